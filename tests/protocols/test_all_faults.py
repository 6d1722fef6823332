"""All faults of a file at once, and the nearest known name for what is misspelt."""

from __future__ import annotations

import pickle
from pathlib import Path

import pytest

from sliplab.protocols.errors import MOST_LINES, InputError
from sliplab.protocols.plan import load_plan
from sliplab.protocols.shown import nearest
from sliplab.protocols.yaml_file import parse_yaml
from sliplab.rigs.rig_file import check_plan, load_rig_file

PILOT = (Path(__file__).parents[2] / "protocols" / "pilot.yaml").read_text()


def faults(tmp_path: Path, *changes: tuple[str, str]) -> dict[str, str]:
    """Return what is wrong with a pilot of these changes, by key."""
    text = PILOT
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        load_plan(path)
    assert [each.file for each in caught.value.faults] == [str(path)] * len(caught.value.faults)
    return {each.key: each.expected for each in caught.value.faults}


def test_faults_of_keys_in_several_sections_are_all_reported(tmp_path: Path) -> None:
    found = faults(
        tmp_path,
        ("epochs: 8", "epoks: 8"),
        ("repetitions: 1", "repetitions: yes"),
        ("order: shuffled", "order: shufled"),
        ("speed: 2 mm/s}", "speed: 2 kg}"),
    )
    assert {
        "analysis.training.epoks",
        "collection.repetitions",
        "collection.order",
        "collection.motion[1].speed",
    } <= found.keys()
    assert "did you mean 'epochs'?" in found["analysis.training.epoks"]
    assert "did you mean 'shuffled'?" in found["collection.order"]


@pytest.mark.parametrize("phase", ["approach", "press", "hold", "slide", "release", "return"])
def test_a_misspelt_key_of_a_phase_is_told_by_the_keys_of_that_phase(
    tmp_path: Path, phase: str
) -> None:
    key = "duration" if phase == "hold" else "speed"
    line = next(line for line in PILOT.splitlines() if f"phase: {phase}," in line)
    found = faults(tmp_path, (line, line.replace(f"{key}:", f"{key}x:")))
    (told,) = found.values()
    assert f"did you mean '{key}'? (known here: phase," in told
    assert "action" not in told


def test_a_phase_that_is_missing_or_misspelt_is_told_by_the_phases(tmp_path: Path) -> None:
    found = faults(tmp_path, ("{phase: press,", "{phse: press,"), ("{phase: return, ", "{"))
    assert found["collection.motion[1].phse"] == "unknown key; did you mean 'phase'?"
    assert "must be one of approach, press, hold, slide" in found["collection.motion[5].phase"]


def test_faults_of_text_keys_and_rules_are_reported_together(tmp_path: Path) -> None:
    found = faults(
        tmp_path,
        ("seed: 20264", "seed: *seed"),
        ("repetitions: 1", "repetitions: 1\n  order: x"),
        ("epochs: 8", "epochs: many"),
    )
    assert "aliases are not supported" in found["collection.seed"]
    assert "duplicate key" in found["collection.order"]
    assert found["analysis.training.epochs"] == "must be a whole number"


def test_faults_of_rules_over_several_keys_are_reported_together(tmp_path: Path) -> None:
    found = faults(
        tmp_path,
        ("speed: $speed, direction", "speed: $sped, direction"),
        ("strata: [depth, speed]", "strata: [deep, dir]"),
        ("depth: 3.6 mm", "depth: 2.6 mm"),
    )
    assert found["collection.motion[3].speed"].endswith("did you mean 'speed'?")
    assert {"analysis.split.strata[0]", "analysis.split.strata[1]"} <= found.keys()
    assert "exceeds collection.limits.depth" in found["collection.factors.depth.values[1]"]
    assert "exceeds collection.limits.depth" in found["collection.factors.depth.values[2]"]
    assert "collection.factors.depth.values[0]" not in found
    assert "collection.factors.speed" not in found  # unused only because of the misspelling


def test_a_misspelt_key_is_not_reported_as_missing_too(tmp_path: Path) -> None:
    assert faults(tmp_path, ("seed: 20264", "sed: 20264")).keys() == {"collection.sed"}


def test_message_has_one_line_a_fault_and_counts_the_rest() -> None:
    each = [InputError("f.yaml", f"key{number}", number, "is wrong") for number in range(30)]
    whole = InputError.joined(each)
    lines = whole.message.split("\n")
    assert lines[:2] == ["f.yaml: key0 = 0: is wrong", "f.yaml: key1 = 1: is wrong"]
    assert len(lines) == MOST_LINES + 1
    assert lines[-1] == "and 10 more"
    again = pickle.loads(pickle.dumps(whole))
    assert (again.message, len(again.faults)) == (whole.message, 30)


def test_faults_of_a_rig_file_name_the_file_that_has_them(tmp_path: Path) -> None:
    below, above = tmp_path / "below.yaml", tmp_path / "above.yaml"
    below.write_text("extends: mock\nname: below\nlimits: {depht: 3 mm}\nsensor: *a\n")
    above.write_text("extends: below.yaml\nname: above\nmock: {scene: {levl: L2}}\n")
    with pytest.raises(InputError) as caught:
        load_rig_file(above)
    found = {each.key: Path(each.file).name for each in caught.value.faults}
    assert found == {
        "limits.depht": "below.yaml",
        "sensor": "below.yaml",
        "mock.scene.levl": "above.yaml",
    }


def test_all_limits_of_a_rig_that_a_plan_exceeds_are_reported(tmp_path: Path) -> None:
    path = tmp_path / "low.yaml"
    path.write_text("extends: mock\nname: low\nlimits: {depth: 1 mm, speed: 1 mm/s, reach: 1 mm}\n")
    rig, _ = load_rig_file(path)
    with pytest.raises(InputError) as caught:
        check_plan(rig, load_plan(Path("pilot")), str(path))
    keys = [each.key for each in caught.value.faults]
    assert sorted(keys) == ["limits.depth", "limits.reach", "limits.speed"]


@pytest.mark.parametrize("given", ["kinematik", "Pilot", "pilot-gravty"])
def test_misspelt_protocol_name_gets_the_nearest(given: str) -> None:
    meant = {"kinematik": "kinematic", "Pilot": "pilot", "pilot-gravty": "pilot_gravity"}[given]
    with pytest.raises(InputError, match=f"did you mean '{meant}'"):
        load_plan(Path(given))


def test_misspelt_rig_and_file_names_get_the_nearest(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="did you mean 'rehearsal'"):
        load_rig_file(Path("rehersal"))
    (tmp_path / "bench_two.yaml").write_text("extends: mok\nname: bench\n")
    with pytest.raises(InputError, match=r"did you mean 'bench_two\.yaml'"):
        load_rig_file(tmp_path / "bench_to.yaml")
    with pytest.raises(InputError, match="did you mean 'mock'"):
        load_rig_file(tmp_path / "bench_two.yaml")
    with pytest.raises(InputError, match=r"did you mean 'bench_two\.yaml'"):
        load_plan(tmp_path / "bench-two.yml")


def test_nearest_ignores_case_and_hyphens() -> None:
    assert nearest("Mock-Force", ["mock", "mock_force"]) == "mock_force"
    assert nearest("zzz", ["mock"]) is None


def test_several_faults_of_yaml_text_are_reported_at_once() -> None:
    with pytest.raises(InputError) as caught:
        parse_yaml("a: *x\nb: !t y\nc: 1\nc: 2\nd: 2026-02-30\n", "f.yaml")
    assert [each.key for each in caught.value.faults] == ["a", "b", "c", "d"]


def test_unreadable_item_of_a_list_in_an_extending_rig_is_named(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("extends: mock\nname: mine\ncameras: [events, *a]\nlimits: {depht: 3 mm}\n")
    with pytest.raises(InputError) as caught:
        load_rig_file(path)
    assert {each.key for each in caught.value.faults} == {"cameras[1]", "limits.depht"}
