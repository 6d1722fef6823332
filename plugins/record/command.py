"""`sliplab record`: record streams without a protocol, at the terminal."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from decimal import Decimal
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sliplab.flows.cli.common import COLLECT, JsonOption, StoreOption, finish
from sliplab.flows.running import console, exit_codes, stopping
from sliplab.protocols.errors import InputError

if TYPE_CHECKING:
    from sliplab.plugins.record.recorder import RecordedTrial, Recorder
    from sliplab.storage.streams import Json

app = typer.Typer()
LOOK_S, SHOWN_S = 0.05, 0.5
KEY_ERROR_MS = 500.0
"""Bound of the error of a mark by a key: a person's reaction."""
KEYS = "space: start, stop; m: mark slip; t: mark tap; q: quit"


@app.command(
    rich_help_panel=COLLECT,
    epilog="Example: sliplab record cameras.yaml lsl:EMG --store data --campaign grasps --for 60s",
)
def record(
    streams: Annotated[
        list[str],
        typer.Argument(
            metavar="STREAMS",
            help="Rig files, files of streams, lsl:STREAM, usb:DEVICE, or NAME=lsl:STREAM.",
        ),
    ],
    store: StoreOption = ...,  # type: ignore[assignment]  # typer's word for: must be given
    campaign: Annotated[
        str, typer.Option("--campaign", help="Name of the campaign; created if missing.")
    ] = ...,  # type: ignore[assignment]
    length: Annotated[
        str | None, typer.Option("--for", help="Begin at once, and end after this time: 60s.")
    ] = None,
    every: Annotated[
        str | None, typer.Option("--every", help="Begin at once, and a new trial each time: 10min.")
    ] = None,
    condition: Annotated[
        list[str] | None,
        typer.Option("--set", help="A condition of the trials: object=mug, grip_n=2. Repeatable."),
    ] = None,
    operator: Annotated[str, typer.Option("--operator", help="The person.")] = "",
    analysis: Annotated[
        Path | None,
        typer.Option("--analysis", help="Settings (YAML) of the analysis, as in an adapter."),
    ] = None,
    tap: Annotated[
        str | None,
        typer.Option("--tap", help="Two sensors that feel the same taps: imu,grip; key t marks."),
    ] = None,
    pulses: Annotated[
        str | None,
        typer.Option("--pulses", help="Streams that see the same pulses: daq,box (docs: record)."),
    ] = None,
    simulated: Annotated[
        bool, typer.Option("--simulated", help="Mark the trials as simulated.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Record streams without a protocol and without an arm, trial by trial.

    At a terminal keys start, stop and mark; otherwise it begins at once. Ctrl-C ends and keeps the
    trial, and so does the end of the last stream. Ends with 1 if a stream failed or nothing came,
    with 130 if Ctrl-C came before --for was over. After a crash, what verifies of an unfinished
    trial is kept by the next record or verify.
    """
    from sliplab.plugins.record.keys import pressed_keys
    from sliplab.plugins.record.recorder import Recorder, levels

    length_s = None if length is None else _seconds("--for", length)
    every_s = None if every is None else _seconds("--every", every)
    pairs = [_pair(text) for text in condition or ()]
    given = dict(pairs)
    if len(given) < len(pairs):
        raise InputError("--set", "", ", ".join(condition or ()), "gives a condition twice")
    levels(given)  # wrong ones are said before a device is opened
    result: Json = {}
    with (
        Recorder(
            streams,
            store,
            campaign,
            operator=operator,
            simulated=simulated,
            analysis=analysis,
            tap=None if tap is None else _two(tap),
            pulses=None if pulses is None else tuple(pulses.split(",")),
            collects=True,
        ) as recorder,
        pressed_keys() as key,
    ):
        for trial in recorder.salvaged:
            console.say(f"kept what verifies of the unfinished trial {trial}")
        session = _Session(recorder, given, key, length_s, every_s)
        early: KeyboardInterrupt | None = None
        try:
            session.run()
        except KeyboardInterrupt as error:
            early = error if length is not None else None
        finally:
            session.end()
        result = {
            "campaign": campaign,
            "trials": recorder.committed,
            "salvaged": recorder.salvaged,
            "lost": session.lost,
            "faults": session.faults,
            "warnings": session.warnings,
        }
    finish(result, f"recorded into {store}", as_json)
    if early is not None:
        raise early
    if session.faults:
        raise typer.Exit(exit_codes.FAILED)


@dataclass
class _Session:
    """A recording at the terminal.

    Attributes:
        key: returns the next key; None without a terminal.
        length_s, every_s: of the whole, and of each trial; None without a limit.
        lost: rows that are known to be lost, by stream. faults: of streams, and empty trials.
        warnings: what else is worth a look.
    """

    recorder: Recorder
    condition: dict[str, object]
    key: Callable[[], str] | None
    length_s: float | None
    every_s: float | None
    trial: RecordedTrial | None = None
    lost: dict[str, int] = field(default_factory=dict)
    faults: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    _recorded_s: float = 0.0
    """Of the trials before."""
    _shown: float = 0.0
    _rows: dict[str, int] = field(default_factory=dict)

    def run(self) -> None:
        """Record until the time is over, or a key or a signal ends it."""
        if self.key is None or self.length_s is not None or self.every_s is not None:
            self._begin()
        if self.key is not None:
            console.say(KEYS)
        while self._answer(self.key() if self.key is not None else ""):
            if self.trial is not None:
                if len(self.trial.faults) == len(self.recorder.sources):
                    return  # no stream is left
                seconds = (time.monotonic_ns() - self.trial.begin_ns) / 1e9
                if self.length_s is not None and self._recorded_s + seconds >= self.length_s:
                    return
                if self.every_s is not None and seconds >= self.every_s:
                    self._recorded_s += seconds
                    self.end()
                    self._begin()
                elif time.monotonic() - self._shown >= SHOWN_S:
                    self._show(self.trial, seconds)
            stopping.wait(LOOK_S)

    def end(self) -> None:
        """End and commit the trial, if there is one."""
        trial, self.trial = self.trial, None
        if trial is None:
            return
        try:
            trial.close()
        finally:
            self.faults += [f"trial {trial.id}: {fault}" for fault in trial.faults.values()]
            if trial.record is not None and not any(trial.rows().values()):
                self.faults.append(f"trial {trial.id}: nothing came from any stream")
            for name, count in trial.lost().items():
                self.lost[name] = self.lost.get(name, 0) + count
            self._line("")
        console.say(f"trial {trial.id} is committed")
        about = None if trial.record is None else trial.record.imported
        if about is not None:
            for text in (
                *(f"{count} {what}" for what, count in about.dropped.items()),
                *about.warnings,
            ):
                self.warnings.append(f"trial {trial.id}: {text}")
                console.say(f"  {text}")

    def _answer(self, key: str) -> bool:
        """Do what a key asks for; return False to quit."""
        if key in {" ", "\n", "s"}:
            if self.trial is None:
                self._begin()
            else:
                self.end()
        elif key == "m" and self.trial is not None:
            self.trial.mark("slip", uncertainty_ms=KEY_ERROR_MS)
        elif key == "t" and self.trial is not None:
            self.trial.mark("tap", uncertainty_ms=KEY_ERROR_MS)
        return key != "q"

    def _begin(self) -> None:
        self._rows, self._shown = {}, time.monotonic()
        self.trial = self.recorder.trial(**self.condition).__enter__()

    def _show(self, trial: RecordedTrial, seconds: float) -> None:
        """Show rates, losses and size of the running trial in one line."""
        now, rows = time.monotonic(), trial.rows()
        rates = [
            f"{name} ended"
            if name in trial.faults
            else f"{name} {(count - self._rows.get(name, 0)) / (now - self._shown):,.0f}/s"
            for name, count in rows.items()
        ]
        lost = sum(trial.lost().values())
        size = console.size(trial.bytes_written)
        self._line(f"{trial.id}  {seconds:.0f} s  {'  '.join(rates)}  {size}  lost {lost}")
        self._rows, self._shown = rows, now

    def _line(self, text: str) -> None:
        if sys.stderr.isatty():
            sys.stderr.write(f"\r\x1b[K{text}")
            sys.stderr.flush()


def _seconds(option: str, text: str) -> float:
    from pydantic import TypeAdapter, ValidationError

    from sliplab.protocols.quantity import PositiveSeconds

    try:
        value: Decimal = TypeAdapter(PositiveSeconds).validate_python(text)
    except ValidationError as error:
        raise InputError(option, "", text, "must be a time with its unit, such as 60s") from error
    return float(value)


def _two(text: str) -> tuple[str, str]:
    first, comma, second = text.partition(",")
    if not (first and comma and second):
        raise InputError("--tap", "", text, "must be two streams, such as imu,grip")
    return first, second


def _pair(text: str) -> tuple[str, object]:
    name, equals, value = text.partition("=")
    if not equals or not name.isidentifier():
        raise InputError("--set", "", text, "must be NAME=VALUE, such as object=mug")
    try:
        return name, float(value)
    except ValueError:
        return name, value
