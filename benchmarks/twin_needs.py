"""Which effects are asked for by pilots that have them, and by pilots that lack them.

    python -m benchmarks.twin_needs [--pilots 8] [--only relaxation,vibration] [--seed 1]

The twin is the rig for rehearsals. Its worlds, and the pilots, have parameters drawn 2 % (standard
deviation) around its own, as a fit leaves them; a pilot has other pixels, and its skin is the
twin's, whose papillae were measured to 10 um, 5 um aside and 1 % of friction. A pilot is the test
trials of `protocols/pilot.yaml`. Of each effect there are pilots with it, and pilots without it.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from sliplab.plugins.simulation.scene_runs import changed
from sliplab.plugins.simulation.settings import Papilla, scene_of, skin_of
from sliplab.plugins.twin.effects import Effect, effects_of
from sliplab.plugins.twin.needs.flow import WORLDS
from sliplab.plugins.twin.needs.judging import Marked, Need, marked, marks, need
from sliplab.plugins.twin.parameters import PARAMETERS, value_of
from sliplab.plugins.twin.worlds import DrawnWorld, Slides, guess_of, other_rig
from sliplab.protocols.plan import load_plan
from sliplab.rigs.rig_file import RigFile, load_rig_file
from sliplab.rigs.rig_inheritance import shipped_rigs
from sliplab.storage.streams import Json

ROOT = Path(__file__).parents[1]
LEFT_OPEN = 0.02
HEIGHT_MM, PLACE_MM, FRICTION = 0.01, 0.005, 0.01
GROUPS = frozenset(
    {"slips", "motion", "events over time", "places of events", "events at rest", "times of events"}
)


def slides() -> Slides:
    """Return the pilot's test trials."""
    plan = load_plan(ROOT / "protocols/pilot.yaml")
    trials = tuple(trial for trial in plan.trials if trial.split == "test")
    return Slides(plan, trials, frozenset(trial.id for trial in trials))


def papillae(rig: RigFile, rng: np.random.Generator | None) -> tuple[Papilla, ...]:
    """Return a rig's papillae as they are, or as somebody measured them."""
    skin, design = skin_of(scene_of(rig)), np.array(rig.skin.layout_mm())
    error = np.zeros((len(skin), 4)) if rng is None else rng.standard_normal((len(skin), 4))
    aside = skin.layout_mm - design + PLACE_MM * error[:, 2:]
    return tuple(
        Papilla(
            height_mm=float(skin.height_mm[k] + HEIGHT_MM * error[k, 0]),
            friction=float(skin.friction_factor[k] * (1.0 + FRICTION * error[k, 1])),
            offset_mm=(float(aside[k, 0]), float(aside[k, 1])),
        )
        for k in range(len(skin))
    )


def rigs(
    rig: RigFile, skin: Sequence[Papilla], count: int, rng: np.random.Generator, *, pixels: bool
) -> list[RigFile]:
    """Return rigs around one, with a skin.

    Args:
        pixels: of their own.
    """
    found = []
    for _ in range(count):
        values = {}
        for it in PARAMETERS:
            own = value_of(scene_of(rig), it)
            if own > 0.0:
                factor = float(np.exp(LEFT_OPEN * rng.standard_normal()))
                values[it.key] = min(own * factor, it.most)
        made = other_rig(rig, values, {"papillae": tuple(skin)})
        found.append(changed(made, {"seed": int(rng.integers(2**31))}) if pixels else made)
    return found


def shown(worlds: Sequence[DrawnWorld], settings: Json) -> Marked:
    """Return what worlds show under other settings."""
    taken = [
        [marks(trial) for trial in replace(one, rig=changed(one.rig, settings)).take()]
        for one in worlds
    ]
    return marked(taken, GROUPS)


def needs_of(pilots: Marked, having: Marked, without: Marked) -> list[Need]:
    """Return what each of some pilots says of an effect."""
    return [need(Marked(one[None], pilots.groups), having, without) for one in pilots.values]


def line(effect: Effect, present: Sequence[Need], absent: Sequence[Need]) -> str:
    """Return an effect's row of the table."""
    calls = [sum(it.verdict == "asked for" for it in of) for of in (present, absent)]
    shows = sum(it.verdict != "not shown" for it in present)
    losses = [float(np.median([it.loss for it in of])) for of in (present, absent)]
    return (
        f"| {effect.title} | {calls[0]} of {len(present)} | {calls[1]} of {len(absent)} | "
        f"{losses[0]:.3g} | {losses[1]:.3g} | {present[0].limit:.3g} | {present[0].shown_by} | "
        f"{shows} |"
    )


def main() -> None:
    """Print a table of the effects."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pilots", type=int, default=8, help="with each effect, and without")
    parser.add_argument("--only", default="", help="keys of effects, with commas")
    parser.add_argument("--seed", type=int, default=1)
    wanted = parser.parse_args()
    own, _ = load_rig_file(shipped_rigs()["rehearsal"])
    rig, trials = other_rig(own, {}, {}), slides()
    rng = np.random.default_rng(wanted.seed)
    worlds, pilots = (
        [DrawnWorld(one, trials, int(rng.integers(2**31)), guess_of(own)) for one in of]
        for of in (
            rigs(rig, papillae(rig, rng), WORLDS, rng, pixels=False),
            rigs(rig, papillae(rig, None), wanted.pilots, rng, pixels=True),
        )
    )
    print(
        "| effect | asked for by pilots with it | without it | loss | loss | chance | shown by | "
        "can tell |"
    )
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    both = shown(worlds, {}), shown(pilots, {})
    keys = [key for key in wanted.only.split(",") if key]
    for effect in effects_of(scene_of(rig)):
        if keys and effect.key not in keys:
            continue
        beside = effect.beside
        having, present = (shown(worlds, beside), shown(pilots, beside)) if beside else both
        without, absent = shown(worlds, effect.without), shown(pilots, effect.without)
        found = [needs_of(of, having, without) for of in (present, absent)]
        print(line(effect, *found), flush=True)


if __name__ == "__main__":
    main()
