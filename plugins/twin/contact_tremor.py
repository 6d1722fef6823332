"""The arm's tremor, from the common motion of all sliding tips."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from sliplab.plugins.twin.contact_lags import LEAST_STRETCH_MM
from sliplab.plugins.twin.contact_slips import SETTLES_S, SlideSlips
from sliplab.storage.streams import F64

C128 = npt.NDArray[np.complex128]

BAND_HZ = (2.2, 10.0)
"""Band in which an arm's tremor is searched: friction along a path varies more slowly."""
TONES = 4
STRENGTHENING, WEAK_MM_S = 0.01, 0.1
"""Friction at the speed w is taken to grow by 0.01 ln(1 + w / 0.1 mm/s)."""
UNSURE = 0.4
"""A tone whose error is a larger share of its mean strength is left out of that slide."""
SAME_HZ = 0.07
"""Tones that are closer are one: slides take a dozen seconds."""


def tremor_estimates(slips: SlideSlips) -> dict[str, float]:
    """Return the largest amplitude of the arm's tremor over the slides, and its frequency.

    All sliding tips lag by it together; friction of their own averages out and is slow. Its tones
    are the same in all slides along one axis: they are found in all together, by orthogonal
    matching pursuit, and then fitted in each slide. A tone along the plate shows in the slides
    along one axis only; one of the depth, which changes the lags in proportion to friction, in all.
    """
    axis = np.abs(slips.direction[:, 0]) < np.abs(slips.direction[:, 1])
    found = []
    for side in (False, True):
        series = [common_lag(slips, i) for i in np.flatnonzero(axis == side).tolist()]
        known = [one for one in series if one is not None]
        if len(known) >= 3:
            tones, amplitude, error = _tones([(t, lag) for t, lag, _ in known])
            followed = np.array([follows for *_, follows in known])[:, None]
            turning = 2 * np.pi * tones * followed * STRENGTHENING
            averaged = np.sinc(tones * np.median(np.diff(known[0][0])))
            followed_mm = amplitude * np.hypot(1.0, turning) / averaged
            height = np.sqrt(np.mean(followed_mm**2, axis=0))
            found.append((tones, height, followed_mm, error < UNSURE * height))
    along: list[float] = []
    own_tones: list[float] = []
    power = weighted = 0.0
    for number, (tones, height, amplitude, sure) in enumerate(found):
        power += float(np.sum(height**2))
        weighted += float(np.sum(height**2 * np.log(tones)))
        others = [tone for k, one in enumerate(found) if k != number for tone in one[0].tolist()]
        own = [
            k
            for k in range(len(tones))
            if not any(abs(tones[k] - tone) < SAME_HZ for tone in others)
        ]
        if own:
            k = max(own, key=lambda k: height[k])
            along += amplitude[sure[:, k], k].tolist()
            own_tones.append(float(tones[k]))
    strength = [float(np.sqrt(np.sum(row**2))) for *_, amplitude, _ in found for row in amplitude]
    return {
        "tremor_mm": _largest(along),
        "tremor_along_mean_mm": float(np.mean(along)) if along else float("nan"),
        "tremor_all_mm": _largest(strength),
        "tremor_hz": float(np.exp(weighted / power)) if power > 0.0 else float("nan"),
        # one axis' tones alone are others than both axes'
        "tremor_along_hz": float(np.sqrt(np.prod(own_tones)))
        if len(own_tones) == 2
        else float("nan"),
    }


def _largest(values: Sequence[float]) -> float:
    """Mean of the four largest values; NaN without."""
    return float(np.mean(np.sort(values)[-4:])) if len(values) else float("nan")


def common_lag(slips: SlideSlips, i: int) -> tuple[F64, F64, float] | None:
    """Return times and mean lag of the tips that slide early in a slide, 25 a second, mm; and the
    mean lag over the speed, s.

    Small lags count more: friction of the tip itself has less part in them. Friction that rises
    with speed, d mu / mu = s dw / (w + weak), keeps a tip with the lag l from following the tremor:
    it follows by 1 / (1 + i omega s l / (w + weak)).
    """
    t, lag = slips.frame_s[i], slips.lag_mm[i]
    begins = np.sort(slips.slipped_s[i][np.isfinite(slips.slipped_s[i])])
    if len(begins) < 3:
        return None
    begin = begins[max(len(begins) // 3, 2)] + SETTLES_S
    use = np.flatnonzero(slips.slipped_s[i] < begin)
    rows = (t >= begin) & np.isfinite(lag[:, use]).all(axis=1)
    four = rows.sum() // 4 * 4
    if four < 100:
        return None
    seen = lag[rows][:four][:, use]
    weight = 1.0 / np.maximum(np.abs(seen.mean(axis=0)), LEAST_STRETCH_MM) ** 2
    common = (seen @ weight / weight.sum()).reshape(-1, 4).mean(axis=1)
    behind = float(np.mean(common)) / (slips.speed_mm_s[i] + WEAK_MM_S)
    return t[rows][:four].reshape(-1, 4).mean(axis=1), common, behind


def _tones(series: Sequence[tuple[F64, F64]]) -> tuple[F64, F64, F64]:
    """Return the frequencies of the tones that series have in common, (TONES,), and their
    amplitudes in each with standard errors, (len(series), TONES)."""
    grid = np.arange(*BAND_HZ, 0.03)
    waves = [_waves(t, grid) for t, _ in series]
    trends = [_legendre(t) for t, _ in series]
    tones: list[float] = []
    rest = [_without(values, trend)[0] for (_, values), trend in zip(series, trends, strict=True)]
    amplitude, error = np.zeros((2, len(series), TONES))
    for number in range(TONES):
        power = np.zeros(len(grid))
        for wave, r in zip(waves, rest, strict=True):
            power += np.abs(wave @ r) ** 2 / len(r)
        tones.append(_peak(grid, power))
        for row, ((t, values), trend) in enumerate(zip(series, trends, strict=True)):
            phase = 2 * np.pi * np.array(tones) * t[:, None]
            design = np.column_stack([trend, np.cos(phase), np.sin(phase)])
            rest[row], best = _without(values, design)
            pair = best[trend.shape[1] :].reshape(2, number + 1)
            amplitude[row, : number + 1] = np.hypot(*pair)
            if number == TONES - 1:
                spread = np.diag(np.linalg.pinv(design.T @ design))[trend.shape[1] :]
                free = max(len(t) - design.shape[1], 1)
                noise = np.sum(rest[row] ** 2) / free
                error[row] = np.sqrt(noise * spread.reshape(2, TONES).mean(axis=0))
    return np.array(tones), amplitude, error


def _peak(grid_hz: F64, power: F64) -> float:
    """Frequency of the largest power, by a parabola through it and its neighbours."""
    k = int(np.clip(np.argmax(power), 1, len(grid_hz) - 2))
    before, here, after = power[k - 1 : k + 2]
    bend = before - 2.0 * here + after
    shift = 0.5 * (before - after) / bend if bend < 0.0 else 0.0
    return float(grid_hz[k] + np.clip(shift, -0.5, 0.5) * (grid_hz[1] - grid_hz[0]))


def _waves(t_s: F64, grid_hz: F64) -> C128:
    """exp(-2 pi i f t) on an even grid of frequencies, (len(grid), n): each from the one before."""
    step = np.exp(-2j * np.pi * (grid_hz[1] - grid_hz[0]) * t_s)
    rows = np.tile(step, (len(grid_hz), 1))
    rows[0] = np.exp(-2j * np.pi * grid_hz[0] * t_s)
    result: C128 = np.multiply.accumulate(rows, axis=0)
    return result


def _legendre(t_s: F64) -> F64:
    """Polynomials that take the slow changes of a series out: a degree for each second, (n, k)."""
    span = t_s[-1] - t_s[0]
    degree = int(np.clip(2.0 * span, 3, 20))
    result: F64 = np.polynomial.legendre.legvander(2.0 * (t_s - t_s[0]) / span - 1.0, degree)
    return result


def _without(values: F64, design: F64) -> tuple[F64, F64]:
    best = np.asarray(np.linalg.lstsq(design, values, rcond=1e-6)[0], np.float64)
    return values - design @ best, best
