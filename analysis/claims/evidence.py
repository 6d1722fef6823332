"""What a campaign's trials show: figures of each trial, in the order in which they were taken."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from sliplab.analysis.claims.sequences import F64, Bets
from sliplab.protocols import Plan, Trial
from sliplab.protocols.claims import Claim, Difference
from sliplab.protocols.factors import Factor

I64 = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Grid:
    """The measured trials of a plan, numbered in its order.

    Attributes:
        trials: N of them. factors: of the plan, with its context.
        levels: (N, factors) int64, numbers of their levels.
        stretch: (N,) int64, number of the combination of levels that a person sets.
    """

    trials: tuple[Trial, ...]
    factors: Mapping[str, Factor]
    levels: I64
    stretch: I64

    @staticmethod
    def of(plan: Plan) -> Grid:
        """Return the grid of a plan."""
        trials = tuple(trial for trial in plan if trial.role == "measured")
        factors = plan.protocol.collection.all_factors
        order = {name: {level: n for n, level in enumerate(plan.enabled[name])} for name in factors}
        levels = [[order[name][level] for name, level in trial.condition] for trial in trials]
        by_person = [factor.changeover == "person" for factor in factors.values()]
        table = np.array(levels, np.int64).reshape(len(trials), len(factors))
        kinds = np.unique(table[:, by_person], axis=0, return_inverse=True)[1]
        return Grid(trials, factors, table, np.asarray(kinds, np.int64).reshape(len(trials)))

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

    def members(self, between: Difference, place: int) -> Mask:
        """Return which trials have one of two compared levels."""
        name, level = between.factor, between.levels[place]
        return np.array([dict(trial.condition)[name] == level for trial in self.trials], np.bool_)


@dataclass(frozen=True)
class Chances:
    """With what chance the trials of an adaptive campaign were chosen.

    Attributes:
        chosen: (n,) of each taken trial, when it was drawn; NaN where no chance decided.
        least: (n,) the smallest that any trial left had when its batch was chosen.
    """

    chosen: F64
    least: F64


@dataclass(frozen=True)
class Evidence:
    """Taken trials and their figures.

    Attributes:
        taken: (n,) numbers of the trials in the grid, in the order taken.
        looks: (k,) how many of them there are at the end of each round.
        values: (n,) by figure, in the figure's unit; NaN where a trial has none, infinite where
            nothing was detected.
        chances: None where the plan gives the order.
    """

    grid: Grid
    taken: I64
    looks: I64
    values: dict[str, F64]
    chances: Chances | None = None

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
    def left(self) -> Mask:
        """(k, N) what was left when each round began."""
        since = np.full(len(self.grid.trials), len(self.looks), np.int64)
        since[self.taken] = self.rounds
        return np.asarray(np.arange(len(self.looks))[:, None] <= since)

    def until(self, look: int) -> Evidence:
        """Return the evidence at an earlier look, by its number."""
        n = int(self.looks[look])
        chances = self.chances
        if chances is not None:
            chances = Chances(chances.chosen[:n], chances.least[:n])
        return Evidence(
            self.grid, self.taken[:n], self.looks[: look + 1],
            {name: value[:n] for name, value in self.values.items()}, chances,
        )  # fmt: skip


def members_of(claim: Claim, grid: Grid) -> list[Mask]:
    """Return the trials that a claim is about: all, or those of either of two levels."""
    if claim.between is None:
        return [np.ones(len(grid.trials), np.bool_)]
    return [grid.members(claim.between, place) for place in (0, 1)]


def plain_bets(evidence: Evidence, x: F64, members: Mask) -> Bets:
    """Return bets on the mean of `x` over trials that the plan ordered.

    Args:
        x: (n,) from 0 to 1, of the taken trials; NaN where unknown.
        members: (N,) of the grid.
    """
    used = members[evidence.taken] & ~np.isnan(x)
    counts = np.concatenate([[0], np.cumsum(used)])
    return Bets.of(x[used], np.asarray(counts[evidence.looks], np.int64))


def weighted_bets(evidence: Evidence, x: F64, members: Mask, expected: F64) -> Bets:
    """Return bets on the mean of `x` over the whole grid, of trials that were chosen by chance.

    What was taken is known, what is left is expected, and the trial drawn next corrects that by its
    difference from the expected, divided by its chance: without bias whatever is expected
    (Waudby-Smith, Stark and Ramdas 2021, RiLACS; with a prediction as in Robins, Rotnitzky and Zhao
    1994).

    Args:
        x, members: as for `plain_bets`.
        expected: (k, N) from 0 to 1, of each round, by what was known when it began.
    """
    assert evidence.chances is not None
    grid, taken, left = evidence.grid, evidence.taken, evidence.left
    rounds, chance = evidence.rounds, evidence.chances.chosen
    guess = expected[rounds, taken]
    value = np.where(np.isnan(x), guess, x)
    z = np.full(len(taken), np.nan)
    low, high = np.full(len(expected), np.inf), np.full(len(expected), -np.inf)
    for stretch in range(grid.stretches):
        ours = members & (grid.stretch == stretch)
        size = int(ours.sum())
        drawn = np.flatnonzero(grid.stretch[taken] == stretch)
        if not size or not len(drawn):
            continue
        of = rounds[drawn]
        inside = ours[taken[drawn]]
        away = np.where(inside, value[drawn] - guess[drawn], 0.0)
        counted = np.concatenate([[0.0], np.cumsum(np.where(inside, value[drawn], 0.0))])
        begin = np.searchsorted(of, np.arange(len(expected)))  # places of the rounds' first draws
        rest = left & ours
        known = counted[begin] + np.where(rest, expected, 0.0).sum(axis=1)
        before = np.cumsum(away) - away
        before -= before[begin[of]]
        with np.errstate(invalid="ignore"):
            z[drawn] = (known[of] + before + away / chance[drawn]) / size
        count = np.bincount(of, minlength=len(expected))
        there = count > 0
        least = np.ones(len(expected))
        least[of] = evidence.chances.least[drawn]
        far = 1.0 / (least * size)
        most = np.where(rest, expected, 0.0).max(axis=1, initial=0.0)
        fewest = np.where(rest, expected, 1.0).min(axis=1, initial=1.0)
        low = np.where(there, np.minimum(low, (known - count) / size - most * far), low)
        high = np.where(there, np.maximum(high, (known + count) / size + (1 - fewest) * far), high)
    used = ~np.isnan(z)
    counts = np.concatenate([[0], np.cumsum(used)])
    looks = np.asarray(counts[evidence.looks], np.int64)
    return Bets(z[used], low[rounds][used], high[rounds][used], looks)
