"""Studies on a calibrated twin, beside those on the hidden world that it was fitted to.

    python -m benchmarks.twin_studies FOLDER [--worlds 3] [--first 0] [--seed 1] [--bank 240]
                                      [--networks 2] [--again] [--whole-grid]

A hidden world is a clean one of `benchmarks.twin` with the same seed, and so are the worlds that a
fit simulates. Its pilot of 36 slides calibrates a twin, beginning with the rig that all hidden
worlds were drawn around. Then the same study is done on the hidden world, on its twin, and, once,
on the rig as it was: the kinematic grid with `REPETITIONS` of each condition, of which `SPLIT` are
tests, and gravity and disturbance trials in full. Trials of one id have the same
chance on each of them. Each study trains `--networks` networks from other seeds, and its figures
are their means: one network alone may find slip 0.2 s later than another of the same trials. The
networks of each are tested on the hidden world's test trials. What the twin's scene alone changes
is shown by its trials with the hidden world's networks; what figures differ by anyway, with
`--again`, by as many further networks of the hidden world's study. `--whole-grid` is another study:
the grid alone, as shipped, with 605 slides to train on and 132 tests.

Times count from two onsets: the label's, which is the first frame in which a marker has moved by 2
pixels, as in the paper; and the change point, when it began to. The decisions are the same. The
paper's onsets are known in steps of 10 ms, the frames' period, and so are latencies; their medians
are those of values that lie anywhere within their steps (`statistics.median_grouped`).

FOLDER keeps all stores: a run that was stopped goes on, and more worlds may be added.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from shutil import copytree
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd

from benchmarks.twin import BANK, CLEAN, pilot_slides, prior_of
from sliplab.analysis.campaigns import Collected, training_campaigns
from sliplab.analysis.detectors.onset_references import Decided, decisions_of, references_of
from sliplab.analysis.detectors.onset_references import Name as Onset
from sliplab.analysis.evaluation.trials import EvaluatedTrials, judge
from sliplab.analysis.labels.reviewed import StoreLabels
from sliplab.analysis.metrics.intervals import drawn
from sliplab.analysis.networks import model_file
from sliplab.analysis.networks.models import rules_of, wanted_models
from sliplab.analysis.networks.training import Fitted, predict_counts
from sliplab.analysis.windows.dataset import SampleSet
from sliplab.analysis.windows.sample_sets import load_samples
from sliplab.flows.other_rig import retake
from sliplab.flows.planning.run_request import make_request
from sliplab.flows.running import orchestration
from sliplab.flows.train import train
from sliplab.plugins.simulation.settings import scene_of
from sliplab.plugins.twin.calibrate import calibrate_scene, request
from sliplab.plugins.twin.study import STUDY, finding
from sliplab.plugins.twin.worlds import touch_depth_mm
from sliplab.protocols.yaml_file import parse_yaml
from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.rig_file import load_rig_file
from sliplab.rigs.rig_inheritance import rig_yaml
from sliplab.storage.files import read_json, write_json
from sliplab.storage.trials.store import TrialStore

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

ROOT = Path(__file__).parents[1]
ASSUMED = {
    "extends": "mock_force",
    "name": "assumed",
    "poll": "1 s",
    "mock": {"frame_camera": {"level": "tracks"}, "scene": {"level": "L3"}},
}
"""The rig that hidden worlds are drawn around, with all physics."""
REPETITIONS = {"kinematic": 2, "gravity": 12, "disturbance": 18}
"""Of each condition. The median latency over 48 disturbances is uncertain by 13 % (95 %)."""
SPLIT = {"train": 0.35, "validation": 0.075, "test": 0.575}
"""Shares of the slides. As many to train on as in one repetition of the grid; the others are tests:
the accuracy on the 43 test slides of one repetition is uncertain by 1.7 points (95 %)."""
TOUCHES = 8
"""Touches whose mean is depth zero."""


ONSETS: dict[Onset, str] = {"paper": "2 pixels (paper)", "change_point": "change point"}


@dataclass(frozen=True)
class StudyFigure:
    """A figure of a study.

    Attributes:
        title: with its unit.
        experiment: that its test trials are of.
        time: the attribute of `TrialLatency` whose median it is; None: strict accuracy.
    """

    title: str
    experiment: str
    time: str | None


FIGURES = {
    "accuracy": StudyFigure("accuracy (%)", "kinematic", None),
    "kinematic": StudyFigure("slides, incipient (ms)", "kinematic", "latency_incipient_ms"),
    "gross": StudyFigure("slides, gross (ms)", "kinematic", "latency_gross_ms"),
    "gravity": StudyFigure("gravity, incipient (ms)", "gravity", "latency_incipient_ms"),
    "gravity_lead": StudyFigure("gravity, lead (ms)", "gravity", "lead_ms"),
    "disturbance": StudyFigure(
        "disturbance, incipient (ms)", "disturbance", "latency_incipient_ms"
    ),
    "disturbance_lead": StudyFigure("disturbance, lead (ms)", "disturbance", "lead_ms"),
}
POINTS, SHARE = 1.0, 0.1
"""Largest difference of accuracy and, relative, of each median."""
STEP_MS: dict[Onset, float] = {"paper": 10.0, "change_point": 0.0}
"""That latencies and leads are known in: the frames' period, or none."""


def shipped(
    name: str,
    folder: Path,
    repetitions: int | None = None,
    networks: int = 1,
    split: Mapping[str, float] | None = None,
) -> Path:
    """Write a shipped protocol as it is used here; the paper's network is left out.

    Args:
        repetitions, split: in place of the shipped ones.
    """
    source = ROOT / f"protocols/{name}.yaml"
    data = parse_yaml(source.read_text(), source)
    if repetitions is not None:
        data["collection"]["repetitions"] = repetitions
    data["collection"]["maintenance"]["rezero"]["touches"] = TOUCHES
    data["analysis"].pop("also", None)
    if name == "kinematic":
        data["analysis"]["split"].update(split or {})
        data["analysis"]["training"]["seeds"] = list(range(networks))
    path = folder / f"{name}.yaml"
    path.write_text(rig_yaml(data))
    return path


def protocols(folder: Path, networks: int, whole_grid: bool) -> list[Path]:
    """Write the protocols of a study that trains so many networks."""
    folder.mkdir(exist_ok=True)
    if whole_grid:
        return [shipped("kinematic", folder, networks=networks)]
    return [shipped(name, folder, count, networks, SPLIT) for name, count in REPETITIONS.items()]


def medians_ms(times: FloatArray, step_ms: float = 0.0) -> FloatArray:
    """Return medians over the last axis of times, NaN left out; NaN of none.

    Args:
        step_ms: that times are known in. Within its step, the median lies where as many of the
            step's values would lie below it as half of all values leave, if they were spread
            evenly (`statistics.median_grouped`).
    """
    there = np.sort(np.round(times) if step_ms else times, axis=-1)  # NaN last
    n = np.isfinite(there).sum(axis=-1, keepdims=True)
    last = there.shape[-1] - 1
    middle = np.take_along_axis(there, np.minimum(n // 2, last), axis=-1)
    if not step_ms:
        before = np.take_along_axis(there, np.maximum(n - 1, 0) // 2, axis=-1)
        return (0.5 * (before + middle))[..., 0]
    below, equal = (
        compare(there, middle).sum(axis=-1, keepdims=True) for compare in (np.less, np.equal)
    )
    with np.errstate(invalid="ignore"):  # 0 of 0 values
        return (middle + step_ms * ((n / 2 - below) / equal - 0.5))[..., 0]


def hidden_rig(folder: Path, assumed: Path, seed: int, number: int) -> Path:
    """Write the rig file of a hidden world."""
    prior = replace(prior_of(CLEAN, seed), rig=load_rig_file(assumed)[0])
    world = prior.world(number, pilot_slides()).rig
    data = {
        "extends": str(assumed),
        "name": "hidden",
        "mock": scene_of(world).model_dump(mode="json"),
        # a lab measures it
        "calibration": {"touch_depth": f"{touch_depth_mm(world):.3f} mm"},
    }
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
    retained = store.folder / "derived/scene-worlds"
    copytree(worlds, retained, dirs_exist_ok=True)
    try:
        fitting = prior_of(BANK, asked.seed)
        wanted = request(assumed, twin, asked.bank, fitting.spread, fitting.seed)
        fitted = calibrate_scene(store, item, replace(wanted, needs=False))
        STUDY.write(finding(twin, *fitted))
    finally:
        copytree(retained, worlds, dirs_exist_ok=True)
    return twin


@dataclass(frozen=True)
class TrainedStudy:
    """Labelled trials of a study, and the networks that it trained."""

    store: TrialStore
    campaigns: list[Collected]
    networks: list[Fitted]

    def outcomes(self, networks: Sequence[Fitted]) -> Outcomes:
        """Test networks on the study's test trials, by its protocols' rules."""
        rules = rules_of(self.campaigns, networks[0].network.outputs_per_class)
        labels = StoreLabels(self.store)
        references = {
            (item.name, trial.id): references_of(recording, labels.read(item, recording))
            for item in self.campaigns
            for trial, recording in item.of_split("test")
        }
        judged = [judge(it, rules, self.store, self.campaigns) for it in networks]
        decisions = [decisions_of(it.rows, references, rules) for it in judged]
        return {onset: NetworkOutcome.of(judged, decisions, onset) for onset in ONSETS}

    @cached_property
    def samples(self) -> SampleSet:
        """The windows of the study's test slides."""
        return load_samples(StoreLabels(self.store), training_campaigns(self.campaigns), "test")

    def windows(self, networks: Sequence[Fitted]) -> NetworkOutcome:
        """Test networks on the windows of the study's test slides; there are no times."""
        judged = [
            EvaluatedTrials(predict_counts(it, self.samples.windows), self.samples, [])
            for it in networks
        ]
        return NetworkOutcome.of(judged, [()] * len(judged), "paper")


def studied(rig: Path, files: Sequence[Path], folder: Path) -> TrainedStudy:
    """Take, label and train what is missing of a study."""
    store, campaigns = retake([make_request(file, rig, folder) for file in files])
    train(store, campaigns)
    models = wanted_models(store, campaigns)
    return TrainedStudy(store, campaigns, [model_file.load(it.path) for it in models])


@dataclass(frozen=True)
class NetworkOutcome:
    """What several networks make of the same test trials.

    Attributes:
        values: by figure, a row for each network and a column for each trial: ms, NaN where no time
            is counted; of the accuracy, windows that it classified correctly.
        windows: of each slide.
        step_ms: that times are known in.
    """

    values: dict[str, pd.DataFrame]
    windows: pd.Series[float]
    step_ms: float

    @classmethod
    def of(
        cls, judged: Sequence[EvaluatedTrials], decisions: Sequence[Sequence[Decided]], onset: Onset
    ) -> NetworkOutcome:
        """Collect what networks made of the trials of one store.

        Args:
            decisions: of each network on each trial.
            onset: that times count from.
        """
        slides = [it.hits_by_trial(False) for it in judged]
        windows = {trial: count for trial, (_, count) in slides[0].items()}
        values = {}
        for name, figure in FIGURES.items():
            if figure.time is None:
                rows = [{trial: hits for trial, (hits, _) in it.items()} for it in slides]
            else:
                rows = [
                    {
                        row.trial: getattr(decided.latency(onset), figure.time, None)
                        for row, decided in zip(it.rows, decided_by, strict=True)
                        if row.experiment == figure.experiment
                    }
                    for it, decided_by in zip(judged, decisions, strict=True)
                ]
            values[name] = pd.DataFrame(rows, dtype=np.float64)
        return cls(values, pd.Series(windows, dtype=np.float64), STEP_MS[onset])

    def drawn(
        self, name: str, trials: pd.Index[str], networks: IntArray, picked: IntArray
    ) -> FloatArray:
        """Return a figure of `FIGURES` of draws of networks and trials, the mean over networks.

        Args:
            trials: that are drawn from; one that is not here counts for nothing.
            networks, picked: indices of each draw, (draws, k) and (draws, n).

        Returns:
            (draws,); NaN where a network has no time.
        """
        values = self.values[name].reindex(columns=trials).to_numpy()
        values = values[networks[:, :, None], picked[:, None, :]]
        if name == "accuracy":
            windows = self.windows.reindex(trials, fill_value=0.0).to_numpy()[picked].sum(axis=1)
            return np.asarray(100.0 * np.nansum(values, axis=2).mean(axis=1) / windows)
        return np.asarray(medians_ms(values, self.step_ms).mean(axis=1))

    def figure(self, name: str) -> float:
        """Return a figure of `FIGURES`, the mean over networks; NaN where one has no time."""
        values = self.values[name]
        k, n = values.shape
        if not n:
            return math.nan
        return float(self.drawn(name, values.columns, np.arange(k)[None], np.arange(n)[None])[0])

    def figures(self) -> dict[str, float | None]:
        """Return all figures; None where there are no times."""
        found = {name: self.figure(name) for name in FIGURES}
        return {name: None if math.isnan(value) else value for name, value in found.items()}

    def against(self, own: NetworkOutcome, name: str) -> tuple[float, float] | None:
        """Return the 95 % interval of how far a figure lies from `own`'s: points, or a share.

        Trials of both are drawn again together, since they have the same chance, and so are the
        networks of each; None where there are no times.
        """
        here, there = self.values[name], own.values[name]
        trials = there.columns.union(here.columns, sort=False)
        if trials.empty:
            return None
        picked = drawn(len(trials))
        a = self.drawn(name, trials, drawn(len(here), 1), picked)
        b = own.drawn(name, trials, drawn(len(there), 2), picked)
        found = a - b if name == "accuracy" else a / b - 1.0
        known = found[np.isfinite(found)]
        if not len(known):
            return None
        low, high = np.quantile(known, (0.025, 0.975))
        return float(low), float(high)


Outcomes = Mapping[Onset, NetworkOutcome]


def compared(found: NetworkOutcome, own: NetworkOutcome) -> dict[str, Any]:
    """Return the figures of a study, and how far each is from the hidden world's own."""
    return {
        "figures": found.figures(),
        "spans": {name: found.against(own, name) for name in FIGURES},
    }


def within(own: Mapping[str, Any], other: Mapping[str, Any]) -> dict[str, bool]:
    """Return which figures of a study are as near to a hidden world's own as they should be."""
    found = {}
    for name in FIGURES:
        a, b = own[name], other[name]
        most = POINTS if name == "accuracy" else SHARE * abs(a or 0.0)
        found[name] = a is not None and b is not None and abs(a - b) <= most
    return found


def beyond(spans: Mapping[str, Any]) -> dict[str, bool]:
    """Return which figures differ by more than they should by their whole 95 % interval."""
    found = {}
    for name, span in spans.items():
        most = POINTS if name == "accuracy" else SHARE
        found[name] = span is not None and (span[0] > most or span[1] < -most)
    return found


def world_row(
    asked: argparse.Namespace,
    number: int,
    files: Sequence[Path],
    hidden_files: Sequence[Path],
    assumed: TrainedStudy,
    usual: Outcomes,
) -> dict[str, Any]:
    """Do everything of one hidden world; return its figures.

    Args:
        files: the protocols.
        hidden_files: those of the hidden world, which may ask for further networks.
        assumed, usual: the study on the rig as it was, and its outcome.
    """
    folder: Path = asked.folder / f"world{number}"
    folder.mkdir(exist_ok=True)
    hidden = hidden_rig(folder, asked.folder / "assumed.yaml", asked.seed, number)
    twin = studied(calibrated(asked, folder, hidden), files, folder / "twin")
    own = studied(hidden, hidden_files, folder / "hidden")
    further = own.networks[asked.networks :]
    own = replace(own, networks=own.networks[: asked.networks])
    first = own.outcomes(own.networks)
    outcomes = {
        "twin": twin.outcomes(twin.networks),
        "assumed": usual,
        "twin, hidden world's networks": twin.outcomes(own.networks),
    }
    on_hidden = {"twin": own.windows(twin.networks), "assumed": own.windows(assumed.networks)}
    if further:
        found = own.outcomes(further)
        outcomes["hidden, further networks"] = found
        on_hidden["hidden, further networks"] = found["paper"]
    studies = {
        onset: {"hidden": {"figures": first[onset].figures()}}
        | {name: compared(found[onset], first[onset]) for name, found in outcomes.items()}
        for onset in ONSETS
    }
    networks = {
        name: {"accuracy": it.figure("accuracy"), "span": it.against(first["paper"], "accuracy")}
        for name, it in {"hidden": first["paper"], **on_hidden}.items()
    }
    return {"world": number, "studies": studies, "networks": networks}


def lines(rows: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Yield tables of all worlds in Markdown, and summaries."""
    for onset, title in ONSETS.items():
        yield f"Times from the onset by: {title}"
        yield ""
        yield from tables({row["world"]: row["studies"][onset] for row in rows})
        yield ""
    yield "| world | networks trained on | accuracy on the hidden world (%) | behind by | 95 % |"
    yield "| --- | --- | --- | --- | --- |"
    for row in rows:
        first = row["networks"]["hidden"]["accuracy"]
        for name, network in row["networks"].items():
            behind, (low, high) = first - network["accuracy"], network["span"]
            text = f"{network['accuracy']:.1f} | {behind:.1f} | {-high:.1f} to {-low:.1f}"
            yield f"| {row['world']} | {name} | {text} |"


def tables(worlds: Mapping[int, Mapping[str, Any]]) -> Iterator[str]:
    """Yield tables of the studies on each world, with times from one onset."""
    every_study = [study["figures"] for studies in worlds.values() for study in studies.values()]
    known = [name for name in FIGURES if any(it[name] is not None for it in every_study)]
    titles = " | ".join(FIGURES[name].title for name in known)
    yield f"| world | study on | {titles} | within |"
    yield "| --- | --- |" + " --- |" * (len(known) + 1)
    near: dict[str, list[dict[str, bool]]] = {}
    far: dict[str, list[dict[str, bool]]] = {}
    for number, studies in worlds.items():
        own = studies["hidden"]["figures"]
        for name, study in studies.items():
            found, stated = study["figures"], ""
            cells = ["-" if found[key] is None else f"{found[key]:.1f}" for key in known]
            if name != "hidden":
                near_by = within(own, found)
                held = {key: near_by[key] for key in known}
                near.setdefault(name, []).append(held)
                far.setdefault(name, []).append(beyond(study["spans"]))
                stated = f"{sum(held.values())} of {len(held)}"
            yield f"| {number} | {name} | {' | '.join(cells)} | {stated} |"
    for title, counted, every in (
        (f"within {POINTS:g} point, or {100 * SHARE:g} %", near, "all"),
        ("whole 95 % interval beyond that", far, "none"),
    ):
        yield ""
        yield f"| {title} | {titles} | {every} |"
        yield "| --- |" + " --- |" * (len(known) + 1)
        for name, each in counted.items():
            counts = [sum(held[key] for held in each) for key in known]
            whole = all if every == "all" else lambda found: not any(found)
            counts.append(sum(whole(found.values()) for found in each))
            yield f"| {name} | {' | '.join(f'{count} of {len(each)}' for count in counts)} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--worlds", type=int, default=3)
    parser.add_argument("--first", type=int, default=0, help="number of the first world")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--bank", type=int, default=240, help="worlds that fits simulate")
    parser.add_argument("--networks", type=int, default=2, help="networks of each study")
    parser.add_argument("--again", action="store_true", help="and as many of the hidden world's")
    parser.add_argument("--whole-grid", action="store_true", help="the shipped grid, and it alone")
    asked = parser.parse_args()
    asked.folder = asked.folder.resolve()
    (asked.folder / "scene-worlds").mkdir(parents=True, exist_ok=True)
    orchestration.configure_prefect(asked.folder)
    (asked.folder / "assumed.yaml").write_text(rig_yaml(ASSUMED))
    files = protocols(asked.folder, asked.networks, asked.whole_grid)
    hidden_networks = asked.networks * (2 if asked.again else 1)
    hidden_files = protocols(asked.folder / "hidden", hidden_networks, asked.whole_grid)
    retained = asked.folder / "rows.json"
    rows = read_json(retained)["rows"] if retained.exists() else []
    assumed = studied(asked.folder / "assumed.yaml", files, asked.folder / "assumed")
    usual = assumed.outcomes(assumed.networks)
    for number in range(asked.first, asked.first + asked.worlds):
        if number in [row["world"] for row in rows]:
            continue
        try:
            rows.append(world_row(asked, number, files, hidden_files, assumed, usual))
        except RigError as error:
            print(f"world {number} cannot be collected: {error}")
            continue
        write_json(retained, {"simulated": True, "rows": rows})
    print("\n".join(lines(rows)))


if __name__ == "__main__":
    main()
