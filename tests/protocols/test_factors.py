"""Every number of every phase may be a factor, held against its field, its unit and limits."""

from __future__ import annotations

import copy
import hashlib
from pathlib import Path
from typing import Any

import pytest
import yaml

from sliplab.protocols import load_plan
from tests.conftest import ROOT, SMALL
from tests.protocols.planning import plan_of, refused

GRAVITY: dict[str, Any] = yaml.safe_load((ROOT / "protocols" / "pilot_gravity.yaml").read_text())
DISTURBANCE: dict[str, Any] = yaml.safe_load((ROOT / "protocols" / "disturbance.yaml").read_text())

# protocol, place of the phase in its motion, field, unit, two levels that are right,
# and one that is out of the field's range
FIELDS = """
    pilot 0 clearance mm 4 6.5 0
    pilot 0 speed mm/s 10 25 -1
    pilot 1 depth mm 2.4 3 0
    pilot 1 speed mm/s 1 2.5 0
    pilot 2 settle s 0 1.5 -0.5
    pilot 2 duration s 2 3 0
    pilot 3 distance mm 6 9 0
    pilot 3 speed mm/s 0.5 1 0
    pilot 4 clearance mm 5 6 -5
    pilot 4 speed mm/s 5 10 0
    pilot 5 speed mm/s 5 20 0
    gravity 0 duration s 0 1 -1
    gravity 4 duration s 0.5 0.8 -1
    gravity 6 distance mm 4 4.2 0
    gravity 6 speed mm/s 0.5 0.6 0
"""


def varied(source: dict[str, Any], place: int, field: str, unit: str, levels: Any) -> Any:
    """`source` with one field of one phase as the factor `extra`."""
    data = copy.deepcopy(source)
    collection = data["collection"]
    before = collection["motion"][place][field] if field != "settle" else ""
    if isinstance(before, str) and before.startswith("$"):
        del collection["factors"][before[1:]]
        data["analysis"]["split"].pop("strata", None)
    collection["factors"]["extra"] = {"unit": unit, "values": levels}
    collection["motion"][place][field] = "$extra"
    collection["limits"]["duration"] = "200 s"
    return data


@pytest.mark.quick(5)
@pytest.mark.parametrize("row", FIELDS.strip().splitlines())
def test_any_field_of_a_phase_is_a_factor(row: str, tmp_path: Path) -> None:
    """Each level moves the arm as the same number written into the phase does."""
    name, at, field, unit, *numbers = row.split()
    source, place = GRAVITY if name == "gravity" else SMALL, int(at)
    *levels, wrong = map(yaml.safe_load, numbers)
    plan = plan_of(varied(source, place, field, unit, levels), tmp_path)
    programs: dict[Any, list[Any]] = {}
    for trial in plan:
        condition = dict(trial.condition)
        level = condition.pop("extra")
        assert f"extra={level}{unit.replace('/', 'p')}" in trial.id
        programs.setdefault(str(level), []).append((condition, plan.program(trial)))
    assert len(programs) == 2
    for level, found in programs.items():
        data = varied(source, place, field, unit, levels)
        del data["collection"]["factors"]["extra"]
        data["collection"]["motion"][place][field] = f"{level} {unit}"
        fixed = plan_of(data, tmp_path)
        expected = {trial.condition: fixed.program(trial) for trial in fixed}
        for condition, program in found:
            assert program == expected[tuple(condition.items())]

    # a level out of the field's range, and a factor of another dimension
    error = refused(varied(source, place, field, unit, [levels[0], wrong]), tmp_path)
    assert (error.key, error.value) == ("collection.factors.extra.values[1]", f"{wrong} {unit}")
    zero = field == "settle" or (place in {0, 4} and source is GRAVITY)
    bound, at = "at least" if zero else "more than", f"collection.motion[{place}].{field}"
    assert error.expected == f"must be {bound} 0 {unit} in {at}"
    error = refused(varied(source, place, field, "px", levels), tmp_path)
    assert (error.key, error.value) == ("collection.factors.extra.unit", "px")
    assert error.expected == f"must be {unit} where $extra stands ({at})"


@pytest.mark.parametrize(
    ("place", "field", "unit", "level", "says"),
    [
        (0, "clearance", "mm", 21, "exceeds collection.limits.clearance = 20 mm"),
        (0, "speed", "mm/s", 51, "exceeds collection.limits.speed = 50 mm/s"),
        (1, "depth", "mm", 3.7, "exceeds collection.limits.depth = 3.6 mm"),
        (1, "speed", "mm/s", 51, "exceeds collection.limits.speed = 50 mm/s"),
        (4, "clearance", "mm", 21, "exceeds collection.limits.clearance = 20 mm"),
        (5, "speed", "mm/s", 51, "exceeds collection.limits.speed = 50 mm/s"),
    ],
)
def test_a_level_over_a_limit_is_named(
    place: int, field: str, unit: str, level: float, says: str, tmp_path: Path
) -> None:
    error = refused(varied(SMALL, place, field, unit, [1, level]), tmp_path)
    assert error.key == "collection.factors.extra.values[1]"
    assert (error.value, error.expected) == (f"{level} {unit}", says)


def test_a_level_of_a_reference_trial_is_held_against_its_field(tmp_path: Path) -> None:
    data = varied(SMALL, 2, "settle", "s", [0, 1])
    condition = {"depth": 2.4, "speed": 1, "direction": 0, "extra": -1}
    data["collection"]["references"] = {"every": 5, "condition": condition}
    error = refused(data, tmp_path)
    assert error.key == "collection.references.condition.extra"
    assert error.expected == "must be at least 0 s in collection.motion[2].settle"


def test_a_share_is_a_factor_with_its_range(tmp_path: Path) -> None:
    data = copy.deepcopy(DISTURBANCE)
    data["collection"]["factors"]["disturbance"]["values"] = [25, 201]
    error = refused(data, tmp_path)
    assert error.key == "collection.factors.disturbance.values[1]"
    assert "from 0 to 200 percent" in error.expected


def test_the_shortest_hold_decides_the_warning(tmp_path: Path) -> None:
    plan = plan_of(varied(SMALL, 2, "duration", "s", [2, 1]), tmp_path)
    (warning,) = plan.warnings()
    assert "the recorded hold of 1 s is shorter than" in warning


def test_one_factor_may_stand_in_several_fields(tmp_path: Path) -> None:
    data = varied(SMALL, 1, "speed", "mm/s", [1, 2])
    data["collection"]["motion"][4]["speed"] = "$extra"
    for trial in (plan := plan_of(data, tmp_path)):
        speeds = {s.phase: s.speed_mm_s for s in plan.program(trial).steps if hasattr(s, "to")}
        assert speeds["press"] == speeds["release"] == float(dict(trial.condition)["extra"])


def test_a_field_is_described_by_its_value_or_its_levels(tmp_path: Path) -> None:
    plan = plan_of(varied(GRAVITY, 2, "depth", "mm", [3.5, 4]), tmp_path)
    press = plan.protocol.collection.motion[2]
    assert plan.level_texts(press.depth, "mm") == ("3.5 mm", "4 mm")
    assert plan.level_texts(press.speed, "mm/s") == ("2 mm/s",)


KNOWN = {
    "kinematic": "b02438086de04e460d5ccde4 bf86c5c81e912fa4fb57262f",
    "gravity": "69436ee1dfbdb79478d1b5b6 0d0e6e61b148fbfac64b8d4b",
    "disturbance": "fdd143eb29f104ebb6b88414 6fb5c3ee28b138b46111f91c",
    "pilot": "deb317af3b5ef097a0ae2722 1f376b49fb2200d3566f9ace",
    "pilot_gravity": "1596088aea72701d7a37f587 bb44ff42358f4ab1e0e6b934",
}
"""Starts of SHA-256 of trials with seconds, and of programs, from before any field took one."""


@pytest.mark.parametrize("name", KNOWN)
def test_trials_and_programs_of_shipped_protocols_stay(name: str) -> None:
    plan = load_plan(Path(name))
    # the class had this name then
    trials = repr([(trial, plan.seconds(trial)) for trial in plan]).replace("PlannedT", "T")
    programs = repr([plan.program(trial) for trial in plan])
    found = [hashlib.sha256(text.encode()).hexdigest()[:24] for text in (trials, programs)]
    assert " ".join(found) == KNOWN[name]
