"""Whatever is wrong with a protocol file is said with file, key, value and what would be right."""

import copy
import os
import re
from collections.abc import Callable
from decimal import Decimal
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from sliplab.protocols import InputError, Protocol, load_plan, make_plan
from sliplab.protocols.yaml_file import parse_yaml, validate
from tests.conftest import ROOT

Change = Callable[[dict[str, Any]], None]


def _set(*path: Any, to: Any) -> Change:
    def change(data: dict[str, Any]) -> None:
        for part in path[:-1]:
            data = data[part]
        data[path[-1]] = to

    return change


def _drop(*path: Any) -> Change:
    def change(data: dict[str, Any]) -> None:
        for part in path[:-1]:
            data = data[part]
        del data[path[-1]]

    return change


COLLECTION = "collection"
LEFT_OUT = {"method": "leave_conditions_out", "test_levels": {"depth": ["2.4 mm"]}}
CASES: dict[str, tuple[Change, str, str]] = {
    "unknown key": (
        _set(COLLECTION, "repetition", to=2),
        "collection.repetition",
        "did you mean 'repetitions'",
    ),
    "unknown key in a phase": (
        _set(COLLECTION, "motion", 1, "sped", to="1 mm/s"),
        "collection.motion[1].sped",
        "did you mean 'speed'",
    ),
    "unknown phase": (
        _set(COLLECTION, "motion", 1, "phase", to="jump"),
        "collection.motion[1].phase",
        "approach",
    ),
    "wrong unit": (
        _set(COLLECTION, "motion", 1, "speed", to="2 kg"),
        "collection.motion[1].speed",
        "mm/s",
    ),
    "unknown device": (
        _set("analysis", "training", "device", to="gpu"),
        "analysis.training.device",
        "must be cpu, or a GPU as cuda",
    ),
    "factor in another unit than its place": (
        _set(COLLECTION, "factors", "depth", "unit", to="mm/s"),
        "collection.factors.depth.unit",
        "must be mm where $depth stands",
    ),
    "no unit": (
        _set(COLLECTION, "motion", 3, "distance", to=12),
        "collection.motion[3].distance",
        "has no unit",
    ),
    "factor unit": (
        _set(COLLECTION, "factors", "depth", "unit", to="furlong"),
        "collection.factors.depth.unit",
        "must be one of",
    ),
    "NaN": (
        _set(COLLECTION, "factors", "depth", "values", to=[float("nan")]),
        "collection.factors.depth.values[0]",
        "finite",
    ),
    "infinity": (
        _set(COLLECTION, "factors", "depth", "values", to=[2.4, float("inf")]),
        "collection.factors.depth.values[1]",
        "finite",
    ),
    "negative speed": (
        _set(COLLECTION, "factors", "speed", "values", to=[0.6, -1.0]),
        "collection.factors.speed.values[1]",
        "more than 0",
    ),
    "negative speed in a phase": (
        _set(COLLECTION, "motion", 1, "speed", to="-2 mm/s"),
        "collection.motion[1].speed",
        "more than 0",
    ),
    "depth over the limit": (
        _set(COLLECTION, "factors", "depth", "values", to=[2.4, 3.7]),
        "collection.factors.depth.values[1]",
        "exceeds collection.limits.depth = 3.6 mm",
    ),
    "slide leaves the workspace": (
        _set(COLLECTION, "motion", 3, "distance", to="21 mm"),
        "collection.motion[3].distance",
        "outside collection.limits.workspace.x",
    ),
    "empty factor": (
        _set(COLLECTION, "factors", "depth", "values", to=[]),
        "collection.factors.depth",
        "at least one",
    ),
    "no factors": (_set(COLLECTION, "factors", to={}), "collection.factors", "at least one"),
    "duplicate level": (
        _set(COLLECTION, "factors", "depth", "values", to=[2.4, 2.40]),
        "collection.factors.depth",
        "2.4 twice",
    ),
    "list and range": (
        _set(COLLECTION, "factors", "depth", "range", to={"from": 1, "to": 2, "step": 1}),
        "collection.factors.depth",
        "exactly one of 'values' and 'range'",
    ),
    "range that misses its end": (
        _set(
            COLLECTION,
            "factors",
            "depth",
            to={"unit": "mm", "range": {"from": 2.4, "to": 3.4, "step": 0.3}},
        ),
        "collection.factors.depth.range",
        "whole number of steps",
    ),
    "endless range": (
        _set(
            COLLECTION,
            "factors",
            "depth",
            to={"unit": "mm", "range": {"from": 0.000001, "to": 3.0, "step": 0.000001}},
        ),
        "collection.factors.depth.range",
        "1,000,000",
    ),
    "too many trials": (
        _set(COLLECTION, "repetitions", to=50_000),
        "collection.factors",
        "more than 1,000,000",
    ),
    "missing section": (_drop(COLLECTION, "limits"), "collection.limits", "is missing"),
    "reference to nothing": (
        _set(COLLECTION, "motion", 1, "depth", to="$deep"),
        "collection.motion[1].depth",
        "unknown factor $deep; defined factors: depth, speed, direction",
    ),
    "unused factor": (
        _set(COLLECTION, "factors", "extra", to={"values": ["a"]}),
        "collection.factors.extra",
        "not used by any phase",
    ),
    "no hold": (_drop(COLLECTION, "motion", 2), "collection.motion", "must have a 'hold'"),
    "too long": (
        _set(COLLECTION, "limits", "duration", to="10 s"),
        "collection.limits.duration",
        "raise the limit",
    ),
    "word as a number": (
        _set(COLLECTION, "factors", "direction", to={"values": ["left"]}),
        "collection.factors.direction.values[0]",
        "number in deg",
    ),
    "held-out level that is none": (
        _set(
            "analysis",
            "split",
            to={"method": "leave_conditions_out", "test_levels": {"depth": ["9 mm"]}},
        ),
        "analysis.split.test_levels.depth",
        "is not one of its levels",
    ),
    "windows further apart than they are long": (
        _set("analysis", "detection", "stride_ms", to=31),
        "analysis.detection.stride_ms",
        "must not exceed length_ms = 30",
    ),
    "a stride that the window is no multiple of": (
        _set("analysis", "detection", "compare", to={"stride_ms": 20}),
        "analysis.detection.compare.stride_ms",
        "must divide length_ms = 30",
    ),
    "a choice that nobody makes": (
        _set("analysis", "detection", "choose", to="train"),
        "analysis.detection.choose",
        "validation",
    ),
    "a grid out of order": (
        _set("analysis", "detection", "smoothing_grid", to=[4, 1]),
        "analysis.detection.smoothing_grid",
        "ascending list of values",
    ),
    "a window of nothing": (
        _set("analysis", "detection", "smoothing_grid", to=[0, 1]),
        "analysis.detection.smoothing_grid",
        "from 1",
    ),
    "rates that are no shares": (
        _set("analysis", "detection", "compare", to={"rates": [0.01, 1.0]}),
        "analysis.detection.compare.rates",
        "ascending list of shares",
    ),
    "shares that do not add up": (
        _set("analysis", "split", "train", to=0.9),
        "analysis.split",
        "add up to 1",
    ),
    "name that points out of the store": (_set("name", to="../x"), "name", "pattern"),
    "strata that are no factors": (
        _set("analysis", "split", "strata", to=["depht", "speed"]),
        "analysis.split.strata[0]",
        "= depht: unknown factor depht; defined factors: depth, speed, direction",
    ),
    "a stratum twice": (
        _set("analysis", "split", "strata", to=["depth", "depth"]),
        "analysis.split.strata[1]",
        "appears twice",
    ),
    "a factor held out that is none": (
        _set("analysis", "split", to={**LEFT_OUT, "test_levels": {"depht": ["2.4 mm"]}}),
        "analysis.split.test_levels.depht",
        "unknown factor depht; defined factors: depth, speed, direction",
    ),
    "nothing held out": (
        _set("analysis", "split", to={**LEFT_OUT, "test_levels": {"depth": []}}),
        "analysis.split.test_levels.depth",
        "at least one level",
    ),
    "a level held out twice over": (
        _set("analysis", "split", to={**LEFT_OUT, "validation_levels": {"depth": ["0.24 cm"]}}),
        "analysis.split.validation_levels.depth",
        "is already held out for testing",
    ),
    "a reference to a factor that is none": (
        _set(COLLECTION, "motion", 3, "speed", to="$sped"),
        "collection.motion[3].speed",
        "= $sped: unknown factor $sped; defined factors: depth, speed, direction",
    ),
    "a reference condition of another factor": (
        _set(
            COLLECTION,
            "references",
            to={"every": 5, "condition": {"depth": 2, "speed": 1, "direction": 0, "sped": 1}},
        ),
        "collection.references.condition.sped",
        "unknown factor sped; defined factors: depth, speed, direction",
    ),
    "a level held out twice in two units": (
        _set(
            "analysis",
            "split",
            to={**LEFT_OUT, "test_levels": {"depth": ["2.4 mm", "2400 um"]}},
        ),
        "analysis.split.test_levels.depth[1]",
        "is listed twice as held out",
    ),
    "one direction twice": (
        _set(COLLECTION, "factors", "direction", "values", to=[0, 90, 360]),
        "collection.factors.direction.values[2]",
        "= 360: 360 deg is the same direction as 0 deg",
    ),
    "one direction twice, in a range": (
        _set(
            COLLECTION,
            "factors",
            "direction",
            to={"unit": "deg", "range": {"from": -180, "to": 180, "step": 90}},
        ),
        "collection.factors.direction.range",
        "180 deg is the same direction as -180 deg",
    ),
    "one direction twice, when it is switched on": (
        _set(COLLECTION, "factors", "direction", "optional", to=[-90]),
        "collection.factors.direction.optional[0]",
        "is the same direction as 270 deg",
    ),
    "many turns": (
        _set(COLLECTION, "factors", "direction", "values", to=[0, -1e9]),
        "collection.factors.direction.values[1]",
        "must be from -360 to 360 deg",
    ),
    "many turns in a phase": (
        _set(COLLECTION, "motion", 3, "direction", to="1e6 deg"),
        "collection.motion[3].direction",
        "must be from -360 to 360 deg",
    ),
    "a length of planets": (
        _set(COLLECTION, "recording", "region", "width", to="9e8 m"),
        "collection.recording.region.width",
        "must be from -100000 to 100000 mm",
    ),
    "a switch in a list of numbers": (
        _set("analysis", "training", to={"seeds": [0, True]}),
        "analysis.training.seeds[1]",
        "= true: must be a number",
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_the_message_names_key_and_cure(case: str, small: dict[str, Any], tmp_path: Path) -> None:
    change, key, says = CASES[case]
    change(small)
    path = tmp_path / "wrong.yaml"
    path.write_text(yaml.safe_dump(small, sort_keys=False))
    with pytest.raises(InputError) as caught:
        load_plan(path)
    assert str(path) in caught.value.message
    assert caught.value.key.startswith(key)
    assert says in caught.value.message


RAW = {
    "not a mapping": (b"- a\n- b\n", "holds a list"),
    "empty": (b"", "holds nothing"),
    "text": (b"hello", "holds a str"),
    "not UTF-8": (b"name: caf\xe9\n", "is not UTF-8"),
    "broken": (b"a: [1, 2\n", "cannot be read"),
    "key twice": (b"a: 1\na: 2\n", "duplicate key"),
    "alias": (b"a: &x [1]\nb: *x\n", "aliases are not supported"),
    "deep": (b"a: " + b"[" * 200 + b"]" * 200, "nested more than"),
    "python object": (b"a: !!python/object/apply:os.system ['true']\n", "cannot be read"),
    "base 60": (b"a: 1:30.5\n", "base-60"),
    "huge": (b"a: '" + b"x" * (1 << 20) + b"'\n", "is over"),
}


@pytest.mark.parametrize("case", RAW)
def test_what_is_no_protocol_file_is_refused(case: str, tmp_path: Path) -> None:
    data, says = RAW[case]
    path = tmp_path / "wrong.yaml"
    path.write_bytes(data)
    with pytest.raises(InputError, match=says) as caught:
        load_plan(path)
    assert str(path) in caught.value.message


def test_aliases_cannot_blow_up(tmp_path: Path) -> None:
    """The billion laughs: refused at its first alias."""
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 20)]
    path = tmp_path / "bomb.yaml"
    path.write_text("\n".join(lines))
    with pytest.raises(InputError, match="aliases are not supported"):
        load_plan(path)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file") as caught:
        load_plan(tmp_path / "none.yaml")
    assert "none.yaml" in caught.value.message
    with pytest.raises(InputError, match="is a folder"):
        load_plan(tmp_path)


def test_what_is_no_plain_file_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.yaml")
    for path in (tmp_path / "pipe.yaml", Path("/dev/zero")):
        with pytest.raises(InputError, match="is not a regular file"):
            load_plan(path)


def test_ids_that_no_folder_can_have_are_refused(
    small: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "long.yaml"
    path.write_text(yaml.safe_dump(small, sort_keys=False))
    load_plan(path)
    monkeypatch.setattr("sliplab.protocols.plan.MAX_ID", 30)
    with pytest.raises(InputError, match="30 at most"):
        load_plan(path)


def test_a_number_is_shown_as_it_was_written() -> None:
    error = InputError("rig.yaml", "mock.scene.friction.kinetik", Decimal("0.9"), "unknown key")
    assert str(error) == "rig.yaml: mock.scene.friction.kinetik = 0.9: unknown key"


INFINITE = float("inf")
NUMBERS: dict[tuple[Any, ...], list[Any]] = {
    (COLLECTION, "repetitions"): [True, INFINITE, 10**12],
    (COLLECTION, "seed"): [True, INFINITE, -1, 2**63],
    (COLLECTION, "references"): [
        {"every": each, "condition": {"depth": 2.8, "speed": 1, "direction": 0}}
        for each in (True, 10**12)
    ],
    (COLLECTION, "gates", "frames_lost"): [False, INFINITE, 10**12],
    (COLLECTION, "gates", "event_burst"): [True, INFINITE, 10**12],
    (COLLECTION, "gates", "retakes"): [True, 10**12],
    (COLLECTION, "gates", "event_gap"): [True, "inf s", "1e9 s"],
    (COLLECTION, "gates", "path_deviation"): ["nan mm", "1e9 mm"],
    (COLLECTION, "gates", "sync_uncertainty"): [{"host_time": "1e9 min"}],
    (COLLECTION, "maintenance", "rezero", "every"): [True, INFINITE, 10**12],
    (COLLECTION, "maintenance", "warm_up", "presses"): [True, 10**12],
    (COLLECTION, "maintenance", "clean"): [{"every": 10**12, "prompt": "clean"}],
    (COLLECTION, "limits", "duration"): ["1e9 min"],
    (COLLECTION, "limits", "workspace", "x", "low"): ["-1e9 m"],
    ("analysis", "labelling", "threshold_px"): [True, INFINITE, 10**12],
    ("analysis", "labelling", "reference_ms"): [True, INFINITE, 10**12],
    ("analysis", "windows", "length_ms"): [True, INFINITE, 10**12],
    ("analysis", "windows", "pool_px"): [True],
    ("analysis", "samples", "per_class"): [True, 10**12],
    ("analysis", "split", "train"): [True, INFINITE, float("nan")],
    ("analysis", "network"): [
        {"conv1_kernel": True},
        {"weight_scale": [4, 3, 4, True]},
        {"weight_scale": [4, 3, 4, INFINITE]},
        {"weight_scale": [4, 3, 4, -1]},
        {"outputs_per_class": 10**12},
    ],
    ("analysis", "training", "epochs"): [True, INFINITE, 10**12],
    ("analysis", "training", "learning_rate"): [True, float("nan"), 10**12],
    ("analysis", "training", "gain"): [True, INFINITE],
    ("analysis", "training", "patience"): [True, 10**12],
    ("analysis", "training", "seeds"): [[10**30], [True]],
    ("analysis", "detection", "smoothing"): [True, INFINITE, 10**12],
    ("analysis", "detection", "margin"): [True, INFINITE, float("nan"), "inf", 1e12],
    ("analysis", "detection", "false_early_ms"): [True, INFINITE, 1e12],
    ("analysis", "detection", "smoothing_grid"): [[1, 10**12], [True, 2]],
    ("analysis", "detection", "margin_grid"): [[1, INFINITE], [1, 1e12], [False, 2]],
    ("analysis", "detection", "false_early_rate"): [True, INFINITE, float("nan")],
    ("analysis", "detection", "compare"): [
        {"train_trials": 10**12},
        {"rates": [float("nan")]},
        {"rates": [False]},
    ],
    ("protocol",): [True],
    (COLLECTION, "recording", "sync_rate"): [True, INFINITE],
}


@pytest.mark.parametrize("path", NUMBERS, ids=lambda path: ".".join(map(str, path)))
def test_numbers_are_numbers_finite_and_bounded(
    path: tuple[Any, ...], small: dict[str, Any], tmp_path: Path
) -> None:
    """No switch (yes is not 1), no infinity, no NaN, nothing out of the world."""
    key = ".".join(map(str, path))
    file = tmp_path / "wrong.yaml"
    for value in NUMBERS[path]:
        data = copy.deepcopy(small)
        _set(*path, to=value)(data)
        file.write_text(yaml.safe_dump(data))
        with pytest.raises(InputError) as caught:
            load_plan(file)
        assert caught.value.key.startswith(key), caught.value.message
        assert caught.value.value is not None
        assert "Decimal(" not in caught.value.message


def gravity() -> dict[str, Any]:
    """The gravity pilot as data."""
    data: dict[str, Any] = yaml.safe_load((ROOT / "protocols" / "pilot_gravity.yaml").read_text())
    return data


def _without(action: str) -> dict[str, Any]:
    data = gravity()
    motion = data[COLLECTION]["motion"]
    motion[:] = [phase for phase in motion if phase.get("action") != action]
    return data


def _caught_first() -> dict[str, Any]:
    data = gravity()
    motion = data[COLLECTION]["motion"]
    motion[-2], motion[4] = motion[4], motion[-2]
    return data


@pytest.mark.parametrize(
    ("made", "key", "says"),
    [
        (_without("catch"), "collection.motion", "but never caught: add"),
        (_without("release"), "collection.motion", "must release the plate"),
        (_without("raise"), "collection.motion", "must raise the plate"),
        (_caught_first(), "collection.motion[4].action", "must come after"),
    ],
)
def test_a_plate_that_falls_is_caught(
    made: dict[str, Any], key: str, says: str, tmp_path: Path
) -> None:
    path = tmp_path / "wrong.yaml"
    path.write_text(yaml.safe_dump(made))
    with pytest.raises(InputError) as caught:
        load_plan(path)
    assert caught.value.key == key, caught.value.message
    assert says in caught.value.message


def test_protocols_in_stores_are_held_to_the_rules_of_their_day(
    small: dict[str, Any], tmp_path: Path
) -> None:
    """A campaign that was collected under rules without some of today's can still be used."""
    path = tmp_path / "protocol.yaml"
    small["analysis"]["split"]["strata"] = ["depht", "speed"]
    small[COLLECTION]["factors"]["direction"]["values"] = [0, 360]
    for data in (small, _without("catch")):
        path.write_text(yaml.safe_dump(data))
        assert len(load_plan(path, stored=True)) > 0
        with pytest.raises(InputError):
            load_plan(path)


PLACE = "a-place-for-text"
TEXTS = [
    "yes",
    "no",
    "~",
    "2026-11-23",
    "2026-02-30",
    "12:30",
    "0x10",
    "1e12",
    "1.0e+12",
    ".inf",
    "-.inf",
    ".nan",
    "-1",
    "[]",
    "[2.5, {a: 0.5}]",
    "{a: 0.5}",
    "!include x",
    "!!set {a}",
    "*a",
    "<<",
    "&a 5",
    '"\\e[31mred"',
    '"\\x9b31m"',
    '"\\u202Ered"',
    "2,5",
    "2,5 mm",
    "\u221210 mm",
    "5 \u00b5m",
    "1,000 mm",
    "$sped",
    "$",
    "1 um",
    "''",
    "'a: b'",
    "99999999999999999999",
    "1000000 m",
]
SHIPPED: dict[str, dict[str, Any]] = {
    name: yaml.safe_load((ROOT / "protocols" / f"{name}.yaml").read_text())
    for name in ("kinematic", "gravity", "disturbance")
}


def _leaves(data: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    if not isinstance(data, dict | list):
        return [path]
    pairs = data.items() if isinstance(data, dict) else enumerate(data)
    return [path, *(leaf for key, part in pairs for leaf in _leaves(part, (*path, key)))][
        0 if path else 1 :
    ]


LEAVES = [(name, path) for name, data in SHIPPED.items() for path in _leaves(data)]


def is_taken_or_named(where: Any, text: str) -> None:
    """Any text at any key: a plan, or messages of one line each that name a key of the file."""
    name, path = where
    data = copy.deepcopy(SHIPPED[name])
    _set(*path, to=PLACE)(data)
    written = yaml.safe_dump(data, sort_keys=False).replace(PLACE, text)
    error = None
    try:
        make_plan(validate(Protocol, parse_yaml(written, "p.yaml"), "p.yaml"), "p.yaml")
    except InputError as found:
        error = found
    for each in () if error is None else error.faults:
        assert each.message.startswith("p.yaml: ")
        assert not re.search(r"[\x00-\x1f\x7f-\x9f\u202e]|Decimal\(|datetime", each.message)
        assert each.key.startswith((str(path[0]), "collection", "analysis")), each.message
        assert each.expected


ANYWHERE = given(st.sampled_from(LEAVES), st.sampled_from(TEXTS))
test_whatever_stands_at_a_key_is_taken_or_named = settings(max_examples=150)(
    ANYWHERE(is_taken_or_named)
)
test_more_of_what_may_stand_at_a_key = pytest.mark.long(
    settings(max_examples=600)(ANYWHERE(is_taken_or_named))
)


@pytest.mark.parametrize(
    ("name", "level", "says"),
    [
        ("depth", 30, "exceeds collection.limits.depth = 3.6 mm"),
        ("depth", -1, "must be more than 0"),
        ("depth", 0, "must be more than 0"),
        ("speed", 900, "exceeds collection.limits.speed = 50 mm/s"),
        ("speed", 0, "must be more than 0"),
        ("direction", 1e6, "must be from -360 to 360 deg"),
    ],
)
def test_reference_trials_obey_the_limits(
    name: str, level: float, says: str, small: dict[str, Any], tmp_path: Path
) -> None:
    path = tmp_path / "wrong.yaml"
    condition = {"depth": 2.8, "speed": 1, "direction": 0}
    small[COLLECTION]["references"] = {"every": 5, "condition": condition}
    path.write_text(yaml.safe_dump(small))
    assert len(load_plan(path)) == 44
    condition[name] = level
    path.write_text(yaml.safe_dump(small))
    with pytest.raises(InputError, match=re.escape(says)) as caught:
        load_plan(path)
    assert caught.value.key == f"collection.references.condition.{name}"


def test_a_reference_slide_stays_in_the_workspace(small: dict[str, Any], tmp_path: Path) -> None:
    small[COLLECTION]["factors"]["distance"] = {"unit": "mm", "values": [9]}
    small[COLLECTION]["motion"][3]["distance"] = "$distance"
    condition = {"depth": 2.8, "speed": 1, "direction": 0, "distance": 25}
    small[COLLECTION]["references"] = {"every": 5, "condition": condition}
    path = tmp_path / "wrong.yaml"
    path.write_text(yaml.safe_dump(small))
    with pytest.raises(InputError, match=r"outside collection\.limits\.workspace\.x") as caught:
        load_plan(path)
    assert caught.value.key == "collection.references.condition.distance"
