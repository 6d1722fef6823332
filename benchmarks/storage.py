"""Writing and reading a trial, beside the lab's way: lists of times, one a pixel, pickled.

The pickles are given every advantage: their lists are made before the clock runs, reading them
stops at the lists, and they keep neither polarity nor microseconds.
"""

from __future__ import annotations

import pickle
import tempfile
from pathlib import Path

import numpy as np

from benchmarks.measure import RUNS, SEED, Figures, alternate, one_core, rate, spread
from benchmarks.slides import many_events
from rigs.scene.frames import FrameOptics, PlateView
from rigs.scene.randomness import generator
from storage.hdf5 import StreamFile, StreamReader
from storage.streams import U8, EventChunk
from storage.video import VideoWriter

WIDTH, HEIGHT = 640, 480
CHUNK = 20_000
WINDOW_US = 30_000
Lists = list[list[list[int]]]


def measure(
    events: int = 3_000_000, frames: int = 250, size: int = 800, runs: int = RUNS
) -> Figures:
    """Events through HDF5 and pickles on one core, frames through FFV1 on two."""
    with tempfile.TemporaryDirectory() as folder:
        return _events(Path(folder), events, runs) | _frames(Path(folder), frames, size, runs)


def _events(folder: Path, count: int, runs: int) -> Figures:
    data = many_events(count)
    lists = _lists(data)
    hdf5, pickled = folder / "data.h5", folder / "data.pickle"
    first, last = int(data.t_us[0]), int(data.t_us[-1])
    starts = np.linspace(first, last - WINDOW_US, 20).astype(np.int64).tolist()

    def write() -> None:
        file = StreamFile(hdf5)
        for at in range(0, count, CHUNK):
            part = slice(at, at + CHUNK)
            file.add_events(EventChunk(data.x[part], data.y[part], data.p[part], data.t_us[part]))
        file.finish()

    def read() -> EventChunk:
        with StreamReader(hdf5) as reader:
            return reader.events()

    def windows() -> None:
        for start in starts:
            with StreamReader(hdf5) as reader:
                reader.events(start, start + WINDOW_US)

    def pickle_write() -> None:
        with pickled.open("wb") as file:
            pickle.dump(lists, file, protocol=pickle.HIGHEST_PROTOCOL)

    def pickle_read() -> Lists:
        with pickled.open("rb") as file:
            loaded: Lists = pickle.load(file)
        return loaded

    def pickle_window() -> list[tuple[int, int, int]]:
        low, high = (starts[10] - first) // 1000, (starts[10] - first + WINDOW_US) // 1000
        return [
            (x, y, t)
            for y, row in enumerate(pickle_read())
            for x, times in enumerate(row)
            for t in times
            if low <= t < high
        ]

    with one_core():
        taken = alternate(
            runs, write=write, pickle_write=pickle_write, read=read, pickle_read=pickle_read,
            window=windows, pickle_window=pickle_window,
        )  # fmt: skip
    back = read()
    for column in ("x", "y", "p", "t_us"):
        if not np.array_equal(getattr(back, column), getattr(data, column)):
            raise RuntimeError(f"{column} came back otherwise than it was written")
    millions = count / 1e6
    each = [value * 1e3 / len(starts) for value in taken["window"]]
    return {
        **rate("write_m_events_per_s", millions, taken["write"]),
        **rate("read_m_events_per_s", millions, taken["read"]),
        **spread("window_30ms_ms", each),
        "bytes_per_event": hdf5.stat().st_size / count,
        **rate("pickle_write_m_events_per_s", millions, taken["pickle_write"]),
        **rate("pickle_read_m_events_per_s", millions, taken["pickle_read"]),
        **spread("pickle_window_30ms_ms", [value * 1e3 for value in taken["pickle_window"]]),
        "pickle_bytes_per_event": pickled.stat().st_size / count,
    }


def _lists(data: EventChunk) -> Lists:
    """Whole milliseconds since the first event, a list a pixel."""
    lists: Lists = [[[] for _ in range(WIDTH)] for _ in range(HEIGHT)]
    ms = ((data.t_us - data.t_us[0]) // 1000).tolist()
    for x, y, t in zip(data.x.tolist(), data.y.tolist(), ms, strict=True):
        lists[y][x].append(t)
    return lists


def noisy_frames(count: int, size: int, noise: float) -> U8:
    """Frames of a sliding skin with noise on every pixel, which is the worst to encode."""
    rng = generator(SEED, "benchmark frames")
    ring = 5.6 * np.exp(2j * np.pi * np.arange(6) / 6)
    places = np.concatenate(([0j], ring, 2 * ring))
    layout = np.stack((places.real, places.imag), axis=-1)
    slide = np.linspace(-3.0, 3.0, count)[:, None, None] * np.array([1.0, 0.2])
    images = np.empty((count, size, size), np.uint8)
    view = PlateView(FrameOptics(noise=0.0, tip_radius_mm=1.0), size, size)
    view.draw(images, layout[None] + slide, None, np.arange(count, dtype=np.int64), SEED)
    for image in images:
        grey = image + np.rint(rng.standard_normal(image.shape, np.float32) * noise)
        image[:] = np.clip(grey, 0, 255).astype(np.uint8)
    return images


def _frames(folder: Path, count: int, size: int, runs: int) -> Figures:
    images = noisy_frames(min(count, 25), size, 1.5)
    path = folder / "frames.mkv"

    def encode() -> None:
        video = VideoWriter(path, size, size, 100, threads=2)
        for at in range(0, count, len(images)):
            video.write(images[: count - at])
        video.close()

    taken = alternate(runs, encode=encode)["encode"]
    pixels = count * size * size
    return {
        **rate("frames_per_s_800", count, taken),
        "video_bytes_per_pixel": path.stat().st_size / pixels,
    }
