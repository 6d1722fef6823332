"""Clock fits on bad pulse trains, beside the ways in which labs fit clocks today.

A train: 20 to 60 s of the code at 100, 50 or 20 ticks a second; clocks up to a day apart that
differ by up to 200 ppm; 5 us of jitter, up to 20 % of the pulses missing, 5 % reported twice, 5 %
spurious, 5 % late by up to 2 ms; stamps cut to whole microseconds. The error of a fit is the
largest that its map makes anywhere in the train, `coverage_95` the share of trains in which it is
within the stated uncertainty.

`wrong_accepted` counts accepted maps that are wrong by over 100 us, and fits accepted of what must
be refused: a train without a code, another stretch of the code, a clock that jumps by whole ticks
half-way. More kinds of trains: `benchmarks/clock_kinds.py`.

Beside it, on the same trains: pulses paired by their index and least squares; the nearest pulse
after the best lag of a cross-correlation, and scipy's soft-L1 regression; and the clock regression
of pyxdf (Huber loss by ADMM), which reads LSL's recordings, given the pairs that ours found, for it
pairs nothing itself.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from statistics import median

import numpy as np
from pyxdf.pyxdf import _robust_fit
from scipy import fft, optimize

from benchmarks.measure import SEED, Figures, spread
from sliplab.analysis.clocks.clocks import ClockFit, ClockRefused, fit_clock
from sliplab.rigs.core.pulse_code import SEEDS, U8, code_bits
from sliplab.storage.streams import F64, I64

DAY_NS = 86_400 * 10**9
WRONG_US = 100.0
"""A map that is wrong by more than this must not have been accepted."""
DRIFT_PPM = 400.0
"""Largest frequency difference of two crystals."""


@dataclass(frozen=True)
class StampTrain:
    """Stamps of a device, reports of the box, and true times of pulses on the device's clock.

    Attributes:
        device, reference: stamps, ns.
        true, sent: of every pulse the true time on the device's clock and that on the box's, ns.
    """

    device: I64
    reference: I64
    true: I64
    sent: I64
    tick_ns: int


Line = Callable[[I64], F64]


def measure(trains: int = 1000) -> Figures:
    """Errors, refusals and times over seeded trains, each fitted by all methods in turn."""
    rng = np.random.default_rng(SEED)
    first = make_train(rng)
    _by_ours(first), by_index(first), by_nearest(first)  # what happens once, happens untimed
    errors: dict[str, list[float]] = {"": [], "index_": [], "nearest_": [], "pyxdf_": []}
    times: dict[str, list[float]] = {name: [] for name in errors}
    accepted = wrong = covered = 0
    for _ in range(trains):
        made = make_train(rng)
        started = time.perf_counter()
        fit = _by_ours(made)
        times[""].append((time.perf_counter() - started) * 1e3)
        if fit is not None:
            error = float(np.abs(fit.map.to_reference(made.true) - made.sent).max())
            errors[""].append(error * 1e-3)
            accepted += 1
            covered += error <= fit.uncertainty_ns
            wrong += error * 1e-3 > WRONG_US
        rivals: dict[str, Callable[[], Line]] = {
            "index_": lambda made=made: by_index(made),  # type: ignore[misc]
            "nearest_": lambda made=made: by_nearest(made),  # type: ignore[misc]
        }
        if fit is not None:
            rivals["pyxdf_"] = lambda made=made, fit=fit: by_pyxdf(made, fit)  # type: ignore[misc]
        for name, method in rivals.items():
            started = time.perf_counter()
            line = method()
            times[name].append((time.perf_counter() - started) * 1e3)
            far = np.abs(line(made.true) - (made.reference - made.reference[0])).max()
            errors[name].append(float(far) * 1e-3)
        wrong += sum(_is_accepted(device, reference) for device, reference in _hopeless(rng, made))
    figures: Figures = {
        "trains": float(trains),
        "accepted_share": accepted / trains,
        "wrong_accepted": float(wrong),
        "coverage_95": covered / accepted if accepted else 0.0,
    }
    for name, values in errors.items():
        figures[f"{name}worst_error_us"] = max(values) if values else float("inf")
        figures[f"{name}median_error_us"] = median(values) if values else float("inf")
        figures |= spread(f"{name}fit_ms", times[name])
    return figures


def make_train(
    rng: np.random.Generator,
    clock: Callable[[F64, int], F64] | None = None,
    missing: float | None = None,
    seconds: float | None = None,
    tick: int | None = None,
    code: Callable[[int, int], U8] = code_bits,
) -> StampTrain:
    """A train with all its faults.

    Args:
        clock: what the device's clock is ahead by, ns, at times since the train began, for a tick.
        missing: share of the pulses that the device does not report; up to a fifth by default.
        seconds, tick: how long the train is, and a tick of it in ns; drawn by default.
        code: gives the bits from a seed and how many.
    """
    if seconds is None or tick is None:
        seconds, tick = float(rng.uniform(20, 60)), int(rng.choice([10, 20, 50])) * 1_000_000
    bits = code(int(rng.integers(1, SEEDS)), int(seconds * 1e9 / tick))
    sent = np.flatnonzero(bits).astype(np.int64) * tick
    offset, start = int(rng.integers(-DAY_NS, DAY_NS)), int(rng.integers(0, 10**12))
    true = np.round(sent / (1 + rng.uniform(-200, 200) * 1e-6)).astype(np.int64) + offset
    if clock is not None:
        true += np.rint(clock(sent.astype(np.float64), tick)).astype(np.int64)
    seen = true + np.round(rng.normal(0, 5_000, true.size)).astype(np.int64)
    late = rng.random(seen.size) < 0.05
    seen[late] += rng.integers(0, 2_000_000, int(late.sum()))
    seen = seen[rng.random(seen.size) >= (rng.uniform(0, 0.2) if missing is None else missing)]
    again = seen[rng.random(seen.size) < 0.05]
    stray = rng.integers(true[0], true[-1], int(0.05 * seen.size))
    seen = np.concatenate((seen, again + rng.integers(0, 100_000, again.size), stray))
    return StampTrain(np.sort(seen) // 1000 * 1000, sent + start, true, sent + start, tick)


def _hopeless(rng: np.random.Generator, made: StampTrain) -> list[tuple[I64, I64]]:
    """Device and reference trains that do not belong together."""
    ticks = int((made.reference[-1] - made.reference[0]) // made.tick_ns)
    bits = code_bits(int(rng.integers(1, SEEDS)), 4 * ticks)
    one, other = (
        np.flatnonzero(bits[a : a + ticks]).astype(np.int64) * made.tick_ns for a in (0, 3 * ticks)
    )
    regular = np.arange(made.reference[0], made.reference[-1], 2 * made.tick_ns)
    jumped = made.device.copy()
    jumped[jumped.size // 2 :] += int(rng.integers(1, 20)) * made.tick_ns
    return [(one, other), (regular + 7, regular), (jumped, made.reference)]


def _by_ours(made: StampTrain) -> ClockFit | None:
    try:
        return fit_clock(made.device, made.reference, max_drift_ppm=DRIFT_PPM)
    except ClockRefused:
        return None


def by_index(made: StampTrain) -> Line:
    """The first pulse belongs to the first, the second to the second; least squares."""
    count = min(made.device.size, made.reference.size)
    origin = int(made.device[0])
    x = (made.device[:count] - origin).astype(np.float64)
    y = (made.reference[:count] - made.reference[0]).astype(np.float64)
    drift, level = np.polyfit(x, y - x, 1)
    return _line(origin, float(drift), float(level))


def by_nearest(made: StampTrain) -> Line:
    """The best lag of both trains in bins of a tenth of a tick, nearest neighbours, soft L1."""
    width = made.tick_ns // 10
    origin = int(made.device[0])
    x, y = made.device - origin, made.reference - made.reference[0]
    size = fft.next_fast_len(int(x[-1] // width + y[-1] // width) + 2, real=True)
    spectra = []
    for times in (x, y):
        bins = np.zeros(size)
        bins[times // width] = 1.0
        spectra.append(fft.rfft(bins))
    score = fft.irfft(spectra[1] * np.conj(spectra[0]), size)
    best = int(score.argmax())
    lag = (best if best <= y[-1] // width else best - size) * width
    right = np.clip(np.searchsorted(y, x + lag), 1, y.size - 1)
    left_nearer = x + lag - y[right - 1] < y[right] - x - lag
    nearest = np.where(left_nearer, right - 1, right)
    near = np.abs(y[nearest] - x - lag) < made.tick_ns / 2
    px, py = x[near] * 1e-9, (y[nearest[near]] - x[near]) * 1e-3
    found = optimize.least_squares(
        lambda line: line[0] * px + line[1] - py,
        (0.0, float(np.median(py))),
        loss="soft_l1",
        f_scale=10.0,
    )
    return _line(origin, float(found.x[0]) * 1e-6, float(found.x[1]) * 1e3)


def by_pyxdf(made: StampTrain, fit: ClockFit) -> Line:
    """pyxdf's regression on the pairs that ours found, late ones too; times in seconds as there."""
    mapped = fit.map.to_reference(made.device)
    nearest = np.clip(np.searchsorted(made.reference, mapped), 1, made.reference.size - 1)
    before = mapped - made.reference[nearest - 1] < made.reference[nearest] - mapped
    partner = made.reference[np.where(before, nearest - 1, nearest)]
    paired = np.abs(partner - mapped) < made.tick_ns / 4
    origin = int(made.device[0])
    x = (made.device[paired] - origin) * 1e-9
    y = (partner[paired] - made.reference[0]) * 1e-9 - x
    level, drift = _robust_fit(np.column_stack([np.ones(x.size), x]), y)
    return _line(origin, float(drift), float(level) * 1e9)


def _line(origin: int, drift: float, level_ns: float) -> Line:
    """Device times to reference times since its first pulse, ns."""

    def mapped(times: I64) -> F64:
        since = times - origin
        result: F64 = since + drift * since + level_ns
        return result

    return mapped


def _is_accepted(device: I64, reference: I64) -> bool:
    try:
        fit_clock(device, reference, max_drift_ppm=DRIFT_PPM)
    except ClockRefused:
        return False
    return True
