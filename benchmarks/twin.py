"""A scene fitted to pilots of hidden worlds: intervals that hold, and effects that it lacks.

    python -m benchmarks.twin coverage [--clean 40] [--bank 150] [--seed 1]
                                       [--file WORLDS.jsonl] [--cores 2] [--plot RANKS.png]
    python -m benchmarks.twin misfits [--worlds 10] and the same

A hidden world is a simulated rig with a force sensor, its parameters drawn 30 % around the
defaults, with another skin and other pixels, and depth zero off by up to 0.1 mm. Its pilot has 36
slides; test trials are left out. The bank's worlds are drawn as in a fit, 50 % around the
defaults; each of them is compared with others, too, as a clean world. Every world is looked at
twice: with its forces, and without.

Coverage has two tables. Hidden worlds lie in the middle of the bank's, where errors are smaller
than its intervals say. The bank's own, a tenth at a time against the others, are as wide apart as
what intervals are made of: simulation-based calibration (Talts et al. 2018). There a truth's rank
among the posterior's samples is uniform, which `--plot` shows for each parameter.

Effects have the sizes that docs/faults.md names. The light is as bright as makes a pixel of 2.7
standard deviations below the mean threshold fire, as light of the default share does on the default
pixels: what is brighter fails a campaign's gates, and of what is less bright these have no events.

`--file` keeps what was simulated: a run that was stopped goes on from there.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import kstest, kstwo
from threadpoolctl import threadpool_limits

from sliplab.plugins.simulation.scene_runs import changed
from sliplab.plugins.simulation.settings import MockEventCameraSettings, scene_of
from sliplab.plugins.twin.document import MisfitCheck
from sliplab.plugins.twin.misfits import misfits
from sliplab.plugins.twin.parameters import PARAMETERS, settings_of, value_of
from sliplab.plugins.twin.pilot import PilotTrial
from sliplab.plugins.twin.pilots import event_trials, simulate_pilot
from sliplab.plugins.twin.posterior import Bank, FittedBank, ParameterPosterior, fitted
from sliplab.plugins.twin.statistics import SlideStatistics, of_names, statistics
from sliplab.plugins.twin.worlds import DrawnWorld, Prior, Slides
from sliplab.protocols.plan import load_plan
from sliplab.rigs.core import faults
from sliplab.rigs.rig_file import load_rig_file
from sliplab.rigs.rig_inheritance import shipped_rigs
from sliplab.storage.streams import F64

ROOT = Path(__file__).parents[1]
SPREAD, HIDDEN_SPREAD = 0.5, 0.3
TILT_DEG = 1.0
THRESHOLD = MockEventCameraSettings().threshold
FAINT = 2.67
"""A light is seen by pixels whose threshold is so many standard deviations below the mean."""
FIRST_STREAMS = {
    "a tilted plate": ("frames",),
    "a sticky papilla": ("frames",),
    "a broken papilla": ("frames",),
    "a light on the mains": ("events",),
    "a slow ramp": ("poses",),
    "a dirty spot": ("frames",),
}
CLEAN, BANK = "clean", "bank"
FIRST_KINDS = (BANK, CLEAN, *FIRST_STREAMS)
"""Those whose worlds have a seed of their own; worlds of later kinds are further clean ones."""
LATER = 1000
TURN_DEG, SCALED, BENT, REACH_MM, LATE_S, DRIFT = 6.0, 1.05, -0.03, 15.0, 0.015, -0.2


def turned(tips: F64) -> F64:
    """Return places in the picture of a camera that is turned by `TURN_DEG`."""
    cos, sin = np.cos(np.radians(TURN_DEG)), np.sin(np.radians(TURN_DEG))
    found: F64 = tips @ np.array([[cos, sin], [-sin, cos]])
    return found


def scaled(tips: F64) -> F64:
    """Return places whose scale is wrong."""
    return tips * SCALED


def bent(tips: F64) -> F64:
    """Return places that a lens moves by `BENT` of their distance where this is `REACH_MM`."""
    found: F64 = tips * (1.0 + BENT * (tips**2).sum(axis=-1, keepdims=True) / REACH_MM**2)
    return found


VIEWS = {"a turned camera": turned, "a wrong scale": scaled, "a distorting lens": bent}
LATE = "late frames"
DRIFTS = {
    "falling stiffness": "scene.skin.youngs_modulus_mpa",
    "falling friction": "scene.friction.kinetic",
}
STREAMS: Mapping[str, tuple[str, ...]] = (
    FIRST_STREAMS
    | dict.fromkeys((*VIEWS, LATE), ("frames",))
    | dict.fromkeys(DRIFTS, ("frames", "force"))
)
KINDS = (BANK, CLEAN, *STREAMS)
FORCES = ("without forces", "with forces")
TENTHS = 10


@dataclass(frozen=True)
class WorldJob:
    """One world to simulate: its kind, one of `KINDS`, and its number among these."""

    kind: str
    number: int
    seed: int


def prior_of(kind: str, seed: int) -> Prior:
    """Return what worlds of a kind are drawn from."""
    rig, _ = load_rig_file(shipped_rigs()["mock_force"])
    spread = SPREAD if kind == BANK else HIDDEN_SPREAD
    own = kind if kind in FIRST_KINDS else CLEAN
    return Prior(rig, spread, seed * len(FIRST_KINDS) + FIRST_KINDS.index(own))


def pilot_slides() -> Slides:
    """Return the pilot's trials without its test trials."""
    plan = load_plan(ROOT / "protocols/pilot.yaml")
    fitted = tuple(trial for trial in plan.trials if trial.split != "test")
    return Slides(plan, fitted, event_trials(fitted))


def world_of(job: WorldJob) -> DrawnWorld:
    """Return a world of a kind."""
    prior = prior_of(job.kind, job.seed)
    if job.kind not in FIRST_KINDS:
        return prior.world(LATER + job.number, pilot_slides())
    world = prior.world(job.number, pilot_slides())
    if job.kind == "a tilted plate":
        tilt_deg = scene_of(prior.rig).scene.contact.tilt_deg + TILT_DEG
        made = changed(world.rig, {"scene": {"contact": {"tilt_deg": tilt_deg}}})
    else:
        rng = np.random.default_rng([prior.seed, job.number, 1])
        made = changed(
            world.rig, {"faults": tuple(faults_of(job.kind, prior.values(job.number), rng))}
        )
    return replace(world, rig=made, with_faults=True)


def faults_of(
    kind: str, values: Mapping[str, float], rng: np.random.Generator
) -> Iterator[faults.AnyFault]:
    """Yield the fault that makes an effect; none for a clean world or a tilted plate."""
    papilla = int(rng.integers(19))
    if kind == "a sticky papilla":
        yield faults.PapillaSticky(kind="papilla_sticky", papilla=papilla)
    elif kind == "a broken papilla":
        yield faults.PapillaTorn(kind="papilla_torn", papilla=papilla, since="trial", at_s=0.0)
    elif kind == "a light on the mains":
        sigma = values["event_camera.threshold_sigma"]
        share = math.tanh((THRESHOLD - FAINT * sigma) / 2.0)
        yield faults.MainsLight(kind="mains_light", share=share)
    elif kind == "a slow ramp":
        yield faults.ArmRamp(kind="arm_ramp", mm_s2=5.0)
    elif kind == "a dirty spot":
        angle, far = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.0, 10.0)
        centre = (float(far * np.cos(angle)), float(far * np.sin(angle)))
        yield faults.PlateSpot(kind="plate_spot", centre_mm=centre, radius_mm=4.0)


def slides_of(job: WorldJob, world: DrawnWorld) -> list[PilotTrial]:
    """Return the slides that a world of a kind shows."""
    if job.kind in DRIFTS:
        key, trials = DRIFTS[job.kind], world.slides.trials
        (it,) = (one for one in PARAMETERS if one.key == key)
        value, found = value_of(scene_of(world.rig), it), []
        for number, trial in enumerate(trials):
            worn = value * (1.0 + DRIFT * number / (len(trials) - 1))
            rig = changed(world.rig, settings_of(scene_of(world.rig), {key: worn}))
            with_events = trial.id in world.slides.with_events
            found += simulate_pilot(rig, world.slides.plan, [trial], world.seed, with_events)
        return found
    slides = world.take()
    if job.kind in VIEWS:
        return [replace(slide, tips_mm=VIEWS[job.kind](slide.tips_mm)) for slide in slides]
    if job.kind == LATE:
        return [late(slide) for slide in slides]
    return slides


def late(slide: PilotTrial) -> PilotTrial:
    """Return a slide whose frames are stamped late by `LATE_S`."""
    stamps = slide.frame_s + LATE_S
    base = [np.interp(stamps, slide.frame_s, column) for column in slide.base_mm.T]
    return replace(slide, frame_s=stamps, base_mm=np.column_stack(base))


def shown_by(job: WorldJob) -> dict[str, Any]:
    """Return what a world shows, with and without its forces."""
    world = world_of(job)
    found: dict[str, Any] = vars(job).copy()
    with threadpool_limits(1):
        slides = slides_of(job, world)
        for name in FORCES:
            seen = slides if name == "with forces" else [replace(s, forces=None) for s in slides]
            found[name] = vars(statistics(seen, world.slides.with_events, world.guess))
    return found


def taken(
    jobs: Sequence[WorldJob], file: Path | None, cores: int
) -> dict[str, list[dict[str, Any]]]:
    """Return what worlds show by kind; those that the file has are not simulated again."""
    retained: dict[WorldJob, dict[str, Any]] = {}
    if file is not None and file.exists():
        for line in file.read_text().splitlines():
            row = json.loads(line)
            retained[WorldJob(row["kind"], row["number"], row["seed"])] = row
    missing = sorted((job for job in jobs if job not in retained), key=lambda job: job.number)
    with ProcessPoolExecutor(cores, get_context("spawn")) as pool:
        for job, row in zip(missing, pool.map(shown_by, missing), strict=True):
            retained[job] = row
            if file is not None:
                with file.open("a") as lines:
                    lines.write(json.dumps(row) + "\n")
    found: dict[str, list[dict[str, Any]]] = {kind: [] for kind in KINDS}
    for job in jobs:
        found[job.kind].append(retained[job])
    return found


def seen_in(row: Mapping[str, Any], name: str) -> SlideStatistics:
    """Return what a world showed, with or without forces."""
    return SlideStatistics(**row[name])


def checks_of(
    row: Mapping[str, Any], bank: Sequence[Mapping[str, Any]], name: str
) -> tuple[MisfitCheck, ...]:
    """Return the checks of a hidden world against a bank."""
    own, worlds = seen_in(row, name), [seen_in(world, name) for world in bank]
    names = tuple(worlds[0].fitted)
    s = np.stack([of_names(world.fitted, names) for world in worlds])
    effects = [world.effects for world in worlds]
    return misfits(own.effects, effects, names, of_names(own.fitted, names), s)


def run_misfits(asked: argparse.Namespace) -> None:
    """Print how many effects are found, by which stream, and false alarms."""
    counts = {BANK: asked.bank, CLEAN: asked.clean} | dict.fromkeys(STREAMS, asked.worlds)
    jobs = [WorldJob(kind, n, asked.seed) for kind, count in counts.items() for n in range(count)]
    found = taken(jobs, asked.file, asked.cores)
    print("| world | forces | found | by the right stream | first check (worlds) |")
    print("| --- | --- | --- | --- | --- |")
    for name in FORCES:
        for kind in (*STREAMS, CLEAN, BANK):
            bank = found[BANK]
            called = []
            for row in found[kind]:
                others = [world for world in bank if world is not row]
                called += checks_of(row, others, name)[:1]
            misfit = [check for check in called if check.found]
            right = sum(check.stream in STREAMS.get(kind, ()) for check in misfit)
            titles = [f"{check.title} [{check.stream}]" for check in misfit]
            first = "; ".join(f"{t} ({titles.count(t)})" for t in dict.fromkeys(titles))
            counted = f"{right} of {len(called)}" if kind in STREAMS else "-"
            print(f"| {kind} | {name} | {len(misfit)} of {len(called)} | {counted} | {first} |")


@dataclass(frozen=True)
class CalledEstimate:
    """An estimate, the truth (logarithm), and the share of the posterior's samples below it."""

    estimate: ParameterPosterior
    truth: float
    rank: float

    @property
    def holds(self) -> bool:
        """Whether the interval holds the truth."""
        return self.estimate.low <= self.truth <= self.estimate.high


Worlds = list[tuple[CalledEstimate, ...]]
"""Of each world, one for each parameter."""


def called(bank: Bank, observed: F64, truths: F64) -> Worlds:
    """Return what a bank says of worlds.

    Args:
        observed: statistics, (k, q). truths: logarithms of parameters, (k, p).
    """
    fits: dict[bytes, FittedBank] = {}
    found = []
    for seen, truth in zip(observed, truths, strict=True):
        usable = np.isfinite(seen)
        key = usable.tobytes()
        if key not in fits:
            fits[key] = fitted(bank, usable)
        stated = fits[key].at(seen)
        ranks = (stated.samples < truth).mean(axis=0)
        found.append(tuple(map(CalledEstimate, stated.estimates, truth.tolist(), ranks.tolist())))
    return found


def called_of_bank(bank: Bank) -> Worlds:
    """Return what a bank says of its own worlds, a tenth at a time by the others."""
    found: Worlds = []
    for part in range(TENTHS):
        own = np.arange(len(bank)) % TENTHS == part
        others = replace(bank, theta=bank.theta[~own], s=bank.s[~own])
        found += called(others, bank.s[own], bank.theta[own])
    return found


def ranks_of(worlds: Worlds) -> F64:
    """Return the ranks of worlds and parameters, (k, p)."""
    return np.array([[one.rank for one in world] for world in worlds])


def coverage_lines(worlds: Worlds, forces: str) -> Iterator[str]:
    """Yield rows of a table: each parameter, and all."""
    known = [one for world in worlds for one in world if one.estimate.identified]
    for column in zip(*worlds, strict=True):
        cells = _cells([one for one in column if one.estimate.identified], len(column))
        yield f"| {column[0].estimate.parameter} | {forces} | {' | '.join(cells)} |"
    yield f"| all | {forces} | {' | '.join(_cells(known, sum(map(len, worlds))))} |"


def _cells(known: Sequence[CalledEstimate], of: int) -> tuple[str, str, str]:
    if not known:
        return f"0 of {of}", "-", "-"
    holds = sum(one.holds for one in known)
    off = [abs(math.expm1(one.estimate.median - one.truth)) for one in known]
    held = f"{holds} of {len(known)} ({100 * holds / len(known):.1f} %)"
    return f"{len(known)} of {of}", held, f"{100 * np.median(off):.1f} %"


def run_coverage(asked: argparse.Namespace) -> None:
    """Print how often intervals hold the truth, and how far medians are off."""
    counts = {BANK: asked.bank, CLEAN: asked.clean}
    jobs = [WorldJob(kind, n, asked.seed) for kind, count in counts.items() for n in range(count)]
    found = taken(jobs, asked.file, asked.cores)
    prior, hidden = prior_of(BANK, asked.seed), prior_of(CLEAN, asked.seed)
    banks = {name: prior.bank([seen_in(row, name) for row in found[BANK]]) for name in FORCES}
    values = [hidden.values(row["number"]) for row in found[CLEAN]]
    print("\n| hidden worlds | forces | identified | interval holds | median error |")
    print("| --- | --- | --- | --- | --- |")
    for name, bank in banks.items():
        seen = [of_names(seen_in(row, name).fitted, bank.statistics) for row in found[CLEAN]]
        truths = np.log([[it[key] for key in bank.parameters] for it in values])
        for line in coverage_lines(called(bank, np.stack(seen), truths), name):
            print(line)
    print(
        "\n| worlds of the bank | forces | identified | interval holds | median error | ranks, p |"
    )
    print("| --- | --- | --- | --- | --- | --- |")
    own = {name: called_of_bank(bank) for name, bank in banks.items()}
    ranks = {name: ranks_of(worlds) for name, worlds in own.items()}
    for name, worlds in own.items():
        uniform = [f"{kstest(column, 'uniform').pvalue:.2g}" for column in ranks[name].T]
        for line, p in zip(coverage_lines(worlds, name), [*uniform, "-"], strict=True):
            print(f"{line} {p} |")
    if asked.plot is not None:
        draw_ranks(ranks, asked.plot)


def draw_ranks(ranks: Mapping[str, F64], path: Path) -> None:
    """Draw the share of worlds below each rank less that rank, one line a parameter.

    The band is that of Kolmogorov's test at 5 %, for one parameter.

    Args:
        ranks: of worlds and parameters, (k, p), by the title of their panel.
    """
    figure = Figure(figsize=(9.0, 3.4), layout="constrained")
    panels = figure.subplots(1, len(ranks), sharey=True, squeeze=False)[0]
    for panel, (title, of) in zip(panels, ranks.items(), strict=True):
        share = (np.arange(len(of)) + 0.5) / len(of)
        panel.axhspan(*100.0 * np.array([-1, 1]) * kstwo.isf(0.05, len(of)), color="0.9")
        for column in np.sort(of, axis=0).T:
            panel.plot(column, 100.0 * (share - column), color="tab:blue", lw=0.7, alpha=0.6)
        panel.set(title=f"{title}, simulated", xlabel="rank of the truth among samples, 0 to 1")
    panels[0].set_ylabel("worlds with a smaller rank,\nless expected (points)")
    figure.savefig(path, dpi=90)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parts = parser.add_subparsers(required=True)
    part = parts.add_parser("misfits", help="worlds with an effect that the scene lacks")
    part.set_defaults(run=run_misfits)
    part.add_argument("--worlds", type=int, default=10, help="of each effect")
    other = parts.add_parser("coverage", help="worlds without one: intervals and errors")
    other.set_defaults(run=run_coverage)
    for each in (part, other):
        each.add_argument("--clean", type=int, default=40, help="without any effect")
        each.add_argument("--bank", type=int, default=150, help="at least 100 for coverage")
        each.add_argument("--seed", type=int, default=1)
        each.add_argument("--file", type=Path, help="keeps what was simulated")
        each.add_argument("--cores", type=int, default=2)
    other.add_argument("--plot", type=Path, help="writes the ranks of the bank's truths")
    asked = parser.parse_args()
    asked.run(asked)


if __name__ == "__main__":
    main()
