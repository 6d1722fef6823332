"""The table of scores: every number of a summary, with its columns."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from sliplab.analysis.report.against import compare, load_report
from sliplab.analysis.report.scores import COLUMNS, FILE, score_table
from sliplab.protocols.errors import InputError
from sliplab.storage.files import read_json
from sliplab.storage.trials.catalogue import write_table
from tests.flows.older import older_store

KEYS = ["figure", "campaign", "experiment", "split", "condition", "trial", "detector"]
SETTINGS = {"timing_s", "versions", "protocols", "seeds", "detection", "paper"}
LEVELS = {"seed", "tenth", "lead", "to"}


@pytest.fixture(scope="module")
def summary(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The numbers of an older store's report."""
    return read_json(older_store(tmp_path_factory.mktemp("older")) / "report" / "summary.json")


def numbers(value: Any) -> Iterator[float]:
    """Every number in JSON data, without levels and settings."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from () if key in LEVELS else numbers(inner)
    elif isinstance(value, list):
        for inner in value:
            yield from numbers(inner)
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield float(value)


def rows_of(table: pd.DataFrame, **columns: str) -> pd.DataFrame:
    for name, value in columns.items():
        table = table[table[name] == value]
    return table


def test_every_number_of_a_summary_is_in_the_table(summary: dict[str, Any]) -> None:
    table = score_table(summary)
    assert list(table.columns) == list(COLUMNS)
    assert not table.duplicated(KEYS).any()
    cells = set(table[["value", "low", "high"]].to_numpy().ravel()) | set(table.n.dropna())
    listed = {key: value for key, value in summary.items() if key not in SETTINGS}
    assert set(numbers(listed)) <= cells


def test_figures_have_their_unit_and_count(summary: dict[str, Any]) -> None:
    table, part = score_table(summary), summary["kinematic"]
    (lead,) = rows_of(table, figure="lead_ms.mean", experiment="kinematic").to_dict("records")
    assert (lead["value"], lead["n"]) == (part["lead_ms"]["mean"], part["lead_ms"]["n"])
    assert (lead["unit"], lead["split"], lead["simulated"]) == ("ms", "test", True)
    strict = rows_of(table, figure="interval").iloc[0]
    assert (strict.value, strict.n) == (part["interval"]["share"], part["interval"]["n"])
    assert strict.unit == "share"
    counts = rows_of(table, figure="latency_ms.gross.missed", experiment="kinematic")
    assert counts.unit.tolist() == [""]


@pytest.mark.parametrize(
    ("number", "figure", "unit"),
    [
        ({"rates": [{"asked": 0.01, "choice": 4}]}, "rates.choice", ""),
        ({"rates": [{"asked": 0.01, "levels": {"gross": 48.5}}]}, "rates.levels.gross", ""),
        (
            {"rates": {"by_reference": {"true": {"unsure": 2}}}},
            "rates.by_reference.true.unsure",
            "",
        ),
        ({"curve": [{"allowed": 1, "rate": 0.1}]}, "curve.rate", "share"),
        ({"rates": {"iaf1": 0.1}}, "rates.iaf1", "share"),
        ({"force": {"rmse_n": 0.2}}, "force.rmse_n", "N"),
        ({"force": {"rmse_n": {"each": 0.2}}}, "force.rmse_n.each", "N"),
    ],
)
def test_units_are_of_the_key_that_has_one(number: dict[str, Any], figure: str, unit: str) -> None:
    table = score_table({"simulated": True, **number}, {}, {"rmse_n": "N"}, {"force": "validation"})
    (row,) = table.to_dict("records")
    assert (row["figure"], row["unit"]) == (figure, unit)
    assert row["split"] == ("validation" if "force" in number else "")


def test_shares_are_no_counts(summary: dict[str, Any]) -> None:
    table = rows_of(score_table(summary), unit="share")
    assert len(table) > 50
    assert (table.value.dropna().abs() <= 1).all()


def test_parts_of_a_key_that_are_columns_are_not_in_the_figure() -> None:
    share = {"share": 0.5, "low": 0.4, "high": None, "n": 8, "trials": 2}
    table = score_table(
        {
            "simulated": False,
            "kinematic": {
                "by_factor": {"depth": {"2 mm": share}},
                "seeds": {"each": [{"seed": 3, "chosen": True, "strict": 0.5, "margin": None}]},
                "samples": {"train": 4, "test": 2},
                "intervals": {
                    "lead_ms": {"n": 2, "mean": [1.0, None]},
                    "latency_incipient_ms": {"n": 2, "median": [7.0, 9.0]},
                },
                "latency_ms": {"incipient": {"median": 8.0, "n": 2}},
                "lead_ms": {"mean": 2.0, "n": 2},
            },
            "networks": {"other": {"gravity": {"lead_ms": {"mean": 3.0, "n": 1}}}},
            "detectors": {"detectors": [{"name": "cusum", "stride_ms": 10, "curve": []}]},
            "planned": {"pilot": {"seconds": 1.5}},
        }
    )
    level = rows_of(table, figure="by_factor").iloc[0]
    assert (level.condition, level.value, level.low, level.n) == ("depth=2 mm", 0.5, 0.4, 8)
    assert math.isnan(level.high)
    seed = rows_of(table, condition="seed=3")
    assert seed.figure.tolist() == ["seeds.each.strict", "seeds.each.margin"]
    assert rows_of(table, figure="samples").split.tolist() == ["train", "test"]
    leads = rows_of(table, figure="lead_ms.mean")
    assert leads.value.tolist() == [2.0, 3.0]
    assert leads.detector.tolist() == ["", "other"]
    assert leads.high.tolist()[0] == math.inf
    median = rows_of(table, figure="latency_ms.incipient.median").iloc[0]
    assert (median.value, median.low, median.high) == (8.0, 7.0, 9.0)
    assert rows_of(table, campaign="pilot").unit.tolist() == ["s"]


def test_a_lost_detection_is_infinitely_late() -> None:
    times = dict.fromkeys(("latency_incipient_ms", "latency_gross_ms", "lead_ms"))
    trial = {"campaign": "a", "experiment": "gravity", "trial": "t", "outcome": "late"}
    summary = {"simulated": True, "trials": [{**trial, "gross": "false_early", **times}]}
    table = score_table(summary, {("a", "t"): {"depth": "2 mm"}}).set_index("figure")
    assert table.value["latency_incipient_ms"] == math.inf
    assert table.value["lead_ms"] == -math.inf
    assert math.isnan(table.value["latency_gross_ms"])
    assert table.value[["outcome.late", "outcome.missed", "gross.false_early"]].tolist() == [
        1,
        0,
        1,
    ]
    assert set(table.condition) == {"depth=2 mm"}


def test_the_file_is_the_same_twice(summary: dict[str, Any], tmp_path: Path) -> None:
    made = []
    for _ in range(2):
        write_table(score_table(summary), tmp_path / FILE)
        made.append((tmp_path / FILE).read_bytes())
    assert made[0] == made[1]
    pd.testing.assert_frame_equal(pd.read_parquet(io.BytesIO(made[0])), score_table(summary))


def test_reports_are_compared_by_their_tables(tmp_path: Path) -> None:
    older = load_report(older_store(tmp_path / "store"))
    figures = compare(older, older).figures
    assert len(figures) > 10
    assert not any(row.difference or row.beyond for row in figures)
    (tmp_path / "summary.json").write_text('{"simulated": true}')
    for wrong in ("summary.json", "nowhere"):
        with pytest.raises(InputError, match="--against"):
            load_report(tmp_path / wrong)
