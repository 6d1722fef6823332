"""Reviewers' decisions, applied to labels only where asked, and only to the label they saw."""

from __future__ import annotations

from pathlib import Path

import pytest

from sliplab.analysis.evaluation.evaluation import make_job
from sliplab.analysis.labels.reviewed import StoreLabels
from sliplab.analysis.networks.models import wanted_models
from sliplab.storage.errors import StoreError
from sliplab.storage.trials.review import ReviewedOnsets
from tests.analysis.labels.reviewable import ADJUSTED, NAME, Reviewable, label
from tests.patching import loose


@pytest.fixture
def made(tmp_path: Path) -> Reviewable:
    """Twelve trials."""
    return Reviewable(tmp_path / "s", 12)


def test_decisions_count_only_when_asked(made: Reviewable) -> None:
    one, two, three, four = made.ids[:4]
    made.decide(one, "adjust")
    made.decide(two, "reject", ReviewedOnsets())
    made.decide(three, "accept", ReviewedOnsets())
    made.decide(four, "reject", ReviewedOnsets())
    made.decide(four, "reopen", ReviewedOnsets())
    plain, reviewed = StoreLabels(made.store), StoreLabels(made.store, reviewed=True)
    for trial in made.ids[:5]:
        found = plain.read(made.item, made.recording(trial))
        marked = {"simulated": True}  # of labels that a step wrote
        assert found.to_json() | marked == {"key": made.keys[trial], **label(), **marked}
        assert plain.key(made.item, made.recording(trial)) == made.keys[trial]
    assert plain.states([made.item]) is None

    found = reviewed.read(made.item, made.recording(one))
    assert (found.incipient_ns, found.gross_ns) == (ADJUSTED.incipient_ns, ADJUSTED.gross_ns)
    assert list(found.per_marker_ns) == label()["per_marker_ns"]
    found = reviewed.read(made.item, made.recording(two))
    assert (found.incipient_ns, found.gross_ns) == (None, None)
    assert found.doubts.incipient == "rejected: because"
    for trial in made.ids[2:5]:
        assert reviewed.read(made.item, made.recording(trial)).gross_ns == label()["gross_ns"]
        assert reviewed.key(made.item, made.recording(trial)) == made.keys[trial]
    assert reviewed.states([made.item]) == {
        "open": 9,
        "accepted": 1,
        "adjusted": 1,
        "rejected": 1,
        "stale": 0,
    }


def test_keys_follow_from_the_onsets_that_were_decided(made: Reviewable) -> None:
    labels, trial = StoreLabels(made.store, reviewed=True), made.ids[0]
    keys = [labels.key(made.item, made.recording(trial))]
    for verdict, new in (
        ("adjust", ADJUSTED),
        ("adjust", ReviewedOnsets(300_000_000, 500_000_001)),
        ("adjust", ADJUSTED),
        ("reject", ReviewedOnsets()),
        ("accept", ReviewedOnsets()),
    ):
        loose(made).decide(trial, verdict, new)  # of the two verdicts
        keys.append(labels.key(made.item, made.recording(trial)))
    assert keys[0] == keys[5] == made.keys[trial]
    assert keys[1] == keys[3]
    assert len(set(keys)) == 4


def test_models_and_evaluation_know_whose_labels_they_stand_on(made: Reviewable) -> None:
    items = [made.item]
    used = next(t for t, _ in made.item.trials if t.split == "train").id
    before = wanted_models(made.store, items)[0].key
    assert wanted_models(made.store, items, reviewed=True)[0].key == before
    made.decide(used, "adjust")
    assert wanted_models(made.store, items)[0].key == before
    assert wanted_models(made.store, items, reviewed=True)[0].key != before
    with pytest.raises(StoreError, match="with `--reviewed`"):
        make_job(made.store, items, reviewed=True)


def test_a_damaged_decision_stops_what_would_use_it(made: Reviewable) -> None:
    trial = made.ids[0]
    made.decide(trial, "adjust")
    path = made.store.folder / "review" / NAME / trial / "000001.json"
    path.write_text("{")
    with pytest.raises(StoreError, match=r"000001\.json"):
        StoreLabels(made.store, reviewed=True).key(made.item, made.recording(trial))
    assert StoreLabels(made.store).key(made.item, made.recording(trial)) == made.keys[trial]
