"""A study: its options become a command, its result files."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import pandas as pd
import pytest
import typer
from typer.testing import CliRunner

from sliplab.analysis.report.page import Table
from sliplab.analysis.study import Finding, Study, tables, write_tables
from sliplab.flows.cli.study_command import study_app
from sliplab.protocols import InputError
from sliplab.storage.schema.document import Bool, Document, Number, Part


class Rate(Part):
    """A rate of a trial."""

    trial: str
    rate: Number


class Rates(Document):
    """Rates."""

    simulated: Bool
    rates: tuple[Rate, ...]


PAGE = """{% extends "page.html" %}
{% block title %}Rates{% endblock %}
{% block top %}<h1>{{ result.rates|length }} rates, {{ most }} at most</h1>{% endblock %}
{% block sections %}{% endblock %}
"""


def study(folder: Path, **ends: Any) -> Study[Rates]:
    """Return a study whose command writes into a folder."""
    page = folder / "page.html"
    page.write_text(PAGE)

    def measure(
        trials: Annotated[int, typer.Option("--trials", min=1, help="Number of trials.")] = 2,
    ) -> Finding[Rates]:
        """Measure rates."""
        rates = tuple(Rate(trial=f"t{k}", rate=0.5 * k) for k in range(trials))
        return Finding(Rates(simulated=True, rates=rates), folder / "out", **ends)

    def shown(result: Rates) -> Iterator[Table | str]:
        yield Table(("trial", "rate (1/s)"), [[it.trial, str(it.rate)] for it in result.rates])
        yield "rates of the hold"

    return Study(
        name="rates",
        title="Rates",
        measure=measure,
        result=Rates,
        page=page,
        view=lambda result: {"most": max(it.rate for it in result.rates)},
        shown=shown,
        example="rates --trials 3",
    )


def test_command_has_the_options_and_writes_everything(tmp_path: Path) -> None:
    made = study(tmp_path)
    done = CliRunner().invoke(study_app(made), ["--trials", "3", "--json"])
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout)
    assert found.pop("page") == str(tmp_path / "out" / "rates.html")
    assert found == json.loads((tmp_path / "out" / "rates.json").read_text())
    assert made.read(tmp_path / "out" / "rates.json").rates[2].rate == 1.0
    assert "3 rates, 1.0 at most" in (tmp_path / "out" / "rates.html").read_text()
    for suffix, read in ((".csv", pd.read_csv), (".parquet", pd.read_parquet)):
        frame = read(tmp_path / "out" / "tables" / f"rates.rates{suffix}")
        assert frame.to_dict("list") == {
            "trial": ["t0", "t1", "t2"],
            "rate": [0.0, 0.5, 1.0],
            "simulated": [True] * 3,
        }


def test_terminal_shows_tables_and_lines(tmp_path: Path) -> None:
    done = CliRunner().invoke(study_app(study(tmp_path)), [])
    assert "rate (1/s)" in done.output
    assert "rates of the hold" in done.output
    assert f"page: {tmp_path / 'out' / 'rates.html'}" in done.output.replace("\n", "")


def test_json_names_further_files_and_lines_stand_beside_it(tmp_path: Path) -> None:
    made = study(tmp_path, named={"folder": tmp_path})
    done = CliRunner().invoke(study_app(made), ["--json"])
    assert json.loads(done.stdout)["folder"] == str(tmp_path)
    assert "rates of the hold" in done.stderr
    assert "rate (1/s)" not in done.stderr


def test_json_entries_replace_those_of_the_result(tmp_path: Path) -> None:
    made = study(tmp_path, named={"rates": [1], "made": 2})
    done = CliRunner().invoke(study_app(made), ["--json"])
    found = json.loads(done.stdout)
    assert (found["rates"], found["made"], found["simulated"]) == ([1], 2, True)
    assert len(made.read(tmp_path / "out" / "rates.json").rates) == 2


def test_dry_run_writes_nothing(tmp_path: Path) -> None:
    done = CliRunner().invoke(study_app(study(tmp_path, dry=True)), ["--json"])
    assert set(json.loads(done.stdout)) == {"simulated", "rates"}
    assert "page" not in done.stderr
    assert not (tmp_path / "out").exists()


def test_column_of_numbers_and_words_becomes_text(tmp_path: Path) -> None:
    document = Document.model_validate({"levels": [{"value": 2.5}, {"value": "8 bit"}, {}]})
    write_tables(tmp_path, "s", document)
    column = pd.read_parquet(tmp_path / "s.levels.parquet")["value"]
    assert [*column.dropna()] == ["2.5", "8 bit"]
    assert column.isna().sum() == 1


@pytest.mark.parametrize(
    ("ends", "code"), [({"failed": True}, 1), ({"error": InputError("--trials", "", 2, "no")}, 1)]
)
def test_what_fails_has_its_files_all_the_same(
    tmp_path: Path, ends: dict[str, Any], code: int
) -> None:
    made = study(tmp_path, stem="friction", **ends)
    done = CliRunner().invoke(study_app(made), [])
    assert done.exit_code == code
    assert (tmp_path / "out" / "friction.json").exists()
    if "error" in ends:
        assert done.exception is ends["error"]
        assert not done.output


def test_lists_in_lists_become_tables_with_the_cells_above_them() -> None:
    document = {
        "campaign": "c",
        "detectors": [
            {
                "name": "a",
                "figures": [{"name": "all", "per_hour": {"value": 2.0, "low": 1.0, "high": None}}],
                "level": [1, 2],
            },
            {"name": "b", "figures": []},
        ],
        "hours": {"test": 1.0},
        "worlds": {"w1": {"n": 1}, "w2": {"n": 2}},
    }
    found = dict(tables(document, simulated=False))
    assert found["detectors"] == [
        {"name": "a", "level": "[1, 2]", "simulated": False},
        {"name": "b", "simulated": False},
    ]
    assert found["detectors.figures"] == [
        {
            "name": "a",
            "level": "[1, 2]",
            "figures_name": "all",
            "per_hour": 2.0,
            "per_hour_low": 1.0,
            "per_hour_high": None,
            "simulated": False,
        }
    ]
    assert [row["name"] for row in found["worlds"]] == ["w1", "w2"]
    assert set(found) == {"detectors", "detectors.figures", "worlds"}


def test_args_of_the_docstring_are_the_help_of_options(tmp_path: Path) -> None:
    def measure(skip: int = 0, most: int = 3) -> Finding[Rates]:
        """Measure rates.

        Of every trial.

        Args:
            skip: trials to leave out
                first.
            most: trials at most.

        Raises:
            StoreError: there is none.
        """
        raise NotImplementedError

    made = CliRunner().invoke(study_app(replace(study(tmp_path), measure=measure)), ["--help"])
    shown = " ".join(made.output.replace("│", " ").split())
    assert "Measure rates. Of every trial." in shown
    assert re.search(r"--skip <int> Trials to leave out first\.", shown)
    assert re.search(r"--most <int> Trials at most\.", shown)
    assert "Args:" not in shown
    assert "StoreError" not in shown
