"""`sliplab.record`: record streams into a store, trial by trial, beside a program of its own.

One thread reads the devices and writes; the program marks, pushes and decides when a trial begins
and ends. A trial is committed when its block ends, also by an exception. What was written of it up
to a second before a crash is kept by the next recording (`plugins.record.salvage`).
"""

from __future__ import annotations

import math
import re
import shutil
import socket
import threading
import time
from collections.abc import Iterable, Mapping
from contextlib import ExitStack, suppress
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from sliplab.flows.collecting.requests import store_lock
from sliplab.plugins.record.campaign import join
from sliplab.plugins.record.pushed import PushedStream
from sliplab.plugins.record.salvage import salvage_campaign
from sliplab.plugins.record.sources import READS, Source, is_bound, opened
from sliplab.plugins.record.table import MOST_NS
from sliplab.plugins.record.tapped import check_common, check_pulses
from sliplab.plugins.record.trial_record import BegunTrial, make_record
from sliplab.protocols.errors import InputError
from sliplab.protocols.units import TABLE
from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.rig_lock import lock_file, locked
from sliplab.storage.errors import StoreError, translated_disk_errors
from sliplab.storage.files import safe_name, write_json
from sliplab.storage.interrupts import uninterrupted
from sliplab.storage.process import give_memory_back
from sliplab.storage.schema.trial import Mark, Provenance, TrialRecord
from sliplab.storage.streams import FRAMES_KIND, Chunk, Json
from sliplab.storage.trials.prefix_journal import BEGUN
from sliplab.storage.trials.store import Campaign, TrialStore
from sliplab.storage.trials.writer import TrialWriter
from sliplab.storage.versions import RECORDING, installed_versions

POLL_S = 0.01
MARK_S, TRIM_S = 0.3, 10.0
"""Time between two states in a trial's journal: with the disk's, what a crash can lose, s; and
between two returns of freed memory to the system, which else grows with every burst."""
TAIL_S = 0.1
"""Time for which streams are read after the end of a trial: data are on their way, s."""
START_S, END_S = 60.0, 600.0
"""Longest time for devices to start; and for a trial to end, which fits clocks and seals files."""
LOST = ("lost", "late", "overflowed", "dropped", "malformed")
"""Counts of a device of rows that are not recorded."""
_FRAME_RATE = 100
"""Time base of videos only."""
_UNITS = {each.symbol.lower().replace("/", "_"): each.symbol for each in TABLE}
_LEVEL = re.compile(r"[A-Za-z0-9_.+-]+")


class Recorder:
    """Records trials of some streams into one campaign; a context manager.

    Args:
        streams: files of streams, rig files, and what `push` and other functions declare.
        store: its folder, which is made if it is missing.
        campaign: name of a new campaign, or of one that was recorded.
        operator: the person.
        simulated: mark the trials as simulated.
        analysis: YAML file with `analysis`, `split`, `experiment`, `title` or `about`, as in an
            adapter (docs/adapters.md).
        tap: names of two sensors that feel the same taps: the clock of the first is then known by
            the second, near marks named ``tap`` or anywhere in a trial.
        pulses: names of two sensors that see the same pulses, and of others that share the clock of
            the first, which is then known by the second (`plugins.record.pulsed`).
        collects: `sliplab stop` ends this program.

    Raises:
        InputError: an argument or a file.
        RigError: a device cannot be opened.
        Locked: another program writes into the store, or uses a device.
    """

    def __init__(
        self,
        streams: Iterable[str | Path | Source],
        store: str | Path = "data",
        campaign: str = "recording",
        *,
        operator: str = "",
        simulated: bool = False,
        analysis: str | Path | None = None,
        tap: tuple[str, str] | None = None,
        pulses: tuple[str, ...] | None = None,
        collects: bool = False,
    ) -> None:
        self._tap, self._pulses = tap, pulses
        self._streams = [streams] if isinstance(streams, (str, Path, Source)) else list(streams)
        self._store, self._name = Path(store), campaign
        try:
            safe_name(campaign)
        except StoreError:
            text = "must be a folder's name: letters, digits and . _ - = , + are possible"
            raise InputError("record", "campaign", campaign, text) from None
        self._operator, self._simulated = operator, simulated
        self._analysis = None if analysis is None else Path(analysis)
        self._collects = collects
        self._undo = ExitStack()
        self.sources: list[Source] = []
        self.salvaged: list[str] = []
        self.committed: list[str] = []
        self._experiment = ""
        self._running: RecordedTrial | None = None
        self._open = False

    def __enter__(self) -> Self:
        with ExitStack() as undo, ExitStack() as devices:
            self.sources = opened(self._streams, devices)  # wrong input writes nothing
            for key, names in (("tap", self._tap), ("pulses", self._pulses)):
                if names is not None:
                    check_common(key, names, self.sources)
            if self._pulses is not None and all(s.clock != READS for s in self.sources):
                check_pulses(self._pulses, self.sources)
            store = TrialStore.create(self._store)
            undo.enter_context(store_lock(store, collects=self._name if self._collects else ""))
            self.campaign: Campaign = store.campaign(self._name)
            locks = {
                lock_file(name): what
                for source in self.sources
                for name, what in source.locks.items()
            }
            undo.enter_context(locked(locks, self._store))
            undo.push(devices.pop_all())  # closed before their locks are free
            self._experiment = join(self.campaign, self._analysis, self._simulated)
            self.salvaged = salvage_campaign(self.campaign)
            for source in self.sources:
                source.stream.connect()
            if self._pulses is not None:  # columns of LSL are known now
                check_pulses(self._pulses, self.sources)
            self._undo = undo.pop_all()
        self._open = True
        return self

    def __exit__(self, *error: object) -> None:
        self._open = False
        with self._undo:
            if self._running is not None:
                self._running.close("the recording ended")

    def trial(self, **condition: object) -> RecordedTrial:
        """Return the next trial, a context manager.

        Args:
            condition: what was varied. A name may end in a unit: ``grip_n=2.0`` is the factor
                ``grip`` of 2.0 N.

        Raises:
            InputError: a value is neither a number nor text of a to z, digits, spaces and ``_.+-``.
            RuntimeError: a trial is being recorded, or the recording has not begun, or has ended.
        """
        self._check_free()
        return RecordedTrial(self, levels(condition))

    def _check_free(self) -> None:
        if not self._open:
            raise RuntimeError("a trial is recorded within the block: with record(...) as recorder")
        if self._running is not None:
            raise RuntimeError("a trial is being recorded; end it first")

    def _next_id(self) -> tuple[str, int]:
        known = {
            path.name.partition(".")[0]
            for name in ("trials", "incoming", "quarantine")
            for path in self.campaign.folders(name)
        }
        number = max((int(name) for name in known if name.isdecimal()), default=0) + 1
        return f"{number:06d}", number - 1


def levels(condition: Mapping[str, object]) -> dict[str, str]:
    """Return the levels of a condition as text, by factor. Raises InputError."""
    found: dict[str, str] = {}
    for name, value in condition.items():
        factor, text = _level(name, value)
        if factor in found:
            raise InputError("trial", name, value, f"gives the factor {factor} a second time")
        found[factor] = text
    return found


def _level(name: str, value: object) -> tuple[str, str]:
    if not name.isidentifier():
        raise InputError("trial", name, value, "must have a name of letters, digits and _")
    if isinstance(value, bool) or not isinstance(value, (str, int, float, np.number)):
        raise InputError("trial", name, value, "must be text or a number")
    if isinstance(value, str):
        level = "_".join(value.split())
        if not _LEVEL.fullmatch(level):  # characters left out would make one level of two
            right = "must be of the letters a to z, digits, spaces and _ . + -"
            raise InputError("trial", name, value, right)
        return name, level
    try:
        finite = math.isfinite(float(value))
    except OverflowError:
        finite = False
    if not finite:
        raise InputError("trial", name, value, "must be a finite number")
    for suffix, unit in _UNITS.items():
        if name.endswith(f"_{suffix}") and len(name) > len(suffix) + 1:
            return name.removesuffix(f"_{suffix}"), f"{value} {unit}"
    return name, f"{value}"


class RecordedTrial:
    """One trial while it is recorded; a context manager. Its methods may be called in any thread.

    Attributes:
        id: its id in the campaign, once it has begun.
        faults: why streams have ended, by name.
        record: once it is committed.
    """

    def __init__(self, recorder: Recorder, condition: dict[str, str]) -> None:
        self._recorder, self._condition = recorder, condition
        self.id = ""
        self.faults: dict[str, str] = {}
        self.record: TrialRecord | None = None
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._began, self._end = threading.Event(), threading.Event()
        self._error: BaseException | None = None
        self._ended_by = ""
        self._lock = threading.Lock()
        self._marks: list[Mark] = []
        self._described: dict[str, Json] | None = None
        self._drained = False
        self.begin_ns = self._end_ns = 0
        self.bytes_written = 0

    def __enter__(self) -> Self:
        self._recorder._check_free()
        self._recorder._running = self
        self._thread.start()
        self._wait(self._began, START_S, "the devices did not start")
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        why = ""
        if kind is not None:
            why = f"{kind.__name__}: {error}" if str(error) else kind.__name__
        self.close(why)

    def close(self, ended_by: str = "") -> None:
        """End and commit the trial; safe to call more than once.

        Args:
            ended_by: what ended it early, which its record says.

        Raises:
            StoreError, RigError: it could not be committed.
        """
        if self._recorder._running is not self:
            return
        if not self._end.is_set():
            self._ended_by, self._end_ns = ended_by, time.monotonic_ns()
            self._end.set()
        interrupted: KeyboardInterrupt | None = None
        deadline = time.monotonic() + END_S
        while self._thread.is_alive():
            try:
                self._thread.join(1.0)
            except KeyboardInterrupt as error:  # the files are completed first
                interrupted = error
            if time.monotonic() > deadline:
                raise RigError("recorder", f"trial {self.id} did not end within {END_S:g} s")
        self._recorder._running = None
        if self._error is not None:
            raise self._error
        if interrupted is not None:
            raise interrupted

    def push(self, name: str, t_ns: Any, *values: Any, **named: Any) -> None:
        """Add rows to a stream that `push` declared; see `PushedStream.push`.

        Args:
            t_ns: time, or times of shape (n,), ns (of events us); None is now.
            values: of each column a number, or numbers of shape (n,).

        Raises:
            InputError: no such stream, other columns, or times of another clock.
        """
        source = next((each for each in self._recorder.sources if each.name == name), None)
        if source is None or not isinstance(source.device, PushedStream):
            raise InputError("push", "", name, "is no stream that was declared with push()")
        source.device.push(t_ns, *values, **named)

    def mark(
        self, name: str, t_ns: int | None = None, *, uncertainty_ms: float | None = None
    ) -> None:
        """Mark a moment; the first ``slip`` or ``incipient``, and the first ``gross``, are onsets.

        Args:
            t_ns: on the host's clock (``time.monotonic_ns()``); None is now.
            uncertainty_ms: bound of its error; None where it is unknown.

        Raises:
            InputError: an argument. RuntimeError: the trial has ended.
        """
        if not isinstance(name, str) or not (name and name.isprintable()) or len(name) > 100:
            raise InputError("mark", "", name, "must be printable text of 100 characters at most")
        if t_ns is not None and (
            isinstance(t_ns, bool)
            or not isinstance(t_ns, (int, np.integer))
            or abs(int(t_ns)) >= MOST_NS
        ):
            raise InputError("mark", "t_ns", t_ns, "must be whole ns, as time.monotonic_ns() gives")
        if uncertainty_ms is not None and not is_bound(uncertainty_ms):
            right = "must be a finite number of milliseconds, not negative"
            raise InputError("mark", "uncertainty_ms", uncertainty_ms, right)
        at = time.monotonic_ns() if t_ns is None else int(t_ns)
        error = None if uncertainty_ms is None else uncertainty_ms * 1e6
        with self._lock:
            if self._drained:
                raise RuntimeError(f"mark '{name}': the trial has ended")
            self._marks.append(Mark(name=name, t_ns=at, uncertainty_ns=error))

    def rows(self) -> dict[str, int]:
        """Return the rows of each stream so far."""
        return {source.name: source.rows for source in self._recorder.sources}

    def lost(self) -> dict[str, int]:
        """Return what is known to be lost so far, by stream; at the end what the record says."""
        described = self._described
        if described is None:
            described = {s.name: s.stream.describe() or {} for s in self._recorder.sources}
        found = {}
        for name, about in described.items():
            counts = about.get("counts", {})
            if lost := sum(int(counts.get(key, 0)) for key in LOST):
                found[name] = lost
        return found

    def _note(self, writer: TrialWriter, begun: BegunTrial, changed: bool = False) -> None:
        """Write down how the trial was begun if that has changed, or what is lost."""
        dropped = {f"rows of {name} that were lost": n for name, n in self.lost().items()}
        if changed or dropped != begun.dropped:
            begun.dropped = dropped
            write_json(writer.folder / BEGUN, begun.model_dump(mode="json"))

    def _wait(self, event: threading.Event, seconds: float, what: str) -> None:
        if not event.wait(seconds):
            self._end.set()
            self._recorder._running = None
            raise RigError("recorder", f"{what} within {seconds:g} s")
        if self._error is not None:
            self._thread.join(END_S)
            self._recorder._running = None
            raise self._error

    def _run(self) -> None:
        try:
            with translated_disk_errors(self._recorder.campaign.folder, RigError):
                self._record()
        except BaseException as error:
            self._error = error
        finally:
            self._began.set()

    @uninterrupted
    def _record(self) -> None:
        recorder = self._recorder
        self.id, repetition = recorder._next_id()
        expected: dict[str, tuple[Chunk, ...]] = {}
        for source in recorder.sources:
            expected |= source.expected()
        first = next((s for s in recorder.sources if s.name == FRAMES_KIND), None)
        size = None if first is None else first.stream.about.size_px
        writer = recorder.campaign.begin(self.id, size, _FRAME_RATE, expected=expected)
        begun = BegunTrial(
            trial=self.id,
            campaign=recorder.campaign.name,
            experiment=recorder._experiment,
            repetition=repetition,
            condition=self._condition,
            simulated=recorder._simulated,
            begin_ns=time.monotonic_ns(),
            started=datetime.now(UTC).isoformat(timespec="milliseconds"),
            operator=recorder._operator,
            sources={source.name: source.about for source in recorder.sources},
            tap=recorder._tap,
            pulses=recorder._pulses,
        )
        try:
            self._stream(writer, begun)
            self._commit(writer, begun)
        except BaseException as error:
            with suppress(OSError, RuntimeError):
                writer.abandon()
            if not begun.begin_ns or not self._began.is_set():
                with suppress(OSError):
                    recorder.campaign.quarantine(writer.folder, f"{type(error).__name__}: {error}")
            raise
        recorder.committed.append(self.id)

    def _stream(self, writer: TrialWriter, begun: BegunTrial) -> None:
        """Start the devices, and write what they send until the trial ends."""
        sources = self._recorder.sources
        try:
            for source in sources:
                source.start()
            self.begin_ns = begun.begin_ns = time.monotonic_ns()
            self._note(writer, begun, changed=True)
            self._began.set()
            noted = trimmed = time.monotonic()
            while not self._end.wait(POLL_S):
                self._drain(writer, begun)
                if time.monotonic() - noted >= MARK_S:
                    writer.mark()
                    self._note(writer, begun)
                    self.bytes_written = sum(p.stat().st_size for p in writer.folder.iterdir())
                    noted = time.monotonic()
                if noted - trimmed >= TRIM_S:
                    give_memory_back()
                    trimmed = noted
            tail = time.monotonic() + TAIL_S
            while time.monotonic() < tail:
                self._drain(writer, begun)
                threading.Event().wait(POLL_S)
            self._drain(writer, begun, last=True)
            writer.mark()
        finally:
            for source in sources:
                with suppress(RigError):
                    source.stream.stop()

    def _drain(self, writer: TrialWriter, begun: BegunTrial, last: bool = False) -> None:
        for source in self._recorder.sources:
            if source.fault is not None:
                continue
            try:
                source.drain(writer, last)
            except RigError as error:  # the others continue
                source.fault = self.faults[source.name] = str(error)
        with self._lock:
            marks, self._marks = self._marks, []
            self._drained = last
        if marks:
            begun.marks += marks
            self._note(writer, begun, changed=True)

    def _commit(self, writer: TrialWriter, begun: BegunTrial) -> None:
        """Fit the clocks, and commit the trial."""
        sources = self._recorder.sources
        notes = [f"ended by {self._ended_by}"] if self._ended_by else []
        notes += [f"{fault}; the stream ended there" for fault in self.faults.values()]
        devices = {s.name: about for s in sources if (about := s.stream.describe()) is not None}
        self._described = devices  # devices may still count what comes behind the end
        self._note(writer, begun)
        folder = writer.seal()
        record = make_record(folder, begun, self._end_ns, tuple(notes), devices=devices)
        provenance = Provenance(
            started=begun.started,
            ended=datetime.now(UTC).isoformat(timespec="milliseconds"),
            host=socket.gethostname(),
            operator=begun.operator,
            disk_free=shutil.disk_usage(folder).free,
            versions=installed_versions(RECORDING),
        )
        writer.commit(record, provenance)
        self.record = record


def record(
    streams: Iterable[str | Path | Source],
    store: str | Path = "data",
    campaign: str = "recording",
    **options: Any,
) -> Recorder:
    """Record streams into a campaign of a store, trial by trial; see `Recorder`.

    with sliplab.record(["camera.yaml", push("gripper", {"width": "mm"})]) as recording:
        with recording.trial(object="mug", grip_n=2.0) as trial:
            trial.push("gripper", None, 31.5)
            trial.mark("slip")
    """
    return Recorder(streams, store, campaign, **options)


__all__ = ["RecordedTrial", "Recorder", "record"]
