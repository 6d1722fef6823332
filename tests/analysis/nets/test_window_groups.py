"""Groups of windows: counted by hand, with intervals that hold the truth where trials differ."""

import itertools

import numpy as np
import pytest

from analysis.nets.metrics import accuracy
from analysis.nets.window_groups import (
    by_factor,
    by_tenth,
    by_trial,
    credit,
    share,
    strict_hits,
    trial_interval,
)

COUNTS = np.array([[5, 0, 0], [3, 3, 0], [0, 0, 0], [0, 2, 1], [0, 0, 4], [9, 0, 0]])
LABELS = np.array([0, 1, 2, 1, 2, 2])
TRIAL = np.array([4, 4, 4, 7, 7, 7])


def test_credits_add_up_to_the_accuracies() -> None:
    found = accuracy(COUNTS, LABELS)
    assert credit(COUNTS, LABELS).tolist() == [1, 1 / 2, 1 / 3, 1, 1, 0]
    assert credit(COUNTS, LABELS).mean() == pytest.approx(found.argmax)
    assert strict_hits(COUNTS, LABELS).mean() == found.strict
    for order in itertools.permutations(range(3)):
        place = np.argsort(order)
        moved = credit(COUNTS[:, order], place[LABELS])
        np.testing.assert_array_equal(moved, credit(COUNTS, LABELS))
    assert credit(COUNTS[:0], LABELS[:0]).shape == (0,)


def test_two_trials_have_the_interval_of_their_three_mixtures() -> None:
    # drawn with equal chance: both the one, both the other, or one of each twice
    values, trial = np.array([0.0] * 10 + [1.0] * 10), np.repeat([0, 1], 10)
    assert trial_interval(values, trial) == (0.0, 1.0)
    assert trial_interval(values, trial, level=0.4) == (0.5, 0.5)
    assert trial_interval(values[:10], trial[:10]) is None


def test_intervals_over_trials_hold_the_truth_where_those_over_windows_do_not() -> None:
    """Trials of 50 windows, each trial with a share of its own: 95 % should be about 95 %."""
    rng = np.random.default_rng(0)
    trial = np.repeat(np.arange(40), 50)
    held = naive = 0
    for _ in range(100):
        each = rng.beta(4, 1, 40)
        hits = (rng.random(2000) < np.repeat(each, 50)).astype(float)
        found = trial_interval(hits, trial)
        assert found is not None
        held += found[0] <= 0.8 <= found[1]
        half = 1.96 * np.sqrt(0.8 * 0.2 / 2000)
        naive += abs(hits.mean() - 0.8) <= half
    assert 88 <= held <= 100
    assert naive < 70


def test_levels_are_split_by_trials() -> None:
    hits = strict_hits(COUNTS, LABELS)
    levels = {7: {"depth": "3 mm", "speed": "1 mm/s"}, 4: {"depth": "2 mm", "speed": "1 mm/s"}}
    found = by_factor(hits, TRIAL, levels)
    assert list(found["depth"]) == ["3 mm", "2 mm"]
    assert found["depth"]["2 mm"]["share"] == 1 / 3
    assert found["depth"]["3 mm"]["share"] == 2 / 3
    assert found["depth"]["2 mm"]["low"] is None
    assert found["speed"]["1 mm/s"] == share(hits, TRIAL)
    assert by_factor(hits, TRIAL, {99: {"depth": "4 mm"}}) == {"depth": {}}


def test_tenths_of_a_phase() -> None:
    fraction = np.array([0.0, 0.05, 0.999, 1.0, np.nan, -0.1])
    labels, hits = np.array([0, 0, 0, 0, 0, 0]), np.array([1.0, 0, 1, 1, 1, 1])
    found = by_tenth(hits, labels, np.arange(6), fraction)
    assert [row["n"] for row in found["no_slip"]] == [2, 0, 0, 0, 0, 0, 0, 0, 0, 2]
    assert found["no_slip"][0]["share"] == 0.5
    assert found["no_slip"][9]["share"] == 1.0
    assert found["no_slip"][4]["share"] is None
    assert {row["n"] for row in found["gross"]} == {0}


def test_the_worst_trial_comes_first() -> None:
    rows = by_trial(COUNTS, LABELS, TRIAL, lambda number: {"trial": number})
    assert [(row["trial"], row["errors"], row["n"]) for row in rows] == [(4, 2, 3), (7, 1, 3)]
    assert rows[0]["taken"] == {"incipient as undecided": 1, "gross as undecided": 1}
    assert rows[1]["taken"] == {"gross as no_slip": 1}
