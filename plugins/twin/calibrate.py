"""`sliplab calibrate scene`: fit a simulated rig's scene to the slides of a pilot.

What the pilot shows is reduced to a few dozen statistics. The same pilot is then simulated in many
worlds, whose parameters are drawn round the rig file's, and the statistics of these worlds say
which parameters lead to those of the pilot. Test trials are not fitted: they judge the result.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import date
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np

from sliplab.analysis.campaigns import Collected
from sliplab.flows.running import console, orchestration
from sliplab.plugins.simulation.scene_runs import changed
from sliplab.plugins.simulation.settings import Papilla, scene_of
from sliplab.plugins.twin.contact_estimates import NOT_LOGGED, papillae, read_contact
from sliplab.plugins.twin.contact_slips import find_slips
from sliplab.plugins.twin.document import (
    MisfitCheck,
    ParameterFit,
    StatisticSeen,
    TwinFit,
)
from sliplab.plugins.twin.drawn_rigs import samples_file, write_samples
from sliplab.plugins.twin.misfits import misfits
from sliplab.plugins.twin.needs.flow import Needs, cheapest_path, measure_needs, write_cheapest
from sliplab.plugins.twin.needs.judging import Marks, marks
from sliplab.plugins.twin.parameters import GAIN_SLOPES, settings_of, value_of
from sliplab.plugins.twin.pilots import LEVEL, ZEROS_MM, PilotSlides, read_pilot
from sliplab.plugins.twin.posterior import Bank, Posterior, posterior, widened
from sliplab.plugins.twin.shown import SameTrials, SlideCurves, compare, show
from sliplab.plugins.twin.statistics import SlideStatistics, of_names
from sliplab.plugins.twin.worlds import (
    DrawnWorld,
    Prior,
    Slides,
    everywhere,
    guess_of,
    other_rig,
    simulated,
    touch_section,
)
from sliplab.protocols.errors import InputError
from sliplab.rigs.rig_file import RigFile, load_rig_file
from sliplab.rigs.rig_inheritance import rig_path, rig_yaml, shipped_rigs
from sliplab.rigs.twin import ConditionRange, FittedValue, TwinRecord
from sliplab.storage.files import make_folder, write_text
from sliplab.storage.streams import F64
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.store import TrialStore

LIKE = 1.25
"""Noise of tracking that differs by less than this factor from the rig file's is the rig file's."""
GAIN_ERROR = 0.15
"""Largest error of a force sensor's gain, a share, where it was not checked with known weights."""
PREDICTED = 12
"""Worlds of the twin in which the test trials are taken."""


@dataclass(frozen=True)
class FitRequest:
    """Request of a fit, checked.

    Attributes:
        prior: worlds around the simulated rig to start from. rig_path: the rig's file.
        out: rig file to write. worlds: to simulate.
        needs: whether to measure what the scene needs, which no parameter depends on.
        gain_error: largest error of the force sensor's gain, a share.
    """

    prior: Prior
    rig_path: Path
    out: Path
    worlds: int
    needs: bool = True
    gain_error: float = GAIN_ERROR

    @property
    def rig(self) -> RigFile:
        """The simulated rig to start from."""
        return self.prior.rig


def request(
    rig_path: Path,
    out: Path,
    worlds: int,
    spread: float,
    seed: int,
    gain_error: float = GAIN_ERROR,
) -> FitRequest:
    """Check a request before anything is simulated.

    Raises:
        InputError: the rig is not a simulated one in virtual time, or the new file cannot be made.
    """
    rig = fitted_rig(rig_path)
    if out.suffix.lower() not in {".yaml", ".yml"}:
        raise InputError("--out", "", str(out), "must end in .yaml")
    if not out.parent.is_dir():
        raise InputError("--out", "", str(out), "its folder does not exist")
    if out.resolve() == rig_path.resolve():
        raise InputError("--out", "", str(out), "is the rig file that is fitted; name another file")
    for path in (out, cheapest_path(out)):
        if path.exists() and load_rig_file(path)[0].twin is None:
            raise InputError("--out", "", str(path), "exists and is no twin: use another name")
    return FitRequest(Prior(rig, spread, seed), rig_path, out, worlds, gain_error=gain_error)


def fitted_rig(rig_path: Path) -> RigFile:
    """Read the rig file of a scene to fit.

    Raises:
        InputError: the rig is not a simulated one in virtual time.
    """
    rig, _ = load_rig_file(rig_path)
    if not rig.in_virtual_time:
        raise InputError(
            "--rig",
            "",
            str(rig_path),
            "must be a simulated rig with driver: mock, whose scene is fitted; such as rehearsal, "
            "or a file that extends it with your skin and cameras",
        )
    return rig


@dataclass(frozen=True)
class SceneFit:
    """A pilot, the worlds that it was compared with, and the fitted scene.

    Attributes:
        observed: what the pilot shows. seen: what each world shows. bank: of these worlds.
        found: posterior of the prior's parameters.
        skin: settings of the twin's skin, in addition to those among the parameters.
    """

    prior: Prior
    pilot: PilotSlides
    observed: SlideStatistics
    seen: Sequence[SlideStatistics]
    bank: Bank
    found: Posterior
    skin: Mapping[str, Any]

    @property
    def values(self) -> dict[str, float]:
        """The identified parameters' medians, by key."""
        return {
            it.parameter: float(np.exp(it.median)) for it in self.found.estimates if it.identified
        }

    def drawn(self, rng: np.random.Generator, count: int) -> list[dict[str, float]]:
        """Draw the identified parameters within what the pilot leaves open."""
        rows = rng.choice(len(self.found.samples), count, replace=False)
        return [
            {
                it.parameter: float(np.exp(self.found.samples[row, k]))
                for k, it in enumerate(self.found.estimates)
                if it.identified
            }
            for row in rows
        ]


def with_tracking_noise(rig: RigFile, pilot: PilotSlides) -> RigFile:
    """Return the rig with the noise of marker places that the pilot's holds show.

    It is measured, not fitted: a marker that sticks moves by nothing else.
    """
    slips = find_slips([pilot.slides[trial.id] for trial in pilot.fitted])
    camera = scene_of(rig).frame_camera
    if slips is None:
        return rig
    noise_px = float(np.median(slips.noise_mm)) * camera.px_per_mm
    if camera.centroid_noise_px / LIKE < noise_px < camera.centroid_noise_px * LIKE:
        return rig
    return changed(rig, {"frame_camera": {"centroid_noise_px": float(f"{noise_px:.2g}")}})


def fit_scene(store: TrialStore, pilot: PilotSlides, prior: Prior, worlds: int) -> SceneFit:
    """Compare a pilot with simulated worlds."""
    prior = replace(prior, rig=with_tracking_noise(prior.rig, pilot), zero_mm=pilot.zero_mm)
    observed = pilot.statistics(guess_of(prior.rig, prior.zero_mm))
    slides = Slides(pilot.plan, pilot.fitted, pilot.with_events)
    saved = Derived.of(store, "scene-worlds")
    seen = simulated("pilot's trials (worlds)", prior, slides, worlds, saved)
    bank = prior.bank(seen)
    found = posterior(bank, of_names(observed.fitted, bank.statistics))
    made = measured_papillae(prior.rig, pilot)
    skin = {} if made is None else {"papillae": made}
    return SceneFit(prior, pilot, observed, seen, bank, found, skin)


def calibrate_scene(
    store: TrialStore, item: Collected, wanted: FitRequest
) -> tuple[TwinFit, SameTrials]:
    """Fit a rig's scene to a campaign's slides, and write the twin's rig file.

    Raises:
        StoreError: the campaign has no slides, or they are not labelled.
    """
    began = monotonic()
    orchestration.configure_prefect(store.folder)
    pilot = read_pilot(store, item)
    if pilot.zero_mm == ZEROS_MM[-1]:
        console.say(
            f"hint: depth zero of '{item.name}' is known to {pilot.zero_mm:g} mm, by single or "
            "scattered touches; a pilot with touches: 8 in maintenance.rezero is more exact"
        )
    scene = fit_scene(store, pilot, wanted.prior, wanted.worlds)
    worlds = judging_worlds(scene)
    judged = [pilot.slides[trial.id] for trial in pilot.judged]
    twin, before = predict(worlds)
    trials = SameTrials(
        [show(slide) for slide in judged],
        [one.shown for one in twin],
        [one.shown for one in before],
        ring_of(wanted.rig),
        pilot.streams,
    )
    needs = Needs()
    if wanted.needs:
        needs = measure_needs(judged, worlds[: len(twin)], [one.marks for one in twin])
    checks = misfits(
        scene.observed.effects,
        [one.effects for one in scene.seen],
        scene.bank.statistics,
        of_names(scene.observed.fitted, scene.bank.statistics),
        scene.bank.s,
    )
    gain_error = wanted.gain_error if "force" in pilot.streams else None
    fit = TwinFit(
        simulated=bool(item.info.get("simulated")),
        campaign=item.name,
        rig=wanted.rig.name,
        checksum=pilot.checksum,
        trials=len(pilot.fitted),
        judged=len(pilot.judged),
        worlds=len(scene.bank),
        predicted=len(twin),
        seconds=round(monotonic() - began, 1),
        parameters=parameter_fits(scene, wanted.rig, gain_error or 0.0, checks),
        statistics=seen_statistics(scene),
        checks=checks,
        compared=compare(trials),
        needs=needs.effects,
        cheapest=needs.cheapest,
        gain_error=gain_error,
    )
    record = TwinRecord(
        campaign=fit.campaign,
        checksum=fit.checksum,
        trials=fit.trials,
        simulated=fit.simulated,
        fitted=date.today(),
        method=f"regression on {fit.worlds} simulated worlds",
        depth_mm=_range([pilot.slides[t.id].slide.depth_mm for t in pilot.fitted]),
        speed_mm_s=_range([pilot.slides[t.id].slide.speed_mm_s for t in pilot.fitted]),
        parameters={
            it.key: FittedValue(
                value=it.value, low=it.low, high=it.high, unit=it.unit, identified=it.identified
            )
            for it in fit.parameters
        },
        misfits=tuple(f"{it.stream}: {it.title}" for it in fit.misfits),
        needs={it.title: it.verdict for it in fit.needs},
    )
    write_twin(wanted, scene, record)
    write_samples(samples_file(wanted.out), scene.found)
    write_cheapest(wanted.out, needs)
    return fit, trials


def measured_papillae(rig: RigFile, pilot: PilotSlides) -> tuple[Papilla, ...] | None:
    """Return the papillae as the pilot shows them, for `mock.scene.skin`; None if it does not."""
    contact = read_contact(
        [pilot.slides[trial.id] for trial in pilot.fitted], guess_of(rig, pilot.zero_mm)
    )
    found = None if contact is None else papillae(contact)
    design = np.array(rig.skin.layout_mm())
    if found is None or len(found.gap_mm) != len(design):
        return None
    place = found.place_mm - np.median(found.place_mm - design, axis=0)
    height = scene_of(rig).scene.skin.heights_mm[0] - found.gap_mm
    if not np.isfinite([*height, *found.friction, *place.ravel()]).all():
        return None
    return tuple(
        Papilla(
            height_mm=round(float(height[k]), 4),
            friction=round(float(found.friction[k]), 4),
            offset_mm=tuple(np.round(place[k] - design[k], 4).tolist()),
        )
        for k in range(len(design))
    )


def judging_worlds(scene: SceneFit) -> list[DrawnWorld]:
    """Return worlds of the twin, and as many of the rig file as it was, with the test trials.

    Worlds of the twin differ in what the pilot leaves open of the identified parameters.
    """
    pilot, rig = scene.pilot, scene.prior.rig
    if not pilot.judged:
        return []
    rng = np.random.default_rng([scene.prior.seed, 3])
    slides = Slides(pilot.plan, pilot.judged, frozenset(trial.id for trial in pilot.judged))
    values = scene.drawn(rng, PREDICTED)
    chance = [int(n) for n in rng.integers(2**31, size=PREDICTED)]
    rigs = [other_rig(rig, one, scene.skin) for one in values]
    rigs += [other_rig(rig, {}, {})] * PREDICTED
    return [
        DrawnWorld(one, slides, seed, guess_of(rig, scene.prior.zero_mm))
        for one, seed in zip(rigs, chance * 2, strict=True)
    ]


@dataclass(frozen=True)
class Predicted:
    """The test trials in a world: their compared quantities, and their numbers for scores."""

    shown: list[SlideCurves]
    marks: list[Marks]


def predicted_in(world: DrawnWorld) -> Predicted:
    """Take the test trials in a world."""
    slides = world.take()
    return Predicted([show(slide) for slide in slides], [marks(slide) for slide in slides])


def predict(worlds: Sequence[DrawnWorld]) -> tuple[list[Predicted], list[Predicted]]:
    """Take the test trials in worlds of the twin and in as many of the rig file as it was."""
    taken, half = everywhere("test trials (worlds)", predicted_in, worlds), len(worlds) // 2
    return taken[:half], taken[half:]


def parameter_fits(
    scene: SceneFit, rig: RigFile, gain_error: float, checks: Sequence[MisfitCheck]
) -> tuple[ParameterFit, ...]:
    """Return the stored results of the parameters' posterior; no interval under a misfit.

    Args:
        rig: with the assumed values. gain_error: largest error of the force sensor's gain.
    """
    known = scene.prior.parameters
    slopes = np.array([GAIN_SLOPES.get(it.key, 0.0) for it in known])
    found = []
    for it, estimate in zip(
        known, widened(scene.found, slopes, math.log1p(gain_error)), strict=True
    ):
        assumed = value_of(scene_of(rig), it)
        low, high, least, most = np.exp(
            [estimate.low, estimate.high, estimate.prior_low, estimate.prior_high]
        )
        withheld = tuple(check.title for check in checks if check.found and it.key in check.touches)
        found.append(
            ParameterFit(
                key=it.key,
                title=it.title,
                unit=it.unit,
                assumed=assumed,
                value=float(np.exp(estimate.median)) if estimate.identified else assumed,
                low=None if withheld else float(low),
                high=None if withheld else float(high),
                least=float(least),
                most=float(most),
                identified=estimate.identified,
                withheld=withheld,
            )
        )
    return tuple(found)


def seen_statistics(scene: SceneFit) -> dict[str, StatisticSeen]:
    """Return the pilot's statistics with the middle 95 % of the worlds."""
    bank, observed = scene.bank, scene.observed.fitted
    found = {}
    for k, name in enumerate(bank.statistics):
        there = bank.s[np.isfinite(bank.s[:, k]), k]
        if name not in NOT_LOGGED:
            there = np.exp(there)
        low, high = np.quantile(there, (0.025, 0.975)) if len(there) else (None, None)
        own = observed.get(name, np.nan)
        found[name] = StatisticSeen(
            pilot=float(own) if np.isfinite(own) else None,
            low=None if low is None else float(low),
            high=None if high is None else float(high),
        )
    return found


def write_twin(wanted: FitRequest, scene: SceneFit, record: TwinRecord) -> None:
    """Write the twin's rig file, which extends the one that was fitted."""
    rounded = {key: _rounded(value) for key, value in scene.values.items()}
    mock = settings_of(scene_of(wanted.rig), rounded)
    mock.setdefault("scene", {})["level"] = LEVEL
    noise_px = scene_of(scene.prior.rig).frame_camera.centroid_noise_px
    if noise_px != scene_of(wanted.rig).frame_camera.centroid_noise_px:
        mock["frame_camera"] = {"centroid_noise_px": noise_px}
    skin = mock["scene"].setdefault("skin", {})
    if scene.skin:
        skin["papillae"] = tuple(scene.skin["papillae"])
    touch = touch_section(changed(wanted.rig, mock))
    if scene.skin:
        skin["papillae"] = [papilla.model_dump(mode="json") for papilla in scene.skin["papillae"]]
    path = rig_path(wanted.rig_path)
    shipped = path in shipped_rigs().values()
    extends = path.stem if shipped else os.path.relpath(path.resolve(), wanted.out.parent.resolve())
    data = {
        "extends": extends,
        "name": wanted.out.stem.replace("_", "-"),
        **touch,
        "mock": mock,
        "twin": record.model_dump(mode="json"),
    }
    text = f"# Written by `sliplab calibrate scene`: {extends}, fitted to '{record.campaign}'.\n"
    make_folder(wanted.out.parent)
    write_text(wanted.out, text + rig_yaml(data))


def ring_of(rig: RigFile) -> F64:
    """Return each papilla's ring, 0 for the centre, (m,)."""
    return np.repeat(np.arange(len(rig.skin.ring_counts)), rig.skin.ring_counts).astype(np.float64)


def _rounded(value: float) -> float:
    return float(f"{value:.5g}")


def _range(values: Sequence[float]) -> ConditionRange:
    return ConditionRange(least=float(min(values)), most=float(max(values)))
