"""Choice of the next trials: those that would narrow the open claims most, and some by chance.

The spread of an estimate is smallest where trials are taken in proportion to their own spread
(Neyman 1934). The spread is expected by factors; of a percentile it is that of lying below it. A
share of each choice is even over all that is left, so that every trial has a known chance.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sliplab.plugins.claims.blocks import F64, I64
from sliplab.plugins.claims.document import ChosenTrial, TrialBatch
from sliplab.plugins.claims.evidence import ClaimEvidence, TrialGrid, members_of
from sliplab.plugins.claims.states import ClaimHistory, Fits, estimate_of, is_called, state_of
from sliplab.protocols.claims import QUANTILES, AdaptiveChoice, Claim, Stopping
from sliplab.protocols.hashing import hash_integer

CENTRE = 0.2, 0.8
"""Percentiles outside are about rare trials, which unequal chances do not find sooner; a few large
weights would decide."""


def next_batch(
    known: ClaimEvidence,
    chosen: Sequence[TrialBatch],
    stopping: Stopping,
    choice: AdaptiveChoice,
    seed: int,
    fits: Fits | None = None,
) -> TrialBatch | None:
    """Choose the trials that follow `chosen`; None if none are left.

    A round has a batch of every stretch between two changes by a person. The first round fills the
    grid evenly, without chance. The same arguments give the same trials.

    Args:
        known: trials of earlier batches whose figures are known.
        seed: the protocol's. fits: as for `states`.
    """
    grid = known.grid
    stretches = grid.stretches
    left = np.ones(len(grid.trials), np.bool_)
    for batch in chosen:
        left[[grid.number[item.trial] for item in batch.trials]] = False
    if not left.any():
        return None
    number = len(chosen)
    stretch = number % stretches
    while not (left & (grid.stretch == stretch)).any():  # fewer levels may be left than others
        stretch = (stretch + 1) % stretches
    here = np.flatnonzero(left & (grid.stretch == stretch))
    rng = np.random.Generator(np.random.PCG64(hash_integer(seed, "choice", number)))
    if number < stretches:
        count = max(choice.start // stretches, 2)
        items = [
            ChosenTrial(trial=grid.trials[k].id, chance=None)
            for k in spread_out(grid, here, count, rng)
        ]
        return TrialBatch(known=0, least=None, trials=tuple(items))
    history = ClaimHistory(known, stopping, {} if fits is None else fits)
    share = chances(history, here, choice.random)
    items = []
    p = share.copy()
    for _ in range(min(choice.batch, len(here))):
        p /= p.sum()
        k = int(rng.choice(len(here), p=p))
        items.append(ChosenTrial(trial=grid.trials[here[k]].id, chance=float(p[k])))
        p[k] = 0.0
    return TrialBatch(known=len(known.taken), least=float(share.min()), trials=tuple(items))


def chances(history: ClaimHistory, here: I64, random: float) -> F64:
    """Return the chance of each trial of `here`, (k,), all above 0.

    Args:
        random: share that is even over them.
    """
    even = np.full(len(here), 1.0 / len(here))
    if not len(history.evidence.taken):
        return even
    total = np.zeros(len(here))
    for claim in history.stopping.claims:
        if is_called(state_of(claim, history)):
            continue
        worth = _spread(claim, history)[here]
        if worth.sum() > 0.0:
            total += worth / worth.sum()
    return even if total.sum() == 0.0 else random * even + (1.0 - random) * total / total.sum()


def _spread(claim: Claim, history: ClaimHistory) -> F64:
    """Return the spread that each trial of the grid is expected to add to a claim's estimate."""
    grid = history.evidence.grid
    found = np.zeros(len(grid.trials))
    expected = history.expected_after(claim.figure, len(history.evidence.taken))
    for members in members_of(claim, grid):
        if claim.of == "mean":
            spread = expected.spread
        elif not CENTRE[0] <= QUANTILES[claim.of] <= CENTRE[1]:
            spread = np.ones(len(found))
        else:
            at = estimate_of(claim, history, members)
            if claim.within is None and claim.between is None:
                at = claim.value
            below = expected.below(at) if at is not None else np.full(len(found), 0.5)
            spread = np.sqrt(below * (1.0 - below))
        found[members] = spread[members]
    return found


def spread_out(grid: TrialGrid, here: I64, count: int, rng: np.random.Generator) -> list[int]:
    """Choose trials that lie far from each other in the grid, the first by chance.

    The distance of two trials is the sum over factors of that of their levels, as a share of the
    factor's range; each next trial is the farthest from all before it.
    """
    levels = grid.levels[here].astype(np.float64)
    levels /= np.maximum(levels.max(axis=0), 1.0)
    order = rng.permutation(len(here))  # ties
    nearest = np.full(len(here), np.inf)
    found: list[int] = []
    for _ in range(min(count, len(here))):
        k = int(order[np.argmax(nearest[order])])
        found.append(int(here[k]))
        nearest = np.minimum(nearest, np.abs(levels - levels[k]).sum(axis=1))
        nearest[k] = -1.0
    return found
