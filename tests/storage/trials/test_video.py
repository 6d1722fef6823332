"""Frames are lossless, and the same frames are the same file."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import av
import numpy as np
import pytest

from sliplab.storage.trials.video import (
    FrameReader,
    VideoWriter,
    copy_frames,
    count_frames,
    read_frame,
    read_frames,
)
from tests.storage.trial_files import FRAME, frames


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


def test_copied_frames_are_lossless_and_the_same_bytes(tmp_path: Path) -> None:
    path, copies = tmp_path / "v.mkv", [tmp_path / "a.mp4", tmp_path / "b.mp4"]
    write(path, 9)
    numbers = np.array([0, 0, 2, 3, 3, 8])
    for copy in copies:
        copy_frames(path, copy, numbers, 50)
    assert copies[0].read_bytes() == copies[1].read_bytes()
    assert np.array_equal(list(read_frames(copies[0])), frames(9).images[numbers])
    with av.open(str(copies[0])) as file:
        times = [frame.time for frame in file.decode(video=0)]
    np.testing.assert_allclose(times, np.arange(6) / 50)
    with pytest.raises(IndexError, match="no frame 9"):
        copy_frames(path, copies[0], np.array([8, 9]), 50)


def test_the_same_frames_are_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a.mkv", "b.mkv"):
        write(tmp_path / name, 9)
    assert (tmp_path / "a.mkv").read_bytes() == (tmp_path / "b.mkv").read_bytes()


@pytest.mark.parametrize("count", [1, 2, 7, 100])
def test_the_number_of_threads_shows_nowhere_in_the_file(count: int, tmp_path: Path) -> None:
    images = frames(count, seed=4).images
    files = []
    for threads in (1, 2, 3):
        path = tmp_path / f"{threads}.mkv"
        writer = VideoWriter(path, *FRAME, 100, threads)
        for image in images:
            writer.write(image[None])
        writer.close()
        files.append(path.read_bytes())
    assert files[0] == files[1] == files[2]
    found = list(read_frames(tmp_path / "3.mkv"))
    assert np.array_equal(np.stack(found), images)


def test_an_encoder_that_fails_says_so_and_blocks_nobody(tmp_path: Path, monkeypatch: Any) -> None:
    class Broken:
        """Stands for the codec's frames: the third one cannot be made."""

        made = 0

        @classmethod
        def from_numpy_buffer(cls, image: np.ndarray, format: str) -> av.VideoFrame:
            cls.made += 1
            if cls.made == 3:
                raise ValueError("out of ink")
            return av.VideoFrame.from_numpy_buffer(image, format=format)

    codec = SimpleNamespace(**{**vars(av), "VideoFrame": Broken})
    monkeypatch.setattr("sliplab.storage.trials.video.av", codec)
    writer = VideoWriter(tmp_path / "v.mkv", *FRAME, 100)
    # fewer than the queues hold: nothing waits, and closing tells what happened
    writer.write(frames(20).images[:2])
    writer.close()
    writer = VideoWriter(tmp_path / "w.mkv", *FRAME, 100)

    def write_on() -> None:
        for _ in range(20):
            writer.write(frames(20).images)
        writer.close()

    with pytest.raises(RuntimeError, match="out of ink"):
        write_on()


def test_frames_of_another_size_are_refused(tmp_path: Path) -> None:
    writer = VideoWriter(tmp_path / "v.mkv", *FRAME, 100)
    with pytest.raises(ValueError, match="do not fit"):
        writer.write(np.zeros((1, 8, 8), np.uint8))
    writer.close()


def test_no_frames_are_no_file(tmp_path: Path) -> None:
    writer = VideoWriter(tmp_path / "v.mkv", *FRAME, 100)
    writer.close()
    assert not (tmp_path / "v.mkv").exists()


@pytest.mark.parametrize("guarded", [False, True])
@pytest.mark.parametrize("rate_hz", [30, 100, 144])
def test_frames_are_found_in_any_order(tmp_path: Path, rate_hz: int, guarded: bool) -> None:
    wanted = frames(40).images
    writer = VideoWriter(tmp_path / "v.mkv", *FRAME, rate_hz, guarded=guarded)
    writer.write(wanted)
    writer.close()
    with FrameReader(tmp_path / "v.mkv") as reader:
        for index in (20, 0, 39, 1, 20, 21, 3):
            assert np.array_equal(reader.frame(index), wanted[index])
        for index in (-1, 40, 1000):
            with pytest.raises(IndexError, match=f"has no frame {index}"):
                reader.frame(index)
