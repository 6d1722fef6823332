"""`sliplab record`: how far LSL times are off, what a kill costs, and what a long recording needs.

`lsl`: recordings of a stream whose sender's clock drifts by 100 ppm and jumps in every second one;
an event of each, by the true clock, against the stated bound. `load`: simulated sources in real
time, 5 M events/s in 1 s of each 10, two cameras at 100 frames/s and 20 channels at 1 kHz. An hour,
about 12 GB: `python -m benchmarks record --size lsl=0 --size seconds=3600`.
"""

from __future__ import annotations

import resource
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

from benchmarks.measure import SEED, Figures, resident_mb
from sliplab.plugins.record.recorder import RecordedTrial, record
from sliplab.plugins.record.sources import push
from sliplab.storage.trials.store import TrialStore
from sliplab.storage.trials.verify import verify_trial
from tests.plugins.record.lsl_clocks import recordings

EVENTS_PX, FRAMES_PX = (640, 480), (320, 240)
BURST_RATE, REST_RATE, BURST_S, PERIOD_S = 5_000_000, 100_000, 1.0, 10.0
FRAME_HZ, CHANNELS, CHANNEL_HZ = 100, 20, 1000
STEP_S = 0.02
_PICTURES = 32


def measure(lsl: int = 200, seconds: float = 120.0) -> Figures:
    """Figures of some LSL recordings, and of a load for some seconds."""
    with tempfile.TemporaryDirectory() as folder:
        figures = _lsl(Path(folder) / "lsl", lsl) if lsl else {}
        return figures | (_load(Path(folder) / "load", seconds) if seconds else {})


def _lsl(folder: Path, count: int) -> Figures:
    folder.mkdir()
    found = recordings(folder, count, SEED)
    bounds = [each.bound_us for each in found if each.bound_us is not None]
    known = [each for each in found if each.bound_us is not None]
    return {
        "lsl_recordings": len(found),
        "lsl_refused": len(found) - len(known),
        "lsl_within_percent": 100.0 * sum(each.within for each in known) / len(known),
        "lsl_error_median_us": float(np.median([abs(each.event_us) for each in known])),
        "lsl_bound_median_us": float(np.median(bounds)),
        "lsl_bound_p95_us": float(np.percentile(bounds, 95)),
    }


class _Source:
    """Pushes rows at a rate in real time, in steps; counts them."""

    def __init__(self, trial: RecordedTrial, end: threading.Event) -> None:
        self._trial, self._end = trial, end
        self.pushed = {"events": 0, "left": 0, "right": 0, "channels": 0}
        self.late_s = 0.0
        rng = np.random.default_rng(SEED)
        most = round(BURST_RATE * STEP_S * 4)
        self._pixels = [rng.integers(0, n, most) for n in (*EVENTS_PX, 2)]
        # a smooth picture with the noise of a quarter of its pixels, which is stored without loss
        picture = np.linspace(40, 200, FRAMES_PX[0])[None] + np.zeros(FRAMES_PX[::-1])
        noise = rng.random((_PICTURES, *FRAMES_PX[::-1])) < 0.25
        self._frames_shown = (picture + noise).astype(np.uint8)

    def run(self) -> None:
        began = time.monotonic_ns()
        done = began
        while not self._end.wait(STEP_S):
            now = time.monotonic_ns()
            self._events(done, now, (now - began) / 1e9 % PERIOD_S < BURST_S)
            for name in ("left", "right"):
                self._frames(name, (now - began) * FRAME_HZ // 10**9, began)
            self._channels((now - began) * CHANNEL_HZ // 10**9, began)
            self.late_s = max(self.late_s, (time.monotonic_ns() - now) / 1e9)
            done = now

    def _events(self, start: int, end: int, burst: bool) -> None:
        count = round((BURST_RATE if burst else REST_RATE) * (end - start) / 1e9)
        for at in range(0, count, len(self._pixels[0])):
            part = min(count - at, len(self._pixels[0]))
            t_us = np.linspace(start // 1000, end // 1000, part, endpoint=False).astype(np.int64)
            self._trial.push("events", t_us, *(each[:part] for each in self._pixels))
            self.pushed["events"] += part
            start = end

    def _frames(self, name: str, due: int, began: int) -> None:
        for index in range(self.pushed[name], due):
            image = self._frames_shown[index % _PICTURES]
            self._trial.push(name, began + index * 10**9 // FRAME_HZ, image)
        self.pushed[name] = max(due, self.pushed[name])

    def _channels(self, due: int, began: int) -> None:
        count = due - self.pushed["channels"]
        t_ns = began + (self.pushed["channels"] + np.arange(count)) * (10**9 // CHANNEL_HZ)
        self._trial.push("channels", t_ns, *np.zeros((CHANNELS, count)))
        self.pushed["channels"] = due


def _load(folder: Path, seconds: float) -> Figures:
    names = {f"c{index}": "mV" for index in range(CHANNELS)}
    streams = [
        push("events", events_px=EVENTS_PX),
        push("left", frames_px=FRAMES_PX),
        push("right", frames_px=FRAMES_PX),
        push("channels", names),
    ]
    memory = []
    with record(streams, folder, "load", simulated=True) as recorder:
        with recorder.trial() as trial:
            end = threading.Event()
            source = _Source(trial, end)
            thread = threading.Thread(target=source.run)
            thread.start()
            began = time.monotonic()
            while time.monotonic() - began < seconds:
                end.wait(1.0)
                memory.append(resident_mb())
            end.set()
            thread.join()
        lost = sum(trial.lost().values())
    campaign = TrialStore.open(folder).campaign("load")
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    found = campaign.recording(trial.id)
    stored = {name: each.rows for name, each in found.record.streams.items()}
    stored["events"] = found.record.counts.events
    half = len(memory) // 2
    missing = sum(source.pushed.values()) - sum(stored[n] for n in source.pushed)
    return {
        "load_s": seconds,
        "load_events_m": source.pushed["events"] / 1e6,
        "load_frames": source.pushed["left"] + source.pushed["right"],
        "load_lost_rows": missing,
        "load_lost_unsaid": missing - lost,
        "load_memory_first_half_mb": max(memory[:half]),
        "load_memory_second_half_mb": max(memory[half:]),
        "load_memory_peak_mb": peak_mb,
        "load_source_late_ms": 1e3 * source.late_s,
        "load_mb": sum(path.stat().st_size for path in found.folder.iterdir()) / 1e6,
        "load_damaged": len(verify_trial(found.folder)),
    }
