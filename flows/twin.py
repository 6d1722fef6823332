"""`sliplab calibrate scene`: fit a simulated rig's scene to the slides of a pilot.

What the pilot shows is reduced to a few dozen statistics. The same pilot is then simulated in many
worlds, whose parameters are drawn round the rig file's, and the statistics of these worlds say
which parameters lead to those of the pilot. A second round draws worlds where the first one found
the pilot. Test trials are not fitted: they judge the result.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.report import twin as page
from sliplab.analysis.twin.camera_estimates import camera_estimates
from sliplab.analysis.twin.contact_estimates import NOT_LOGGED, contact_estimates, papillae
from sliplab.analysis.twin.contact_springs import Guess
from sliplab.analysis.twin.misfits import misfit_numbers, misfits
from sliplab.analysis.twin.parameters import (
    PARAMETERS,
    Parameter,
    logarithms,
    settings_of,
    value_of,
)
from sliplab.analysis.twin.pilot import PilotTrial, pilot_trial, slide_of
from sliplab.analysis.twin.posterior import (
    Bank,
    Estimate,
    Posterior,
    narrowed,
    pooled,
    posterior,
)
from sliplab.analysis.twin.shown import QUANTITIES, compare
from sliplab.flows.running import console, orchestration
from sliplab.flows.scene_runs import changed
from sliplab.flows.twin_pilots import simulate_pilot
from sliplab.protocols import Plan, Trial
from sliplab.protocols.errors import InputError
from sliplab.rigs.levels import choose_level
from sliplab.rigs.mock.settings import Papilla
from sliplab.rigs.rig_file import RigFile, load_rig_file
from sliplab.rigs.rig_inheritance import rig_path, rig_yaml, shipped_rigs
from sliplab.rigs.twin import FittedValue, Range, TwinRecord
from sliplab.storage.files import write_json, write_text
from sliplab.storage.schema.twin import ParameterFit, QuantityCompared, StatisticSeen, TwinFit
from sliplab.storage.streams import F64
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.store import Store, StoreError

WORLDS = 150
"""Worlds of each of the two rounds."""
SPREAD = 0.5
"""The first round draws between 1/1.5 and 1.5 times the rig file's values."""
LEVEL = "L3"
"""All physics: what a scene may leave out is not known before it was fitted."""
PREDICTED = 12
"""Worlds of the twin in which the test trials are taken."""
EVENT_TRIALS = 12
"""Slides whose events are simulated and read: events take most of the time, and their statistics
need few trials."""
ZERO_MM = 0.1
"""Largest error of depth zero: touching off finds the plate only so exactly."""


@dataclass(frozen=True)
class Pilot:
    """The slides of a campaign.

    Attributes:
        fitted: trials for the fit. judged: test trials, which judge it.
        slides: all of them as arrays, by id.
        with_events: ids of the fitted trials whose events are read.
        checksum: of the fitted trials' files.
    """

    plan: Plan
    fitted: tuple[Trial, ...]
    judged: tuple[Trial, ...]
    slides: Mapping[str, PilotTrial]
    with_events: frozenset[str]
    checksum: str

    @property
    def streams(self) -> frozenset[str]:
        """Streams that the fitted trials have."""
        first = self.slides[self.fitted[0].id]
        there = {"frames": True, "events": first.camera, "force": first.forces}
        return frozenset(name for name, found in there.items() if found is not None)

    def statistics(self, guess: Guess) -> dict[str, float]:
        """Return what the fitted trials show."""
        slides = [self.slides[trial.id] for trial in self.fitted]
        return statistics(slides, self.with_events, guess)

    def misfit_numbers(self, guess: Guess) -> dict[str, float]:
        """Return what the fitted trials show of effects that the scene lacks."""
        slides = [self.slides[trial.id] for trial in self.fitted]
        return misfit_numbers(slides, events_of(slides, self.with_events), guess)


def read_pilot(store: Store, item: Collected) -> Pilot:
    """Read the labelled slides of a campaign.

    Raises:
        StoreError: it has no slides, or they are not labelled.
    """
    rig, _ = load_rig_file(item.campaign.folder / "rig.yaml", stored=True)
    choice = choose_level(rig, item.plan)
    if choice is not None and choice.name != LEVEL:
        raise StoreError(
            f"campaign '{item.name}': was simulated at level {choice.name}, without all physics "
            f"that is fitted; collect it on a rig with mock.scene.level: {LEVEL}"
        )
    labels = Derived.of(store, "labels", item.name)
    parts: dict[bool, list[Trial]] = {True: [], False: []}
    slides, sums = {}, hashlib.sha256()
    for trial, recording in item.trials:
        slide = slide_of(item.plan.program(trial))
        if slide is None:
            continue
        try:
            places = labels.arrays(trial.id)
        except FileNotFoundError:
            raise StoreError(
                f"{item.name}/{trial.id}: has no label yet; run `sliplab label` first"
            ) from None
        slides[trial.id] = pilot_trial(slide, recording, places)
        parts[trial.split == "test"].append(trial)
        if trial.split != "test":
            sums.update(recording.checksum.encode())
    if not parts[False]:
        raise StoreError(f"campaign '{item.name}': has no straight slides to fit a scene to")
    fitted = tuple(parts[False])
    chosen = np.unique(np.linspace(0, len(fitted) - 1, EVENT_TRIALS).round().astype(int))
    return Pilot(
        item.plan, fitted, tuple(parts[True]), slides,
        frozenset(fitted[k].id for k in chosen), sums.hexdigest(),
    )  # fmt: skip


def statistics(
    slides: Sequence[PilotTrial], with_events: frozenset[str], guess: Guess
) -> dict[str, float]:
    """Return what slides show of contact and event camera, by name.

    Args:
        with_events: ids of those whose events are read. guess: see `contact_estimates`.
    """
    seen = events_of(slides, with_events)
    found = contact_estimates(slides, guess)
    return found | camera_estimates(seen) if seen else found


def events_of(slides: Sequence[PilotTrial], with_events: frozenset[str]) -> list[PilotTrial]:
    """Return the slides whose events are read."""
    return [slide for slide in slides if slide.trial in with_events and slide.camera is not None]


@dataclass(frozen=True)
class World:
    """A simulated rig on which slides of the pilot are taken again.

    Attributes:
        with_events: ids of the trials whose events are simulated. seed: of the trials' chance.
        guess: where estimates begin; of the rig that is fitted.
        with_faults: keep the rig's faults.
    """

    rig: RigFile
    plan: Plan
    trials: tuple[Trial, ...]
    with_events: frozenset[str]
    seed: int
    guess: Guess
    with_faults: bool = False

    def slides(self) -> list[PilotTrial]:
        """Take the trials, in their order."""
        found = {}
        for with_events in (True, False):
            trials = [t for t in self.trials if (t.id in self.with_events) == with_events]
            for slide in simulate_pilot(
                self.rig, self.plan, trials, self.seed, with_events, self.with_faults
            ):
                found[slide.trial] = slide
        return [found[trial.id] for trial in self.trials]


def slides_of_world(world: World) -> list[PilotTrial]:
    """Return a world's slides."""
    return world.slides()


def statistics_of_world(world: World) -> tuple[dict[str, float], dict[str, float]]:
    """Return what a world's slides show: statistics, and the numbers of the checks for misfits.

    The matrices are too small for threads of their own.
    """
    with threadpool_limits(1):
        slides = world.slides()
        return (
            statistics(slides, world.with_events, world.guess),
            misfit_numbers(slides, events_of(slides, world.with_events), world.guess),
        )


def other_rig(
    rig: RigFile, values: Mapping[str, float], skin: Mapping[str, Any], zero_mm: float = 0.0
) -> RigFile:
    """Return a simulated rig with other parameters and another skin.

    Args:
        values: by the keys of `PARAMETERS`. skin: settings of it, beside those among `values`.
        zero_mm: error of depth zero.
    """
    settings = settings_of(rig.scene, values)
    scene = settings.setdefault("scene", {})
    scene["level"] = LEVEL
    scene["skin"] = {**scene.get("skin", {}), **skin}
    scene["contact"] = {"offset_mm": rig.scene.scene.contact.offset_mm + zero_mm}
    return changed(rig, settings)


def other_specimen(rig: RigFile, values: Mapping[str, float], seed: int, zero_mm: float) -> RigFile:
    """Return another specimen of a simulated rig: its skin, its pixels, its tremor are drawn anew.

    Args:
        values, zero_mm: as for `other_rig`.
    """
    made = other_rig(rig, values, {"seed": None, "papillae": None}, zero_mm)
    return changed(made, {"seed": seed})


def guess_of(rig: RigFile) -> Guess:
    """Return the design of a rig's skin, and what it assumes of it."""
    skin, friction = rig.scene.scene.skin, rig.scene.scene.friction
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
    )


def everywhere(title: str, work: Callable[[World], Any], worlds: Sequence[World]) -> list[Any]:
    """Return `work` of every world, on all cores."""
    from sliplab.flows.running.parallel_map import parallel_map_flow

    found: dict[int, Any] = {}
    with console.bar(title, len(worlds)) as bar:

        def keep(number: int, result: Any) -> None:
            found[number] = result
            bar.advance()

        task = orchestration.Opaque((title, work, worlds, keep, None))
        orchestration.run(parallel_map_flow, task)
    return [found[number] for number in range(len(worlds))]


@dataclass(frozen=True)
class Calibration:
    """What a fit is asked for.

    Attributes:
        rig: the simulated rig to start from. rig_path: its file.
        worlds: to simulate in each of two rounds. spread: of the first round, see `drawn`.
        seed: of the worlds that are drawn.
    """

    rig: RigFile
    rig_path: Path
    out: Path
    worlds: int = WORLDS
    spread: float = SPREAD
    seed: int = 1

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Parameters that are switched on in the rig file."""
        return tuple(it for it in PARAMETERS if value_of(self.rig.scene, it) > 0.0)


def request(rig_path: Path, out: Path, worlds: int, spread: float, seed: int) -> Calibration:
    """Check what is asked for before anything is simulated.

    Raises:
        InputError: the rig is not a simulated one in virtual time, or the new file cannot be made.
    """
    rig, _ = load_rig_file(rig_path)
    if not rig.in_virtual_time:
        raise InputError(
            "--rig", "", str(rig_path),
            "must be a simulated rig with driver: mock, whose scene is fitted; such as rehearsal, "
            "or a file that extends it with your skin and cameras",
        )  # fmt: skip
    if out.suffix not in {".yaml", ".yml"}:
        raise InputError("--out", "", str(out), "must end in .yaml")
    if not out.parent.is_dir():
        raise InputError("--out", "", str(out), "its folder does not exist")
    if out.exists() and load_rig_file(out)[0].twin is None:
        raise InputError("--out", "", str(out), "exists and is no twin: use another name")
    return Calibration(rig, rig_path, out, worlds, spread, seed)


def calibrate_scene(store: Store, item: Collected, wanted: Calibration) -> TwinFit:
    """Fit a rig's scene to a campaign's slides; write the twin's rig file, page and numbers.

    Raises:
        StoreError: the campaign has no slides, or they are not labelled.
    """
    began = monotonic()
    orchestration.configure_prefect(store.folder)
    pilot = read_pilot(store, item)
    observed = pilot.statistics(guess_of(wanted.rig))
    parameters = wanted.parameters
    assumed = {it.key: value_of(wanted.rig.scene, it) for it in parameters}
    middle = logarithms(assumed, parameters)
    reach = np.log1p(wanted.spread)
    most = np.log([it.most for it in parameters])
    prior = middle - reach, np.minimum(middle + reach, most)
    first, _ = simulated_bank("first round (worlds)", wanted, pilot, observed, prior, 1)
    found = posterior(first, of_names(observed, first.statistics))
    second, numbers = simulated_bank(
        "second round (worlds)", wanted, pilot, observed, narrowed(found), 2
    )
    bank = pooled(first, second)
    found = posterior(bank, of_names(observed, bank.statistics), prior)
    values = {
        it.key: float(np.exp(estimate.median))
        for it, estimate in zip(parameters, found.estimates, strict=True)
        if estimate.identified
    }
    skin = {} if (made := measured_papillae(wanted.rig, pilot)) is None else {"papillae": made}
    worlds = len(first) + len(second)
    predicted = predict(wanted, pilot, parameters, found, values, skin)
    fit = TwinFit(
        simulated=bool(item.info.get("simulated")),
        campaign=item.name,
        rig=wanted.rig.name,
        checksum=pilot.checksum,
        trials=len(pilot.fitted),
        judged=len(pilot.judged),
        worlds=worlds,
        predicted=len(predicted[0]),
        seconds=round(monotonic() - began, 1),
        parameters=tuple(
            parameter_fit(it, assumed[it.key], estimate)
            for it, estimate in zip(parameters, found.estimates, strict=True)
        ),
        statistics=seen_statistics(bank, observed),
        checks=misfits(
            pilot.misfit_numbers(guess_of(wanted.rig)),
            numbers,
            second.statistics,
            of_names(observed, second.statistics),
            second.s,
        ),
        compared=compared(pilot, *predicted),
    )
    record = TwinRecord(
        campaign=fit.campaign,
        checksum=fit.checksum,
        trials=fit.trials,
        simulated=fit.simulated,
        fitted=date.today(),
        method=f"regression on {worlds} simulated worlds",
        depth_mm=_range([pilot.slides[t.id].slide.depth_mm for t in pilot.fitted]),
        speed_mm_s=_range([pilot.slides[t.id].slide.speed_mm_s for t in pilot.fitted]),
        parameters={
            it.key: FittedValue(
                value=it.value, low=it.low, high=it.high, unit=it.unit, identified=it.identified
            )
            for it in fit.parameters
        },
    )
    write_twin(wanted, values, skin, record)
    write_json(wanted.out.with_suffix(".json"), fit.to_json())
    rings = ring_of(wanted.rig)
    judged = [pilot.slides[trial.id] for trial in pilot.judged]
    text = page.render(fit, wanted.out.stem, judged, *predicted, rings, pilot.streams)
    write_text(wanted.out.with_suffix(".html"), text)
    return fit


def of_names(values: Mapping[str, float], names: Sequence[str]) -> F64:
    """Return the logarithms of statistics by name, (q,); NaN for one that is missing.

    Those that may be negative stay as they are.
    """
    found = np.array([values.get(name, np.nan) for name in names], np.float64)
    plain = np.array([name in NOT_LOGGED for name in names], np.bool_)
    with np.errstate(invalid="ignore", divide="ignore"):
        logged = np.log(np.where(found > 0.0, found, np.nan))
    result: F64 = np.where(plain, found, logged)
    return result


def simulated_bank(
    title: str,
    wanted: Calibration,
    pilot: Pilot,
    observed: Mapping[str, float],
    bounds: tuple[F64, F64],
    number: int,
) -> tuple[Bank, list[dict[str, float]]]:
    """Simulate the pilot in worlds drawn between bounds of the parameters' logarithms.

    Args:
        number: of the round, which has worlds of its own.

    Returns:
        The bank, and each world's numbers of the checks for misfits.
    """
    parameters, (lower, upper) = wanted.parameters, bounds
    rng = np.random.default_rng([wanted.seed, number])
    theta = rng.uniform(lower, upper, (wanted.worlds, len(parameters)))
    worlds = []
    for row in theta:
        values = {it.key: float(value) for it, value in zip(parameters, np.exp(row), strict=True)}
        seed, chance = (int(n) for n in rng.integers(2**31, size=2))
        zero_mm = float(rng.uniform(-ZERO_MM, ZERO_MM))
        rig = other_specimen(wanted.rig, values, seed, zero_mm)
        worlds.append(
            World(rig, pilot.plan, pilot.fitted, pilot.with_events, chance, guess_of(wanted.rig))
        )
    seen = everywhere(title, statistics_of_world, worlds)
    names = tuple(observed)
    s = np.stack([of_names(found, names) for found, _ in seen])
    bank = Bank(tuple(it.key for it in parameters), names, theta, s, lower, upper)
    return bank, [numbers for _, numbers in seen]


def measured_papillae(rig: RigFile, pilot: Pilot) -> tuple[Papilla, ...] | None:
    """Return the papillae as the pilot shows them, for `mock.scene.skin`; None if it does not."""
    found = papillae([pilot.slides[trial.id] for trial in pilot.fitted], guess_of(rig))
    design = np.array(rig.skin.layout_mm())
    if found is None or len(found.gap_mm) != len(design):
        return None
    place = found.place_mm - np.median(found.place_mm - design, axis=0)
    height = rig.scene.scene.skin.heights_mm[0] - found.gap_mm
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


def predict(
    wanted: Calibration,
    pilot: Pilot,
    parameters: Sequence[Parameter],
    found: Posterior,
    values: Mapping[str, float],
    skin: Mapping[str, Any],
) -> tuple[list[list[PilotTrial]], list[list[PilotTrial]]]:
    """Take the test trials in worlds of the twin and in worlds of the rig file as it was.

    Worlds of the twin differ in what the pilot leaves open of the identified parameters.
    """
    if not pilot.judged:
        return [], []
    rng = np.random.default_rng([wanted.seed, 3])
    all_events = frozenset(trial.id for trial in pilot.judged)
    rows = rng.choice(len(found.samples), PREDICTED, replace=False)
    chance = [int(n) for n in rng.integers(2**31, size=PREDICTED)]
    guess = guess_of(wanted.rig)
    worlds = []
    for row, seed in zip(rows, chance, strict=True):
        drawn = {
            it.key: float(np.exp(found.samples[row, k]))
            for k, it in enumerate(parameters)
            if it.key in values
        }
        rig = other_rig(wanted.rig, drawn, skin)
        worlds.append(World(rig, pilot.plan, pilot.judged, all_events, seed, guess))
    as_it_was = other_rig(wanted.rig, {}, {})
    worlds += [
        World(as_it_was, pilot.plan, pilot.judged, all_events, seed, guess) for seed in chance
    ]
    taken = everywhere("test trials (worlds)", slides_of_world, worlds)
    return taken[:PREDICTED], taken[PREDICTED:]


def parameter_fit(it: Parameter, assumed: float, estimate: Estimate) -> ParameterFit:
    """Return what is kept of a parameter's posterior."""
    low, high, least, most = np.exp(
        [estimate.low, estimate.high, estimate.prior_low, estimate.prior_high]
    )
    value = float(np.exp(estimate.median)) if estimate.identified else assumed
    return ParameterFit(
        key=it.key, title=it.title, unit=it.unit, assumed=assumed, value=value,
        low=float(low), high=float(high), least=float(least), most=float(most),
        identified=estimate.identified,
    )  # fmt: skip


def seen_statistics(bank: Bank, observed: Mapping[str, float]) -> dict[str, StatisticSeen]:
    """Return what was read of the pilot, beside the middle 95 % of the bank's worlds."""
    found = {}
    for k, name in enumerate(bank.statistics):
        there = bank.s[np.isfinite(bank.s[:, k]), k]
        if name not in NOT_LOGGED:
            there = np.exp(there)
        low, high = np.quantile(there, (0.025, 0.975)) if len(there) else (None, None)
        own = observed[name]
        found[name] = StatisticSeen(
            pilot=float(own) if np.isfinite(own) else None,
            low=None if low is None else float(low),
            high=None if high is None else float(high),
        )
    return found


def compared(
    pilot: Pilot, twin: list[list[PilotTrial]], before: list[list[PilotTrial]]
) -> tuple[QuantityCompared, ...]:
    """Return the test trials' quantities beside those of simulated worlds."""
    if not pilot.judged:
        return ()
    judged = [pilot.slides[trial.id] for trial in pilot.judged]
    return tuple(
        QuantityCompared(
            title=QUANTITIES[it.name], pilot=it.pilot, twin=it.twin, before=it.before,
            scatter=it.scatter,
        )
        for it in compare(judged, twin, before)
    )  # fmt: skip


def write_twin(
    wanted: Calibration, values: Mapping[str, float], skin: Mapping[str, Any], record: TwinRecord
) -> None:
    """Write the twin's rig file, which extends the one that was fitted."""
    mock = settings_of(wanted.rig.scene, {key: _rounded(value) for key, value in values.items()})
    mock.setdefault("scene", {})["level"] = LEVEL
    if skin:
        papillae = [papilla.model_dump(mode="json") for papilla in skin["papillae"]]
        mock.setdefault("scene", {}).setdefault("skin", {})["papillae"] = papillae
    path = rig_path(wanted.rig_path)
    shipped = path in shipped_rigs().values()
    extends = path.stem if shipped else os.path.relpath(path.resolve(), wanted.out.parent.resolve())
    data = {
        "extends": extends,
        "name": wanted.out.stem.replace("_", "-"),
        "mock": _plain(mock),
        "twin": record.model_dump(mode="json"),
    }
    text = f"# Written by `sliplab calibrate scene`: {extends}, fitted to '{record.campaign}'.\n"
    write_text(wanted.out, text + rig_yaml(data))


def ring_of(rig: RigFile) -> F64:
    """Return each papilla's ring, 0 for the centre, (m,)."""
    return np.repeat(np.arange(len(rig.skin.ring_counts)), rig.skin.ring_counts).astype(np.float64)


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    return list(value) if isinstance(value, tuple) else value


def _rounded(value: float) -> float:
    return float(f"{value:.5g}")


def _range(values: Sequence[float]) -> Range:
    return Range(least=float(min(values)), most=float(max(values)))
