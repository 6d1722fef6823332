"""Raw estimates of an event camera's parameters from the slides of a pilot.

Each is near to one parameter of the camera, or to what of several can be seen together, and is
computed from events alone where that can be done. They need not be without bias: what simulated
worlds give is computed in the same way, and compared.

Log intensity has no absolute scale: contrast and threshold, and the threshold's mismatch, are
observed as ratios only. What a force does to the image is seen as a product with that force.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import pdist
from scipy.stats import poisson

from sliplab.analysis.labels.event_tracking import find_discs
from sliplab.plugins.twin.alignment import event_delay_ms
from sliplab.plugins.twin.event_times import (
    INTERVALS_US,
    ScanningReadout,
    count_intervals,
    dead_time_us,
    find_scans,
)
from sliplab.plugins.twin.pilot import Forces, PilotTrial
from sliplab.plugins.twin.rims import (
    COLUMN,
    CONTRAST,
    DOWN,
    EDGE,
    GROWN,
    HIDDEN,
    RADIUS,
    RIGHT,
    ROW,
    RimFit,
    first_moments,
    fit_rims,
)
from sliplab.plugins.twin.trends import plain_trend, shift_trend
from sliplab.storage.kernels import njit
from sliplab.storage.streams import F64, EventChunk

Mask = NDArray[np.bool_]

NAMES = (
    "px_per_mm",
    "marker_radius_mm",
    "image_shift_mm_per_n",
    "image_shift_px",
    "image_growth_mm_per_n",
    "image_growth_px_per_mm",
    "edge_px",
    "contrast_in_thresholds",
    "on_thresholds",
    "off_thresholds",
    "threshold_mismatch",
    "refractory_us",
    "noise_hz",
    "leak_share",
    "hot_pixels",
    "hot_hz",
    "readout_hz",
    "scan_us",
    "hold_events_per_s",
    "first_mm_events_per_mm",
    "last_mm_events_per_mm",
    "interval_us",
    "radius_step_px",
    "radius_scatter_px",
    "shift_scatter",
)
"""Of the estimates, with their units; all are positive, for their logarithms."""
FIRST_MM = 0.3
"""Travel of the sensor in which discs are searched: less than most need to slip."""
PHASE_MM = 1.0
SHORT_S = 0.1
"""Forces and tips before and after a motion are means over so long."""
CLEAR = 0.75
"""Pixels so far from all discs at rest see none in a slide either; of the least distance between
two discs."""
FIRST_REACH, REACH = 1.8, 1.3
"""Events of a disc are looked for up to here, in radii: from where it was at rest, and from its
way."""
FALSE_HOT = 0.01
"""Pixels that are called hot and are not, on average."""
SCANNED, SCANNED_EVENTS = 3, 20_000
"""Trials in which scans are searched, and the number of events of each."""
SHAPED = 6
"""Trials that the edge and the contrast are taken from."""
SWEPT = 3.0
"""Discs show their edge and the contrast where they moved by so many scales of an edge."""
_EDGE_PX, _CONTRAST = 0.8, 10.0
_FEWEST_FULL = 200


CONTRAST_TREND, NOISE_TREND, SHIFT_TREND, PICTURE_TURN, EVENT_DELAY = CHECKED = (
    "contrast_trend",
    "noise_trend",
    "shift_trend",
    "picture_turn_deg",
    "event_delay_ms",
)
"""Statistics of effects that no parameter of the camera causes."""


def camera_estimates(trials: Sequence[PilotTrial]) -> dict[str, float]:
    """Return estimates by name, see `NAMES`; NaN for those that are not identifiable.

    Trials without an event camera, or of another camera or skin than the first, are left out.
    """
    return read_camera(trials)[0]


def read_camera(trials: Sequence[PilotTrial]) -> tuple[dict[str, float], dict[str, float]]:
    """Return `camera_estimates`, and the numbers of `CHECKED`."""
    found, checked = dict.fromkeys(NAMES, np.nan), dict.fromkeys(CHECKED, np.nan)
    seen = [trial for trial in trials if trial.camera is not None and len(trial.camera.events)]
    if not seen:
        return found, checked
    size_px, markers = _size(seen[0]), seen[0].tips_mm.shape[1]
    seen = [t for t in seen if _size(t) == size_px and t.tips_mm.shape[1] == markers]
    rests = _rests(seen, size_px)
    noise = _noise(seen, rests, size_px)
    found.update(noise_hz=noise.rate_hz, leak_share=noise.leak_share)
    found.update(hot_pixels=float(noise.hot.sum()), hot_hz=noise.hot_hz)
    found.update(_times(seen, noise, size_px))
    found.update(_rates(seen))
    checked[NOISE_TREND] = _noise_trend(seen, _clear(rests, size_px) & ~noise.hot)
    if rests is not None:
        checked[EVENT_DELAY] = event_delay_ms(seen, rests)
        discs = _discs(seen, rests, noise, size_px)
        found.update({name: value for name, value in discs.items() if name in found})
        checked.update({name: value for name, value in discs.items() if name in checked})
    return {name: value if value > 0.0 else np.nan for name, value in found.items()}, checked


def _noise_trend(trials: Sequence[PilotTrial], quiet: Mask) -> float:
    """Trend of the noise of pixels that see no disc."""
    if not quiet.any():
        return float("nan")
    rates = []
    for trial in trials:
        events = _events(trial, trial.hold_s, trial.slide_s)
        rates.append(quiet[events.y, events.x].sum() / (trial.slide_s - trial.hold_s))
    return plain_trend(rates)


def _size(trial: PilotTrial) -> tuple[int, int]:
    assert trial.camera is not None
    return trial.camera.size_px


def _events(trial: PilotTrial, begin_s: float, end_s: float) -> EventChunk:
    """Return the events of an interval."""
    assert trial.camera is not None
    events = trial.camera.events
    part = slice(*np.searchsorted(events.t_us, (begin_s * 1e6, end_s * 1e6)).tolist())
    return events[part]


def _moved_s(trial: PilotTrial, way_mm: float) -> float:
    """Return when the sensor has travelled a distance; the end of the slide if it never does."""
    return min(way_mm / trial.slide.speed_mm_s, trial.slide_s)


def _tips(trials: Sequence[PilotTrial]) -> F64:
    """Mean places of the markers when recording began, columns and rows, mm, (m, 2).

    NaN for a marker that was not seen.
    """
    first = [t.tips_mm[t.frame_s < max(t.hold_s, -t.slide_s) + SHORT_S] for t in trials]
    tips = np.concatenate(first) * [1.0, -1.0]
    known = np.isfinite(tips)
    middle: F64 = np.where(known, tips, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    return np.where(known.any(axis=0), middle, np.nan)


def _rests(trials: Sequence[PilotTrial], size_px: tuple[int, int]) -> F64 | None:
    """Discs at rest, roughly: a table as of `rims`, (m, 8); None where they are not found.

    They are looked for in the first motions of all trials of one direction together. A row is NaN
    where the tip was not seen.
    """
    tips = _tips(trials)
    known = np.isfinite(tips).all(axis=1)
    if known.sum() < 3:
        return None
    layout = tips[known]
    ways = np.array([trial.slide.direction for trial in trials])
    tried = np.zeros(len(trials), np.bool_)
    for first in range(len(trials)):
        if tried[first]:
            continue
        alike = np.hypot(*(ways - ways[first]).T) < 0.1
        tried |= alike
        together = [t for t, same in zip(trials, alike, strict=True) if same]
        events = EventChunk.concatenate(
            [_events(trial, 0.0, _moved_s(trial, FIRST_MM)) for trial in together]
        )
        discs = find_discs(events, layout, size_px)
        if discs is None:
            continue
        design = np.column_stack([layout, np.ones(len(layout))])
        fitted = np.linalg.lstsq(design[discs.found], discs.xy[discs.found], rcond=None)[0]
        table = np.zeros((len(layout), 8))
        table[:, [COLUMN, ROW]] = np.where(discs.found[:, None], discs.xy, design @ fitted)
        table[:, RADIUS] = np.where(discs.found, discs.radius, np.nanmedian(discs.radius))
        table[:, EDGE], table[:, CONTRAST] = _EDGE_PX, _CONTRAST
        rests = np.full((len(tips), 8), np.nan)
        rests[known] = table
        return rests
    return None


@dataclass(frozen=True)
class _Noise:
    """Noise of a camera.

    Attributes:
        rate_hz: of a pixel. leak_share: excess of positive events in it.
        hot: (height, width) bool. hot_hz: mean rate of a hot pixel when it is not dead.
    """

    rate_hz: float
    leak_share: float
    hot: Mask
    hot_hz: float


def _noise(trials: Sequence[PilotTrial], rests: F64 | None, size_px: tuple[int, int]) -> _Noise:
    """Noise of pixels that see no disc; in the hold, of all pixels."""
    width, height = size_px
    clear = _clear(rests, size_px)
    in_hold, in_slide = np.zeros((2, 2, height, width), np.int32)
    hold_s = slide_s = 0.0
    for trial in trials:
        held, slid = _events(trial, trial.hold_s, 0.0), _events(trial, 0.0, trial.slide_s)
        add_counts(held.x, held.y, held.p, True, clear, in_hold)
        add_counts(slid.x, slid.y, slid.p, False, clear, in_slide)
        hold_s, slide_s = hold_s - min(trial.hold_s, 0.0), slide_s + trial.slide_s
    seen_s = np.where(clear, hold_s + slide_s, hold_s)
    counts = in_hold + in_slide
    total = counts.sum(axis=0)
    quiet = (clear if clear.any() else np.ones_like(clear)) & (seen_s > 0.0)
    if not quiet.any():
        return _Noise(np.nan, np.nan, np.zeros_like(clear), np.nan)
    # those that are busy count a little at first, and not at all from then on
    for _ in range(10):
        off, on = (counts[:, quiet].sum(axis=1) / seen_s[quiet].sum()).tolist()
        most = poisson.isf(
            FALSE_HOT / total.size, (on + off) * np.array([hold_s, hold_s + slide_s])
        )
        # a pixel near a rim may fire once in each hold, as its disc creeps
        busy = (total > np.where(clear, most[1], most[0] + len(trials))) & (seen_s > 0.0)
        if not (quiet & busy).any():
            break
        quiet &= ~busy
    # one that is busy in the slide alone saw a disc after all, as where one was misplaced
    hot = busy & ((in_hold.sum(axis=0) > most[0]) | (hold_s == 0.0))
    hot_hz = total[hot].sum() / seen_s[hot].sum() if hot.any() else np.nan
    share = (on - off) / (on + off) if on + off > 0.0 else np.nan
    return _Noise(on + off, share, hot, float(hot_hz))


@njit(cache=True, nogil=True)
def add_counts(x: Any, y: Any, p: Any, everywhere: bool, clear: Any, counts: Any) -> None:
    """Count events of each polarity and pixel, of all pixels or of those in `clear`.

    Args:
        counts: negative and positive ones, (2, height, width), added to.
    """
    for k in range(x.size):
        if everywhere or clear[y[k], x[k]]:
            counts[1 if p[k] > 0 else 0, y[k], x[k]] += 1


def _clear(rests: F64 | None, size_px: tuple[int, int]) -> Mask:
    """Pixels that see no disc in a slide, (height, width)."""
    width, height = size_px
    if rests is None:
        return np.zeros((height, width), np.bool_)
    places = rests[np.isfinite(rests[:, RADIUS])][:, [COLUMN, ROW]]
    reach = CLEAR * float(pdist(places).min())
    clear = np.ones((height, width), np.bool_)
    column, row = np.arange(width), np.arange(height)[:, None]
    for x, y in places:
        left, top = int(max(x - reach, 0)), int(max(y - reach, 0))
        box = np.s_[top : int(max(y + reach, 0)) + 2, left : int(max(x + reach, 0)) + 2]
        away = np.hypot(column[box[1]] - x, row[box[0]] - y)
        clear[box] &= away > reach
    return clear


def _times(
    trials: Sequence[PilotTrial], noise: _Noise, size_px: tuple[int, int]
) -> dict[str, float]:
    """Return estimates from the times of events: read-out, dead time, rate of hot pixels."""
    found: dict[str, float] = {}
    width, height = size_px
    scans: list[ScanningReadout] = []
    for trial in trials[:SCANNED]:
        events = _events(trial, -np.inf, np.inf)[:SCANNED_EVENTS]
        scan = find_scans(events, width)
        if scan is not None:
            scans.append(scan)
    period_us = None
    if scans:
        period_us = float(np.median([scan.period_us for scan in scans]))
        found["readout_hz"] = 1e6 / period_us
        found["scan_us"] = float(np.median([scan.scan_us for scan in scans]))
    counts = np.zeros(INTERVALS_US, np.int64)
    last_us = np.empty((height, width), np.int64)
    for trial in trials:
        events = _events(trial, -np.inf, np.inf)
        count_intervals(events.t_us, events.x, events.y, noise.hot, last_us, counts)
    dead_us = dead_time_us(counts, noise.hot_hz, period_us)
    found["refractory_us"] = dead_us
    if np.isfinite(dead_us):
        found["hot_hz"] = noise.hot_hz / (1.0 - noise.hot_hz * dead_us * 1e-6)
    return found


def _rates(trials: Sequence[PilotTrial]) -> dict[str, float]:
    """Return how many positive events there are in each phase, and how far apart."""
    hold, hold_s, first, last, gaps = 0, 0.0, 0, 0, []
    for trial in trials:
        events = _events(trial, trial.hold_s, 0.0)
        hold, hold_s = hold + int((events.p > 0).sum()), hold_s - min(trial.hold_s, 0.0)
        begun = _events(trial, 0.0, _moved_s(trial, PHASE_MM))
        ended = _events(trial, trial.slide_s - _moved_s(trial, PHASE_MM), trial.slide_s)
        first, last = first + int((begun.p > 0).sum()), last + int((ended.p > 0).sum())
        if len(begun) > 1:
            gaps.append(float(np.mean(np.diff(begun.t_us)) * trial.slide.speed_mm_s))
    way_mm = PHASE_MM * len(trials)
    return {
        "hold_events_per_s": hold / hold_s if hold_s > 0.0 else np.nan,
        "first_mm_events_per_mm": first / way_mm,
        "last_mm_events_per_mm": last / way_mm,
        "interval_us": float(np.mean(gaps)) if gaps else np.nan,
    }


def _discs(
    trials: Sequence[PilotTrial], rests: F64, noise: _Noise, size_px: tuple[int, int]
) -> dict[str, float]:
    """Return estimates from discs before and after each slide."""
    images = [_counts(trial, noise, size_px) for trial in trials]
    # what noise adds to a pixel's count: a mean, of leakage, and a variance
    seen_s = np.array([trial.slide_s - min(trial.hold_s, 0.0) for trial in trials])
    noise_hz = np.nan_to_num(noise.rate_hz)
    grounds = (noise_hz * np.nan_to_num(noise.leak_share) * seen_s).tolist()
    starts = [_start(image, rests) for image in images]
    # the same of all discs: a few slides suffice
    some = range(0, len(trials), max(len(trials) // SHAPED, 1))
    edge_px, contrast = _shape(
        [fit_rims(images[k], grounds[k], starts[k], shape=True) for k in some]
    )
    if not np.isfinite(edge_px + contrast):
        return {}
    fits = []
    for image, ground, start in zip(images, grounds, starts, strict=True):
        # displacements by moments are in proportion to the contrast that was assumed
        start[:, [RIGHT, DOWN]] *= start[:, [CONTRAST]] / contrast
        start[:, EDGE], start[:, CONTRAST] = edge_px, contrast
        fits.append(fit_rims(image, ground, start, shape=False))
    discs = np.array([fit.discs for fit in fits])
    # what does not press does not move, and shows no rim
    for k in (RIGHT, DOWN):
        guessed = np.nan_to_num(np.array(starts)[..., k])
        discs[..., k] = np.where(np.isnan(discs[..., k]), guessed, discs[..., k])
    full = np.array([fit.full.sum(axis=(0, 1)) for fit in fits])
    with np.errstate(invalid="ignore", divide="ignore"):
        contrasts = full[:, 1] / full[:, 0]
    return {
        "edge_px": edge_px,
        **_contrast(fits, noise_hz * seen_s, contrast),
        **_geometry(trials, discs, bool(np.isfinite(rests).all())),
        **_papillae(trials, discs),
        CONTRAST_TREND: plain_trend(contrasts),
        **_picture(trials, discs),
    }


def _picture(trials: Sequence[PilotTrial], discs: F64) -> dict[str, float]:
    """Return the turn of the picture against the arm's motion, and the trend of its shift.

    Args:
        discs: as for `_geometry`.
    """
    right, down = discs[..., [RIGHT, DOWN]].sum(axis=1).T
    ahead, up = np.array([trial.slide.direction for trial in trials]).T
    along, across = right * ahead - down * up, -down * ahead - right * up
    # markers move with the force or against it
    sign = np.sign(along.sum())
    turn = np.degrees(np.arctan2(sign * across, sign * along))
    return {
        PICTURE_TURN: float(np.median(turn)),
        SHIFT_TREND: shift_trend(trials, np.hypot(along, across)),
    }


def _counts(trial: PilotTrial, noise: _Noise, size_px: tuple[int, int]) -> NDArray[np.int32]:
    """Positive less negative events of each pixel of a trial, up to the end of its slide."""
    width, height = size_px
    events = _events(trial, -np.inf, trial.slide_s)
    place = events.y.astype(np.int64) * width + events.x
    sign = np.where(events.p > 0, 1.0, -1.0)
    net = np.bincount(place, weights=sign, minlength=height * width)
    counts = net.astype(np.int32).reshape(height, width)
    counts[noise.hot] = HIDDEN
    return counts


def _start(counts: NDArray[np.int32], rests: F64) -> F64:
    """Discs at rest with first guesses of the contrast, and of their displacements by moments."""
    start = rests.copy()
    # where a disc ends up is not known at first, and another one's pixels may be taken for its own
    for reach in (FIRST_REACH, REACH):
        sums = first_moments(counts, start, reach)
        # most pixels that fire see nearly all of the contrast
        contrast = max(float(sums[:, 0].sum() / max(sums[:, 1].sum(), 1.0)) + 0.5, 2.0)
        area = contrast * np.pi * start[:, RADIUS] ** 2
        start[:, [RIGHT, DOWN]] = sums[:, 2:] / area[:, None]
    start[:, CONTRAST] = contrast
    return start


def _shape(fits: Sequence[RimFit]) -> tuple[float, float]:
    """Edge and contrast of all discs that moved far enough, by their weighted mean."""
    discs = np.concatenate([fit.discs for fit in fits])
    sigma = np.concatenate([fit.sigma for fit in fits])
    moved = np.concatenate([fit.swept_px for fit in fits])
    far = np.isfinite(discs).all(axis=1) & (moved > SWEPT * discs[:, EDGE])
    if not far.any():
        return np.nan, np.nan
    edge, contrast = (
        float(np.average(discs[far, k], weights=sigma[far, k] ** -2.0)) for k in (EDGE, CONTRAST)
    )
    return edge, contrast


def _contrast(fits: Sequence[RimFit], variances: F64, fitted: float) -> dict[str, float]:
    """Contrast in thresholds, of both polarities, and the mismatch between pixels.

    A pixel with threshold t counts the whole thresholds in a contrast C. Where t is normal, about T
    by a share s, the mean of C / t is C / T (1 + s^2 + ...) and its standard deviation over that
    s (1 + 3 s^2 + ...); cutting to whole numbers takes off a half, and adds 1/12 to the square.

    Args:
        variances: of a pixel's count in each trial, by noise. fitted: the contrast by the fits,
            for discs that did not go far enough.
    """
    fulls = np.array([fit.full.sum(axis=0) for fit in fits])
    fulls[..., 2] -= fulls[..., 0] * variances[:, None]
    full = fulls.sum(axis=0)
    n, total, squares = full.sum(axis=0)
    if n < _FEWEST_FULL:
        return {"contrast_in_thresholds": fitted}
    spread = max(squares / n - (total / n) ** 2 - 1.0 / 12.0, 0.0)
    share = np.sqrt(spread) / (total / n)
    share /= 1.0 + 3.0 * share**2
    found = {"threshold_mismatch": float(share)}
    for name, (n, total, _) in zip(
        ("contrast_in_thresholds", "on_thresholds", "off_thresholds"),
        (full.sum(axis=0), *full),
        strict=True,
    ):
        if n >= _FEWEST_FULL:
            found[name] = float(total / n / (1.0 + share**2))
    return found


def _geometry(trials: Sequence[PilotTrial], discs: F64, complete: bool) -> dict[str, float]:
    """Return scale, radius, and the effects of forces on the image.

    Args:
        discs: of each trial, (n, m, 8), see `rims`; displaced also where the rest is unknown.
        complete: these are the discs of all papillae.
    """
    tips = np.array([_tips([trial]) for trial in trials])
    seen = np.isfinite(discs[..., RADIUS])
    both = seen & np.isfinite(tips[..., 0])
    known = both.any(axis=0)
    if known.sum() < 3:
        return {}
    places = np.where(both[..., None], discs[..., [COLUMN, ROW]], np.nan)[:, known]
    layout = np.where(both[..., None], tips, np.nan)[:, known]
    ratio = pdist(np.nanmean(places, axis=0)) / pdist(np.nanmean(layout, axis=0))
    px_per_mm = float(np.median(ratio))
    found = {"px_per_mm": px_per_mm}
    shift = np.hypot(*discs[..., [RIGHT, DOWN]].sum(axis=1).T)
    found["image_shift_px"] = float(shift.mean()) / discs.shape[1]
    always = seen.all(axis=0)
    if always.any():
        radius = discs[:, always, RADIUS].mean(axis=1)
        depth = np.array([trial.slide.depth_mm for trial in trials])
        found["marker_radius_mm"] = float(radius.mean()) / px_per_mm
        found["image_growth_px_per_mm"] = _slope(depth, radius)
    loads = np.array([_loads(trial) for trial in trials])
    pulled = np.hypot(*(loads[:, 1, :2] - loads[:, 0, :2]).T)
    measured = np.isfinite(pulled)
    # a force on all papillae goes with all discs
    if complete and measured.sum() >= 3:
        found["image_shift_mm_per_n"] = float(
            shift[measured] @ pulled[measured] / (pulled[measured] @ pulled[measured]) / px_per_mm
        )
        found.update(_growth(discs[measured], loads[measured, :, 2], px_per_mm))
    return found


def _growth(discs: F64, normal_n: F64, px_per_mm: float) -> dict[str, float]:
    """Radius of a marker without force, and its growth by force.

    Together, radii are those without force, of as many as are seen, and grow by the force on them
    all. Where the number seen goes with the force, that does not tell one from the other. But when
    all tips slide, a disc's displacement is in proportion to the force on its papilla, but for what
    friction differs by, so that big and small discs of one slide tell it too.

    Args:
        normal_n: of all papillae before and after each slide, N, (n, 2).
    """
    seen = np.isfinite(discs[..., RADIUS])
    moved = np.hypot(discs[..., RIGHT], discs[..., DOWN])
    share = moved / np.maximum(moved.sum(axis=1, keepdims=True), 1e-9)
    pressed = normal_n[:, 0] * np.where(seen, share, 0.0).sum(axis=1)
    together = np.column_stack([seen.sum(axis=1), pressed])
    each = np.column_stack([np.ones(seen.sum()), (normal_n[:, [1]] * share)[seen]])
    radius = np.concatenate(
        [np.nansum(discs[..., RADIUS], axis=1), (discs[..., RADIUS] + discs[..., GROWN])[seen]]
    )
    (at_rest, grown), _, rank, _ = np.linalg.lstsq(
        np.concatenate([together, each]), radius, rcond=1e-6
    )
    if rank < 2:
        return {}
    return {
        "marker_radius_mm": float(at_rest) / px_per_mm,
        "image_growth_mm_per_n": float(grown) / px_per_mm,
    }


def _papillae(trials: Sequence[PilotTrial], discs: F64) -> dict[str, float]:
    """Return differences of discs in the deepest slides: between rings, and inside them.

    Radii grow with normal forces and displacements with tangential ones, so these say how loads
    differ between papillae, which one force of all cannot.
    """
    depth = np.array([trial.slide.depth_mm for trial in trials])
    deep = discs[depth > depth.max() - 1e-6]
    radius = deep[..., RADIUS].mean(axis=0)
    moved = np.hypot(deep[..., RIGHT], deep[..., DOWN]).mean(axis=0)
    known = np.isfinite(radius)
    if known.sum() < 3:
        return {}
    layout = _tips(trials)
    seen = layout[np.isfinite(layout[:, 0])]
    away = np.hypot(*(layout[known] - seen.mean(axis=0)).T)
    ring = np.rint(away / pdist(seen).min()).astype(np.int64)
    radius, moved = radius[known], moved[known]
    found = {"radius_step_px": -_slope(ring.astype(np.float64), radius)}
    apart, relative = [], []
    for k in np.unique(ring):
        if (ring == k).sum() >= 3:
            apart.append(radius[ring == k] - radius[ring == k].mean())
            relative.append(moved[ring == k] / moved[ring == k].mean() - 1.0)
    if apart:
        found["radius_scatter_px"] = float(np.concatenate(apart).std())
        found["shift_scatter"] = float(np.concatenate(relative).std())
    return found


def _slope(x: F64, y: F64) -> float:
    """Slope of y over x; NaN where x does not vary."""
    return float(np.polyfit(x, y, 1)[0]) if np.ptp(x) > 1e-6 else np.nan


def _loads(trial: PilotTrial) -> F64:
    """Forces when recording began, and at the end of the slide, N, (2, 3)."""
    if trial.forces is None:
        return np.full((2, 3), np.nan)
    begin_s = max(trial.hold_s, -trial.slide_s)
    return np.array(
        [
            _mean_force(trial.forces, begin_s, begin_s + SHORT_S),
            _mean_force(trial.forces, trial.slide_s - SHORT_S, trial.slide_s),
        ]
    )


def _mean_force(forces: Forces, begin_s: float, end_s: float) -> F64:
    part = slice(*np.searchsorted(forces.t_s, (begin_s, end_s)).tolist())
    if part.start == part.stop:
        return np.full(3, np.nan)
    middle: F64 = forces.force_n[part].mean(axis=0)
    return middle
