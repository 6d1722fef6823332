"""Nuisances as elements of a protocol: names, strengths, motions of the arm, and requests."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from sliplab.protocols import InputError, Plan, PlannedTrial, load_plan
from sliplab.protocols.nuisances import MIX, NONE, QUIET_S, SHIPPED
from sliplab.protocols.program import Dwell, Move, Twist
from tests.conftest import ROOT

FAR = {"kind": "arm_motion", "distance": "8 mm", "speed": "20 mm/s"}


def edited(folder: Path, change: dict[str, Any] | None = None, **limits: str | None) -> Plan:
    """The shipped protocol with other nuisances or limits; None leaves a limit out."""
    data = yaml.safe_load((ROOT / "protocols/nuisances.yaml").read_text())
    data["collection"]["nuisances"] |= change or {}
    for name, value in limits.items():
        data["collection"]["limits"].pop(name, None)
        if value is not None:
            data["collection"]["limits"][name] = value
    (folder / "p.yaml").write_text(yaml.safe_dump(data))
    return load_plan(folder / "p.yaml")


def under(plan: Plan, name: str, strength: int = 100) -> PlannedTrial:
    """The first trial with a nuisance at a strength."""
    names = ("nuisance", "strength")
    found = (t for t in plan if tuple(dict(t.condition)[n] for n in names) == (name, strength))
    return min(found, key=lambda trial: trial.id)


@pytest.fixture
def plan() -> Plan:
    """The shipped protocol."""
    return load_plan(Path("nuisances"))


def test_all_that_ship_are_levels_of_the_shipped_protocol(plan: Plan) -> None:
    assert set(plan.levels["nuisance"]) == {NONE, MIX, *SHIPPED}
    assert plan.program(under(plan, NONE)).nuisances == ()
    assert plan.program(under(plan, MIX)).nuisances == tuple(SHIPPED.values())


def test_strength_multiplies_sizes(plan: Plan) -> None:
    (half,), (double,) = (plan.program(under(plan, "brush", s)).nuisances for s in (50, 200))
    assert (half.force, double.force) == (SHIPPED["brush"].force / 2, SHIPPED["brush"].force * 2)
    assert half.every == double.every


@pytest.mark.parametrize(
    ("name", "step"), [("arm_motion", Move), ("rotation", Twist), ("regrasp", Move)]
)
def test_the_arm_moves_in_the_hold_and_comes_back(plan: Plan, name: str, step: type) -> None:
    steps = plan.program(under(plan, name)).steps
    still = plan.program(under(plan, NONE)).steps
    made = [(k, each) for k, each in enumerate(steps) if each.phase == "nuisance"]
    count = int((36 - QUIET_S) / float(SHIPPED[name].every))
    assert len(made) == 2 * count
    assert all(isinstance(each, step) and each.recorded for _, each in made)
    pressed = next(each.to for each in steps if isinstance(each, Move) and each.phase == "press")
    assert [each.to == pressed for _, each in made] == [False, True] * count
    # all else is as without nuisances, and labels count from an undisturbed hold
    holds = [each for each in steps if isinstance(each, Dwell) and each.phase == "hold"]
    assert sum(each.seconds for each in holds) == pytest.approx(36, abs=1e-9)
    assert holds[-1].seconds >= QUIET_S
    others = [each for each in steps if each.phase not in {"hold", "nuisance"}]
    assert others == [each for each in still if each.phase != "hold"]


def test_a_person_is_asked_once_and_told_when_it_ends(plan: Plan) -> None:
    asked = {}
    for trial in plan:
        for task in plan.tasks_before(trial):
            if task.kind == "changeover":
                asked[trial.index] = task.prompt
    first = {dict(trial.condition)["nuisance"]: trial for trial in reversed(plan.trials)}
    tapping = [asked.get(t.index) for t in plan if dict(t.condition)["nuisance"] == "tap_table"]
    assert tapping == [
        said
        for um in (10, 20, 40)
        for said in (
            f"from now on: knock on the table about every 2 s, so that it moves by {um} um",
            *[None] * 3,
        )
    ]
    assert first["none"].index not in asked  # nothing has been asked for yet
    assert asked[first["arm_motion"].index] == "from now on: leave the rig alone again"
    assert first["rotation"].index not in asked
    assert asked[first["mix"].index].count(";") == 7


@pytest.mark.parametrize(
    ("change", "limits", "said"),
    [
        ({"strength": "-5 %"}, {}, "strength"),
        ({"elements": {"mix": {"kind": "warmth", "rise": "5 degC"}}}, {}, "stands for itself"),
        ({"elements": {"tap_arm": {"kind": "knocking"}}}, {}, "tap_arm"),
        ({"elements": {"tap_arm": {"kind": "warmth", "rise": "-5 degC"}}}, {}, "more than 0"),
        ({}, {"twist": None}, r"limits.twist: is needed.*'rotation' turns the sensor"),
        ({}, {"twist": "0.3 deg"}, r"twist of 0.4 deg, over collection.limits.twist = 0.3 deg"),
        ({}, {"twist_speed": "4 deg/s"}, r"5 deg/s.*limits.twist_speed = 4 deg/s"),
        ({"elements": {"arm_motion": FAR}}, {}, "reaches x"),
    ],
)
def test_what_is_wrong_is_said(tmp_path: Path, change: Any, limits: Any, said: str) -> None:
    change = change or {"apply": "$nuisance"}
    with pytest.raises(InputError, match=said):
        edited(tmp_path, change, **limits)


def test_a_level_that_is_no_nuisance_is_named(tmp_path: Path) -> None:
    data = yaml.safe_load((ROOT / "protocols/nuisances.yaml").read_text())
    data["collection"]["factors"]["nuisance"]["values"] = ["none", "tapping"]
    (tmp_path / "p.yaml").write_text(yaml.safe_dump(data))
    said = r"factors.nuisance.values\[1\] = tapping: must be one of none, mix, tap_table"
    with pytest.raises(InputError, match=said):
        load_plan(tmp_path / "p.yaml")


def test_a_protocol_may_bring_its_own(tmp_path: Path) -> None:
    own = {"fan": {"kind": "vibration", "speed": "0.2 mm/s", "low": "20 Hz", "high": "30 Hz"}}
    data = yaml.safe_load((ROOT / "protocols/nuisances.yaml").read_text())
    data["collection"]["nuisances"]["elements"] = own
    data["collection"]["factors"]["nuisance"]["values"] = ["none", "fan"]
    (tmp_path / "p.yaml").write_text(yaml.safe_dump(data))
    plan = load_plan(tmp_path / "p.yaml")
    (fan,) = plan.program(under(plan, "fan", 200)).nuisances
    assert (fan.kind, str(fan.speed), str(fan.high)) == ("vibration", "0.4", "30")
    assert plan.collection_hash != load_plan(Path("nuisances")).collection_hash
