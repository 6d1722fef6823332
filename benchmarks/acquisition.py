"""Real drivers and the writer under a trial's full load: nothing may get lost.

Noisy frames come from pylon's emulated camera through the Basler driver, events and pulses from
another process through dv-processing and the DVXplorer driver; both go into a trial with a spool.
Events are made before the clock runs. One run, for it is long.

frames_lost, events_lost, pulses_lost: sent or exposed, and not in the trial's files. The emulated
camera slows down where a real one would lose frames, so `frames_per_s` stands beside them. It is
asked for `EMULATED_HZ`, for it waits a period and then draws: asked for 100/s, it makes 99.
dropped_on_purpose, dropped_noticed: in a second, short run the stand-in drops frames; noticed are
those missing in the file's frame numbers that the driver counted too.
memory_growth_mb: of this process, from its most in the first fifth of the run to its most of all;
memory_end_growth_mb: from the median of the first fifth to that of the last.
cores: processor time of this process, drivers, pylon's emulation and writing, over time; that of
dv-processing, which has a process of its own, is not in it.
loop_max_ms: the longest time between two looks of the loop that reads and writes; queued_max_ms:
how much of that it waited for a processor that others had.
saturation_x_realtime: frames a second that the spool takes by itself, until they are on the disk,
over 100. encode_s_per_trial: encoding the run's spool when the trial ends.
"""

from __future__ import annotations

import tempfile
import threading
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from statistics import median

import numpy as np

from benchmarks.basler_emulation import LossyDevice, show, write_frames
from benchmarks.dvxplorer_server import DvxplorerServer, Packet
from benchmarks.measure import SEED, Figures, queued_s, resident_mb
from benchmarks.storage import noisy_frames
from sliplab.plugins.devices.basler.driver import BaslerCamera, find_camera
from sliplab.plugins.devices.basler.fake_live import emulate
from sliplab.plugins.devices.basler.settings import BaslerSettings
from sliplab.plugins.devices.dvxplorer.driver import DvxplorerCamera
from sliplab.plugins.simulation.scene.randomness import generator
from sliplab.storage.files import sync_file
from sliplab.storage.streams import U8, EventChunk, FrameChunk
from sliplab.storage.trials.checksums import DATA, FRAMES, SPOOL
from sliplab.storage.trials.hdf5_reader import StreamReader
from sliplab.storage.trials.video import count_frames
from sliplab.storage.trials.writer import TrialWriter

RATE_HZ = 100
EMULATED_HZ = 102
PACKET_US = 10_000
POLL_S = 0.01
FREE_RUN = BaslerSettings(px_per_mm=20.0, trigger="free run", rate_hz=EMULATED_HZ)
BURSTS = (1, 2, 5, 17)
"""Number of consecutive frames that the fake camera drops on purpose."""
TAIL_S = 10.0
"""Time to wait for data that was sent and has not arrived yet."""


def measure(
    seconds: float = 30.0,
    events_per_s: int = 2_000_000,
    size: int = 1000,
    pictures: int = 50,
    saturating: int = 2000,
) -> Figures:
    """One run of `seconds`, and `saturating` frames into a spool of their own."""
    emulate(1)
    images = noisy_frames(pictures, size, 1.5)
    with tempfile.TemporaryDirectory() as folder:
        write_frames(Path(folder) / "pictures", images)
        figures = _run(Path(folder), seconds, events_per_s, size)
        figures |= _drop(Path(folder), size)
        figures["saturation_x_realtime"] = _saturate(Path(folder), images, saturating) / RATE_HZ
    return figures


def busy(seconds: float, events_per_s: int) -> Iterator[Packet]:
    """Packets of 10 ms of events all over the sensor, and a pulse in most of them."""
    rng = generator(SEED, "benchmark events")
    count = events_per_s * PACKET_US // 1_000_000
    x = rng.integers(0, 640, count).astype(np.uint16)
    y = rng.integers(0, 480, count).astype(np.uint16)
    p = rng.integers(0, 2, count).astype(np.uint8)
    within = np.sort(rng.integers(0, PACKET_US, count))
    for start in range(0, round(seconds * 1e6), PACKET_US):
        pulses = np.full(int(start // PACKET_US % 3 > 0), start, np.int64)
        yield EventChunk(x, y, p, start + within), pulses


def _run(folder: Path, seconds: float, events_per_s: int, size: int) -> Figures:
    trial = TrialWriter(folder / "aside", folder / "trial", (size, size), RATE_HZ, spool=True)
    frames = BaslerCamera(FREE_RUN)
    with DvxplorerServer(partial(busy, seconds, events_per_s)) as server:
        events = DvxplorerCamera(server.settings)
        try:
            frames.set_region(size, size)
            show(frames.device, folder / "pictures")
            events.start()
            frames.start()
            server.go()
            memory, pauses, rates = _loop(trial, frames, events, server, seconds)
            frames.stop()
            sent = server.finish(TAIL_S)
            _tail(trial, events, sent.events, sent.pulses)
            trial.add("frames", frames.read())
            counts = frames.counts
            before = time.perf_counter()
            trial.seal()
            encode_s = time.perf_counter() - before
        finally:
            events.close()
            frames.close()
    with StreamReader(trial.folder / DATA) as reader:
        rows = reader.counts()
    fifth = max(len(memory) // 5, 1)
    early, late = memory[:fifth], memory[-fifth:]
    return {
        "frames_lost": counts.lost + counts.grabbed - count_frames(trial.folder / FRAMES),
        "events_lost": sent.events - rows["events/t"],
        "pulses_lost": sent.pulses - rows["event_pulses/t"],
        "frames_late": counts.late,
        "m_events_per_s": sent.events / sent.seconds / 1e6,
        **rates,
        "memory_growth_mb": max(0.0, max(memory) - max(early)),
        "memory_end_growth_mb": max(0.0, median(late) - median(early)),
        "loop_max_ms": max(pauses)[0] * 1e3,
        "queued_max_ms": max(pauses)[1] * 1e3,
        "encode_s_per_trial": encode_s,
    }


def _loop(
    trial: TrialWriter,
    frames: BaslerCamera,
    events: DvxplorerCamera,
    server: DvxplorerServer,
    seconds: float,
) -> tuple[list[float], list[tuple[float, float]], Figures]:
    """Read and write as a rig does: memory at every look, time between looks, and rates."""
    memory, pauses, idle = [], [], threading.Event()
    queued = queued_s()
    used = time.process_time()
    began = last = time.perf_counter()
    while last - began < seconds or not server.answered:
        trial.add("events", events.read())
        trial.add("events", events.read_pulses())
        trial.add("frames", frames.read())
        memory.append(resident_mb())
        idle.wait(POLL_S)
        now = time.perf_counter()
        queued, before = queued_s(), queued
        pauses.append((now - last, queued - before))
        last = now
    rates = {
        "frames_per_s": frames.counts.grabbed / (last - began),
        "cores": (time.process_time() - used) / (last - began),
    }
    return memory, pauses, rates


def _tail(trial: TrialWriter, events: DvxplorerCamera, wanted: int, pulses: int) -> None:
    """Drain the events still in flight after the server has sent its last message."""
    end = time.perf_counter() + TAIL_S
    idle = threading.Event()
    while time.perf_counter() < end:
        counts = events.counts
        if (counts.events, counts.pulses) == (wanted, pulses):
            break
        idle.wait(POLL_S)
    events.stop()
    trial.add("events", events.read())
    trial.add("events", events.read_pulses())


def _drop(folder: Path, size: int) -> Figures:
    """Frames that the stand-in drops on purpose, and how many of them are known in the end."""
    trial = TrialWriter(folder / "gaps", folder / "no", (size, size), RATE_HZ, spool=True)
    device = LossyDevice(find_camera(None))
    frames = BaslerCamera(FREE_RUN, device)
    idle, end = threading.Event(), time.perf_counter() + TAIL_S
    try:
        frames.set_region(size, size)
        show(frames.device, folder / "pictures")
        frames.start()
        for burst in (*BURSTS, 0):
            before = frames.counts.grabbed
            while frames.counts.grabbed < before + 5 and time.perf_counter() < end:
                trial.add("frames", frames.read())
                idle.wait(POLL_S)
            device.drop_frames(burst)
        frames.stop()
        trial.add("frames", frames.read())
    finally:
        frames.close()
    trial.seal()
    with StreamReader(trial.folder / DATA) as reader:
        numbers = reader.column("frames/number")
    missing = int(numbers[-1]) + 1 - len(numbers)
    trial.discard()
    return {
        "dropped_on_purpose": device.dropped,
        "dropped_noticed": min(missing, frames.counts.skipped),
    }


def _saturate(folder: Path, images: U8, count: int) -> float:
    """Frames a second into a spool, by the time they are on the disk."""
    size = images.shape[1]
    trial = TrialWriter(folder / "full", folder / "never", (size, size), RATE_HZ, spool=True)
    part = images[:10]
    times = np.zeros(len(part), np.int64)
    chunk = FrameChunk(part, times, times, times, np.zeros(len(part), np.uint8))
    began = time.perf_counter()
    for _ in range(0, count, len(part)):
        trial.add("frames", chunk)
    trial.abandon()  # returns when all is written
    sync_file(trial.folder / SPOOL)
    taken = time.perf_counter() - began
    trial.discard()
    return -(-count // len(part)) * len(part) / taken
