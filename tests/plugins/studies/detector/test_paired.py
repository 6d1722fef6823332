"""Differences over seeds, against SciPy's paired test."""

import numpy as np
import pytest
from scipy.stats import ttest_rel

from sliplab.plugins.studies.detector.paired import PairedDifference, paired_difference


def test_the_interval_is_that_of_the_paired_test() -> None:
    rng = np.random.default_rng(0)
    for n in (2, 3, 8):
        ours, theirs = rng.normal(1.0, 0.3, n), rng.normal(0.0, 0.3, n)
        found = paired_difference(ours.tolist(), theirs.tolist())
        expected = ttest_rel(ours, theirs)
        interval = expected.confidence_interval(0.95)
        assert (found.low, found.high) == pytest.approx((interval.low, interval.high))
        assert found.mean == pytest.approx((ours - theirs).mean())
        assert found.significant == bool(expected.pvalue < 0.05)
        assert found.seeds == n


def test_seeds_with_one_figure_only_are_left_out() -> None:
    found = paired_difference([1.0, None, 3.0], [0.5, 1.0, None])
    assert found == PairedDifference(0.5, None, None, 1)
    assert found.significant is None
    assert paired_difference([None], [1.0]) == PairedDifference(None, None, None, 0)
    assert paired_difference([2.0, 3.0], [1.0, 2.0]).significant  # no spread at all
    with pytest.raises(ValueError, match="zip"):
        paired_difference([1.0], [])
