"""Writing of a trial: in `incoming` until every file is complete, then visible by one rename.

The first event camera, the first frame camera, arm, sync box and small sensors share one HDF5 file.
Each further camera has its own files, made with its first chunk, in the same layout.
"""

from __future__ import annotations

import os
import shutil
from contextlib import suppress
from pathlib import Path

from sliplab.storage.errors import masked
from sliplab.storage.files import protect, sync_file, sync_folder, write_json_aside
from sliplab.storage.schema.trial import Provenance, TrialRecord
from sliplab.storage.streams import (
    EVENTS_KIND,
    FRAMES_KIND,
    I64,
    U8,
    CameraChunk,
    ClockReads,
    EventChunk,
    FrameChunk,
    Json,
    PoseChunk,
    PulseChunk,
    StreamChunk,
)
from sliplab.storage.trials.checksums import (
    CHECKSUMS,
    DATA,
    FRAMES,
    PROVENANCE,
    RECORD,
    SPOOL,
    Checksum,
    as_json,
    is_stream_file,
    stream_file,
)
from sliplab.storage.trials.frame_writer import FrameWriter
from sliplab.storage.trials.hdf5_writer import STREAM_NAME, StreamFile


def data_files(folder: Path) -> list[str]:
    """Return the names of a trial's files that hold data."""
    first = [name for name in (DATA, FRAMES) if (folder / name).exists()]
    return first + sorted(filter(is_stream_file, os.listdir(folder)))


def make_visible(folder: Path, target: Path) -> None:
    """Rename a complete folder to `target`, and flush that."""
    os.rename(folder, target)
    sync_folder(target.parent)


def finish_folder(folder: Path, cause: Json | None = None) -> None:
    """Write the checksums of a trial's folder that has data and record, and flush its entries.

    Args:
        cause: why it goes to quarantine, if it does.
    """
    sums = {name: Checksum.of(folder / name) for name in (*data_files(folder), RECORD)}
    write_json_aside(folder / CHECKSUMS, as_json(sums))
    if cause is not None:
        write_json_aside(folder / "cause.json", cause)
    for name in (*sums, CHECKSUMS, PROVENANCE):
        protect(folder / name)
    sync_folder(folder)


class TrialWriter:
    """A `storage.streams.Sink` that ends in exactly one of `commit` and `abandon`.

    Args:
        folder: the trial's folder while it is written; must not exist.
        target: its folder once committed.
        frame_px: (width, height) of the frames, or None without a frame camera. Whether there will
            be a video shows with the first frame: a camera may return tracks instead.
        spool: keep raw frames on disk and encode them when the trial ends; for rigs that cannot
            encode as fast as their cameras deliver.
    """

    def __init__(
        self,
        folder: Path,
        target: Path,
        frame_px: tuple[int, int] | None,
        rate_hz: int,
        *,
        spool: bool = False,
    ) -> None:
        self.folder, self.target = folder, target
        folder.mkdir(parents=True)
        self._streams = StreamFile(folder / DATA)
        self._rate_hz, self._spool = rate_hz, spool
        self._frames: FrameWriter | None = None
        if frame_px is not None:
            raw = folder / SPOOL if spool else None
            self._frames = FrameWriter(self._streams, folder / FRAMES, raw, rate_hz, frame_px)
        self._further: dict[str, CameraWriter] = {}
        self._sealed = False

    @property
    def counts(self) -> dict[str, int]:
        """Rows written so far, by column."""
        return dict(self._streams.counts)

    def add_events(self, chunk: EventChunk) -> None:
        """Append events."""
        self._streams.add_events(chunk)

    def add_event_pulses(self, chunk: PulseChunk) -> None:
        """Append pulses seen by the event camera."""
        self._streams.append("event_pulses", t=chunk.t_ns)

    def add_arm_pulses(self, chunk: PulseChunk) -> None:
        """Append pulses seen by the arm."""
        self._streams.append("arm_pulses", t=chunk.t_ns)

    def add_sync_pulses(self, chunk: PulseChunk) -> None:
        """Append pulses sent by the sync box."""
        self._streams.append("sync_pulses", t=chunk.t_ns)

    def add_exposures(self, chunk: PulseChunk) -> None:
        """Append starts of exposures seen by the sync box."""
        self._streams.append("exposures", t=chunk.t_ns)

    def add_box_reads(self, chunk: ClockReads) -> None:
        """Append reads of the sync box's clock."""
        self._add_reads("box_reads", chunk)

    def add_frame_camera_reads(self, chunk: ClockReads) -> None:
        """Append reads of the frame camera's clock."""
        self._add_reads("frame_camera_reads", chunk)

    def _add_reads(self, group: str, chunk: ClockReads) -> None:
        self._streams.append(group, t=chunk.device_ns, before=chunk.before_ns, after=chunk.after_ns)

    def add_triggers(self, t_ns: I64, kind: U8) -> None:
        """Append triggers of the event camera, of an imported trial."""
        self._streams.append("triggers", t=t_ns, kind=kind)

    def add_poses(self, chunk: PoseChunk) -> None:
        """Append arm poses."""
        self._streams.append(
            "poses", t=chunk.t_ns, host=chunk.host_ns, xyz=chunk.xyz_mm, rotvec=chunk.rotvec_deg
        )

    def add_frames(self, chunk: FrameChunk) -> None:
        """Append frames, or the tracks in place of them, and their times."""
        if self._frames is not None:
            self._frames.add(chunk)

    def add_stream(self, name: str, chunk: StreamChunk | CameraChunk) -> None:
        """Append to a named stream; that of a further camera has its own files.

        Raises:
            ValueError: the name is not a small identifier, or the stream is of another kind.
        """
        if isinstance(chunk, StreamChunk):
            self._streams.add_stream(name, chunk)
            return
        if name not in self._further:
            if not STREAM_NAME.fullmatch(name):
                raise ValueError(f"stream '{name}': a name must match {STREAM_NAME.pattern}")
            self._further[name] = CameraWriter(self.folder, name, self._rate_hz, self._spool)
        self._further[name].add(chunk)

    def seal(self) -> Path:
        """Finish data and video files, so that they can be read before the commit.

        Returns:
            The folder of these files.
        """
        if self._sealed:
            return self.folder
        self._sealed = True
        self._streams.finish()
        if self._frames is not None:
            self._frames.seal()
        for camera in self._further.values():
            camera.seal()
        return self.folder

    def commit(self, record: TrialRecord, provenance: Provenance) -> Path:
        """Write record and checksums, flush everything, and make the trial visible.

        Returns:
            The committed trial's folder.

        Raises:
            FileExistsError: the trial is there already; nothing was changed.
        """
        self.seal()
        if self.target.exists():
            raise FileExistsError(f"{self.target}: this trial is already committed")
        self._finish_folder(record, provenance)
        make_visible(self.folder, self.target)
        return self.target

    def quarantine(
        self, target: Path, record: TrialRecord, provenance: Provenance, cause: Json
    ) -> None:
        """End a complete but unwanted attempt: keep it in `target`, with its record and cause."""
        self.seal()
        self._finish_folder(record, provenance, {**cause, "cause": masked(str(cause["cause"]))})
        make_visible(self.folder, target)

    def _finish_folder(
        self, record: TrialRecord, provenance: Provenance, cause: Json | None = None
    ) -> None:
        """Write what makes the folder complete.

        The record is written when the data are safe: a recovery trusts a folder that has one.
        """
        for name in data_files(self.folder):
            sync_file(self.folder / name)
        write_json_aside(self.folder / PROVENANCE, provenance.to_json())
        write_json_aside(self.folder / RECORD, record.to_json())
        finish_folder(self.folder, cause)

    def abandon(self) -> None:
        """Close open files and leave the folder unchanged, for quarantine."""
        if not self._sealed:
            self._sealed = True
            try:
                self._streams.abandon()
                if self._frames is not None:
                    self._frames.abandon()
            finally:
                for camera in self._further.values():
                    with suppress(OSError, RuntimeError):
                        camera.abandon()

    def discard(self) -> None:
        """Close open files and delete the folder; for motions that are no trial."""
        self.abandon()
        shutil.rmtree(self.folder)


class CameraWriter:
    """Writes the files of one further camera: an HDF5 file as the trial's own, and a video.

    Args:
        folder: the trial's folder while it is written.
        name: the stream's name.
        spool: as that of `TrialWriter`.
    """

    def __init__(self, folder: Path, name: str, rate_hz: int, spool: bool) -> None:
        self._folder, self._name, self._rate_hz, self._spool = folder, name, rate_hz, spool
        self._streams = StreamFile(folder / stream_file(name))
        self._frames: FrameWriter | None = None
        self._kind: str | None = None

    def add(self, chunk: CameraChunk) -> None:
        """Append what the camera sent. Raises ValueError for another kind than it began with."""
        if isinstance(chunk, ClockReads):
            self._streams.append(
                "frame_camera_reads",
                t=chunk.device_ns,
                before=chunk.before_ns,
                after=chunk.after_ns,
            )
            return
        kind = FRAMES_KIND if isinstance(chunk, FrameChunk) else EVENTS_KIND
        self._kind = self._kind or kind
        if self._kind != kind:
            raise ValueError(f"stream '{self._name}': is of kind '{self._kind}', not '{kind}'")
        if isinstance(chunk, EventChunk):
            self._streams.add_events(chunk)
        elif isinstance(chunk, PulseChunk):
            self._streams.append("event_pulses", t=chunk.t_ns)
        else:
            if self._frames is None:
                video, raw = (
                    self._folder / stream_file(self._name, suffix) for suffix in ("mkv", "raw")
                )
                raw_file = raw if self._spool else None
                self._frames = FrameWriter(self._streams, video, raw_file, self._rate_hz)
            self._frames.add(chunk)

    def seal(self) -> None:
        """Finish its files."""
        self._streams.finish()
        if self._frames is not None:
            self._frames.seal()

    def abandon(self) -> None:
        """Close its files, as far as the disk takes them."""
        try:
            self._streams.abandon()
        finally:
            if self._frames is not None:
                self._frames.abandon()
