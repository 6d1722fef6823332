"""Alignment of frames and forces with the arm: scale, rotation, distortion, delays.

A tip that slides steadily moves as its base does. The difference between both is the camera's: its
scale, its turn about its axis, pixels that are not square, a tilt, a lens. What a tip lags behind
its base grows with speed by a delay alone. Forces have a direction and a delay in the same way.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from sliplab.plugins.twin.contact_forces import relaxing
from sliplab.plugins.twin.contact_lags import VARIATION, Growth, SteadyLags
from sliplab.plugins.twin.contact_slips import SETTLES_S, SlideSlips, find_slips, mean_seen
from sliplab.plugins.twin.contact_tremor import STRENGTHENING, WEAK_MM_S
from sliplab.plugins.twin.pilot import PilotTrial
from sliplab.plugins.twin.rims import COLUMN, RADIUS, ROW
from sliplab.storage.streams import F64

DISC_REACH = 1.4
"""Events of a disc are counted up to here, in radii."""
LEAST_WAY_MM = 1.0
"""A tip's motion counts from a base's way of this length on, between the means of its two halves.
"""
NOISE_MM = 0.01
"""Assumed error of a tip's travel, for weights only: the arm's tremor."""
FEWEST_FRAMES = 20
RELAX_S = 1.5
"""Time with which lags are taken to grow after a slip."""
ROUNDS, OUTLIER = 6, 2.5
"""Of the reweighting of ways, and from how many deviations on one counts less."""


@dataclass(frozen=True)
class View:
    """Alignment of frames with the arm's motion; all numbers are 0 for an aligned camera.

    Attributes:
        scale: of displacements in frames over those of the arm, less 1.
        turn_deg: of the picture, counterclockwise.
        stretch: difference of scale between two directions at right angles.
        distortion: radial displacement at the outermost marker over its distance from the middle.
        perspective: difference of scale across the distance of the outermost marker.
    """

    scale: float = float("nan")
    turn_deg: float = float("nan")
    stretch: float = float("nan")
    distortion: float = float("nan")
    perspective: float = float("nan")


def view_of(slips: SlideSlips) -> View:
    """Return the alignment of some slides' frames with the arm; NaN where not observable."""
    ways = [row for i in range(len(slips.trials)) for row in _ways(slips, i)]
    if len(ways) < 12:
        return View()
    base, seen, first, last = (np.array([way[k] for way in ways]) for k in range(4))
    lag = np.array([way[4] for way in ways])
    left = np.array([way[5] for way in ways])
    reach = float(max(np.hypot(*first.T).max(), np.hypot(*last.T).max()))
    ahead = base / np.hypot(*base.T)[:, None]
    x, y = last / reach, first / reach
    columns = [
        base,
        base[:, ::-1] * [-1.0, 1.0],
        base * [1.0, -1.0],
        base[:, ::-1],
        reach * (_cubic(x) - _cubic(y)),
        *(reach * (x * x[:, [k]] - y * y[:, [k]]) for k in (0, 1)),
        # what still relaxes is in proportion to the lag
        -ahead * (lag * left)[:, None],
    ]
    error = np.stack([np.hypot(VARIATION * lag, NOISE_MM), np.full(len(lag), NOISE_MM)], axis=1)
    # along the way and across it
    axes = np.stack([ahead, ahead[:, ::-1] * [-1.0, 1.0]], axis=1)
    rows = np.einsum("nab,nbc->nac", axes, np.stack(columns, axis=2)).reshape(-1, len(columns))
    right = np.einsum("nab,nb->na", axes, seen - base).ravel()
    found = _robust(rows, right, error.ravel())
    return View(
        float(found[0]),
        float(np.degrees(found[1])),
        float(2.0 * np.hypot(*found[2:4])),
        float(found[4]),
        float(np.hypot(*found[5:7])),
    )


def _ways(slips: SlideSlips, i: int) -> Iterator[tuple[F64, F64, F64, F64, float, float]]:
    """Yield what each sliding tip of a slide goes between the middles of its way's two halves.

    Yields:
        ways of the base and of the tip, mm; the tip's places there; its mean lag, mm; and the share
        of what relaxes that did so in between.
    """
    trial = slips.trials[i]
    moving = (trial.frame_s >= 0.0) & (trial.frame_s <= trial.slide_s)
    tips, base, t = trial.tips_mm[moving], trial.base_mm[moving], slips.frame_s[i]
    for j in np.flatnonzero(slips.slid[i]):
        since = t - slips.slipped_s[i, j]
        use = np.flatnonzero((since > SETTLES_S) & np.isfinite(tips[:, j, 0]))
        if len(use) < FEWEST_FRAMES:
            continue
        a, b = use[: len(use) // 2], use[len(use) // 2 :]
        way = base[b].mean(axis=0) - base[a].mean(axis=0)
        if np.hypot(*way) < LEAST_WAY_MM:
            continue
        first, last = tips[a, j].mean(axis=0), tips[b, j].mean(axis=0)
        lag, left = float(slips.lag_mm[i][use, j].mean()), np.exp(-since / RELAX_S)
        relaxed = float(left[a].mean() - left[b].mean())
        yield way, last - first, first, last, abs(lag), relaxed


def _cubic(place: F64) -> F64:
    return place * (place**2).sum(axis=1, keepdims=True)


def _robust(design: F64, right: F64, error: F64) -> F64:
    """Return the least-squares solution in which outliers count less (Huber's weights)."""
    weight = 1.0 / error
    best: F64 = np.zeros(design.shape[1])
    for _ in range(ROUNDS):
        found = np.linalg.lstsq(design * weight[:, None], right * weight, rcond=1e-9)[0]
        best = np.asarray(found, np.float64)
        off = np.abs(right - design @ best) / error
        usual = max(1.4826 * float(np.median(off)), 1e-9)
        weight = np.sqrt(np.minimum(1.0, OUTLIER * usual / np.maximum(off, 1e-12))) / error
    return best


def frame_delay_ms(slips: SlideSlips, steady: SteadyLags) -> float:
    """Return how late frames are against the arm's poses, ms; NaN with one speed alone.

    A delay adds to a lag in proportion to the speed, the same to that of every papilla. Friction
    that drifts through the slides or rises with speed changes a lag in proportion to itself.
    """
    lag = np.where(slips.free, np.nan, steady.lag_mm)
    lag = lag / (1.0 + STRENGTHENING * np.log1p(slips.speed_mm_s / WEAK_MM_S))[:, None]
    off, mean = _off_their_depth(slips, lag)
    speed = np.broadcast_to(slips.speed_mm_s[:, None], lag.shape)
    order = np.broadcast_to(np.arange(len(lag))[:, None] / len(lag), lag.shape)
    known = np.isfinite(off)
    if known.sum() < 12 or np.ptp(slips.speed_mm_s) < 0.05:
        return float("nan")
    rows = [
        _off_their_depth(slips, np.where(known, column, np.nan))[0]
        for column in (speed, mean * order)
    ]
    design = np.column_stack([row[known] for row in rows])
    error = np.hypot(0.4 * VARIATION * mean, NOISE_MM)[known]
    return 1e3 * float(_robust(design, off[known], error)[0])


def _off_their_depth(slips: SlideSlips, values: F64) -> tuple[F64, F64]:
    """Return values (k, m) less the mean of the slides of one depth, and that mean, (k, m)."""
    _, which = slips.depths
    mean = np.full(values.shape, np.nan)
    for level in np.unique(which):
        mean[which == level] = mean_seen(values[which == level])
    return values - mean, mean


NEAR_S = (0.04, 0.02, 0.01)
"""Events are counted so long before and after a slip, and in as long a time on either side: first
widely, to find a large delay, and then closely, where tremor moves a tip less."""


def event_delay_ms(trials: Sequence[PilotTrial], rests: F64 | None) -> float:
    """Return how late slips are in events against those in frames, ms; NaN without either.

    A papilla is bent until its tip slips, and not further: the events of its marker end then.

    Args:
        rests: markers in the event camera's picture, see `camera_estimates`.
    """
    slips = find_slips(trials)
    if slips is None or rests is None:
        return float("nan")
    late_s = 0.0
    for near_s in NEAR_S:
        counts = [
            row for i in range(len(slips.trials)) for row in _near(slips, i, rests, late_s, near_s)
        ]
        before, between, after = np.array(counts, np.float64).reshape(-1, 3).sum(axis=0)
        if before <= after:
            return float("nan")
        late_s += near_s * float((between - before - after) / (before - after))
    return 1e3 * late_s


def _near(
    slips: SlideSlips, i: int, rests: F64, late_s: float, near_s: float
) -> Iterator[tuple[int, ...]]:
    """Yield events of each marker before, about and after `late_s` from its slip in a slide."""
    trial = slips.trials[i]
    if trial.camera is None:
        return
    events = trial.camera.events
    for j in np.flatnonzero(slips.slid[i] & np.isfinite(rests[:, RADIUS])):
        edges = slips.slipped_s[i, j] + late_s + near_s * np.array([-2.0, -1.0, 1.0, 2.0])
        if edges[0] < 0.0 or edges[-1] > trial.slide_s:
            continue
        column, row, radius = rests[j, [COLUMN, ROW, RADIUS]]
        first, *ends = np.searchsorted(events.t_us, edges * 1e6).tolist()
        part = slice(first, ends[-1])
        inside = np.hypot(events.x[part] - column, events.y[part] - row) < DISC_REACH * radius
        yield tuple(int(inside[a - first : b - first].sum()) for a, b in pairwise([first, *ends]))


def force_delay_ms(slips: SlideSlips, growth: Growth) -> float:
    """Return how late forces are against the arm's poses, ms; NaN without a force sensor.

    While all tips stick, the force along the slide follows the base's travel and its relaxation.
    """
    late, weight = [], []
    for i, trial in enumerate(slips.trials):
        slid = slips.slipped_s[i][slips.slid[i]]
        frame_s = slips.frame_s[i]
        if trial.forces is None or not len(slid) or len(frame_s) < 10:
            continue
        t = trial.forces.t_s
        until = 0.9 * float(slid.min())
        rows, before = (t > 0.02) & (t < until), (t >= -0.2) & (t < 0.0)
        if rows.sum() < 50 or not before.any():
            continue
        pull = trial.forces.force_n[:, :2] @ slips.direction[i]
        moving = (trial.frame_s >= 0.0) & (trial.frame_s <= trial.slide_s)
        way = trial.base_mm[moving] @ slips.direction[i]
        stretch = relaxing(way[:, None], frame_s, growth)[:, 0]
        model = np.column_stack(
            [
                np.interp(t[rows], frame_s, column)
                for column in (stretch, -np.gradient(stretch, frame_s))
            ]
        )
        right = pull[rows] - pull[before].mean()
        stiffness, product = np.linalg.lstsq(model, right, rcond=1e-9)[0]
        if stiffness > 0.0:
            late.append(1e3 * product / stiffness)
            # the arm's tremor delays a fast and long stretch less
            weight.append(stretch[frame_s < until][-1] * slips.speed_mm_s[i])
    return float(np.average(late, weights=weight)) if len(late) >= 3 else float("nan")


def force_turn_deg(slips: SlideSlips) -> float:
    """Return the angle from the path to the forces in a slide's second half, degrees, else NaN."""
    found = []
    for (ahead, across), trial in zip(slips.direction, slips.trials, strict=True):
        if trial.forces is None:
            continue
        t = trial.forces.t_s
        last, before = (t >= 0.5 * trial.slide_s) & (t <= trial.slide_s), (t >= -0.2) & (t < 0.0)
        if not last.any() or not before.any():
            continue
        force = trial.forces.force_n[:, :2]
        x, y = force[last].mean(axis=0) - force[before].mean(axis=0)
        found.append(np.degrees(np.arctan2(y * ahead - x * across, x * ahead + y * across)))
    return float(np.mean(found)) if len(found) >= 3 else float("nan")
