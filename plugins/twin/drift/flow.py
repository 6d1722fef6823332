"""`sliplab calibrate drift`: the fit of a scene, repeated over a campaign's reference trials.

A reference is one condition taken again and again. It is simulated in worlds of one specimen, the
rig file's: the same papillae and pixels, so that worlds differ only in what may change while a
campaign is taken, and by chance. Each reference is fitted by itself; a line through the fits says
how fast a parameter changes.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from time import monotonic

import numpy as np

from sliplab.analysis.campaigns import Collected
from sliplab.flows.running import orchestration
from sliplab.plugins.simulation.settings import scene_of
from sliplab.plugins.twin.drift.document import FRICTION, DriftFit, ParameterDrift, ReferenceFit
from sliplab.plugins.twin.drift.estimates import FEWEST, Drift, drifts
from sliplab.plugins.twin.parameters import PARAMETERS, SceneParameter, value_of
from sliplab.plugins.twin.pilot import PilotTrial
from sliplab.plugins.twin.pilots import check_level, read_slide
from sliplab.plugins.twin.statistics import of_names, statistics
from sliplab.plugins.twin.worlds import (
    DrawnWorld,
    Prior,
    Slides,
    guess_of,
    other_rig,
    simulated,
)
from sliplab.protocols import PlannedTrial
from sliplab.protocols.shown import plural
from sliplab.rigs.rig_file import RigFile
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.store import StoreError, TrialStore

MADE = frozenset(
    {
        "scene.friction.papilla_scatter",
        "scene.skin.layer_step_mm",
        "scene.skin.height_scatter_mm",
        "scene.skin.position_scatter_mm",
        "event_camera.threshold_sigma",
        "arm.vibration_hz",
    }
)
"""Properties of the specimen's skin, pixels and arm: they do not change in a campaign."""
STIFFNESSES = frozenset(
    {
        "scene.skin.youngs_modulus_mpa",
        "scene.skin.base_normal_n_per_m",
        "scene.skin.base_tangential_n_per_m",
    }
)
"""Without forces only friction over these is seen."""


@dataclass(frozen=True)
class OneSpecimen(Prior):
    """Worlds around a simulated rig that are the rig's own specimen.

    Attributes:
        with_forces: stiffnesses may change too. Without forces friction and stiffness cannot be
            distinguished: then the stiffnesses are the rig file's, and friction represents both.
    """

    with_forces: bool

    @cached_property
    def parameters(self) -> tuple[SceneParameter, ...]:
        """Parameters that may change along a campaign, if they are switched on in the rig file."""
        left_out = MADE if self.with_forces else MADE | STIFFNESSES
        return tuple(
            it
            for it in PARAMETERS
            if it.key not in left_out and value_of(scene_of(self.rig), it) > 0.0
        )

    def world(self, number: int, slides: Slides) -> DrawnWorld:
        """Return a world: the same specimen, with another error of depth zero."""
        values, rng = self._drawn(number)
        zero_mm = float(rng.uniform(-self.zero_mm, self.zero_mm))
        rig = other_rig(self.rig, values, {}, zero_mm)
        return DrawnWorld(rig, slides, int(rng.integers(2**31)), guess_of(self.rig, self.zero_mm))


@dataclass(frozen=True)
class ReferenceTrials:
    """Labelled reference trials of a campaign in the plan's order, and what they recorded."""

    trials: tuple[PlannedTrial, ...]
    slides: Mapping[str, PilotTrial]
    checksum: str

    @property
    def with_forces(self) -> bool:
        """True where all have forces."""
        return all(slide.forces is not None for slide in self.slides.values())


def read_references(store: TrialStore, item: Collected) -> ReferenceTrials:
    """Read the labelled reference trials of a campaign.

    Raises:
        InputError: the campaign was imported.
        StoreError: it has too few of them, they are no slides, or they are not labelled.
    """
    check_level(item)
    labels = Derived.of(store, "labels", item.name)
    slides, trials, sums = {}, [], hashlib.sha256()
    for trial, recording in item.trials:
        if trial.role != "reference":
            continue
        slide = read_slide(item, labels, trial, recording)
        if slide is None:
            raise StoreError(
                f"{item.name}/{trial.id}: is no straight slide, which drift is fitted to"
            )
        slides[trial.id] = slide
        trials.append(trial)
        sums.update(recording.checksum.encode())
    if len(trials) < FEWEST:
        raise StoreError(
            f"campaign '{item.name}': has {plural(len(trials), 'reference trial')}, and a "
            "trend takes "
            f"{FEWEST}; ask for more by collection.references in its protocol"
        )
    return ReferenceTrials(tuple(trials), slides, sums.hexdigest())


def fit_drift(
    store: TrialStore,
    item: Collected,
    references: ReferenceTrials,
    rig: RigFile,
    worlds: int,
    spread: float,
    seed: int,
) -> tuple[OneSpecimen, list[Drift]]:
    """Fit every reference of a campaign; return the prior, and its parameters' drift in order."""
    guess = guess_of(rig)
    first = references.trials[0]
    prior = OneSpecimen(
        rig, spread, seed, references.with_forces and scene_of(rig).force is not None
    )
    with_events = references.slides[first.id].camera is not None
    slides = Slides(item.plan, (first,), frozenset({first.id} if with_events else ()))
    saved = Derived.of(store, "drift-worlds", item.name)
    bank = prior.bank(simulated("reference (worlds)", prior, slides, worlds, saved))
    observed = [
        of_names(statistics([slide], {slide.trial}, guess).fitted, bank.statistics)
        for slide in references.slides.values()
    ]
    places = np.array([trial.index + 1.0 for trial in references.trials])
    return prior, drifts(bank, np.stack(observed), places)


def calibrate_drift(
    store: TrialStore,
    item: Collected,
    rig: RigFile,
    *,
    worlds: int,
    spread: float,
    seed: int,
    limit_percent: float | None = None,
) -> DriftFit:
    """Fit a campaign's references one by one.

    Args:
        worlds, spread, seed: see `Prior`. limit_percent: largest change of friction.

    Raises:
        InputError: the campaign was imported.
        StoreError: see `read_references`.
    """
    began = monotonic()
    orchestration.configure_prefect(store.folder)
    references = read_references(store, item)
    prior, found = fit_drift(store, item, references, rig, worlds, spread, seed)
    identified = sum(one.identified for one in found)
    parameters = tuple(
        parameter_drift(it, one, references.trials, identified)
        for it, one in zip(prior.parameters, found, strict=True)
    )
    friction = next(it for it in parameters if it.key == FRICTION)
    return DriftFit(
        simulated=bool(item.info.get("simulated")),
        campaign=item.name,
        rig=rig.name,
        checksum=references.checksum,
        condition=item.describe(references.trials[0]),
        worlds=worlds,
        seconds=round(monotonic() - began, 1),
        with_forces=prior.with_forces,
        parameters=parameters,
        limit_percent=limit_percent,
        beyond=limit_percent is not None and beyond(friction, limit_percent),
    )


def parameter_drift(
    it: SceneParameter, found: Drift, trials: Sequence[PlannedTrial], together: int
) -> ParameterDrift:
    """Return the stored result of a parameter's drift.

    Args:
        together: parameters that are looked at; one that is called changed must be so improbable
            that 5 % of campaigns without any change have one.
    """
    line = found.line
    span = trials[-1].index - trials[0].index
    percent = [_percent(100.0 * slope) for slope in (line.slope, line.low, line.high)]
    change = [_percent(span * slope) for slope in (line.slope, line.low, line.high)]
    relative = found.values - line.start
    return ParameterDrift(
        key=it.key,
        title=it.title,
        unit=it.unit,
        identified=found.identified,
        start=float(np.exp(line.start)),
        percent_per_100_trials=percent[0],
        low=percent[1],
        high=percent[2],
        change_percent=change[0],
        change_low=change[1],
        change_high=change[2],
        changed=found.identified and line.p < 0.05 / together,
        references=tuple(
            ReferenceFit(
                trial=trial.id,
                place=trial.index + 1,
                factor=float(np.exp(value)),
                low=float(np.exp(value - 1.96 * error)),
                high=float(np.exp(value + 1.96 * error)),
            )
            for trial, value, error in zip(trials, relative, found.errors, strict=True)
        ),
    )


def beyond(it: ParameterDrift, limit_percent: float) -> bool:
    """Return whether a parameter changed by more than a limit, its whole interval being beyond."""
    return it.identified and (it.change_low > limit_percent or it.change_high < -limit_percent)


def _percent(logarithm: float) -> float:
    return 100.0 * float(np.expm1(logarithm))
