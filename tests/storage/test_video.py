"""Frames are lossless, and the same frames are the same file."""

from pathlib import Path

import numpy as np
import pytest

from storage.video import VideoWriter, count_frames, read_frame, read_frames
from tests.storage.trials import FRAME, frames


def write(path: Path, count: int) -> None:
    """Random frames in two calls."""
    writer = VideoWriter(path, *FRAME, 100)
    images = frames(count).images
    writer.write(images[:3])
    writer.write(images[3:])
    writer.close()


def test_frames_are_lossless_and_countable(tmp_path: Path) -> None:
    path = tmp_path / "v.mkv"
    write(path, 9)
    images = frames(9).images
    assert count_frames(path) == 9
    for found, image in zip(read_frames(path), images, strict=True):
        assert np.array_equal(found, image)
    assert np.array_equal(read_frame(path, 7), images[7])
    with pytest.raises(IndexError, match="no frame 9"):
        read_frame(path, 9)


def test_the_same_frames_are_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a.mkv", "b.mkv"):
        write(tmp_path / name, 9)
    assert (tmp_path / "a.mkv").read_bytes() == (tmp_path / "b.mkv").read_bytes()


def test_frames_of_another_size_are_refused(tmp_path: Path) -> None:
    writer = VideoWriter(tmp_path / "v.mkv", *FRAME, 100)
    with pytest.raises(ValueError, match="do not fit"):
        writer.write(np.zeros((1, 8, 8), np.uint8))
    writer.close()


def test_no_frames_are_no_file(tmp_path: Path) -> None:
    writer = VideoWriter(tmp_path / "v.mkv", *FRAME, 100)
    writer.close()
    assert not (tmp_path / "v.mkv").exists()
