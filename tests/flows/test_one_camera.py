"""A study on a rig with one camera ends in a report that says what it cannot say."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import yaml

from sliplab.analysis.campaigns import collected
from sliplab.flows.collect import collect
from sliplab.flows.evaluate import evaluate
from sliplab.flows.label import label
from sliplab.flows.planning.run_request import make_request
from sliplab.flows.report import against, read_one_camera, report
from sliplab.flows.running.console import plain
from sliplab.flows.study import StudyOutcome, study
from sliplab.flows.study_ledger import LEFT_OUT
from sliplab.flows.train import train
from sliplab.storage.trials.store import StoreError, TrialStore
from tests.analysis.report.test_plugin_sections import install
from tests.conftest import ROOT
from tests.flows.conftest import summary_json, tiny, tiny_gravity, write
from tests.protocols.test_plugin import installed

__all__ = ["installed"]  # a fixture

pytestmark = pytest.mark.programs
STEPS = {"sync", "label", "train", "evaluate", "report"}
"""Those after collection that need no events."""


def rig_with(camera: str, folder: Path) -> Path:
    """The rig for rehearsals with one camera."""
    rig = yaml.safe_load((ROOT / "rigs" / "rehearsal.yaml").read_text())
    rig["extends"] = str(ROOT / "rigs" / rig["extends"])
    return write(folder / "rig.yaml", {**rig, "name": f"one-{camera}", "cameras": [camera]})


def take(camera: str, folder: Path) -> tuple[TrialStore, StudyOutcome]:
    """Three slides and two plates, from protocol to report."""
    slides = tiny()
    slides["collection"]["factors"]["direction"]["values"] = [0, 120, 240]
    slides["analysis"]["split"] = {
        "method": "leave_conditions_out",
        "validation_levels": {"direction": ["120 deg"]},
        "test_levels": {"direction": ["240 deg"]},
    }
    slides["analysis"].setdefault("training", {})["seeds"] = [0, 1] if camera == "frames" else [0]
    protocols = [
        write(folder / "tiny.yaml", slides),
        write(folder / "tiny_gravity.yaml", tiny_gravity()),
    ]
    path = rig_with(camera, folder)
    requests = [make_request(protocol, path, folder / "store") for protocol in protocols]
    outcome = study(requests, check=2, holdout=3)
    return TrialStore.open(requests[0].store), outcome


@pytest.fixture(scope="module")
def studied(
    tmp_path_factory: pytest.TempPathFactory,
) -> Callable[[str], tuple[TrialStore, StudyOutcome]]:
    """The study of each camera, made when it is first asked for."""
    return cache(lambda camera: take(camera, tmp_path_factory.mktemp(camera)))


Take = Callable[[str], TrialStore]


@pytest.fixture
def taken(studied: Callable[[str], tuple[TrialStore, StudyOutcome]], tmp_path: Path) -> Take:
    """A copy of a camera's store, to be changed at will."""

    def copied(camera: str) -> TrialStore:
        return TrialStore.open(shutil.copytree(studied(camera)[0].folder, tmp_path / "store"))

    return copied


@pytest.mark.parametrize("camera", [pytest.param("events", marks=pytest.mark.long), "frames"])
def test_a_study_with_one_camera_runs_to_its_report(
    camera: str, studied: Callable[[str], tuple[TrialStore, StudyOutcome]]
) -> None:
    store, outcome = studied(camera)
    states = {row.name: (row.state, row.note) for row in outcome.rows}
    json.dumps([outcome.steps, outcome.collected], default=plain, allow_nan=False)  # as --json
    missing = {"events": "frames", "frames": "events"}[camera]
    for name, (state, note) in states.items():
        possible = camera == "events" or name.startswith("collect") or name in STEPS
        assert (state == LEFT_OUT) != possible, name
        if not possible:
            assert missing in note
    assert {"train", "evaluate", "holdout"} <= states.keys()

    summary = read_one_camera(store)
    assert (summary.simulated, summary.one_camera) == (True, camera)
    assert summary.quality.committed == 5
    assert summary.labels is not None
    assert (summary.event_rates is None) == (camera == "frames")
    left_out = [each.name for each in summary.left_out]
    page = (store.folder / "report" / "index.html").read_text()
    assert "Every number and figure in this report is simulated." in page
    assert "What this report leaves out" in page
    assert "Accuracy of the labels" in page
    assert left_out == []
    if camera == "events":
        assert summary.labels.source == {"video": 0, "tracks": 0, "events": 5}
        errors = summary.labels.error_ms
        assert (errors.incipient.n, errors.gross.n) == (3, 3)
        assert max(errors.incipient.max_abs or 0.0, errors.gross.max_abs or 0.0) < 100
        assert "the plate moves by itself" in page
        assert summary.kinematic.accuracy.n > 50
        assert summary.kinematic.latency_ms.incipient.n >= 0
        assert summary.gravity.accounted.without_onsets == 2
        assert summary.kinematic.work is not None
        assert "Window accuracy" in page or "window accuracy" in page
        for rate in (summary.event_rates or {}).values():
            assert rate.motion > rate.hold > 0
        assert "Onsets of slip are read from the events of the" in page
        assert (store.folder / "report" / "figures" / "event-rates.svg").exists()
    else:
        assert summary.classifier is not None
        assert summary.kinematic.samples.test > 50
        assert summary.kinematic.accuracy.strict > 0.8
        assert summary.kinematic.work is None
        assert len(summary.trials) == 3
        assert summary.gravity is not None
        for experiment in (summary.kinematic, summary.gravity):
            (chosen,) = (it for it in experiment.by_seed if it.chosen)
            assert sorted(it.seed for it in experiment.by_seed) == [0, 1]
            assert chosen.latency_ms == experiment.latency_ms
            assert chosen.lead_ms == experiment.lead_ms
            assert f"{chosen.seed}, shown above" in page
        assert "The classifier on marker displacements" in page
        assert "no clock lies between them" in page
        assert summary.labels.error_ms.incipient.n == 5
        assert summary.labels.error_ms.incipient.max_abs < 25
        assert "Top: frames a second." in page
    assert "spiking network and its detectors" in page or camera == "events"
    assert (store.folder / "report" / "figures" / "confusion.svg").exists()


@pytest.mark.long  # as in `test_report`
def test_sections_of_other_packages_stand_in_the_report(
    installed: Any, taken: Take, tmp_path: Path
) -> None:
    store = taken("frames")
    install(installed, tmp_path, "lab_rubs")
    assert report(store, collected(store))["done"] == 1
    assert report(store, collected(store))["done"] == 0
    assert "<p>7 rubs, simulated</p>" in (store.folder / "report" / "index.html").read_text()
    assert (store.folder / "report" / "figures" / "rubs-force.svg").exists()


@pytest.mark.long
def test_training_and_evaluation_repeat_and_say_what_is_stale(taken: Take) -> None:
    """The same bytes and figures from the same seed; nothing is made twice."""
    store = taken("frames")
    campaigns = collected(store)
    model = store.folder / "models" / "markers-seed0.model"
    first, before = model.read_bytes(), summary_json(store)
    assert b"multilayer perceptron on marker displacements" in first
    assert train(store, campaigns)["done"] == 0
    assert evaluate(store, campaigns)["done"] == 0
    assert report(store, campaigns)["done"] == 0

    model.unlink()
    with pytest.raises(StoreError, match="missing or stale"):
        evaluate(store, campaigns)
    assert report(store, campaigns)["done"] == 1
    without = read_one_camera(store)
    assert without is not None
    assert [each.name for each in without.left_out] == ["train", "evaluate"]
    assert without.kinematic is None

    assert train(store, campaigns)["done"] == 1
    assert model.read_bytes() == first
    assert evaluate(store, campaigns)["done"] == 0
    assert report(store, campaigns)["done"] == 1
    after = summary_json(store)
    assert before.pop("timing_s").keys() == after.pop("timing_s").keys()
    assert before == after

    assert evaluate(store, campaigns, margin=90.0)["done"] == 1
    report(store, campaigns)
    summary = read_one_camera(store)
    assert summary is not None
    assert {rule.margin for rule in summary.detection.values()} == {90.0}
    assert {rule.choose for rule in summary.detection.values()} == {"protocol"}


@pytest.mark.long
def test_a_report_on_events_says_which_steps_are_still_to_do(taken: Take) -> None:
    store = taken("events")
    campaigns = collected(store)
    for name, then in (("evaluation", ["train", "evaluate"]), ("labels", ["label"])):
        shutil.rmtree(store.folder / "derived" / name)
        assert report(store, campaigns)["done"] == 1
        summary = read_one_camera(store)
        assert summary is not None
        assert [each.name for each in summary.left_out][: len(then)] == then
        assert all("not done yet; run `sliplab" in each.reason for each in summary.left_out)
        assert summary.kinematic is None
        assert (summary.labels is None) == (name == "labels")


def test_a_report_on_one_camera_shows_reference_trials(tmp_path: Path) -> None:
    """Of frames, the time to the first slip; there is no rate of events."""
    slides = tiny()
    condition = {"depth": 2.4, "speed": 1.6, "direction": 0}
    slides["collection"]["references"] = {"every": 2, "condition": condition}
    path = rig_with("frames", tmp_path)
    request = make_request(write(tmp_path / "tiny.yaml", slides), path, tmp_path / "store")
    collect(request)
    store = TrialStore.open(request.store)
    campaigns = collected(store)
    label(store, campaigns)
    report(store, campaigns)
    summary = read_one_camera(store)
    found = summary.references["tiny"]
    assert len(found.trials) >= 3
    assert all(trial.hold_events_per_s is None for trial in found.trials)
    assert all(trial.first_slip_ms is not None for trial in found.trials)
    assert found.wear.keys() == {"first_slip_ms"}
    page = (store.folder / "report" / "index.html").read_text()
    assert "No campaign has reference trials" not in page
    assert "time to the first slip" in page


@pytest.mark.long
def test_the_report_is_made_again_only_when_something_changed(
    studied: Callable[[str], tuple[TrialStore, StudyOutcome]],
) -> None:
    store, _ = studied("events")
    assert {each.beyond for each in against(store, store.folder)[0].figures} <= {False, None}
    assert report(store, collected(store))["done"] == 0
    before = summary_json(store)
    (store.folder / "report" / "index.html").unlink()
    assert report(store, collected(store))["done"] == 1
    after = summary_json(store)
    assert before.pop("timing_s").keys() == after.pop("timing_s").keys()
    assert before == after


def test_a_report_on_frames_is_compared(taken: Take) -> None:
    store = taken("frames")
    figures = against(store, store.folder)[0].figures
    assert {"trials committed", "labels: gross, median distance from the truth"} <= {
        each.name for each in figures
    }
    assert {each.beyond for each in figures} <= {False, None}
