"""Checks for effects in a pilot that the simulated scene lacks.

Each is a number that one kind of effect makes large. The same number of simulated worlds says how
large it becomes without the effect, and a number beyond that is a misfit. Further checks compare
all statistics of a stream with those of the worlds: they find what no other check was made for.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy.ndimage import median_filter

from sliplab.plugins.twin import camera_estimates
from sliplab.plugins.twin.alignment import force_delay_ms, force_turn_deg, frame_delay_ms, view_of
from sliplab.plugins.twin.camera_estimates import (
    CONTRAST_TREND,
    EVENT_DELAY,
    NOISE_TREND,
    PICTURE_TURN,
    SHIFT_TREND,
)
from sliplab.plugins.twin.contact_estimates import ContactSlides
from sliplab.plugins.twin.contact_lags import Growth, settled_lags
from sliplab.plugins.twin.contact_slips import SlideSlips
from sliplab.plugins.twin.contact_springs import SCATTER, Fit
from sliplab.plugins.twin.document import MisfitCheck
from sliplab.plugins.twin.parameters import CAMERA, CONTACT, PARAMETERS
from sliplab.plugins.twin.pilot import PilotTrial
from sliplab.plugins.twin.trends import LAG, PULL, RATIO, contact_trends
from sliplab.storage.streams import F64, I64

Bools = npt.NDArray[np.bool_]
Stream = Literal["frames", "events", "poses", "force"]

LEVEL = 0.05
"""Share of pilots without any such effect that show a misfit, of all checks together."""
SETUP_LEVEL = 0.01
"""Its share for the checks of places, times and trends."""
TAIL = 0.2
"""Share of the worlds that the tail of a number is taken from."""
FEWEST = 20
"""Worlds that a check takes."""

TILT, STICKY, BROKEN, LIGHT, RAMP, SPOT = (
    "tilt_mm_per_mm",
    "odd_friction",
    "missing_share",
    "line_over_noise",
    "ramp_mm",
    "spot",
)
SCALE, TURN, STRETCH, BENT, PERSPECTIVE, FRAME_DELAY, FORCE_DELAY, FORCE_TURN = (
    "frame_scale",
    "frame_turn_deg",
    "frame_stretch",
    "frame_bent",
    "frame_perspective",
    "frame_delay_ms",
    "force_delay_ms",
    "force_turn_deg",
)

VIEWS = frozenset((SCALE, TURN, STRETCH, BENT, PERSPECTIVE))
"""Of the frames: a wrong image causes spurious delays and trends."""

CONTACT_KEYS = frozenset(it.key for it in CONTACT)
CAMERA_KEYS = frozenset(it.key for it in CAMERA)
FORCE_KEYS = frozenset(it.key for it in PARAMETERS if "force" in it.streams)
IN_MM = CONTACT_KEYS | {f"event_camera.{name}" for name in ("px_per_mm", "radius_mm")} | FORCE_KEYS
"""Parameters whose lengths are measured by frames."""
NOISE_KEYS = frozenset(
    f"event_camera.{name}" for name in ("noise_hz", "leak_share", "hot_pixels", "hot_hz")
)


@dataclass(frozen=True)
class MisfitTest:
    """A number that one kind of effect makes large.

    Attributes:
        key: of the number. title: of the effect, for people.
        stream: that shows it. unit: of the number.
        floor: values that differ by less than this are alike.
        touches: parameters whose intervals do not hold with the effect.
        signed: the number is the distance from its median in worlds, either way.
        setup: whether it shows places, times or trends that are wrong. These show in others, too,
            so that it comes first; and its number is near to normal, see `Tail`.
    """

    key: str
    title: str
    stream: Stream
    unit: str
    floor: float
    touches: frozenset[str] = CONTACT_KEYS
    signed: bool = False
    setup: bool = False


def _view(key: str, title: str, unit: str, floor: float, signed: bool = True) -> MisfitTest:
    return MisfitTest(key, title, "frames", unit, floor, IN_MM, signed, setup=True)


def _trend(key: str, title: str, stream: Stream, touches: frozenset[str]) -> MisfitTest:
    return MisfitTest(
        key, f"{title} drifts during the pilot", stream, "sigma", 0.5, touches, setup=True
    )


def _delay(key: str, title: str, stream: Stream, touches: frozenset[str]) -> MisfitTest:
    return MisfitTest(key, title, stream, "ms", 0.5, touches, signed=True, setup=True)


CHECKS = (
    MisfitTest(TILT, "plate tilted against the arm's", "frames", "mm/mm", 5e-4),
    MisfitTest(STICKY, "friction of one papilla unlike that of the others", "frames", "sigma", 0.5),
    MisfitTest(BROKEN, "slides in which a papilla is missing", "frames", "share", 0.25),
    MisfitTest(LIGHT, "light that flickers", "events", "times noise", 0.2, CAMERA_KEYS),
    MisfitTest(RAMP, "slides that begin and end gently", "poses", "mm", 2e-3),
    MisfitTest(
        SPOT, "friction of one place of the plate unlike that of others", "frames", "sigma", 0.5
    ),
    _view(TURN, "frame camera turned against the arm's axes", "deg", 0.05),
    _view(SCALE, "scale of the frames unlike the arm's", "share", 1e-3),
    _view(STRETCH, "scale of the frames unlike in two directions", "share", 1e-3, signed=False),
    _view(BENT, "frames distorted by a lens", "share", 1e-3),
    _view(PERSPECTIVE, "frame camera tilted against the plate", "share", 1e-3, signed=False),
    _delay(FRAME_DELAY, "frames late or early against the arm's poses", "frames", IN_MM),
    _delay(EVENT_DELAY, "frames late or early against the events", "frames", IN_MM),
    _delay(FORCE_DELAY, "forces late or early against the arm's poses", "force", FORCE_KEYS),
    MisfitTest(
        FORCE_TURN,
        "force sensor turned against the arm's axes",
        "force",
        "deg",
        0.1,
        FORCE_KEYS,
        signed=True,
        setup=True,
    ),
    _trend(LAG, "friction or stiffness", "frames", CONTACT_KEYS | FORCE_KEYS),
    _trend(PULL, "stiffness or the force sensor's gain", "force", CONTACT_KEYS | FORCE_KEYS),
    _trend(RATIO, "friction", "force", CONTACT_KEYS | FORCE_KEYS),
    _trend(
        SHIFT_TREND,
        "stiffness or the event image's shift by force",
        "events",
        CONTACT_KEYS | FORCE_KEYS,
    ),
    _trend(CONTRAST_TREND, "contrast or threshold of events", "events", CAMERA_KEYS),
    _trend(NOISE_TREND, "noise of the event camera", "events", NOISE_KEYS),
    MisfitTest(
        PICTURE_TURN,
        "event camera turned against the arm's axes",
        "events",
        "deg",
        0.1,
        CAMERA_KEYS,
        signed=True,
        setup=True,
    ),
)
GENERAL: Mapping[Stream, str] = {
    "frames": "all that frames show",
    "force": "all that forces show",
    "events": "all that events show",
}
"""Titles of the checks that compare all statistics of a stream."""
SHOWN_BY: Mapping[Stream, frozenset[str]] = {
    "frames": CONTACT_KEYS,
    "force": FORCE_KEYS,
    "events": CAMERA_KEYS,
}


def misfit_numbers(
    trials: Sequence[PilotTrial], with_events: Sequence[PilotTrial], contact: ContactSlides | None
) -> dict[str, float]:
    """Return the number of every check by key, NaN where the slides do not determine it.

    Those of the event camera come from `read_camera`.

    Args:
        with_events: those of the trials whose events are read.
        contact: of the trials, see `read_contact`.
    """
    found = dict.fromkeys((it.key for it in CHECKS), float("nan"))
    found[RAMP] = ramp_mm(trials)
    found[LIGHT] = line_over_noise(with_events)
    if contact is None:
        return found
    ring = contact.ring
    found[BROKEN] = missing_share(contact.slips, ring)
    if contact.springs is not None:
        known = ring >= 0
        raised_mm = contact.springs.raised_mm[known]
        found[TILT] = gap_slope(contact.place_mm[known], raised_mm, ring[known])
        found[STICKY] = odd_friction(contact.springs, ring)
    found[SPOT] = largest_spot(contact.slips, contact.growth)
    view = view_of(contact.slips)
    found |= {
        SCALE: view.scale,
        TURN: view.turn_deg,
        STRETCH: view.stretch,
        BENT: view.distortion,
        PERSPECTIVE: view.perspective,
        FRAME_DELAY: frame_delay_ms(contact.slips, contact.steady),
        FORCE_DELAY: force_delay_ms(contact.slips, contact.growth),
        FORCE_TURN: force_turn_deg(contact.slips),
        **contact_trends(contact.slips, contact.steady),
    }
    return found


# -- frames ------------------------------------------------------------------------------------


def gap_slope(place_mm: F64, raised_mm: F64, ring: I64) -> float:
    """Slope of a plane through papillae's heights over their rings', mm/mm; NaN with too few.

    Args:
        place_mm: (m, 2). raised_mm, ring: (m,).
    """
    rings = (ring[:, None] == np.unique(ring)).astype(np.float64)
    design = np.column_stack([place_mm - place_mm.mean(axis=0), rings])
    best, _, rank, _ = np.linalg.lstsq(design, raised_mm, rcond=1e-6)
    if rank < design.shape[1] or len(design) < design.shape[1] + 2:
        return float("nan")
    return float(np.hypot(*best[:2]))


LEAST_SCATTER = 0.3
"""Estimates of papillae's friction are taken to scatter by at least so much of what is expected:
where all are alike, the smallest difference would be significant."""


def odd_friction(fit: Fit, ring: I64) -> float:
    """Largest deviation of one papilla's friction from all others', over the scatter of these.

    Each is compared with the mean and scatter of the others (an externally studentised residual;
    Cook and Weisberg 1982). The fit's prior draws an estimate to the mean, the more the less its
    ring shows: with the prior's variance s^2 and the usual error e of the ring, estimates scatter
    by sqrt(s^2 - e^2), which deviations are divided by.
    """
    known = ring >= 0
    n = int(known.sum())
    if n < 5:
        return float("nan")
    friction, inside = np.log(fit.friction[known]), ring[known]
    errors = {r: np.median(fit.friction_error[ring == r]) for r in np.unique(inside).tolist()}
    error = np.array([errors[r] for r in inside.tolist()])
    scatter = np.sqrt(np.maximum(SCATTER**2 - error**2, (LEAST_SCATTER * SCATTER) ** 2))
    others = ~np.eye(n, dtype=np.bool_) / scatter**2
    mean = others @ friction / others.sum(axis=1)
    off = (friction - mean[:, None]) / scatter
    square = (off**2).sum(axis=1) - np.diag(off) ** 2
    usual = np.maximum(np.sqrt(square / (n - 2)), LEAST_SCATTER)
    return float(np.max(np.abs(np.diag(off)) / usual))


LOADED_MM = 0.8
"""Papillae of a ring whose tips are stretched so far before they slip all hold: their heights
differ by less."""


def missing_share(slips: SlideSlips, ring: I64) -> float:
    """Largest share of the slides in which a papilla is not seen, or does not hold while its ring
    does, of one papilla."""
    seen = np.array([np.isfinite(lag).any(axis=0) for lag in slips.lag_mm])
    missing = ~seen
    stretch = np.where(slips.slid, slips.stretch_mm, np.nan)
    for r in np.unique(ring[ring >= 0]):
        these = ring == r
        for i in range(len(seen)):
            own = stretch[i, these]
            held = np.isfinite(own).sum() >= max(these.sum() / 2, 2)
            if held and np.nanmedian(own) >= LOADED_MM:
                missing[i, these] |= slips.free[i, these]
    return float(missing.mean(axis=0).max())


CELL_MM = 2.0
LEAST_IN_CELL_MM = 0.5
"""A tip's path in a cell counts from this length on."""
FEWEST_IN_CELL = 3
LEAST_LAG_MM = 0.3
"""Lags that are smaller depend more on heights and on the arm's tremor than on friction."""
_CELLS = 10_000
"""More than there are along an axis of the plate."""


def largest_spot(slips: SlideSlips, growth: Growth) -> float:
    """Largest deviation of the lags in a cell of the plate from each papilla's own, over its error.

    A papilla's lag in a cell is compared with its median over all cells at that depth. The error
    is that of a mean of paths through the cell, by their scatter.
    """
    parts = [_lags_in_cells(slips, i, growth) for i in range(len(slips.trials))]
    own, cell, lag = (np.concatenate(column) for column in zip(*parts, strict=True))
    off = np.full(len(lag), np.nan)
    for one in np.unique(own):
        these = own == one
        middle = np.median(lag[these])
        if these.sum() >= FEWEST_IN_CELL and middle >= LEAST_LAG_MM:
            off[these] = lag[these] / middle - 1.0
    known = np.isfinite(off)
    if known.sum() < 10:
        return float("nan")
    off = off[known] - np.median(off[known])
    scatter = max(1.4826 * float(np.median(np.abs(off))), 1e-6)
    _, index = np.unique(cell[known], return_inverse=True)
    count = np.bincount(index)
    total = np.abs(np.bincount(index, off))
    full = count >= FEWEST_IN_CELL
    return float(np.max(total[full] / np.sqrt(count[full])) / scatter) if full.any() else np.nan


def _lags_in_cells(slips: SlideSlips, i: int, growth: Growth) -> tuple[I64, I64, F64]:
    """Return the mean lag of each path of a sliding tip through a cell, mm, in one slide.

    Returns:
        Three arrays (paths,): a number for papilla and depth, one for the cell, and the lag.
    """
    trial, which = slips.trials[i], slips.depths[1]
    m = slips.slipped_s.shape[1]
    lag, _ = settled_lags(slips, i, growth)
    moving = (trial.frame_s >= 0.0) & (trial.frame_s <= trial.slide_s)
    step = np.abs(np.diff(slips.path_mm[i], axis=0, prepend=np.nan))
    seen = np.isfinite(lag) & np.isfinite(step)
    j = np.nonzero(seen)[1]
    across, up = np.floor(trial.tips_mm[moving][seen] / CELL_MM).astype(np.int64).T
    place = (across + _CELLS // 2) * _CELLS + up + _CELLS // 2
    path, index, count = np.unique(place * m + j, return_inverse=True, return_counts=True)
    long = np.bincount(index, step[seen]) >= LEAST_IN_CELL_MM
    mean = np.bincount(index, lag[seen]) / np.maximum(count, 1)
    return which[i] * m + path[long] % m, path[long] // m, mean[long]


# -- poses -------------------------------------------------------------------------------------


def ramp_mm(trials: Sequence[PilotTrial]) -> float:
    """Mean distance by which the reported motion stays behind constant speed at a slide's ends, mm.

    The constant speed is that of the middle half. An acceleration a costs v^2 / 2a at either end.
    """
    found = []
    for trial in trials:
        t, path = trial.frame_s, trial.base_mm @ trial.slide.direction
        middle = (t > 0.25 * trial.slide_s) & (t < 0.75 * trial.slide_s)
        before, after = t <= 0.0, t >= trial.slide_s
        moving = (t >= 0.0) & (t <= trial.slide_s)
        if middle.sum() < 10 or not before.any():
            continue
        speed, begin = np.polynomial.Polynomial.fit(t[middle], path[middle], 1).convert().coef[::-1]
        first = path[before].mean() - begin
        # recordings may end with the slide
        if after.any():
            last = begin + speed * trial.slide_s - path[after].mean()
        else:
            last = begin + speed * t[moving][-1] - path[moving][-1]
        found.append(0.5 * (first + last))
    return abs(float(np.mean(found))) if found else float("nan")


# -- events ------------------------------------------------------------------------------------

BAND_HZ = (20.0, 500.0)
SPAN_S = 1.0
"""Events are looked at for so long at a time, which sets the width of a line."""
BAND = np.arange(round(BAND_HZ[0] * SPAN_S), round(BAND_HZ[1] * SPAN_S) + 1)
STEP_US = 20
"""Events are counted by so many microseconds: short against the scans of a read-out, whose aliases
would be lines."""
ROUND_HZ = 20.0
"""The noise at a frequency is the median so far on either side."""
FEWEST_EVENTS = 100


def line_over_noise(trials: Sequence[PilotTrial]) -> float:
    """Power of the strongest line in the rate of events over the noise about it, in the hold.

    Spectra of seconds, of each polarity by itself, are divided by their own noise and then
    averaged, as the phase of a light differs from slide to slide. The mean is that of log(1 + x):
    a single second does not make a line. Without a light 0.8 of the noise is expected, and of the
    largest of many frequencies some 1.5. NaN without events.
    """
    total, spans = np.zeros(len(BAND)), 0
    span_us = round(SPAN_S * 1e6)
    count = span_us // STEP_US
    around = 2 * round(ROUND_HZ * SPAN_S) + 1
    for trial in trials:
        if trial.camera is None:
            continue
        events = trial.camera.events
        for start in range(-span_us, round(trial.hold_s * 1e6) - 1, -span_us):
            part = slice(*np.searchsorted(events.t_us, (start, start + span_us)).tolist())
            step = (events.t_us[part] - start) // STEP_US
            for positive in (True, False):
                own = step[(events.p[part] > 0) == positive]
                if len(own) < FEWEST_EVENTS:
                    continue
                rate = np.bincount(own, minlength=count)
                power = np.abs(np.fft.rfft(rate - rate.mean())) ** 2
                # the median needs frequencies beyond the band, too
                power = power[: BAND[-1] + around]
                noise = median_filter(power, around)[BAND] / np.log(2.0)
                total += np.log1p(power[BAND] / np.maximum(noise, 1e-12))
                spans += 1
    return float(np.expm1(total.max() / spans)) if spans else float("nan")


# -- all statistics ----------------------------------------------------------------------------

FOLDS = 5
FAR = 5.0
"""Statistics are cut off so many spreads from their median; one that the pilot lacks counts as so
far off."""
SEEN = 0.95
"""Share of worlds that must have a statistic."""
RIDGE = 0.01
"""Added to variances, of statistics of unit spread."""
FORCE_NAMES = (
    "normal_n",
    "normal_lost",
    "ratio",
    "ratio_per_speed",
    "stiffness_n_per_mm",
    "hold_relaxing_share",
    "hold_relaxation_s",
    "youngs_modulus_mpa",
)


def stream_of(statistic: str) -> Stream:
    """Return the stream that shows a statistic of contact or camera."""
    if statistic in camera_estimates.NAMES:
        return "events"
    force = statistic in FORCE_NAMES or statistic.startswith("pull_ring")
    return "force" if force else "frames"


def distances(s: F64, observed: F64) -> tuple[F64, float]:
    """Return how far each world's statistics are from the other worlds', and the pilot's from them.

    Mahalanobis distances over the root of the number of statistics. Each world is compared with
    the mean and covariance of worlds that it is not among, and the pilot with all of these.

    Args:
        s: (k, q), some NaN. observed: (q,), some NaN.
    """
    finite = np.isfinite(s)
    s, observed, finite = (a[..., finite.mean(axis=0) >= SEEN] for a in (s, observed, finite))
    lower, centre, upper = np.nanpercentile(np.where(finite, s, np.nan), [25, 50, 75], axis=0)
    moving = upper > lower
    s, observed, centre = s[:, moving], observed[moving], centre[moving]
    scale = (upper - lower)[moving] / 1.349
    q = len(scale)
    if q == 0:
        return np.full(len(s), np.nan), float("nan")
    x = np.clip(np.where(np.isfinite(s), (s - centre) / scale, 0.0), -FAR, FAR)
    y = np.clip(np.where(np.isfinite(observed), (observed - centre) / scale, FAR), -FAR, FAR)
    found, own = np.empty(len(x)), np.empty(FOLDS)
    part = np.arange(len(x)) % FOLDS
    for fold in range(FOLDS):
        others = x[part != fold]
        inverse = np.linalg.inv(np.atleast_2d(np.cov(others.T)) + RIDGE * np.eye(q))
        off, off_y = x[part == fold] - others.mean(axis=0), y - others.mean(axis=0)
        found[part == fold] = np.einsum("ij,jk,ik->i", off, inverse, off)
        own[fold] = off_y @ inverse @ off_y
    return np.sqrt(found / q), float(np.sqrt(own.mean() / q))


# -- the verdict -------------------------------------------------------------------------------

_LEAST_TAIL = 0.1
"""Numbers of the worlds are taken to scatter in their tail by at least so much, relative; where the
numbers themselves are looked at, by their floor."""


@dataclass(frozen=True)
class Tail:
    """The largest values of a number in the worlds: log(value + floor) has an exponential tail.

    A posterior predictive distribution (prior 1 / mean): with few worlds it is wider. It is longer
    than that of a normal or log-normal number. What is near to normal has an exponential tail
    itself, in units of the floor (`linear`), which is still longer.

    Attributes:
        values: of the worlds, sorted, transformed, (n,). floor, linear: see `MisfitTest`.
    """

    values: F64
    floor: float
    linear: bool = False

    @classmethod
    def of(cls, values: F64, floor: float, linear: bool = False) -> Tail:
        """Return the tail of some worlds' values."""
        tail = cls(values, floor, linear)
        return replace(tail, values=np.sort(tail._scaled(values)))

    def _scaled(self, values: F64) -> F64:
        positive = np.maximum(values, 0.0)
        result: F64 = positive / self.floor if self.linear else np.log(positive + self.floor)
        return result

    @property
    def _shape(self) -> tuple[int, float, float]:
        """Return how many worlds make the tail, where it begins and the sum of their excesses."""
        k = max(round(TAIL * len(self.values)), 2)
        begin = float(self.values[-k - 1])
        least = 1.0 if self.linear else _LEAST_TAIL
        return k, begin, max(float((self.values[-k:] - begin).sum()), k * least)

    def share(self, value: float) -> float:
        """Return the probability of at least this value."""
        k, begin, total = self._shape
        x = float(self._scaled(np.array(value)))
        if x <= begin:
            return float((self.values >= x).mean())
        return float(k / len(self.values) * (1.0 + (x - begin) / total) ** -k)

    def limit(self, share: float) -> float:
        """Return the value that is reached with a probability, which is less than `TAIL`."""
        k, begin, total = self._shape
        x = begin + total * ((k / len(self.values) / share) ** (1.0 / k) - 1.0)
        return float(x * self.floor if self.linear else np.exp(x) - self.floor)


def misfits(
    numbers: Mapping[str, float],
    worlds: Sequence[Mapping[str, float]],
    names: Sequence[str],
    observed: F64,
    s: F64,
) -> tuple[MisfitCheck, ...]:
    """Return the checks of a pilot, misfits first; the first one says which stream shows it.

    A check for one kind of effect comes before those of all statistics: it says more. Those of
    the frames' picture come first, and then those of times and trends, since all others show them,
    too. Checks that the pilot does not determine, or that fewer than `FEWEST` worlds do, are left
    out.

    Args:
        numbers: of the pilot, see `misfit_numbers`. worlds: those of k simulated worlds.
        names: of q statistics. observed: of the pilot, (q,). s: of the worlds, (k, q); logarithms
            where they are positive.
    """
    tried: list[tuple[MisfitTest, float, F64]] = []
    for check in CHECKS:
        values = np.array([world[check.key] for world in worlds], np.float64)
        values, value = values[np.isfinite(values)], numbers[check.key]
        if check.signed and len(values):
            middle = float(np.median(values))
            values, value = np.abs(values - middle), abs(value - middle)
        tried.append((check, value, values))
    streams = np.array([stream_of(name) for name in names])
    for stream, title in GENERAL.items():
        own = streams == stream
        if len(s) >= FEWEST and np.isfinite(observed[own]).any():
            values, value = distances(s[:, own], observed[own])
            check = MisfitTest("", title, stream, "distance", 0.1, SHOWN_BY[stream])
            tried.append((check, value, values[np.isfinite(values)]))
    tried = [it for it in tried if np.isfinite(it[1]) and len(it[2]) >= FEWEST]
    found = []
    for check, value, values in tried:
        alike = sum(other.setup == check.setup for other, *_ in tried)
        level = (SETUP_LEVEL if check.setup else LEVEL - SETUP_LEVEL) / alike
        tail = Tail.of(values, check.floor, check.setup)
        share = tail.share(value)
        general = check.key == ""
        found.append(
            (
                (share >= level, general, not check.setup, check.key not in VIEWS, share),
                MisfitCheck(
                    title=check.title,
                    stream=check.stream,
                    unit=check.unit,
                    pilot=value,
                    limit=tail.limit(level),
                    share=share,
                    found=share < level,
                    touches=tuple(it.key for it in PARAMETERS if it.key in check.touches),
                ),
            )
        )
    return tuple(check for _, check in sorted(found, key=lambda it: it[0]))
