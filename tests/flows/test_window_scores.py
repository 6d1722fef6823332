"""Windows of several campaigns in one evaluation, where campaigns number their trials alike."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sliplab.analysis.campaigns import collected
from sliplab.analysis.evaluation.evaluation import evaluation_of
from sliplab.analysis.evaluation.windows import kept_counts
from sliplab.analysis.labels.reviewed import StoreLabels
from sliplab.analysis.metrics import classification as metrics
from sliplab.analysis.windows.dataset import TrialId
from sliplab.analysis.windows.sample_sets import load_samples, split_trials
from sliplab.flows.collect import collect
from sliplab.flows.evaluate import evaluate
from sliplab.flows.label import label
from sliplab.flows.planning.run_request import make_request
from sliplab.flows.train import train
from sliplab.storage.trials.review import ReviewedOnsets, decide
from sliplab.storage.trials.store import TrialStore
from tests.flows.conftest import tiny, write


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory, rig_path: Path) -> TrialStore:
    """Two campaigns with trials of the same numbers; a person rejected a test trial of the first.

    The rejected one is the last of its campaign that has samples to give, so that the next sample
    in the file is of the other campaign.
    """
    folder = tmp_path_factory.mktemp("two")
    for name in ("first", "second"):
        data = tiny()
        data["name"] = name
        data["collection"]["motion"][3]["distance"] = "5 mm"
        data["analysis"]["training"] = {"epochs": 1}
        collect(make_request(write(folder / f"{name}.yaml", data), rig_path, folder / "store"))
    store = TrialStore.open(folder / "store")
    campaigns = collected(store)
    label(store, campaigns)
    rejected, recording = list(campaigns[0].of_split("test"))[-1]
    key = StoreLabels(store).key(campaigns[0], recording)
    known = {
        "label": key,
        "old": ReviewedOnsets(),
        "new": ReviewedOnsets(),
        "seen": 0,
        "who": "a person",
    }
    decide(store, "first", rejected.id, "reject", **known, why="the skin was dirty")
    train(store, campaigns, reviewed=True)
    return store


@pytest.mark.long
def test_a_trial_without_samples_gets_none_of_another_campaign(two: TrialStore) -> None:
    campaigns = collected(two)
    assert [t.index for t, _ in campaigns[0].of_split("test")] == [
        t.index for t, _ in campaigns[1].of_split("test")
    ]
    assert evaluate(two, campaigns, reviewed=True)["done"] == 1
    found = evaluation_of(two)
    first, second = ([t.id for t, _ in item.of_split("test")] for item in campaigns)
    rows = {(row.campaign, row.trial): row.n for row in found.windows.by_trial}
    expected = {("first", first[0]), *(("second", name) for name in second)}
    assert rows.keys() == expected
    kept = kept_counts(two, found.key)
    assert kept is not None
    labels = StoreLabels(two, reviewed=True)
    trials = [tuple(names) for names in kept["trials"].tolist()]
    for item, trial, recording in split_trials(campaigns, "test"):
        ours = int(np.count_nonzero(kept["trial"] == trials.index((item.name, trial.id))))
        assert ours == rows.get((item.name, trial.id), 0)
        onset = labels.read(item, recording).incipient_ns
        assert (onset is None) == (ours == 0)


@pytest.mark.long
@pytest.mark.parametrize("margin", [0.0, 2.0])
def test_windows_and_trials_are_judged_by_one_margin(two: TrialStore, margin: float) -> None:
    """Another margin once changed the detections, and not the margin accuracy beside them."""
    assert evaluate(two, collected(two), margin=margin, reviewed=True)["done"] == 1
    found = evaluation_of(two)
    assert {rule.margin for rule in found.detection.values()} == {margin}
    kept = kept_counts(two, found.key)
    expected = metrics.accuracy(kept["counts"], kept["y"], margin).margin
    assert found.windows.accuracy.margin == expected
    (seed,) = found.windows.seeds.each
    assert seed.margin == expected
    assert expected != metrics.accuracy(kept["counts"], kept["y"], 30.0).margin


@pytest.mark.long
def test_each_sample_says_its_trial(two: TrialStore) -> None:
    """The last window of no slip ends at the onset of its own trial."""
    campaigns = collected(two)
    labels = StoreLabels(two, reviewed=True)
    for split in ("train", "validation", "test"):
        samples = load_samples(labels, campaigns, split)
        length_ns = campaigns[0].settings.windows.length_ms * 1_000_000
        for item, trial, recording in split_trials(campaigns, split):
            index = samples.trials.index(TrialId(item.name, trial.id))
            onset = labels.read(item, recording).incipient_ns
            still = samples.start_ns[(samples.trial == index) & (samples.y == 0)]
            if onset is None:
                assert not len(still)
            else:
                assert still.max() + length_ns == onset
