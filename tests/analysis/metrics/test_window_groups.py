"""Groups of windows: counted by hand, with intervals that hold the truth where trials differ."""

import itertools

import numpy as np
import pytest

from sliplab.analysis.metrics import window_groups
from sliplab.analysis.metrics.classification import accuracy, credit
from sliplab.analysis.metrics.intervals import share_interval
from sliplab.analysis.metrics.window_groups import by_factor, by_tenth, share, strict_hits

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


def test_a_share_tells_windows_and_trials_and_its_interval() -> None:
    hits = strict_hits(COUNTS, LABELS)
    found = share(hits, TRIAL)
    assert (found.share, found.n, found.trials) == (0.5, 6, 2)
    assert (found.low, found.high) == share_interval([1.0, 2.0], [3.0, 3.0])
    assert share(hits[:3], TRIAL[:3]).low is None
    assert share(hits[:0], TRIAL[:0]).share is None
    ahead = window_groups.mean(hits - 0.5, TRIAL)
    assert ahead.share == 0.0
    assert ahead.low == pytest.approx(-ahead.high)


def test_levels_are_split_by_trials() -> None:
    hits = strict_hits(COUNTS, LABELS)
    levels = {7: {"depth": "3 mm", "speed": "1 mm/s"}, 4: {"depth": "2 mm", "speed": "1 mm/s"}}
    found = by_factor(hits, TRIAL, levels)
    assert list(found["depth"]) == ["3 mm", "2 mm"]
    assert found["depth"]["2 mm"].share == 1 / 3
    assert found["depth"]["3 mm"].share == 2 / 3
    assert found["depth"]["2 mm"].low is None
    assert found["speed"]["1 mm/s"] == share(hits, TRIAL)
    assert by_factor(hits, TRIAL, {99: {"depth": "4 mm"}}) == {"depth": {}}


def test_tenths_of_a_phase() -> None:
    fraction = np.array([0.0, 0.05, 0.999, 1.0, np.nan, -0.1])
    labels, hits = np.array([0, 0, 0, 0, 0, 0]), np.array([1.0, 0, 1, 1, 1, 1])
    found = by_tenth(hits, labels, np.arange(6), fraction)
    assert [row.n for row in found["no_slip"]] == [2, 0, 0, 0, 0, 0, 0, 0, 0, 2]
    assert found["no_slip"][0].share == 0.5
    assert found["no_slip"][9].share == 1.0
    assert found["no_slip"][4].share is None
    assert {row.n for row in found["gross"]} == {0}


def test_the_worst_trial_comes_first() -> None:
    rows = window_groups.by_trial(
        COUNTS, LABELS, TRIAL, lambda number: ("slides", f"t{number}", {})
    )
    assert [(row.trial, row.errors, row.n) for row in rows] == [("t4", 2, 3), ("t7", 1, 3)]
    assert rows[0].taken == {"incipient as undecided": 1, "gross as undecided": 1}
    assert rows[1].taken == {"gross as no_slip": 1}
