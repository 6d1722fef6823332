"""A complete trial of a store inside an MCAP file, and its re-import into a store.

Such a trial is written by the store's own writer, checked as `sliplab verify` checks one, and
retains its record: clocks, condition and gates are unchanged. Its files are written again, so their
bytes, and with them the keys of derived results, may differ although the contents are equal: steps
then compute again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
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
    CHUNKS,
    EVENTS_KIND,
    FRAMES_KIND,
    SCALAR,
    STREAM_NAME,
    U8,
    Chunk,
    Column,
    EventChunk,
    FrameChunk,
    Json,
    ScalarChunk,
    StreamKind,
    chunk_type,
)
from sliplab.storage.trials.checksums import DATA, stream_file
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.hdf5_writer import (
    COLUMNS,
    GROUPS,
    LATE_GROUPS,
    OWN_DEVICES,
    STREAM_GROUP,
    STREAMS,
    TIMING,
    TRACKS,
)
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import Campaign, TrialStore
from sliplab.storage.trials.verify import content_problems
from sliplab.storage.trials.writer import TrialWriter

Array = npt.NDArray[Any]
_FRAMES_AT_ONCE = 32
_TIMES = {part: SCALAR.columns[part] for part in ("t", "host")}
"""Columns that every named stream has in the same way, where it has them."""


@dataclass(frozen=True)
class Original:
    """A trial of a store.

    Attributes:
        columns: all but those of events, by file and name.
        events: events of each camera by the name of its stream, in order of time.
        frames: frames of each camera that has a video.
        units: units of the columns of named streams.
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
            if stated.kind in STREAMS:
                for part, column in STREAMS[stated.kind].columns.items():
                    known[f"{STREAM_GROUP}/{stream}/{part}"] = column
            elif not stated.of_camera and name.startswith(f"{STREAM_GROUP}/{stream}/"):
                part = name.rpartition("/")[2]
                if STREAM_NAME.fullmatch(part):
                    known[name] = _TIMES.get(part) or _as_is(part, values)
        files = {DATA, *(stream_file(name) for name, stated in streams.items() if stated.of_camera)}
        if name not in known or name.startswith("events/") or file not in files:
            raise FormatError(f"holds the column {name!r:.60} of {file!r:.60}, which no trial has")
        _, dtype, shape, _ = known[name]
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
    def restore(
        self, store: TrialStore, campaign: Campaign, name: str, about: Json
    ) -> StreamCounts:
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
        self._fill_file(writer, DATA, {device: device for device in OWN_DEVICES})
        data = self._of(DATA)
        for name, stated in self.record.streams.items():
            group = f"{STREAM_GROUP}/{name}"
            if stated.of_camera:
                self._fill_file(writer, stream_file(name), {stated.kind: name})
            elif f"{group}/t" in data:
                writer.add(name, self._rows(data, group, stated.kind))

    def _rows(self, data: Mapping[str, Array], group: str, name: str) -> Chunk:
        """Return the rows of a named stream."""
        if name == SCALAR.name:
            return _chunk(data, group, ScalarChunk, unit=self.units.get(f"{group}/value", ""))
        if name in STREAMS:
            return _chunk(data, group, CHUNKS[name])
        parts = {key.rpartition("/")[2]: key for key in data if key.startswith(f"{group}/")}
        columns = {
            part: _as_is(part, data[key])._replace(unit=self.units.get(key, ""))
            for part, key in parts.items()
        }
        return _chunk(data, group, chunk_type(StreamKind(name, columns)))

    def _of(self, file: str) -> dict[str, Array]:
        return {name: values for (of, name), values in self.columns.items() if of == file}

    def _fill_file(self, writer: TrialWriter, file: str, devices: Mapping[str, str]) -> None:
        """Write what one file has.

        Args:
            devices: to whose streams it goes, by the device that has such groups in a trial's own
                file.
        """
        data = self._of(file)
        for group, (device, kind) in (GROUPS | LATE_GROUPS).items():
            if device not in devices:
                continue
            name = devices[device]
            chunks: Iterable[Chunk] = ()
            if group == EVENTS_KIND:
                chunks = self._events(name)
            elif group == FRAMES_KIND:
                chunks = self._frames(name, data)
            elif f"{group}/t" in data:
                chunks = [_chunk(data, group, CHUNKS[kind.name])]
            for chunk in chunks:
                writer.add(name, chunk)

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

    def keep_label(self, store: TrialStore, campaign: str, trial: str) -> None:
        """Write the trial's label, before the trial: no one reads it until the trial exists."""
        if self.label is None:
            return
        saved = Derived.of(store, LABELS, campaign)
        make_folder(saved.folder)
        if self.label_arrays is not None:
            write_bytes(saved.arrays_path(trial), self.label_arrays)
        write_json(saved.folder / f"{trial}.json", self.label.to_json())

    def drop_label(self, store: TrialStore, campaign: str, trial: str) -> None:
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


def _as_is(part: str, values: Array) -> Column:
    """Return the column of another package's kind that has these values."""
    return Column(part, values.dtype.name, values.shape[1:], "")


def _chunk(data: Mapping[str, Array], group: str, chunk: type[Chunk], **more: str) -> Chunk:
    """Return the rows of a group. Raises FormatError as `_group`."""
    parts = tuple(chunk.KIND.columns)
    found = dict(zip(parts, _group(data, group, parts), strict=True))
    return chunk.from_columns(found, **more)


def _group(data: Mapping[str, Array], group: str, parts: tuple[str, ...]) -> list[Array]:
    """Return columns of a group, of one length. Raises FormatError where one is missing."""
    found = [data.get(f"{group}/{part}") for part in parts]
    lengths = {None if column is None else len(column) for column in found}
    if len(lengths) != 1 or None in lengths:
        raise FormatError(f"holds columns of {group} of different lengths, or not all of them")
    return [column for column in found if column is not None]
