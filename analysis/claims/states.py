"""What the evidence says of each claim: its estimate, its interval, and whether it is settled."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from sliplab.analysis.claims.evidence import (
    Evidence,
    Mask,
    members_of,
    plain_bets,
    weighted_bets,
)
from sliplab.analysis.claims.expectation import Expectation, coded, expectation
from sliplab.analysis.claims.sequences import F64, Bets, mean_bounds, refuted
from sliplab.protocols.claims import FIGURES, QUANTILES, Claim, Stopping
from sliplab.storage.schema.claims import ClaimState

PERCENT = 100.0


Fits = dict[tuple[str, bytes], Expectation]
"""What the first figures of a campaign let expect: the same at each later look."""


def states(
    evidence: Evidence, stopping: Stopping, fits: Fits | None = None
) -> tuple[ClaimState, ...]:
    """Return the state of every claim at the last look.

    Args:
        fits: of earlier looks at the same campaign; those made here are added.
    """
    history = History(evidence, {} if fits is None else fits)
    return tuple(state_of(claim, history, stopping.error) for claim in stopping.claims)


@dataclass(frozen=True)
class History:
    """Evidence, and what was expected of the grid when each round began."""

    evidence: Evidence
    fits: Fits = field(default_factory=dict)

    @cached_property
    def _code(self) -> F64:
        return coded(self.evidence.grid.levels)

    def expected(self, figure: str) -> Expectation:
        """Return what was expected of a figure in each round, (k, N)."""
        if figure not in self._by_round:
            begins = [0, *(int(n) for n in self.evidence.looks[:-1])]
            each = [self.expected_after(figure, n) for n in begins]
            self._by_round[figure] = Expectation(
                np.array([one.mean for one in each]), np.array([one.spread for one in each])
            )
        return self._by_round[figure]

    def expected_after(self, figure: str, n: int) -> Expectation:
        """Return what the first `n` trials let expect of a figure."""
        values = self.evidence.values[figure][:n]
        key = figure, values.tobytes()
        if key not in self.fits:
            self.fits[key] = expectation(self._code, self.evidence.taken[:n], values)
        return self.fits[key]

    @cached_property
    def _by_round(self) -> dict[str, Expectation]:
        return {}

    def bets_below(self, figure: str, value: float, members: Mask, *, at: bool) -> Bets:
        """Return bets on the share of trials whose figure is below a value.

        Args:
            at: figures at the value count as below.
        """
        y = self.evidence.values[figure]
        x = np.where(np.isnan(y), np.nan, (y <= value) if at else (y < value))
        if self.evidence.chances is None:
            return plain_bets(self.evidence, x, members)
        return weighted_bets(self.evidence, x, members, self.expected(figure).below(value))

    def bets_on_mean(self, figure: str, members: Mask) -> Bets:
        """Return bets on the mean of a share in percent, as a number from 0 to 1."""
        x = self.evidence.values[figure] / PERCENT
        if self.evidence.chances is None:
            return plain_bets(self.evidence, x, members)
        guess = np.clip(self.expected(figure).mean / PERCENT, 0.0, 1.0)
        return weighted_bets(self.evidence, x, members, guess)


def state_of(claim: Claim, history: History, error: float) -> ClaimState:
    """Return the state of a claim.

    A claim of a bound is called by a bound that is wrong with `error`; one of a width by both, each
    with half of it; one of a difference has four.
    """
    groups = members_of(claim, history.evidence.grid)
    ends = len(groups) * (1 if claim.within is None else 2)
    spans = [_bounds(claim, history, members, error / ends) for members in groups]
    estimates = [estimate_of(claim, history, members) for members in groups]
    low, high, estimate = *spans[0], estimates[0]
    if claim.between is not None:
        low, high = spans[1][0] - spans[0][1], spans[1][1] - spans[0][0]
        both = [value for value in estimates if value is not None]
        estimate = both[1] - both[0] if len(both) == 2 else None
    holds, against = _verdict(claim, low, high)
    if claim.between is None and claim.within is None:  # sharper: the bound itself is bet against
        holds, against = _bound_verdict(claim, history, groups[0], error)
    used = [np.isfinite(_values(claim, history, members)).sum() for members in groups]
    return ClaimState(
        claim=claim.text(history.evidence.grid.factors),
        kind=claim.kind,
        value=claim.value,
        unit=FIGURES[claim.figure].unit, trials=int(sum(used)), estimate=estimate,
        low=low if np.isfinite(low) else None, high=high if np.isfinite(high) else None,
        holds=holds, refuted=against,
    )  # fmt: skip


def _values(claim: Claim, history: History, members: Mask) -> F64:
    evidence = history.evidence
    return evidence.values[claim.figure][members[evidence.taken]]


def _verdict(claim: Claim, low: float, high: float) -> tuple[bool, bool]:
    """Return whether a claim holds, and whether it is refuted, by an interval."""
    if claim.within is not None:
        return bool(high - low <= 2.0 * claim.value), False
    if claim.between is not None and claim.at_least is not None:
        size = max(abs(low), abs(high))
        return bool(low >= claim.value or high <= -claim.value), bool(size < claim.value)
    if claim.at_least is not None:
        return bool(low >= claim.value), bool(high < claim.value)
    return bool(high <= claim.value), bool(low > claim.value)


def _bound_verdict(
    claim: Claim, history: History, members: Mask, error: float
) -> tuple[bool, bool]:
    """Return whether a claim of a bound holds, and is refuted, by bets on the bound itself."""
    value, least = claim.value, claim.at_least is not None
    if claim.of == "mean":
        bets = history.bets_on_mean(claim.figure, members)
        share = value / PERCENT
        above = refuted(bets, share, error, above=True)
        below = refuted(bets, share, error, above=False)
        return (above, below) if least else (below, above)
    share = QUANTILES[claim.of]
    # at least v: fewer than the share lie below v; at most v: more than the share lie at most at v
    under = history.bets_below(claim.figure, value, members, at=not least)
    fewer = refuted(under, share, error, above=False)
    more = refuted(under, share, error, above=True)
    return (fewer, more) if least else (more, fewer)


def _bounds(claim: Claim, history: History, members: Mask, error: float) -> tuple[float, float]:
    """Return bounds of a statistic, each of which is wrong with `error` at most."""
    if claim.of == "mean":
        low, high = mean_bounds(history.bets_on_mean(claim.figure, members), error)
        return PERCENT * low, PERCENT * high
    share = QUANTILES[claim.of]
    values = np.unique(_values(claim, history, members))
    values = values[~np.isnan(values)]

    def too_low(value: float) -> bool:
        bets = history.bets_below(claim.figure, value, members, at=False)
        return refuted(bets, share, error, above=False)

    def too_high(value: float) -> bool:
        bets = history.bets_below(claim.figure, value, members, at=True)
        return refuted(bets, share, error, above=True)

    # a value is refuted where one further in is
    begin, end = 0, len(values)
    while begin < end:
        middle = (begin + end) // 2
        begin, end = (middle + 1, end) if too_low(values[middle]) else (begin, middle)
    low = -np.inf if begin == 0 else float(values[begin - 1])
    begin, end = 0, len(values)
    while begin < end:
        middle = (begin + end) // 2
        begin, end = (begin, middle) if too_high(values[middle]) else (middle + 1, end)
    high = np.inf if begin == len(values) else float(values[begin])
    return low, high


def estimate_of(claim: Claim, history: History, members: Mask) -> float | None:
    """Return the mean of the unbiased estimates; of a percentile, where their share reaches it."""
    if claim.of == "mean":
        z = history.bets_on_mean(claim.figure, members).z
        return PERCENT * float(z.mean()) if len(z) else None
    values = np.unique(_values(claim, history, members))
    values = values[~np.isnan(values)]
    share = QUANTILES[claim.of] - 1e-12
    begin, end = 0, len(values)
    while begin < end:
        middle = (begin + end) // 2
        z = history.bets_below(claim.figure, values[middle], members, at=True).z
        begin, end = (begin, middle) if len(z) and z.mean() >= share else (middle + 1, end)
    return float(values[begin]) if begin < len(values) and np.isfinite(values[begin]) else None


def settled(found: Sequence[ClaimState]) -> bool:
    """Return whether every claim holds or is refuted."""
    return all(state.holds or state.refuted for state in found)
