"""Evidence of a campaign: figures of each trial, in the order in which they were taken."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from sliplab.plugins.claims.blocks import F64, I64, MeanEstimate, of_trials
from sliplab.protocols import Plan, PlannedTrial
from sliplab.protocols.claims import Claim, LevelDifference, Stopping
from sliplab.protocols.factors import Factor

Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class TrialGrid:
    """The measured trials of a plan, numbered in its order.

    Attributes:
        trials: N of them. factors: of the plan, with its context.
        levels: (N, factors) int64, numbers of their levels.
        stretch: (N,) int64, number of the combination of levels that a person sets.
    """

    trials: tuple[PlannedTrial, ...]
    factors: Mapping[str, Factor]
    levels: I64
    stretch: I64

    @staticmethod
    def of(plan: Plan) -> TrialGrid:
        """Return the grid of a plan."""
        trials = tuple(trial for trial in plan if trial.role == "measured")
        factors = plan.protocol.collection.all_factors
        order = {name: {level: n for n, level in enumerate(plan.enabled[name])} for name in factors}
        levels = [[order[name][level] for name, level in trial.condition] for trial in trials]
        by_person = [factor.changeover == "person" for factor in factors.values()]
        table = np.array(levels, np.int64).reshape(len(trials), len(factors))
        kinds = np.unique(table[:, by_person], axis=0, return_inverse=True)[1]
        return TrialGrid(trials, factors, table, np.asarray(kinds, np.int64).reshape(len(trials)))

    @property
    def stretches(self) -> int:
        """Number of combinations of levels that a person sets."""
        return int(self.stretch.max()) + 1

    @cached_property
    def number(self) -> dict[str, int]:
        """Number of each trial by id."""
        return {trial.id: number for number, trial in enumerate(self.trials)}

    @cached_property
    def condition(self) -> I64:
        """(N,) number of each trial's condition."""
        kinds = np.unique(self.levels, axis=0, return_inverse=True)[1]
        return np.asarray(kinds, np.int64).reshape(len(self.trials))

    @cached_property
    def repetition(self) -> I64:
        """(N,) number of each trial's repetition, from 1."""
        return np.array([trial.repetition for trial in self.trials], np.int64)

    def members(self, between: LevelDifference, place: int) -> Mask:
        """Return which trials have one of two compared levels."""
        name, level = between.factor, between.levels[place]
        if (name, level) not in self._members:
            found = [dict(trial.condition)[name] == level for trial in self.trials]
            self._members[name, level] = np.array(found, np.bool_)
        return self._members[name, level]

    @cached_property
    def _members(self) -> dict[tuple[str, object], Mask]:
        return {}


@dataclass(frozen=True)
class ClaimEvidence:
    """Trials of the rounds so far, and their figures.

    Attributes:
        taken: (n,) numbers of the trials in the grid, in the order taken.
        looks: (k,) how many of them there are at the end of each round.
        values: (n,) by figure, in the figure's unit; NaN where a trial has none, or was left out;
            infinite where nothing was detected.
        chances: (n,) with which each trial of an adaptive campaign was drawn; NaN where it was
            placed. None where the plan gives the order.
        block: trials in a row that may resemble each other; None: all of a repetition.
    """

    grid: TrialGrid
    taken: I64
    looks: I64
    values: dict[str, F64]
    chances: F64 | None = None
    block: int | None = None

    def digest(self) -> str:
        """Return a hash of the trials and their figures."""
        whole = hashlib.sha256(self.taken.tobytes())
        for name in sorted(self.values):
            whole.update(name.encode() + self.values[name].tobytes())
        return whole.hexdigest()

    @cached_property
    def rounds(self) -> I64:
        """(n,) number of each trial's round."""
        return np.asarray(
            np.searchsorted(self.looks, np.arange(len(self.taken)), "right"), np.int64
        )

    @cached_property
    def blocks(self) -> I64:
        """(n,) number of each trial's block: a batch, a repetition, or some trials of one."""
        if self.chances is not None:
            return self.rounds
        repetition = self.grid.repetition[self.taken]
        if self.block is None:
            return np.asarray(np.unique(repetition, return_inverse=True)[1], np.int64)
        stretch = self.grid.stretch[self.taken]
        new = np.ones(len(self.taken), np.bool_)
        new[1:] = (np.diff(repetition) != 0) | (np.diff(stretch) != 0)
        first = np.flatnonzero(new)[np.cumsum(new) - 1]
        begin = (np.arange(len(self.taken)) - first) % self.block == 0
        return np.asarray(np.cumsum(begin) - 1, np.int64)

    @cached_property
    def block_count(self) -> I64:
        """(k,) number of blocks at each look."""
        # numbers rise from 0, each with its first trial
        return np.array([self.blocks[:n].max(initial=-1) + 1 for n in self.looks], np.int64)

    @cached_property
    def left(self) -> Mask:
        """(k, N) trials that were left when each round began."""
        since = np.full(len(self.grid.trials), len(self.looks), np.int64)
        since[self.taken] = self.rounds
        return np.asarray(np.arange(len(self.looks))[:, None] <= since)

    def until(self, look: int) -> ClaimEvidence:
        """Return the evidence at an earlier look, by its number."""
        n = int(self.looks[look])
        return ClaimEvidence(
            self.grid,
            self.taken[:n],
            self.looks[: look + 1],
            {name: value[:n] for name, value in self.values.items()},
            None if self.chances is None else self.chances[:n],
            self.block,
        )


def members_of(claim: Claim, grid: TrialGrid) -> list[Mask]:
    """Return the trials that a claim is about: all, or those of either of two levels."""
    if claim.between is None:
        return [np.ones(len(grid.trials), np.bool_)]
    return [grid.members(claim.between, place) for place in (0, 1)]


def round_ends(grid: TrialGrid, stopping: Stopping) -> I64:
    """Return how many trials of a planned order there are at the end of each round.

    A round with which there would be more than `most` is left out, unless it is the first.
    """
    ends = np.cumsum(np.bincount((grid.repetition - 1) // stopping.repetitions))
    if stopping.most is not None:
        ends = ends[: max(int((ends <= stopping.most).sum()), 1)]
    return np.asarray(ends, np.int64)


def planned_end(grid: TrialGrid, stopping: Stopping, *, adaptive: bool) -> int:
    """Return the number of trials of a campaign that no claim ends."""
    if adaptive:
        return min(len(grid.trials), stopping.most or len(grid.trials))
    return int(round_ends(grid, stopping)[-1])


def planned_estimate(evidence: ClaimEvidence, x: F64, members: Mask, expected: F64) -> MeanEstimate:
    """Return an estimate of the mean of `x`, each condition alike, in the order of the plan.

    Args:
        x: (n,) from 0 to 1, of the taken trials; NaN where unknown, which are left out.
        members: (N,) of the grid. expected: (N,) of `x`, which takes conditions that a block lacks
            out of its scatter.
    """
    used = members[evidence.taken] & ~np.isnan(x)
    count = int(evidence.block_count[-1]) if len(evidence.looks) else 0
    n = int(used.sum())
    if not n:
        return MeanEstimate(float("nan"), np.zeros(count))
    off = np.where(used, x - expected[evidence.taken], 0.0)
    weights = used / n
    return of_trials(float(x[used].mean()), off, weights, evidence.blocks, count)


def chosen_estimate(
    evidence: ClaimEvidence, x: F64, members: Mask, expected: F64, latest: F64
) -> MeanEstimate:
    """Return an estimate of the mean of `x`, each condition alike, of trials chosen by chance.

    At each draw what was taken is known, what is left is expected, and the drawn trial corrects
    that by its difference from the expected, divided by its chance: without bias whatever is
    expected (Waudby-Smith, Stark and Ramdas 2021, RiLACS; with a prediction as in Robins, Rotnitzky
    and Zhao 1994). Draws count by the inverse square of what is left, as their variance does. Each
    trial's weight in the sum gives the scores of blocks, so that the error is that of conditions
    repeated for ever, not of the grid's own trials.

    Args:
        x, members: as for `planned_estimate`.
        expected: (k, N) from 0 to 1, of each round, by what was known when it began.
        latest: (N,) by all that is known, for the scores.
    """
    assert evidence.chances is not None
    grid, taken, left, rounds = evidence.grid, evidence.taken, evidence.left, evidence.rounds
    guess = expected[rounds, taken]
    value = np.where(np.isnan(x), guess, x)
    count, total = len(evidence.looks), int(members.sum())
    estimate, weights = 0.0, np.zeros(len(taken))
    for stretch in range(grid.stretches):
        ours = members & (grid.stretch == stretch)
        size = int(ours.sum())
        drawn = np.flatnonzero(grid.stretch[taken] == stretch)
        chance = evidence.chances[drawn]
        by_chance = ~np.isnan(chance)
        if not size:
            continue
        if not by_chance.any():
            return MeanEstimate(float("nan"), np.zeros(count))
        of = rounds[drawn]
        inside = ours[taken[drawn]]
        away = np.where(inside, value[drawn] - guess[drawn], 0.0)
        counted = np.concatenate([[0.0], np.cumsum(np.where(inside, value[drawn], 0.0))])
        begin = np.searchsorted(of, np.arange(count))  # places of the rounds' first draws
        known = counted[begin] + np.where(left & ours, expected, 0.0).sum(axis=1)
        before = np.cumsum(away) - away
        before -= before[begin[of]]
        remaining = int((grid.stretch == stretch).sum()) - np.arange(len(drawn))
        draws = np.where(by_chance, 1.0 / remaining**2, 0.0)
        draws /= draws.sum()
        scaled = np.where(by_chance, 1.0 / np.where(by_chance, chance, 1.0), 0.0)
        z = (known[of] + before + away * scaled) / size
        estimate += size / total * float(draws @ z)
        later = 1.0 - np.cumsum(draws)
        weights[drawn] = inside * (later + draws * scaled) / total
    return of_trials(estimate, value - latest[taken], weights, rounds, count)
