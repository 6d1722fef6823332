"""A scene fitted to pilots of hidden worlds: intervals that hold, and effects that it lacks.

    python -m benchmarks.twin coverage [--clean 40] [--bank 150] [--seed 1]
                                       [--file WORLDS.jsonl] [--cores 2]
    python -m benchmarks.twin misfits [--worlds 10] and the same

A hidden world is a simulated rig with a force sensor, its parameters drawn 30 % around the
defaults, with another skin and other pixels, and depth zero off by up to 0.1 mm. Its pilot has 36
slides; test trials are left out. The bank's worlds are drawn as in a fit, 50 % around the
defaults; each of them is compared with the others, too, as a clean world. Every world is
looked at twice: with its forces, and without.

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
from threadpoolctl import threadpool_limits

from sliplab.analysis.twin.misfits import misfits
from sliplab.analysis.twin.posterior import posterior
from sliplab.analysis.twin.statistics import Statistics, of_names, statistics
from sliplab.flows.scene_runs import changed
from sliplab.flows.twin.pilots import event_trials
from sliplab.flows.twin.worlds import Prior, Slides, World
from sliplab.protocols.plan import load_plan
from sliplab.rigs.mock import fault_settings as faults
from sliplab.rigs.mock.settings import EventCamera
from sliplab.rigs.rig_file import load_rig_file
from sliplab.rigs.rig_inheritance import shipped_rigs
from sliplab.storage.schema.twin import MisfitCheck

ROOT = Path(__file__).parents[1]
SPREAD, HIDDEN_SPREAD = 0.5, 0.3
TILT_DEG = 1.0
THRESHOLD = EventCamera().threshold
FAINT = 2.67
"""A light is seen by pixels whose threshold is so many standard deviations below the mean."""
STREAMS = {
    "a tilted plate": "frames", "a sticky papilla": "frames", "a broken papilla": "frames",
    "a light on the mains": "events", "a slow ramp": "poses", "a dirty spot": "frames",
}  # fmt: skip
CLEAN, BANK = "clean", "bank"
KINDS = (BANK, CLEAN, *STREAMS)
FORCES = ("without forces", "with forces")


@dataclass(frozen=True)
class Job:
    """One world to simulate: its kind, one of `KINDS`, and its number among these."""

    kind: str
    number: int
    seed: int


def prior_of(kind: str, seed: int) -> Prior:
    """Return what worlds of a kind are drawn from."""
    rig, _ = load_rig_file(shipped_rigs()["mock_force"])
    spread = SPREAD if kind == BANK else HIDDEN_SPREAD
    return Prior(rig, spread, seed * len(KINDS) + KINDS.index(kind))


def pilot_slides() -> Slides:
    """Return the pilot's trials without its test trials."""
    plan = load_plan(ROOT / "protocols/pilot.yaml")
    fitted = tuple(trial for trial in plan.trials if trial.split != "test")
    return Slides(plan, fitted, event_trials(fitted))


def world_of(job: Job) -> World:
    """Return a world of a kind."""
    prior = prior_of(job.kind, job.seed)
    world = prior.world(job.number, pilot_slides())
    if job.kind == "a tilted plate":
        tilt_deg = prior.rig.scene.scene.contact.tilt_deg + TILT_DEG
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


def shown_by(job: Job) -> dict[str, Any]:
    """Return what a world shows, with and without its forces."""
    world = world_of(job)
    found: dict[str, Any] = vars(job).copy()
    with threadpool_limits(1):
        slides = world.take()
        for name in FORCES:
            seen = slides if name == "with forces" else [replace(s, forces=None) for s in slides]
            found[name] = vars(statistics(seen, world.slides.with_events, world.guess))
    return found


def taken(jobs: Sequence[Job], file: Path | None, cores: int) -> dict[str, list[dict[str, Any]]]:
    """Return what worlds show by kind; those that the file has are not simulated again."""
    kept: dict[Job, dict[str, Any]] = {}
    if file is not None and file.exists():
        for line in file.read_text().splitlines():
            row = json.loads(line)
            kept[Job(row["kind"], row["number"], row["seed"])] = row
    missing = sorted((job for job in jobs if job not in kept), key=lambda job: job.number)
    with ProcessPoolExecutor(cores, get_context("spawn")) as pool:
        for job, row in zip(missing, pool.map(shown_by, missing), strict=True):
            kept[job] = row
            if file is not None:
                with file.open("a") as lines:
                    lines.write(json.dumps(row) + "\n")
    found: dict[str, list[dict[str, Any]]] = {kind: [] for kind in KINDS}
    for job in jobs:
        found[job.kind].append(kept[job])
    return found


def seen_in(row: Mapping[str, Any], name: str) -> Statistics:
    """Return what a world showed, with or without forces."""
    return Statistics(**row[name])


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
    jobs = [Job(kind, n, asked.seed) for kind, count in counts.items() for n in range(count)]
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
            right = sum(check.stream == STREAMS.get(kind) for check in misfit)
            titles = [f"{check.title} [{check.stream}]" for check in misfit]
            first = "; ".join(f"{t} ({titles.count(t)})" for t in dict.fromkeys(titles))
            counted = f"{right} of {len(called)}" if kind in STREAMS else "-"
            print(f"| {kind} | {name} | {len(misfit)} of {len(called)} | {counted} | {first} |")


def run_coverage(asked: argparse.Namespace) -> None:
    """Print how often intervals hold the truth, and how far medians are off."""
    counts = {BANK: asked.bank, CLEAN: asked.clean}
    jobs = [Job(kind, n, asked.seed) for kind, count in counts.items() for n in range(count)]
    found = taken(jobs, asked.file, asked.cores)
    print("| parameter | forces | identified | interval holds | median error |")
    print("| --- | --- | --- | --- | --- |")
    prior, hidden = prior_of(BANK, asked.seed), prior_of(CLEAN, asked.seed)
    for name in FORCES:
        bank = prior.bank([seen_in(row, name) for row in found[BANK]])
        known, held, errors = 0, 0, []
        pairs = []
        for row in found[CLEAN]:
            observed = of_names(seen_in(row, name).fitted, bank.statistics)
            truth = hidden.values(row["number"])
            estimates = posterior(bank, observed).estimates
            pairs.append([(it, np.log(truth[it.parameter])) for it in estimates])
        for column in zip(*pairs, strict=True):
            called = [(it, truth) for it, truth in column if it.identified]
            holds = sum(it.low <= truth <= it.high for it, truth in called)
            off = [abs(np.expm1(it.median - truth)) for it, truth in called]
            known, held, errors = known + len(called), held + holds, errors + off
            error = f"{100 * np.median(off):.1f} %" if off else "-"
            cells = (f"{len(called)} of {len(column)}", f"{holds} of {len(called)}", error)
            print(f"| {column[0][0].parameter} | {name} | {' | '.join(cells)} |")
        print(
            f"| all | {name} | {known} of {sum(map(len, pairs))} | {held} of {known} "
            f"({100 * held / max(known, 1):.1f} %) | {100 * np.median(errors):.1f} % |"
        )


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
    asked = parser.parse_args()
    asked.run(asked)


if __name__ == "__main__":
    main()
