"""Read access to a committed trial: raw streams, clock maps, record."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from sliplab.protocols.errors import InputError
from sliplab.protocols.program import ACTING
from sliplab.storage.clockmap import ClockMap
from sliplab.storage.errors import StoreError
from sliplab.storage.schema.document import DocumentError, NewerFormat
from sliplab.storage.schema.trial import Provenance, SyncResult, TrialClockMaps, TrialRecord
from sliplab.storage.streams import (
    EVENTS_KIND,
    F64,
    FRAMES_KIND,
    I64,
    SCALAR,
    U8,
    WRENCH,
    EventChunk,
    ScalarChunk,
    WrenchChunk,
)
from sliplab.storage.trials.checksums import (
    DATA,
    FRAMES,
    PROVENANCE,
    RECORD,
    Checksums,
    Fetch,
    read_sums,
    stream_file,
    to_fetch,
)
from sliplab.storage.trials.hdf5_reader import StreamReader
from sliplab.storage.trials.video import FrameReader, read_frame, read_frames


@dataclass(frozen=True)
class Tracks:
    """Positions of the markers in each of n frames as the camera found them, pixels."""

    markers_px: F64
    """(n, m, 2) in the order of the record's layout, NaN where a marker was not seen whole."""
    plate_px: F64 | None
    """(n, 2), NaN where the plate's marker was not seen; None without one."""


class Recording:
    """One trial on disk. Times on the trial's time line are the sync box's clock, int64 ns.

    A committed trial is never rewritten, and never read if it differs from the committed one: each
    of its files is checked against its checksum before this object first reads it. Where its clocks
    were fitted again and came out otherwise, the new ones are among the derived results, and are
    used in the record's place.

    Args:
        folder: the trial's own folder.
        sync_file: path of the result of fitting its clocks again, once there is one.
        fetch: brings files that a mirror lacks; it goes to other processes by its name.
    """

    def __init__(
        self, folder: Path, sync_file: Path | None = None, fetch: Fetch | None = None
    ) -> None:
        self.folder = folder
        self.sync_file = sync_file
        self._fetch = fetch
        self._checked: set[str] = set()

    def __reduce__(self) -> tuple[type[Recording], tuple[Path, Path | None, Fetch | None]]:
        """Send another process the trial's paths, not its loaded data."""
        return Recording, (self.folder, self.sync_file, self._fetch)

    @cached_property
    def record(self) -> TrialRecord:
        """The trial's record.

        Raises:
            StoreError: it is damaged, or was written by a newer version.
        """
        path = self._sound(RECORD)
        try:
            return TrialRecord.load(path)
        except NewerFormat as error:
            raise StoreError(str(error)) from None
        except DocumentError as error:
            raise self._damaged(str(error)) from None

    @cached_property
    def context(self) -> dict[str, str]:
        """The skin, and what people had logged by then of temperature and so on, by name.

        Raises:
            StoreError: it is damaged.
        """
        try:
            skin = Provenance.load(self.folder / PROVENANCE).skin
        except FileNotFoundError:
            skin = None
        except (OSError, DocumentError, NewerFormat) as error:
            raise StoreError(str(error)) from None
        return {**({"skin": skin} if skin else {}), **self.record.context}

    @property
    def described(self) -> dict[str, str]:
        """The condition and the context, by name; logged context comes before what was planned."""
        planned = self.record.condition
        known = {name: value for name, value in self.context.items() if name not in planned}
        return {**planned, **known, **self.record.context}

    @property
    def trial_id(self) -> str:
        """The trial's id."""
        return self.record.trial

    @cached_property
    def raw_checksum(self) -> str:
        """One hash that represents the raw data of this trial and its record."""
        return "".join(self._sums[name].sha256[:16] for name in sorted(self._sums))

    @cached_property
    def _sums(self) -> Checksums:
        """The trial's checksums."""
        try:
            return read_sums(self.folder)
        except ValueError as error:
            raise self._damaged(str(error)) from None

    def files(self) -> dict[str, Path]:
        """Return the trial's files that are under checksums, by name, each checked against its own.

        Raises:
            StoreError: one is damaged.
        """
        return {name: self._sound(name) for name in sorted(self._sums)}

    def _sound(self, name: str) -> Path:
        """Return one of the trial's files, once it has been checked against its checksum.

        Raises:
            StoreError: it is damaged.
        """
        path = self.folder / name
        if name not in self._checked:
            if name not in self._sums:
                raise self._damaged(f"{path}: is not among the checksums")
            if to_fetch(path):
                if self._fetch is None:
                    raise StoreError(
                        f"{path}: was not downloaded from the URL that this store mirrors; open "
                        "the store with `storage.remote.mirror.open_store`, which downloads it"
                    )
                self._fetch(path, self._sums[name])
            if (problem := self._sums[name].problem(path)) is not None:
                raise self._damaged(f"{path}: {problem}")
            self._checked.add(name)
        return path

    def _damaged(self, what: str) -> StoreError:
        store = self.folder.parents[3] if len(self.folder.parents) > 3 else self.folder
        return StoreError(
            f"{what}: this trial is damaged; `sliplab verify {store} --quarantine` quarantines "
            "it, and `sliplab collect` retakes what a protocol asks for"
        )

    @property
    def checksum(self) -> str:
        """One hash of all that analysis reads of this trial: raw data and clocks in use."""
        refitted = self._refitted
        return self.raw_checksum if refitted is None else self.raw_checksum + refitted.key

    @cached_property
    def clocks(self) -> TrialClockMaps:
        """The clocks of the trial: fitted again, or else as the record has them."""
        refitted = self._refitted
        found = None if refitted is None else refitted.clocks
        return self.record.clocks if found is None else found

    @property
    def refitted(self) -> bool:
        """True if other clocks are in use than those of the record."""
        return self._refitted is not None

    @cached_property
    def _refitted(self) -> SyncResult | None:
        """The result of fitting again, where it holds other clocks than the record's."""
        if self.sync_file is None or not self.sync_file.exists():
            return None
        try:
            found = SyncResult.load(self.sync_file)
            # a trial that was retaken under this id has nothing to do with it
            if found.raw != self.raw_checksum or found.clocks is None:
                return None
            if found.clocks.events is None and self.record.clocks.events is not None:
                raise DocumentError(f"{self.sync_file}: clocks.events: is missing")
        except NewerFormat as error:
            raise StoreError(str(error)) from None
        except DocumentError as error:
            raise StoreError(
                f"{error}; it is damaged: delete it, and `sliplab sync` recomputes it"
            ) from None
        return found

    @property
    def clocks_elsewhere(self) -> SyncResult | None:
        """Clocks for `use_clocks` in another process; None for those of the record."""
        return self._refitted

    def use_clocks(self, refitted: SyncResult | None) -> None:
        """Use `clocks_elsewhere` of another process, whatever is stored here."""
        self.__dict__.pop("clocks", None)
        self.__dict__["_refitted"] = refitted

    def forget_clocks(self) -> None:
        """Forget refitted clocks, so that those just written are read."""
        for name in ("_refitted", "clocks"):
            self.__dict__.pop(name, None)

    @property
    def has_video(self) -> bool:
        """True if the frames themselves were recorded."""
        return FRAMES in self._sums

    @cached_property
    def has_tracks(self) -> bool:
        """True if the markers' places were recorded instead of a video."""
        with self.open() as reader:
            return reader.has("tracks/markers")

    @property
    def frame_source(self) -> str:
        """``video``, ``tracks`` or ``none``: the data of the outside camera."""
        if self.has_video:
            return "video"
        # frames that are in no video are tracks, and the record is a small file
        return "tracks" if self.record.counts.frames else "none"

    @property
    def event_px(self) -> tuple[int, int]:
        """Columns and rows of the event camera.

        Raises:
            StoreError: they are unknown, as of an imported trial.
        """
        found = self.record.geometry.event_px
        if found is None:
            raise StoreError(f"{self.folder}: the size of its event camera is unknown")
        return found

    @property
    def frame_px(self) -> tuple[int, int]:
        """Columns and rows of the frames.

        Raises:
            StoreError: the trial was recorded without frames.
        """
        found = self.record.geometry.frame_px
        if found is None:
            raise StoreError(f"{self.folder}: was recorded without frames")
        return found

    @property
    def layout_px(self) -> F64:
        """Places of the markers at rest from the frame's centre, pixels; float64 (m, 2).

        Raises:
            StoreError: the trial holds no scale.
        """
        geometry = self.record.geometry
        if geometry.px_per_mm is None:
            raise StoreError(f"{self.folder}: the scale of its frames is unknown")
        layout = np.asarray(geometry.skin_mm, np.float64) * geometry.px_per_mm
        layout[:, 1] *= -1  # rows count downwards
        return layout

    def open(self, stream: str | None = None) -> StreamReader:
        """The HDF5 file, as a context manager; with `stream` that of a further camera.

        Raises:
            StoreError: the trial has no such further camera.
        """
        if stream is None or stream in {EVENTS_KIND, FRAMES_KIND}:
            return StreamReader(self._sound(DATA), self.record.geometry.event_px)
        self._check_stream(stream, EVENTS_KIND, FRAMES_KIND)
        about = self.record.streams[stream]
        size = about.size_px if about.kind == EVENTS_KIND else None
        return StreamReader(self._sound(stream_file(stream)), size)

    def streams(self, *kinds: str) -> list[str]:
        """Names of the streams of some kinds, the first cameras' ``events`` and ``frames`` first.

        Args:
            kinds: ``events``, ``frames``, ``scalar``, ``wrench``, and those of other packages; all
                if left out.
        """
        record = self.record
        with_events, with_frames = record.clocks.events is not None, self.frame_source != "none"
        first = {EVENTS_KIND: with_events, FRAMES_KIND: with_frames}
        named = {name: stream.kind for name, stream in sorted(record.streams.items())}
        found = {name: name for name, there in first.items() if there} | named
        return [name for name, kind in found.items() if not kinds or kind in kinds]

    def _check_stream(self, name: str, *kinds: str) -> None:
        if name in {EVENTS_KIND, FRAMES_KIND} & set(kinds):
            return
        stream = self.record.streams.get(name)
        if stream is None or stream.kind not in kinds:
            raise StoreError(
                f"{self.folder}: the trial has no {' or '.join(kinds)} '{name}'; it has: "
                f"{', '.join(self.streams(*kinds)) or 'none'}"
            )

    def clock(self, device: str) -> ClockMap:
        """The map from a device's clock (``events``, ``frames``, ``arm``, a stream's name) to the
        time line.

        Raises:
            StoreError: the trial has no such clock.
        """
        known = self.clocks.devices()
        if device not in known:
            names = ", ".join(sorted(known)) or "none"
            why = self.clocks.refused.get(device)
            text = f"the trial has no clock '{device}'" + (f", since {why}" if why else "")
            raise StoreError(f"{self.folder}: {text}; it has: {names}")
        return known[device].map

    def events(
        self,
        start_ns: int | None = None,
        end_ns: int | None = None,
        stream: str = EVENTS_KIND,
    ) -> EventChunk:
        """Events between two times of the time line, on the camera's own clock.

        Args:
            stream: name of a further event camera's stream, instead of the first one's.

        Raises:
            InputError: a time does not fit 64 bits.
            StoreError: the trial has no such stream.
        """
        self._check_stream(stream, EVENTS_KIND)
        clock = self.clock(stream)
        bounds: list[int | None] = []
        for name, t in (("start_ns", start_ns), ("end_ns", end_ns)):
            try:
                bounds.append(None if t is None else -(-int(clock.to_device(t)) // 1000))
            except OverflowError:
                raise InputError(name, "", t, "must fit 64 bits; None has no bound") from None
        with self.open(stream) as reader:
            return reader.events(*bounds)

    def scalars(self, name: str) -> ScalarChunk:
        """Readings of a named stream, on the sensor's own clock.

        Raises:
            StoreError: the trial has no such stream; the message lists those that it has.
        """
        self._check_stream(name, SCALAR.name)
        with self.open() as reader:
            return reader.scalars(name)

    def samples(self, name: str) -> dict[str, npt.NDArray[Any]]:
        """Samples of a named stream of any kind but a camera's, each of shape (n, ...).

        Returns:
            its columns by their stored names, ``t`` as ns on the time line, without ``host``.

        Raises:
            StoreError: the trial has no such stream.
        """
        about = self.record.streams
        known = [key for key, stream in about.items() if not stream.of_camera]
        if name not in known:
            there = ", ".join(sorted(known)) or "none"
            raise StoreError(f"{self.folder}: the trial has no samples '{name}'; it has: {there}")
        with self.open() as reader:
            found = reader.stream(name) if about[name].rows else {}
        found.pop("host", None)
        times = found.pop("t", np.empty(0, np.int64))
        return {"t": np.asarray(self.clock(name).to_reference(times)), **found}

    def wrenches(self, name: str = "force") -> WrenchChunk:
        """Forces and torques of a named stream, on the sensor's own clock and in its own axes.

        Raises:
            StoreError: the trial has no such stream; the message lists those that it has.
        """
        self._check_stream(name, WRENCH.name)
        with self.open() as reader:
            return reader.wrenches(name)

    def frame_times(self, stream: str = FRAMES_KIND) -> I64:
        """Middle of exposure of every frame on the time line, ns.

        Args:
            stream: name of a further frame camera's stream, instead of the first one's.

        Raises:
            StoreError: the trial has no such stream.
        """
        with self.open(stream) as reader:
            times = reader.column("frames/t")
        return np.asarray(self.clock(stream).to_reference(times))

    def video(self, stream: str = FRAMES_KIND) -> Path | None:
        """Return the path of a camera's video; None where it returned no frames, or tracks.

        Raises:
            StoreError: the trial has no such stream.
        """
        name = self._video(stream)
        return self._sound(name) if name in self._sums else None

    def _video(self, stream: str) -> str:
        """Return the name of a camera's video."""
        if stream == FRAMES_KIND:
            return FRAMES
        self._check_stream(stream, FRAMES_KIND)
        return stream_file(stream, "mkv")

    def frames(self, threads: int = 1, stream: str = FRAMES_KIND) -> Iterator[U8]:
        """Decoded frames, uint8 of shape (height, width); `stream` as in `frame_times`.

        Raises:
            StoreError: one is of another size than the record says.
        """
        found = read_frames(self._sound(self._video(stream)), threads)
        return (self._fitting(image, stream) for image in found)

    def frame(self, index: int, stream: str = FRAMES_KIND) -> U8:
        """One decoded frame; `stream` as in `frame_times`."""
        return self._fitting(read_frame(self._sound(self._video(stream)), index), stream)

    def _fitting(self, image: U8, stream: str) -> U8:
        """Return a frame of the size that the record says: positions are looked up in it."""
        size = self.record.geometry.frame_px if stream == FRAMES_KIND else None
        if size is not None and image.shape != (size[1], size[0]):
            raise self._damaged(
                f"{self.folder / self._video(stream)}: has a frame of {image.shape[1]} x "
                f"{image.shape[0]} px, the record says {size[0]} x {size[1]}"
            )
        return image

    def frame_reader(self) -> FrameReader:
        """The video, opened for frames in any order; a context manager."""
        return FrameReader(self._sound(FRAMES))

    def tracks(self) -> Tracks:
        """The markers' places, where they were recorded instead of a video.

        Raises:
            ValueError: the trial has none.
            StoreError: there are not as many as frames.
        """
        if not self.has_tracks:
            raise ValueError(f"{self.folder}: contains no tracks")
        with self.open() as reader:
            plate = reader.column("tracks/plate") if reader.has("tracks/plate") else None
            markers = reader.column("tracks/markers")
            frames = reader.counts()["frames/t"]
        for what, rows in (("markers", markers), ("plate", plate)):
            if rows is not None and len(rows) != frames:
                raise self._damaged(
                    f"{self.folder / DATA}: tracks/{what} has {len(rows)} rows, and there are "
                    f"{frames} frames"
                )
        return Tracks(
            markers.astype(np.float64), None if plate is None else plate.astype(np.float64)
        )

    def step(self, phase: str) -> tuple[int, int]:
        """Start and end of a phase of the motion on the time line, ns.

        The last step of that name is meant, which is the recorded one.

        Raises:
            KeyError: the motion has no such phase.
        """
        clock = self.clock("arm")
        for step in reversed(self.record.steps):
            if step.phase == phase:
                return clock.to_reference(step.start_ns), clock.to_reference(step.end_ns)
        raise KeyError(f"{self.trial_id}: no step '{phase}'")

    @property
    def motion_phase(self) -> str:
        """The phase in which slip is first looked for: ``slide``, ``retract`` or ``move``."""
        phases = {step.phase for step in self.record.steps}
        return next((phase for phase in ACTING if phase in phases), "retract")

    @property
    def motion_ns(self) -> tuple[int, int]:
        """Start of the first and end of the last phase in which slip is looked for, ns.

        Of an imported trial whose motion is not known it is the whole recording.

        Raises:
            KeyError: the motion has none.
        """
        origin = self.record.imported
        if origin is not None and origin.span_ns is not None and not self.record.steps:
            return origin.span_ns
        clock = self.clock("arm")
        there = [step for step in self.record.steps if step.phase in ACTING]
        several = [step for step in there if step.recorded] if len(there) > 1 else []
        if not several:
            return self.step(self.motion_phase)
        return clock.to_reference(several[0].start_ns), clock.to_reference(several[-1].end_ns)

    @property
    def simulated(self) -> bool:
        """True if a mock rig made this."""
        return self.record.simulated

    def simulation_truth(self) -> dict[str, Any] | None:
        """Return the simulated truth, on the time line; only for tests and error reports."""
        return self.record.simulation_truth
