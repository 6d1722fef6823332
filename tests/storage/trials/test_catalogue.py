"""The catalogue: one row a trial, units in the names, queries that can only query."""

from pathlib import Path

import pytest

from sliplab.storage.trials.catalogue import catalogue, query
from sliplab.storage.trials.store import Store
from tests.storage.trial_files import campaign, commit


def test_conditions_become_columns_with_units(tmp_path: Path) -> None:
    where = campaign(tmp_path / "s")
    commit(where, "a", condition={"depth": "2.4 mm", "speed": "0.6 mm/s", "side": "left"})
    commit(where, "b", condition={"depth": "3.4 mm", "speed": "1.6 mm/s", "side": "right"})
    table = catalogue(Store.open(tmp_path / "s"))
    assert list(table["trial"]) == ["a", "b"]
    assert list(query(table, "depth_mm > 3 and side == 'right'")["speed_mm_per_s"]) == [1.6]
    assert list(query(table, "events == 1000")["trial"]) == ["a", "b"]


@pytest.mark.parametrize(
    "expression", ["@x", "trial.__class__", "nothing > 3", "import os", "depth_mm >"]
)
def test_expressions_that_are_no_query_are_refused(expression: str, tmp_path: Path) -> None:
    where = campaign(tmp_path / "s")
    commit(where, "a")
    with pytest.raises(ValueError, match=r"must use columns|cannot be read"):
        query(catalogue(Store.open(tmp_path / "s")), expression)


def test_an_empty_store_has_an_empty_catalogue(tmp_path: Path) -> None:
    campaign(tmp_path / "s")
    assert len(catalogue(Store.open(tmp_path / "s"))) == 0
