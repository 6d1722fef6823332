"""Sensitivity to assumed parameters: the unchanged scene gives the study's own figures."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from benchmarks.guesses import results as study_sensitivity
from benchmarks.guesses import run as guesses
from benchmarks.guesses.document import SensitivityResults, SettingScores
from benchmarks.guesses.results import (
    FIGURES,
    StudySensitivity,
    changes,
    figures,
)
from benchmarks.guesses.run import TRIALS, guess_sweep, measure_guesses
from benchmarks.guesses.study import STUDY
from benchmarks.scene_parameters import AS_IT_IS, ParameterSetting
from sliplab.analysis.campaigns import collected
from sliplab.flows.cli.study_command import study_app
from sliplab.storage.files import json_text, read_json, write_json
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.store import TrialStore
from tests.flows.conftest import shape_of

pytestmark = pytest.mark.long

Json = dict[str, Any]
GUESS = "event_camera.contrast"


@pytest.fixture(scope="module")
def store(own_study: TrialStore) -> TrialStore:
    """A copy of the small study, its contrast measured down and up."""
    measure_guesses(own_study, collected(own_study), (GUESS,), 20)
    return own_study


def kept(store: TrialStore) -> dict[str, Json]:
    found: dict[str, Json] = read_json(store.folder / "derived/guesses/results.json")["settings"]
    return found


def scores(store: TrialStore) -> dict[str, SettingScores]:
    return SensitivityResults.load(store.folder / "derived/guesses/results.json").settings


def test_the_scene_as_it_is_gives_the_study_s_own_trials(store: TrialStore) -> None:
    ours = Derived.of(store, "evaluation").read("evaluation")["trials"]
    again = [
        {key: value for key, value in row.items() if key != "depth_zero_mm"}
        for row in kept(store)[AS_IT_IS]["trials"]
    ]
    assert len(again) == 4
    assert sorted(again, key=lambda row: row["trial"]) == sorted(ours, key=lambda row: row["trial"])


def test_a_change_is_seen_and_compared_trial_by_trial(store: TrialStore) -> None:
    settings = kept(store)
    assert list(settings) == [AS_IT_IS, f"{GUESS} x 0.8", f"{GUESS} x 1.2"]
    base, lower, higher = settings.values()
    assert (lower["value"], higher["value"]) == pytest.approx((0.8 * 2.08, 1.2 * 2.08))
    for setting in (lower, higher):
        # the contact does not know of the camera, but by where the rig found the plate
        pairs = list(zip(base["trials"], setting["trials"], strict=True))
        assert all(row["trial"] == other["trial"] for row, other in pairs)
        same = [(a, b) for a, b in pairs if a["depth_zero_mm"] == b["depth_zero_mm"]]
        assert all(a["incipient_ns"] == b["incipient_ns"] for a, b in same)
        assert setting["windows"].keys() == base["windows"].keys()
    assert lower["windows"] != higher["windows"]
    typed = scores(store)
    assert all(set(figures(setting)) == set(FIGURES) for setting in typed.values())
    none = changes(typed[AS_IT_IS], typed[AS_IT_IS])
    assert none["strict"] == (0.0, 0.0)
    assert all(span in (None, (0.0, 0.0)) for span in none.values())


LATENCY = dict.fromkeys(
    ("false_early", "late", "max", "mean", "median", "min", "missed", "n", "p95", "std"), "float"
) | dict.fromkeys(("false_early", "late", "missed", "n"), "int")
TRIAL = {
    "campaign": "str",
    "condition": {"depth": "str", "direction": "str", "speed": "str"},
    "depth_zero_mm": "float",
    "detected_gross_ns": "int",
    "detected_incipient_ns": "int",
    "end_ns": "int",
    "experiment": "str",
    "gross_ns": "int",
    "incipient_ns": "int",
    "latency": {
        "false_early_gross": "bool",
        "false_early_incipient": "bool",
        "late_gross_ms": "NoneType",
        "late_incipient_ms": "NoneType",
        "latency_gross_ms": "float",
        "latency_incipient_ms": "float",
        "lead_ms": "float",
        "missed_gross": "bool",
        "missed_incipient": "bool",
    },
    "trial": "str",
}


def test_a_setting_has_these_keys(store: TrialStore) -> None:
    path = store.folder / "derived/guesses/results.json"
    assert json_text(SensitivityResults.load(path).to_json()) == path.read_text()
    file = read_json(path)
    assert list(file) == ["change", "settings", "simulated"]
    assert (file["change"], file["simulated"]) == (0.2, True)
    base, lower, _ = file["settings"].values()
    assert (base["factor"], base["parameter"], base["value"]) == (1.0, None, None)
    assert (lower["factor"], lower["parameter"]) == (0.8, GUESS)
    found = shape_of(lower)
    kinematic = found["experiments"].pop("kinematic")
    assert list(found["experiments"]) == ["disturbance", "gravity"]
    assert kinematic == {
        "latency_ms": {"gross": LATENCY, "incipient": LATENCY},
        "lead_ms": dict(sorted({**LATENCY, "detected_first": "int"}.items())),
        "trials": "int",
        "without_onsets": "int",
    }
    assert list(found) == [
        "experiments",
        "factor",
        "key",
        "parameter",
        "trials",
        "value",
        "windows",
    ]
    assert found["trials"] == [TRIAL]
    slides = {row["trial"] for row in lower["trials"] if row["campaign"] == "tiny"}
    assert found["windows"] == {name: ["int"] for name in slides}
    assert all(len(pair) == 2 for pair in lower["windows"].values())


def test_what_is_kept_is_not_measured_again_and_leaves_no_store(store: TrialStore) -> None:
    again = measure_guesses(store, collected(store), (GUESS,), 20)
    assert again.measured == 0
    folder = store.folder / "derived" / "guesses"
    assert [path.name for path in folder.iterdir()] == ["results.json"]


def test_stopped_between_two_settings_it_goes_on(
    store: TrialStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(store.folder, tmp_path / "store")
    other = TrialStore.open(tmp_path / "store")
    file = other.folder / "derived/guesses/results.json"
    write_json(file, {"settings": {AS_IT_IS: kept(other)[AS_IT_IS]}})

    def stopped(work: StudySensitivity, setting: ParameterSetting, scenes: Any) -> SettingScores:
        if setting.factor > 1:
            raise KeyboardInterrupt
        return scores(store)[setting.name]

    monkeypatch.setattr(guesses, "measure_setting", stopped)
    with pytest.raises(KeyboardInterrupt):
        measure_guesses(other, collected(other), (GUESS,), 20)
    monkeypatch.undo()
    assert len(kept(other)) == 2
    assert measure_guesses(other, collected(other), (GUESS,), 20).measured == 1
    assert kept(other) == kept(store)


def test_another_network_is_another_measurement(
    store: TrialStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    work = StudySensitivity(store, collected(store), TRIALS)
    assert guess_sweep(work, (GUESS,)).pending == []
    monkeypatch.setattr(study_sensitivity, "VERSION", 99)
    assert len(guess_sweep(work, (GUESS,)).pending) == 3


def test_a_command_shows_them(store: TrialStore) -> None:
    done = CliRunner().invoke(study_app(STUDY), [str(store.folder), "--guess", GUESS, "--json"])
    assert done.exit_code == 0, done.output
    reported = json.loads(done.stdout)
    assert set(reported["settings"]) == set(scores(store))
    page = Path(reported["page"]).read_text()
    assert "Sensitivity to assumed scene parameters" in page
    assert "contrast of the markers" in page
    tables = sorted(path.name for path in Path(reported["page"]).parent.glob("tables/*.csv"))
    parts = ("", ".experiments", ".experiments.latency_ms", ".trials")
    assert tables == [f"guesses.settings{part}.csv" for part in parts]
