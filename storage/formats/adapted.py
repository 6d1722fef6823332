"""Import of a foreign data set by an adapter: each trial complete or not at all."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from sliplab.protocols.adapter import Adapter, load_adapter
from sliplab.protocols.adapter_parts import StreamClock
from sliplab.protocols.errors import InputError
from sliplab.storage.clockmap import IDENTITY, ClockMap
from sliplab.storage.formats.adapted_labels import FoundTime, find_motion
from sliplab.storage.formats.adapted_streams import (
    read_events,
    read_frames,
    read_poses,
    read_scalar,
    read_wrench,
)
from sliplab.storage.formats.adapted_trials import (
    EVENTS,
    FRAME_TIMES,
    FRAMES,
    POSES,
    AdaptedSet,
    AdaptedTrial,
)
from sliplab.storage.formats.foreign import RISING, FormatError, check_pixels
from sliplab.storage.process import now
from sliplab.storage.schema.document import first_fault
from sliplab.storage.schema.trial import (
    Clocks,
    Counts,
    DeviceRecord,
    Geometry,
    Given,
    GivenSpan,
    Imported,
    Provenance,
    Quality,
    Step,
    StreamRecord,
    TrialRecord,
)
from sliplab.storage.streams import Json, PulseChunk
from sliplab.storage.trials.store import IMPORTED, Campaign, CampaignInfo, Store
from sliplab.storage.trials.writer import TrialWriter

ADAPTER = "adapter"
"""Key of a campaign's `imported` part, and its format."""
GIVEN, UNKNOWN = "given", "unknown"
"""Grades of clocks: stated by the adapter, or not."""
_FRAME_RATE = 100
_RIG = "# Imported: there is no rig file.\nimported: adapter\n"


def import_adapted(
    store: Store,
    name: str,
    found: AdaptedSet,
    text: str,
    on_trial: Callable[[str], None] = lambda name: None,
) -> Json:
    """Import the trials of a data set that are not there yet; the caller holds the store's lock.

    Args:
        name: the campaign's, which is made, or was made by the same adapter.
        text: the adapter's, which the campaign keeps.
        on_trial: called with each trial's id before it is read; what it raises ends the import
            between two trials.

    Returns:
        ``campaign``, ``imported`` and ``there`` with ids, ``events`` and ``frames`` imported.

    Raises:
        InputError: the campaign is another one, or a file cannot be right. Trials before it stay
            committed; of this one nothing is left.
    """
    campaign = store.campaign(name)
    fresh = not campaign.begun
    if not fresh:
        _check_same(campaign, found)
    existing = campaign.committed()
    imported: list[str] = []
    counts = {"events": 0, "frames": 0}
    wanted = [trial for trial in found.trials if trial.id not in existing]
    try:
        for trial in wanted:
            on_trial(trial.id)
            if not imported:
                _describe(campaign, found, text)
            taken = _take(campaign, found, trial)
            imported.append(trial.id)
            counts = {key: counts[key] + taken[key] for key in counts}
        if not wanted:
            _describe(campaign, found, text)
    finally:
        if fresh and not imported and campaign.folder.exists():
            shutil.rmtree(campaign.folder)
    there = [trial.id for trial in found.trials if trial.id in existing]
    return {"campaign": name, "imported": imported, "there": there, **counts}


def _check_same(campaign: Campaign, found: AdaptedSet) -> None:
    """Check that a campaign came by this adapter, which may differ in how it is analysed."""
    info = campaign.info
    if ADAPTER not in info.get(IMPORTED, {}):
        raise InputError(
            "--name", "", campaign.name,
            "is a campaign that did not come by an adapter; choose another name",
        )  # fmt: skip
    kept, new = load_adapter(campaign.protocol_file).of_the_trials(), found.adapter.of_the_trials()
    differing = [key for key in new if new[key] != kept.get(key)]
    if differing:
        raise InputError(
            found.file, differing[0], None,
            f"differs from the adapter of campaign '{campaign.name}' (in "
            f"{', '.join(differing)}), whose trials would not be alike; choose another --name",
        )  # fmt: skip


def _describe(campaign: Campaign, found: AdaptedSet, text: str) -> None:
    about: Json = {
        "from": found.folder.path.name, "format": ADAPTER, ADAPTER: found.adapter.adapter,
        "when": now(),
    }  # fmt: skip
    if campaign.begun:
        about = campaign.info.get(IMPORTED, about)
    info: CampaignInfo = {
        "name": campaign.name, "simulated": found.adapter.simulated,
        "experiment": found.adapter.experiment, IMPORTED: about,
    }  # fmt: skip
    campaign.update(info, text, _RIG)


def _take(campaign: Campaign, found: AdaptedSet, trial: AdaptedTrial) -> dict[str, int]:
    """Commit one trial; return its counts."""
    with ExitStack() as stack:
        made = _Trial(campaign, found, trial, stack)
        try:
            record = made.fill()
            provenance = {"imported": now(), "from": trial.source}
            made.writer.commit(record, Provenance.model_validate(provenance))
        except BaseException:
            made.writer.discard()
            raise
    return {"events": record.counts.events, "frames": record.counts.frames}


class _Trial:
    """A trial while it is imported."""

    def __init__(
        self, campaign: Campaign, found: AdaptedSet, trial: AdaptedTrial, stack: ExitStack
    ) -> None:
        self._campaign, self._found, self._trial, self._stack = campaign, found, trial, stack
        self._adapter: Adapter = found.adapter
        self._clocks: dict[str, DeviceRecord] = {}
        self._streams: dict[str, StreamRecord] = {}
        self._unknown: list[str] = []
        self._ends_ns: list[tuple[int, int]] = []
        self._event_px: tuple[int, int] | None = None
        self._frames = self._open_frames()
        size = None if self._frames is None else self._frames[0]
        self.writer: TrialWriter = campaign.begin(trial.id, size, _FRAME_RATE)

    def fill(self) -> TrialRecord:
        """Write all streams; return the record.

        Raises:
            InputError: a file cannot be right, or a label lies outside of the recording.
        """
        span = self._reading(EVENTS, self._add_events)
        self._reading(FRAMES, self._add_frames)
        self._reading(POSES, self._add_poses)
        parts = self._adapter.streams
        for key, named in (("wrenches", parts.wrenches), ("scalars", parts.scalars)):
            for name in named:
                self._reading(f"{key}.{name}", partial(self._add, key, name))
        if span is None:
            if not self._ends_ns:
                raise self._error(self._names(EVENTS), "contains no event: its length is unknown")
            span = (min(a for a, _ in self._ends_ns), max(b for _, b in self._ends_ns))
        return self._record(span)

    def _names(self, stream: str) -> tuple[str, ...]:
        return self._trial.files.get(stream, ())

    def _paths(self, stream: str) -> list[Path]:
        return self._stack.enter_context(self._found.folder.local(*self._names(stream)))

    def _error(self, names: tuple[str, ...], text: str) -> InputError:
        where = self._found.folder.place(names[0]) if names else str(self._found.folder.path)
        return InputError(where, "", None, text)

    def _reading(self, stream: str, read: Callable[[], Any]) -> Any:
        """Read a stream that is there; a fault in its file becomes the error of that file."""
        try:
            return read() if self._names(stream) else None
        except FormatError as error:
            raise self._error(self._names(stream), str(error)) from None

    def _open_frames(self) -> Any:
        part = self._adapter.streams.frames
        if part is None or not self._names(FRAMES):
            return None
        times = self._names(FRAME_TIMES)
        if part.times is not None and not times:
            return None
        paths = self._paths(FRAMES) if part.format == "video" else []
        return self._reading(
            FRAMES,
            lambda: read_frames(self._found.folder, self._names(FRAMES), times, part, paths),
        )

    def _add_events(self) -> tuple[int, int] | None:
        part = self._adapter.streams.events
        assert part is not None
        here = part.format in {"counts", "csv", "numpy"}
        paths = [] if here else self._paths(EVENTS)
        source = read_events(self._found.folder, self._names(EVENTS), part, paths)
        last_us: int | None = None
        for chunk in source.chunks():
            if not len(chunk):
                continue
            if last_us is not None and int(chunk.t_us[0]) < last_us:
                raise FormatError("contains events with decreasing times")
            first_us = int(chunk.t_us[0])
            last_us = int(chunk.t_us[-1])
            self._ends_ns.append((first_us * 1000, (last_us + 1) * 1000))
            check_pixels(chunk, source.size_px())
            self.writer.add_events(chunk)
        self._event_px = source.size_px()
        if self._event_px is None:
            self._unknown.append("sensor size")
        self._clocks["events"] = DeviceRecord(grade=UNKNOWN, map=IDENTITY)
        foreign = source.foreign
        if foreign is not None:
            self._unknown += [what for what in foreign.unknown if what != "condition"]
            if foreign.triggers is not None:
                t_ns = foreign.triggers.t_us * 1000
                self.writer.add_triggers(t_ns, foreign.triggers.kind)
                self.writer.add_event_pulses(PulseChunk(t_ns[foreign.triggers.kind == RISING]))
        if source.span_us is None:
            return None
        return source.span_us[0] * 1000, source.span_us[1] * 1000

    def _add_frames(self) -> None:
        part = self._adapter.streams.frames
        if self._frames is None or part is None:
            return
        clock = self._clock(part.clock, "frames")
        for chunk in self._frames[1]():
            if len(chunk):
                self._saw(clock, int(chunk.t_ns[0]), int(chunk.t_ns[-1]))
            self.writer.add_frames(chunk)

    def _add_poses(self) -> None:
        part = self._adapter.streams.poses
        assert part is not None
        chunk = read_poses(self._found.folder, self._names(POSES)[0], part)
        self.writer.add_poses(chunk)
        self._clock(part.clock, "arm")

    def _add(self, kind: str, name: str) -> None:
        file = self._names(f"{kind}.{name}")[0]
        parts = self._adapter.streams
        if kind == "wrenches":
            wrench = parts.wrenches[name]
            chunk: Any = read_wrench(self._found.folder, file, wrench)
            clock, unit = wrench.clock, None
        else:
            scalar = parts.scalars[name]
            chunk = read_scalar(self._found.folder, file, scalar)
            clock, unit = scalar.clock, scalar.quantity_unit or None
        self.writer.add_stream(name, chunk)
        self._clock(clock, name)
        self._streams[name] = StreamRecord(kind=chunk.KIND, rows=len(chunk), unit=unit)

    def _clock(self, clock: StreamClock | None, device: str) -> DeviceRecord:
        """Keep the clock of a device on the time line, which is the events' clock."""
        if not self._clocks or clock is None:
            if self._clocks:
                self._unknown.append(f"clock of {device}")
            record = DeviceRecord(grade=UNKNOWN, map=IDENTITY)
        else:
            error = clock.uncertainty_ms
            record = DeviceRecord(
                grade=GIVEN,
                map=ClockMap.line(0, round(clock.offset_ms * 1e6), round(clock.drift_ppm * 1000)),
                uncertainty_ns=None if error is None else error * 1e6,
            )
        self._clocks[device] = record
        return record

    def _saw(self, clock: DeviceRecord, first_ns: int, last_ns: int) -> None:
        line = clock.map.to_reference
        self._ends_ns.append((line(first_ns), line(last_ns) + 1000))

    def _on_line(self, time: FoundTime, clock: str, span: tuple[int, int]) -> int:
        """A label's time on the time line.

        Raises:
            InputError: it lies outside of the recording.
        """
        ns = self._line_ns(time.ns, clock, span)
        if not span[0] <= ns <= span[1]:
            raise time.row.error(
                time.column, f"lies outside of the recording of trial {self._trial.id}, which is "
                f"from {span[0] / 1e9:g} to {span[1] / 1e9:g} s",
            )  # fmt: skip
        return ns

    def _line_ns(self, ns: int, clock: str, span: tuple[int, int]) -> int:
        if clock == "start":
            return span[0] + ns
        known = self._clocks.get(clock)
        return ns if known is None else known.map.to_reference(ns)

    def _given(self, span: tuple[int, int]) -> Given | None:
        label = self._trial.label
        if label is None:
            return None
        if label.whole is not None:
            whole = GivenSpan(start_ns=span[0], end_ns=span[1], name=label.whole)
            return Given(source=label.source, spans=(whole,))
        spans = tuple(
            GivenSpan(
                start_ns=self._on_line(each.start, label.clock, span),
                end_ns=self._on_line(each.end, label.clock, span),
                name=each.name,
            )
            for each in label.spans
        )
        incipient, gross = (
            None if time is None else self._on_line(time, label.clock, span)
            for time in (label.incipient, label.gross)
        )
        known = self._clocks.get(label.clock)
        error = label.uncertainty_ns
        if error is not None and known is not None and label.clock != "events":
            clock_error = known.uncertainty_ns
            error = None if clock_error is None else error + clock_error
        return Given(
            source=label.source, spans=spans, incipient_ns=incipient, gross_ns=gross,
            uncertainty_ns=error,
        )  # fmt: skip

    def _steps(self, span: tuple[int, int]) -> tuple[Step, ...]:
        motion = self._adapter.motion
        if motion is None:
            return ()
        fields = {**self._trial.fields, "id": self._trial.id}
        found = find_motion(motion, fields, self._found.file, self._trial.id)
        if found is None:
            self._unknown.append("motion")
            return ()
        start, end = (self._line_ns(ns, motion.clock, span) for ns in found)
        if not span[0] <= start < end <= span[1]:
            raise InputError(
                self._found.file, "motion.start", motion.start,
                f"to {motion.end}: lies outside of the recording of trial {self._trial.id}, which "
                f"is from {span[0] / 1e9:g} to {span[1] / 1e9:g} s",
            )  # fmt: skip
        if "arm" not in self._clocks:  # the motion's times are on the time line
            self._clocks["arm"] = DeviceRecord(grade=UNKNOWN, map=IDENTITY)
        times = [int(self._clocks["arm"].map.to_device(ns)) for ns in (span[0], start, end)]
        hold = Step(phase="hold", start_ns=times[0], end_ns=times[1])
        slide = Step(phase="slide", start_ns=times[1], end_ns=times[2])
        return (hold, slide) if times[1] > times[0] else (slide,)

    def _all_clocks(self) -> Clocks:
        seen = self._adapter.streams.events is not None
        known = self._clocks
        return Clocks(
            reference="event camera" if seen else "frame camera",
            events=known.get("events"),
            frames=known.get("frames"),
            arm=known.get("arm"),
            streams={name: clock for name, clock in known.items() if name in self._streams},
        )

    def _record(self, span: tuple[int, int]) -> TrialRecord:
        trial, adapter = self._trial, self._adapter
        rows = self.writer.counts
        steps = self._steps(span)
        frame_px = None if self._frames is None else self._frames[0]
        origin = {
            "format": ADAPTER,
            "from": trial.source,
            "unknown": [*self._unknown, *(f"{name} (no file)" for name in trial.missing)],
            "fields": trial.fields,
            "span_ns": span,
            "given": self._given(span),
        }
        try:
            return TrialRecord(
                trial=trial.id,
                campaign=self._campaign.name,
                experiment=adapter.experiment,
                role="measured",
                block=0,
                repetition=0,
                attempt=0,
                condition=trial.condition,
                simulated=adapter.simulated,
                recorded_s=(span[1] - span[0]) / 1e9,
                counts=Counts(
                    events=rows["events/t"], frames=rows["frames/t"], poses=rows["poses/t"],
                    pulses=0,
                ),
                clocks=self._all_clocks(),
                quality=Quality(passed=True, gates={}),
                steps=steps,
                geometry=Geometry(event_px=self._event_px, frame_px=frame_px),
                imported=Imported.model_validate(origin),
                streams=self._streams,
            )  # fmt: skip
        except ValidationError as error:
            key, value, expected = first_fault(error)
            raise InputError(
                self._found.file, key, value, f"{expected}, in the record of trial {trial.id}"
            ) from None
