"""Coverage of a bank's posterior over its own worlds."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmarks.twin import called_of_bank, coverage_lines, draw_ranks
from sliplab.analysis.twin.posterior import Bank


def linear_bank(worlds: int = 200) -> Bank:
    """Two parameters: one shows in a statistic with noise, nothing tells of the other."""
    rng = np.random.default_rng(3)
    theta = rng.uniform(-1.0, 1.0, (worlds, 2))
    s = np.column_stack([theta[:, 0] + 0.05 * rng.standard_normal(worlds), rng.random(worlds)])
    return Bank(("told", "untold"), ("a", "b"), theta, s, np.full(2, -1.0), np.full(2, 1.0))


def test_each_world_is_judged_once_by_worlds_without_it(tmp_path: Path) -> None:
    bank = linear_bank()
    worlds = called_of_bank(bank)
    told, untold = zip(*worlds, strict=True)
    assert sorted(one.truth for one in told) == sorted(bank.theta[:, 0].tolist())
    assert all(one.estimate.identified for one in told)
    assert not any(one.estimate.identified for one in untold)
    # 190 expected, standard deviation 3; nothing told: the interval is the prior's
    assert 181 <= sum(one.holds for one in told) <= 199
    assert 181 <= sum(one.holds for one in untold) <= 199
    rows = [line.split("|") for line in coverage_lines(worlds, "without forces")]
    assert [row[1].strip() for row in rows] == ["told", "untold", "all"]
    assert rows[0][3].strip() == "200 of 200"
    assert [cell.strip() for cell in rows[1][3:6]] == ["0 of 200", "-", "-"]
    assert float(rows[0][6]) > 0.001
    assert rows[2][3].strip() == "200 of 400"
    ranks = np.array([[one.rank for one in world] for world in worlds])
    draw_ranks({"toy": ranks}, tmp_path / "ranks.png")
    assert (tmp_path / "ranks.png").read_bytes().startswith(b"\x89PNG")
