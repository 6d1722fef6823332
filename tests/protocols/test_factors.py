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
FIELDS: list[tuple[dict[str, Any], int, str, str, tuple[float, float], float]] = [
    (SMALL, 0, "clearance", "mm", (4, 6.5), 0),
    (SMALL, 0, "speed", "mm/s", (10, 25), -1),
    (SMALL, 1, "depth", "mm", (2.4, 3), 0),
    (SMALL, 1, "speed", "mm/s", (1, 2.5), 0),
    (SMALL, 2, "settle", "s", (0, 1.5), -0.5),
    (SMALL, 2, "duration", "s", (2, 3), 0),
    (SMALL, 3, "distance", "mm", (6, 9), 0),
    (SMALL, 3, "speed", "mm/s", (0.5, 1), 0),
    (SMALL, 4, "clearance", "mm", (5, 6), -5),
    (SMALL, 4, "speed", "mm/s", (5, 10), 0),
    (SMALL, 5, "speed", "mm/s", (5, 20), 0),
    (GRAVITY, 0, "duration", "s", (0, 1), -1),
    (GRAVITY, 4, "duration", "s", (0.5, 0.8), -1),
    (GRAVITY, 6, "distance", "mm", (4, 4.2), 0),
    (GRAVITY, 6, "speed", "mm/s", (0.5, 0.6), 0),
]


def varied(
    source: dict[str, Any], place: int, field: str, unit: str, levels: list[float]
) -> dict[str, Any]:
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


@pytest.mark.parametrize(("source", "place", "field", "unit", "levels", "wrong"), FIELDS)
def test_any_field_of_a_phase_is_a_factor(
    source: dict[str, Any],
    place: int,
    field: str,
    unit: str,
    levels: tuple[float, float],
    wrong: float,
    tmp_path: Path,
) -> None:
    """Each level moves the arm as the same number written into the phase does."""
    plan = plan_of(varied(source, place, field, unit, list(levels)), tmp_path)
    programs: dict[Any, list[Any]] = {}
    for trial in plan:
        condition = dict(trial.condition)
        level = condition.pop("extra")
        assert f"extra={level}{unit.replace('/', 'p')}" in trial.id
        programs.setdefault(str(level), []).append((condition, plan.program(trial)))
    assert len(programs) == 2
    for level, found in programs.items():
        data = varied(source, place, field, unit, list(levels))
        del data["collection"]["factors"]["extra"]
        data["collection"]["motion"][place][field] = f"{level} {unit}"
        fixed = plan_of(data, tmp_path)
        expected = {trial.condition: fixed.program(trial) for trial in fixed}
        for condition, program in found:
            assert program == expected[tuple(condition.items())]


@pytest.mark.parametrize(("source", "place", "field", "unit", "levels", "wrong"), FIELDS)
def test_a_level_out_of_a_fields_range_is_named(
    source: dict[str, Any],
    place: int,
    field: str,
    unit: str,
    levels: tuple[float, float],
    wrong: float,
    tmp_path: Path,
) -> None:
    error = refused(varied(source, place, field, unit, [levels[0], wrong]), tmp_path)
    assert error.key == "collection.factors.extra.values[1]"
    assert error.value == f"{wrong} {unit}"
    bound = (
        "at least" if field == "settle" or (place in {0, 4} and source is GRAVITY) else "more than"
    )
    assert error.expected == f"must be {bound} 0 {unit} in collection.motion[{place}].{field}"


@pytest.mark.parametrize(("source", "place", "field", "unit", "levels", "wrong"), FIELDS)
def test_a_factor_of_another_dimension_is_refused(
    source: dict[str, Any],
    place: int,
    field: str,
    unit: str,
    levels: tuple[float, float],
    wrong: float,
    tmp_path: Path,
) -> None:
    error = refused(varied(source, place, field, "px", list(levels)), tmp_path)
    assert (error.key, error.value) == ("collection.factors.extra.unit", "px")
    assert (
        error.expected == f"must be {unit} where $extra stands (collection.motion[{place}].{field})"
    )


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
    "kinematic": (
        "b02438086de04e460d5ccde45ad379dd953a3b73972250e14b25c4bb8c3199c3",
        "bf86c5c81e912fa4fb57262ff63d54b54ebdc274c5283d9833710eb7a309cff4",
    ),
    "gravity": (
        "69436ee1dfbdb79478d1b5b669a8d0cdf38049decfc89bbd499b6089c056ae29",
        "0d0e6e61b148fbfac64b8d4b2ddd51473efac4fbd37d624b1b8dcc2fca741aac",
    ),
    "disturbance": (
        "fdd143eb29f104ebb6b88414562664a3a0144aba51785d099bb1f15b29313edd",
        "6fb5c3ee28b138b46111f91c4c97946af9aa60afb1040be6e6d9c5454b6db8ce",
    ),
    "pilot": (
        "deb317af3b5ef097a0ae272286ffd22d975bbd8dad9cfa7911e647872cccc0b3",
        "1f376b49fb2200d3566f9ace87f0707403d053c2d190a3bdaf82f65264223e56",
    ),
    "pilot_gravity": (
        "1596088aea72701d7a37f58712c35ac848bd2520179f0027fb9be10f9f39e4fe",
        "bb44ff42358f4ab1e0e6b934cd976986113e843b5aed7850fa18b067372b699d",
    ),
}
"""SHA-256 of trials with their seconds, and of programs, as they were before any field took one."""


@pytest.mark.parametrize("name", KNOWN)
def test_trials_and_programs_of_shipped_protocols_stay(name: str) -> None:
    plan = load_plan(Path(name))
    trials = repr([(trial, plan.seconds(trial)) for trial in plan])
    programs = repr([plan.program(trial) for trial in plan])
    assert tuple(hashlib.sha256(t.encode()).hexdigest() for t in (trials, programs)) == KNOWN[name]
