"""Campaigns that end by their claims, with the figures of all trials given: no rig, no store.

The same procedure as that of a campaign that is collected (`plugins.claims.rounds`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from sliplab.plugins.claims.blocks import F64, I64
from sliplab.plugins.claims.choosing import next_batch
from sliplab.plugins.claims.document import ClaimState, TrialBatch
from sliplab.plugins.claims.evidence import ClaimEvidence, TrialGrid, round_ends
from sliplab.plugins.claims.states import Fits, is_called, states
from sliplab.protocols import Plan
from sliplab.protocols.claims import Stopping

Figures = dict[str, F64]
PERCENT = 100.0


@dataclass(frozen=True)
class ClaimOutcome:
    """Outcome of a claim.

    Attributes:
        look: number of the look at which it was called; None: never.
        state: then, or at the last look.
    """

    look: int | None
    state: ClaimState


@dataclass(frozen=True)
class CampaignCourse:
    """Course of a campaign.

    Attributes:
        evidence: at its end; its looks are all that a campaign of a given order might have had.
        claims: in order.
        ended: trials of the campaign where its claims ended it; None: they did not.
    """

    evidence: ClaimEvidence
    claims: tuple[ClaimOutcome, ...]
    ended: int | None


def course(
    plan: Plan, grid: TrialGrid, values: Figures, over_time: Figures | None = None
) -> CampaignCourse:
    """Return the course of a campaign of a plan with claims.

    Args:
        grid: of the plan. values: (N,) by figure, of its trials in its order.
        over_time: (N,) by figure, what the first, second, ... trial that is taken shows more.
    """
    if plan.protocol.collection.adaptive is not None:
        return _chosen_course(plan, grid, values, over_time)
    stopping = claims_of(plan)
    evidence = planned_evidence(plan, grid, values, over_time)
    claims = _called(evidence, stopping)
    settled = _settled(evidence, claims, stopping.least)
    return CampaignCourse(
        evidence, claims, None if settled is None else int(evidence.looks[settled])
    )


def claims_of(plan: Plan) -> Stopping:
    """Return the claims of a plan that has some."""
    stopping = plan.protocol.collection.stopping
    assert stopping is not None
    return stopping


def _settled(evidence: ClaimEvidence, claims: Sequence[ClaimOutcome], least: int) -> int | None:
    """Return the first look at which all claims are called; None before it."""
    called = [it.look for it in claims if it.look is not None]
    if len(called) < len(claims):
        return None
    enough = (k for k in range(max(called), len(evidence.looks)) if evidence.looks[k] >= least)
    return next(enough, None)


def _shown(values: Figures, taken: I64, over_time: Figures | None) -> Figures:
    """Return the figures of trials in the order taken."""
    found = {name: value[taken] for name, value in values.items()}
    for name, added in (over_time or {}).items():
        found[name] = found[name] + added[: len(taken)]
        if name == "accuracy":
            found[name] = np.clip(found[name], 0.0, PERCENT)
    return found


def planned_evidence(
    plan: Plan, grid: TrialGrid, values: Figures, over_time: Figures | None = None
) -> ClaimEvidence:
    """Return all evidence of a campaign in its plan's order, with a look after each round.

    A round with which it would take more trials than it may is left out.
    """
    stopping = claims_of(plan)
    ends = round_ends(grid, stopping)
    taken = np.argsort(grid.repetition, kind="stable")[: ends[-1]]
    shown = _shown(values, taken, over_time)
    return ClaimEvidence(grid, taken, ends, shown, block=stopping.block)


def _called(evidence: ClaimEvidence, stopping: Stopping) -> tuple[ClaimOutcome, ...]:
    """Return how claims come out; once all are called, no later look is made."""
    looks: list[int | None] = [None] * len(stopping.claims)
    at_call: dict[int, ClaimState] = {}
    found: tuple[ClaimState, ...] = ()
    fits: Fits = {}
    for look in range(len(evidence.looks)):
        found = states(evidence.until(look), stopping, fits, found)
        for k, state in enumerate(found):
            if looks[k] is None and is_called(state):
                looks[k], at_call[k] = look, state
        if None not in looks:
            break
    return tuple(ClaimOutcome(look, at_call.get(k, found[k])) for k, look in enumerate(looks))


def _chosen_course(
    plan: Plan, grid: TrialGrid, values: Figures, over_time: Figures | None
) -> CampaignCourse:
    """Return the course of an adaptive campaign: it takes one more round than it needs."""
    stopping = claims_of(plan)
    called: dict[int, ClaimOutcome] = {}
    claims: tuple[ClaimOutcome, ...] = ()
    fits: Fits = {}
    found: tuple[ClaimState, ...] = ()
    rounds = chosen_evidence(plan, grid, values, fits, over_time)
    evidence = next(rounds)
    while True:
        found = states(evidence, stopping, fits, found)
        for number, state in enumerate(found):
            if is_called(state):
                called.setdefault(number, ClaimOutcome(len(evidence.looks) - 1, state))
        claims = tuple(called.get(k, ClaimOutcome(None, state)) for k, state in enumerate(found))
        settled = _settled(evidence, claims, stopping.least) is not None
        following = next(rounds, None)
        too_many = following is not None and len(following.taken) > (stopping.most or math.inf)
        if following is None or too_many:
            break
        evidence = following
        if settled:
            break
    return CampaignCourse(evidence, claims, len(evidence.taken) if settled else None)


def chosen_evidence(
    plan: Plan, grid: TrialGrid, values: Figures, fits: Fits, over_time: Figures | None = None
) -> Iterator[ClaimEvidence]:
    """Yield an adaptive campaign's evidence after each round, up to the whole grid.

    Args:
        fits: as for `states`. over_time: as for `course`.
    """
    stopping, choice = claims_of(plan), plan.protocol.collection.adaptive
    assert choice is not None
    batches: list[TrialBatch] = []
    looks: list[int] = []
    while True:
        # the next batch does not wait for the last round's figures
        known = _seen(grid, batches, looks[:-1], values, over_time)
        for _ in range(grid.stretches):
            batch = next_batch(known, batches, stopping, choice, plan.seed, fits)
            if batch is not None:
                batches.append(batch)
        taken = sum(len(batch.trials) for batch in batches)
        if looks and taken == looks[-1]:
            return
        looks.append(taken)
        yield _seen(grid, batches, looks, values, over_time)


def _seen(
    grid: TrialGrid,
    batches: Sequence[TrialBatch],
    looks: Sequence[int],
    values: Figures,
    over_time: Figures | None,
) -> ClaimEvidence:
    """Return the evidence of rounds that end at `looks`."""
    items = [(item, batch) for batch in batches for item in batch.trials]
    items = items[: looks[-1] if looks else 0]
    taken = np.array([grid.number[item.trial] for item, _ in items], np.int64)
    chances = np.array([item.chance for item, _ in items], np.float64)
    shown = _shown(values, taken, over_time)
    return ClaimEvidence(grid, taken, np.array(looks, np.int64), shown, chances)
