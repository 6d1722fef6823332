"""Studies on a calibrated twin, beside those on the hidden world that it was fitted to.

    python -m benchmarks.twin_studies FOLDER [--worlds 3] [--first 0] [--seed 1] [--bank 240]
                                      [--again]

A hidden world is a clean one of `benchmarks.twin` with the same seed, and so are the worlds that a
fit simulates. Its pilot of 36 slides calibrates a twin, beginning with the rig that all hidden
worlds were drawn around. Then the same study is done on the hidden world, on its twin, and, once,
on the rig as it was: the kinematic grid with `REPETITIONS` of each condition, of which `SPLIT` are
tests, and gravity and disturbance trials in full. Trials of one id have the same
chance on each of them. The network of each is tested on the hidden world's test trials. What
the twin's scene alone changes is shown by its trials with the hidden world's network; what figures
differ by alone, with `--again`, by the hidden world's study with a network of another seed.

FOLDER keeps all stores: a run that was stopped goes on, and more worlds may be added.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from shutil import copytree
from typing import Any

from benchmarks.twin import BANK, CLEAN, pilot_slides, prior_of
from sliplab.analysis.campaigns import Collected
from sliplab.analysis.evaluation.trials import Judged, judge, summaries
from sliplab.analysis.labels.reviewed import Labels
from sliplab.analysis.networks import model_file, training
from sliplab.analysis.networks.models import (
    choose_model,
    rules_of,
    training_settings,
    wanted_models,
)
from sliplab.analysis.networks.training import Fitted
from sliplab.analysis.windows.sample_sets import load_samples
from sliplab.flows.other_rig import retake
from sliplab.flows.planning.run_request import make_request
from sliplab.flows.running import orchestration
from sliplab.flows.train import train
from sliplab.flows.twin.calibrate import calibrate_scene, request
from sliplab.flows.twin.worlds import touch_depth_mm
from sliplab.protocols.yaml_file import parse_yaml
from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.rig_file import load_rig_file
from sliplab.rigs.rig_inheritance import rig_yaml
from sliplab.storage.files import read_json, write_json
from sliplab.storage.trials.store import Store

ROOT = Path(__file__).parents[1]
ASSUMED = {
    "extends": "mock_force",
    "name": "assumed",
    "poll": "1 s",
    "mock": {"frame_camera": {"level": "tracks"}, "scene": {"level": "L3"}},
}
"""The rig that hidden worlds are drawn around, with all physics."""
REPETITIONS = {"kinematic": 2, "gravity": 12, "disturbance": 6}
"""Of each condition."""
SPLIT = {"train": 0.35, "validation": 0.075, "test": 0.575}
"""Shares of the slides. As many to train on as in one repetition of the grid; the others are tests:
the accuracy on the 43 test slides of one repetition is uncertain by 1.7 points (95 %)."""
TOUCHES = 8
"""Touches whose mean is depth zero."""
FIGURES = {
    "accuracy": "accuracy (%)",
    "kinematic": "slides, incipient (ms)",
    "gross": "slides, gross (ms)",
    "gravity": "gravity, incipient (ms)",
    "gravity_lead": "gravity, lead (ms)",
    "disturbance": "disturbance, incipient (ms)",
    "disturbance_lead": "disturbance, lead (ms)",
}
"""Figures of a study: strict accuracy, and medians."""
POINTS, SHARE = 1.0, 0.1
"""Largest difference of accuracy and, relative, of each median."""
STEP_MS = 10.1
"""Medians of latencies are steps of 10 ms: two that differ by one step may come from one rig."""


def shipped(name: str, folder: Path, repetitions: int = 1) -> Path:
    """Write a shipped protocol as it is used here; the paper's network is left out."""
    source = ROOT / f"protocols/{name}.yaml"
    data = parse_yaml(source.read_text(), source)
    data["collection"]["repetitions"] = repetitions
    data["collection"]["maintenance"]["rezero"]["touches"] = TOUCHES
    data["analysis"].pop("also", None)
    if name == "kinematic":
        data["analysis"]["split"].update(SPLIT)
    path = folder / f"{name}.yaml"
    path.write_text(rig_yaml(data))
    return path


def hidden_rig(folder: Path, assumed: Path, seed: int, number: int) -> Path:
    """Write the rig file of a hidden world."""
    prior = replace(prior_of(CLEAN, seed), rig=load_rig_file(assumed)[0])
    world = prior.world(number, pilot_slides()).rig
    data = {
        "extends": str(assumed), "name": "hidden", "mock": world.scene.model_dump(mode="json"),
        # a lab measures it
        "calibration": {"touch_depth": f"{touch_depth_mm(world):.3f} mm"},
    }  # fmt: skip
    path = folder / "hidden.yaml"
    path.write_text(rig_yaml(data))
    return path


def calibrated(asked: argparse.Namespace, folder: Path, hidden: Path) -> Path:
    """Take the pilot of a hidden world and write its twin; all fits share simulated worlds."""
    assumed, worlds = asked.folder / "assumed.yaml", asked.folder / "scene-worlds"
    twin = folder / "twin.yaml"
    if twin.with_suffix(".html").exists():
        return twin
    pilot = make_request(shipped("pilot", folder), hidden, folder / "pilot")
    store, (item,) = retake([pilot])
    kept = store.folder / "derived/scene-worlds"
    copytree(worlds, kept, dirs_exist_ok=True)
    try:
        fitting = prior_of(BANK, asked.seed)
        wanted = request(assumed, twin, asked.bank, fitting.spread, fitting.seed)
        calibrate_scene(store, item, replace(wanted, needs=False))
    finally:
        copytree(kept, worlds, dirs_exist_ok=True)
    return twin


@dataclass(frozen=True)
class Study:
    """Labelled trials of a study, and the network that it trained."""

    store: Store
    campaigns: list[Collected]
    fitted: Fitted

    def judged(self, fitted: Fitted) -> Judged:
        """Test a network on the study's test trials, by its protocols' rules."""
        rules = rules_of(self.campaigns, fitted.network.outputs_per_class)
        return judge(fitted, rules, self.store, self.campaigns)


def studied(rig: Path, files: Sequence[Path], folder: Path) -> Study:
    """Take, label and train what is missing of a study."""
    store, campaigns = retake([make_request(file, rig, folder) for file in files])
    train(store, campaigns)
    model = choose_model(wanted_models(store, campaigns))
    return Study(store, campaigns, model_file.load(model.path))


def trained_again(study: Study, path: Path) -> Fitted:
    """Train a study's network with another seed, unless `path` has it."""
    if path.exists():
        return model_file.load(path)
    labels, settings = Labels(study.store), training_settings(study.campaigns)
    train, validation = (
        load_samples(labels, study.campaigns, split) for split in ("train", "validation")
    )
    fitted = training.fit(
        train.windows, train.y, validation.windows, validation.y, settings.network,
        settings.windows, settings.training, settings.training.seeds[0] + 1,
    )  # fmt: skip
    model_file.save(path, fitted)
    return fitted


def figures_of(judged: Judged) -> dict[str, float | None]:
    """Return the figures of a study, see `FIGURES`."""
    strict, of = judged.window_scores(0.0).strict, summaries(judged.rows)
    return {
        "accuracy": None if strict.share is None else 100.0 * strict.share,
        "gross": of["kinematic"].latency_ms.gross.median,
        **{name: scores.latency_ms.incipient.median for name, scores in of.items()},
        **{f"{name}_lead": of[name].lead_ms.median for name in ("gravity", "disturbance")},
    }


def transferred(judged: Judged) -> dict[str, float | None]:
    """Return the accuracy of a network on a hidden world's test trials, in percent."""
    strict = judged.window_scores(0.0).strict
    ends = {"share": strict.share, "low": strict.low, "high": strict.high}
    return {name: None if value is None else 100.0 * value for name, value in ends.items()}


def within(
    own: Mapping[str, Any], other: Mapping[str, Any], step_ms: float = 0.0
) -> dict[str, bool]:
    """Return which figures of a study are as near to a hidden world's own as they should be.

    Args:
        step_ms: difference that is allowed to any median.
    """
    found = {}
    for name in FIGURES:
        a, b = own[name], other[name]
        most = POINTS if name == "accuracy" else max(SHARE * abs(a or 0.0), step_ms)
        found[name] = a is not None and b is not None and abs(a - b) <= most
    return found


def world_row(asked: argparse.Namespace, number: int, files: Sequence[Path]) -> dict[str, Any]:
    """Do everything of one hidden world; return its figures."""
    folder: Path = asked.folder / f"world{number}"
    folder.mkdir(exist_ok=True)
    assumed = asked.folder / "assumed.yaml"
    hidden = hidden_rig(folder, assumed, asked.seed, number)
    twin = calibrated(asked, folder, hidden)
    studies = {
        "hidden": studied(hidden, files, folder / "hidden"),
        "twin": studied(twin, files, folder / "twin"),
        "assumed": studied(assumed, files, asked.folder / "assumed"),
    }
    own = studies["hidden"]
    judged = {name: it.judged(it.fitted) for name, it in studies.items()}
    judged["twin, hidden world's network"] = studies["twin"].judged(own.fitted)
    on_hidden = {name: own.judged(studies[name].fitted) for name in ("twin", "assumed")}
    on_hidden["hidden"] = judged["hidden"]
    again = folder / "again.pt"
    if asked.again or again.exists():
        other_seed = own.judged(trained_again(own, again))
        judged["hidden, another seed"] = on_hidden["hidden, another seed"] = other_seed
    return {
        "world": number,
        "studies": {name: figures_of(it) for name, it in judged.items()},
        "networks": {name: transferred(it) for name, it in on_hidden.items()},
    }


def lines(rows: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Yield tables of all worlds in Markdown, and summaries."""
    yield f"| world | study on | {' | '.join(FIGURES.values())} | within |"
    yield "| --- | --- |" + " --- |" * (len(FIGURES) + 1)
    near: dict[str, list[dict[str, bool]]] = {}
    steps: dict[str, int] = {}
    for row in rows:
        own = row["studies"]["hidden"]
        for name, found in row["studies"].items():
            cells = [
                "-" if value is None else f"{value:.1f}" if key == "accuracy" else f"{value:.0f}"
                for key, value in ((key, found[key]) for key in FIGURES)
            ]
            said = ""
            if found is not own:
                held = within(own, found)
                near.setdefault(name, []).append(held)
                steps[name] = steps.get(name, 0) + all(within(own, found, STEP_MS).values())
                said = f"{sum(held.values())} of {len(held)}"
            yield f"| {row['world']} | {name} | {' | '.join(cells)} | {said} |"
    yield ""
    title = f"within {POINTS:g} point, or {100 * SHARE:g} %"
    yield f"| {title} | {' | '.join(FIGURES.values())} | all | all, or one step of 10 ms |"
    yield "| --- |" + " --- |" * (len(FIGURES) + 2)
    for name, worlds in near.items():
        counts = [sum(held[key] for held in worlds) for key in FIGURES]
        counts += [sum(all(held.values()) for held in worlds), steps[name]]
        yield f"| {name} | {' | '.join(f'{count} of {len(worlds)}' for count in counts)} |"
    yield ""
    yield "| world | network trained on | accuracy on the hidden world (%) | 95 % |"
    yield "| --- | --- | --- | --- |"
    for row in rows:
        for name, found in row["networks"].items():
            span = "-" if found["low"] is None else f"{found['low']:.1f} to {found['high']:.1f}"
            yield f"| {row['world']} | {name} | {found['share']:.1f} | {span} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--worlds", type=int, default=3)
    parser.add_argument("--first", type=int, default=0, help="number of the first world")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--bank", type=int, default=240, help="worlds that fits simulate")
    parser.add_argument("--again", action="store_true", help="train with another seed, too")
    asked = parser.parse_args()
    asked.folder = asked.folder.resolve()
    (asked.folder / "scene-worlds").mkdir(parents=True, exist_ok=True)
    orchestration.configure_prefect(asked.folder)
    (asked.folder / "assumed.yaml").write_text(rig_yaml(ASSUMED))
    files = [shipped(name, asked.folder, count) for name, count in REPETITIONS.items()]
    kept = asked.folder / "rows.json"
    rows = read_json(kept)["rows"] if kept.exists() else []
    for number in range(asked.first, asked.first + asked.worlds):
        if number in [row["world"] for row in rows]:
            continue
        try:
            rows.append(world_row(asked, number, files))
        except RigError as error:
            print(f"world {number} cannot be collected: {error}")
            continue
        write_json(kept, {"simulated": True, "rows": rows})
    print("\n".join(lines(rows)))


if __name__ == "__main__":
    main()
