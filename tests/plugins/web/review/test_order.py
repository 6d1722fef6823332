"""Trials by what a review of their label would change, against figures computed anew."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sliplab.analysis.detectors.latency import DetectedOnsets
from sliplab.analysis.evaluation.trials import summaries
from sliplab.analysis.labels.reviewed import StoreLabels
from sliplab.analysis.metrics import window_groups
from sliplab.analysis.windows.sample_sets import load_samples
from sliplab.plugins.web.review.influence import DRAWS, ReviewDraws, ReviewStatistic
from sliplab.plugins.web.review.order import TRAINING, ReviewOrder, review_order
from sliplab.storage.schema.evaluation import ExperimentScores, TrialScore
from sliplab.storage.schema.label import TrialLabel
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.review import ReviewedOnsets
from tests.analysis.labels.reviewable import NAME
from tests.plugins.web.review.evaluated import MS, TRIALS, Evaluated

GRAVE = "marker 3 could not be followed from 0.05 s after the motion began"
GRAVELY = {"incipient_ns": None, "gross_ns": None, "doubts": {"incipient": GRAVE, "gross": GRAVE}}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Evaluated:
    """A hundred trials and ten, whose labels are in no doubt."""
    return Evaluated(tmp_path_factory.mktemp("order") / "s")


@pytest.fixture
def made(whole: Evaluated, tmp_path: Path) -> Evaluated:
    """A copy of them, to be changed at will."""
    return whole.copied(tmp_path / "s")


def order(made: Evaluated) -> ReviewOrder:
    return review_order(made.store, [made.item])


def figure(found: ReviewOrder, name: str) -> ReviewStatistic:
    (one,) = [it for it in found.figures if (it.name, it.experiment) == (name, "kinematic")]
    return one


def test_the_one_that_moves_the_median_is_first(made: Evaluated) -> None:
    """Ten others are as doubtful, and move the means as much, but lie far from the median."""
    n = len(made.tests)
    assert n == 12
    # 5 doubtful ones at either end; between them a gap on both sides of the middle pair
    latencies = [20.0] * 5 + [60.0, 62.0] + [100.0] * 5
    near = made.tests[6]
    doubtful = [*made.tests[:5], near, *made.tests[-5:]]
    for trial in doubtful:
        made.widen(trial, 12.0)
    made.evaluate(latencies)
    found = order(made)
    assert found.notes == []
    assert {item.trial for item in found.trials} == set(doubtful)
    first, *others = found.trials
    assert first.trial == near
    assert first.moves[0].figure == "median incipient latency"
    assert all(item.doubt.spread_ms == {"incipient": 12.0, "gross": 0.0} for item in found.trials)
    for item in others:
        moved = {move.figure: move.change for move in item.moves}
        assert moved["mean incipient latency"] > 0
        assert moved.get("median incipient latency", 0) < first.moves[0].change / 20
        assert item.score < first.score / 2


def test_without_doubts_nothing_would_change(made: Evaluated) -> None:
    made.evaluate(np.linspace(20, 90, len(made.tests)).tolist())
    found = order(made)
    assert list(found.trials) == []
    assert found.gains(20) == []
    # a doubt of less than a frame of 10 ms is none that a person could resolve
    made.widen(made.tests[0], 9.9, 9.9)
    assert list(order(made).trials) == []


def test_what_is_decided_is_not_listed_and_what_is_stale_is(made: Evaluated) -> None:
    one, two, three = made.tests[:3]
    for trial in (one, two, three):
        made.widen(trial, 12.0)
    made.evaluate(np.linspace(20, 90, len(made.tests)).tolist())
    made.decide(one, "accept")
    key, made.keys[two] = made.keys[two], "of an older label"
    made.decide(two, "adjust")
    made.keys[two] = key
    found = order(made)
    assert {item.trial for item in found.trials} == {two, three}
    assert "the evaluation does not use the 1 decisions" in found.notes[0]


def moved_rows(
    made: Evaluated, rows: list[TrialScore], place: int, label: TrialLabel
) -> list[TrialScore]:
    """The rows with one trial scored again by another label."""
    row = rows[place]
    found = DetectedOnsets(row.detected_incipient_ns, row.detected_gross_ns)
    return [*rows[:place], made.row(row.trial, label, found), *rows[place + 1 :]]


FIGURES = {
    "incipient latency": lambda scores: scores.latency_ms.incipient,
    "gross latency": lambda scores: scores.latency_ms.gross,
    "lead": lambda scores: scores.lead_ms,
}


def of(scores: ExperimentScores, name: str) -> float:
    """A figure of `summaries` by its name here; NaN where it has none."""
    statistic, _, title = name.partition(" ")
    found = getattr(FIGURES[title](scores), statistic)
    return np.nan if found is None else float(found)


@pytest.mark.quick(1)
@pytest.mark.parametrize("case", ["moves", "drops out", "comes in", "comes and moves"])
def test_changes_are_those_of_an_evaluation_made_again(made: Evaluated, case: str) -> None:
    place = 7
    trial = made.tests[place]
    full = made.label(trial)
    if case == "moves":
        made.widen(trial, 45.0, 45.0)  # false early, late and crossed onsets among them
    elif case == "drops out":
        made.change(trial, flags=["knocked"])
    else:
        made.change(trial, **GRAVELY)
        if case == "comes and moves":
            made.widen(trial, 45.0, 45.0)
    latencies = np.random.default_rng(3).uniform(-40, 140, len(made.tests)).tolist()
    latencies[place] = 55.0
    rows = made.evaluate(latencies)
    found = order(made)
    (item,) = found.trials
    drawn = ReviewDraws.of(item.name, item.doubt)
    assert 0 <= (~drawn.usable).sum() < len(drawn.usable)
    before = summaries(rows)["kinematic"]
    names = [f"{statistic} {title}" for title in FIGURES for statistic in ("median", "mean")]
    for name in names:
        assert figure(found, name).value == pytest.approx(of(before, name), abs=1e-9)
    seen = set()
    for draw in range(0, DRAWS, 10):
        kinds = ("incipient_ns", "gross_ns")
        usable = drawn.usable[draw]
        onsets = {kind: int(getattr(drawn, kind)[draw]) if usable else None for kind in kinds}
        again = moved_rows(made, rows, place, full.model_copy(update=onsets))
        after = summaries(again)["kinematic"]
        seen.add(again[place].latency is None)
        for name in names:
            change = figure(found, name).changes(item.name)[draw]
            assert change == pytest.approx(of(after, name) - of(before, name), abs=1e-9), name
    assert seen == ({False} if case == "moves" else {False, True})
    signed = {move.figure: move.signed for move in item.moves}
    mean = np.nanmean(figure(found, "mean lead").changes(item.name))
    assert signed["mean lead"] == pytest.approx(mean)


def test_accuracy_changes_with_the_classes_of_its_windows(made: Evaluated) -> None:
    trial = made.tests[4]
    made.widen(trial, 30.0, 30.0)
    made.change(trial, flags=["knocked"])
    made.evaluate(np.linspace(20, 90, len(made.tests)).tolist())
    found = order(made)
    (item,) = found.trials
    drawn = ReviewDraws.of(item.name, item.doubt)
    samples = load_samples(StoreLabels(made.store), [made.item], "test")
    counts = Derived.of(made.store, "windows").arrays("test")["counts"]
    ours = np.array([samples.trials[k].trial == trial for k in samples.trial])
    before = window_groups.share(window_groups.strict_hits(counts, samples.y), samples.trial).share
    assert figure(found, "strict accuracy").value == pytest.approx(before)
    changes = figure(found, "strict accuracy").changes(item.name)
    assert (changes < 0).any()
    for draw in range(0, DRAWS, 50):
        y = samples.y.copy()
        for k in np.flatnonzero(ours):
            middle = samples.start_ns[k] + 15 * MS
            y[k] = int(middle >= drawn.incipient_ns[draw]) + int(middle >= drawn.gross_ns[draw])
        keep = ~ours | drawn.usable[draw]
        after = window_groups.strict_hits(counts[keep], y[keep]).mean()
        assert changes[draw] == pytest.approx(after - before)


def test_training_trials_move_training_and_nothing_else(made: Evaluated) -> None:
    gone, moved, come = made.trained[:3]
    made.change(gone, flags=["knocked"])
    made.widen(moved, 30.0, 0.0)
    made.change(come, **GRAVELY)
    made.evaluate(np.linspace(20, 90, len(made.tests)).tolist())
    found = order(made)
    shares = {item.trial: item.moves[0].change for item in found.trials}
    assert {item.split for item in found.trials} == {"train"}
    assert all([move.figure for move in item.moves] == [TRAINING] for item in found.trials)
    labels = StoreLabels(made.store)
    parts = [load_samples(labels, [made.item], split) for split in ("train", "validation")]
    total = sum(map(len, parts))
    windows = np.bincount(parts[0].trial)[0]
    assert shares[gone] * total == pytest.approx(0.2 * windows, rel=0.15)
    assert 0 < shares[moved] * total < 4
    assert shares[come] * total == pytest.approx(0.5 * 150, rel=0.1)


def test_gains_are_what_reviewed_trials_no_longer_blur(made: Evaluated) -> None:
    """The variance of a mean is the sum of its trials': half of them reviewed, half left."""
    n = len(made.tests)
    for trial in made.tests[:8]:
        made.widen(trial, 12.0)
    made.evaluate([90.0 + k / 10 for k in range(n)])  # far from false early, and from late
    found = order(made)
    gains = {gain.figure: gain for gain in found.gains(4)}
    mean = gains["mean incipient latency"]
    assert mean.label_width == pytest.approx(3.92 * 12.0 * np.sqrt(8) / n, rel=0.06)
    assert mean.left == pytest.approx(mean.label_width / np.sqrt(2), rel=0.06)
    low, high = figure(found, "mean incipient latency").span or (0, 0)
    assert mean.width == pytest.approx(high - low)
    assert all(gain.left == 0 for gain in found.gains(8))


def test_without_a_current_evaluation_doubt_alone_orders(made: Evaluated) -> None:
    one, two, three = made.tests[:3]
    made.widen(one, 12.0)
    made.widen(two, 40.0)
    made.change(three, flags=["knocked"])
    found = order(made)
    assert [item.trial for item in found.trials] == [three, two, one]
    assert [item.moves for item in found.trials] == [(), (), ()]
    assert "nothing evaluated yet" in found.notes[0]
    assert found.notes[0].endswith("ordered by doubt alone")
    assert found.gains(3) == []
    # an evaluation of other labels says nothing of these
    made.evaluate(np.linspace(20, 90, len(made.tests)).tolist())
    made.change(one, incipient_ns=330 * MS)
    (note,) = order(made).notes
    assert one in note
    assert len(order(made).trials) == 3
    assert note.endswith("run `sliplab evaluate`; ordered by doubt alone")


def test_decisions_tell_how_many_are_unusable(made: Evaluated) -> None:
    """Ten assumed trials and six decided ones: of those in grave doubt all were rejected."""
    for trial in made.tests[:7]:
        made.change(trial, **GRAVELY)
    for trial in made.tests[:6]:
        made.decide(trial, "reject", ReviewedOnsets())
    (item,) = order(made).trials
    assert item.doubt.unusable == pytest.approx((10 * 0.5 + 6) / 16)
    assert (item.campaign, item.trial) == (NAME, made.tests[6])
    assert len(made.ids) == TRIALS
