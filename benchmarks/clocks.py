"""Clock fits on faulty pulse trains, beside the two ways in which trains are usually paired.

A train: 20 s of the code at 100 ticks a second, drift of up to 100 ppm, 5 us of jitter, 2 %
missing, 1 % reported twice, 2 % late by up to 5 ms, stamps cut to whole microseconds. The error of
a fit is the largest that its map makes anywhere in the train. `wrong_accepted` counts maps that are
wrong by over 100 us, and fits of trains that do not belong together: without a code, or of another
stretch of it. Every seed gives a stretch of the same 65,535 ticks; stretches that overlap do fit
where they overlap, so the other stretch is one that does not.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from statistics import median

import numpy as np
from scipy import fft

from analysis.clocks import ClockRefused, fit_clock
from benchmarks.measure import SEED, Figures, spread
from rigs.pulse_code import PERIOD, code_bits
from storage.streams import F64, I64

TICK_NS = 10_000_000
BIN_NS = 1_000_000
WRONG_US = 100.0
"""A map that is wrong by more than this must not have been accepted."""


@dataclass(frozen=True)
class Train:
    """What a device stamped, what the box sent, and when that really was on the device's clock."""

    device: I64
    reference: I64
    true: I64


Line = Callable[[I64], F64]


def measure(trains: int = 40, seconds: float = 20.0) -> Figures:
    """Errors, refusals and times over seeded trains, each fitted by all three methods in turn."""
    rng = np.random.default_rng(SEED)
    first = make_train(rng, 5.0, 1)
    for method in (fit_clock, by_index, by_correlation):  # what happens once, happens untimed
        method(first.device, first.reference)
    errors: dict[str, list[float]] = {"": [], "index_": [], "xcorr_": []}
    times: dict[str, list[float]] = {name: [] for name in errors}
    accepted = wrong = covered = 0
    for _ in range(trains):
        seed = int(rng.integers(1, PERIOD))
        made = make_train(rng, seconds, seed)
        started = time.perf_counter()
        try:
            fit = fit_clock(made.device, made.reference)
        except ClockRefused:
            fit = None
        times[""].append((time.perf_counter() - started) * 1e3)
        if fit is not None:
            mapped = fit.map.to_reference(made.true)
            error = float(np.abs(mapped - made.reference).max())
            errors[""].append(error * 1e-3)
            accepted += 1
            covered += error <= fit.uncertainty_ns
            wrong += error * 1e-3 > WRONG_US
        for name, method in (("index_", by_index), ("xcorr_", by_correlation)):
            started = time.perf_counter()
            line = method(made.device, made.reference)
            times[name].append((time.perf_counter() - started) * 1e3)
            far = np.abs(line(made.true) - (made.reference - made.reference[0])).max()
            errors[name].append(float(far) * 1e-3)
        # no map belongs to pulses without a code, nor to those of another stretch of the code
        ticks = int(seconds * 1e9 / TICK_NS)
        other = make_train(rng, seconds, seed, int(rng.integers(2 * ticks, PERIOD - 2 * ticks)))
        regular = np.arange(made.reference[0], made.reference[-1], 2 * TICK_NS)
        wrong += _is_accepted(made.device, other.reference) + _is_accepted(regular + 7, regular)
    figures: Figures = {
        "accepted_share": accepted / trains,
        "wrong_accepted": float(wrong),
        "coverage_95": covered / accepted if accepted else 0.0,
    }
    for name, values in errors.items():
        figures[f"{name}worst_error_us"] = max(values) if values else float("inf")
        figures[f"{name}median_error_us"] = median(values) if values else float("inf")
        figures |= spread(f"{name}fit_ms", times[name])
    return figures


def make_train(rng: np.random.Generator, seconds: float, seed: int, skip: int = 0) -> Train:
    """A train with all its faults, `skip` ticks into the code; its clocks began long ago."""
    bits = code_bits(seed, skip + int(seconds * 1e9 / TICK_NS))[skip:]
    sent = np.flatnonzero(bits).astype(np.int64) * TICK_NS
    offset, start = int(rng.integers(0, 10**18)), int(rng.integers(0, 10**12))
    true = np.round(sent / (1 + rng.uniform(-100, 100) * 1e-6)).astype(np.int64) + offset
    seen = true + np.round(rng.normal(0, 5_000, true.size)).astype(np.int64)
    late = rng.random(seen.size) < 0.02
    seen[late] += rng.integers(50_000, 5_000_000, int(late.sum()))
    seen = seen[rng.random(seen.size) >= 0.02]
    again = seen[rng.random(seen.size) < 0.01]
    seen = np.concatenate((seen, again + rng.integers(0, 50_000, again.size)))
    return Train(np.sort(seen) // 1000 * 1000, sent + start, true)


def by_index(device: I64, reference: I64) -> Line:
    """The first pulse belongs to the first, the second to the second; least squares."""
    count = min(device.size, reference.size)
    origin = int(device[0])
    return _line(device[:count] - origin, reference[:count] - reference[0], origin)


def by_correlation(device: I64, reference: I64) -> Line:
    """The best lag of both trains in bins of 1 ms, nearest neighbours, least squares."""
    origin = int(device[0])
    x, y = device - origin, reference - reference[0]
    size = fft.next_fast_len(int(x[-1] // BIN_NS + y[-1] // BIN_NS) + 2, real=True)
    spectra = []
    for times in (x, y):
        bins = np.zeros(size)
        bins[times // BIN_NS] = 1.0
        spectra.append(fft.rfft(bins))
    score = fft.irfft(spectra[1] * np.conj(spectra[0]), size)
    best = int(score.argmax())
    lag = (best if best <= y[-1] // BIN_NS else best - size) * BIN_NS
    right = np.clip(np.searchsorted(y, x + lag), 1, y.size - 1)
    left_nearer = x + lag - y[right - 1] < y[right] - x - lag
    nearest = np.where(left_nearer, right - 1, right)
    near = np.abs(y[nearest] - x - lag) < TICK_NS / 2
    return _line(x[near], y[nearest[near]], origin)


def _line(x: I64, y: I64, origin: int) -> Line:
    """Device times to reference times since its first pulse, ns; differences, so floats do."""
    drift, level = np.polyfit(x.astype(np.float64), (y - x).astype(np.float64), 1)

    def mapped(times: I64) -> F64:
        since = times - origin
        result: F64 = since + drift * since + level
        return result

    return mapped


def _is_accepted(device: I64, reference: I64) -> bool:
    try:
        fit_clock(device, reference)
    except ClockRefused:
        return False
    return True
