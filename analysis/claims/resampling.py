"""Campaigns as a pilot lets expect them: figures of trials that nobody has taken.

A trial's figure is that of one of the pilot's trials of the same condition, or of the nearest
ones, moved by what the factors' effects differ between the two conditions. So undetected and
missing ones come as often as the pilot has them there, and all figures of a trial belong together.
Blocks differ as much as the pilot's do. The pilot is itself one of many that might have been: it is
drawn anew in the same way before each campaign (a hierarchical bootstrap: Davison and Hinkley 1997,
Bootstrap Methods and their Application, section 3.8). Few values, drawn again and again, would give
percentiles in steps, so each is moved by a little more chance, and their spread is kept (Silverman
and Young 1987, The bootstrap: to smooth or not to smooth?).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from sliplab.analysis.claims.blocks import F64, I64, block_share
from sliplab.analysis.claims.evidence import Grid
from sliplab.analysis.claims.expectation import expectation
from sliplab.protocols import Plan
from sliplab.protocols.factors import Factor, Level
from sliplab.protocols.yaml_file import KeyedError

DONORS = 10
"""Trials of a pilot that a figure may come from, at least."""
MOST_PERCENT = 100.0
TURN_DEG = 360.0
Condition = Mapping[str, Level]


@dataclass(frozen=True)
class Axis:
    """A factor that the pilot and the plan have.

    Attributes:
        levels: of the pilot, numbers in ascending order. turns: they are directions, of which 360
            deg is 0 deg.
    """

    name: str
    levels: tuple[Level, ...]
    turns: bool = False

    @property
    def numeric(self) -> bool:
        """True where levels are numbers."""
        return not isinstance(self.levels[0], str)

    @cached_property
    def _numbers(self) -> F64:
        return np.array([float(level) for level in self.levels])

    def knows(self, level: Level) -> bool:
        """Return whether the level's effect follows from those of the pilot's levels."""
        if level in self.levels or not self.numeric or isinstance(level, str):
            return level in self.levels
        if self.turns:
            return len(self.levels) > 2
        return bool(self._numbers[0] <= float(level) <= self._numbers[-1])

    def weights(self, level: Level, rng: np.random.Generator) -> F64:
        """Return how much of the effect of each of the pilot's levels a level has; they add to 1.

        A number between two levels has part of both; a word that the pilot lacks is as one of
        the pilot's, by chance.
        """
        found = np.zeros(len(self.levels))
        if level in self.levels:
            found[self.levels.index(level)] = 1.0
        elif isinstance(level, str):
            found[rng.integers(len(found))] = 1.0
        else:
            numbers = np.append(self._numbers, self._numbers[0] + TURN_DEG)
            at = float(level)
            if self.turns:
                at = numbers[0] + (at - numbers[0]) % TURN_DEG
            above = int(np.searchsorted(numbers, at, side="right"))
            part = (at - numbers[above - 1]) / (numbers[above] - numbers[above - 1])
            found[above - 1] = 1.0 - part
            found[above % len(found)] += part
        return found

    def places(self, weights: F64) -> F64:
        """Return coordinates (n, k) of weights (n, levels), at most 1 away from each other."""
        if not self.numeric:
            return 0.5 * weights
        if self.turns:
            angle = np.radians(self._numbers)
            return 0.5 * weights @ np.column_stack([np.cos(angle), np.sin(angle)])
        reach = max(float(np.ptp(self._numbers)), 1e-12)
        return weights @ self._numbers[:, None] / reach


@dataclass(frozen=True)
class Pilot:
    """Trials whose figures are known.

    Attributes:
        axes: factors that the plan has, too. conditions: of each trial.
        blocks: (n,) number of each trial's block.
        values: (n,) by figure, in its unit; NaN where a trial has none, infinite where nothing was
            detected.
    """

    axes: tuple[Axis, ...]
    conditions: tuple[Condition, ...]
    blocks: I64
    values: dict[str, F64]

    def campaign(self, grid: Grid, rng: np.random.Generator) -> dict[str, F64]:
        """Draw the figures of a campaign, (N,) by figure."""
        blocks = np.array([trial.block for trial in grid.trials], np.int64)
        conditions = [dict(trial.condition) for trial in grid.trials]
        return self._again(rng)._drawn(conditions, blocks, rng)

    def _again(self, rng: np.random.Generator) -> Pilot:
        """Draw the pilot anew."""
        return replace(self, values=self._drawn(self.conditions, self.blocks, rng))

    def _drawn(
        self, conditions: Sequence[Condition], blocks: I64, rng: np.random.Generator
    ) -> dict[str, F64]:
        count = len(self.conditions)
        kinds: dict[tuple[Level, ...], int] = {}
        kind = np.array([
            kinds.setdefault(tuple(condition[axis.name] for axis in self.axes), len(kinds))
            for condition in conditions
        ])  # fmt: skip
        own = [tuple(condition[axis.name] for axis in self.axes) for condition in self.conditions]
        code, places = self._coded([*own, *kinds], rng)
        far = np.abs(places[count:, None] - places[None, :count]).sum(axis=2)
        within = np.sort(far, axis=1)[:, [min(DONORS, count) - 1]]
        near = far <= within + 1e-9  # (kinds, count)
        # the k-th of a row's donors, k even over them
        pick = np.floor(rng.random(len(kind)) * near.sum(axis=1)[kind]).astype(np.int64)
        donor = np.argsort(~near, axis=1, kind="stable")[kind, pick]
        _, number = np.unique(blocks, return_inverse=True)
        of_block = rng.standard_normal(int(number.max()) + 1)[number]
        found: dict[str, F64] = {}
        for name, y in self.values.items():
            mean = expectation(code, np.arange(count), y).mean
            off = y - mean[:count]
            finite = np.isfinite(off)
            number_near = np.maximum((near & finite).sum(axis=1), 1)
            centre = (near @ np.where(finite, off, 0.0) / number_near)[kind]
            # a sample's own mean is nearer to it than the true one
            wider = np.sqrt(number_near / np.maximum(number_near - 1.0, 1.0))[kind]
            share, size = block_share(off, self.blocks)
            smooth, scatter = _smoothing(off)
            away = smooth * (off[donor] - centre) + scatter * rng.standard_normal(len(donor))
            away = wider * np.sqrt(1.0 - share) * away + size * of_block
            drawn = np.where(finite[donor], mean[count:][kind] + centre + away, y[donor])
            found[name] = np.clip(drawn, 0.0, MOST_PERCENT) if name == "accuracy" else drawn
        return found

    def _coded(
        self, kinds: Sequence[tuple[Level, ...]], rng: np.random.Generator
    ) -> tuple[F64, F64]:
        """Return code for `expectation` and coordinates of conditions, (n, p) and (n, k)."""
        code, places = [np.ones((len(kinds), 1))], [np.zeros((len(kinds), 1))]
        for k, axis in enumerate(self.axes):
            levels = dict.fromkeys(kind[k] for kind in kinds)
            by_level = {level: axis.weights(level, rng) for level in levels}
            weights = np.array([by_level[kind[k]] for kind in kinds])
            code.append(weights)
            places.append(axis.places(weights))
        return np.hstack(code), np.hstack(places)


def _smoothing(off: F64) -> tuple[float, float]:
    """Return by how much residuals are shrunk, and the deviation of what is added to them.

    The width is Silverman's rule for a kernel density (1986, Density Estimation, section 3.4).
    """
    there = off[np.isfinite(off)]
    if len(there) < 2:
        return 1.0, 0.0
    deviation = float(there.std(ddof=1))
    quarter, three = np.quantile(there, [0.25, 0.75])
    width = 0.9 * min(deviation, float(three - quarter) / 1.34) * len(there) ** -0.2
    if width == 0.0:
        return 1.0, 0.0
    shrunk = 1.0 / np.sqrt(1.0 + (width / deviation) ** 2)
    return float(shrunk), float(shrunk * width)


def shared_axes(plan: Plan, conditions: Sequence[Condition]) -> tuple[tuple[Axis, ...], list[str]]:
    """Return the factors that a pilot and a plan share, and what the pilot does not tell of others.

    Args:
        conditions: of the pilot's trials.

    Raises:
        KeyedError: a level lies outside of the pilot's, or is compared by a claim and unknown.
    """
    axes: list[Axis] = []
    notes: list[str] = []
    collection, levels = plan.protocol.collection, plan.enabled
    claims = () if collection.stopping is None else collection.stopping.claims
    compared = {claim.between.factor for claim in claims if claim.between is not None}
    directions = {ref.factor for key, ref in collection.bindings() if key.endswith(".direction")}
    for name, factor in collection.all_factors.items():
        if not all(name in condition for condition in conditions):
            if name in compared:
                raise KeyedError(
                    f"collection.factors.{name}", None,
                    "is compared by a claim, and the pilot does not vary it: take some trials of "
                    "both levels",
                )  # fmt: skip
            if len(levels[name]) > 1:
                notes.append(f"the pilot lacks the factor {name}: no effect of it is assumed")
            continue
        known = list(dict.fromkeys(condition[name] for condition in conditions))
        words = [level for level in known if isinstance(level, str)]
        if not words:
            known = sorted(known, key=float)
        elif len(words) < len(known):
            raise KeyedError(f"collection.factors.{name}", known[0], "is words in one of both")
        axis = Axis(name, tuple(known), turns=name in directions and not words)
        notes += _unknown(axis, factor, levels[name], name in compared)
        axes.append(axis)
    return tuple(axes), notes


def _unknown(
    axis: Axis, factor: Factor, levels: Sequence[Level], compared: bool
) -> Iterator[str]:  # fmt: skip
    """Yield what to say of levels that the pilot lacks.

    Raises:
        KeyedError: nothing is known of one of them.
    """
    there = ", ".join(map(factor.text, axis.levels))
    lacking = [level for level in levels if level not in axis.levels]
    for level in lacking:
        by_chance = isinstance(level, str) and not axis.numeric and not compared
        if not axis.knows(level) and not by_chance:
            raise KeyedError(
                f"collection.factors.{axis.name}", factor.text(level),
                f"lies outside of the pilot's levels, {there}: take some trials there, or leave "
                "this level out",
            )  # fmt: skip
    if lacking:
        texts = ", ".join(map(factor.text, lacking))
        how = "taken to lie between" if axis.numeric else "each taken for one of"
        yield f"the pilot lacks {axis.name} {texts}: {how} its own, {there}"
