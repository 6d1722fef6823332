"""Writing and reading a trial, beside other files for events (`benchmarks/event_files.py`).

Events go through one core, frames through two. A window is 30 ms in the middle of the file, which
is opened for it anew; its figure is of the window alone for ours and a rival alike.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.event_files import rivals
from benchmarks.measure import RUNS, SEED, Figures, alternate, one_core, rate, ratio, spread
from benchmarks.slides import many_events
from sliplab.plugins.simulation.scene.frames import FrameOptics, PlateView
from sliplab.plugins.simulation.scene.randomness import generator
from sliplab.storage.formats.aedat4 import Aedat4File
from sliplab.storage.streams import U8, EventChunk
from sliplab.storage.trials.hdf5_reader import StreamReader
from sliplab.storage.trials.hdf5_writer import StreamFile
from sliplab.storage.trials.video import VideoWriter, read_frames

CHUNK = 20_000
WINDOW_US = 30_000


def measure(
    events: int = 3_000_000, frames: int = 250, size: int = 800, runs: int = RUNS
) -> Figures:
    """Events through HDF5 and its rivals on one core, frames through FFV1 on two."""
    with tempfile.TemporaryDirectory() as folder:
        return _events(Path(folder), events, runs) | _frames(Path(folder), frames, size, runs)


def _events(folder: Path, count: int, runs: int) -> Figures:
    data = many_events(count)
    others = rivals(folder, data)
    hdf5 = folder / "data.h5"
    first, last = int(data.t_us[0]), int(data.t_us[-1])
    starts = np.linspace(first, last - WINDOW_US, 20).astype(np.int64).tolist()
    middle = starts[10]

    def write() -> None:
        file = StreamFile(hdf5)
        for at in range(0, count, CHUNK):
            file.add("events", data[at : at + CHUNK])
        file.finish()

    def read() -> EventChunk:
        with StreamReader(hdf5) as reader:
            return reader.events()

    def windows() -> None:
        for start in starts:
            with StreamReader(hdf5) as reader:
                reader.events(start, start + WINDOW_US)

    work: dict[str, Callable[[], object]] = {"write": write, "read": read, "window": windows}
    for name, other in others.items():
        work[f"{name}_write"], work[f"{name}_read"] = other.write, other.read
        work[f"{name}_window"] = partial(other.window, middle, middle + WINDOW_US)
    work["aedat4_own_read"] = lambda: _read_aedat4(others["aedat4"].path)
    with one_core():
        taken = alternate(runs, **work)
    own, theirs = taken["aedat4_own_read"], taken["aedat4_read"]
    back = read()
    for column in ("x", "y", "p", "t_us"):
        if not np.array_equal(getattr(back, column), getattr(data, column)):
            raise RuntimeError(f"{column} came back otherwise than it was written")
    taken["window"] = [value / len(starts) for value in taken["window"]]
    figures: Figures = {}
    for name, path in {"": hdf5, **{f"{n}_": other.path for n, other in others.items()}}.items():
        for what in ("write", "read"):
            figures |= rate(f"{name}{what}_m_events_per_s", count / 1e6, taken[name + what])
        figures |= spread(f"{name}window_30ms_ms", [v * 1e3 for v in taken[f"{name}window"]])
        figures[f"{name}bytes_per_event"] = path.stat().st_size / count
    figures |= rate("aedat4_own_read_m_events_per_s", count / 1e6, own)
    return figures | ratio("aedat4_own_read_ratio", theirs, own)


def _read_aedat4(path: Path) -> list[EventChunk]:
    """All events of the rival's file, as `sliplab import` reads them."""
    with Aedat4File(path) as file:
        return list(file.events(0))


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
    for number, image in enumerate(read_frames(path, threads=2)):
        if not np.array_equal(image, images[number % len(images)]):
            raise RuntimeError(f"frame {number} came back otherwise than it was written")
    pixels = count * size * size
    return {
        **rate("frames_per_s_800", count, taken),
        "video_bytes_per_pixel": path.stat().st_size / pixels,
    }
