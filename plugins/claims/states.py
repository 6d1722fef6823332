"""State of each claim by the evidence: its estimate, its interval, and whether it is settled.

Trials without a figure could have had any: a claim is called only if it holds for every possible
figure of theirs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np

from sliplab.plugins.claims.blocks import F64, Limit, MeanEstimate, block_share
from sliplab.plugins.claims.boundaries import boundaries
from sliplab.plugins.claims.document import ClaimState
from sliplab.plugins.claims.evidence import (
    ClaimEvidence,
    Mask,
    chosen_estimate,
    members_of,
    planned_end,
    planned_estimate,
)
from sliplab.plugins.claims.expectation import Expectation, coded, expectation
from sliplab.protocols.claims import FIGURES, QUANTILES, Claim, Stopping

PERCENT = 100.0
_HALVINGS = 50
Fits = dict[tuple[str, bytes], Expectation]
"""Expectations from a campaign's first figures, cached: they are the same at each later look."""


def states(
    evidence: ClaimEvidence,
    stopping: Stopping,
    fits: Fits | None = None,
    earlier: Sequence[ClaimState] = (),
) -> tuple[ClaimState, ...]:
    """Return the state of every claim at the last look.

    Args:
        fits: of earlier looks at the same campaign; those made here are added.
        earlier: the states at the look before; what was called then stays so.
    """
    history = ClaimHistory(evidence, stopping, {} if fits is None else fits)
    found = [state_of(claim, history) for claim in stopping.claims]
    for k, before in enumerate(earlier):
        if is_called(before):
            update = {
                "holds": before.holds,
                "refuted": before.refuted,
                "alike": None,
                "trend": None,
            }
            found[k] = found[k].model_copy(update=update)
    return tuple(found)


def is_called(state: ClaimState) -> bool:
    """Return whether a claim holds or is refuted."""
    return state.holds or state.refuted


def settled(found: Sequence[ClaimState]) -> bool:
    """Return whether every claim holds or is refuted."""
    return all(is_called(state) for state in found)


@dataclass(frozen=True)
class ClaimHistory:
    """Evidence, and the expectations over the grid when each round began."""

    evidence: ClaimEvidence
    stopping: Stopping
    fits: Fits = field(default_factory=dict)

    @cached_property
    def _code(self) -> F64:
        return coded(self.evidence.grid.levels)

    def expected(self, figure: str) -> Expectation:
        """Return the expectations of a figure in each round, (k, N)."""
        if figure not in self._by_round:
            begins = [0, *(int(n) for n in self.evidence.looks[:-1])]
            each = [self.expected_after(figure, n) for n in begins]
            self._by_round[figure] = Expectation(
                np.array([one.mean for one in each]), np.array([one.spread for one in each])
            )
        return self._by_round[figure]

    def expected_after(self, figure: str, n: int) -> Expectation:
        """Return the expectation of a figure from the first `n` trials."""
        values = self.evidence.values[figure][:n]
        key = figure, values.tobytes()
        if key not in self.fits:
            self.fits[key] = expectation(self._code, self.evidence.taken[:n], values)
        return self.fits[key]

    @cached_property
    def _by_round(self) -> dict[str, Expectation]:
        return {}

    def limit(self, claim: Claim, error: float) -> Limit:
        """Return the limit of a claim's estimate at the last look; infinite at early ones."""
        evidence = self.evidence
        enough = evidence.block_count >= claim.least_blocks
        if not len(enough) or not enough[-1]:
            return Limit(np.inf, np.inf, np.inf)
        adaptive = evidence.chances is not None
        planned = planned_end(evidence.grid, self.stopping, adaptive=adaptive)
        shares = tuple(float(n) / planned for n in evidence.looks[enough])
        blocks = int(evidence.block_count[-1])
        return Limit(
            float(boundaries(shares, error)[-1]),
            float(boundaries((1.0,), error / 8.0)[0]),
            blocks / shares[-1],
        )

    def share_below(
        self, figure: str, value: float, members: Mask, *, at: bool, missing: float | None = None
    ) -> MeanEstimate:
        """Return the share of trials whose figure is below a value.

        Args:
            at: figures at the value count as below. missing: what trials without a figure count as;
                None: they are left out.
        """
        key = figure, value, members.tobytes(), at, missing
        if key not in self._shares:
            y = self.evidence.values[figure]
            x = np.where(np.isnan(y), np.nan, (y <= value) if at else (y < value))
            found = self._estimate(figure, x, members, lambda fit: fit.below(value), missing)
            self._shares[key] = found
        return self._shares[key]

    @cached_property
    def _shares(self) -> dict[tuple[object, ...], MeanEstimate]:
        """Shares below values, which claims about one figure have in common."""
        return {}

    def mean(self, figure: str, members: Mask, missing: float | None = None) -> MeanEstimate:
        """Return the mean of a share in percent, as a number from 0 to 1; see `share_below`."""

        def guess(fit: Expectation) -> F64:
            return np.clip(fit.mean / PERCENT, 0.0, 1.0)

        x = self.evidence.values[figure] / PERCENT
        return self._estimate(figure, x, members, guess, missing)

    def _estimate(
        self,
        figure: str,
        x: F64,
        members: Mask,
        guess: Callable[[Expectation], F64],
        missing: float | None,
    ) -> MeanEstimate:
        evidence = self.evidence
        if missing is not None:
            x = np.where(np.isnan(x), missing, x)
        latest = guess(self.expected_after(figure, len(evidence.taken)))
        if evidence.chances is None:
            return planned_estimate(evidence, x, members, latest)
        return chosen_estimate(evidence, x, members, guess(self.expected(figure)), latest)


def state_of(claim: Claim, history: ClaimHistory) -> ClaimState:
    """Return the state of a claim by the last look alone.

    A claim of a bound is called by a bound that is wrong with the stated error; one of a width by
    both, each with half of it; one of a difference of percentiles has four.
    """
    evidence = history.evidence
    groups = members_of(claim, evidence.grid)
    low, high = _interval(claim, history, groups, worst=True)
    holds, against = _called(claim, history, groups, (low, high), worst=True)
    y = evidence.values[claim.figure]
    used = np.any(groups, axis=0)[evidence.taken]
    missing = int(np.isnan(y[used]).sum())
    alike: Literal["holds", "refuted"] | None = None
    if missing and not holds and not against:
        span = _interval(claim, history, groups, worst=False)
        would, would_not = _called(claim, history, groups, span, worst=False)
        alike = "holds" if would else "refuted" if would_not else None
    trend: Literal["holds", "refuted"] | None = None
    if not holds and not against:
        would, would_not = _called(claim, history, groups, (low, high), worst=True, trend=False)
        trend = "holds" if would else "refuted" if would_not else None
    fit = history.expected_after(claim.figure, len(evidence.taken))
    share, _ = block_share(np.where(used, y - fit.mean[evidence.taken], np.nan), evidence.blocks)
    return ClaimState(
        claim=claim.text(evidence.grid.factors),
        kind=claim.kind,
        value=claim.value,
        unit=FIGURES[claim.figure].unit,
        trials=int(np.isfinite(y[used]).sum()),
        undetected=int(np.isinf(y[used]).sum()),
        missing=missing,
        blocks=int(evidence.block_count[-1]) if len(evidence.looks) else 0,
        least_blocks=claim.least_blocks,
        block_share=share,
        estimate=_estimate_of(claim, history, groups),
        low=low if np.isfinite(low) else None,
        high=high if np.isfinite(high) else None,
        holds=holds,
        refuted=against,
        alike=alike,
        trend=trend,
    )


def _called(
    claim: Claim,
    history: ClaimHistory,
    groups: Sequence[Mask],
    span: tuple[float, float],
    *,
    worst: bool,
    trend: bool = True,
) -> tuple[bool, bool]:
    """Return whether a claim holds, and whether it is refuted.

    Args:
        trend: it must be so where the trend so far continues, too; an interval has that in it.
    """
    if claim.between is None and claim.within is None:  # sharper than by an interval of two ends
        return _bound_verdict(claim, history, groups[0], worst=worst, trend=trend)
    low, high = span
    if claim.within is not None:
        return bool(high - low <= 2.0 * claim.value), False
    if claim.at_least is not None:  # about the size of a difference
        size = max(abs(low), abs(high))
        return bool(low >= claim.value or high <= -claim.value), bool(size < claim.value)
    return bool(high <= claim.value), bool(low > claim.value)


def _bound_verdict(
    claim: Claim, history: ClaimHistory, members: Mask, *, worst: bool, trend: bool
) -> tuple[bool, bool]:
    """Return whether a claim of a bound holds, and is refuted."""
    value, least = claim.value, claim.at_least is not None
    limit = history.limit(claim, history.stopping.error)
    if not trend:
        limit = replace(limit, steady=-np.inf)
    none, all_ = (0.0, 1.0) if worst else (None, None)
    if claim.of == "mean":
        share = value / PERCENT
        figure = claim.figure
        above = history.mean(figure, members, none).is_beyond(share, limit, above=True)
        below = history.mean(figure, members, all_).is_beyond(share, limit, above=False)
        return (above, below) if least else (below, above)
    share = QUANTILES[claim.of]
    # at least v: fewer than the share lie below v; at most v: more than the share lie at most at v

    def under(missing: float | None) -> MeanEstimate:
        return history.share_below(claim.figure, value, members, at=not least, missing=missing)

    fewer = under(all_).is_beyond(share, limit, above=False)
    more = under(none).is_beyond(share, limit, above=True)
    return (fewer, more) if least else (more, fewer)


def _interval(
    claim: Claim, history: ClaimHistory, groups: Sequence[Mask], *, worst: bool
) -> tuple[float, float]:
    """Return the interval of a claim's statistic, or of a difference."""
    none, all_ = (0.0, 1.0) if worst else (None, None)
    error = history.stopping.error / 2.0
    if claim.of == "mean":
        limit = history.limit(claim, error)
        low, high = (history.mean(claim.figure, groups[-1], fill) for fill in (none, all_))
        if len(groups) == 2:
            low = low.minus(history.mean(claim.figure, groups[0], all_))
            high = high.minus(history.mean(claim.figure, groups[0], none))
        return _mean_bounds(low, high, limit, least=1.0 - len(groups))
    limit = history.limit(claim, error / len(groups))
    spans = [_percentile_bounds(claim, history, members, limit, worst) for members in groups]
    if len(spans) == 1:
        return spans[0]
    return spans[1][0] - spans[0][1], spans[1][1] - spans[0][0]


def _mean_bounds(
    low: MeanEstimate, high: MeanEstimate, limit: Limit, *, least: float
) -> tuple[float, float]:
    """Return bounds of a mean, or of a difference of two, in percent.

    Args:
        low, high: estimates with missing figures at their least, and at their most.
        least: smallest value that it can have; the largest is 1.
    """
    bottom = _border(lambda m: low.is_beyond(m, limit, above=True), least, 1.0)
    top = _border(lambda m: high.is_beyond(m, limit, above=False), 1.0, least)
    return PERCENT * bottom, PERCENT * top


def _border(wrong: Callable[[float], bool], inside: float, outside: float) -> float:
    """Return where values stop being wrong, by halving; `inside` where even that is not."""
    if not wrong(inside):
        return inside
    for _ in range(_HALVINGS):
        middle = 0.5 * (inside + outside)
        inside, outside = (middle, outside) if wrong(middle) else (inside, middle)
    return inside


def _percentile_bounds(
    claim: Claim, history: ClaimHistory, members: Mask, limit: Limit, worst: bool
) -> tuple[float, float]:
    """Return bounds of a percentile."""
    if not np.isfinite(limit.boundary):
        return -np.inf, np.inf
    share = QUANTILES[claim.of]
    none, all_ = (0.0, 1.0) if worst else (None, None)
    values = _values(claim, history, members)

    def too_low(value: float) -> bool:
        below = history.share_below(claim.figure, value, members, at=False, missing=all_)
        return below.is_beyond(share, limit, above=False)

    def too_high(value: float) -> bool:
        below = history.share_below(claim.figure, value, members, at=True, missing=none)
        return below.is_beyond(share, limit, above=True)

    # a value is refuted where one further in is
    first = _first(values, lambda value: not too_low(value))
    low = -np.inf if first == 0 else float(values[first - 1])
    last = _first(values, too_high)
    return low, np.inf if last == len(values) else float(values[last])


def _first(values: F64, found: Callable[[float], bool]) -> int:
    """Return the place of the first value with a property that all later ones have, too."""
    begin, end = 0, len(values)
    while begin < end:
        middle = (begin + end) // 2
        begin, end = (begin, middle) if found(values[middle]) else (middle + 1, end)
    return begin


def _values(claim: Claim, history: ClaimHistory, members: Mask) -> F64:
    """Return the different figures of some trials, rising."""
    evidence = history.evidence
    values = np.unique(evidence.values[claim.figure][members[evidence.taken]])
    return np.asarray(values[~np.isnan(values)])


def _estimate_of(claim: Claim, history: ClaimHistory, groups: Sequence[Mask]) -> float | None:
    found = [estimate_of(claim, history, members) for members in groups]
    if len(found) == 1:
        return found[0]
    first, second = found
    return None if first is None or second is None else second - first


def estimate_of(claim: Claim, history: ClaimHistory, members: Mask) -> float | None:
    """Return a mean, or the value that the share of a percentile does not exceed.

    Trials without a figure are left out.
    """
    if claim.of == "mean":
        mean = history.mean(claim.figure, members).value
        return PERCENT * mean if np.isfinite(mean) else None
    values = _values(claim, history, members)
    share = QUANTILES[claim.of] - 1e-12
    place = _first(
        values,
        lambda value: history.share_below(claim.figure, value, members, at=True).value >= share,
    )
    return float(values[place]) if place < len(values) and np.isfinite(values[place]) else None
