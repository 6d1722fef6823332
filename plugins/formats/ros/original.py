"""A complete trial of a store inside an MCAP file, and its re-import into a store.

Such a trial is written by the store's own writer, checked as `sliplab verify` checks one, and
retains its record: clocks, condition and gates are unchanged. Its files are written again, so their
bytes, and with them the keys of derived results, may differ although the contents are equal: steps
then compute again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import islice
from typing import Any

import numpy as np
import numpy.typing as npt

from sliplab.storage.files import make_folder, write_bytes, write_json
from sliplab.storage.formats.foreign import FormatError
from sliplab.storage.formats.stored import check_arrays
from sliplab.storage.interrupts import interruptible, uninterrupted
from sliplab.storage.schema.label import LABELS, TrialLabel
from sliplab.storage.schema.trial import Provenance, StreamCounts, SyncResult, TrialRecord
from sliplab.storage.streams import (
    EVENTS_KIND,
    FRAMES_KIND,
    U8,
    ClockReads,
    EventChunk,
    FrameChunk,
    Json,
    PoseChunk,
    PulseChunk,
    ScalarChunk,
    WrenchChunk,
)
from sliplab.storage.trials.checksums import DATA, stream_file
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.hdf5_writer import COLUMNS, STREAM_GROUP, STREAMS, TIMING, TRACKS
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import Campaign, Store
from sliplab.storage.trials.verify import content_problems
from sliplab.storage.trials.writer import TrialWriter

Array = npt.NDArray[Any]
_FRAMES_AT_ONCE = 32
_CHUNKS: dict[str, type[WrenchChunk] | type[ScalarChunk]] = {
    chunk.KIND: chunk for chunk in (WrenchChunk, ScalarChunk)
}


@dataclass(frozen=True)
class Original:
    """A trial of a store.

    Attributes:
        columns: all but those of events, by file and name.
        events: events of each camera by the name of its stream, in order of time.
        frames: frames of each camera that has a video.
        units: units of scalar streams, by name.
        label: label document and its arrays (an ``.npz`` file), where it has some.
        sync: result of fitting its clocks again, where that is in use.
    """

    record: TrialRecord
    provenance: Provenance
    columns: Mapping[tuple[str, str], Array]
    events: Mapping[str, Callable[[], Iterator[EventChunk]]]
    frames: Mapping[str, Callable[[], Iterator[U8]]]
    units: Mapping[str, str]
    rate_hz: int
    label: TrialLabel | None = None
    label_arrays: bytes | None = None
    sync: SyncResult | None = None

    def __post_init__(self) -> None:
        """Check columns and arrays. Raises FormatError where they cannot be a trial's."""
        for (file, name), values in self.columns.items():
            self._check_column(file, name, values)
        if self.label_arrays is not None:
            check_arrays(self.label_arrays)

    def _check_column(self, file: str, name: str, values: Array) -> None:
        streams, known = self.record.streams, {**COLUMNS, **TRACKS, **TIMING}
        for stream, stated in streams.items():
            for part, (_, kind) in STREAMS.get(stated.kind, {}).items():
                known[f"{STREAM_GROUP}/{stream}/{part}"] = kind
        files = {DATA, *(stream_file(name) for name, stated in streams.items() if stated.of_camera)}
        if name not in known or name.startswith("events/") or file not in files:
            raise FormatError(f"holds the column {name!r:.60} of {file!r:.60}, which no trial has")
        dtype, shape, _ = known[name]
        fits = len(values.shape) == len(shape) + 1 and all(
            wanted in (-1, found) for wanted, found in zip(shape, values.shape[1:], strict=True)
        )
        if values.dtype != np.dtype(dtype) or not fits:
            raise FormatError(f"holds the column {name} as {values.dtype} {values.shape[1:]}")

    def frame_px(self) -> tuple[int, int] | None:
        """Return columns and rows of the first frame camera; None without frames."""
        if (DATA, "frames/t") not in self.columns:
            return None
        first = next(self.frames[FRAMES_KIND](), None) if FRAMES_KIND in self.frames else None
        if first is None:
            return self.record.geometry.frame_px or (1, 1)  # tracks without frames
        return first.shape[1], first.shape[0]

    @uninterrupted
    def restore(self, store: Store, campaign: Campaign, name: str, about: Json) -> StreamCounts:
        """Commit the trial with its label and clocks; as `Restorable`."""
        writer = campaign.begin(name, self.frame_px(), self.rate_hz)
        try:
            self.keep_label(store, campaign.name, name)
            self.commit(writer, Provenance.model_validate({**self.provenance.to_json(), **about}))
        except BaseException:
            writer.discard()
            self.drop_label(store, campaign.name, name)
            raise
        self.keep_sync(campaign, campaign.recording(name))
        return self.record.counts

    def commit(self, writer: TrialWriter, provenance: Provenance) -> None:
        """Write the trial and make it visible.

        Raises:
            FormatError: what it holds is not what its record says, or runs backwards.
        """
        try:
            self._fill(writer)
        except (ValueError, KeyError) as error:
            raise FormatError(f"holds no whole trial: {error}") from None
        problems = content_problems(writer.seal(), self.record)
        if problems:
            path, text = problems[0]
            raise FormatError(f"holds no whole trial: {path.name}: {text}")
        writer.commit(self.record, provenance)

    @interruptible
    def _fill(self, writer: TrialWriter) -> None:
        data = {name: values for (file, name), values in self.columns.items() if file == DATA}
        for chunk in self._events(EVENTS_KIND):
            writer.add_events(chunk)
        for group, add in (
            ("event_pulses", writer.add_event_pulses),
            ("arm_pulses", writer.add_arm_pulses),
            ("sync_pulses", writer.add_sync_pulses),
            ("exposures", writer.add_exposures),
        ):
            if f"{group}/t" in data:
                add(PulseChunk(data[f"{group}/t"]))
        for group, add_reads in (
            ("box_reads", writer.add_box_reads),
            ("frame_camera_reads", writer.add_frame_camera_reads),
        ):
            if f"{group}/t" in data:
                add_reads(ClockReads(*_group(data, group, ("t", "before", "after"))))
        if "triggers/t" in data:
            writer.add_triggers(*_group(data, "triggers", ("t", "kind")))
        if "poses/t" in data:
            writer.add_poses(PoseChunk(*_group(data, "poses", ("t", "host", "xyz", "rotvec"))))
        for frames in self._frames(FRAMES_KIND, data):
            writer.add_frames(frames)
        for name, stated in self.record.streams.items():
            if stated.of_camera:
                self._fill_camera(writer, name)
            elif f"{STREAM_GROUP}/{name}/t" in data:
                parts = STREAMS[stated.kind]
                values = _group(data, f"{STREAM_GROUP}/{name}", tuple(parts))
                named: dict[str, Any] = {
                    field: found for (field, _), found in zip(parts.values(), values, strict=True)
                }
                if stated.kind == ScalarChunk.KIND:
                    named["unit"] = self.units.get(name, "")
                writer.add_stream(name, _CHUNKS[stated.kind](**named))

    def _fill_camera(self, writer: TrialWriter, name: str) -> None:
        file = stream_file(name)
        data = {part: values for (of, part), values in self.columns.items() if of == file}
        for chunk in self._events(name):
            writer.add_stream(name, chunk)
        for frames in self._frames(name, data):
            writer.add_stream(name, frames)
        if "event_pulses/t" in data:
            writer.add_stream(name, PulseChunk(data["event_pulses/t"]))
        if "frame_camera_reads/t" in data:
            reads = _group(data, "frame_camera_reads", ("t", "before", "after"))
            writer.add_stream(name, ClockReads(*reads))

    def _events(self, name: str) -> Iterator[EventChunk]:
        return self.events[name]() if name in self.events else iter(())

    def _frames(self, name: str, data: Mapping[str, Array]) -> Iterator[FrameChunk]:
        if "frames/t" not in data:
            return
        number, t_ns, host, sync = _group(data, "frames", ("number", "t", "host", "sync"))
        tracks = {part: data.get(f"tracks/{part}") for part in ("markers", "plate")}
        images = self.frames[name]() if name in self.frames else None
        for low in range(0, len(t_ns), _FRAMES_AT_ONCE):
            rows = slice(low, low + _FRAMES_AT_ONCE)
            count = len(t_ns[rows])
            levels = np.empty((count, 0, 0), np.uint8)
            if images is not None:
                found = list(islice(images, count))
                if len(found) != count:
                    raise FormatError(f"holds {low + len(found)} frames, and times of {len(t_ns)}")
                levels = np.stack(found)
            markers, plate = (None if c is None else c[rows] for c in tracks.values())
            yield FrameChunk(
                levels, number[rows], t_ns[rows], host[rows], sync[rows], markers, plate
            )
        if images is not None and next(images, None) is not None:
            raise FormatError(f"holds more frames than times of frames, {len(t_ns)}")

    def keep_label(self, store: Store, campaign: str, trial: str) -> None:
        """Write the trial's label, before the trial: no one reads it until the trial exists."""
        if self.label is None:
            return
        saved = Derived.of(store, LABELS, campaign)
        make_folder(saved.folder)
        if self.label_arrays is not None:
            write_bytes(saved.arrays_path(trial), self.label_arrays)
        write_json(saved.folder / f"{trial}.json", self.label.to_json())

    def drop_label(self, store: Store, campaign: str, trial: str) -> None:
        """Delete the label of a trial that was not written."""
        saved = Derived.of(store, LABELS, campaign)
        (saved.folder / f"{trial}.json").unlink(missing_ok=True)
        saved.arrays_path(trial).unlink(missing_ok=True)

    def keep_sync(self, campaign: Campaign, recording: Recording) -> None:
        """Write the refitted clocks, as of the files that were made now."""
        if self.sync is None:
            return
        make_folder(campaign.sync_folder)
        saved = self.sync.model_copy(update={"raw": recording.raw_checksum})
        write_json(campaign.sync_file(recording.folder.name), saved.to_json())


def _group(data: Mapping[str, Array], group: str, parts: tuple[str, ...]) -> list[Array]:
    """Return columns of a group, of one length. Raises FormatError where one is missing."""
    found = [data.get(f"{group}/{part}") for part in parts]
    lengths = {None if column is None else len(column) for column in found}
    if len(lengths) != 1 or None in lengths:
        raise FormatError(f"holds columns of {group} of different lengths, or not all of them")
    return [column for column in found if column is not None]
