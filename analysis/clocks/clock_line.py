"""A clock's line through pulses of which some may be wrong: straight, or bent as the clock is.

A crystal that warms up drifts by a few ppm more at the end of a trial than at its beginning; a
straight line is then wrong by a hundred microseconds and does not know it. So the line gets a knot
wherever the drift changes beyond chance, and each piece between such knots is cut into some more.
Without such a knot the residuals choose between one piece and four (Akaike 1974). Where the line
stays straight, the bends that chance may hide are in the stated uncertainty. That is the 95 %
quantile of the largest error anywhere between the first and the last pulse. A clock that jumps has
no line: a step is looked for at every pulse, along with each knot.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import special

from sliplab.analysis.clocks.pulse_kernels import (
    changes,
    largest_sizes,
    median,
    normal_equations,
    places_of,
    quantile,
    residuals_at,
    robust_values,
)

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]

_HUBER = 1.345
_GATE = 5.0
_ROUGHLY, _EXACTLY = 1e-2, 1e-3
"""Convergence: largest change of an estimate in a step, standard deviations of a pulse."""
_MOST_KNOTS = 24
_PIECE_PULSES = 30
_PIECES = 4
"""Pieces of a clock that bends without a knot; one with knots is cut into twice as many as it has.
"""
_BEND = 2.0
"""A clock is straight where pieces explain less of the squares than this for each knot that joins
them (Akaike 1974): of straight clocks 11 % get four pieces."""
_HIDDEN = 0.8
"""Variance of a bend that a straight line hides, in that with which the pulses show it."""
_MOVED_KNOTS = 4
"""Up to this number of knots, each is moved to its best place when one is added."""
_BLOCK_PULSES = 12
_CHANCE = 1e-4
"""False-positive rate of knots for straight clocks with locked stamps."""
_KNOT = 3.5
"""Change of the drift, in standard deviations, that adds a knot."""
STEP, STEP_AT_END = 5.5, 4.5
"""Detection thresholds of a clock's jump, in sigma: among thousands of places, or at an end."""
_MORE_LIKELY, _MORE = 12.0, 1.1
"""By how much and by what share more of the squares a step must explain than a change of drift: of
a clock that bends smoothly a step explains less than a bend does, of one that jumps 1.5 times as
much in the median over the places of the jump."""
_AS_LIKELY = 6.0
"""A change of drift that explains more of the squares than a step by less than this leaves the step
a probability of 5 % (19 to 1 is exp(6 / 2)): it is part of what is stated with 95 %."""
_DOUBT, _DOUBT_AT_END = 4.0, 3.0
"""A step of so many may be one: what it would do is added to the uncertainty."""
_TURN = 4.5
"""Change of the drift, in standard deviations, that adds a piece over pulses left out at an end:
they were left out because they lie off the line, so chance alone gives 3.5."""
_CLIP = 3.0
"""Clip of residuals at an end, standard deviations."""
_TAIL = 10
"""So many pulses at an end are left out at the most, late ones among them: less than half a second
at 100 ticks a second."""
_DRAWS = 2048
_SLOPES = 81
_UNITS = 0.6
"""Largest distance of stamps from a line that their unit explains, in units: half, and jitter."""


def theil_sen(x: Floats, y: Floats) -> tuple[float, float]:
    """Median of the slopes between pulses half the train apart, and the median level at x = 0.

    Not all n**2 pairs, as in Theil (1950) and Sen (1968): near pairs say little about the slope.
    The breakdown point is 25 %.
    """
    half = x.size // 2
    run = x[half : 2 * half] - x[:half]
    far = run > 0
    rise = y[half : 2 * half] - y[:half]
    if far.all():
        slope = median(rise / run) if half else 0.0
    else:
        slope = median(rise[far] / run[far]) if far.any() else 0.0
    return slope, median(y - slope * x)


@dataclass(frozen=True)
class ClockLine:
    """Straight lines that join at knots, and how well pulses lie on them.

    Attributes:
        knots, values: (k + 1,) x and y of the knots, first and last pulse included, ns.
        residuals: (n,) y less the line at every pulse, ns.
        inside: (n,) whether a pulse lies on the line, within 5 sigma.
        sigma: scatter of the pulses on the line, ns.
        uncertainty: largest error of the line from the first to the last knot, 95 %, ns.
        sudden: how far the line may be off next to where its slope changes faster than a clock
            bends, ns.
        jump: by how much the clock jumped somewhere, ns; 0 if it did not.
        straightened: whether what is left over looks like chance.
        unverified: number of pieces at either end that follow pulses which nothing confirms;
            uncertainty, slopes and sudden are of the others.
    """

    knots: Floats
    values: Floats
    residuals: Floats
    inside: Bools
    sigma: float
    uncertainty: float
    sudden: float
    jump: float
    straightened: bool
    unverified: tuple[int, int] = (0, 0)

    @property
    def span(self) -> tuple[float, float]:
        """First and last x between which pulses confirm the line, ns."""
        return float(self.knots[self.unverified[0]]), float(self.knots[-1 - self.unverified[1]])

    @cached_property
    def residual_p95(self) -> float:
        """95th percentile of the absolute residuals of the pulses on the line, ns."""
        return quantile(np.abs(self.residuals[self.inside]), 0.95)

    @cached_property
    def slopes(self) -> Floats:
        """Slope of each piece."""
        every: Floats = np.diff(self.values) / np.diff(self.knots)
        return every[self.unverified[0] : every.size - self.unverified[1]]


def fit_line(x: Floats, y: Floats, resolution: float, bend_per_ns: float) -> ClockLine:
    """The line of a clock through pulses at rising x, with as few knots as the residuals allow.

    Args:
        x: (n,) times of the pulses, rising, ns.
        y: (n,) what the other clock gained there, ns.
        resolution: unit of the stamps, ns: where nothing shakes them, means that differ by less
            than half of it are no bend.
        bend_per_ns: by how much a slope may change in a nanosecond.
    """
    slope, level = theil_sen(x, y)
    floor = max(0.3 * resolution, 0.5)
    rough = y - slope * x - level
    # scatter between neighbours is free of any bend
    local = max(1.4826 * median(np.abs(rough[1:] - rough[:-1])) / 2**0.5, floor)
    knots, all_x, all_y = x[[0, -1]], x, y
    values, moved = slope * knots + level, True
    left_out, mistaken = 0, 0.0
    while True:
        values, residuals, inside, sigma = _robust(x, y, knots, values, floor, _ROUGHLY)
        noise = min(local, sigma)
        # a unit that nothing shakes hides what is smaller
        locked = resolution / 2 > noise
        found = _changes(x, knots, residuals, inside, _HUBER * sigma, noise)
        step = _jump(found, resolution if locked else 0.0)
        if locked:
            straight = _is_chance(residuals[inside], knots.size, noise, resolution / 2)
        else:
            straight = found.knot < _KNOT
        pieces = knots.size - 1
        tail = min(found.tail_at, x.size - found.tail_at)
        doubtful = found.tail > max(_DOUBT_AT_END, 0.0 if straight else found.knot)
        doubtful = doubtful and found.knot < STEP and not (step or locked)
        if doubtful and left_out < 2 and tail <= min(_TAIL, x.size // 4):
            # a jump, a bend or chance: the data that would distinguish them come after the end
            left_out += 1
            behind = found.tail_at
            stays = slice(behind, None) if 2 * behind < x.size else slice(behind)
            x, y = x[stays], y[stays]
            before = knots
            knots = np.concatenate([x[:1], knots[(knots > x[0]) & (knots < x[-1])], x[-1:]])
            values = np.interp(knots, before, values)
            continue
        if straight or (step and moved):
            break
        before = knots
        if not step:
            if pieces > min(_MOST_KNOTS, int(inside.sum()) // _PIECE_PULSES - 1):
                break
            if found.step > found.knot or _as_likely(found):
                # a step may be taken for a change of drift, and hides in the knot from then on
                mistaken = max(mistaken, abs(found.step_size))
            knots = np.sort(np.append(knots, x[found.knot_at]))
        # a knot off its place leaves a step there
        moved = bool(step) or pieces <= _MOVED_KNOTS
        if moved:
            knots = _moved(x, y, knots, inside, noise)
        values = np.interp(knots, before, values)
    at, hidden = knots[1:-1], None
    if not step:
        finer = knots if locked else _cut(x[inside], knots)
        if knots.size == 2 < finer.size:
            values, residuals, inside, sigma = _robust(x, y, knots, values, floor, _EXACTLY)
            hidden = _hidden(x, finer.size - 1, residuals, inside, sigma)
        if hidden is None:
            values, knots = np.interp(finer, knots, values), finer
            values, residuals, inside, sigma = _robust(x, y, knots, values, floor, _EXACTLY)
    line = _judged(x, knots, at, values, residuals, inside, sigma, resolution, bend_per_ns, hidden)
    line = replace(
        line,
        uncertainty=line.uncertainty + max(_doubt(found), mistaken),
        jump=step,
        straightened=bool(straight),
    )
    return _followed(line, all_x, all_y) if left_out else line


def _followed(line: ClockLine, x: Floats, y: Floats) -> ClockLine:
    """Return the line with a further, unconfirmed piece over the pulses that were left out."""
    (knots, values), unverified = (line.knots, line.values), [0, 0]
    for end in (0, -1):
        away = x - line.knots[end]
        rest = y - gained(x, line.knots, line.values)
        left = (away > 0 if end else away < 0) & (np.abs(rest) <= _GATE * line.sigma)
        square = float((away[left] ** 2).sum())
        top = float((away[left] * rest[left]).sum())
        # chance alone turns a line by little
        if abs(top) > _TURN * line.sigma * square**0.5:
            unverified[end], turn = 1, top / square
            value = gained(x[[end]], line.knots, line.values) + turn * away[end]
            order = slice(None, None, -1 if end else 1)
            knots = np.concatenate((x[[end]], knots)[order])
            values = np.concatenate((value, values)[order])
    residuals: Floats = y - gained(x, knots, values)
    inside: Bools = np.abs(residuals) <= _GATE * line.sigma
    return replace(
        line,
        knots=knots,
        values=values,
        residuals=residuals,
        inside=inside,
        unverified=(unverified[0], unverified[1]),
    )


def gained(x: Floats, knots: Floats, values: Floats) -> Floats:
    """Return the line at x, extrapolated linearly beyond its ends."""
    piece, share = places_of(x, knots)
    result: Floats = -residuals_at(piece, share, np.zeros(x.size), values)
    return result


def _cut(x: Floats, knots: Floats) -> Floats:
    """Knots with more between them, about `_PIECES` or twice as many pieces as there are."""
    pieces = knots.size - 1
    required = min(max(_PIECES, 2 * pieces), max(x.size // _PIECE_PULSES, 1))
    length = (knots[-1] - knots[0]) / required
    parts = [knots[:1]]
    for begin, end in pairwise(knots):
        count = max(1, int(np.ceil((end - begin) / length - 0.25)))
        parts.append(np.linspace(begin, end, count + 1)[1:])
    return np.concatenate(parts)


@dataclass(frozen=True)
class _Changes:
    """Largest deviations in the residuals, in standard deviations under chance, and their places.

    knot, knot_at: a change of the drift, and its pulse.
    step, step_size: a step, and its size in ns.
    end, end_size: the same within some pulses of an end.
    tail, tail_size, tail_at: the mean of some pulses at an end, for which large residuals count
        as they are; and the first pulse behind that step.
    """

    knot: float
    knot_at: int
    step: float
    step_size: float
    end: float
    end_size: float
    tail: float
    tail_size: float
    tail_at: int


def _changes(
    x: Floats, knots: Floats, residuals: Floats, inside: Bools, limit: float, noise: float
) -> _Changes:
    piece, share = places_of(x, knots)
    rest = np.where(inside, residuals, np.inf)
    gate = float(np.abs(residuals[inside]).max())
    matrix = normal_equations(piece, share, np.zeros(x.size), rest, gate, limit, knots.size)[0]
    found = changes(
        (x - x[0]) / (x[-1] - x[0]),
        piece,
        share,
        rest,
        gate,
        limit,
        _CLIP * noise,
        np.linalg.inv(_held(matrix)),
        max(1, x.size * knots.size**2 // 60_000),
        _PIECE_PULSES // 2,
    )
    knot, at, step, step_size, end, end_size, tail, tail_size, tail_at = found
    return _Changes(
        knot / noise,
        int(at),
        step / noise,
        step_size,
        end / noise,
        end_size,
        tail / noise,
        tail_size,
        int(tail_at),
    )


def _jump(found: _Changes, hidden: float) -> float:
    """Return the size of a step that is significant, no drift change, and not hidden; else 0."""
    bent = max(found.knot**2 + _MORE_LIKELY, _MORE * found.knot**2)
    if found.step**2 > max(STEP**2, bent) and abs(found.step_size) > hidden:
        return found.step_size
    if found.end**2 > max(STEP_AT_END**2, bent) and abs(found.end_size) > hidden:
        return found.end_size
    return 0.0


def _as_likely(found: _Changes) -> bool:
    """Check that a step large enough for a jump is not ruled out by a change of the drift."""
    return found.step > STEP and found.step**2 > found.knot**2 - _AS_LIKELY


def _doubt(found: _Changes) -> float:
    """Error by a step that may be there, ns: half of it on either side."""
    middle = 0.5 * abs(found.step_size) if found.step > _DOUBT else 0.0
    return max(middle, abs(found.end_size) if found.end > _DOUBT_AT_END else 0.0)


def _moved(x: Floats, y: Floats, knots: Floats, inside: Bools, noise: float) -> Floats:
    """Each inner knot in turn where it fits best while the others stay."""
    rest = np.where(inside, 0.0, np.inf)
    for _ in range(1 if knots.size == 3 else 2):
        for k in range(1, knots.size - 1):
            others = np.delete(knots, k)
            piece, share = places_of(x, others)
            level = np.where(inside, y, 0.0)
            matrix, right = normal_equations(piece, share, level, rest, 1.0, 1.0, others.size)
            values: Floats = np.linalg.solve(_held(matrix), right)
            residuals = residuals_at(piece, share, y, values)
            found = _changes(x, others, residuals, inside, np.inf, noise)
            if found.knot > 0:
                knots = np.sort(np.append(others, x[found.knot_at]))
    return knots


def line_within_unit(x: Floats, y: Floats, resolution: float, drift: float) -> ClockLine | None:
    """The straight line that is never further from a stamp than its unit explains.

    Stamps cut to a unit in step with the ticks, such as 2 ms and 10 ms, do not change until the
    clocks have drifted past a unit's edge, and then all move by one unit: in a short train a
    regression takes that for a drift. Every stamp bounds the clock all the same.

    Args:
        drift: the most that the slope may be, either way.

    Returns:
        None if no slope that is allowed does it. Its uncertainty holds for every error within
        the unit: half of it, and how far the stamps lie from the line.
    """
    slopes = np.linspace(-drift, drift, _SLOPES)
    spans = np.array([np.ptp(y - slope * x) for slope in slopes])
    near = np.flatnonzero(spans <= spans.min() + 1.0)
    slope = float(slopes[near[near.size // 2]])
    rest = y - slope * x
    level, away = float(rest.max() + rest.min()) / 2, float(np.ptp(rest)) / 2
    if away > _UNITS * resolution:
        return None
    knots = x[[0, -1]]
    residuals = rest - level
    sigma = max(float(np.sqrt((residuals**2).mean())), 0.5)
    everything = np.ones(x.size, np.bool_)
    uncertainty = 1.0 + resolution / 2 + away
    return ClockLine(
        knots, slope * knots + level, residuals, everything, sigma, uncertainty, 0.0, 0.0, True
    )


def _robust(
    x: Floats, y: Floats, knots: Floats, values: Floats, floor: float, until: float
) -> tuple[Floats, Floats, Bools, float]:
    """Huber's M-estimate of the values at knots on what lies inside 5 robust sigma."""
    piece, share = places_of(x, knots)
    values, residuals, inside = robust_values(
        piece, share, y, np.interp(x, knots, values), values, floor, _GATE, _HUBER, until
    )
    sigma = float(np.sqrt((residuals[inside] ** 2).sum() / max(1, inside.sum() - knots.size)))
    return values, residuals, inside, max(sigma, floor)


def _held(matrix: Floats) -> Floats:
    """Normal equations in which a piece with a single pulse depends on its neighbours."""
    n = matrix.shape[0]
    matrix.flat[:: n + 1] += 1e-12 * matrix.trace() / n
    return matrix


def _is_chance(residuals: Floats, parameters: int, sigma: float, slack: float) -> bool:
    """Check that the means of stretches of the train are as small as chance makes them."""
    blocks = min(max(8, 4 * (parameters - 1)), residuals.size // _BLOCK_PULSES)
    if blocks <= parameters:
        return True
    edges = np.linspace(0, residuals.size, blocks + 1).round().astype(np.int64)
    counts = np.diff(edges)
    means = np.add.reduceat(residuals, edges[:-1]) / counts
    # a unit that nothing shakes hides what is smaller
    excess = np.maximum(np.abs(means) - (slack if slack > sigma else 0.0), 0.0)
    square = float((excess**2 * counts).sum()) / sigma**2
    return square <= float(special.chdtri(blocks - parameters, _CHANCE))


def _judged(
    x: Floats,
    knots: Floats,
    at: Floats,
    values: Floats,
    residuals: Floats,
    inside: Bools,
    sigma: float,
    resolution: float,
    bend_per_ns: float,
    hidden: _Hidden | None,
) -> ClockLine:
    """The line with its uncertainty; `at` are the knots whose places were fitted to the pulses."""
    inner, n = residuals[inside], knots.size
    if hidden is not None:
        ends, away = hidden.covariance, hidden.bend
    else:
        piece, share = places_of(x[inside], knots)
        none = np.zeros(inner.size)
        matrix = _held(normal_equations(piece, share, none, none, np.inf, np.inf, n)[0])
        variance = float((_influence(inner, sigma) ** 2).mean())
        variance *= inner.size / max(1, inner.size - n - at.size)
        ends = _with_places(matrix, piece, share, np.searchsorted(knots, at)) * variance
        away = np.zeros(ends.shape[0])
    count = ends.shape[0]
    root = np.zeros((count + 1, count + 1))
    root[1:, 0] = away
    root[1:, 1:] = np.linalg.cholesky(ends + (1e-12 * ends.trace() / count + 1e-6) * np.eye(count))
    # between knots the error is no larger than at one of them
    largest = largest_sizes(_draws(count), root)
    band = float(np.partition(largest, int(0.95 * _DRAWS))[int(0.95 * _DRAWS)])
    band *= float(special.stdtrit(max(1, inner.size - n - at.size), 0.975)) / 1.959964
    sudden = 0.0
    if n > 2:
        run = np.diff(knots)
        # slopes' changes as a linear function of the values
        to_change = np.zeros((n - 2, n))
        here = np.arange(n - 2)
        to_change[here, here], to_change[here, here + 2] = 1 / run[:-1], 1 / run[1:]
        to_change[here, here + 1] = -1 / run[:-1] - 1 / run[1:]
        changed = np.abs(to_change @ values)
        covariance = variance * np.linalg.inv(matrix)
        chance = np.sqrt(np.einsum("ij,jk,ik->i", to_change, covariance, to_change))
        spans, longest = 0.5 * (run[:-1] + run[1:]), np.maximum(run[:-1], run[1:])
        faster = np.maximum(changed - chance - bend_per_ns * spans, 0.0) * longest / 2
        sudden = float(faster.max())
    uncertainty = 1.0 + band + _locked(inner, resolution)
    return ClockLine(knots, values, residuals, inside, sigma, uncertainty, sudden, 0.0, True)


def _influence(residuals: Floats, sigma: float) -> Floats:
    """Return each pulse's influence on Huber's estimate (Huber 1964): psi / E psi', ns.

    Their mean square is the estimate's asymptotic variance for a single pulse.
    """
    limit = _HUBER * sigma
    linear = max(float((np.abs(residuals) < limit).mean()), 0.1)
    result: Floats = np.clip(residuals, -limit, limit) / linear
    return result


@dataclass(frozen=True)
class _Hidden:
    """Possible error of a straight line at some knots, ns: chance, and an undetected bend.

    Attributes:
        bend, covariance: (k,) mean and (k, k) covariance of the error.
    """

    bend: Floats
    covariance: Floats


def _hidden(
    x: Floats, pieces: int, residuals: Floats, inside: Bools, sigma: float
) -> _Hidden | None:
    """Judge the residuals of a straight line for bends between pieces; None if there are some.

    Pieces have equally many pulses, so a stretch without pulses is in no piece. Which bends are
    hidden is judged for halves of them: a bend near an end lies within the first. Each bend has
    mean 0 and `_HIDDEN` times the variance with which the pulses show it (the g-prior of Zellner
    1986).
    """
    x, apparent = x[inside], _influence(residuals[inside], sigma)
    finer = x[np.linspace(0, x.size - 1, 2 * pieces + 1).astype(np.int64)]
    piece, share = places_of(x, finer)
    none = np.zeros(x.size)
    matrix, right = normal_equations(piece, share, apparent, none, np.inf, np.inf, finer.size)
    variance = float((apparent**2).mean()) * x.size / max(1, x.size - 2)
    hats = _between(finer[::2], finer)
    found = hats.T @ right
    if float(found @ np.linalg.solve(_held(hats.T @ matrix @ hats), found)) > (
        _BEND * variance * (pieces - 1)
    ):
        return None
    ends = _between(finer[[0, -1]], finer)
    straight = ends @ np.linalg.inv(ends.T @ matrix @ ends) @ ends.T
    bent = np.linalg.inv(_held(matrix))
    part = _HIDDEN / (1.0 + _HIDDEN)
    covariance = variance * (straight + part * (bent - straight))
    return _Hidden(part * bent @ right, covariance)


def _between(knots: Floats, x: Floats) -> Floats:
    """Return the interpolation matrix from knots to x, (x, knots)."""
    piece, share = places_of(x, knots)
    result, row = np.zeros((x.size, knots.size)), np.arange(x.size)
    result[row, piece], result[row, piece + 1] = 1.0 - share, share
    return result


def _with_places(matrix: Floats, piece: Ints, share: Floats, places: Ints) -> Floats:
    """Covariance of the values at knots, for pulses of variance 1; twice where a place was fitted.

    A knot that is slightly off makes the line wrong by a step there, to first order (Seber and
    Wild 1989, section 9.4): it has one value before and one behind. `matrix` are the normal
    equations of the values, `places` (p,) which knots these are.
    """
    n, count = matrix.shape[0], places.size
    if not count:
        return np.asarray(np.linalg.inv(matrix), np.float64)
    hats = np.zeros((n - 1, n))
    here = np.arange(n - 1)
    hats[here, here] = np.bincount(piece, 1.0 - share, n - 1)
    hats[here, here + 1] = np.bincount(piece, share, n - 1)
    behind = np.cumsum(hats[::-1], axis=0)[::-1][places]
    pulses = np.cumsum(np.bincount(piece, minlength=n - 1)[::-1])[::-1][places]
    whole = np.zeros((n + count, n + count))
    whole[:n, :n], whole[n:, :n], whole[:n, n:] = matrix, behind, behind.T
    whole[n:, n:] = pulses[np.maximum.outer(np.arange(count), np.arange(count))]
    transform = np.eye(n + count)
    transform[:n, n:] = np.arange(n)[:, None] > places
    # behind each place: the value of its knot, and all steps up to its own
    transform[n:, n:] = np.tri(count)
    transform[n + np.arange(count), places] = 1.0
    result: Floats = transform @ np.linalg.inv(_held(whole)) @ transform.T
    return result


def _locked(residuals: Floats, resolution: float) -> float:
    """Error, ns, that stamps cut to a unit hide where no jitter shakes them.

    Jitter spreads stamps over units, and their mean finds the middle; what is left falls as
    exp(-2 pi^2 sigma^2 / unit^2) (Widrow and Kollar 2008), and is half a unit without any jitter.
    """
    if resolution == 0.0 or residuals.size < 2:
        return 0.0
    shaken = 1.4826 * median(np.abs(residuals[1:] - residuals[:-1])) / 2**0.5 / resolution
    return 0.5 * resolution * float(np.exp(-2 * np.pi**2 * shaken**2))


@lru_cache(maxsize=16)
def _draws(n: int) -> Floats:
    """Return 1 and n normal numbers, the same at every call, (draws, 1 + n)."""
    normal = np.random.default_rng(n).standard_normal((_DRAWS, n))
    return np.asfortranarray(np.column_stack((np.ones(_DRAWS), normal)))
