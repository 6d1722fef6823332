"""Scenes of the bench, version 2. Frozen: any change here requires a new version.

Worlds are simulated rigs around the shipped rig `rehearsal`, their parameters drawn uniformly in
their logarithms. Those of training and validation have seeds that everybody knows; those of tests
are drawn by the seed that the user gives.
"""

from __future__ import annotations

from dataclasses import dataclass

VERSION = 2
SEEDS = 2**53
"""Seeds of test worlds are below; so many that a detector cannot try all while it is judged."""


@dataclass(frozen=True)
class Span:
    """Range of a motion's number, uniform; `logarithmic`: in its logarithm."""

    low: float
    high: float
    logarithmic: bool = False


@dataclass(frozen=True)
class ScenePart:
    """Scenes of one part.

    Attributes:
        worlds: simulated rigs. slides: in each of them.
        holds: scenes with a long hold, each in a world of its own.
    """

    worlds: int
    slides: int
    holds: int


@dataclass(frozen=True)
class Size:
    """A set of scenes.

    Attributes:
        nuisance: scenes of each nuisance, each in a world of its own.
    """

    train: ScenePart
    validation: ScenePart
    test: ScenePart
    nuisance: int


@dataclass(frozen=True)
class Definition:
    """Distributions that the scenes are drawn from.

    Attributes:
        spread: of the worlds' parameters: the largest factor less 1, either way.
        train_seed, validation_seed: of worlds and motions.
        beyond_mm: depth of the press beyond that at which the lowest papillae touch: one that does
            not touch would move from the first moment on, which is no slip.
        hold_s: before a slide. long_hold_s: of scenes for false alarms.
        nuisance_hold_s: of scenes with a nuisance.
    """

    rig: str = "rehearsal"
    spread: float = 0.3
    train_seed: int = 101
    validation_seed: int = 102
    beyond_mm: Span = Span(0.4, 1.1)
    speed_mm_s: Span = Span(0.6, 1.6, True)
    direction_deg: Span = Span(0.0, 360.0)
    distance_mm: float = 12.0
    hold_s: Span = Span(1.0, 8.0, True)
    long_hold_s: Span = Span(100.0, 140.0)
    nuisance_hold_s: Span = Span(15.0, 25.0)


DEFINITION = Definition()
FRICTION, SCENE, CONTACT = ("scene", "friction"), ("scene",), ("scene", "contact")
EFFECTS: dict[str, dict[tuple[str, ...], Span | int]] = {
    "creep": {
        (*FRICTION, "creep_mm_s"): Span(0.05, 0.5, True),
        (*FRICTION, "creep_share"): Span(0.02, 0.1, True),
    },
    "stick-slip": {
        (*FRICTION, "static_excess"): Span(0.05, 0.3, True),
        (*FRICTION, "least_mm_s"): Span(0.5, 4.0, True),
        (*SCENE, "step_ms"): 1,  # markers move on cubics through the rows: a jump blurs over three
    },
    "texture": {
        (*FRICTION, "path_variation"): Span(0.05, 0.2, True),
        (*FRICTION, "correlation_mm"): Span(0.2, 2.0, True),
    },
    "curved": {
        (*SCENE, "plate_radius_mm"): Span(600.0, 4000.0, True),
        (*CONTACT, "tilt_deg"): Span(0.2, 1.0, True),
        (*CONTACT, "tilt_axis_deg"): Span(0.0, 360.0),
    },
}
"""Harder worlds: keys of the simulated rig that an effect draws, in every world."""
WORLDS = {"usual": (), **{name: (name,) for name in EFFECTS}, "hard": tuple(EFFECTS)}
"""Effects of each set of worlds. Those of `usual` are version 2 to the bit."""
SIZES = {
    "full": Size(ScenePart(16, 9, 0), ScenePart(12, 8, 120), ScenePart(16, 12, 30), 4),
    "small": Size(ScenePart(4, 4, 0), ScenePart(4, 4, 2), ScenePart(6, 4, 2), 1),
}
