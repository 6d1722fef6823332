"""Motions as data: templates with parameters, and moves to places."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import pytest
import yaml

from sliplab.protocols import Dwell, Move, Position, load_plan
from sliplab.protocols.templates import templates, written_out
from tests.conftest import ROOT, SMALL
from tests.protocols.planning import plan_of, refused, rows

KINEMATIC = {"template": "kinematic", "depth": "$depth", "distance": "9 mm", "speed": "$speed"}
KINEMATIC["direction"] = "$direction"


def small(motion: Any, *unused: str) -> dict[str, Any]:
    """The pilot with another motion, without the factors that it does not use."""
    data = copy.deepcopy(SMALL)
    data["collection"]["motion"] = copy.deepcopy(motion)
    for name in unused:
        del data["collection"]["factors"][name]
    data["analysis"]["split"].pop("strata")
    return data


@pytest.mark.parametrize("name", ["kinematic", "gravity", "disturbance"])
def test_shipped_protocols_are_made_from_templates(name: str, tmp_path: Path) -> None:
    """Their hashes and programs are held elsewhere against those from before there were any."""
    text = (ROOT / "protocols" / f"{name}.yaml").read_text()
    assert yaml.safe_load(text)["collection"]["motion"]["template"] == name
    path = tmp_path / "copy.yaml"
    path.write_text(written_out(text, path))
    assert isinstance(yaml.safe_load(path.read_text())["collection"]["motion"], list)
    plan, same = load_plan(ROOT / "protocols" / f"{name}.yaml"), load_plan(path, stored=True)
    assert list(plan) == list(same)
    assert plan.collection_hash == same.collection_hash
    assert [plan.program(trial) for trial in plan] == [same.program(trial) for trial in same]
    assert written_out(path.read_text(), path) == path.read_text()
    before, after = yaml.safe_load(text), yaml.safe_load(path.read_text())
    assert before["collection"].pop("motion") != after["collection"].pop("motion")
    assert before == after


def test_a_template_is_its_phases(tmp_path: Path) -> None:
    plan = plan_of(small(KINEMATIC), tmp_path)
    same = plan_of(small(SMALL["collection"]["motion"]), tmp_path)
    assert [plan.program(trial) for trial in plan] == [same.program(trial) for trial in same]
    assert plan.collection_hash == same.collection_hash


def test_every_parameter_takes_a_factor(tmp_path: Path) -> None:
    data = small({**KINEMATIC, "settle": "$wait"})
    data["collection"]["factors"]["wait"] = {"unit": "s", "values": [0.5, 1]}
    waits = set()
    for trial in (plan := plan_of(data, tmp_path)):
        waits |= {s.seconds for s in plan.program(trial).steps if s.phase == "settle"}
    assert waits == {0.5, 1.0}


WRONG = """
    template: pull | template | must be one of disturbance, gravity
    template: ~ | template | must be one of
    dept: 2 mm | dept | did you mean 'depth'?
    distance: 9 kg | distance | must be one of: mm
    distance: 9 | distance | has no unit
    press: -1 mm/s | press | must be more than 0 mm/s
    depth: 4 mm, speed: $depth2 | speed | unknown factor $depth2
    travel: 51 mm/s | travel | exceeds collection.limits.speed
"""


@pytest.mark.parametrize(("change", "key", "says"), rows(WRONG))
def test_what_is_wrong_is_said_of_the_parameter(
    change: str, key: str, says: str, tmp_path: Path
) -> None:
    error = refused(small({**KINEMATIC, **yaml.safe_load(f"{{{change}}}")}), tmp_path)
    assert error.key == f"collection.motion.{key}"
    assert says in error.expected


def test_a_missing_parameter_is_named(tmp_path: Path) -> None:
    motion = {key: value for key, value in KINEMATIC.items() if key != "distance"}
    error = refused(small(motion), tmp_path)
    assert error.key == "collection.motion.distance"
    assert error.expected == "is missing: the template kinematic needs it, in mm, or a $factor"


def test_a_level_is_held_against_the_parameter(tmp_path: Path) -> None:
    data = small({**KINEMATIC, "press": "$rate"})
    data["collection"]["factors"]["rate"] = {"unit": "mm/s", "values": [1, -1]}
    error = refused(data, tmp_path)
    assert error.key == "collection.factors.rate.values[1]"
    assert error.expected == "must be more than 0 mm/s in collection.motion.press"


def test_templates_take_what_they_name() -> None:
    for name, template in templates().items():
        text = str(template.motion)
        for parameter in template.parameters:
            assert f"'${parameter}'" in text, (name, parameter)


ZIGZAG: list[dict[str, Any]] = [
    {"phase": "approach", "clearance": "5 mm", "speed": "20 mm/s"},
    {"phase": "move", "to": {"x": "-3 mm", "y": "1 mm"}, "speed": "10 mm/s"},
    {"phase": "press", "depth": "$depth", "speed": "2 mm/s"},
    {"phase": "hold", "settle": "1 s", "duration": "2 s"},
    {"phase": "move", "by": {"x": "4 mm", "depth": "-0.2 mm"}, "speed": "$speed"},
    {"phase": "hold", "settle": "0.1 s", "duration": "0.5 s"},
    {"phase": "move", "to": {"y": "$side"}, "speed": "$speed"},
    {"phase": "release", "clearance": "5 mm", "speed": "10 mm/s"},
    {"phase": "return", "speed": "20 mm/s"},
]


def zigzag() -> dict[str, Any]:
    data = small(ZIGZAG, "direction")
    data["collection"]["factors"]["side"] = {"unit": "mm", "values": [-2, 2]}
    return data


def test_a_motion_of_moves(tmp_path: Path) -> None:
    plan = plan_of(zigzag(), tmp_path)
    trial = next(t for t in plan if t.id.startswith("depth=2.8mm,side=-2mm,speed=1mmps"))
    assert plan.program(trial).steps == (
        Move("approach", Position(0.0, 0.0, -5.0), 20.0),
        Move("travel", Position(-3.0, 1.0, -5.0), 10.0),
        Move("press", Position(-3.0, 1.0, 2.8), 2.0),
        Dwell("settle", 1.0),
        Dwell("hold", 2.0, recorded=True),
        Move("move", Position(1.0, 1.0, 2.8 - 0.2), 1.0, recorded=True),
        Dwell("settle", 0.1, recorded=True),
        Dwell("hold", 0.5, recorded=True),
        Move("move", Position(1.0, -2.0, 2.8 - 0.2), 1.0, recorded=True),
        Move("release", Position(1.0, -2.0, -5.0), 10.0),
        Move("return", Position(0.0, 0.0, -5.0), 20.0),
    )


def change_move(place: int, **change: Any) -> dict[str, Any]:
    data = zigzag()
    data["collection"]["motion"][place] |= change
    return data


@pytest.mark.parametrize(
    ("place", "change", "key", "says"),
    [
        (4, {"by": {}}, "collection.motion[4].by", "give x, y or depth"),
        (4, {"to": {"x": "1 mm"}}, "collection.motion[4]", "either 'to' or 'by'"),
        (4, {"by": {"z": "1 mm"}}, "collection.motion[4].by.z", "unknown key"),
        (4, {"speed": "0 mm/s"}, "collection.motion[4].speed", "more than 0"),
        (1, {"to": {"x": "11 mm"}}, "collection.motion[1].to.x", "limits.workspace.x"),
        (
            6,
            {"to": {"y": "$side", "depth": "3.7 mm"}},
            "collection.motion[6].to.depth",
            "limits.depth",
        ),
        (1, {"to": {"depth": "-21 mm"}}, "collection.motion[1].to.depth", "limits.clearance"),
        (4, {"by": {"x": "14 mm"}}, "collection.motion", "limits.workspace.x"),
        (4, {"by": {"depth": "1 mm"}}, "collection.motion", "limits.depth"),
        (4, {"by": {"x": "1 kg"}}, "collection.motion[4].by.x", "must be one of: mm"),
    ],
)
def test_a_wrong_move_is_named(
    place: int, change: dict[str, Any], key: str, says: str, tmp_path: Path
) -> None:
    error = refused(change_move(place, **change), tmp_path)
    assert error.key == key
    assert says in error.expected


def test_a_level_that_leads_out_of_the_workspace_is_named(tmp_path: Path) -> None:
    data = zigzag()
    data["collection"]["factors"]["side"]["values"] = [-2, 10.5]
    error = refused(data, tmp_path)
    assert (error.key, error.value) == ("collection.factors.side.values[1]", "10.5 mm")


def test_moves_out_of_contact_alone_are_no_motion(tmp_path: Path) -> None:
    motion = [phase for index, phase in enumerate(ZIGZAG) if index not in {4, 5, 6}]
    error = refused(small(motion, "direction", "speed"), tmp_path)
    assert "or a 'move' between press and release" in error.expected
