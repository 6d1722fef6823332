"""The longest verified prefix of a trial whose program was killed.

The files of such a trial are readable up to the last state in its journal. Each state has the rows
of every column and the CRC-32 of them; the latest one that all files match is kept, and what comes
after it is cut off. The files are copied, cut and put in place, so this may be killed, too.
"""

from __future__ import annotations

import shutil
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import h5py
import hdf5plugin  # noqa: F401  (registers the filters)
import numpy as np

from sliplab.storage.errors import own_fault
from sliplab.storage.files import replacing
from sliplab.storage.streams import Json
from sliplab.storage.trials.checksums import DATA, FRAMES, stream_file
from sliplab.storage.trials.hdf5_reader import FileContent
from sliplab.storage.trials.hdf5_writer import cut
from sliplab.storage.trials.prefix_journal import read_journal
from sliplab.storage.trials.superblock import HEAD_BYTES, closed
from sliplab.storage.trials.video import cut_video, read_frames

_BLOCK = 1 << 18


def keep_prefix(folder: Path) -> Json | None:
    """Cut a trial's files to the latest state of its journal that they match.

    Returns:
        The state, by file: rows and checksums by column, and images. None if there is none: nothing
        was changed then.

    Raises:
        OSError: the disk is full or failing.
    """
    states = read_journal(folder)
    last = len(states) - 1
    for name in states[0] if states else ():
        last = _last_match(folder, name, [state[name] for state in states[: last + 1]])
    if last < 0:
        return None
    for name, state in states[last].items():
        data, video = _paths(folder, name)
        with replacing(data) as copy:
            shutil.copyfile(data, copy)
            _close(copy)
            cut(copy, state)
        images = state["images"][0]
        if images:
            with replacing(video) as copy:
                cut_video(video, images, copy)
        else:
            video.unlink(missing_ok=True)
    return states[last]


def _paths(folder: Path, name: str) -> tuple[Path, Path]:
    if not name:
        return folder / DATA, folder / FRAMES
    return folder / stream_file(name), folder / stream_file(name, "mkv")


def _close(path: Path) -> None:
    """Clear the mark of a file that a killed program had open."""
    with path.open("r+b") as file:
        if (head := closed(file.read(HEAD_BYTES), path.stat().st_size)) is not None:
            file.seek(0)
            file.write(head)


def _last_match(folder: Path, name: str, states: Sequence[Json]) -> int:
    """Return the index of the latest state that a file and its video match; -1 for none."""
    data, video = _paths(folder, name)
    last = len(states) - 1
    try:
        with data.open("rb") as raw:
            head = closed(raw.read(HEAD_BYTES), data.stat().st_size) or b""
        with FileContent(data, head=head) as content, h5py.File(content, "r") as file:
            for column in states[0]["columns"]:
                counts = [state["columns"][column] for state in states[: last + 1]]
                last = _matching(counts, _reader(file[column]))
    except Exception as error:  # of HDF5, about a file that may have any damage
        if own_fault(error):
            raise
        return -1
    images = [state["images"] for state in states[: last + 1]]
    if images and images[-1][0]:
        frames = _frames(video)
        last = _matching(images, lambda start, end: (next(frames) for _ in range(start, end)))
    return last


def _matching(counts: Sequence[Sequence[int]], read: Callable[[int, int], Iterable[Any]]) -> int:
    """Return the index of the last count whose rows have its checksum; -1 for none.

    Args:
        counts: rows from the beginning, and their CRC-32; rising.
        read: yields the rows between two places; fewer where the rest cannot be read.
    """
    done = crc = 0
    for index, (rows, stated) in enumerate(counts):
        try:
            for block in read(done, rows):
                crc = zlib.crc32(np.ascontiguousarray(block).data, crc)
        except Exception as error:  # of HDF5 or FFmpeg, about what may have any damage
            if own_fault(error):
                raise
            return index - 1
        if crc != stated:
            return index - 1
        done = rows
    return len(counts) - 1


def _reader(column: Any) -> Callable[[int, int], Iterator[Any]]:
    def read(start: int, end: int) -> Iterator[Any]:
        for at in range(start, end, _BLOCK):
            yield column[at : min(at + _BLOCK, end)]

    return read


def _frames(video: Path) -> Iterator[Any]:
    """Yield the frames of a video as far as they can be decoded."""
    if video.exists():
        yield from read_frames(video)
