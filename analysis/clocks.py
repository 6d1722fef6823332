"""The clock map of a device, from the coded pulses it saw, or a reason why there is none.

Camera, arm and sync box each stamp the same pulses with clocks that started on different days. The
pulses are coded, so the trains fit together at one place only; this file finds that place and then
a line through it. It must say no rather than be wrong: a regular train, which fits everywhere, is
refused, and so is one whose residuals are not jitter (docs/decisions/0002).

The way: cut a short piece out of the device's train, cross-correlate it with the reference (FFT)
under several drifts, and take the best lag; pair pulses by the windowed mode of their differences;
Theil-Sen line, then all pulses paired by that line, then Huber's M-estimate inside a gate. Times
stay int64; floats hold differences only.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from analysis.pulse_runs import stray_stretch
from analysis.robust_line import line_uncertainty, robust_line, theil_sen
from storage.clockmap import ClockMap

Reason = Literal["too_few_pulses", "ambiguous", "no_match", "drift", "residuals"]
Ints = NDArray[np.int64]
Floats = NDArray[np.float64]

MIN_PULSES = 24
"""Fewer than this may fit a 16-bit code in more than one place once some are lost."""
MAX_PEAK_RATIO = 0.9
"""Second correlation peak over the first: about 0.6 to 0.75 for the code, near 1 when regular."""
MIN_MATCHED = 0.7
"""Share of pulses that must find a partner; a wrong lag on the same tick grid gives 0.5."""

_PIECE_TICKS = 400
_PIECES = 5
_BINS_A_TICK = 4
_MAX_BINS = 1 << 22


class ClockRefused(ValueError):
    """No clock map can be trusted for these pulses.

    Attributes:
        reason: which gate said no: ``too_few_pulses``, ``ambiguous`` (the train fits in more than
            one place), ``no_match`` (it fits nowhere), ``drift`` or ``residuals``.
    """

    def __init__(self, reason: Reason, message: str) -> None:
        super().__init__(message)
        self.reason: Reason = reason


@dataclass(frozen=True)
class ClockFit:
    """A clock map with what is known about its quality.

    Attributes:
        map: device ns to reference ns.
        pulses_seen: pulses on which the line stands.
        pulses_late: pulses that found a partner but lie outside the gate; not in the line.
        pulses_missed: reference pulses inside the device's train that found no partner.
        pulses_spurious: device pulses without a partner (a second report of a pulse is one).
        residual_median_ns, residual_p95_ns, residual_max_ns: absolute residuals of the pulses seen.
        drift_ppm: what the reference gains on the device.
        uncertainty_ns: the map's largest error between the first and the last pulse seen, 95 %:
            from the residuals, plus half the stamps' resolution, plus what the residuals bend away
            from a line. A delay that all pulses share cannot be seen and is not in it.
        peak_ratio: second correlation peak over the first, 0 to 1; low is unambiguous.
    """

    map: ClockMap
    pulses_seen: int
    pulses_late: int
    pulses_missed: int
    pulses_spurious: int
    residual_median_ns: float
    residual_p95_ns: float
    residual_max_ns: float
    drift_ppm: float
    uncertainty_ns: float
    peak_ratio: float


def fit_clock(
    device_ns: Ints,
    reference_ns: Ints,
    *,
    jitter_ns: float = 20_000.0,
    max_drift_ppm: float = 10_000.0,
    resolution_ns: float = 1_000.0,
    in_order: bool = False,
) -> ClockFit:
    """The line from a device's clock to the reference, from pulses that both saw.

    Args:
        device_ns: (m,) int64, the pulses on the device's clock, ns. Pulses may be missing, doubled,
            late, spurious, out of order.
        reference_ns: (n,) int64, the pulses on the reference clock, ns; may have gaps too.
        jitter_ns: the scatter (1 sigma) to be expected of the device's stamps. Residuals whose
            95th percentile exceeds three times this are refused.
        max_drift_ppm: clocks that differ by more are refused.
        resolution_ns: the unit to which the device cuts its stamps. A cut that all pulses share
            moves the line unseen, so half of it is added to the uncertainty.
        in_order: the stamps stand in the order in which the pulses came, so that a clock that
            jumps back is seen to do so. It must be known: once they are sorted, such a train looks
            like one that began earlier than the reference and ended earlier.

    Raises:
        ClockRefused: with its `reason`.
        TypeError: the times are not integers.
        ValueError: the times are not 1-D, or a limit is not positive.
    """
    if not (jitter_ns > 0 and resolution_ns >= 0 and 0 < max_drift_ppm <= 50_000):
        raise ValueError(
            f"jitter_ns = {jitter_ns} and resolution_ns = {resolution_ns} must be positive, "
            f"max_drift_ppm = {max_drift_ppm} in (0, 50000]"
        )
    device, reference = _train(device_ns, "device"), _train(reference_ns, "reference")
    if in_order:
        for name, times in (("device", device_ns), ("reference", reference_ns)):
            back_ns = -int(np.diff(np.asarray(times)).min(initial=0))
            if back_ns > jitter_ns:
                raise ClockRefused("residuals", f"the {name} clock jumps back by {back_ns / 1e9} s")
    tick = _tick(reference)
    if jitter_ns > tick / 4:
        raise ValueError(f"jitter_ns = {jitter_ns}: pulses {tick} ns apart cannot be told apart")
    # differences to a pulse of each train; float64 holds them exactly up to 104 days
    device_0, reference_0 = int(device[device.size // 2]), int(reference[reference.size // 2])
    x, y = _differences(device, device_0), _differences(reference, reference_0)

    lag, drift, centre, piece, peak_ratio = _coarse(x, y, tick, max_drift_ppm * 1e-6)
    slope, level = _first_line(x[piece], y, centre, lag, drift, tick)
    # the piece's line is good to some 10 us at the far ends; a quarter tick leaves room for bends
    pairs = _pair(x, y, (x - centre) * (1 + slope) + centre + level, tick / 4)
    _gate_share(x, y, pairs, slope, centre, level)

    px, py = x[pairs[0]], y[pairs[1]]
    x_mid = float(np.round(px.mean()))
    line = robust_line(px - x_mid, py - px)
    slope, level = line.slope, line.level
    if abs(slope) > max_drift_ppm * 1e-6:
        raise ClockRefused(
            "drift", f"the clocks differ by {slope * 1e6:.1f} ppm, more than {max_drift_ppm:g}"
        )
    residuals = np.abs(line.residuals[line.inside])
    p95 = float(np.quantile(residuals, 0.95))
    if p95 > 3 * jitter_ns or line.inside.mean() < MIN_MATCHED:
        raise ClockRefused(
            "residuals",
            f"95 % of the pulses lie within {p95 / 1e3:.1f} us of the line (at most "
            f"{3 * jitter_ns / 1e3:.1f} are allowed) and {line.inside.mean():.0%} inside the gate",
        )
    stray = stray_stretch(
        (x - x_mid) * (1 + slope) + x_mid + level, y,
        pairs[0][line.inside], pairs[1][line.inside], 5 * line.sigma,
    )  # fmt: skip
    if stray is not None:
        raise ClockRefused("residuals", f"{stray}: a clock jumped, or began to drift otherwise")
    in_span = (y >= py.min()) & (y <= py.max())
    return ClockFit(
        map=ClockMap(
            device_0 + int(x_mid),
            reference_0 + int(x_mid) + round(level),
            round(slope * 1e9),
        ),
        pulses_seen=int(line.inside.sum()),
        pulses_late=int(px.size - line.inside.sum()),
        pulses_missed=int(in_span.sum()) - px.size,
        pulses_spurious=x.size - px.size,
        residual_median_ns=float(np.median(residuals)),
        residual_p95_ns=p95,
        residual_max_ns=float(residuals.max()),
        drift_ppm=slope * 1e6,
        uncertainty_ns=line_uncertainty(px - x_mid, line) + resolution_ns / 2,
        peak_ratio=peak_ratio,
    )


def _train(times: Ints, name: str) -> Ints:
    array = np.asarray(times)
    if array.dtype.kind not in "iu":
        raise TypeError(f"{name} pulse times must be int64 ns, not {array.dtype}")
    if array.ndim != 1:
        raise ValueError(f"{name} pulse times must be 1-D, not {array.shape}")
    if array.size < MIN_PULSES:
        raise ClockRefused(
            "too_few_pulses", f"{array.size} {name} pulses; at least {MIN_PULSES} are needed"
        )
    return np.sort(array.astype(np.int64))


def _differences(times: Ints, origin: int) -> Floats:
    """Float differences to `origin`; a stray stamp too far away to be subtracted is left out."""
    near = (times >= max(origin - 2**52, -(2**63))) & (times <= min(origin + 2**52, 2**63 - 1))
    kept: Floats = (times[near] - origin).astype(np.float64)
    return kept


def _tick(reference: Ints) -> float:
    """The grid on which pulses come: the shortest common interval between pulses, ns."""
    steps = np.diff(reference)
    tick = float(np.quantile(steps[steps > 0], 0.1)) if (steps > 0).any() else 0.0
    if tick < 1_000:
        raise ClockRefused("no_match", f"reference pulses {tick:.0f} ns apart are no pulse train")
    return tick


def _coarse(
    x: Floats, y: Floats, tick: float, max_drift: float
) -> tuple[float, float, float, NDArray[np.bool_], float]:
    """Where a piece of the train `x` fits into `y`.

    Returns:
        lag (ns, of the piece's centre), drift, the centre (ns), the piece (mask on x), and the
        ratio of the second correlation peak to the first.
    """
    width = tick / _BINS_A_TICK
    y_start = y[0]
    if y[-1] - y_start > _MAX_BINS * width:
        raise ClockRefused(
            "no_match", "the reference pulses span hours: stray stamps, or many trials"
        )
    y_bins = np.zeros(int((y[-1] - y_start) / width) + 1)
    y_bins[((y - y_start) / width).astype(np.int64)] = 1.0

    length = _PIECE_TICKS * tick
    best: tuple[float, float, float, NDArray[np.bool_], float] | None = None
    # by rank, not by time: a stray stamp far away must not decide where the pieces lie
    for rank in _spread(_PIECES):
        centre = float(x[int(rank * (x.size - 1))])
        piece = np.abs(x - centre) <= length / 2
        if piece.sum() < MIN_PULSES:
            continue
        centre = float(x[piece][0] + x[piece][-1]) / 2
        found = _correlate(x[piece] - centre, y_bins, width, max_drift)
        candidate = (found[0] + y_start - centre, found[1], centre, piece, found[2])
        if best is None or found[2] < best[4]:
            best = candidate
        if found[2] < 0.8:
            break
    if best is None:
        raise ClockRefused(
            "too_few_pulses", f"no stretch of {length / 1e9:.1f} s holds {MIN_PULSES} pulses"
        )
    if best[4] > MAX_PEAK_RATIO:
        raise ClockRefused(
            "ambiguous",
            f"the train fits in more than one place: second peak {best[4]:.3f} of the first "
            f"(at most {MAX_PEAK_RATIO}); a regular train, or not these pulses",
        )
    return best


def _spread(count: int) -> list[float]:
    """Places in 0..1, the middle first."""
    return sorted(((i + 0.5) / count for i in range(count)), key=lambda place: abs(place - 0.5))


def _correlate(
    piece: Floats, y_bins: Floats, width: float, max_drift: float
) -> tuple[float, float, float]:
    """Best (lag of the piece's centre from bin 0 in ns, drift, peak ratio)."""
    half = max(-float(piece[0]), float(piece[-1])) * (1 + max_drift)
    bins = 2 * int(half / width + 1) + 1
    size = int(fft.next_fast_len(y_bins.size + bins + 2, real=True))
    spectrum = fft.rfft(y_bins, size)
    # one step of drift moves the piece's ends by a bin
    steps = int(np.ceil(max_drift * half / width))
    drifts = np.linspace(-max_drift, max_drift, 2 * steps + 1) if steps else np.zeros(1)
    scores = np.zeros(size)
    best = np.zeros(size, np.int64)
    for row, drift in enumerate(drifts):
        comb = np.zeros(bins + 2)
        places = np.unique(np.round(piece * (1 + drift) / width).astype(np.int64) + bins // 2 + 1)
        # a pulse may fall on either side of an edge: let it count in the neighbours too
        np.add.at(comb, places, 1.0)
        np.add.at(comb, places - 1, 0.5)
        np.add.at(comb, places + 1, 0.5)
        score = fft.irfft(spectrum * np.conj(fft.rfft(comb, size)), size)
        best[score > scores] = row
        np.maximum(scores, score, out=scores)
    column = int(scores.argmax())
    first = float(scores[column])
    # round the train's end a lag is negative
    lag_bins = column if column < y_bins.size else column - size
    away = np.abs(np.arange(size) - column)
    away = np.minimum(away, size - away)
    second = float(scores[away > 0.6 * _BINS_A_TICK].max())
    lag = (lag_bins + bins // 2 + 1 + 0.5) * width
    return lag, float(drifts[best[column]]), second / first if first > 0 else 1.0


def _first_line(
    x: Floats, y: Floats, centre: float, lag: float, drift: float, tick: float
) -> tuple[float, float]:
    """A line through the piece: pairs by the windowed mode of their differences, Theil-Sen."""
    u = x - centre
    predicted = u * (1 + drift) + centre + lag
    low = np.searchsorted(y, predicted - tick)
    high = np.searchsorted(y, predicted + tick)
    counts = high - low
    which = np.repeat(np.arange(x.size), counts)
    first = np.repeat(low - np.concatenate(([0], np.cumsum(counts)[:-1])), counts)
    partner = first + np.arange(which.size)
    difference = y[partner] - predicted[which]
    window = tick / 2
    ordered = np.sort(difference)
    held = np.searchsorted(ordered, ordered + window, side="right") - np.arange(ordered.size)
    start = ordered[int(held.argmax())] if ordered.size else 0.0
    chosen = (difference >= start) & (difference <= start + window)
    if chosen.sum() < MIN_PULSES // 2:
        raise ClockRefused("no_match", "the trains fit nowhere")
    uc = u[which[chosen]]
    slope, level = theil_sen(uc, y[partner[chosen]] - x[which[chosen]])
    return slope, level


def _pair(x: Floats, y: Floats, predicted: Floats, gate: float) -> tuple[Ints, Ints]:
    """Indices into x and y of pulses that are each other's nearest, closer than `gate`."""
    to_y = _nearest(y, predicted)
    order = np.argsort(predicted, kind="stable")
    back = order[_nearest(predicted[order], y)]
    i = np.flatnonzero((back[to_y] == np.arange(x.size)) & (np.abs(y[to_y] - predicted) <= gate))
    return i, to_y[i]


def _nearest(grid: Floats, values: Floats) -> Ints:
    right = np.clip(np.searchsorted(grid, values), 1, grid.size - 1)
    left = right - 1
    return np.where(values - grid[left] <= grid[right] - values, left, right).astype(np.int64)


def _gate_share(
    x: Floats, y: Floats, pairs: tuple[Ints, Ints], slope: float, centre: float, level: float
) -> None:
    """Refuse when, where the trains overlap, too few pulses of the shorter have a partner."""
    matched = int(pairs[0].size)
    predicted = (x - centre) * (1 + slope) + centre + level
    low, high = max(predicted.min(), y[0]), min(predicted.max(), y[-1])
    in_x = int(((predicted >= low) & (predicted <= high)).sum())
    in_y = int(((y >= low) & (y <= high)).sum())
    share = matched / max(1, min(in_x, in_y))
    if share < MIN_MATCHED:
        raise ClockRefused(
            "no_match",
            f"only {share:.0%} of the pulses have a partner (at least {MIN_MATCHED:.0%}); "
            f"{in_x} device and {in_y} reference pulses overlap",
        )
    if matched < MIN_PULSES:
        raise ClockRefused(
            "too_few_pulses", f"{matched} pulses found a partner; at least {MIN_PULSES} are needed"
        )
