"""Import of foreign trials into a campaign, each one atomically.

A trial is committed by the store's own rename after all of it was read and checked. A trial that
cannot be imported does not stop the others. Rows that cannot be right, or whose times run back, are
left out and counted (`time_order`); where they are many, the trial is not imported. Unknown
properties (relations of clocks, poses, conditions) are marked as unknown and never invented:
the time line is the event camera's own clock, or that of the frames where there are no events. The
intact part of a damaged file, before the damage, may be salvaged; the trial's record counts the
lost rest.
"""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from pydantic import ValidationError

from sliplab.protocols.errors import InputError
from sliplab.protocols.key_errors import faults_of
from sliplab.protocols.shown import plural
from sliplab.storage.clockmap import IDENTITY
from sliplab.storage.files import json_text, safe_name
from sliplab.storage.formats.by_time import by_time
from sliplab.storage.formats.foreign import (
    LATEST_US,
    NO_TIME,
    OUTSIDE,
    RISING,
    Damage,
    DataSpan,
    ForeignCampaign,
    ForeignChunk,
    ForeignTrial,
    FormatError,
    LabelError,
    NoEvents,
    Whole,
    as_damage,
    check_size,
    inside,
    left_out_of,
    refusal,
)
from sliplab.storage.formats.recognition import before_damage
from sliplab.storage.formats.time_order import Mask, falls, in_order
from sliplab.storage.interrupts import interruptible, uninterrupted
from sliplab.storage.process import now
from sliplab.storage.schema.trial import (
    DeviceRecord,
    Gate,
    Geometry,
    Lost,
    Provenance,
    StreamCounts,
    StreamRecord,
    TrialClockMaps,
    TrialQuality,
    TrialRecord,
)
from sliplab.storage.streams import (
    EVENTS_KIND,
    FRAMES_KIND,
    I64,
    Chunk,
    EventChunk,
    FrameChunk,
    Json,
    PulseChunk,
    ScalarChunk,
    TriggerChunk,
)
from sliplab.storage.trials.store import IMPORTED, Campaign, CampaignInfo, TrialStore
from sliplab.storage.trials.writer import TrialWriter

_LONG_GAP_US = 3_600_000_000
_FRAME_RATE = 100
"""Time base of the video only; frames keep their own times."""
BACK = "whose times run back"
MOST_RESOLUTION_US = 1.0
"""Step of the type of a stream's times from which on they carry too little information, us."""
_SOME, _SHARE = 10, 0.1
"""Number and share of the rows that cannot be right up to which a trial is imported without."""
_LEAST_SHARE = 0.01
"""Share of the rows that must be in order of time."""
_MOST_RATE, _FEW = 1e8, 100
"""Events a second that no camera sends; of fewer events the rate says nothing."""
_MOST_ALIKE = 1000
"""Events for each distinct time, in the mean, from which on times carry too little information."""
SampleT = TypeVar("SampleT", bound=Chunk)
_UNKNOWN = DeviceRecord(grade="unknown", map=IDENTITY, uncertainty_ns=None)


def import_trials(
    store: TrialStore,
    name: str,
    trials: Iterable[ForeignTrial],
    origin: Path,
    kind: str,
    on_trial: Callable[[str], None] = lambda name: None,
    *,
    salvage: bool = False,
) -> Json:
    """Import trials that do not exist yet; the caller holds the store's lock.

    Args:
        name: the campaign's, which is made.
        origin: the file or folder that they come from, for messages and the campaign's description.
        kind: the format's name.
        on_trial: called with each trial's id before it is read; what it raises ends the import
            between two trials.
        salvage: import the intact part of a damaged file, before the damage.

    Returns:
        ``imported`` and ``there`` (existing, skipped) with ids, ``events`` and ``frames`` imported,
        and where there are any, ``warnings``, ``salvaged`` (the loss of each trial),
        ``left_out`` (rows left out of each trial, by reason) and ``failed``: trials that could not
        be imported, of which nothing is left.

    Raises:
        InputError: no trial could be imported, because the first file is damaged (`DamagedFile`) or
            cannot be right; or the campaign is another one.
    """
    campaign = store.campaign(name)
    fresh = not campaign.folder.exists()
    existing = campaign.committed()
    joined: ForeignCampaign | None = None
    imported: list[str] = []
    skipped: list[str] = []
    counts = {"events": 0, "frames": 0}
    warnings: list[str] = []
    salvaged: list[Json] = []
    left_out: list[Json] = []
    failed: list[Json] = []
    first_error: InputError | None = None
    label_error: InputError | None = None
    labelled = misfit = False
    try:
        for trial in trials:
            on_trial(trial.name)
            try:
                if trial.error is None:  # else it may not say of which campaign it is
                    of = trial.campaign or _Imported(origin, kind, trial.simulated)
                    if of != joined:
                        of.join(campaign, trial.source)
                        joined = of
                if trial.name in existing:
                    skipped.append(trial.name)
                    continue
                if trial.error is not None:
                    raise trial.error
                if trial.name in imported:
                    raise InputError(
                        origin,
                        "",
                        None,
                        f"holds two files for the trial {trial.name}; import them one by one",
                    )
                trial, found = _take_whole(store, campaign, trial, kind, salvage)
            except (FormatError, InputError) as error:
                if isinstance(error, FormatError):
                    file = error.file or (origin if origin.is_file() else origin / trial.source)
                    error = refusal(file, error)
                first_error = first_error or error
                if isinstance(error, LabelError):
                    label_error = label_error or error
                about = {"trial": trial.name, "file": trial.source}
                failed.append({**about, "reason": error.message})
                continue
            imported.append(trial.name)
            labelled |= found.labelled
            about = {"trial": trial.name, "file": trial.source}
            if trial.lost is not None:
                salvaged.append({**about, **trial.lost.to_json()})
            if found.left_out:
                left_out.append({**about, "left_out": dict(found.left_out)})
            warnings += [f"{trial.source}: {text}" for text in found.warnings]
            counts = {key: counts[key] + found.counts[key] for key in counts}
        misfit = label_error is not None and not labelled and fresh  # no label fits its trial
        if misfit:
            imported.clear()
    finally:
        # a signal may have come between a trial's commit and its entry in the list
        if fresh and campaign.folder.exists() and (misfit or not campaign.committed()):
            shutil.rmtree(campaign.folder)
    if first_error is not None and not imported and not skipped:
        raise label_error or first_error
    result = {"campaign": name, "imported": imported, "there": skipped, **counts}
    further = {"salvaged": salvaged, "left_out": left_out, "failed": failed, "warnings": warnings}
    return result | {key: found for key, found in further.items() if found}


@dataclass(frozen=True)
class _Imported:
    """The campaign of recordings that belong to none: it has neither protocol nor rig."""

    origin: Path
    kind: str
    simulated: bool

    def join(self, campaign: Campaign, source: str) -> None:
        if campaign.begun:
            if IMPORTED not in campaign.info:
                raise InputError(
                    "--name", "", campaign.name, "is a collected campaign; choose another name"
                )
            campaign.finish_description()
            return
        about = {"from": self.origin.name, "format": self.kind, "when": now()}
        info: CampaignInfo = {"name": campaign.name, "simulated": self.simulated, IMPORTED: about}
        text = f"# Imported: there is no protocol.\nimported: {json_text(self.kind).strip()}\n"
        campaign.update(info, text, text.replace("protocol", "rig file"))


def _counted(count: int, reason: str) -> str:
    """Return a count before a reason that begins with what is counted, such as ``events``."""
    what, space, why = reason.partition(" ")
    return f"{count:,} {what.removesuffix('s') if count == 1 else what}{space}{why}"


@dataclass
class _Content:
    """Content read of a trial.

    Attributes:
        orders: rows that stay of streams whose times run back.
        rows: numbers of rows that were written, by stream.
        left_out: numbers of rows that were left out, by reason.
        gates: those that the trial does not pass.
        counts: events and frames.
        size_px: columns and rows of the event camera. latest_px: largest column and row of events.
        further_ns: first and last time of poses and streams.
        labelled: a label came with the trial.
    """

    orders: Mapping[str, Mask] = field(default_factory=dict)
    rows: Counter[str] = field(default_factory=Counter)
    left_out: Counter[str] = field(default_factory=Counter)
    gates: dict[str, Gate] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    counts: dict[str, int] = field(default_factory=lambda: {"events": 0, "frames": 0})
    size_px: tuple[int, int] | None = None
    latest_px: tuple[int, int] = (0, 0)
    further_ns: dict[str, tuple[int, int]] = field(default_factory=dict)
    labelled: bool = False

    def ordered(self, stream: str, times: I64, done: int, last: int | None) -> Any:
        """Return which rows of a chunk stay: a slice of all, or a mask.

        Args:
            done: rows of the stream before the chunk. last: time of the row before it.

        Raises:
            _RunsBack: times run back, and the order is not known yet.
        """
        order = self.orders.get(stream)
        if order is not None:
            retained = order[done : done + len(times)]
            self.leave_out(f"{_rows_of(stream)} {BACK}", int((~retained).sum()))
            return retained
        if falls(times) or (last is not None and len(times) and times[0] < last):
            raise _RunsBack
        return slice(None)

    def leave_out(self, reason: str, count: int) -> None:
        """Count rows that are left out."""
        if count:
            self.left_out[reason] += count

    def check_majority(self, stream: str, retained: int) -> None:
        """Check that few rows of a stream cannot be right. Raises FormatError."""
        what = _rows_of(stream)
        wrong = {
            reason: count
            for reason, count in self.left_out.items()
            if reason.startswith(f"{what} ") and not reason.endswith(BACK)
        }
        count = sum(wrong.values())
        if count and (count >= retained or count > max(_SOME, _SHARE * (retained + count))):
            named = ", ".join(f"{count:,} {reason}" for reason, count in wrong.items())
            if set(wrong) == {OUTSIDE} and self.size_px is not None:
                (width, height), (column, row) = self.size_px, self.latest_px
                far = column >= width or row >= height
                where = (
                    f"up to column {column} and row {row}" if far else "at negative columns or rows"
                )
                named = (
                    f"{count:,} {where}, outside of the {width} x {height} pixels that the file "
                    "gives its camera"
                )
            raise FormatError(f"{what}: {named}; {retained:,} can be right")

    def check_order(self, stream: str, retained: int, rows: int) -> None:
        """Check that enough rows of a stream are in order of time. Raises FormatError."""
        if retained < rows and retained < max(2, _LEAST_SHARE * rows):
            raise FormatError(
                f"contains {_rows_of(stream)} with decreasing times: {retained:,} of {rows:,} "
                "are in order"
            )

    def check_times(
        self, stream: str, ends: tuple[int, int] | None, resolution: float, distinct: int = 0
    ) -> None:
        """Check that the times of a stream carry information.

        Args:
            ends: first and last time, ns. resolution: of their type, us.
            distinct: number of different times of events.
        """
        rows, what = self.rows[stream], _rows_of(stream)
        if ends is None or rows < 2:
            return
        if resolution > MOST_RESOLUTION_US:
            self._fail(
                f"{stream}_time_resolution_us",
                resolution,
                MOST_RESOLUTION_US,
                f"the times of {stream} have steps of {resolution:,.6g} us, for their type is too "
                "short for such large numbers or has no fractions; floats of 64 bits, or times "
                "counted from the recording's start, would be right",
            )
        if ends[0] == ends[1]:
            self._fail(f"{stream}_times", "one time", None, f"all {rows:,} {what} have one time")
        elif stream == EVENTS_KIND and rows >= _FEW:
            rate = rows * 1e9 / (ends[1] - ends[0])
            if rate > _MOST_RATE:
                self._fail(
                    "events_rate",
                    rate,
                    _MOST_RATE,
                    f"{rate:,.3g} events a second are more than a camera sends; are the times in "
                    "another unit?",
                )
            elif rows >= _MOST_ALIKE * distinct:
                self._fail(
                    "events_distinct_times",
                    float(distinct),
                    rows / _MOST_ALIKE,
                    f"{rows:,} events have {distinct:,} different times; were the times rounded?",
                )

    def check_images(self, stream: str, alike: int) -> None:
        """Check that frames change; `alike` of them equal the one before."""
        rows = self.rows[stream]
        if rows > 1 and alike == rows - 1:
            self._fail(
                f"{stream}_change", "none", None, f"all {rows:,} frames of {stream} are alike"
            )
        elif alike > rows / 2:
            self.warnings.append(f"{alike:,} of {rows:,} frames of {stream} repeat the one before")

    def _fail(self, gate: str, value: float | str, limit: float | None, text: str) -> None:
        self.gates[gate] = Gate(passed=False, value=value, limit=limit)
        self.warnings.append(text)

    def all_warnings(self, trial: ForeignTrial) -> list[str]:
        """Return all warnings about a trial."""
        left_out = [
            f"{_counted(count, reason)} left out" for reason, count in self.left_out.items()
        ]
        return [*_loss_warnings(trial.lost), *trial.notes(), *left_out, *self.warnings]


def _rows_of(stream: str) -> str:
    """Return the name of a stream's rows, for messages."""
    return (
        stream if stream in {EVENTS_KIND, FRAMES_KIND, "poses", "triggers"} else f"rows of {stream}"
    )


class _RunsBack(Exception):
    """The times of a stream run back."""


def _take_whole(
    store: TrialStore, campaign: Campaign, trial: ForeignTrial, kind: str, salvage: bool
) -> tuple[ForeignTrial, _Content]:
    """Commit one trial, or its intact part; return it with what was read."""
    try:
        return trial, _take(store, campaign, trial, kind)
    except NoEvents:
        raise
    except FormatError as error:
        if trial.salvage is None:
            raise
        whole = before_damage(trial.salvage, error, salvage)
    trial = replace(
        trial,
        events=whole.events,
        any_order=whole.any_order,
        event_px=whole.event_px,
        triggers=whole.triggers,
        frames=whole.frames,
        frame_px=whole.frame_px,
        lost=whole.lost,
        packets=whole.packets,
        notes=whole.notes,
        salvage=None,
    )
    with as_damage():
        return trial, _take(store, campaign, trial, kind)


@uninterrupted
def _take(store: TrialStore, campaign: Campaign, trial: ForeignTrial, kind: str) -> _Content:
    """Commit one trial; return what was read."""
    if trial.original is not None:
        about = {"imported": now(), "from": trial.source}
        with as_damage():
            rows = trial.original.restore(store, campaign, safe_name(trial.name), about)
        return _Content(counts={"events": rows.events, "frames": rows.frames})
    try:
        return _write(campaign, trial, kind, _Content())
    except _RunsBack:
        if not trial.any_order:
            return _write(campaign, trial, kind, _Content(_orders(trial)))
    sorted_ = replace(trial, events=partial(by_time, trial.events), any_order=False)
    return _take(store, campaign, sorted_, kind)


def _orders(trial: ForeignTrial) -> dict[str, Mask]:
    """Return which rows of events and frames are in order of time, by stream."""
    unused = _Content()
    events = [np.empty(0, np.int64), *(chunk.t_us for chunk in _events(trial, unused))]
    found = {EVENTS_KIND: in_order(np.concatenate(events))}
    cameras = {FRAMES_KIND: trial.frames, **trial.cameras}
    for name, read in cameras.items():
        if read is not None:
            frames = [chunk.t_ns for chunk in _frames(name, read, trial.frame_px, unused)]
            found[name] = in_order(np.concatenate([np.empty(0, np.int64), *frames]))
    return found


def _write(campaign: Campaign, trial: ForeignTrial, kind: str, content: _Content) -> _Content:
    """Commit a trial whose rows are read in `content`'s orders."""
    writer = campaign.begin(safe_name(trial.name), trial.frame_px, _FRAME_RATE)
    try:
        seen = _fill(writer, trial, content)
        streams = _fill_further(writer, trial, content)
        seen = replace(seen, further_ns=content.further_ns)
        if not sum(content.rows.values()) and trial.whole is None:
            raise NoEvents("contains no events; nothing to import")
        counts = writer.counts
        rows = StreamCounts(
            events=counts["events/t"],
            frames=counts["frames/t"],
            poses=counts.get("poses/t", 0),
            pulses=0,
        )
        record = _record(campaign, trial, kind, rows, seen, content, streams)
        about = {"imported": now(), "from": _plain(trial.source)}
        writer.commit(record, Provenance.model_validate(about))
    except BaseException:
        writer.discard()
        raise
    content.warnings = content.all_warnings(trial)
    content.counts = {"events": rows.events, "frames": rows.frames}
    return content


def _events(trial: ForeignTrial, content: _Content) -> Iterator[EventChunk]:
    """Yield the events of a trial that can be right, in the file's order."""
    for chunk in trial.events():
        content.size_px = trial.event_px()
        if content.size_px is not None:
            check_size("states a sensor", content.size_px)
            if len(chunk):
                x, y = content.latest_px
                content.latest_px = max(x, int(chunk.x.max())), max(y, int(chunk.y.max()))
        chunk = inside(chunk, content.size_px)
        content.left_out.update(left_out_of(chunk))
        if len(chunk):
            yield chunk


@interruptible
def _fill(writer: TrialWriter, trial: ForeignTrial, content: _Content) -> DataSpan:
    """Write events, triggers and frames; return first and last times.

    Raises:
        FormatError: many events or frames cannot be right. _RunsBack: as `_Content.ordered`.
    """
    first_us = last_us = None
    gap_us = gap_end_us = 0
    done, distinct, resolution = 0, 1, 0.0
    content.left_out.update(trial.left_out)
    for chunk in _events(trial, content):
        if isinstance(chunk, ForeignChunk):
            resolution = max(resolution, chunk.resolution_us)
        retained = content.ordered(EVENTS_KIND, chunk.t_us, done, last_us)
        done += len(chunk)
        if not isinstance(retained, slice):
            chunk = chunk[retained]
        if not len(chunk):
            continue
        first_us = int(chunk.t_us[0]) if first_us is None else first_us
        steps = np.diff(chunk.t_us, prepend=first_us if last_us is None else last_us)
        distinct += int(np.count_nonzero(steps))
        widest = int(steps.argmax())
        if int(steps[widest]) > gap_us:
            gap_us, gap_end_us = int(steps[widest]), int(chunk.t_us[widest])
        last_us = int(chunk.t_us[-1])
        writer.add("events", chunk)
        content.rows[EVENTS_KIND] += len(chunk)
    content.check_majority(EVENTS_KIND, done)
    content.check_order(EVENTS_KIND, content.rows[EVENTS_KIND], done)
    if first_us is None and trial.lost is not None:
        raise Damage(f"{trial.lost.reason}; there is no event before that")
    _fill_triggers(writer, trial, content)
    times = None
    if trial.frames is not None:
        times, _ = _fill_frames(FRAMES_KIND, trial.frames, trial.frame_px, content, writer)
        content.check_times(FRAMES_KIND, times, trial.resolution_us.get(FRAMES_KIND, 0.0))
    events = None if first_us is None or last_us is None else (first_us, last_us)
    if events is not None:
        ends = events[0] * 1000, events[1] * 1000
        content.check_times(EVENTS_KIND, ends, resolution, distinct)
    content.warnings += _gap_warnings(gap_us, gap_end_us)
    return DataSpan(events, times)


def _fill_triggers(writer: TrialWriter, trial: ForeignTrial, content: _Content) -> None:
    if trial.triggers is None:
        return
    t_us, kind = trial.triggers.t_us, trial.triggers.kind
    good = (t_us >= 0) & (t_us < LATEST_US)
    content.leave_out(NO_TIME.format("triggers"), int((~good).sum()))
    content.check_majority("triggers", int(good.sum()))
    t_us, kind = t_us[good], kind[good]
    retained = in_order(t_us)
    content.leave_out(f"triggers {BACK}", int((~retained).sum()))
    found = TriggerChunk(t_us[retained] * 1000, kind[retained])
    writer.add(EVENTS_KIND, found)
    writer.add(EVENTS_KIND, PulseChunk(found.t_ns[found.kind == RISING]))


def _frames(
    stream: str,
    read: Callable[[], Iterator[FrameChunk]],
    size: tuple[int, int] | None,
    content: _Content,
) -> Iterator[FrameChunk]:
    """Yield the frames of a camera that can be right: of one size, with a time."""
    for chunk in read():
        if not len(chunk):
            continue
        height, width = chunk.images.shape[1:]
        size = size or (width, height)
        if (width, height) != size:
            content.leave_out(f"{_rows_of(stream)} of another size", len(chunk))
            continue
        good = np.abs(chunk.t_ns // 1000) < LATEST_US
        if not good.all():
            what = _rows_of(stream)
            content.leave_out(NO_TIME.format(what), int((~good).sum()))
            chunk = chunk[good]
        if len(chunk):
            yield chunk


def _fill_frames(
    stream: str,
    read: Callable[[], Iterator[FrameChunk]],
    size: tuple[int, int] | None,
    content: _Content,
    writer: TrialWriter,
) -> tuple[tuple[int, int] | None, tuple[int, int] | None]:
    """Write the frames of a camera; return their first and last time, ns, and their size."""
    ends: tuple[int, int] | None = None
    image = None
    done = alike = repeated = 0
    for chunk in _frames(stream, read, size, content):
        retained = content.ordered(stream, chunk.t_ns, done, None if ends is None else ends[1])
        done += len(chunk)
        chunk = chunk if isinstance(retained, slice) else chunk[retained]
        if not len(chunk):
            continue
        size = size or (chunk.images.shape[2], chunk.images.shape[1])
        writer.add(stream, chunk)
        content.rows[stream] += len(chunk)
        last = chunk.t_ns[0] - 1 if ends is None else ends[1]
        repeated += int((np.diff(chunk.t_ns, prepend=last) == 0).sum())
        ends = (int(chunk.t_ns[0]) if ends is None else ends[0], int(chunk.t_ns[-1]))
        for each in chunk.images:
            alike += image is not None and np.array_equal(image, each)
            image = each
    content.check_majority(stream, done)
    content.check_order(stream, content.rows[stream], done)
    content.check_images(stream, alike)
    if repeated:
        content.warnings.append(
            f"{plural(repeated, 'frame')} of {stream} with the time of the one before"
        )
    return ends, size


@interruptible
def _fill_further(
    writer: TrialWriter, trial: ForeignTrial, content: _Content
) -> dict[str, StreamRecord]:
    """Write poses, named streams and further cameras; return what the record says of them."""
    if trial.poses is not None:
        writer.add("arm", _samples("poses", trial.poses, trial, content))
    found: dict[str, StreamRecord] = {}
    for name, chunk in trial.streams.items():
        chunk = _samples(name, chunk, trial, content)
        writer.add(name, chunk)
        about: dict[str, Any] = {"kind": chunk.KIND.name, "rows": len(chunk)}
        if isinstance(chunk, ScalarChunk) and chunk.unit:
            about["unit"] = chunk.unit
        found[name] = StreamRecord(**about)
    for name, read in trial.cameras.items():
        ends, size = _fill_frames(name, read, None, content, writer)
        content.check_times(name, ends, trial.resolution_us.get(name, 0.0))
        found[name] = StreamRecord(kind=FRAMES_KIND, rows=content.rows[name], size_px=size)
    return found


def _samples(name: str, chunk: SampleT, trial: ForeignTrial, content: _Content) -> SampleT:
    """Return the rows of poses, forces or readings that can be right, in order of time."""
    what = _rows_of(name)
    good = np.abs(chunk.times // 1000) < LATEST_US
    content.leave_out(NO_TIME.format(what), int((~good).sum()))
    values = vars(chunk).values()
    numbers = [value for value in values if getattr(value, "dtype", None) == np.float64]
    finite = np.ones(len(chunk), np.bool_)
    for value in numbers:
        finite &= np.isfinite(value).all(axis=tuple(range(1, value.ndim)))
    content.leave_out(f"{what} with a value that is not a number", int((good & ~finite).sum()))
    good &= finite
    content.check_majority(name, int(good.sum()))
    if not good.all():
        chunk = chunk[good]
    retained = in_order(chunk.times)
    if not retained.all():
        content.leave_out(f"{what} {BACK}", int((~retained).sum()))
        content.check_order(name, int(retained.sum()), len(retained))
        chunk = chunk[retained]
    content.rows[name] = len(chunk)
    if len(chunk):
        ends = int(chunk.times[0]), int(chunk.times[-1])
        content.check_times(name, ends, trial.resolution_us.get(name, 0.0))
        content.further_ns[name] = ends
    return chunk


def _plain(source: str) -> str:
    """Return the name of a file, with bytes that are no text written out."""
    return source.encode("utf-8", "backslashreplace").decode()


def _loss_warnings(lost: Lost | None) -> list[str]:
    if lost is None:
        return []
    counts = {"events": lost.events, "frames": lost.frames}
    missing = [f"{count:,} {what}" for what, count in counts.items() if count]
    of = f", {' and '.join(missing)} are missing" if missing else ""
    return [
        f"is not whole: it {lost.reason} (byte {lost.at_byte:,}); {lost.unread_bytes:,} bytes were "
        f"not read{of}"
    ]


def _gap_warnings(gap_us: int, end_us: int) -> list[str]:
    if gap_us < _LONG_GAP_US:
        return []
    return [
        f"{gap_us / 3.6e9:,.1f} hours without an event between {end_us - gap_us} and {end_us} us: "
        "the camera's clock was set there, or the times on one side are wrong; imported unchanged"
    ]


def _seconds(seen: DataSpan, whole: Whole | None) -> float:
    """Return the length of a recording: as it is stated, or from its first to its last event."""
    if whole is not None:
        return (whole.span_ns[1] - whole.span_ns[0]) / 1e9
    if seen.events_us is not None:
        return (seen.events_us[1] - seen.events_us[0]) / 1e6
    first, last = seen.frames_ns or next(iter(seen.further_ns.values()), (0, 0))
    return (last // 1000 - first // 1000) / 1e6


def _clocks(
    trial: ForeignTrial, counts: StreamCounts, whole: Whole | None, streams: dict[str, StreamRecord]
) -> TrialClockMaps:
    there = {
        "events": counts.events > 0 or trial.event_px() is not None,
        "frames": trial.frames is not None,
        "arm": trial.poses is not None or (whole is not None and bool(whole.steps)),
    }
    cameras = {"event camera": there["events"], "frame camera": there["frames"]}
    devices = {**cameras, "arm": there["arm"], **dict.fromkeys(streams, True)}
    found: Json = {
        "reference": next((name for name, known in devices.items() if known), None),
        **{name: trial.clocks.get(name, _UNKNOWN) for name, known in there.items() if known},
    }
    if streams:
        found["streams"] = {name: trial.clocks.get(name, _UNKNOWN) for name in streams}
    return TrialClockMaps(**found)


def _record(
    campaign: Campaign,
    trial: ForeignTrial,
    kind: str,
    counts: StreamCounts,
    seen: DataSpan,
    content: _Content,
    streams: dict[str, StreamRecord],
) -> TrialRecord:
    event_px = trial.event_px()
    whole = None if trial.whole is None else trial.whole(seen)
    missing = ("sensor size",) if counts.events else ("events",)
    origin: Json = {
        "format": trial.kind or kind,
        "from": _plain(trial.source),
        "epoch": trial.epoch,
        "unknown": [*trial.unknown, *(() if event_px else missing)],
        **trial.about,
    }
    if warnings := content.all_warnings(trial):
        origin["warnings"] = warnings
    if content.left_out:
        origin["dropped"] = dict(content.left_out)
    if trial.lost is not None:
        origin["lost"] = trial.lost
    if whole is not None:
        origin |= {"span_ns": whole.span_ns, "given": whole.given}
        content.labelled = whole.given is not None
    values = {
        "format": TrialRecord.FORMAT,
        "trial": trial.name,
        "campaign": campaign.name,
        "experiment": trial.experiment,
        "role": "imported",
        "block": 0,
        "repetition": trial.repetition,
        "attempt": 0,
        "condition": trial.condition,
        "simulated": trial.simulated,
        "recorded_s": _seconds(seen, whole),
        "counts": counts,
        "clocks": _clocks(trial, counts, whole, streams),
        "quality": TrialQuality(passed=not content.gates, gates=content.gates),
        "steps": () if whole is None else whole.steps,
        "geometry": Geometry.model_validate(
            {"event_px": event_px, "frame_px": trial.frame_px, **trial.geometry}
        ),
        "imported": origin,
    }
    if streams:
        values["streams"] = streams
    try:
        return TrialRecord.model_validate(values)
    except ValidationError as error:
        fault = faults_of(TrialRecord, error)[0]
        raise FormatError(f"holds {fault.key} = {fault.value!r:.60}, which {fault}") from None
