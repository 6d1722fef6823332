"""Doubts of labels in numbers: spreads by intervals, by rules that disagree, of hidden onsets."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sliplab.plugins.web.review.doubt import (
    UNUSABLE,
    LabelDoubt,
    doubts_of,
    labelled_trials,
    suggested_onsets,
    without_levels,
)
from sliplab.storage.schema.label import LABELS, TrialLabel
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.review import ReviewedOnsets
from tests.analysis.labels.reviewable import NAME, Reviewable, displacements, frame_times, label

MS = 1_000_000
COUNT = 96
INCIPIENT, GROSS = 315 * MS, 455 * MS
HIDDEN = "marker 3 could not be followed from 0.05 s after the motion began"


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Reviewable:
    """Trials of two speeds and more depths, directions."""
    return Reviewable(tmp_path_factory.mktemp("doubt") / "s", COUNT)


@pytest.fixture
def made(whole: Reviewable, tmp_path: Path) -> Reviewable:
    """A copy of them, to be changed at will."""
    return whole.copied(tmp_path / "s")


def relabel(made: Reviewable, trial: str, **values: Any) -> None:
    Derived.of(made.store, LABELS, NAME).write(trial, made.keys[trial], {**label(), **values})


def doubts(made: Reviewable) -> dict[str, LabelDoubt]:
    cases = labelled_trials(made.store, made.item)
    assert [case.trial.id for case in cases] == made.ids
    found = doubts_of(made.store, cases, UNUSABLE)
    return dict(zip(made.ids, found, strict=True))


def onsets(incipient: int | None, gross: int | None, **others: Any) -> dict[str, Any]:
    found = {"incipient_ns": incipient, "gross_ns": gross, "per_marker_ns": [GROSS, INCIPIENT]}
    return found | others


def test_the_label_is_what_the_fixture_says() -> None:
    assert (label()["incipient_ns"], label()["gross_ns"]) == (INCIPIENT, GROSS)


def test_rules_disagree_only_beyond_what_like_trials_do(made: Reviewable) -> None:
    """Rules are as far apart as the speed makes them; one trial's are 60 ms further apart."""
    odd, rng = made.ids[9], np.random.default_rng(0)
    speeds = {trial.id: made.item.describe(trial)["speed"] for trial, _ in made.item.trials}
    assert len(set(speeds.values())) > 1
    for trial, speed in speeds.items():
        before = round(2000 / float(speed.split()[0])) * MS // 20 + int(rng.normal(0, 2 * MS))
        before += 60 * MS if trial == odd else 0
        sharp = {"first_marker": 1, "low_ns": [0, 0], "high_ns": [0, 0]}
        relabel(
            made,
            trial,
            rule="change_point",
            paper=onsets(INCIPIENT + before, GROSS + before),
            change_point=onsets(INCIPIENT, GROSS, **sharp),
        )
    found = doubts(made)
    assert {name for name, doubt in found.items() if doubt.there} == {odd}
    spread = found[odd].spread_ms
    assert 40 < spread["incipient"] < 60
    assert 40 < spread["gross"] < 60
    assert found[odd].reasons[0].startswith("incipient: the paper's rule is ")
    assert found[odd].reasons[0].endswith(" ms further off than in like trials")
    assert (found[odd].unusable, found[odd].severity) == (0.0, 0)


def test_a_marker_whose_place_is_vague_spreads_its_crossing(made: Reviewable) -> None:
    """At 40 px/s, 0.5 px either way are 12.5 ms: frames from 300 or 305 to 325 or 335 ms."""
    sigma = np.full(displacements().shape, 0.001, np.float32)
    sigma[:, 0] = 0.5
    vague, sharp = made.ids[:2]
    for trial, known in ((vague, sigma), (sharp, np.full_like(sigma, 0.001))):
        arrays = {
            "frame_ns": frame_times(),
            "sigma_px": known,
            "displacement_px": displacements().astype(np.float32),
        }
        times = list(label()["per_marker_ns"])
        paper = {"incipient_ns": INCIPIENT, "gross_ns": GROSS, "per_marker_ns": times}
        data = {**label(), "reference": "hold_end", "paper": paper}
        derived = Derived.of(made.store, LABELS, NAME)
        derived.arrays_path(trial).unlink()  # linked to the others'
        derived.write(trial, made.keys[trial], data, arrays)
    found = doubts(made)
    assert found[sharp].spread_ms == {"incipient": 0.0, "gross": 0.0}
    # 2 px -+ 1 px of the centre marker, which begins to move at 400 ms: from 425 to 475 ms
    assert found[vague].spread_ms["gross"] == pytest.approx((475 - 425) / 4, abs=2.6)
    assert found[vague].spread_ms["incipient"] == 0.0
    (reason,) = found[vague].reasons
    assert reason.startswith("gross: only known to +-")


def test_a_change_point_has_its_own_interval(made: Reviewable) -> None:
    """The intervals of a label from events are of the paper's rule."""
    sharp, wide = made.ids[:2]
    papers = {"incipient_ns": [0, 400 * MS], "gross_ns": [0, 400 * MS]}
    for trial, half in ((sharp, 2 * MS), (wide, 30 * MS)):
        slips = onsets(
            INCIPIENT,
            GROSS,
            first_marker=1,
            low_ns=[GROSS, INCIPIENT - half],
            high_ns=[GROSS, INCIPIENT + half],
        )
        relabel(made, trial, rule="change_point", change_point=slips, intervals=papers)
    found = doubts(made)
    assert found[sharp].spread_ms == {"incipient": 0.0, "gross": 0.0}
    assert found[wide].spread_ms == {"incipient": 15.0, "gross": 0.0}


def test_a_hidden_onset_lies_anywhere_since_the_motion_began(made: Reviewable) -> None:
    one, two, three = made.ids[:3]
    hidden = {"incipient": HIDDEN, "gross": HIDDEN}
    seen = {"paper": onsets(INCIPIENT, GROSS, doubts=hidden)}
    relabel(made, one, incipient_ns=None, gross_ns=None, doubts=hidden, **seen)
    # where its own interval is the reason, that is how far it spreads
    stated = {"incipient_ns": [INCIPIENT - 200 * MS, INCIPIENT + 200 * MS], "gross_ns": None}
    relabel(made, two, incipient_ns=None, gross_ns=None, doubts=hidden, intervals=stated, **seen)
    relabel(made, three, gross_ns=None, per_marker_ns=[-1, INCIPIENT])
    found = doubts(made)
    assert found[one].onsets == found[two].onsets == ReviewedOnsets(INCIPIENT, GROSS)
    start = made.recording(one).motion_ns[0]
    assert found[one].spread_ms["incipient"] == pytest.approx(
        (INCIPIENT - start) / MS / np.sqrt(12)
    )
    assert found[one].spread_ms["gross"] == pytest.approx((GROSS - INCIPIENT) / MS / np.sqrt(12))
    assert found[two].spread_ms["incipient"] == 100.0
    assert found[one].unusable == 0.5
    assert found[three].onsets.gross_ns is None
    assert not found[three].draw(50, 1)[2].any()
    assert found[three].reasons == ("no gross slip was found",)


def test_drawn_onsets_stand_in_order_and_are_lost_as_often_as_said() -> None:
    doubt = LabelDoubt(
        ReviewedOnsets(INCIPIENT, GROSS), 600 * MS, {"incipient": 100.0, "gross": 100.0}, 0.3, 3, ()
    )
    incipient, gross, usable = doubt.draw(4000, 5)
    assert (gross >= incipient).all()
    assert incipient.std() == pytest.approx(100 * MS, rel=0.05)
    assert usable.mean() == pytest.approx(0.7, abs=0.03)


def test_older_labels_suggest_their_markers_onsets() -> None:
    data = {"incipient_ns": None, "gross_ns": None, "end_ns": 1, "per_marker_ns": [9, -1, 4]}
    old = TrialLabel.model_validate(data)
    assert suggested_onsets(old, 0) == ReviewedOnsets(4, 9)
    # in a twist gross slip is not the centre's, as the rule's own onsets say
    paper = {"incipient_ns": 4, "gross_ns": 7}
    assert suggested_onsets(
        TrialLabel.model_validate({**data, "paper": paper}), 0
    ) == ReviewedOnsets(4, 7)


def test_levels_are_taken_out() -> None:
    conditions = [{"a": str(k // 5), "b": str(k % 5)} for k in range(25)]
    effects = np.array([10.0 * (k // 5) ** 2 + 3.0 * (k % 5) for k in range(25)])
    effects[5] += 40
    left = without_levels(effects, conditions)
    # one sweep: what is odd moves the median of its row by a place
    assert left[5] == pytest.approx(40, abs=3.1)
    assert np.abs(np.delete(left, 5)).max() < 3.1
    assert np.isnan(without_levels(np.array([np.nan]), [{}])).all()
