"""A campaign that chooses nothing: its own seed and skin, judged once, each time written down."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from sliplab.analysis.campaigns import collected
from sliplab.analysis.evaluation import holdout as figures
from sliplab.analysis.evaluation.evaluation import evaluation_of
from sliplab.analysis.evaluation.holdout import Holdout
from sliplab.analysis.report.holdout import holdout_part, holdout_rows
from sliplab.analysis.report.programs import HOLDOUT
from sliplab.flows import holdout
from sliplab.flows.holdout import PROTOCOL_SEED, SKIN_SEED, holdout_request, measure_holdout
from sliplab.flows.label import label
from sliplab.flows.report import report
from sliplab.plugins.simulation.settings import scene_of
from sliplab.plugins.studies.generalise import run as generalise
from sliplab.storage.files import json_text, read_json, write_json
from sliplab.storage.schema.holdout import HoldoutResult
from sliplab.storage.trials.store import StoreError, TrialStore
from tests.conftest import ROOT
from tests.flows.conftest import shape_of, summary_json

SEEDS = (5, 6)
"""Not the release's: no test may look at its trials."""


@pytest.fixture(scope="module")
def store(own_study: TrialStore) -> TrialStore:
    """A copy of the small study, with four trials held out."""
    assert measure_holdout(own_study, collected(own_study), 4, seeds=SEEDS)["done"] == 1
    return own_study


def test_the_release_s_seeds_stand_nowhere_else() -> None:
    used = [PROTOCOL_SEED, SKIN_SEED]
    skins = range(generalise.SKIN_SEEDS, generalise.SKIN_SEEDS + 1000)
    assert not set(used) & set(skins)
    words = [str(seed) for seed in used] + [f"{seed:_}" for seed in used]
    own = {ROOT / "flows" / "holdout.py"}
    files = [
        path
        for folder in ("protocols", "rigs", "analysis", "flows", "storage", "tests", "benchmarks")
        for path in (ROOT / folder).rglob("*")
        if path.suffix in {".py", ".yaml", ".json"} and path not in own
    ]
    assert len(files) > 300
    assert not [path for path in files if any(word in path.read_text() for word in words)]


def test_its_trials_are_others_on_another_skin(store: TrialStore) -> None:
    item = collected(store)[0]
    run_request = holdout_request(Holdout(store, collected(store), 4, SEEDS))
    assert (
        run_request.plan.protocol.collection.seed == SEEDS[0] != item.plan.protocol.collection.seed
    )
    assert scene_of(run_request.rig).scene.skin.seed == SEEDS[1]
    assert {trial.split for trial in run_request.plan} == {"test"}
    assert not {trial.seed for trial in run_request.plan} & {trial.seed for trial in item.plan}
    theirs = TrialStore.open(store.folder / "holdout" / "store").campaign(item.name)
    assert theirs.committed() == run_request.only
    # the study's own campaigns are what they were: nothing trains on these, or chooses by them
    assert [campaign.name for campaign in store.campaigns()] == ["tiny", "tiny_gravity"]
    settings = run_request.plan.protocol.analysis
    assert settings.model_copy(update={"split": item.settings.split}) == item.settings


def test_it_is_judged_once_a_version_and_written_down(
    store: TrialStore, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    campaigns = collected(store)
    first = measure_holdout(store, campaigns, 4, seeds=SEEDS)
    assert first["done"] == 0
    (line,) = first["result"].evaluations
    key = evaluation_of(store).key
    assert key is not None
    assert line.model == first["result"].model
    assert line.strict == first["result"].windows.accuracy.strict
    # other settings under the same version: kept as it was, and said
    monkeypatch.setattr(figures, "VERSION", 99)
    again = measure_holdout(store, campaigns, 4, seeds=SEEDS)
    assert (again["done"], again["result"]) == (0, first["result"])
    assert "a second look" in capsys.readouterr().err
    # a new version of the program looks once more
    for module in (holdout, figures):
        monkeypatch.setattr(module, "version", lambda name: "99.0")
    later = measure_holdout(store, campaigns, 4, seeds=SEEDS)
    assert [each.version for each in later["result"].evaluations] == [line.version, "99.0"]
    asked = measure_holdout(store, campaigns, 3, again=True, seeds=SEEDS)
    assert len(asked["result"].evaluations) == 3
    kept, now = first["result"].to_json(), later["result"].to_json()
    assert all(now[name] == kept[name] for name in ("windows", "rows", "kinematic", "trials"))
    write_json(store.folder / "holdout/results.json", kept)


def test_its_figures_stand_beside_those_of_the_test_trials(store: TrialStore) -> None:
    report(store, collected(store))
    summary = summary_json(store)["holdout"]
    kept = read_json(store.folder / "holdout/results.json")
    assert summary["trials"] == len(kept["rows"]) == 4
    assert summary["windows"]["strict"]["trials"] == 4
    latency = summary["latency_ms"]["incipient"]
    assert latency["n"] + latency["missed"] + latency["late"] + latency["false_early"] == 4
    assert "at" not in json.dumps(summary["versions"])
    page = " ".join((store.folder / "report" / "index.html").read_text().split())
    assert "Hold-out: another skin and seed" in page
    assert "They were evaluated 1 time, by version" in page
    rows = holdout_rows(holdout_part(HoldoutResult.model_validate(kept)))
    assert rows[0][0] == "windows right, strict"
    assert rows[0][2] == f"4 trials, {summary['windows']['strict']['n']} windows"


SHARE = {"high": "float", "low": "float", "n": "int", "share": "float", "trials": "int"}
BY_CLASS = {"gross": "float", "incipient": "float", "no_slip": "float"}


def test_the_file_has_these_keys(store: TrialStore) -> None:
    path = store.folder / "holdout/results.json"
    assert json_text(HoldoutResult.load(path).to_json()) == path.read_text()
    found = shape_of(read_json(path))
    names = {"evaluations", "false_alarms", "key", "kinematic", "model", "protocol_seed", "rows"}
    assert list(found) == sorted(names | {"simulated", "skin_seed", "trials", "windows"})
    line = {"at": "str", "model": "str", "strict": "float", "version": "str"}
    assert found["evaluations"] == [line]
    accuracy = {"argmax": "float", "margin": "float", "n": "int", "strict": "float"}
    assert found["windows"] == (
        {"accuracy": accuracy, "argmax": SHARE, "strict": SHARE, "confusion": [["int"]]}
        | dict.fromkeys(("balance", "precision", "recall"), BY_CLASS)
    )
    assert list(found["kinematic"]) == ["latency_ms", "lead_ms", "trials", "without_onsets"]
    times = {f"{name}_ns" for kind in ("incipient", "gross") for name in (kind, f"detected_{kind}")}
    names = {"campaign", "condition", "end_ns", "experiment", "latency", "trial"}
    assert list(found["rows"][0]) == sorted(names | times)
    numbers = ("key", "model", "protocol_seed", "simulated", "skin_seed", "trials")
    types = ["str", "str", "int", "bool", "int", "int"]
    assert [found[name] for name in numbers] == types


def test_a_file_of_another_shape_is_named(store: TrialStore) -> None:
    with pytest.raises(StoreError, match=r"holdout/results\.json"):
        HOLDOUT.parse(HoldoutResult, {"rows": []})


def test_real_slides_need_a_campaign_of_their_own(
    store: TrialStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    campaigns = collected(store)
    monkeypatch.setitem(campaigns[0].info, "simulated", False)
    with pytest.raises(StoreError, match="its slides are real"):
        Holdout(store, campaigns, 4, SEEDS)
    assert label(store, campaigns)["done"] == 0
