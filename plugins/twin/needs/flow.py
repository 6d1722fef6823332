"""Effects of a twin that its pilot requires, and the cheapest scene that predicts it as well.

The test trials are taken in worlds of the twin with all effects and with each left out, by the same
chance; the pilot's own say which predict better (`analysis.twin.needs`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from time import process_time

import numpy as np

from sliplab.plugins.simulation.scene_runs import changed, timed
from sliplab.plugins.simulation.settings import scene_of
from sliplab.plugins.twin.document import CheapestScene, EffectNeed
from sliplab.plugins.twin.effects import NOT_SHOWN, Effect, effects_of, lacking, merged
from sliplab.plugins.twin.needs.judging import (
    FEWEST_TRIALS,
    FEWEST_WORLDS,
    Marked,
    Marks,
    Need,
    marked,
    marks,
    need,
)
from sliplab.plugins.twin.pilot import PilotTrial
from sliplab.plugins.twin.worlds import DrawnWorld, everywhere
from sliplab.rigs.rig_inheritance import rig_yaml
from sliplab.storage.files import write_text
from sliplab.storage.streams import F64, Json

WORLDS = 8
"""Worlds with each effect, and as many without it."""
ROUNDS = 5
"""A scene is timed so often; the fastest counts."""
SAVES = 0.95
"""A scene is cheaper where it takes at most this share of the time."""


@dataclass(frozen=True)
class Needs:
    """Effects that a pilot requires.

    Attributes:
        effects: of the scene, those that it lacks, and those that no slide shows.
        cheapest: None where nothing that saves time can be left out.
        settings: of the section `mock:` that make the cheapest scene of the twin.
    """

    effects: tuple[EffectNeed, ...] = ()
    cheapest: CheapestScene | None = None
    settings: Json = field(default_factory=dict)


@dataclass(frozen=True)
class _Judged:
    """A pilot's test trials, and worlds of its twin.

    Attributes:
        pilot: one world. having: what `worlds` show.
    """

    pilot: Marked
    worlds: Sequence[DrawnWorld]
    having: Marked

    def without(self, effects: Sequence[Effect], beside: Json) -> list[Need]:
        """Return what leaving out each of some effects does under other settings."""
        bases = [merged(beside, effect.beside) for effect in effects]
        others = [base for k, base in enumerate(bases) if base and base not in bases[:k]]
        changes = [merged(beside, effect.without) for effect in effects]
        taken = self._under([*changes, *others])
        having = [({}, self.having), *zip(others, taken[len(changes) :], strict=True)]
        return [
            need(self.pilot, next(it for own, it in having if own == base), found)
            for base, found in zip(bases, taken, strict=False)
        ]

    def _under(self, settings: Sequence[Json]) -> list[Marked]:
        """Return what the worlds show under each of some settings."""
        jobs = [
            replace(world, rig=changed(world.rig, one)) for one in settings for world in self.worlds
        ]
        work = partial(_numbers, retained=frozenset(self.pilot.groups))
        found, count = everywhere("effects (worlds)", work, jobs), len(self.worlds)
        return [
            replace(self.having, values=np.concatenate(found[k : k + count]))
            for k in range(0, len(jobs), count)
        ]

    def seconds(self, settings: Sequence[Json]) -> list[float]:
        """Return the processor time of a slide under each of some settings."""
        rig, slides = self.worlds[0].rig, self.worlds[0].slides
        rigs = [changed(rig, one) for one in settings]
        rounds = [
            [timed(one, slides.plan, slides.trials[0], 0, process_time) for one in rigs]
            for _ in range(ROUNDS)
        ]
        return [min(times) for times in zip(*rounds, strict=True)]


def _numbers(world: DrawnWorld, retained: frozenset[str]) -> F64:
    return marked([[marks(trial) for trial in world.take()]], retained).values


def measure_needs(
    pilot: Sequence[PilotTrial], worlds: Sequence[DrawnWorld], taken: Sequence[Sequence[Marks]]
) -> Needs:
    """Measure which effects a pilot's test trials ask for; nothing with too few of them.

    Args:
        pilot: test trials. worlds: of the twin, with these trials. taken: marks of these.
    """
    if len(pilot) < FEWEST_TRIALS or len(worlds) < FEWEST_WORLDS:
        return Needs()
    own = [marks(trial) for trial in pilot]
    both = own[0].keys() & taken[0][0].keys()
    judged = _Judged(marked([own], both), worlds[:WORLDS], marked(taken[:WORLDS], both))
    scene = scene_of(worlds[0].rig)
    effects = list(effects_of(scene))
    found, against = _measured(judged, effects)
    whole_s, *each_s = judged.seconds([{}, *(effect.without for effect in effects)])
    times = {effect: one / whole_s for effect, one in zip(effects, each_s, strict=True)}
    spare = [
        effect for effect, it in found.items() if it.loss <= it.limit and times[effect] <= SAVES
    ]
    left, cheapest = _cheapest(judged, spare, found, against)
    rows = [
        EffectNeed(
            title=effect.title,
            verdict=it.verdict,
            shown_by=it.shown_by,
            loss=it.loss,
            low=it.low,
            high=it.high,
            limit=it.limit,
            time=times[effect],
            left_out=effect in left,
        )
        for effect, it in found.items()
    ]
    rows += [EffectNeed(title=it.title, verdict="not in the scene") for it in lacking(scene)]
    rows += [
        EffectNeed(title=title, verdict="not shown", shown_by=trials)
        for title, trials in NOT_SHOWN.items()
    ]
    return Needs(tuple(rows), cheapest, merged(*(effect.without for effect in left)))


def _measured(judged: _Judged, effects: Sequence[Effect]) -> tuple[dict[Effect, Need], Json]:
    """Return what leaving out each effect does, and settings without those that do harm.

    Where the pilot lacks an effect, others look superfluous, too: they are measured again without
    the one that does most harm.
    """
    found = dict(zip(effects, judged.without(effects, {}), strict=True))
    against: Json = {}
    doubtful = list(effects)
    while doubtful := [effect for effect in doubtful if found[effect].verdict == "not asked for"]:
        worst = min(doubtful, key=lambda effect: found[effect].loss)
        if found[worst].high >= 0.0:
            break
        against = merged(against, worst.without)
        doubtful.remove(worst)
        found.update(zip(doubtful, judged.without(doubtful, against), strict=True))
    return found, against


def _cheapest(
    judged: _Judged, spare: Sequence[Effect], found: Mapping[Effect, Need], against: Json
) -> tuple[list[Effect], CheapestScene | None]:
    """Return those effects that can be left out together, and the scene without them.

    Args:
        against: settings without the effects that do harm: what these gain hides no loss of others.
    """
    left = _whole(spare)
    while left:
        settings = merged(*(effect.without for effect in left))
        together = Effect("", "", settings)
        (it,) = judged.without([together], against)
        if it.loss <= it.limit:
            before_s, after_s = judged.seconds([{}, settings])
            if after_s > SAVES * before_s:
                break
            (it,) = judged.without([together], {})
            return left, CheapestScene(
                loss=it.loss, low=it.low, high=it.high, seconds=after_s, time=after_s / before_s
            )
        worst = max(left, key=lambda effect: found[effect].loss)
        left = _whole([effect for effect in left if effect is not worst])
    return [], None


def _whole(effects: Sequence[Effect]) -> list[Effect]:
    """Leave out effects that are only left out with others that are not among these."""
    keys = {effect.key for effect in effects}
    return [effect for effect in effects if keys.issuperset(effect.only_with)]


def cheapest_path(twin: Path) -> Path:
    """Return the path of the cheapest scene's file, next to the twin's."""
    return twin.with_name(f"{twin.stem}-cheapest.yaml")


def write_cheapest(twin: Path, needs: Needs) -> None:
    """Write the cheapest scene, if there is one, as a rig file that extends the twin's."""
    path = cheapest_path(twin)
    it = needs.cheapest
    if it is None:
        path.unlink(missing_ok=True)
        return
    left = "".join(f"#   {effect.title}\n" for effect in needs.effects if effect.left_out)
    stated = (
        f"# Written by `sliplab calibrate scene`: {twin.name} without\n{left}"
        f"# A slide takes {it.time:.2f} of the twin's time, {it.seconds:.3g} s of one core; its\n"
        f"# score is worse by {it.loss:.2g} ({it.low:.2g} to {it.high:.2g}) times the twin's "
        "scatter (simulated).\n"
    )
    data = {"extends": twin.name, "name": path.stem.replace("_", "-"), "mock": needs.settings}
    write_text(path, stated + rig_yaml(data))
