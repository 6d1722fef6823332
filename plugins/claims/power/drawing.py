"""Numbers of trials after which a plan's claims are called, over campaigns drawn from a pilot."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sliplab.plugins.claims.document import ClaimState
from sliplab.plugins.claims.evidence import TrialGrid
from sliplab.plugins.claims.power.document import MOST_OPEN, ClaimPower, TrialSpread, WidthLine
from sliplab.plugins.claims.power.resampling import ONE_SESSION, PilotFigures, Sessions
from sliplab.plugins.claims.simulated import CampaignCourse, claims_of, course
from sliplab.plugins.claims.states import is_called, states
from sliplab.protocols import Plan
from sliplab.protocols.claims import FIGURES, Claim

SHARES = (0.1, 0.5, 0.9)
LINES = 10
"""Number of campaigns whose widths are stored."""
POINTS = 8
"""Looks at which they are, at most."""


@dataclass(frozen=True)
class CampaignDraw:
    """A campaign that was drawn.

    Attributes:
        called: of each claim, trials after which it was called; None: never.
        states: of each claim, then or at the end. trials: taken, and known at the last look.
        ended: trials where the claims ended the campaign; None: they did not.
        widths: of each claim; empty where they are not stored.
    """

    called: tuple[int | None, ...]
    states: tuple[ClaimState, ...]
    trials: int
    ended: int | None
    widths: tuple[WidthLine, ...]


@dataclass(frozen=True)
class Drawing:
    """Campaigns of a plan that are drawn from a pilot; equal numbers give equal ones."""

    plan: Plan
    pilot: PilotFigures
    seed: int
    sessions: Sessions = ONE_SESSION

    def campaign(self, number: int) -> CampaignDraw:
        """Draw a campaign."""
        grid = TrialGrid.of(self.plan)
        rng = np.random.default_rng([self.seed, number])
        in_blocks = self.plan.protocol.collection.adaptive is None
        values = self.pilot.without(self.sessions).campaign(grid, rng, in_blocks=in_blocks)
        over_time = self.pilot.over_time(self.plan, grid, self.sessions, rng)
        found = course(self.plan, grid, values, over_time)
        looks = found.evidence.looks
        return CampaignDraw(
            tuple(None if it.look is None else int(looks[it.look]) for it in found.claims),
            tuple(it.state for it in found.claims),
            len(found.evidence.taken),
            found.ended,
            self._widths(found) if number < LINES else (),
        )

    def _widths(self, found: CampaignCourse) -> tuple[WidthLine, ...]:
        """Return the widths of each claim along a campaign, at some of its looks."""
        looks, stopping = found.evidence.looks, claims_of(self.plan)
        places = np.unique(np.linspace(0, len(looks) - 1, POINTS).round().astype(np.int64))
        seen = [states(found.evidence.until(place), stopping) for place in places]
        trials = tuple(int(looks[place]) for place in places)
        return tuple(
            WidthLine(trials=trials, half=tuple(_half(at[k]) for at in seen))
            for k in range(len(stopping.claims))
        )


def _half(state: ClaimState) -> float | None:
    return None if state.low is None or state.high is None else 0.5 * (state.high - state.low)


def spread(trials: Sequence[int | None]) -> TrialSpread:
    """Return 10, 50 and 90 % of numbers of trials, None being more than any."""
    ordered = sorted(trials, key=lambda n: math.inf if n is None else n)
    low, median, high = (ordered[max(math.ceil(p * len(ordered)) - 1, 0)] for p in SHARES)
    return TrialSpread(low=low, median=median, high=high)


def claim_powers(drawing: Drawing, campaigns: Sequence[CampaignDraw]) -> tuple[ClaimPower, ...]:
    """Return the statistics of each claim over drawn campaigns."""
    found = []
    for k, claim in enumerate(claims_of(drawing.plan).claims):
        ends = [it.states[k] for it in campaigns]
        count = len(campaigns)
        called = tuple(it.called[k] for it in campaigns)
        never = sum(trials is None for trials in called) / count
        known = np.isfinite(drawing.pilot.values[claim.figure]).sum()
        found.append(
            ClaimPower(
                claim=ends[0].claim,
                unit=FIGURES[claim.figure].unit,
                width=None if claim.within is None else claim.value,
                known=int(known),
                trials=spread(called),
                called=called,
                holds=sum(state.holds for state in ends) / count,
                refuted=sum(state.refuted for state in ends) / count,
                never=never,
                repetitions=_repetitions(drawing, campaigns, k) if never > MOST_OPEN else None,
                widths=tuple(it.widths[k] for it in campaigns if it.widths),
            )
        )
    return tuple(found)


def _repetitions(drawing: Drawing, campaigns: Sequence[CampaignDraw], k: int) -> int | None:
    """Return the repetitions that would call an open claim in half of the campaigns."""
    claim = claims_of(drawing.plan).claims[k]
    grid = TrialGrid.of(drawing.plan)
    kinds = int(grid.condition.max()) + 1
    needed = sorted(
        it.trials * (1.0 if is_called(it.states[k]) else more_trials(claim, it.states[k]))
        for it in campaigns
    )
    median = needed[(len(needed) - 1) // 2]
    return math.ceil(median / kinds) if math.isfinite(median) else None


def more_trials(claim: Claim, state: ClaimState) -> float:
    """Return how many times the trials would call an open claim, by widths like 1 / sqrt(n).

    With too few blocks, at least so many. Infinite where no bound is known yet, or the estimate is
    what is claimed.
    """
    if state.blocks < state.least_blocks:
        return state.least_blocks / max(state.blocks, 1)
    at, low, high, value = state.estimate, state.low, state.high, claim.value
    if low is None or high is None or at is None:
        return math.inf
    if claim.kind == "within":
        short, gap = 0.5 * (high - low), value
    elif claim.kind == "apart" and abs(at) < value:
        short, gap = max(abs(low), abs(high)) - abs(at), value - abs(at)
    elif claim.kind == "apart":
        short, gap = (at - low if at > 0.0 else high - at), abs(at) - value
    else:
        short, gap = (at - low if at >= value else high - at), abs(at - value)
    return max((short / gap) ** 2, 1.0) if gap > 0.0 else math.inf
