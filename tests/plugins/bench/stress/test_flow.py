"""`sliplab stress`: trials under nuisances beside a store, its detectors judged by them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
import yaml

from sliplab.analysis.campaigns import collected, training_campaigns
from sliplab.analysis.labels.reviewed import StoreLabels
from sliplab.analysis.networks.models import wanted_models
from sliplab.analysis.study import Finding
from sliplab.analysis.windows.sample_sets import load_samples
from sliplab.flows.collect import collect
from sliplab.flows.label import label
from sliplab.flows.planning.run_request import RunRequest, make_request
from sliplab.flows.study import StudyOutcome
from sliplab.plugins.bench.stress.document import StressRecord
from sliplab.plugins.bench.stress.flow import measure_stress, request
from sliplab.plugins.bench.stress.study import STUDY
from sliplab.protocols import InputError
from sliplab.storage.trials.store import TrialStore
from tests.conftest import ROOT
from tests.flows.conftest import tiny

LEVELS = {"nuisance": ["none", "mix"], "strength": [100], "hold": [5, 6]}


def disturbed(folder: Path, split: str = "test", **levels: list[Any]) -> Path:
    """Write the shipped protocol with the windows of the small study and few levels."""
    data = yaml.safe_load((ROOT / "protocols/nuisances.yaml").read_text())
    for name, values in {**LEVELS, **levels}.items():
        data["collection"]["factors"][name]["values"] = values
    data["collection"]["maintenance"].pop("rezero")
    small = tiny()
    data["collection"]["recording"] = small["collection"]["recording"]
    data["collection"]["motion"][3] |= {"distance": "9 mm", "speed": "1.6 mm/s"}
    data["analysis"]["windows"] = small["analysis"].get("windows", data["analysis"]["windows"])
    shares = {"train": 0.0, "validation": 0.0, "test": 0.0, split: 1.0}
    data["analysis"]["split"] = {"method": "ranked", **shares, "strata": ["nuisance"]}
    path = folder / "nuisances.yaml"
    path.write_text(yaml.safe_dump(data))
    return path


@pytest.fixture(scope="module")
def store(ran: tuple[list[RunRequest], StudyOutcome]) -> TrialStore:
    """The small study."""
    return TrialStore.open(ran[0][0].store)


@pytest.fixture(scope="module")
def made(store: TrialStore, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, StressRecord]:
    """Its detectors under four trials."""
    folder = tmp_path_factory.mktemp("stress")
    asked = request(store, collected(store), disturbed(folder), None, folder / "out")
    record = measure_stress(asked)
    STUDY.write(Finding(record, asked.out))
    return folder, record


def test_every_detector_has_every_trial(made: tuple[Path, StressRecord]) -> None:
    _, record = made
    assert record.simulated
    # under all nuisances at once a label may be in doubt
    assert record.trials + record.without_onsets == 4
    assert record.trials >= 3
    for detector in record.detectors:
        over_all, *parts = detector.figures
        assert over_all.trials == record.trials
        single = [it for it in parts if it.strength is not None]
        assert sum(it.trials for it in single) == record.trials
        assert sum(it.false_alarms for it in single) == over_all.false_alarms
        assert over_all.hold_h == pytest.approx(sum(it.hold_h for it in single))
        # holds of 5 and 6 s, and what passes until something slips
        assert 5.0 < 3600 * over_all.hold_h / record.trials < 10.0
    clean = [it.figures[0].clean.value for it in record.detectors]
    assert clean == sorted(clean, reverse=True)
    rules = [it.rule for it in record.detectors]
    assert "smoothing chosen" in rules
    assert any(rule.startswith("rule, ") for rule in rules)
    (network, *_), windows = record.accuracy[0].network, record.accuracy[0].windows
    assert windows == sum(
        it.windows for it in record.accuracy if it.network[0] == network and it.strength is not None
    )


def test_numbers_and_page_say_simulated_and_nothing_is_taken_again(
    made: tuple[Path, StressRecord], store: TrialStore
) -> None:
    folder, record = made
    kept = json.loads((folder / "out" / "stress.json").read_text())
    assert kept == json.loads(json.dumps(record.to_json()))
    page = (folder / "out" / "stress.html").read_text()
    assert "simulated" in page
    assert all(name in page for name in ("none", "mix", "clean trials"))
    table = pd.read_csv(folder / "out" / "tables" / "stress.detectors.figures.csv")
    first, shown = record.detectors[0], table.iloc[0]
    assert shown[["network", "nuisance", "simulated"]].to_list() == [first.network, "all", True]
    assert shown["per_hour_high"] == pytest.approx(first.figures[0].per_hour.high)
    assert len(table) == sum(len(it.figures) for it in record.detectors)
    trials = folder / "out" / "store" / "campaigns" / "stress" / "trials"
    before = {path: path.stat().st_mtime_ns for path in trials.rglob("data.h5")}
    asked = request(store, collected(store), folder / "nuisances.yaml", None, folder / "out")
    assert measure_stress(asked) == record
    assert {path: path.stat().st_mtime_ns for path in trials.rglob("data.h5")} == before
    assert [campaign.name for campaign in store.campaigns()] == ["tiny", "tiny_gravity"]


def test_what_cannot_be_judged_is_refused_before_anything_is_taken(
    store: TrialStore, tmp_path: Path
) -> None:
    def refused(protocol: Path) -> str:
        with pytest.raises(InputError) as error:
            request(store, collected(store), protocol, None, tmp_path / "out")
        return str(error.value)

    assert "--protocol: collection.nuisances" in refused(store.campaign("tiny").protocol_file)
    data = yaml.safe_load(disturbed(tmp_path).read_text())
    data["analysis"]["windows"] = {"length_ms": 40}
    (tmp_path / "other.yaml").write_text(yaml.safe_dump(data))
    assert "analysis.windows" in refused(tmp_path / "other.yaml")
    assert not (tmp_path / "out" / "store" / "campaigns").exists()


@pytest.mark.long
def test_a_campaign_with_nuisances_trains_only_if_it_is_asked_for(
    rig_path: Path, tmp_path: Path
) -> None:
    data = tiny()
    for trains in (False, True):
        data["analysis"].setdefault("training", {})["nuisances"] = trains
        slides = tmp_path / f"slides{trains}.yaml"
        slides.write_text(yaml.safe_dump(data))
        room = tmp_path / "store"  # no trial is taken again: the analysis alone changes
        protocol = disturbed(tmp_path, "train", nuisance=["mix"], hold=[5])
        for file, name in ((slides, "slides"), (protocol, "disturbed")):
            collect(make_request(file, rig_path, room, campaign=name))
        store = TrialStore.open(room)
        campaigns = collected(store)
        assert [item.name for item in campaigns] == ["slides", *["disturbed"] * trains]
        assert [item.name for item in collected(store, ["disturbed"])] == ["disturbed"]
        label(store, campaigns)
        samples = load_samples(StoreLabels(store), campaigns, "train")
        assert ("disturbed" in {name for name, _ in samples.trials}) is trains
        assert training_campaigns(campaigns)[0].name == "slides"
        assert wanted_models(store, campaigns)
