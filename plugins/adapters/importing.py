"""Trials of a foreign data set as its adapter describes them, opened one after the other."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Generator, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from sliplab.plugins.adapters.labels import FoundTime, find_motion
from sliplab.plugins.adapters.streams import (
    NO_ROW,
    FrameNotes,
    read_events,
    read_frames,
    read_samples,
)
from sliplab.plugins.adapters.trials import (
    EVENTS,
    FRAME_TIMES,
    FRAMES,
    POSES,
    AdaptedSet,
    AdaptedTrial,
)
from sliplab.protocols.adapter import load_adapter
from sliplab.protocols.adapter_parts import (
    OWN_FORMATS,
    Markers,
    PoseFiles,
    ScalarFiles,
    StreamClock,
    WrenchFiles,
)
from sliplab.protocols.errors import InputError
from sliplab.storage.clockmap import IDENTITY, ClockMap
from sliplab.storage.formats.foreign import (
    DataSpan,
    ForeignTrial,
    FormatError,
    LabelError,
    Whole,
    broken,
    refusal,
)
from sliplab.storage.formats.import_trials import import_trials
from sliplab.storage.process import now
from sliplab.storage.schema.trial import DeviceRecord, Given, GivenSpan, MotionStep
from sliplab.storage.streams import Chunk, Json
from sliplab.storage.trials.store import ADAPTER, IMPORTED, Campaign, CampaignInfo, TrialStore

GIVEN, UNKNOWN = "given", "unknown"
"""Grades of clocks: stated by the adapter, or not."""
_RIG = "# Imported: there is no rig file.\nimported: adapter\n"
_OF_EVENTS = ("event_px", "any_order", "triggers", "lost", "packets", "salvage")
"""Attributes of a trial that come from the file of its events."""
T = TypeVar("T")


def import_adapted(
    store: TrialStore,
    name: str,
    found: AdaptedSet,
    text: str,
    on_trial: Callable[[str], None] = lambda name: None,
    *,
    salvage: bool = False,
) -> Json:
    """Import the trials of a data set that are not there yet; see `import_trials`.

    Args:
        name: the campaign's, which is made, or was made by the same adapter.
        text: the adapter's, which the campaign keeps.

    Raises:
        InputError: the campaign is another one, or a file cannot be right. Trials before it stay
            committed; of this one nothing is left.
    """
    existing = store.campaign(name).committed()
    campaign = AdaptedCampaign(found, text)
    with closing(_opened(found, campaign, existing, salvage)) as trials:
        return import_trials(
            store, name, trials, found.folder.path, ADAPTER, on_trial, salvage=salvage
        )


def _opened(
    found: AdaptedSet, campaign: AdaptedCampaign, existing: set[str], salvage: bool
) -> Generator[ForeignTrial]:
    """Yield the trials; of those that exist nothing is opened."""
    for trial in found.trials:
        with ExitStack() as stack:
            made = ForeignTrial(
                trial.id,
                trial.source,
                lambda: iter(()),
                "as its files have them",
                campaign=campaign,
            )
            if trial.id not in existing:
                try:
                    made = _Opening(found, trial, stack, salvage).open(made)
                except FormatError as error:
                    fault = refusal(error.file or found.folder.path, error)
                    made = replace(broken(trial.id, trial.source, fault), campaign=campaign)
                except InputError as error:
                    made = replace(broken(trial.id, trial.source, error), campaign=campaign)
            yield made


def _salvaged(salvage: Callable[[], ForeignTrial], made: ForeignTrial) -> ForeignTrial:
    """Return the intact part of the events' file, with the frames of another file."""
    return replace(salvage(), frames=made.frames, frame_px=made.frame_px)


@dataclass(frozen=True, eq=False)
class AdaptedCampaign:
    """The campaign of a data set, which keeps the adapter's text in a protocol's place."""

    found: AdaptedSet
    text: str

    def join(self, campaign: Campaign, source: str) -> None:
        """Keep the adapter, which may differ from one before in how the data are analysed."""
        found = self.found
        about: Json = {
            "from": found.folder.path.name,
            "format": ADAPTER,
            ADAPTER: found.adapter.adapter,
            "when": now(),
        }
        if campaign.begun:
            self._check(campaign)
            about = campaign.info.get(IMPORTED, about)
        info: CampaignInfo = {
            "name": campaign.name,
            "simulated": found.adapter.simulated,
            "experiment": found.adapter.experiment,
            IMPORTED: about,
        }
        campaign.update(info, self.text, _RIG)

    def _check(self, campaign: Campaign) -> None:
        if ADAPTER not in campaign.info.get(IMPORTED, {}):
            raise InputError(
                "--name",
                "",
                campaign.name,
                "is a campaign that did not come by an adapter; choose another name",
            )
        stored = load_adapter(campaign.protocol_file).of_the_trials()
        new = self.found.adapter.of_the_trials()
        differing = [key for key in new if new[key] != stored.get(key)]
        if differing:
            raise InputError(
                self.found.file,
                differing[0],
                None,
                f"differs from the adapter of campaign '{campaign.name}' (in "
                f"{', '.join(differing)}), whose trials would not be alike; choose another --name",
            )


def _device(clock: StreamClock | None) -> DeviceRecord:
    """Return what an adapter states of a clock."""
    if clock is None:
        return DeviceRecord(grade=UNKNOWN, map=IDENTITY)
    offset_ns, drift = round(clock.offset_ms * 1e6), round(clock.drift_ppm * 1e12)
    error = clock.uncertainty_ms
    return DeviceRecord(
        grade=GIVEN,
        map=ClockMap((0,), (offset_ns,), (drift,)),
        uncertainty_ns=None if error is None else error * 1e6,
    )


def _geometry(markers: Markers | None) -> Json:
    if markers is None:
        return {}
    return {"px_per_mm": markers.px_per_mm, "skin_mm": markers.places_mm, "centre": markers.centre}


@dataclass
class _Opening:
    """A trial while it is opened.

    Attributes:
        stack: closes unpacked files, once the trial is imported.
        clocks: of devices and streams on the time line, which is the events' clock.
    """

    found: AdaptedSet
    trial: AdaptedTrial
    stack: ExitStack
    salvage: bool
    clocks: dict[str, DeviceRecord] = field(default_factory=dict)
    unknown: list[str] = field(default_factory=list)
    left_out: Counter[str] = field(default_factory=Counter)
    resolution_us: dict[str, float] = field(default_factory=dict)
    frame_notes: FrameNotes = field(default_factory=FrameNotes)
    span_ns: tuple[int, int] | None = None

    def open(self, made: ForeignTrial) -> ForeignTrial:
        """Open its files.

        Raises:
            FormatError: one cannot be right; it names the file.
        """
        adapter, trial, parts = self.found.adapter, self.trial, self.found.adapter.streams
        if self._names(EVENTS):
            made = self._with_events(made, self._read(EVENTS, self._open_events))
        if self._names(FRAMES) and (parts.frames is not None) and self._timed():
            size, frames, self.frame_notes = self._read(FRAMES, self._open_frames)
            self.resolution_us[FRAMES] = self.frame_notes.resolution_us
            made = replace(made, frames=lambda: self._of(FRAMES, frames()), frame_px=size)
            self._clock(parts.frames.clock, "frames")
        if parts.poses is not None and self._names(POSES):
            made = replace(made, poses=self._samples(POSES, POSES, POSES, parts.poses))
            self._clock(parts.poses.clock, "arm")
        if made.salvage is not None and parts.frames is not None:
            made = replace(made, salvage=partial(_salvaged, made.salvage, made))
        made = replace(made, streams=self._streams())
        motion = self._motion()
        return replace(
            made,
            condition=trial.condition,
            simulated=adapter.simulated,
            experiment=adapter.experiment,
            about={"fields": trial.fields},
            left_out=self.left_out,
            resolution_us=self.resolution_us,
            notes=lambda: tuple(dict.fromkeys(self.frame_notes.texts)),
            unknown=(*self.unknown, *(f"{name} (no file)" for name in trial.missing)),
            clocks=self.clocks,
            geometry=_geometry(adapter.markers),
            whole=lambda seen: self._whole(seen, motion),
        )

    def _names(self, stream: str) -> tuple[str, ...]:
        return self.trial.files.get(stream, ())

    def _paths(self, stream: str) -> list[Path]:
        return self.stack.enter_context(self.found.folder.local(*self._names(stream)))

    @contextmanager
    def _named(self, stream: str) -> Iterator[None]:
        """Give a fault the stream's key and file."""
        try:
            yield
        except FormatError as error:
            name = self._unpacked(stream, error.file) or self._names(stream)[0]
            error.file = Path(self.found.folder.place(name))
            error.key = f"streams.{stream}"
            raise
        except InputError as error:
            known = self._unpacked(stream, Path(error.file))
            if known is None:
                raise
            place = self.found.folder.place(known)
            raise type(error)(place, error.key, error.value, error.expected) from None

    def _unpacked(self, stream: str, file: Path | None) -> str | None:
        """Return the path of a stream's file below the folder, which may have been unpacked."""
        name = None if file is None else file.name
        return next((each for each in self._names(stream) if each.rpartition("/")[2] == name), None)

    def _read(self, stream: str, read: Callable[[], T]) -> T:
        with self._named(stream):
            return read()

    def _of(self, stream: str, chunks: Iterator[T]) -> Iterator[T]:
        with self._named(stream):
            yield from chunks

    def _samples(
        self, name: str, key: str, what: str, part: PoseFiles | WrenchFiles | ScalarFiles
    ) -> Any:
        """Return the chunk of a table; note rows left out, and the resolution of its times.

        Args:
            key: of its files. what: its rows are.
        """
        with self._named(key):
            found = read_samples(self.found.folder, self._names(key)[0], part)
        self.resolution_us[name] = found.resolution_us
        if found.wrong:
            self.left_out[NO_ROW.format(what)] += found.wrong
        return found.chunk

    def _open_events(self) -> ForeignTrial:
        part = self.found.adapter.streams.events
        assert part is not None
        paths = [] if part.format in OWN_FORMATS else self._paths(EVENTS)
        return read_events(self.found.folder, self._names(EVENTS), part, paths, self.salvage)

    def _with_events(self, made: ForeignTrial, found: ForeignTrial) -> ForeignTrial:
        """Return a trial with the content of its events' files.

        Of their frames and poses, only those of which the adapter names no other file.
        """
        if found.whole is not None:
            self.span_ns = found.whole(DataSpan(None, None)).span_ns
        self.clocks["events"] = DeviceRecord(grade=UNKNOWN, map=IDENTITY)
        self.unknown += [what for what in found.unknown if what != "condition"]
        same = {key: getattr(found, key) for key in _OF_EVENTS}
        made = replace(made, events=lambda: self._of(EVENTS, found.events()), **same)
        parts = self.found.adapter.streams
        if found.frames is not None and parts.frames is None:
            made = replace(made, frames=found.frames, frame_px=found.frame_px)
            self._clock(None, "frames")
        if found.poses is not None and parts.poses is None:
            made = replace(made, poses=found.poses)
            self._clock(None, "arm")
        return made

    def _timed(self) -> bool:
        part = self.found.adapter.streams.frames
        return part is not None and (part.times is None or bool(self._names(FRAME_TIMES)))

    def _open_frames(self) -> Any:
        part = self.found.adapter.streams.frames
        assert part is not None
        paths = self._paths(FRAMES) if part.format == "video" else []
        return read_frames(
            self.found.folder, self._names(FRAMES), self._names(FRAME_TIMES), part, paths
        )

    def _streams(self) -> dict[str, Chunk]:
        parts = self.found.adapter.streams
        chunks: dict[str, Chunk] = {}
        for kind, named in (("wrenches", parts.wrenches), ("scalars", parts.scalars)):
            for name, part in named.items():
                if self._names(key := f"{kind}.{name}"):
                    chunks[name] = self._samples(name, key, f"rows of {name}", part)
                    self._clock(part.clock, name)
        return chunks

    def _clock(self, clock: StreamClock | None, device: str) -> None:
        """Keep the clock of a device; the first one is the time line."""
        if not self.clocks or clock is None:
            if self.clocks:
                self.unknown.append(f"clock of {device}")
            self.clocks[device] = DeviceRecord(grade=UNKNOWN, map=IDENTITY)
            return
        self.clocks[device] = _device(clock)

    def _label_clock(self, clock: str) -> DeviceRecord | None:
        """Return what labels count on, also where its stream has no file; None: the time line."""
        part = self.found.adapter.streams.frames
        if clock != "frames" or part is None:
            return None
        return self.clocks.get("frames") or _device(part.clock)

    def _motion(self) -> tuple[int, int] | None:
        """Return begin and end of the slide on the clock that the adapter names."""
        motion = self.found.adapter.motion
        if motion is None:
            return None
        fields = {**self.trial.fields, "id": self.trial.id}
        found = find_motion(motion, fields, self.found.file, self.trial.id)
        if found is None:
            self.unknown.append("motion")
        return found

    def _whole(self, seen: DataSpan, motion: tuple[int, int] | None) -> Whole:
        """Return span, labels and steps.

        Raises:
            FormatError: nothing was recorded. LabelError: a label lies outside of the recording.
        """
        span = self.span_ns or self._span(seen)
        try:
            steps = () if motion is None else self._steps(span, motion)
            return Whole(span, self._given(span), steps)
        except InputError as error:
            raise LabelError(error.file, error.key, error.value, error.expected) from None

    def _span(self, seen: DataSpan) -> tuple[int, int]:
        """Return begin and end of events and frames on the time line."""
        ends = []
        if seen.events_us is not None:
            ends.append((seen.events_us[0] * 1000, (seen.events_us[1] + 1) * 1000))
        if seen.frames_ns is not None:
            line = self.clocks["frames"].map.to_reference
            ends.append((line(seen.frames_ns[0]), line(seen.frames_ns[1]) + 1000))
        for name, (first, last) in seen.further_ns.items() if not ends else ():
            line = self.clocks["arm" if name == POSES else name].map.to_reference
            ends.append((line(first), line(last) + 1000))
        if not ends:
            with self._named(next(iter(self.trial.files))):
                raise FormatError("contains no event: its length is unknown")
        return min(a for a, _ in ends), max(b for _, b in ends)

    def _line_ns(self, ns: int, clock: str, span: tuple[int, int]) -> int:
        if clock == "start":
            return span[0] + ns
        known = self._label_clock(clock)
        return ns if known is None else known.map.to_reference(ns)

    def _on_line(self, time: FoundTime, clock: str, span: tuple[int, int]) -> int:
        """A label's time on the time line.

        Raises:
            InputError: it lies outside of the recording.
        """
        ns = self._line_ns(time.ns, clock, span)
        if not span[0] <= ns <= span[1]:
            raise time.row.error(
                time.column,
                f"lies outside of the recording of trial {self.trial.id}, which is "
                f"from {span[0] / 1e9:g} to {span[1] / 1e9:g} s",
            )
        return ns

    def _given(self, span: tuple[int, int]) -> Given | None:
        label = self.trial.label
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
        known = self._label_clock(label.clock)
        error = label.uncertainty_ns
        if error is not None and known is not None:
            clock_error = known.uncertainty_ns
            error = None if clock_error is None else error + clock_error
        return Given(
            source=label.source,
            spans=spans,
            incipient_ns=incipient,
            gross_ns=gross,
            uncertainty_ns=error,
        )

    def _steps(self, span: tuple[int, int], found: tuple[int, int]) -> tuple[MotionStep, ...]:
        motion = self.found.adapter.motion
        assert motion is not None
        start, end = (self._line_ns(ns, motion.clock, span) for ns in found)
        if not span[0] <= start < end <= span[1]:
            raise InputError(
                self.found.file,
                "motion.start",
                motion.start,
                f"to {motion.end}: lies outside of the recording of trial {self.trial.id}, which "
                f"is from {span[0] / 1e9:g} to {span[1] / 1e9:g} s",
            )
        # without poses the motion's times are on the time line
        arm = self.clocks.get("arm")
        line = IDENTITY if arm is None else arm.map
        times = [int(line.to_device(ns)) for ns in (span[0], start, end)]
        hold = MotionStep(phase="hold", start_ns=times[0], end_ns=times[1])
        slide = MotionStep(phase="slide", start_ns=times[1], end_ns=times[2])
        return (hold, slide) if times[1] > times[0] else (slide,)
