"""Recordings of an LSL stream whose sender's clock drifts and jumps: how far times are off.

The sender is a program of its own under a preloaded library; liblsl is the real one. An event is
seen by the stream, and by a true clock that the sender reads right before and after it.
"""

from __future__ import annotations

import os
import random
import shutil
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sliplab.plugins.record.recorder import record
from sliplab.plugins.record.sources import lsl
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import TrialStore

HERE = Path(__file__).parent
JUMPS_S = (0.05, 0.3, 2.0)


@dataclass
class Sender:
    """A running sender.

    Attributes:
        clock: file with the sum of its clock's jumps.
    """

    clock: Path
    jumped_ns: int = 0

    def jump(self, seconds: float) -> None:
        """Let its clock jump."""
        self.jumped_ns += round(seconds * 1e9)
        with self.clock.open("r+b") as file:
            file.write(struct.pack("<q", self.jumped_ns))


@contextmanager
def sending(folder: Path, name: str, drift_ppm: float) -> Iterator[Sender]:
    """Run a sender while the block runs."""
    library, clock = folder / "fake_clock.so", folder / "clock"
    subprocess.run(
        ["gcc", "-O2", "-shared", "-fPIC", "-o", library, HERE / "fake_clock.c"], check=True
    )
    clock.write_bytes(bytes(8))
    more = {"LD_PRELOAD": str(library), "FAKE_CLOCK": str(clock), "FAKE_RATE": f"{drift_ppm}e-6"}
    child = subprocess.Popen(
        [sys.executable, HERE / "lsl_sender.py", name],
        env={**os.environ, **more},
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    )
    try:
        assert child.stdout is not None
        assert child.stdout.readline() == b"ready\n"
        yield Sender(clock)
    finally:
        child.kill()
        child.communicate()


@dataclass(frozen=True)
class Outcome:
    """One recording.

    Attributes:
        event_us: error of the time of one event of it. worst_us: of any. bound_us: as stated; None
            where the clock was refused.
    """

    event_us: float
    worst_us: float
    bound_us: float | None

    @property
    def within(self) -> bool:
        """The event lies within the stated bound."""
        return self.bound_us is not None and abs(self.event_us) <= self.bound_us


def recordings(folder: Path, count: int, seed: int, drift_ppm: float = 100.0) -> list[Outcome]:
    """Record trials of one to four seconds; the sender's clock jumps in every second one."""
    chance, name = random.Random(seed), f"clock-{os.getpid()}"
    with (
        sending(folder, name, drift_ppm) as sender,
        record([lsl(name, "lab")], folder / "store", "lsl") as recorder,
    ):
        for number in range(count):
            with recorder.trial():
                time.sleep(0.5 + 1.5 * chance.random())  # the recording's length
                if number % 2:
                    sender.jump(chance.choice((-1, 1)) * chance.choice(JUMPS_S))
                    time.sleep(0.5 + 1.5 * chance.random())
    store = TrialStore.open(folder / "store")
    return [_outcome(each, chance) for each in store.campaign("lsl").recordings()]


def _outcome(recording: Recording, chance: random.Random) -> Outcome:
    clock = recording.clocks.streams.get("lab")
    if clock is None:
        return Outcome(0.0, 0.0, None)
    rows = recording.samples("lab")
    offset_ns = time.clock_gettime_ns(time.CLOCK_BOOTTIME) - time.monotonic_ns()
    # an event in whose reading the sender was stopped is not seen by the true clock
    sound = rows["after"] - rows["before"] < 2e-5
    error_us = ((rows["t"] + offset_ns) / 1e9 - (rows["before"] + rows["after"]) / 2) * 1e6
    error_us = error_us[sound] if sound.any() else error_us
    bound = None if clock.uncertainty_ns is None else clock.uncertainty_ns / 1e3
    event = float(error_us[chance.randrange(len(error_us))])
    return Outcome(event, float(np.abs(error_us).max()), bound)


def available() -> bool:
    """Return whether there is a compiler, and pylsl."""
    from importlib.util import find_spec

    return shutil.which("gcc") is not None and find_spec("pylsl") is not None
