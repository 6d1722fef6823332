"""The clock map of a device, from the coded pulses it saw, or a reason why there is none.

Camera, arm and sync box each stamp the same pulses with clocks that started on different days. The
pulses are coded, so the trains fit together at one place only; `clocks.pulse_match`
finds that place and the pairs, `analysis.clocks.clock_line` the line through them, and this file
says whether to trust it. It must say no rather than be wrong: a regular train, which fits
everywhere, is refused, and so is one whose residuals are not jitter (docs/clocks.md).

Times stay int64; floats hold differences only.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any, Literal, cast

import numpy as np
from numpy.typing import NDArray

from sliplab.analysis.clocks.clock_line import (
    STEP,
    STEP_AT_END,
    ClockLine,
    fit_line,
    gained,
    line_within_unit,
)
from sliplab.analysis.clocks.pulse_kernels import median
from sliplab.analysis.clocks.pulse_losses import (
    better_shift,
    on_ticks,
    staggered_ends,
    stray_stretch,
    unevenness,
)
from sliplab.analysis.clocks.pulse_match import (
    MIN_PULSES,
    WIRED,
    Match,
    NoMatchError,
    match_trains,
    tick_of,
)
from sliplab.protocols.shown import plural
from sliplab.storage.clockmap import ClockMap

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]

Reason = Literal["too_few_pulses", "ambiguous", "no_match", "drift", "residuals"]
Rounding = Literal["down", "up", "nearest"]

MIN_MATCHED = 0.7
"""Share of pulses that must find a partner; a wrong lag on the same tick grid gives 0.5."""
MIN_LOSSY, MIN_LIFT = 100, 1.5
"""A smaller share will do where both trains lost many pulses: of so many pulses and so many times
what a wrong lag gives. In such a train a jump by whole ticks, after which half of the pulses match
others, shows only where there are many."""
MOST_STAGGERED = 8
"""So many pulses may lie before one train begins and behind the end of the other: noise. More mean
that only a stretch of two trials' codes is the same."""
STAGGERED_CHANCE = 1e-3
"""Losses make what one trial's trains have at their ends with this probability at least."""
JUMP_CHANCE = 1e-3
"""The same of a part that would fit better some ticks away, where both trains lost many pulses."""
MOST_SLACK = 1 / 8
"""Ticks within which a pulse lies on the line; where it is more, nearly all noise lies on ticks."""
UNEVEN = 3.5
"""Standard deviations between the shares of pulses that fit before and after some time."""
MIN_EITHER = 0.75
"""Both trains lost many pulses where less than this share of each fits."""
UNVOUCHED = 3
"""A clock that jumps at the last two pulses looks the same as two late ones, and a second report of
one of three may be in that pulse's place."""
UNDISTURBED = "let nothing set or restart a clock during a trial, and take it again"
SAME_TRIAL = "check that both recordings are of the same trial, and the cable of the sync line"
BEND_PPM_S = 2.0
"""Largest change of a clock's drift in a second that does not count as a jump; a crystal that
warms up by 10 K in a minute makes 0.4."""


class ClockRefused(ValueError):
    """No clock map can be trusted for these pulses.

    Attributes:
        reason: the gate that failed: ``too_few_pulses``, ``ambiguous`` (the train fits in more than
            one place), ``no_match`` (it fits nowhere), ``drift`` or ``residuals``.
    """

    def __init__(self, reason: Reason, message: str) -> None:
        super().__init__(message)
        self.reason: Reason = reason


@dataclass(frozen=True)
class ClockFit:
    """A clock map and its quality.

    Attributes:
        map: device ns to reference ns; more than one piece where the clocks bend.
        pulses_seen: pulses that the line is fitted to.
        pulses_late: pulses that found a partner but lie outside the gate; not in the line.
        pulses_missed: reference pulses inside the device's train that found no partner.
        pulses_spurious: device pulses without a partner (a second report of a pulse is one).
        residual_median_ns, residual_p95_ns, residual_max_ns: absolute residuals of the pulses seen.
        offset_ns: reference less device in the middle of the train.
        drift_ppm: what the reference gains on the device, in the mean.
        uncertainty_ns: the map's largest error between the first and the last pulse seen, 95 %:
            from the residuals, what the stamps' unit hides, and what bends between knots. A delay
            that all pulses share cannot be seen and is not in it.
        peak_ratio: second correlation peak over the first, 0 to 1; low is unambiguous.
        first_ns, last_ns: the first and the last pulse seen, on the device's clock: the map is
            vouched for in between.
        pulse_ns, residual_ns: (n,) pulses seen on the reference clock, and their residuals; not
            compared and not in `to_json`.
    """

    map: ClockMap
    pulses_seen: int
    pulses_late: int
    pulses_missed: int
    pulses_spurious: int
    residual_median_ns: float
    residual_p95_ns: float
    residual_max_ns: float
    offset_ns: int
    drift_ppm: float
    uncertainty_ns: float
    peak_ratio: float
    first_ns: int
    last_ns: int
    pulse_ns: Ints = field(repr=False, compare=False)
    residual_ns: Floats = field(repr=False, compare=False)

    def to_json(self) -> dict[str, Any]:
        """All but the single pulses, for a record."""
        data = {part.name: getattr(self, part.name) for part in fields(self) if part.compare}
        return {**data, "map": self.map.to_json()}


def fit_clock(
    device_ns: Ints,
    reference_ns: Ints,
    *,
    jitter_ns: float = 20_000.0,
    max_drift_ppm: float = 10_000.0,
    resolution_ns: float = 1_000.0,
    rounding: Rounding = "down",
    in_order: bool = False,
    start_marker_ns: float | None = None,
) -> ClockFit:
    """The map from a device's clock to the reference, from pulses that both saw.

    Args:
        device_ns: (m,) int64, the pulses on the device's clock, ns. Pulses may be missing, doubled,
            late, spurious, out of order.
        reference_ns: (n,) int64, the pulses on the reference clock, ns; may have gaps too.
        jitter_ns: the scatter (1 sigma) to be expected of the device's stamps. Residuals whose
            95th percentile exceeds three times this are refused.
        max_drift_ppm: clocks that differ by more are refused.
        resolution_ns: the unit to which the device cuts its stamps.
        rounding: which way it cuts them: an input that is looked at now and then stamps ``up``. The
            map takes the middle of what a stamp may mean.
        in_order: the stamps are in the order in which the pulses came, so that a clock that jumps
            back is detected. It must be known: once they are sorted, such a train looks like one
            that began earlier than the reference and ended earlier.
        start_marker_ns: the train is regular, and begins with a pulse and this much silence, ns;
            without it a regular train is refused.

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
                raise _fell_back(name, back_ns, jitter_ns)
    # differences to a pulse of each train; float64 holds them exactly up to 104 days
    device_0, reference_0 = int(device[device.size // 2]), int(reference[reference.size // 2])
    shift = {"down": 0.5, "up": -0.5, "nearest": 0.0}[rounding] * resolution_ns
    x, y = _differences(device, device_0) + shift, _differences(reference, reference_0)
    try:
        tick = tick_of(reference)
        if jitter_ns > tick / 4:
            raise ValueError(
                f"jitter_ns = {jitter_ns}: pulses {tick} ns apart cannot be told apart"
            )
        match = match_trains(x, y, tick, 1.02 * max_drift_ppm * 1e-6, start_marker_ns)
    except NoMatchError as error:
        raise ClockRefused(cast("Reason", error.reason), str(error)) from None
    _gate_share(x, y, match, tick)
    px, py = x[match.device], y[match.reference]
    line = fit_line(px, py - px, resolution_ns, BEND_PPM_S * 1e-15)
    # where a unit is all that the stamps show, it knows better than their scatter
    steep = bool(np.abs(line.slopes).max() > max_drift_ppm * 1e-6)
    unsure = line.uncertainty > resolution_ns and np.ptp(line.residuals) <= 2 * resolution_ns
    if steep or unsure:
        bounded = line_within_unit(px, py - px, resolution_ns, max_drift_ppm * 1e-6)
        if bounded is not None and (steep or bounded.uncertainty < line.uncertainty):
            line = bounded
    _gate_line(line, jitter_ns, max_drift_ppm)
    predicted = _extended(line, x)
    _gate_staggered(predicted, y, tick, 5 * line.sigma)
    inside = line.inside
    i, j = match.device[inside], match.reference[inside]
    stray = stray_stretch(predicted, y, i, j, 5 * line.sigma)
    if stray is not None:
        raise ClockRefused(
            "residuals", f"{stray}: a clock jumped, or its drift changed at once; {UNDISTURBED}"
        )
    _gate_lossy(i, j, predicted, y, tick, 5 * line.sigma)
    return _fit(match, line, x, y, device_0, reference_0)


def _fit(
    match: Match, line: ClockLine, x: Floats, y: Floats, device_0: int, reference_0: int
) -> ClockFit:
    inside = line.inside
    px, py = x[match.device], y[match.reference]
    residuals = np.abs(line.residuals[inside])
    knots = np.rint(line.knots).astype(np.int64)
    images = knots + np.rint(np.interp(knots, line.knots, line.values)).astype(np.int64)
    if knots.size == 2:
        slope = float(line.slopes[0])
        middle = int((knots[0] + knots[1]) // 2)
        image = middle + round(float(np.interp(middle, line.knots, line.values)))
        drift = (round(slope * 1e18),)
        clock = ClockMap((device_0 + middle,), (reference_0 + image,), drift)
    else:
        clock = ClockMap.through(
            [device_0 + int(knot) for knot in knots], [reference_0 + int(image) for image in images]
        )
    # what lies at the edge of chance does not confirm what comes before it
    begin, end = line.span
    vouched = (px >= begin) & (px <= end)
    seen = px[inside & vouched & (np.abs(line.residuals) <= 3 * line.sigma)]
    first, last = device_0 + int(seen[UNVOUCHED]), device_0 + int(seen[-1 - UNVOUCHED])
    in_span = (y >= py.min()) & (y <= py.max())
    middle_ns = (first + last) // 2
    ahead = gained(px[inside], line.knots, line.values)
    apart = px[inside] - px[inside].mean()
    return ClockFit(
        map=clock,
        pulses_seen=int(inside.sum()),
        pulses_late=int(px.size - inside.sum()),
        pulses_missed=int(in_span.sum()) - px.size,
        pulses_spurious=x.size - px.size,
        residual_median_ns=median(residuals),
        residual_p95_ns=line.residual_p95,
        residual_max_ns=float(residuals.max()),
        offset_ns=clock.to_reference(middle_ns) - middle_ns,
        drift_ppm=float((apart * ahead).sum() / (apart**2).sum()) * 1e6,
        uncertainty_ns=line.uncertainty,
        peak_ratio=match.peak_ratio,
        first_ns=first,
        last_ns=last,
        pulse_ns=py[inside].astype(np.int64) + reference_0,
        residual_ns=line.residuals[inside],
    )


def _train(times: Ints, name: str) -> Ints:
    array = np.asarray(times)
    if array.dtype.kind not in "iu":
        raise TypeError(f"{name} pulse times must be int64 ns, not {array.dtype}")
    if array.ndim != 1:
        raise ValueError(f"{name} pulse times must be 1-D, not {array.shape}")
    if array.size < MIN_PULSES:
        raise ClockRefused(
            "too_few_pulses",
            f"the {name} has {plural(array.size, 'pulse')}; at least {MIN_PULSES} are "
            f"needed: {WIRED}",
        )
    return np.sort(array.astype(np.int64))


def _differences(times: Ints, origin: int) -> Floats:
    """Float differences to `origin`; a stray stamp too far away to be subtracted is left out."""
    near = (times >= max(origin - 2**52, -(2**63))) & (times <= min(origin + 2**52, 2**63 - 1))
    retained: Floats = (times[near] - origin).astype(np.float64)
    return retained


def _extended(line: ClockLine, x: Floats) -> Floats:
    """x on the reference clock by the line."""
    result: Floats = x + gained(x, line.knots, line.values)
    return result


def _gate_share(x: Floats, y: Floats, match: Match, tick: float) -> None:
    """Refuse when, where the trains overlap, too few pulses of the shorter have a partner."""
    matched = int(match.device.size)
    if matched < MIN_PULSES:
        raise ClockRefused(
            "too_few_pulses",
            f"{matched} pulses match; at least {MIN_PULSES} are needed: {WIRED}",
        )
    px, py = x[match.device], y[match.reference]
    lag = median(py - px)
    low, high = max(x[0] + lag, y[0]), min(x[-1] + lag, y[-1])
    in_x = int(((x + lag >= low) & (x + lag <= high)).sum())
    in_y = int(((y >= low) & (y <= high)).sum())
    share = matched / max(1, min(in_x, in_y))
    by_chance = max(in_x, in_y) * tick / max(high - low, tick)
    if share < MIN_MATCHED and (matched < MIN_LOSSY or share < MIN_LIFT * by_chance):
        raise ClockRefused(
            "no_match",
            f"{share:.0%} of the pulses match where the {in_x} of the device and the {in_y} of the "
            f"reference overlap; at least {MIN_MATCHED:.0%} must, or {MIN_LIFT * by_chance:.0%} "
            f"(chance gives {by_chance:.0%}) if {MIN_LOSSY} pulses match: {SAME_TRIAL}",
        )


def _gate_staggered(predicted: Floats, y: Floats, tick: float, slack_ns: float) -> None:
    """Refuse a device that saw pulses before the box sent any, and none of the last, or so."""
    before, last = np.searchsorted(predicted, (y[0] - tick, y[-1] + tick)).tolist()
    unseen, seen = np.searchsorted(y, (predicted[0] - tick, predicted[-1] + tick)).tolist()
    foreign = max(min(before, y.size - seen), min(predicted.size - last, unseen))
    if foreign > MOST_STAGGERED:
        raise ClockRefused(
            "no_match",
            f"only the device has {foreign} pulses or more at one end, and only the reference as "
            f"many at the other (at most {MOST_STAGGERED}): they are of two trials whose codes "
            f"share a stretch; {SAME_TRIAL}",
        )
    begins, ends = predicted[0] - y[0], predicted[-1] - y[-1]
    staggered = min(abs(begins), abs(ends)) > tick / 2 and (begins < 0) == (ends < 0)
    if not staggered or slack_ns > MOST_SLACK * tick:
        return
    found = staggered_ends(on_ticks(predicted, y, tick, slack_ns))
    if found.chance < STAGGERED_CHANCE:
        raise ClockRefused(
            "no_match",
            f"the {found.earlier} has {found.first} pulses on ticks before the {found.later} has "
            f"any, and the {found.later} {found.last} behind the {found.earlier}'s last: losses "
            f"explain that with a probability of {found.chance:.1g} (at least "
            f"{STAGGERED_CHANCE:g} is needed), so they are of two trials whose codes share a "
            f"stretch; {SAME_TRIAL}",
        )


def _gate_lossy(
    i: Ints, j: Ints, predicted: Floats, y: Floats, tick: float, slack_ns: float
) -> None:
    """Refuse trains that both lost many pulses and match too little, or not equally throughout."""
    shares = [index.size / (int(index[-1]) - int(index[0]) + 1) for index in (i, j)]
    if max(shares) >= MIN_EITHER:
        return
    stated = f"{shares[0]:.0%} of the device's and {shares[1]:.0%} of the reference's pulses match"
    if i.size < MIN_LOSSY:
        raise ClockRefused(
            "no_match",
            f"{stated}; at least {MIN_EITHER:.0%} of either must, or {MIN_LOSSY} pulses, and these "
            f"are {i.size}: {SAME_TRIAL}",
        )
    uneven = min(unevenness(i), unevenness(j))
    if uneven > UNEVEN:
        raise ClockRefused(
            "no_match",
            f"{stated}, and the shares before and after some moment differ by {uneven:.1f} "
            "standard "
            f"deviations (at most {UNEVEN:g}): a clock jumped by whole ticks; {UNDISTURBED}",
        )
    if slack_ns > MOST_SLACK * tick:
        return
    jump, chance = better_shift(on_ticks(predicted, y, tick, slack_ns))
    if chance < JUMP_CHANCE:
        raise ClockRefused(
            "no_match",
            f"{stated}, and on one side of some moment more would {abs(jump)} ticks away, which "
            f"happens by chance with a probability of {chance:.1g} at most (at least "
            f"{JUMP_CHANCE:g} is needed): a clock jumped by whole ticks; {UNDISTURBED}",
        )


def _gate_line(line: ClockLine, jitter_ns: float, max_drift_ppm: float) -> None:
    """Refuse a line that is too steep, that bends like no clock, or on which too little lies."""
    steepest = float(line.slopes[np.abs(line.slopes).argmax()]) * 1e6
    p95 = line.residual_p95
    if p95 > 3 * jitter_ns or line.inside.mean() < MIN_MATCHED:
        raise ClockRefused(
            "residuals",
            f"{line.inside.mean():.0%} of the pulses lie on a line, 95 % of these within "
            f"{p95 / 1e3:.1f} us; at least {MIN_MATCHED:.0%} within {3 * jitter_ns / 1e3:.1f} us "
            "are needed: look for noise on the sync line, or raise the device's jitter_us",
        )
    if line.jump:
        raise ClockRefused(
            "residuals",
            f"a clock jumped by {abs(line.jump) / 1e3:.1f} us, which is above {STEP:g} standard "
            f"deviations of chance ({STEP_AT_END:g} near an end): {UNDISTURBED}",
        )
    for first, second in ((0, 1), (-1, -2)):
        off = line.residuals[first], line.residuals[second]
        if not line.inside[[first, second]].any() and abs(off[0] - off[1]) <= 5 * line.sigma:
            raise ClockRefused(
                "residuals",
                f"the {'first' if first == 0 else 'last'} two pulses lie {off[0] / 1e3:.1f} and "
                f"{off[1] / 1e3:.1f} us off the line (at most {5 * line.sigma / 1e3:.1f} is "
                f"jitter), by the same amount: a clock jumped; {UNDISTURBED}",
            )
    if line.sudden > 3 * jitter_ns:
        raise ClockRefused(
            "residuals",
            f"the drift changes so fast that the line may be wrong by {line.sudden / 1e3:.1f} us "
            f"there (at most {3 * jitter_ns / 1e3:.1f} us is allowed): {UNDISTURBED}",
        )
    if abs(steepest) > max_drift_ppm:
        raise ClockRefused(
            "drift",
            f"the clocks differ by {steepest:.1f} ppm; at most {max_drift_ppm:g} ppm are allowed: "
            "raise drift_ppm of the device or of the sync box if their clocks are no better",
        )
    if not line.straightened:
        raise ClockRefused(
            "residuals",
            f"residuals about a line of {line.slopes.size} pieces, the most that are tried, are "
            f"still larger than jitter: a clock jumped, or its drift wanders; {UNDISTURBED}",
        )


def _fell_back(name: str, back_ns: int, jitter_ns: float) -> ClockRefused:
    """Return the message about stamps that do not rise."""
    return ClockRefused(
        "residuals",
        f"stamps of the {name} fall back by {back_ns / 1e9:g} s (at most {jitter_ns / 1e9:g} s is "
        f"jitter): its clock was set or restarted; {UNDISTURBED}",
    )


def fit_numbered(
    device_ns: Ints,
    numbers: Ints,
    reference_ns: Ints,
    *,
    jitter_ns: float = 20_000.0,
    max_drift_ppm: float = 10_000.0,
    resolution_ns: float = 1_000.0,
    rounding: Rounding = "down",
    reference_resolution_ns: float = 0.0,
) -> ClockFit:
    """The map from a device's clock to the reference, for instants that the device counts.

    A camera that runs by itself exposes at regular intervals, and the box stamps every exposure. A
    regular train fits anywhere, so both must have seen the first and the last one: number 0 is the
    first stamp, and the last number must be the last.

    Args:
        device_ns: (m,) int64 times on the device's clock, ns, in order.
        numbers: (m,) int64 the device's own count of them, rising; what was lost is left out.
        reference_ns: (n,) int64 the stamps of all of them on the reference clock, ns, in order.
        jitter_ns, max_drift_ppm, resolution_ns, rounding: as in `fit_clock`.
        reference_resolution_ns: the unit to which the reference's stamps are cut, downwards.

    Raises:
        ClockRefused: with its `reason`.
    """
    device, reference = _train(device_ns, "device"), _train(reference_ns, "reference")
    for name, times in (("device", device_ns), ("reference", reference_ns)):
        back_ns = -int(np.diff(times).min())
        if back_ns > 0:
            raise _fell_back(name, back_ns, 0.0)
    period = float(np.median(np.diff(reference)))
    steps = np.rint(np.diff(reference) / period).astype(np.int64)
    counted = np.concatenate([[0], np.cumsum(steps)])
    # a second report of an edge
    first = np.concatenate([[True], steps > 0])
    counted, reference = counted[first], reference[first]
    if int(counted[-1]) != int(numbers[-1]):
        raise ClockRefused(
            "ambiguous",
            f"the device counted {int(numbers[-1]) + 1} exposures and the box stamped "
            f"{int(counted[-1]) + 1}, so it is unknown which is which: start the box before "
            "the camera, stop it later, and check the exposure line",
        )
    _, i, j = np.intersect1d(numbers, counted, return_indices=True)
    device_0, reference_0 = int(device[device.size // 2]), int(reference[reference.size // 2])
    shift = {"down": 0.5, "up": -0.5, "nearest": 0.0}[rounding] * resolution_ns
    x = _differences(device, device_0) + shift
    y = _differences(reference, reference_0) + 0.5 * reference_resolution_ns
    if x.size != device.size or y.size != reference.size:
        raise ClockRefused(
            "residuals", "some exposures lie more than 52 days from the others: " + UNDISTURBED
        )
    match = Match(i.astype(np.int64), j.astype(np.int64), 0.0)
    px, py = x[match.device], y[match.reference]
    unit = max(resolution_ns, reference_resolution_ns)
    line = fit_line(px, py - px, unit, BEND_PPM_S * 1e-15)
    _gate_line(line, jitter_ns, max_drift_ppm)
    return _fit(match, line, x, y, device_0, reference_0)
