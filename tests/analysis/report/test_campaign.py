"""The table of what touching off found."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from sliplab.analysis.report.campaign import _depth_zeros
from sliplab.protocols import load_plan

ROOT = Path(__file__).parents[3]


def taken(found: list[tuple[float | None, float | None]]) -> Any:
    """Return a collected pilot whose blocks of 12 trials found a depth zero and a scatter."""
    plan = load_plan(ROOT / "protocols/pilot.yaml")
    trials = [
        (trial, SimpleNamespace(record=SimpleNamespace(depth_zero_mm=zero, depth_zero_sd_mm=sd)))
        for number, trial in enumerate(plan)
        for zero, sd in [found[number // 12]]
    ]
    return SimpleNamespace(name="pilot", plan=plan, trials=trials)


def test_blocks_that_found_the_same_depth_are_counted_apart() -> None:
    (table,) = _depth_zeros([taken([(0.015, None), (0.015, None), (-0.02, None)])])
    assert table.rows == [["pilot", "3", "1", "+0.015", "-0.020", "-0.020", "+0.015", "-", "-"]]


def test_scatters_are_averaged_over_blocks_by_their_squares() -> None:
    item = taken([(0.015, 0.03), (0.02, 0.04), (0.02, 0.04)])
    (row,) = _depth_zeros([item])[0].rows
    assert float(row[7]) == pytest.approx(((0.03**2 + 2 * 0.04**2) / 3) ** 0.5, abs=5e-4)


def test_a_block_without_depth_zero_is_not_counted() -> None:
    (table,) = _depth_zeros([taken([(None, None), (0.015, None), (0.02, None)])])
    assert table.rows[0][1] == "2"
    assert _depth_zeros([taken([(None, None)] * 3)]) == []
