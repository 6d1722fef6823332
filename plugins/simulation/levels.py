"""The physics level that a plan needs in a simulated rig, and the slip to expect from it.

A scene takes the lowest level whose onsets differ from the next level's by less than the onsets of
two seeds differ. This is computed from onsets in closed form (`scene.onsets`), in milliseconds and
without a simulation; `benchmarks.scene_tradeoff` measures the same on windows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from sliplab.plugins.simulation.scene.onsets import Material, slide_onsets
from sliplab.plugins.simulation.scene.randomness import generator
from sliplab.plugins.simulation.settings import MockSettings, scene_of, skin_of
from sliplab.protocols.plan import Plan
from sliplab.protocols.program import Dwell, Move, Program
from sliplab.rigs.physics_levels import LevelChoice, PhysicsLevels, SlipExpected
from sliplab.rigs.rig_file import RigFile

F64 = npt.NDArray[np.float64]

SEEDS = 12
HIGHEST = 3


@dataclass(frozen=True)
class SlideParameters:
    """Parameters that determine the onsets of one slide."""

    depth_mm: float
    speed_mm_s: float
    press_mm_s: float
    settled_s: float


def choose_level(rig: RigFile, plan: Plan) -> LevelChoice:
    """Choose the physics level for a plan on a simulated rig."""
    stated = scene_of(rig).scene.level
    if stated != "auto":
        return LevelChoice(int(stated[1]), "set by the rig file (mock.scene.level)")
    friction = scene_of(rig).scene.friction
    if friction.creep_mm_s > 0.0 or friction.least_mm_s > 0.0:
        return LevelChoice(HIGHEST, "creep and stick-slip are in no lower level")
    slides = slides_of(plan)
    if not slides and plan.protocol.collection.plate is None:
        return LevelChoice(
            HIGHEST,
            "onsets are compared between levels for slides only, so no effect is left out",
        )
    if not slides:
        return LevelChoice(
            HIGHEST,
            "onsets under a falling plate have no closed form at the higher levels, so no effect "
            "is left out",
        )
    return _lowest_level(scene_of(rig), tuple(slides))


@lru_cache(maxsize=16)  # `plan` and `collect` ask again for the same rig and protocol
def _lowest_level(mock: MockSettings, slides: tuple[SlideParameters, ...]) -> LevelChoice:
    """Choose the lowest level that differs from the next one by less than two seeds differ."""
    onsets = {level: expected_onsets(mock, slides, level) for level in (1, 2, 3)}
    seeds = _seeds_differ(mock, slides)
    level, differences = 1, []
    for level in (1, 2):
        difference = np.abs(onsets[level] - onsets[level + 1]).mean(axis=0)
        differences.append((level, difference))
        if np.all(difference < seeds):
            break
    else:
        level = HIGHEST
    last, far = differences[-1]
    against = "stays within" if level == last else "is beyond"
    return LevelChoice(
        level,
        f"L{last} against L{last + 1} moves the first slip by {far[0] * 1e3:.0f} ms and the "
        f"centre's by {far[1] * 1e3:.0f} ms on average, which {against} what two seeds differ "
        f"by, {seeds[0] * 1e3:.0f} and {seeds[1] * 1e3:.0f} ms (simulated)",
    )


def at_level(rig: RigFile, name: str) -> RigFile:
    """Return a simulated rig's file with the scene at the level `name`, such as L2."""
    scene = scene_of(rig).scene.model_copy(update={"level": name})
    return rig.model_copy(update={"mock": scene_of(rig).model_copy(update={"scene": scene})})


def slip_expected(rig: RigFile, plan: Plan) -> SlipExpected | None:
    """Return the range of the first slip and of the duration of incipient slip over all slides.

    Times are from the start of the slide. None for a plan without slides. Closed forms at the
    highest level, with uniform friction and without the markers' thresholds.
    """
    slides = slides_of(plan)
    if not slides:
        return None
    onsets = expected_onsets(scene_of(rig), slides, HIGHEST)
    incipient = onsets[:, 1] - onsets[:, 0]
    return {
        "simulated": True,
        "first_slip_s": [float(onsets[:, 0].min()), float(onsets[:, 0].max())],
        "incipient_s": [float(incipient.min()), float(incipient.max())],
    }


def slides_of(plan: Plan) -> list[SlideParameters]:
    """Return the distinct slides of a plan, in order of first appearance."""
    found: dict[SlideParameters, None] = {}
    for trial in plan:
        slide = _slide(plan.program(trial))
        if slide is not None:
            found.setdefault(slide)
    return list(found)


def _slide(program: Program) -> SlideParameters | None:
    depth, press, settled = 0.0, 1.0, 0.0
    for step in program.steps:
        if isinstance(step, Move) and step.phase == "press":
            depth, press, settled = step.to.depth_mm, step.speed_mm_s, 0.0
        elif isinstance(step, Dwell):
            settled += step.seconds
        elif isinstance(step, Move) and step.phase == "slide":
            return SlideParameters(depth, step.speed_mm_s, press, settled)
    return None


def expected_onsets(
    mock: MockSettings, slides: Sequence[SlideParameters], level: int, grip: F64 | None = None
) -> F64:
    """Return the first slip and the slip of the centre, s after the start of a slide, (k, 2)."""
    scene = mock.scene
    skin = skin_of(mock)
    material = Material(
        scene.friction.kinetic,
        scene.friction.static_excess,
        scene.skin.relaxation_share,
        scene.skin.relaxation_s,
    )
    onsets = slide_onsets(
        skin,
        material,
        level,
        [slide.depth_mm for slide in slides],
        [slide.speed_mm_s for slide in slides],
        [slide.press_mm_s for slide in slides],
        [slide.settled_s for slide in slides],
        grip,
    )
    return np.stack([onsets.min(axis=-1), onsets[..., 0]], axis=-1)


def _seeds_differ(mock: MockSettings, slides: Sequence[SlideParameters]) -> F64:
    """Mean difference of both onsets between two seeds, whose friction at the tips varies."""
    variation, count = mock.scene.friction.path_variation, sum(mock.scene.skin.ring_counts)
    onsets = []
    for seed in range(SEEDS):
        spread = np.clip(generator(seed, "level choice").standard_normal(count), -3.0, 3.0)
        onsets.append(expected_onsets(mock, slides, HIGHEST, 1.0 + variation * spread))
    values = np.array(onsets)  # (seeds, slides, 2)
    differences = np.abs(values[:, None] - values[None]).sum(axis=(0, 1)) / (SEEDS * (SEEDS - 1))
    result: F64 = differences.mean(axis=0)
    return result


def _stated(rig: RigFile) -> str:
    return scene_of(rig).scene.level


def physics_levels() -> PhysicsLevels:
    """Return what the drivers of simulated rigs declare."""
    return PhysicsLevels(choose_level, at_level, _stated, slip_expected)
