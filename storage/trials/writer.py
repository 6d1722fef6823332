"""Writing of a trial: in `incoming` until every file is complete, then visible by one rename.

The first event camera, the first frame camera, arm, sync box and small sensors share one HDF5 file.
Each further camera has its own files, made with its first chunk, in the same layout.
"""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from sliplab.storage.errors import masked
from sliplab.storage.files import protect, sync_file, sync_folder, write_json_aside
from sliplab.storage.schema.trial import Provenance, TrialRecord
from sliplab.storage.streams import STREAM_NAME, Chunk, FrameChunk, Json
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
from sliplab.storage.trials.hdf5_writer import OWN_DEVICES, StreamFile
from sliplab.storage.trials.prefix_journal import PrefixJournal, drop_journal


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
    protect_folder(folder)


def protect_folder(folder: Path) -> None:
    """Protect the files of a trial's folder that has its checksums, and flush its entries."""
    for name in (*data_files(folder), RECORD, CHECKSUMS, PROVENANCE):
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
        expected: empty chunks of every stream that may come, by device; nothing else can be added.
            What was written before the last `mark` can then be kept after a crash
            (`storage.trials.prefix`), but for spooled frames.
    """

    def __init__(
        self,
        folder: Path,
        target: Path,
        frame_px: tuple[int, int] | None,
        rate_hz: int,
        *,
        spool: bool = False,
        expected: Mapping[str, Sequence[Chunk]] | None = None,
    ) -> None:
        self.folder, self.target = folder, target
        folder.mkdir(parents=True)
        self._rate_hz, self._spool = rate_hz, spool
        own, cameras = _split(expected)
        streams = StreamFile(folder / DATA, own)
        raw = folder / SPOOL if spool else None
        guarded = expected is not None
        frames = FrameWriter(streams, folder / FRAMES, raw, rate_hz, frame_px, guarded)
        self._files = _Files(streams, None if frame_px is None else frames)
        self._further: dict[str, tuple[str, _Files]] = {
            name: (chunks[0].KIND.camera, self._camera_files(name, chunks))
            for name, chunks in cameras.items()
        }
        self._journal = PrefixJournal(folder) if guarded else None
        self._sealed = False

    @property
    def counts(self) -> dict[str, int]:
        """Rows written so far, by column."""
        return dict(self._files.streams.counts)

    def add(self, device: str, chunk: Chunk) -> None:
        """Append a chunk; a further camera has its own files, made with its first chunk.

        Raises:
            ValueError: the name is not a small identifier, the stream is of another kind, or events
                come out of order.
        """
        camera = chunk.KIND.camera
        if not camera or device in OWN_DEVICES:
            self._files.add(device, chunk)
            return
        if device not in self._further:
            if not STREAM_NAME.fullmatch(device):
                raise ValueError(f"stream '{device}': a name must match {STREAM_NAME.pattern}")
            self._further[device] = camera, self._camera_files(device)
        known, files = self._further[device]
        if known != camera:
            raise ValueError(f"stream '{device}': is of kind '{known}', not '{camera}'")
        files.add(camera, chunk)

    def _camera_files(self, name: str, expected: Sequence[Chunk] | None = None) -> _Files:
        """Make the files of a further camera."""
        data, video, raw = (self.folder / stream_file(name, end) for end in ("h5", "mkv", "raw"))
        guarded = None if expected is None else {expected[0].KIND.camera: expected}
        streams = StreamFile(data, guarded)
        spool = raw if self._spool else None
        frames = FrameWriter(streams, video, spool, self._rate_hz, guarded=guarded is not None)
        return _Files(streams, frames)

    def mark(self) -> None:
        """Note what was written so far, of a trial with `expected` streams, once it is on the disk.

        Raises:
            OSError: the disk refused earlier rows.
        """
        assert self._journal is not None
        files = {"": self._files, **{name: files for name, (_, files) in self._further.items()}}
        self._journal.add({name: each.mark() for name, each in files.items()})

    def seal(self) -> Path:
        """Finish data and video files, so that they can be read before the commit.

        Returns:
            The folder of these files.
        """
        if self._sealed:
            return self.folder
        self._sealed = True
        if self._journal is not None:
            self._journal.close()
        self._files.seal()
        for _, files in self._further.values():
            files.seal()
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
        sync_folder(self.folder)  # a record on the disk says that all the rest is there
        write_json_aside(self.folder / RECORD, record.to_json())
        drop_journal(self.folder)
        finish_folder(self.folder, cause)

    def abandon(self) -> None:
        """Close open files and leave the folder unchanged, for quarantine."""
        if not self._sealed:
            self._sealed = True
            try:
                if self._journal is not None:
                    self._journal.close()
                self._files.abandon()
            finally:
                for _, files in self._further.values():
                    with suppress(OSError, RuntimeError):
                        files.abandon()

    def discard(self) -> None:
        """Close open files and delete the folder; for motions that are no trial."""
        self.abandon()
        shutil.rmtree(self.folder)


def _split(
    expected: Mapping[str, Sequence[Chunk]] | None,
) -> tuple[Mapping[str, Sequence[Chunk]] | None, Mapping[str, Sequence[Chunk]]]:
    """Return the expected streams of a trial's own file, and those of further cameras."""
    if expected is None:
        return None, {}
    cameras = {
        name: chunks
        for name, chunks in expected.items()
        if chunks[0].KIND.camera and name not in OWN_DEVICES
    }
    return {name: each for name, each in expected.items() if name not in cameras}, cameras


@dataclass
class _Files:
    """An HDF5 file, and the video of the frames whose rows it has.

    Attributes:
        frames: None drops frames.
    """

    streams: StreamFile
    frames: FrameWriter | None

    def add(self, device: str, chunk: Chunk) -> None:
        """Append a chunk. Raises ValueError as `StreamFile.add`."""
        if not isinstance(chunk, FrameChunk):
            self.streams.add(device, chunk)
        elif self.frames is not None:
            self.frames.add(chunk)

    def mark(self) -> Json:
        """Write what waits, and return what the files hold."""
        images = [0, 0] if self.frames is None else self.frames.mark()
        return {**self.streams.mark(), "images": images, "host_ns": time.monotonic_ns()}

    def seal(self) -> None:
        """Finish the files."""
        if self.frames is not None:
            self.frames.settle()
        self.streams.finish()
        if self.frames is not None:
            self.frames.seal()

    def abandon(self) -> None:
        """Close the files, as far as the disk takes them."""
        try:
            self.streams.abandon()
        finally:
            if self.frames is not None:
                self.frames.abandon()
