"""A small campaign over skins and temperatures, from its plan to its labels and its split."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from sliplab.analysis.campaigns import collected as campaigns_of
from sliplab.analysis.report.outcomes import Conditions
from sliplab.storage.trials.store import TrialStore
from tests.command_line import answer, here
from tests.conftest import ROOT
from tests.flows.collecting.test_session import session
from tests.flows.conftest import take_all, tiny, write


def over_skins() -> dict[str, Any]:
    """Two skins, two temperatures, two speeds; a skin that no network has seen is for the test."""
    data = tiny()
    data["name"] = "skins"
    collection = data["collection"]
    collection["factors"]["speed"]["values"] = [1.2, 1.6]
    collection["factors"]["direction"]["values"] = [90]
    collection["motion"][3]["distance"] = "5 mm"
    collection["context"] = {
        "skin": {"values": ["smooth", "ridged"], "changeover": "person"},
        "temperature": {"unit": "degC", "values": [21, 35.5], "changeover": "person"},
        "operator": {"values": ["anna"]},
    }
    data["analysis"]["split"] = {
        "method": "leave_conditions_out",
        "validation_levels": {"temperature": ["35.5 degC"]},
        "test_levels": {"skin": ["ridged"]},
    }
    return data


@pytest.mark.long
def test_skins_and_temperatures_go_through_every_step(tmp_path: Path) -> None:
    protocol, store = write(tmp_path / "skins.yaml", over_skins()), tmp_path / "store"
    rig = ROOT / "rigs" / "rehearsal.yaml"
    plan = answer("plan", protocol, "--rig", rig)
    assert plan["count"] == 8
    assert plan["stretches"] == [[0, 1], [2, 3], [4, 5], [6, 7]]
    prompts = [
        task["prompt"] for trial in plan["trials"] for task in trial["before"] if task["by_person"]
    ]
    assert prompts.count("set skin to ridged") == 1
    assert prompts.count("set operator to anna") == 0
    collected = answer("collect", protocol, "--rig", rig, "--store", store)
    assert (collected["committed"], collected["missing"]) == (8, 0)

    where = 'skin == "ridged" and temperature_degC > 30'
    found = answer("trials", store, "--where", where)["trials"]
    assert len(found) == 2
    assert {(row["skin"], row["temperature_degC"], row["operator"]) for row in found} == {
        ("ridged", 35.5, "anna")
    }
    for ending, read in ((".csv", pd.read_csv), (".parquet", pd.read_parquet)):
        path = tmp_path / f"trials{ending}"
        assert here("trials", store, "--output", path).returncode == 0
        table = read(path)
        assert sorted(table["skin"]) == ["ridged"] * 4 + ["smooth"] * 4
        assert sorted(set(table["temperature_degC"])) == [21.0, 35.5]

    assert answer("label", store)["done"] == 8
    campaigns = campaigns_of(TrialStore.open(store))
    parts = {trial.id: trial.split for trial, _ in campaigns[0].trials}
    for name, part in parts.items():
        held = "validation" if "temperature=35.5degC" in name else "train"
        assert part == ("test" if "skin=ridged" in name else held)
    assert Conditions(campaigns, [], "kinematic").factors["skin"] == ["smooth", "ridged"]


@pytest.mark.parametrize("confirmed", [True, False])
def test_a_person_is_asked_for_each_skin_once(confirmed: bool, tmp_path: Path) -> None:
    data = over_skins()
    data["collection"]["factors"]["speed"]["values"] = [1.6]
    data["collection"]["motion"][3]["distance"] = "1 mm"
    data["collection"]["context"].pop("temperature")
    data["analysis"]["split"].pop("validation_levels")
    work, campaign = session(tmp_path / "a", data)
    asked: list[tuple[str, str]] = []

    class Person:
        def ask(self, task: str, prompt: str, expected: str) -> bool:
            asked.append((task, expected))
            return confirmed or expected != "ridged"

    work.rig.operator = Person()
    if confirmed:
        take_all(work)
    else:
        with pytest.raises(Exception, match="'set skin to ridged' was not confirmed"):
            take_all(work)
    assert asked == [("condition", "smooth"), ("condition", "ridged")]
    assert len(campaign.committed()) == (2 if confirmed else 1)
