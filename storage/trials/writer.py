"""Writing of a trial: in `incoming` until every file is complete, then visible by one rename.

Raw frames of a rig that cannot encode as fast as its camera delivers wait in a spool file. The
caller never waits for the disk while the spool's queue has room. What was written is sent on to the
disk at once: an operating system that gathers gigabytes first stops every writer when it has
enough of them, the one with the events too.
"""

from __future__ import annotations

import os
import shutil
import threading
from collections import deque
from contextlib import suppress
from pathlib import Path

import numpy as np

from sliplab.storage.errors import masked
from sliplab.storage.files import sync_file, sync_folder, write_json_aside
from sliplab.storage.schema.trial import Provenance, TrialRecord
from sliplab.storage.streams import (
    I64,
    U8,
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
)
from sliplab.storage.trials.hdf5_writer import StreamFile
from sliplab.storage.trials.video import VideoWriter

QUEUE_BYTES = 1 << 29
"""The most that waits in memory, bytes: five seconds of 1000 x 1000 px at 100/s."""
WAIT_S = 60.0
"""The longest that a full queue, and the end of the file, are waited for, s."""
_AHEAD_BYTES = 1 << 24


class TrialWriter:
    """A `storage.streams.Sink` that ends in exactly one of `commit` and `abandon`.

    Args:
        folder: the trial's folder while it is written; must not exist.
        target: its folder once committed.
        frame_px: (width, height) of the frames, or None without a frame camera. Whether there will
            be a video shows with the first frame: a camera may return tracks instead.
        spool: keep raw frames on disk and encode them when the trial ends; for rigs that cannot
            encode as fast as their camera delivers.
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
        self._frame_px = frame_px
        self._rate_hz = rate_hz
        self._spool = Spool(folder / SPOOL) if spool and frame_px else None
        self._video: VideoWriter | None = None
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
        if self._frame_px is None or not len(chunk):
            return
        self._streams.append(
            "frames", number=chunk.number, t=chunk.t_ns, host=chunk.host_ns, sync=chunk.sync
        )
        if chunk.markers_px is not None:
            self._streams.add_tracks(chunk)
        elif self._spool is not None:
            self._spool.write(chunk.images)
        else:
            if self._video is None:
                self._video = VideoWriter(self.folder / FRAMES, *self._frame_px, self._rate_hz)
            self._video.write(chunk.images)

    def add_stream(self, name: str, chunk: StreamChunk) -> None:
        """Append to a named stream. Raises ValueError for another kind than it began with."""
        self._streams.add_stream(name, chunk)

    def seal(self) -> Path:
        """Finish data and video files, so that they can be read before the commit.

        Returns:
            The folder of these files.
        """
        if self._sealed:
            return self.folder
        self._sealed = True
        self._streams.finish()
        if self._spool is not None and self._frame_px is not None:
            self._spool.close()
            self._encode_spool(self._spool.path, *self._frame_px)
        if self._video is not None:
            self._video.close()
        return self.folder

    def _encode_spool(self, spool: Path, width: int, height: int) -> None:
        empty = spool.stat().st_size == 0  # which cannot be mapped
        levels = np.empty(0, np.uint8) if empty else np.memmap(spool, np.uint8, "r")
        frames = levels.reshape(-1, height, width)
        self._video = VideoWriter(self.folder / FRAMES, width, height, self._rate_hz)
        for start in range(0, len(frames), 64):
            self._video.write(frames[start : start + 64])
        self._video.close()
        del frames, levels
        spool.unlink()

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
        os.rename(self.folder, self.target)
        sync_folder(self.target.parent)
        return self.target

    def quarantine(
        self, target: Path, record: TrialRecord, provenance: Provenance, cause: Json
    ) -> None:
        """End a complete but unwanted attempt: keep it in `target`, with its record and cause."""
        self.seal()
        write_json_aside(
            self.folder / "cause.json", {**cause, "cause": masked(str(cause["cause"]))}
        )
        self._finish_folder(record, provenance)
        os.rename(self.folder, target)
        sync_folder(target.parent)

    def _finish_folder(self, record: TrialRecord, provenance: Provenance) -> None:
        write_json_aside(self.folder / RECORD, record.to_json())
        write_json_aside(self.folder / PROVENANCE, provenance.to_json())
        for name in (DATA, FRAMES):
            if (self.folder / name).exists():
                sync_file(self.folder / name)
        sums = {
            name: Checksum.of(self.folder / name)
            for name in (DATA, FRAMES, RECORD)
            if (self.folder / name).exists()
        }
        write_json_aside(self.folder / CHECKSUMS, as_json(sums))
        sync_folder(self.folder)

    def abandon(self) -> None:
        """Close what is open and leave the folder as it is, for quarantine."""
        if not self._sealed:
            self._sealed = True
            self._streams.abandon()
            if self._spool is not None:
                with suppress(OSError):
                    self._spool.close()
            if self._video is not None:
                self._video.close()

    def discard(self) -> None:
        """Close what is open and delete it; for motions that are no trial."""
        self.abandon()
        shutil.rmtree(self.folder)


class Spool:
    """A file of grey frames, one after the other; bounded in memory."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = path.open("wb", buffering=0)
        self._waiting: deque[U8] = deque()
        self._bytes = 0
        self._changed = threading.Condition()
        self._error: OSError | None = None
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="spool", daemon=True)
        self._thread.start()

    def write(self, images: U8) -> None:
        """Append frames, which must not change afterwards; waits only where the queue is full.

        Raises:
            OSError: the disk refused these or earlier ones, or has stood still for `WAIT_S`.
        """
        if not images.size:
            return
        images = np.ascontiguousarray(images)
        with self._changed:
            done = self._changed.wait_for(
                lambda: self._error or self._bytes < QUEUE_BYTES, timeout=WAIT_S
            )
            self._check()
            if not done:
                raise OSError(f"{self.path}: the disk has hung for {WAIT_S:g} s")
            self._waiting.append(images)
            self._bytes += images.nbytes
            self._changed.notify_all()

    def close(self) -> None:
        """Write what waits, and close the file; safe to call more than once.

        Raises:
            OSError: not all of it could be written.
        """
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join(WAIT_S)
        if self._thread.is_alive():
            raise OSError(f"{self.path}: the disk has hung for {WAIT_S:g} s")
        self._file.close()
        self._check()

    def _check(self) -> None:
        if self._error is not None:
            raise self._error

    def _run(self) -> None:
        written = sent_on = 0
        try:
            while (images := self._next()) is not None:
                left = images.reshape(-1).data
                while left:
                    left = left[self._file.write(left) or 0 :]
                written += images.nbytes
                if written - sent_on >= _AHEAD_BYTES:
                    self._send_on(written)
                    sent_on = written
                with self._changed:
                    self._bytes -= images.nbytes
                    self._changed.notify_all()
        except OSError as error:
            with self._changed:
                self._error = error
                self._waiting.clear()
                self._changed.notify_all()

    def _next(self) -> U8 | None:
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._closed)
            return self._waiting.popleft() if self._waiting else None

    def _send_on(self, end: int) -> None:
        """Begin to write to the disk, and drop what is there from memory, where the system can."""
        if hasattr(os, "posix_fadvise"):
            os.posix_fadvise(self._file.fileno(), 0, end, os.POSIX_FADV_DONTNEED)
