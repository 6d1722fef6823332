"""The twist: a rotation of the sensor about the plate's normal, as a phase of a motion."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import pytest
import yaml

from sliplab.protocols import Dwell, InputError, Move, Plan, Position, Twist, load_plan
from tests.conftest import ROOT
from tests.protocols.planning import plan_of, put_all, refused, rows

PRESS_TWIST: dict[str, Any] = yaml.safe_load((ROOT / "protocols" / "press_twist.yaml").read_text())


def changed(folder: Path, **change: Any) -> Plan:
    """The shipped protocol with other parts of its collection."""
    data = copy.deepcopy(PRESS_TWIST)
    for key, value in change.items():
        known = data["collection"].get(key)
        both = isinstance(known, dict) and isinstance(value, dict)
        data["collection"][key] = {**known, **value} if both else value
    return plan_of(data, folder)


def test_a_twist_turns_on_the_spot_and_back_where_it_is_clear() -> None:
    plan = load_plan(Path("press_twist"))
    trial = next(t for t in plan if t.id == "angle=-40deg,depth=2.8mm,speed=8degps,r=1")
    twisted = Position(0.0, 0.0, 2.8, -40.0)
    assert plan.program(trial).steps == (
        Move("approach", Position(0.0, 0.0, -5.0), 20.0),
        Move("press", Position(0.0, 0.0, 2.8), 2.0),
        Dwell("settle", 1.0),
        Dwell("hold", 2.0, recorded=True),
        Twist("twist", twisted, 8.0, recorded=True),
        Move("release", Position(0.0, 0.0, -5.0, -40.0), 10.0),
        Twist("untwist", Position(0.0, 0.0, -5.0), 20.0),
        Move("return", Position(0.0, 0.0, -5.0), 20.0),
    )
    assert plan.seconds(trial, recorded_only=True) == 2.0 + 40 / 8


def test_a_place_that_is_not_twisted_reads_as_ever() -> None:
    assert repr(Position(1.0, 2.0, 3.0)) == "Position(x_mm=1.0, y_mm=2.0, depth_mm=3.0)"
    assert repr(Position(1.0, 2.0, 3.0, 4.0)).endswith("depth_mm=3.0, twist_deg=4.0)")


def test_opposite_angles_are_two_conditions(tmp_path: Path) -> None:
    """Two directions that differ by a full turn are one; two twists are not."""
    limits, angles = {"twist": "200 deg"}, {"angle": {"unit": "deg", "values": [-180, 180]}}
    assert len(changed(tmp_path, limits=limits | {"duration": "100 s"}, factors=angles)) == 54


# changes of the collection | the key | what is said
WRONG = """
    limits.twist: 30 deg | factors.angle.values[0] | twist = 30
    limits.twist: | limits.twist | is needed
    limits.twist_speed: 5 deg/s | factors.speed.values[1] | is over
    factors.angle: {unit: deg, values: [0]} | factors.angle.values[0] | must not be 0
    factors.speed: {unit: deg/s, values: [-4]} | factors.speed.values[0] | more than 0 deg/s in \
collection.motion.speed
    factors.speed: {unit: mm/s, values: [4]} | factors.speed.unit | must be deg/s where $speed \
stands
    plate: {mass: 0.2 kg} | motion | cannot twist on a sliding plate
"""


@pytest.mark.parametrize(("change", "key", "says"), rows(WRONG))
def test_a_wrong_twist_is_named(change: str, key: str, says: str, tmp_path: Path) -> None:
    data = copy.deepcopy(PRESS_TWIST)
    put_all(data, change, "collection")
    error = refused(data, tmp_path)
    assert error.key == f"collection.{key}"
    assert says in error.expected


def test_twists_add_up_to_the_limit(tmp_path: Path) -> None:
    motion = load_plan(Path("press_twist")).protocol.collection.model_dump(mode="json")["motion"]
    motion.insert(4, dict(motion[3]))
    with pytest.raises(InputError, match="reaches a twist of -80 deg, over") as caught:
        changed(tmp_path, motion=motion)
    assert caught.value.key == "collection.motion"
