"""Whatever is wrong with a protocol file is said with file, key, value and what would be right."""

import os
from collections.abc import Callable
from decimal import Decimal
from pathlib import Path
from typing import Any

import pytest
import yaml

from protocols import InputError, load_plan

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
        "over collection.limits.depth = 3.6 mm",
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
        "either 'values' or 'range'",
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
        "collection.motion",
        "not there",
    ),
    "unused factor": (
        _set(COLLECTION, "factors", "extra", to={"values": ["a"]}),
        "collection.factors.extra",
        "used by no phase",
    ),
    "no hold": (_drop(COLLECTION, "motion", 2), "collection.motion", "hold still"),
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
        "is no level",
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
        "must ascend",
    ),
    "a window of nothing": (
        _set("analysis", "detection", "smoothing_grid", to=[0, 1]),
        "analysis.detection.smoothing_grid",
        "from 1",
    ),
    "rates that are no shares": (
        _set("analysis", "detection", "compare", to={"rates": [0.01, 1.0]}),
        "analysis.detection.compare.rates",
        "ascending shares",
    ),
    "shares that do not add up": (
        _set("analysis", "split", "train", to=0.9),
        "analysis.split",
        "add up to 1",
    ),
    "name that leads out of the store": (_set("name", to="../x"), "name", "pattern"),
}


@pytest.mark.parametrize("case", CASES)
def test_the_message_names_key_and_cure(case: str, small: dict[str, Any], tmp_path: Path) -> None:
    change, key, says = CASES[case]
    change(small)
    path = tmp_path / "wrong.yaml"
    path.write_text(yaml.safe_dump(small))
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
    "key twice": (b"a: 1\na: 2\n", "stands twice"),
    "alias": (b"a: &x [1]\nb: *x\n", "aliases are not read here"),
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
    with pytest.raises(InputError, match="aliases are not read"):
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
        with pytest.raises(InputError, match="is no plain file"):
            load_plan(path)


def test_ids_that_no_folder_can_have_are_refused(
    small: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "long.yaml"
    path.write_text(yaml.safe_dump(small))
    load_plan(path)
    monkeypatch.setattr("protocols.plan.MAX_ID", 30)
    with pytest.raises(InputError, match="30 at most"):
        load_plan(path)


def test_a_number_is_shown_as_it_was_written() -> None:
    error = InputError("rig.yaml", "mock.scene.friction.kinetik", Decimal("0.9"), "unknown key")
    assert str(error) == "rig.yaml: mock.scene.friction.kinetik = 0.9: unknown key"
