"""Worlds around a simulated rig: other parameters, another skin, the same slides taken again."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from threadpoolctl import threadpool_limits

from sliplab.flows.running import console, orchestration
from sliplab.plugins.simulation.devices import build_mock
from sliplab.plugins.simulation.rig import simulated_rig
from sliplab.plugins.simulation.scene_runs import changed
from sliplab.plugins.simulation.settings import scene_of
from sliplab.plugins.twin.contact_springs import Guess
from sliplab.plugins.twin.parameters import (
    PARAMETERS,
    SceneParameter,
    drawn,
    prior_bounds,
    settings_of,
    value_of,
)
from sliplab.plugins.twin.pilot import PilotTrial
from sliplab.plugins.twin.pilots import LEVEL, ZEROS_MM, simulate_pilot
from sliplab.plugins.twin.posterior import Bank
from sliplab.plugins.twin.statistics import VERSION, SlideStatistics, of_names, statistics
from sliplab.protocols import Plan, PlannedTrial
from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.core.surface_search import touch_off
from sliplab.rigs.rig_file import RigFile
from sliplab.storage.streams import F64
from sliplab.storage.trials.derived import Derived, make_key

T = TypeVar("T")
TOUCH_MM_S, TOUCH_SEARCH_MM, TOUCHES = 0.5, 1.5, 16
"""As the shipped protocols touch off, and how often here."""
ZERO_MM = ZEROS_MM[-1]
"""Largest error of depth zero by one touch: touching off finds the plate only so exactly."""


@dataclass(frozen=True)
class Slides:
    """Trials that are taken in every world.

    Attributes:
        with_events: ids of those whose events are simulated and read.
    """

    plan: Plan
    trials: tuple[PlannedTrial, ...]
    with_events: frozenset[str]


@dataclass(frozen=True)
class DrawnWorld:
    """A simulated rig on which slides are taken again.

    Attributes:
        seed: of the trials' chance. guess: where estimates begin; of the rig that is fitted.
        with_faults: keep the rig's faults.
    """

    rig: RigFile
    slides: Slides
    seed: int
    guess: Guess
    with_faults: bool = False

    def take(self) -> list[PilotTrial]:
        """Take the trials, in their order."""
        found = {}
        for with_events in (True, False):
            trials = [
                trial
                for trial in self.slides.trials
                if (trial.id in self.slides.with_events) == with_events
            ]
            for slide in simulate_pilot(
                self.rig, self.slides.plan, trials, self.seed, with_events, self.with_faults
            ):
                found[slide.trial] = slide
        return [found[trial.id] for trial in self.slides.trials]

    def statistics(self) -> SlideStatistics:
        """Take the trials and return what they show."""
        # the matrices are too small for threads of their own
        with threadpool_limits(1):
            return statistics(self.take(), self.slides.with_events, self.guess)


def other_rig(
    rig: RigFile, values: Mapping[str, float], skin: Mapping[str, Any], zero_mm: float = 0.0
) -> RigFile:
    """Return a simulated rig with other parameters and another skin.

    Args:
        values: by the keys of `PARAMETERS`. skin: settings of it, in addition to those in `values`.
        zero_mm: error of depth zero.
    """
    settings = settings_of(scene_of(rig), values)
    scene = settings.setdefault("scene", {})
    scene["level"] = LEVEL
    scene["skin"] = {**scene.get("skin", {}), **skin}
    scene["contact"] = {"offset_mm": scene_of(rig).scene.contact.offset_mm + zero_mm}
    return changed(rig, settings)


def other_specimen(rig: RigFile, values: Mapping[str, float], seed: int, zero_mm: float) -> RigFile:
    """Return another specimen of a simulated rig: its skin, pixels and tremor are drawn again.

    Args:
        values, zero_mm: as for `other_rig`.
    """
    made = other_rig(rig, values, {"seed": None, "papillae": None}, zero_mm)
    return changed(made, {"seed": seed})


def touch_depth_mm(rig: RigFile) -> float:
    """Return how deep the skin of a simulated rig is when touching off detects it, mm.

    A lab measures it with a gauge; here the surface is known. It depends on camera and skin. Where
    few pixels see the first contact, single touches differ by a tenth of a millimetre: the mean of
    several leaves no common error to the depths of a campaign.

    Raises:
        RigError: no touch is detected at all.
    """
    devices = build_mock(scene_of(rig), rig.timing)
    made = simulated_rig(rig, devices)
    try:
        made.connect()
        surface = devices.world.plane.pose(0.0, 0.0, 0.0).xyz_mm
        taught = made.plate_frame.with_zero(0.0).position(surface).depth_mm
        found = [touch_off(made, TOUCH_MM_S, TOUCH_SEARCH_MM, seed) for seed in range(TOUCHES)]
    finally:
        made.close()
    # by noise the mean may come before the surface; no skin is noticed there
    return max(float(np.mean(found)) + made.touch_mm - taught, 0.0)


def touch_section(rig: RigFile) -> dict[str, Any]:
    """Return the section of a rig file that depends on skin and camera: where a touch is seen."""
    try:
        return {"calibration": {"touch_depth": f"{touch_depth_mm(rig):.3f} mm"}}
    except RigError as error:
        console.say(f"warning: touching off does not work on {rig.name}: {error}")
        return {}


def guess_of(rig: RigFile, zero_mm: float = ZERO_MM) -> Guess:
    """Return the design of a rig's skin, and what it assumes of it.

    Args:
        zero_mm: largest error of depth zero.
    """
    skin, friction = scene_of(rig).scene.skin, scene_of(rig).scene.friction
    rigid = 1e9
    return Guess(
        height_mm=skin.heights_mm[0],
        radius_mm=skin.radius_mm,
        bending=skin.bending,
        poisson_ratio=skin.poisson_ratio,
        kinetic=friction.kinetic,
        youngs_modulus_mpa=skin.youngs_modulus_mpa,
        base_normal_n_per_m=skin.base_normal_n_per_m or rigid,
        base_tangential_n_per_m=skin.base_tangential_n_per_m or rigid,
        layer_step_mm=(skin.heights_mm[0] - skin.heights_mm[-1]) / max(len(skin.heights_mm) - 1, 1),
        zero_mm=zero_mm,
    )


@dataclass(frozen=True)
class Prior:
    """Worlds around a simulated rig's own values, uniform in their logarithms.

    Attributes:
        spread: largest factor less 1, either way: 0.5 is from 1/1.5 to 1.5 times the value.
        seed: of the worlds. The world with a number is the same however many are drawn.
        zero_mm: largest error of depth zero.
    """

    rig: RigFile
    spread: float
    seed: int
    zero_mm: float = field(default=ZERO_MM, kw_only=True)

    @cached_property
    def parameters(self) -> tuple[SceneParameter, ...]:
        """Parameters that are switched on in the rig file."""
        return tuple(it for it in PARAMETERS if value_of(scene_of(self.rig), it) > 0.0)

    @property
    def bounds(self) -> tuple[F64, F64]:
        """Least and largest logarithm of each parameter, (p,)."""
        return prior_bounds(scene_of(self.rig), self.parameters, self.spread)

    def values(self, number: int) -> dict[str, float]:
        """Return a world's parameters by key."""
        return self._drawn(number)[0]

    def world(self, number: int, slides: Slides) -> DrawnWorld:
        """Return a world, with another skin and another error of depth zero."""
        values, rng = self._drawn(number)
        zero_mm = float(rng.uniform(-self.zero_mm, self.zero_mm))
        specimen, chance = (int(n) for n in rng.integers(2**31, size=2))
        rig = other_specimen(self.rig, values, specimen, zero_mm)
        return DrawnWorld(rig, slides, chance, guess_of(self.rig, self.zero_mm))

    def _drawn(self, number: int) -> tuple[dict[str, float], np.random.Generator]:
        rng = np.random.default_rng([self.seed, number])
        return drawn(scene_of(self.rig), self.parameters, self.spread, rng), rng

    def bank(self, seen: Sequence[SlideStatistics]) -> Bank:
        """Return the first worlds and what they show as a bank."""
        names = tuple(dict.fromkeys(name for one in seen for name in one.fitted))
        keys = tuple(it.key for it in self.parameters)
        rows = [self.values(number) for number in range(len(seen))]
        theta = np.log([[row[key] for key in keys] for row in rows])
        return Bank(
            keys,
            names,
            theta,
            np.stack([of_names(one.fitted, names) for one in seen]),
            *self.bounds,
        )


def simulated(
    title: str, prior: Prior, slides: Slides, worlds: int, saved: Derived
) -> list[SlideStatistics]:
    """Return what the prior's first worlds show of the slides.

    Simulated worlds are stored: a stopped run resumes, and other trials of the same conditions on
    the same rig are compared with the same worlds.

    Args:
        title: of the progress bar.
    """
    rig = prior.rig.model_dump(mode="json", exclude={"name", "twin"})
    wanted = [rig, slides.plan.collection_hash, sorted(trial.id for trial in slides.trials)]
    # what is drawn depends on the kind of prior, too
    drawn_by = [
        type(prior).__name__,
        [it.key for it in prior.parameters],
        prior.spread,
        prior.seed,
        prior.zero_mm,
    ]
    key = make_key("scene worlds", VERSION, wanted, [sorted(slides.with_events), *drawn_by])
    name = f"worlds-{key[:16]}"
    found = _read(saved, name) if saved.fresh(name, key) else {}
    missing = [number for number in range(worlds) if number not in found]

    def keep(job: int, one: SlideStatistics) -> None:
        found[missing[job]] = one

    try:
        everywhere(title, DrawnWorld.statistics, [prior.world(k, slides) for k in missing], keep)
    finally:
        if missing and found:
            _write(saved, name, key, found)
    return [found[number] for number in range(worlds)]


def _read(saved: Derived, name: str) -> dict[int, SlideStatistics]:
    arrays = saved.arrays(name)
    fitted, effects = (
        [dict(zip(arrays[f"{part}_names"].tolist(), row, strict=True)) for row in arrays[part]]
        for part in ("fitted", "effects")
    )
    return {
        int(number): SlideStatistics(*both)
        for number, *both in zip(arrays["worlds"], fitted, effects, strict=True)
    }


def _write(saved: Derived, name: str, key: str, found: Mapping[int, SlideStatistics]) -> None:
    arrays: dict[str, Any] = {"worlds": np.array(sorted(found))}
    for part in ("fitted", "effects"):
        rows: list[dict[str, float]] = [getattr(found[k], part) for k in sorted(found)]
        names = list(dict.fromkeys(key for row in rows for key in row))
        arrays[f"{part}_names"] = np.array(names)
        arrays[part] = np.array([[row.get(name, np.nan) for name in names] for row in rows])
    saved.write(name, key, {"worlds": len(found)}, arrays)


def everywhere(
    title: str,
    work: Callable[[DrawnWorld], T],
    worlds: Sequence[DrawnWorld],
    done: Callable[[int, T], None] | None = None,
) -> list[T]:
    """Return `work` of every world, done on all cores.

    Args:
        title: of the progress bar.
        done: called with a world's place and what came of it, in any order.
    """
    from sliplab.flows.running.parallel_map import parallel_map_flow

    found: dict[int, T] = {}
    if not worlds:
        return []
    with console.bar(title, len(worlds)) as bar:

        def keep(number: int, result: T) -> None:
            found[number] = result
            if done is not None:
                done(number, result)
            bar.advance()

        orchestration.run(parallel_map_flow, title, work, worlds, keep)
    return [found[number] for number in range(len(worlds))]
