"""Coverage of a bank's posterior over its own worlds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.stats import kstest

from benchmarks.twin import called_of_bank, coverage_lines, draw_ranks, ranks_of
from sliplab.plugins.twin.posterior import Bank


def linear_bank(worlds: int = 200) -> Bank:
    """Two parameters: one shows in a statistic with noise, nothing tells of the other."""
    rng = np.random.default_rng(3)
    theta = rng.uniform(-1.0, 1.0, (worlds, 2))
    s = np.column_stack([theta[:, 0] + 0.05 * rng.standard_normal(worlds), rng.random(worlds)])
    return Bank(("shown", "unseen"), ("a", "b"), theta, s, np.full(2, -1.0), np.full(2, 1.0))


def test_each_world_is_judged_once_by_worlds_without_it(tmp_path: Path) -> None:
    bank = linear_bank()
    worlds = called_of_bank(bank)
    shown, unseen = zip(*worlds, strict=True)
    assert sorted(one.truth for one in shown) == sorted(bank.theta[:, 0].tolist())
    assert all(one.estimate.identified for one in shown)
    assert not any(one.estimate.identified for one in unseen)
    # 190 expected, standard deviation 3; nothing seen: the interval is the prior's
    assert 181 <= sum(one.holds for one in shown) <= 199
    assert 181 <= sum(one.holds for one in unseen) <= 199
    rows = [line.split("|") for line in coverage_lines(worlds, "without forces")]
    assert [row[1].strip() for row in rows] == ["shown", "unseen", "all"]
    assert rows[0][3].strip() == "200 of 200"
    assert [cell.strip() for cell in rows[1][3:6]] == ["0 of 200", "-", "-"]
    ranks = ranks_of(worlds)
    assert all(kstest(column, "uniform").pvalue > 0.001 for column in ranks.T)
    assert rows[2][3].strip() == "200 of 400"
    draw_ranks({"toy": ranks}, tmp_path / "ranks.png")
    assert (tmp_path / "ranks.png").read_bytes().startswith(b"\x89PNG")
