"""The whole chain on a small campaign: right, honest, and stale only where something changed."""

from __future__ import annotations

import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sliplab.analysis.campaigns import collected, training_campaigns
from sliplab.analysis.evaluation import baselines as window_baselines
from sliplab.analysis.labels.label_errors import read_check
from sliplab.analysis.labels.reviewed import StoreLabels
from sliplab.analysis.metrics.classification import CLASSES
from sliplab.analysis.networks import training
from sliplab.analysis.networks.window_checks import Chance
from sliplab.analysis.windows.dataset import recorded_span
from sliplab.analysis.windows.sample_sets import by_id, load_samples, split_trials
from sliplab.flows import window_checks as check_flows
from sliplab.flows.collect import collect
from sliplab.flows.evaluate import evaluate
from sliplab.flows.label import check_folder, check_labels, check_required
from sliplab.flows.planning.run_request import make_request
from sliplab.flows.report import report
from sliplab.flows.running import parallel_map
from sliplab.flows.running.extras import lacking
from sliplab.flows.study import study
from sliplab.flows.train import train
from sliplab.protocols.errors import InputError
from sliplab.storage.files import write_bytes
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.store import StoreError, TrialStore
from tests.flows.conftest import Ran, summary_json, tiny, tiny_gravity, write


def store_of(ran: Ran) -> TrialStore:
    """The study's store."""
    return TrialStore.open(ran[0][0].store)


def test_every_step_did_its_work(ran: Ran) -> None:
    _, outcome = ran
    assert [item["committed"] for item in outcome.collected] == [6, 2]
    assert [(step["step"], step["done"]) for step in outcome.steps] == [
        ("sync", 8),
        ("label", 8),
        ("train", 2),
        ("evaluate", 1),
        ("report", 1),
    ]


def test_labels_are_within_a_frame_of_the_truth(ran: Ran) -> None:
    errors = summary_json(store_of(ran))["labels"]["error_ms"]
    for kind in ("incipient", "gross"):
        assert errors[kind]["n"] >= 7
        assert errors[kind]["median_abs"] <= 10.0


@pytest.mark.long
def test_labels_of_tracks_are_checked_with_video(ran: Ran, tmp_path: Path) -> None:
    run_request = replace(ran[0][0], store=tmp_path / "store")
    shutil.copytree(store_of(ran).folder, run_request.store)
    assert check_required(run_request)
    assert check_labels(run_request, 2)["done"] == 2
    found = read_check(TrialStore.open(run_request.store))
    assert (found.trials, found.simulated) == (2, True)
    incipient = found.model_dump(mode="json")["rules_ms"]["paper"]["incipient"]
    assert incipient["n"] == 2
    assert incipient["max_abs"] < 25.0  # the true onset to within 2.5 frames
    (first, second) = (
        TrialStore.open(check_folder(run_request)).campaign(run_request.campaign).committed()
    )
    assert {first, second} <= {trial.id for trial in run_request.plan}
    assert check_labels(run_request, 2)["done"] == 0
    assert check_labels(run_request, 3)["done"] == 1


def test_the_summary_has_its_keys_and_says_simulated(ran: Ran) -> None:
    summary = summary_json(store_of(ran))
    assert summary["simulated"] is True
    kinematic = summary["kinematic"]
    assert set(kinematic["accuracy"]) == {"argmax", "strict", "margin", "n"}
    assert np.shape(kinematic["confusion"]) == (3, 4)
    assert set(kinematic["precision"]) == set(kinematic["recall"]) == set(CLASSES)
    for kind in ("incipient", "gross"):
        latency = kinematic["latency_ms"][kind]
        counted = (latency[name] for name in ("n", "missed", "late", "false_early"))
        assert sum(counted) == 2
        assert {"mean", "std", "median", "p95", "min", "max"} <= set(latency)
    lead = summary["gravity"]["lead_ms"]
    assert sum(lead[name] for name in ("n", "missed", "late", "false_early")) == 2
    assert {"min", "mean", "std", "median", "detected_first"} <= set(lead)
    assert summary["disturbance"]["trials"] == 0
    assert summary["labels"]["source"] == {"video": 0, "tracks": 8}
    for campaign, trials in (("tiny", 6), ("tiny_gravity", 2)):
        held = summary["labels"]["holds"][campaign]
        assert (held["trials"], held["slipped"], held["limit_px"]) == (trials, 0, 1.0)
        assert held["most_px"] < 0.1
        assert held["apart_ms"]["incipient"]["n"] == trials
        assert held["apart_ms"]["incipient"]["max_abs"] <= 10.0  # a frame, by noise
    assert summary["sync"]["grade"] == "hardware trigger"
    none = dict.fromkeys(("retaken", "quarantined", "interrupted"), 0)
    assert summary["quality"] == {"planned": 8, "committed": 8, **none}
    assert {"collect tiny", "label", "train", "evaluate", "report"} <= set(summary["timing_s"])
    assert set(summary["protocols"]) == {"tiny", "tiny_gravity"}
    assert summary["seeds"]["network"] == [0]


def test_plan_and_collection_agree(ran: Ran) -> None:
    for known in summary_json(store_of(ran))["planned"].values():
        assert known["seconds_collected"] == pytest.approx(known["seconds"], rel=0.1)
        # without a video these are events, and the plan reckons with the mean of all conditions;
        # what frames take is held to a quarter in test_levels
        assert 0.5 < known["bytes_collected"] / known["bytes"] < 2.0


def test_the_report_is_one_page_that_says_simulated(ran: Ran) -> None:
    text = (store_of(ran).folder / "report" / "index.html").read_text()
    assert "Every number and figure in this report is simulated" in text
    assert text.count("simulated tracks of the markers (no video was drawn)") >= 3
    assert "the video" not in text
    assert '<a href="sync.html">' in text
    assert (store_of(ran).folder / "report" / "sync.html").exists()
    assert text.count("Frames: hardware trigger; events against them within") == 2
    assert "No wire ties" not in text
    assert text.count("<svg") >= 7
    assert text.count(">simulated</text>") == text.count("<figure")
    for outside in ("http://", "https://", "src="):
        found = [line for line in text.splitlines() if outside in line]
        assert all("xmlns" in line or "DTD" in line or "purl.org" in line for line in found)


def test_nothing_changed_is_nothing_to_do(ran: Ran) -> None:
    result = collect(ran[0][0])
    assert (result["taken"], result["committed"], result["missing"]) == (0, 6, 0)
    again = study(ran[0])
    assert [item["taken"] for item in again.collected] == [0, 0]
    assert [step["done"] for step in again.steps] == [0, 0, 0, 0, 0]


@pytest.mark.long
def test_another_margin_is_evaluation_and_report_only(
    ran: Ran, tmp_path: Path, rig_path: Path
) -> None:
    store = store_of(ran)
    counts = Derived.of(store, "counts", "tiny").folder
    before = {path: path.stat().st_mtime_ns for path in counts.iterdir()}
    data: dict[str, Any] = tiny()
    data["analysis"]["detection"]["margin"] = 3.0
    run_requests = [
        make_request(write(tmp_path / "p.yaml", data), rig_path, store.folder),
        ran[0][1],
    ]
    outcome = study(run_requests)
    done = [(step["step"], step["done"]) for step in outcome.steps]
    undone = [(name, 0) for name in ("sync", "label", "train")]
    assert done == [*undone, ("evaluate", 1), ("report", 1)]
    assert before == {path: path.stat().st_mtime_ns for path in counts.iterdir()}
    assert summary_json(store)["detection"]["tiny"]["margin"] == 3.0
    study(ran[0])  # back to what the other tests know


def test_windows_are_looked_at_from_every_side(ran: Ran) -> None:
    summary = summary_json(store_of(ran))
    kinematic = summary["kinematic"]
    n = kinematic["accuracy"]["n"]
    strict = kinematic["accuracy"]["strict"]
    assert kinematic["interval"]["share"] == pytest.approx(strict)
    assert kinematic["interval"]["trials"] == 2
    assert sum(row["n"] for row in kinematic["reliability"]) == n
    assert sum(row["right"] for row in kinematic["reliability"]) == pytest.approx(strict * n)
    assert sum(row["errors"] for row in kinematic["by_trial"]) == pytest.approx((1 - strict) * n)
    for rows in kinematic["by_factor"].values():
        assert sum(row["n"] for row in rows.values()) == n
        assert sum(row["n"] * row["share"] for row in rows.values()) == pytest.approx(strict * n)
    assert set(kinematic["by_factor"]["direction"]) == {"240 deg", "300 deg"}
    classes = np.sum(kinematic["confusion"], axis=1)
    for name, size in zip(CLASSES, classes, strict=True):
        assert sum(row["n"] for row in kinematic["by_tenth"][name]) == size
    assert sum(part["n"] for part in kinematic["no_slip"].values()) == classes[0]
    # no slip is sampled up to the first slip, gross slip from its onset on
    assert kinematic["by_tenth"]["no_slip"][9]["n"] > 0
    assert kinematic["by_tenth"]["gross"][0]["n"] > 0
    work = kinematic["work"]
    assert work["n"] == n
    assert 0 < work["share"] < 0.2
    assert kinematic["seeds"]["each"][0]["strict"] == strict
    for name, row in kinematic["beside"].items():
        assert row["argmax"] == pytest.approx(kinematic["baselines"][name])
        ahead = kinematic["accuracy"]["argmax"] - row["argmax"]
        assert row["network_ahead"]["share"] == pytest.approx(ahead)
    assert kinematic["trained_baselines"] == {}


def test_no_window_of_a_test_trial_is_near_a_training_window(ran: Ran) -> None:
    """Neighbours on a time line are alike: parts must have no trial, so no time line, in common."""
    store = store_of(ran)
    used = training_campaigns(collected(store))
    found: dict[str, set[tuple[str, str]]] = {}
    for split in ("train", "validation", "test"):
        samples = load_samples(StoreLabels(store), used, split)
        known, of = by_id(split_trials(used, split)), samples.trial
        for k in np.unique(of).tolist():
            item, trial, recording = known[samples.trials[k]]
            start, end = recorded_span(recording)
            times = samples.start_ns[of == k]
            assert start <= times.min()
            assert times.max() < end
            found.setdefault(split, set()).add((item.name, trial.id))
    assert [len(trials) for trials in found.values()] == [2, 2, 2]
    assert len(set.union(*found.values())) == 6


@pytest.mark.long
def test_other_methods_are_kept_and_the_report_tells_of_them(
    ran: Ran, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = store_of(ran)
    campaigns = collected(store)
    monkeypatch.setattr(window_baselines, "NAMES", {"logistic_cells": 1, "cnn_frame": 1})
    first = check_flows.window_baselines(store, campaigns)
    assert (first["done"], first["fresh"]) == (2, 0)
    assert check_flows.window_baselines(store, campaigns)["done"] == 0
    assert report(store, campaigns)["done"] == 1
    kinematic = summary_json(store)["kinematic"]
    for name, share in first["argmax"].items():
        assert kinematic["trained_baselines"][name]["argmax"] == pytest.approx(share)
    text = (store.folder / "report" / "index.html").read_text()
    assert "ordinary convolutions on the summed frame" in text
    assert "Saving:" in text
    assert "Cost: the best other method" in text
    for path in (store.folder / "derived" / "baselines").iterdir():
        path.unlink()
    assert report(store, campaigns)["done"] == 1


def test_a_device_that_is_not_there_is_a_wrong_input(
    ran: Ran, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = store_of(ran)
    monkeypatch.setattr("sliplab.analysis.networks.models.ModelOnDisk.fresh", False)
    monkeypatch.setattr("sliplab.analysis.networks.gradients.devices", lambda: ["cuda", "cuda:0"])
    with pytest.raises(
        InputError,
        match=r"analysis\.training\.device = cpu: not available here; must be one of cuda, cuda:0",
    ):
        train(store, collected(store))


def test_a_check_that_fails_ends_the_command(ran: Ran, monkeypatch: pytest.MonkeyPatch) -> None:
    store = store_of(ran)
    campaigns = collected(store)
    fair = Chance((0.3, 0.36), 0.2, 0.45, 0.8, 0.999)
    monkeypatch.setattr(check_flows, "shuffled_chance", lambda *_: fair)
    assert check_flows.window_checks(store, campaigns)["orders"] == 6
    leak = Chance((0.9, 0.91), 0.85, 0.95, 0.92, 0.999)
    monkeypatch.setattr(check_flows, "shuffled_chance", lambda *_: leak)
    with pytest.raises(StoreError, match="shuffled labels"):
        check_flows.window_checks(store, campaigns)


def test_detectors_are_compared_at_equal_rates(ran: Ran) -> None:
    store = store_of(ran)
    summary = summary_json(store)
    compared = summary["detectors"]
    assert compared["trials"] == {"train": 2, "validation": 2, "test": 2}
    assert compared["strides_ms"] == [10, 30]
    assert "carried" not in compared
    for entry in compared["detectors"]:
        for rate in entry["rates"]:
            assert rate["allowed"] == 0
            assert rate["validation"]["latency_ms"]["incipient"]["false_early"] == 0
    assert summary["choices"] == {"tiny": None, "tiny_gravity": None}
    text = (store.folder / "report" / "index.html").read_text()
    assert "0.5 % or 1.0 % or 2.0 % of 2 validation trials" in text
    assert "less than one trial, so none" in text
    assert "were chosen by" not in text


@pytest.mark.long
def test_smoothing_can_be_chosen_and_windows_can_overlap(
    ran: Ran, tmp_path: Path, rig_path: Path
) -> None:
    store = store_of(ran)
    kept = {path: path.stat().st_mtime_ns for path in (store.folder / "derived").glob("heard*/*/*")}
    data: dict[str, Any] = tiny()
    data["analysis"]["detection"].update(
        choose="validation", stride_ms=10, smoothing_grid=[1, 12], compare={"carried": True}
    )
    gravity = tiny_gravity()
    gravity["analysis"].setdefault("detection", {})["choose"] = "test"
    run_requests = [
        make_request(write(tmp_path / "p.yaml", data), rig_path, store.folder),
        make_request(write(tmp_path / "g.yaml", gravity), rig_path, store.folder),
    ]
    done = [(s["step"], s["done"]) for s in study(run_requests).steps]
    assert done[2:] == [("train", 0), ("evaluate", 1), ("report", 1)]
    # kept predictions are not made again
    assert kept == {path: path.stat().st_mtime_ns for path in kept}
    summary = summary_json(store)
    choice = summary["choices"]["tiny"]
    assert (choice["split"], choice["trials"]) == ("validation", 2)
    assert summary["choices"]["tiny_gravity"]["split"] == "test"
    used = summary["detection"]["tiny"]
    assert (used["smoothing"], used["margin"]) == (choice["smoothing"], choice["margin"])
    assert len(summary["detectors"]["carried"]) == len(summary["detectors"]["detectors"])
    text = (store.folder / "report" / "index.html").read_text()
    assert "Smoothing and margin were chosen by validation trials." in text
    assert "chosen by the kinematic test trials themselves" in text
    assert "smoothing and margin chosen on test trials" in text
    assert "states carried" in text
    # an option is what counts, whatever the protocols would choose
    campaigns = collected(store)
    assert evaluate(store, campaigns, smoothing=2)["done"] == 1
    found = Derived.of(store, "evaluation").read("evaluation")
    assert found["choices"] == {"tiny": None, "tiny_gravity": None}
    assert found["detection"]["tiny"]["smoothing"] == 2
    study(ran[0])  # back to what the other tests know


@pytest.mark.long
def test_a_margin_by_option_is_not_kept(ran: Ran) -> None:
    store = store_of(ran)
    campaigns = collected(store)
    assert evaluate(store, campaigns, margin=4.0)["done"] == 1
    assert report(store, campaigns)["done"] == 1
    assert evaluate(store, campaigns)["done"] == 1
    assert report(store, campaigns)["done"] == 1
    assert summary_json(store)["detection"]["tiny"]["margin"] == 8.0


@pytest.mark.long  # tests/goldens holds the summary of these seeds
def test_the_same_seed_gives_the_same_summary(
    ran: Ran, tmp_path: Path, rig_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(parallel_map, "START_S", 0.0)  # all in processes, and still the same
    run_requests = [
        make_request(Path(run_request.plan.file), rig_path, tmp_path / "store")
        for run_request in ran[0]
    ]
    study(run_requests)
    first, second = (
        summary_json(TrialStore.open(folder))
        for folder in (store_of(ran).folder, tmp_path / "store")
    )
    for summary in (first, second):
        summary.pop("timing_s")
    assert json.dumps(first, sort_keys=True) == json.dumps(second, sort_keys=True)


class _Killed(Exception):
    pass


def test_a_training_that_was_killed_goes_on_to_the_same_model(
    ran: Ran, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = (store_of(ran).folder / "models" / "seed0.pt").read_bytes()
    shutil.copytree(store_of(ran).folder, tmp_path / "store")
    store = TrialStore.open(tmp_path / "store")
    models = store.folder / "models"
    for end in ("pt", "json"):
        (models / f"seed0.{end}").unlink()

    def write_and_die(path: Path, state: bytes) -> None:
        write_bytes(path, state)
        raise _Killed

    with monkeypatch.context() as patched:
        patched.setattr("sliplab.analysis.problem.write_bytes", write_and_die)
        with pytest.raises(_Killed):
            train(store, collected(store))
    assert len(list(models.glob("*.state"))) == 1
    assert not (models / "seed0.pt").exists()

    epochs: list[int] = []
    begun = training.fit

    def fit(*given: Any, **named: Any) -> training.Fitted:
        states: list[bytes] = []
        named["on_state"] = states.append
        fitted = begun(*given, **named)
        epochs.append(len(states))
        return fitted

    monkeypatch.setattr(training, "fit", fit)
    assert train(store, collected(store))["done"] == 1
    assert epochs == [1]  # the second of two; the first was kept
    assert (models / "seed0.pt").read_bytes() == whole
    assert not list(models.glob("*.state"))
    assert (models / "seed0.svg").read_text().count("epoch") >= 2


@pytest.mark.long
def test_the_model_goes_out_as_what_it_is(
    ran: Ran, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("onnx", reason="ONNX is not installed (sliplab[onnx])")
    from sliplab.flows.detecting.request import load_model
    from sliplab.plugins.deploy import onnx_file
    from sliplab.plugins.deploy.export import ExportFailed
    from sliplab.plugins.deploy.run import export_model

    store = store_of(ran)
    model = store.folder / "models" / "seed0.pt"
    fitted = load_model(model)
    result = export_model(model, fitted, tmp_path / "out", store, checked=16)
    assert result["simulated"] is True
    assert result["onnx_windows_equal"] == 16
    assert result["speck_fits"] is True
    names = [f"seed0{end}" for end in (".onnx", ".speck.json", ".speck.md", ".speck.npz")]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == sorted(
        [*names, "seed0.card.json", "seed0.card.md"]
    )
    card = json.loads((tmp_path / "out" / "seed0.card.json").read_text())
    assert card["data"]["made_from_these_data"] is True
    (kinematic, gravity) = card["data"]["campaigns"]
    assert kinematic["trials"] == {"train": 2, "validation": 2, "test": 2}
    assert gravity["experiment"] == "gravity"
    # the same windows and the same network as in the evaluation
    summary = summary_json(store)
    assert card["figures"]["test"]["accuracy"] == summary["kinematic"]["accuracy"]
    assert card["detection"]["kinematic"]["latency_ms"] == summary["kinematic"]["latency_ms"]
    speck = json.loads((tmp_path / "out" / "seed0.speck.json").read_text())
    with np.load(tmp_path / "out" / "seed0.speck.npz") as arrays:
        assert {name: arrays[name].dtype for name in arrays} == dict.fromkeys(
            ("conv1.weight", "conv2.weight", "fc1.weight", "fc1.bias", "fc2.weight", "fc2.bias"),
            np.int8,
        )
    assert speck["quantisation"]["change"]["windows"] == card["figures"]["test"]["samples"]
    for name in (".card.md", ".speck.md"):
        assert "simulated" in (tmp_path / "out" / f"seed0{name}").read_text()

    counts = onnx_file.onnx_counts
    monkeypatch.setattr(onnx_file, "onnx_counts", lambda data, x: counts(data, x) + 1)
    with pytest.raises(ExportFailed, match="nothing was written: 4 of 4 windows"):
        export_model(model, fitted, tmp_path / "other", store, checked=4)
    assert not (tmp_path / "other").exists()
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(ModuleNotFoundError) as missing:
        export_model(model, fitted, tmp_path / "other", store, checked=4)
    assert "pip install 'sliplab[onnx]'" in str(lacking(missing.value, "sliplab export-model"))
    assert not (tmp_path / "other").exists()
