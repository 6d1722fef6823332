"""White discs seen by an event camera alone: a track of each, from the events of its rim.

The first moment of an image of log intensity is that of its discs, so an event of polarity p at x
shifts the centroid c of a disc of radius r by p (x - c) / (C pi r^2), where C is the contrast in
thresholds of a pixel: no profile of the rim and no frame is needed. Sums drift where events are
lost or made by noise. The places of the events correct that, as they lie on the rim: a Kalman
filter adds the offset of a circle fitted to those of a slice.

Places come with a standard deviation. A pixel fires when its intensity has changed by a threshold,
and says nothing before: a disc that stops or turns back moves unseen by up to a threshold over the
slope of its rim (`EventTracks.backlash_px`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import pdist

from sliplab.storage.kernels import njit
from sliplab.storage.streams import EventChunk

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

EDGE_PX = 3.1
"""Contrast over the steepest slope of a rim: four scales of a logistic edge of 0.8 px."""
GATE_PX = 6.0
"""Events further from the rim are not the disc's."""
RIM_PX = 1.45
"""Standard deviation of an event's distance from the rim."""
CONTRAST = 10.0
"""First estimate of the contrast in thresholds; refined on each trial."""
DRIFT_PX, SCALE = 0.02, 0.03
"""Drift of the sums, px in a second to the power 1/2, and error of a step as a share of it."""
HOT = 30
"""Events of one polarity that a pixel has more than of the other only if it is hot: a disc raises
and lowers it by the contrast."""
_FEWEST = 60
_SHRINK = 4
_SCALES = 40
_DENSER = 2.0
_ALIKE = 0.35
_GAP_US, _GAP_EVENTS = 10_000, 15.0
"""A pause of all pixels is a loss where it is so long, and so many events were to be expected."""
_SPAN_US, _MISSING, _UNLIKELY = 100_000, 0.7, 5.0
"""Noise away from the discs shows a read-out that loses a part: over so long, it is a share below
this and so many standard deviations off."""
_CLEAR_PX = 24.0
_LOST_PX = 1.0


@dataclass(frozen=True)
class Discs:
    """Discs at rest.

    Attributes:
        xy: (m, 2) centres, column and row, px; NaN for a disc that was not found.
        radius: (m,) px. px_per_mm: scale of the picture.
    """

    xy: F64
    radius: F64
    px_per_mm: float

    @property
    def found(self) -> NDArray[np.bool_]:
        """(m,) True for discs that were found."""
        return np.isfinite(self.radius)


@dataclass(frozen=True)
class EventTracks:
    """Discs over n slices of time.

    Attributes:
        xy: (n, m, 2) px at the end of each slice, NaN where unknown.
        sigma: (n, m) standard deviation of a coordinate, px, without the backlash.
        rests: the discs at rest. contrast: in thresholds, as found.
        lost: (n,) bool, slices in which the camera lost events.
    """

    xy: F64
    sigma: F64
    rests: Discs
    contrast: float
    lost: NDArray[np.bool_]

    @property
    def backlash_px(self) -> float:
        """Play of a place behind the true one, from one direction of motion to the other."""
        return EDGE_PX / self.contrast


def without_hot_pixels(events: EventChunk, size_px: tuple[int, int]) -> EventChunk:
    """Return the events of all pixels but the hot ones.

    Args:
        size_px: columns and rows.
    """
    width, height = size_px
    place = events.y.astype(np.int64) * width + events.x
    sign = np.where(events.p > 0, 1.0, -1.0)
    net = np.bincount(place, weights=sign, minlength=width * height)
    return events[np.abs(net[place]) <= HOT]


def find_discs(events: EventChunk, layout_mm: F64, size_px: tuple[int, int]) -> Discs | None:
    """Find discs by the events of their first motion, at an unknown scale.

    Args:
        events: of a motion by much less than a radius.
        layout_mm: (m, 2) places, columns to the right and rows downwards.
        size_px: columns and rows of the camera.

    Returns:
        None where they do not look like the layout.
    """
    if len(events) < _FEWEST * len(layout_mm) // 2:
        return None
    spacing = float(pdist(layout_mm).min())
    scale, shift, denser = _coarse(events, layout_mm, spacing, size_px)
    if denser < _DENSER:
        return None
    xy, radius = scale * layout_mm + shift, np.full(len(layout_mm), np.nan)
    x, y = events.x.astype(np.float64), events.y.astype(np.float64)
    for marker, (column, row) in enumerate(xy.copy()):
        near = np.hypot(x - column, y - row) < 0.45 * spacing * scale
        circle = _circle(np.stack([x[near], y[near]], 1), events.p[near] > 0)
        if circle is not None:
            xy[marker], radius[marker] = circle[:2], circle[2]
    usual = np.nanmedian(radius) if np.isfinite(radius).any() else np.nan
    radius[~(np.abs(radius / usual - 1.0) < _ALIKE)] = np.nan
    xy[np.isnan(radius)] = np.nan
    return Discs(xy, radius, scale) if np.isfinite(radius).sum() * 2 > len(radius) else None


def _coarse(
    events: EventChunk, layout_mm: F64, spacing: float, size_px: tuple[int, int]
) -> tuple[float, F64, float]:
    """Scale and shift of a layout whose discs hold most of the events, and how much denser they
    are there than elsewhere."""
    width, height = (-(-size // _SHRINK) for size in size_px)
    image = np.zeros((height, width))
    np.add.at(image, (events.y // _SHRINK, events.x // _SHRINK), 1.0)
    extent = float(np.ptp(layout_mm, axis=0).max()) + 0.5 * spacing
    spectrum = np.fft.rfft2(image)
    rows, columns = np.mgrid[:height, :width]
    rows, columns = np.minimum(rows, height - rows), np.minimum(columns, width - columns)
    best = (0.0, np.zeros(2), -np.inf, 0.0)
    count = len(layout_mm)
    largest = min(size_px) / extent
    for scale in np.geomspace(0.25 * largest, largest, _SCALES):
        disc = np.hypot(rows, columns) * _SHRINK < 0.3 * spacing * scale
        places = np.rint(layout_mm * scale / _SHRINK).astype(np.int64)
        mask = np.zeros((height, width))
        np.add.at(mask, (places[:, 1] % height, places[:, 0] % width), 1.0)
        kernel = np.conj(np.fft.rfft2(mask) * np.fft.rfft2(disc))
        caught = np.fft.irfft2(spectrum * kernel, s=image.shape) / image.sum()
        k = int(caught.argmax())
        # a larger layout catches more by chance
        share, area = float(caught.flat[k]), count * float(disc.mean())
        if share - area > best[2] and area < 1.0:
            at = np.array([k % width, k // width]) * _SHRINK + 0.5 * (_SHRINK - 1)
            denser = share * (1.0 - area) / max(area * (1.0 - share), 1e-9)
            best = (float(scale), at, share - area, denser)
    return best[0], best[1], best[3]


def _circle(xy: F64, brighter: NDArray[np.bool_]) -> tuple[float, float, float] | None:
    """Fit a circle to the events of a disc that moves a little; None without both sides of it."""
    if min(brighter.sum(), (~brighter).sum()) < _FEWEST // 4:
        return None
    front, behind = np.median(xy[brighter], axis=0), np.median(xy[~brighter], axis=0)
    # events lie along the rim as the cosine of the angle from the direction of motion
    centre, radius = (front + behind) / 2, float(np.hypot(*(front - behind))) * 2 / np.pi
    for gate in (8.0, GATE_PX, GATE_PX, GATE_PX):
        away = xy - centre
        far = np.hypot(away[:, 0], away[:, 1])
        near = (np.abs(far - radius) < gate) & (far > 0)
        if near.sum() < _FEWEST // 2:
            return None
        normal = away[near] / far[near, None]
        design = np.column_stack([normal, np.ones(len(normal))])
        step, _, rank, _ = np.linalg.lstsq(design, far[near] - radius, rcond=None)
        if rank < 3:
            return None
        centre, radius = centre + step[:2], radius + float(step[2])
    return float(centre[0]), float(centre[1]), radius


def track_discs(events: EventChunk, edges_us: I64, rests: Discs, settle: slice) -> EventTracks:
    """Follow discs through time.

    Args:
        events: without hot pixels, sorted by time.
        edges_us: (n + 1,) borders of the slices, the camera's clock.
        rests: where discs rest at the first border.
        settle: slices of the first motion, by which the places at rest are refined.
    """
    found, lost = rests.found, lost_slices(events, edges_us, rests)
    xy, radius = rests.xy[found], rests.radius[found]
    columns = (events.t_us, events.x, events.y, events.p)
    first = edges_us[: settle.stop + 1]
    contrast = CONTRAST
    for _ in range(2):
        for _ in range(3):
            *_, sums, _ = _follow(*columns, first, lost, xy, radius, contrast, 0.0, 0.0, 0.0)
            step = np.array([_offset(*row) for row in sums[settle].sum(axis=0)])
            xy, radius = xy + step[:, :2], radius + step[:, 2]
        # led by the places of events, which say how much the sums are too large or too small
        path, _, _, summed = _follow(*columns, edges_us, lost, xy, radius, contrast, 0.05, 0.0, 0.5)
        moved = (path - xy).ravel()
        square = float(summed.ravel() @ summed.ravel())
        if square > 0.0:
            contrast *= square / max(float(moved @ summed.ravel()), 0.2 * square)
    path, sigma, _, _ = _follow(
        *columns, edges_us, lost, xy, radius, contrast, 0.05, DRIFT_PX, SCALE
    )
    shape = (len(edges_us) - 1, len(found))
    full, wide = np.full((*shape, 2), np.nan), np.full(shape, np.nan)
    full[:, found], wide[:, found] = path, sigma
    centres, radii = rests.xy.copy(), rests.radius.copy()
    centres[found], radii[found] = xy, radius
    return EventTracks(full, wide, Discs(centres, radii, rests.px_per_mm), contrast, lost)


def lost_slices(events: EventChunk, edges_us: I64, rests: Discs) -> NDArray[np.bool_]:
    """(n,) True for slices in which the camera lost all events, or many of them.

    A camera is never quite silent: noise that pauses, or thins away from the discs, is lost.
    """
    column = np.arange(int(events.x.max(initial=0)) + 1)
    row = np.arange(int(events.y.max(initial=0)) + 1)[:, None]
    clear = np.ones((len(row), len(column)), np.bool_)
    for (x, y), radius in zip(rests.xy[rests.found], rests.radius[rests.found], strict=True):
        clear &= np.hypot(column - x, row - y) > radius + _CLEAR_PX
    noise_us = events.t_us[clear[events.y, events.x]]
    begins = np.arange(edges_us[0], edges_us[-1] - _SPAN_US + 1, _SPAN_US // 4)
    counts = np.diff(np.searchsorted(noise_us, [begins, begins + _SPAN_US]), axis=0)[0]
    usual = float(np.median(counts)) if len(counts) else 0.0
    few = (counts < _MISSING * usual) & (counts < usual - _UNLIKELY * np.sqrt(usual))
    spans = [(begin, begin + _SPAN_US) for begin in begins[few].tolist()]
    longest = max(_GAP_US, _GAP_EVENTS / max(usual, 1e-9) * _SPAN_US)
    times = np.concatenate([edges_us[:1], events.t_us, edges_us[-1:]])
    pauses = np.flatnonzero(np.diff(times) > longest)
    spans += zip(times[pauses].tolist(), times[pauses + 1].tolist(), strict=True)
    lost = np.zeros(len(edges_us) - 1, np.bool_)
    for begin, end in spans:
        lost |= (edges_us[1:] > begin) & (edges_us[:-1] < end)
    return lost


def _offset(*sums: float) -> tuple[float, float, float]:
    """Offset of centre and radius of a circle by the sums over its events; 0 with too few."""
    n, nx, ny, far, xx, xy, yy, x_far, y_far = sums
    if n < _FEWEST // 2:
        return 0.0, 0.0, 0.0
    normal = np.array([[xx, xy, nx], [xy, yy, ny], [nx, ny, n]])
    normal[np.diag_indices(3)] += 1e-6 * n
    dx, dy, dr = np.linalg.solve(normal, np.array([x_far, y_far, far])).tolist()
    return dx, dy, dr


@njit(cache=True, nogil=True)
def _follow(
    t_us: Any,
    column: Any,
    row: Any,
    polarity: Any,
    edges_us: Any,
    lost: Any,
    xy: Any,
    radius: Any,
    contrast: float,
    start_px: float,
    drift_px: float,
    scale: float,
) -> Any:
    """Follow m discs over n slices.

    Args:
        start_px: standard deviation at the first border; with 0 and neither `drift_px` nor `scale`
            the places of events correct nothing.
        drift_px, scale: see `DRIFT_PX` and `SCALE`.

    Returns:
        places (n, m, 2) and their standard deviations (n, m), px; sums over the events of each
        slice, see `_offset` (n, m, 9); and what the sums of polarities alone give (n, m, 2).
    """
    m, n = xy.shape[0], edges_us.size - 1
    centre, r, variance = xy.copy(), radius.copy(), np.full(m, start_px**2)
    path, sigma = np.empty((n, m, 2)), np.empty((n, m))
    sums, summed = np.zeros((n, m, 9)), np.zeros((n, m, 2))
    before, total = np.empty((m, 2)), np.zeros((m, 2))
    e = np.searchsorted(t_us, edges_us[0])
    for i in range(n):
        for k in range(m):
            before[k, 0], before[k, 1] = centre[k, 0], centre[k, 1]
        while e < t_us.size and t_us[e] < edges_us[i + 1]:
            for k in range(m):
                dx, dy = column[e] - centre[k, 0], row[e] - centre[k, 1]
                reach = r[k] + GATE_PX
                if abs(dx) > reach or abs(dy) > reach:
                    continue
                far = np.sqrt(dx * dx + dy * dy)
                off = far - r[k]
                if abs(off) < GATE_PX and far > 0.0:
                    weight = 1.0 / (contrast * np.pi * r[k] * r[k])
                    if polarity[e] <= 0:
                        weight = -weight
                    centre[k, 0] += weight * dx
                    centre[k, 1] += weight * dy
                    total[k, 0] += weight * dx
                    total[k, 1] += weight * dy
                    nx, ny, s = dx / far, dy / far, sums[i, k]
                    s[0] += 1.0
                    s[1] += nx
                    s[2] += ny
                    s[3] += off
                    s[4] += nx * nx
                    s[5] += nx * ny
                    s[6] += ny * ny
                    s[7] += nx * off
                    s[8] += ny * off
                    break
            e += 1
        seconds = (edges_us[i + 1] - edges_us[i]) * 1e-6
        for k in range(m):
            moved = np.hypot(centre[k, 0] - before[k, 0], centre[k, 1] - before[k, 1])
            variance[k] += drift_px**2 * seconds + (scale * moved) ** 2
            if lost[i] and drift_px > 0.0:
                variance[k] += _LOST_PX**2
            count = sums[i, k, 0]
            if count >= 8.0 and variance[k] > 0.0:
                _correct(sums[i, k], centre, r, variance, k)
            path[i, k], sigma[i, k], summed[i, k] = centre[k], np.sqrt(variance[k]), total[k]
    return path, sigma, sums, summed


@njit(cache=True, nogil=True)
def _correct(s: Any, centre: Any, r: Any, variance: Any, k: int) -> None:
    """Move disc k by the offset of its events from the rim, in place.

    One variance serves both coordinates: along the better known one little is lost.
    """
    n = s[0]
    nx, ny, off = s[1] / n, s[2] / n, s[3] / n
    a, b, c = s[4] - n * nx * nx, s[5] - n * nx * ny, s[6] - n * ny * ny
    u, v = s[7] - n * nx * off, s[8] - n * ny * off
    known, prior = 1.0 / RIM_PX**2, 1.0 / variance[k]
    a, b, c = a * known + prior, b * known, c * known + prior
    det = a * c - b * b
    centre[k, 0] += (c * u - b * v) * known / det
    centre[k, 1] += (a * v - b * u) * known / det
    variance[k] = 0.5 * (a + c) / det
    # the radius grows with the load, slowly
    r[k] += 0.002 * off * min(n / 20.0, 1.0)
