"""Context: what is known of a trial and moves nothing, in conditions, ids, tables and splits."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import pytest
import yaml

from sliplab.protocols import InputError, load_plan
from tests.conftest import ROOT, SMALL
from tests.protocols.planning import plan_of, refused, rows

SKIN: dict[str, Any] = {"values": ["smooth", "ridged"], "changeover": "person"}
ROOM: dict[str, Any] = {"unit": "degC", "values": [21, 35.5], "changeover": "person"}


def with_context(**context: Any) -> dict[str, Any]:
    """The pilot with context, and fewer levels."""
    data = copy.deepcopy(SMALL)
    data["collection"]["factors"]["depth"]["values"] = [2.8]
    data["collection"]["factors"]["direction"]["values"] = [0, 180]
    data["collection"]["context"] = context
    return data


def test_context_is_part_of_the_factorial_and_of_ids(tmp_path: Path) -> None:
    plan = plan_of(with_context(skin=SKIN, temperature=ROOM), tmp_path)
    assert len(plan) == 1 * 3 * 2 * 2 * 2
    ids = {trial.id for trial in plan}
    assert "depth=2.8mm,direction=180deg,skin=ridged,speed=0.6mmps,temperature=35.5degC,r=1" in ids
    first = plan.trials[0]
    assert plan.describe(first) == {
        **{name: plan.describe(first)[name] for name in ("depth", "speed", "direction")},
        "skin": "smooth",
        "temperature": "21 degC",
    }
    table = plan.table()
    assert set(table["skin"]) == {"smooth", "ridged"}
    assert set(table["temperature_degC"]) == {21.0, 35.5}


def test_context_moves_nothing(tmp_path: Path) -> None:
    plain = plan_of(with_context(), tmp_path)
    programs = {trial.condition: plain.program(trial) for trial in plain}
    for trial in (plan := plan_of(with_context(skin=SKIN), tmp_path)):
        without = tuple((name, level) for name, level in trial.condition if name != "skin")
        assert plan.program(trial) == programs[without]


def test_a_person_changes_context_in_outer_blocks(tmp_path: Path) -> None:
    plan = plan_of(with_context(skin=SKIN, temperature=ROOM), tmp_path)
    asked = [task for trial in plan for task in plan.tasks_before(trial) if task.by_person]
    assert [(task.prompt, task.expected) for task in asked] == [
        ("set skin to smooth", "smooth"),
        ("set temperature to 21 degC", "21 degC"),
        ("set temperature to 35.5 degC", "35.5 degC"),
        ("set skin to ridged", "ridged"),
        ("set temperature to 21 degC", "21 degC"),
        ("set temperature to 35.5 degC", "35.5 degC"),
    ]
    assert {task.request for task in asked} == {"condition"}
    assert plan.stretches() == [(0, 5), (6, 11), (12, 17), (18, 23)]


def test_the_plate_is_still_a_changeover() -> None:
    plan = load_plan(ROOT / "protocols" / "gravity.yaml")
    (task,) = (task for task in plan.tasks_before(plan.trials[0]) if task.by_person)
    assert (task.request, task.mounts_plate) == ("changeover", True)


def test_a_skin_can_be_held_out(tmp_path: Path) -> None:
    data = with_context(skin=SKIN, temperature=ROOM)
    split = {"method": "leave_conditions_out", "test_levels": {"skin": ["ridged"]}}
    data["analysis"]["split"] = {**split, "validation_levels": {"temperature": ["35.5 degC"]}}
    for trial in plan_of(data, tmp_path):
        condition = dict(trial.condition)
        held = "validation" if str(condition["temperature"]) == "35.5" else "train"
        assert trial.split == ("test" if condition["skin"] == "ridged" else held)


def test_context_is_a_stratum(tmp_path: Path) -> None:
    data = with_context(skin=SKIN)
    data["analysis"]["split"]["strata"] = ["skin", "speed"]
    assert len(plan_of(data, tmp_path)) == 12


def test_added_levels_only_add_trials(tmp_path: Path) -> None:
    optional = {**SKIN, "optional": ["0042"]}
    plain = plan_of(with_context(skin=optional), tmp_path)
    more = plan_of(with_context(skin=optional), tmp_path, "skin=0042")
    assert [trial.id for trial in more][: len(plain)] == [trial.id for trial in plain]
    assert len(more) == len(plain) * 3 // 2
    assert more.collection_hash == plain.collection_hash
    assert plan_of(with_context(), tmp_path).collection_hash != plain.collection_hash


def test_no_context_is_as_if_the_section_were_not_there(tmp_path: Path) -> None:
    data = with_context()
    there = plan_of(data, tmp_path)
    del data["collection"]["context"]
    assert plan_of(data, tmp_path).collection_hash == there.collection_hash
    assert "context" not in there.collection_data


def test_a_serial_number_is_text(tmp_path: Path) -> None:
    data = with_context(sensor={"values": ["0042", "NT-7.b"], "changeover": "person"})
    plan = plan_of(data, tmp_path)
    assert {plan.describe(trial)["sensor"] for trial in plan} == {"0042", "NT-7.b"}


def test_levels_that_nobody_changes_are_noted(tmp_path: Path) -> None:
    data = with_context(skin={"values": ["a", "b"]}, operator={"values": ["anna"]})
    (note,) = plan_of(data, tmp_path).warnings()
    assert note.startswith("collection.context.skin: has 2 levels and no one is asked")


WRONG = """
    sensor: {values: [42]} | sensor | quote a number that is
    room: {unit: degC, values: [hot]} | room | words have none
    skin: {values: [../x]} | skin.values[0] | letters, digits
    speed: {values: [fast]} | speed | is a factor already
    role: {values: [a]} | role | is a column of every table
    Skin: {values: [a]} | Skin | a small letter
    room: {unit: K, values: [1]} | room.unit | must be one of
    skin: {values: []} | skin | at least one
"""


@pytest.mark.parametrize(("context", "key", "says"), rows(WRONG))
def test_wrong_context_is_named(context: str, key: str, says: str, tmp_path: Path) -> None:
    error = refused(with_context(**yaml.safe_load(context)), tmp_path)
    assert error.key == f"collection.context.{key}"
    assert says in error.expected


def test_context_that_is_to_move_something_is_refused(tmp_path: Path) -> None:
    data = with_context(skin=SKIN)
    data["collection"]["motion"][1]["depth"] = "$skin"
    with pytest.raises(InputError, match="is context, which moves nothing") as caught:
        plan_of(data, tmp_path)
    assert caught.value.key == "collection.motion[1].depth"


def test_a_factor_of_no_phase_is_told_where_it_belongs(tmp_path: Path) -> None:
    data = with_context()
    data["collection"]["factors"]["skin"] = {"values": ["a", "b"]}
    with pytest.raises(InputError, match=r"or move it to collection\.context"):
        plan_of(data, tmp_path)
