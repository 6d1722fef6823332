"""Campaigns drawn from a pilot: figures of trials that were not taken.

A trial's figure is that of one of the pilot's trials of the same condition, or of the nearest
ones, moved by what the factors' effects differ between the two conditions. So undetected and
missing ones come as often as the pilot has them there, and all figures of a trial belong together.
Blocks differ as much as the pilot's do, sessions as much as is stated or as the pilot's do; a
drift is drawn where one is stated. The pilot is itself one of many that might have been: it is
resampled in the same way before each campaign (a hierarchical bootstrap: Davison and Hinkley 1997,
Bootstrap Methods and their Application, section 3.8). Few values, drawn again and again, would give
percentiles in steps, so each is moved by a little more chance, and their spread is preserved
(Silverman and Young 1987, The bootstrap: to smooth or not to smooth?).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from sliplab.plugins.claims.blocks import F64, I64, block_share
from sliplab.plugins.claims.evidence import TrialGrid, planned_end
from sliplab.plugins.claims.expectation import expectation
from sliplab.protocols import Plan
from sliplab.protocols.factors import Factor, Level
from sliplab.protocols.key_errors import KeyedError

DONORS = 10
"""Trials of a pilot that a figure may come from, at least."""
ASSUMED = 0.3
"""Of `Sessions.between` where a pilot of one session cannot show it."""
MOST_PERCENT = 100.0
TURN_DEG = 360.0
Condition = Mapping[str, Level]


@dataclass(frozen=True)
class SharedFactor:
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
class Sessions:
    """Sessions of a planned campaign, such as days, mountings or skins, and its drift.

    Attributes:
        count: of equally many trials.
        between: standard deviation between sessions, as a share of that between the trials of a
            block; None: as in the pilot, or `ASSUMED` where it is of one session.
        drift: from the first trial to the last, as a share of the same; up or down by chance.
    """

    count: int = 1
    between: float | None = None
    drift: float = 0.0


ONE_SESSION = Sessions()


@dataclass(frozen=True)
class PilotFigures:
    """Trials whose figures are known.

    Attributes:
        axes: factors that the plan has, too. conditions: of each trial.
        blocks: (n,) number of each trial's block.
        values: (n,) by figure, in its unit; NaN where a trial has none, infinite where nothing was
            detected.
        sessions: (n,) number of each trial's session; None: all are of one.
    """

    axes: tuple[SharedFactor, ...]
    conditions: tuple[Condition, ...]
    blocks: I64
    values: dict[str, F64]
    sessions: I64 | None = None

    @property
    def session_count(self) -> int:
        """Number of sessions."""
        return 1 if self.sessions is None else len(np.unique(self.sessions))

    @cached_property
    def _off(self) -> dict[str, F64]:
        """Residual of each trial from its condition's expected figure, (n,) by figure."""
        own = [tuple(condition[axis.name] for axis in self.axes) for condition in self.conditions]
        code, _ = self._coded(own, np.random.default_rng(0))
        return {
            name: y - expectation(code, np.arange(len(y)), y).mean
            for name, y in self.values.items()
        }

    def scatter(self, figure: str) -> float:
        """Return the standard deviation between the trials of a block, in the figure's unit."""
        off = self._off[figure]
        there = off[np.isfinite(off)]
        share, _ = block_share(off, self.blocks)
        return float(np.sqrt(1.0 - share) * there.std(ddof=1)) if len(there) > 1 else 0.0

    def between(self, figure: str, sessions: Sessions) -> float:
        """Return the deviation between planned sessions, as a share of `scatter`."""
        if sessions.between is not None:
            return sessions.between
        if self.session_count < 2 or self.sessions is None:
            return ASSUMED
        off, of, scatter = self._off[figure], self.sessions, self.scatter(figure)
        first, block = np.unique(self.blocks, return_index=True, return_inverse=True)[1:]
        if len(first) >= 2 * self.session_count:  # else sessions and blocks cannot be distinguished
            there = np.isfinite(off)
            count = np.bincount(block[there], minlength=len(first))
            total = np.bincount(block[there], off[there], minlength=len(first))
            off, of = np.where(count > 0, total / np.maximum(count, 1), np.nan), of[first]
        return block_share(off, of, least=2)[1] / scatter if scatter > 0.0 else 0.0

    def without(self, sessions: Sessions) -> PilotFigures:
        """Return the pilot without differences between its sessions, where these are drawn."""
        if self.sessions is None or sessions.count == 1 or sessions.between == 0.0:
            return self
        values = {name: y.copy() for name, y in self.values.items()}
        for session in np.unique(self.sessions):
            here = self.sessions == session
            for name, off in self._off.items():
                there = off[here & np.isfinite(off)]
                values[name][here] -= there.mean() if len(there) else 0.0
        return replace(self, values=values)

    def over_time(
        self, plan: Plan, grid: TrialGrid, sessions: Sessions, rng: np.random.Generator
    ) -> dict[str, F64]:
        """Draw the effects of time on a campaign's trials, (N,) by figure, in the order taken.

        These are of sessions, of a drift, and of the batches of an adaptive campaign, which are its
        blocks.
        """
        choice, stopping = plan.protocol.collection.adaptive, plan.protocol.collection.stopping
        assert stopping is not None
        place = np.arange(len(grid.trials))
        end = planned_end(grid, stopping, adaptive=choice is not None)
        session = np.minimum(place * sessions.count // end, sessions.count - 1)
        of_session = rng.standard_normal(sessions.count)[session] * (sessions.count > 1)
        trend = rng.choice([-1.0, 1.0]) * (place / max(end - 1, 1) - 0.5)
        of_batch = np.zeros(len(place))
        if choice is not None:
            first = max(choice.start // grid.stretches, 2) * grid.stretches
            batch = np.maximum((place - first) // (choice.batch * grid.stretches) + 1, 0)
            of_batch = rng.standard_normal(len(place))[batch]
        found = {}
        for name, off in self.without(sessions)._off.items():
            shift = self.between(name, sessions) * of_session + sessions.drift * trend
            found[name] = self.scatter(name) * shift + block_share(off, self.blocks)[1] * of_batch
        return found

    def campaign(
        self, grid: TrialGrid, rng: np.random.Generator, *, in_blocks: bool = True
    ) -> dict[str, F64]:
        """Draw the figures of a campaign, (N,) by figure.

        Args:
            in_blocks: blocks of the plan's order differ.
        """
        blocks = np.array([trial.block for trial in grid.trials], np.int64)
        conditions = [dict(trial.condition) for trial in grid.trials]
        return self._again(rng)._drawn(conditions, blocks if in_blocks else None, rng)

    def _again(self, rng: np.random.Generator) -> PilotFigures:
        """Resample the pilot."""
        return replace(self, values=self._drawn(self.conditions, self.blocks, rng))

    def _drawn(
        self, conditions: Sequence[Condition], blocks: I64 | None, rng: np.random.Generator
    ) -> dict[str, F64]:
        count = len(self.conditions)
        kinds: dict[tuple[Level, ...], int] = {}
        kind = np.array(
            [
                kinds.setdefault(tuple(condition[axis.name] for axis in self.axes), len(kinds))
                for condition in conditions
            ]
        )
        own = [tuple(condition[axis.name] for axis in self.axes) for condition in self.conditions]
        code, places = self._coded([*own, *kinds], rng)
        far = np.abs(places[count:, None] - places[None, :count]).sum(axis=2)
        within = np.sort(far, axis=1)[:, [min(DONORS, count) - 1]]
        near = far <= within + 1e-9  # (kinds, count)
        # the k-th of a row's donors, k even over them
        pick = np.floor(rng.random(len(kind)) * near.sum(axis=1)[kind]).astype(np.int64)
        donor = np.argsort(~near, axis=1, kind="stable")[kind, pick]
        of_block = np.zeros(len(kind))
        if blocks is not None:
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


def sessions_text(pilot: PilotFigures, sessions: Sessions) -> Iterator[str]:
    """Yield which sessions and drift are drawn, and the limits of the pilot for them."""
    there, only = pilot.session_count, "a pilot of one session cannot show how sessions differ"
    sizes = ", ".join(f"{pilot.between(name, sessions):.2f} ({name})" for name in pilot.values)
    sizes += " of the scatter between trials"
    if sessions.count == 1:
        shown = only if there == 1 else f"the pilot's {there} differ by {sizes}"
        yield f"one session is drawn (see --sessions): {shown}"
    else:
        how = "" if sessions.between is not None else ", which is assumed"
        if there > 1 and sessions.between is None:
            how = f", as the pilot's {there} do"
        known = f": {only}" if there == 1 else ""
        yield f"{sessions.count} sessions are drawn, which differ by {sizes}{how}{known}"
    if sessions.drift:
        yield f"a drift of {sessions.drift:g} of the scatter between trials is drawn, up or down"
    else:
        yield "no drift is drawn (see --drift)"


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


def shared_axes(
    plan: Plan, conditions: Sequence[Condition]
) -> tuple[tuple[SharedFactor, ...], list[str]]:
    """Return the factors that a pilot and a plan share, and the limits of the pilot for others.

    Args:
        conditions: of the pilot's trials.

    Raises:
        KeyedError: a level lies outside of the pilot's, or is compared by a claim and unknown.
    """
    axes: list[SharedFactor] = []
    notes: list[str] = []
    collection, levels = plan.protocol.collection, plan.enabled
    claims = () if collection.stopping is None else collection.stopping.claims
    compared = {claim.between.factor for claim in claims if claim.between is not None}
    directions = {ref.factor for key, ref in collection.bindings() if key.endswith(".direction")}
    for name, factor in collection.all_factors.items():
        if not all(name in condition for condition in conditions):
            if name in compared:
                raise KeyedError(
                    f"collection.factors.{name}",
                    None,
                    "is compared by a claim, and the pilot does not vary it: take some trials of "
                    "both levels",
                )
            if len(levels[name]) > 1:
                notes.append(f"the pilot lacks the factor {name}: no effect of it is assumed")
            continue
        known = list(dict.fromkeys(condition[name] for condition in conditions))
        words = [level for level in known if isinstance(level, str)]
        if not words:
            known = sorted(known, key=float)
        elif len(words) < len(known):
            raise KeyedError(f"collection.factors.{name}", known[0], "is words in one of both")
        axis = SharedFactor(name, tuple(known), turns=name in directions and not words)
        notes += _unknown(axis, factor, levels[name], name in compared)
        axes.append(axis)
    return tuple(axes), notes


def _unknown(
    axis: SharedFactor, factor: Factor, levels: Sequence[Level], compared: bool
) -> Iterator[str]:
    """Yield notes on levels that the pilot lacks.

    Raises:
        KeyedError: nothing is known of one of them.
    """
    there = ", ".join(map(factor.text, axis.levels))
    lacking = [level for level in levels if level not in axis.levels]
    for level in lacking:
        by_chance = isinstance(level, str) and not axis.numeric and not compared
        if not axis.knows(level) and not by_chance:
            raise KeyedError(
                f"collection.factors.{axis.name}",
                factor.text(level),
                f"lies outside of the pilot's levels, {there}: take some trials there, or leave "
                "this level out",
            )
    if lacking:
        texts = ", ".join(map(factor.text, lacking))
        how = "taken to lie between" if axis.numeric else "each taken for one of"
        yield f"the pilot lacks {axis.name} {texts}: {how} its own, {there}"
