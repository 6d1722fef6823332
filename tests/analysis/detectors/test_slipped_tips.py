"""Tips are followed as by the forward recursion in probabilities, and as the simulation's truth."""

import numpy as np
import pytest
from scipy.stats import poisson

from benchmarks.tips import followed
from sliplab.analysis.detectors.slipped_tips import (
    DISPERSION,
    FIRST,
    LETS_GO_MS,
    SLID,
    SlippedTips,
    regions,
)


def test_the_filter_is_the_forward_recursion() -> None:
    """Without noise, and while every tip has probably let go, so that no rate is measured again."""
    rate = np.array([2.0, 5.0])
    counts = np.random.default_rng(1).poisson(SLID * rate, (40, 2))
    tips = SlippedTips(rate, np.zeros(2))
    tips.probability[:] = 0.99
    slid, seen = np.full(2, 0.99), []
    for row in counts:
        slid = slid + (1 - slid) / LETS_GO_MS
        both = np.array([1 - slid, slid])
        both *= poisson.pmf(row, np.array([rate, SLID * rate])) ** (1 / DISPERSION)
        slid = both[1] / both.sum(axis=0)
        assert slid.min() > 0.5
        seen.append(slid.mean())
    limited = np.minimum(seen, 1 / (1 + np.exp(-8.0)))
    assert tips.push(counts) == pytest.approx(limited, abs=1e-3)


def test_tips_let_go_one_after_the_other_and_stick_again() -> None:
    """Ten tips of 1 to 5 events/ms: five let go after 100 ms, and stick again after 400 ms."""
    rng, rate = np.random.default_rng(2), np.geomspace(1.0, 5.0, 10)
    true = np.ones((800, 10))
    true[100:400, :5] = SLID
    tips = SlippedTips(rate, np.zeros(10))
    share = tips.push(rng.poisson(true * rate))
    assert share[50:100].mean() < 0.1
    assert share[300:400].mean() == pytest.approx(0.5, abs=0.1)
    assert share[700:].mean() < 0.1


def test_the_rate_of_a_tip_that_sticks_may_grow_to_thrice() -> None:
    rate = np.linspace(1.0, 3.0, 600)[:, None] * np.ones(10)
    share = SlippedTips(np.ones(10), np.zeros(10)).push(np.random.default_rng(3).poisson(rate))
    assert share.max() < 0.1


def test_no_events_and_no_rate_say_nothing_for_long() -> None:
    tips = SlippedTips(np.zeros(3), np.zeros(3))
    share = tips.push(np.zeros((1000, 3), np.int64))
    assert np.isfinite(share).all()
    assert FIRST < share[0] < share[-1] <= 1


def test_cells_belong_to_the_nearest_tip_and_parts_of_an_edge_are_one() -> None:
    place = np.full((30, 40), -1)
    place[10, 8:11], place[12, 8:11] = 0, 1  # two parts of an edge
    place[11, 22:25] = 2
    found = regions(place.ravel(), 40).reshape(30, 40)
    assert found[11, 9] == found[10, 8] == found[12, 10] == 0
    assert found[11, 23] == found[14, 23] == 1
    assert found[11, 16] == found[25, 9] == -1  # beyond the reach
    with pytest.raises(ValueError, match="zero-size"):
        regions(np.full(1200, -1), 40)


@pytest.mark.quick(1)
@pytest.mark.parametrize(("worlds", "most"), [("usual", 0.05), ("hard", 0.12)])
def test_the_share_is_that_of_the_simulated_tips(worlds: str, most: float) -> None:
    """From the first tip to the last, whatever the chunks are; before the first slip it is 0."""
    (slide,) = followed(1, worlds)
    assert np.abs(slide.shown - slide.true)[slide.slipping].mean() < most
    before = slide.shown[: slide.first]
    assert (before[~np.isnan(before)] == 0).all()
    assert slide.shown[-1] > 0.8
