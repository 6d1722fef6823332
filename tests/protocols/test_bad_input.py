"""Whatever is wrong with a protocol file is said with file, key, value and what would be right."""

import copy
import os
import re
from collections.abc import Iterator
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
from tests.protocols.planning import plan_of, put, refused, rows

COLLECTION = "collection"
LEFT_OUT = {"method": "leave_conditions_out", "test_levels": {"depth": ["2.4 mm"]}}
SPED = "{every: 5, condition: {depth: 2, speed: 1, direction: 0, sped: 1}}"


# section: the place and what is put there (nothing: dropped) | the key of the fault after the
# place, or before it with a caret | what the message says
CASES = {
    "collection": f"""
        repetition: 2 | | did you mean 'repetitions'
        epochs: 3 | | its place may be analysis.training.epochs
        title: x | | its place may be the top level (title)
        repetitions: 50000 | ^factors | more than 1,000,000
        limits: | | is missing
        limits.duration: 10 s | | raise the limit
        recording.region.width: 9.0e+8 m | | must be from -100000 to 100000 mm
        references: {SPED} | .condition.sped | unknown factor sped; defined factors: {{all}}""",
    "collection.motion": """
        [1].sped: 1 mm/s | | did you mean 'speed'
        [1].phase: jump | | approach
        [1].speed: 2 kg | | mm/s
        [1].speed: -2 mm/s | | more than 0
        [1].depth: $deep | | unknown factor $deep; defined factors: {all}
        [2]: | ^ | must have a 'hold'
        [3].distance: 12 | | has no unit
        [3].distance: 21 mm | | outside collection.limits.workspace.x
        [3].direction: 1e6 deg | | must be from -360 to 360 deg
        [3].speed: $sped | | = $sped: unknown factor $sped; defined factors: {all}""",
    "collection.factors": """
        : {} | | at least one
        extra: {values: [a]} | | not used by any phase
        speed.values: [0.6, -1.0] | [1] | more than 0
        depth.unit: mm/s | | must be mm where $depth stands
        depth.unit: furlong | | must be one of
        depth.values: [.nan] | [0] | finite
        depth.values: [2.4, .inf] | [1] | finite
        depth.values: [2.4, 3.7] | [1] | exceeds collection.limits.depth = 3.6 mm
        depth.values: [] | ^depth | at least one
        depth.values: [2.4, 2.40] | ^depth | 2.4 twice
        depth.range: {from: 1, to: 2, step: 1} | ^depth | exactly one of 'values' and 'range'
        depth: {unit: mm, range: {from: 2.4, to: 3.4, step: 0.3}} | .range | whole number of steps
        depth: {unit: mm, range: {from: 1.0e-6, to: 3.0, step: 1.0e-6}} | .range | 1,000,000""",
    "collection.factors.direction": """
        : {values: [left]} | .values[0] | number in deg
        values: [0, 90, 360] | [2] | = 360: 360 deg is the same direction as 0 deg
        : {unit: deg, range: {from: -180, to: 180, step: 90}} | .range | 180 deg is the same direct
        optional: [-90] | [0] | is the same direction as 270 deg
        values: [0, -1.0e+9] | [1] | must be from -360 to 360 deg""",
    "analysis": """
        training.device: gpu | | must be cpu, or a GPU as cuda
        training: {seeds: [0, true]} | .seeds[1] | = true: must be a number
        detection.stride_ms: 31 | | must not exceed length_ms = 30
        detection.compare: {stride_ms: 20} | .stride_ms | must divide length_ms = 30
        detection.choose: train | | validation
        detection.smoothing_grid: [4, 1] | | ascending list of values
        detection.smoothing_grid: [0, 1] | | from 1
        detection.compare: {rates: [0.01, 1.0]} | .rates | ascending list of shares
        split.train: 0.9 | ^split | add up to 1
        split.strata: [depht, speed] | [0] | = depht: unknown factor depht; defined factors: {all}
        split.strata: [depth, depth] | [1] | appears twice""",
    "analysis.split": """
        test_levels: {depth: [9 mm]} | .depth | is not one of its levels
        test_levels: {depht: [2.4 mm]} | .depht | unknown factor depht; defined factors: {all}
        test_levels: {depth: []} | .depth | at least one level
        test_levels: {depth: [2.4 mm, 2400 um]} | .depth[1] | is listed twice as held out
        validation_levels: {depth: [0.24 cm]} | .depth | is already held out for testing""",
    "": "name: ../x | | pattern",
}
ROWS = [(section, *row) for section, table in CASES.items() for row in rows(table)]


@pytest.mark.parametrize(("section", "change", "key", "says"), ROWS)
def test_the_message_names_key_and_cure(
    section: str, change: str, key: str, says: str, small: dict[str, Any], tmp_path: Path
) -> None:
    place, _, value = change.partition(":")
    if section == "analysis.split":
        small["analysis"]["split"] = copy.deepcopy(LEFT_OUT)
    at = f"{section}.{place}".strip(".").replace(".[", "[")
    put(small, at, yaml.safe_load(value))
    error = refused(small, tmp_path)
    assert str(tmp_path) in error.message
    start = f"{section}.{key[1:]}".rstrip(".") if key.startswith("^") else at + key
    assert error.key.startswith(start)
    assert says.replace("{all}", "depth, speed, direction") in error.message


LAUGHS = "a0: &a0 [x, x]" + "".join(
    f"\na{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 20)
)
RAW = {
    "not a mapping": (b"- a\n- b\n", "holds a list"),
    "empty": (b"", "holds nothing"),
    "text": (b"hello", "holds one value"),
    "not UTF-8": (b"name: caf\xe9\n", "is not UTF-8"),
    "broken": (b"a: [1, 2\n", "cannot be read"),
    "key twice": (b"a: 1\na: 2\n", "duplicate key"),
    "alias": (b"a: &x [1]\nb: *x\n", "aliases are not supported"),
    "billion laughs": (LAUGHS.encode(), "aliases are not supported"),
    "deep": (b"a: " + b"[" * 200 + b"]" * 200, "nested more than"),
    "python object": (b"a: !!python/object/apply:os.system ['true']\n", "cannot be read"),
    "base 60": (b"a: 1:30.5\n", "base-60"),
    "huge": (b"a: '" + b"x" * (1 << 20) + b"'\n", "is over"),
}


@pytest.mark.parametrize(("data", "says"), RAW.values(), ids=list(RAW))
def test_what_is_no_protocol_file_is_refused(data: bytes, says: str, tmp_path: Path) -> None:
    path = tmp_path / "wrong.yaml"
    path.write_bytes(data)
    with pytest.raises(InputError, match=says) as caught:
        load_plan(path)
    assert str(path) in caught.value.message


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
    plan_of(small, tmp_path)
    monkeypatch.setattr("sliplab.protocols.plan.MAX_ID", 30)
    assert "30 at most" in refused(small, tmp_path).message


def test_a_number_is_shown_as_it_was_written() -> None:
    error = InputError("rig.yaml", "mock.scene.friction.kinetik", Decimal("0.9"), "unknown key")
    assert str(error) == "rig.yaml: mock.scene.friction.kinetik = 0.9: unknown key"


EVERY = "{every: %s, condition: {depth: 2.8, speed: 1, direction: 0}}"
NUMBERS = f"""
collection
    repetitions: true; .inf; {10**12}
    seed: true; .inf; -1; {2**63}
    references: {EVERY % "true"}; {EVERY % 10**12}
    gates.frames_lost: false; .inf; {10**12}
    gates.event_burst: true; .inf; {10**12}
    gates.retakes: true; {10**12}
    gates.event_gap: true; inf s; 1e9 s
    gates.path_deviation: nan mm; 1e9 mm
    gates.sync_uncertainty: {{host_time: 1e9 min}}
    maintenance.rezero.every: true; .inf; {10**12}
    maintenance.rezero.speed: 1.1 mm/s; 50 mm/s
    maintenance.warm_up.presses: true; {10**12}
    maintenance.clean: {{every: {10**12}, prompt: clean}}
    limits.duration: 1e9 min
    limits.workspace.x.low: -1e9 m
    recording.sync_rate: true; .inf
analysis
    labelling.threshold_px: true; .inf; {10**12}
    labelling.reference_ms: true; .inf; {10**12}
    windows.length_ms: true; .inf; {10**12}
    windows.pool_px: true
    samples.per_class: true; {10**12}
    split.train: true; .inf; .nan
    network: {{conv1_kernel: true}}; {{outputs_per_class: {10**12}}}
    network: {{weight_scale: [4, 3, 4, true]}}; {{weight_scale: [4, 3, 4, .inf]}}
    network: {{weight_scale: [4, 3, 4, -1]}}
    training.epochs: true; .inf; {10**12}
    training.learning_rate: true; .nan; {10**12}
    training.gain: true; .inf
    training.patience: true; {10**12}
    training.seeds: [{10**30}]; [true]
    detection.smoothing: true; .inf; {10**12}
    detection.margin: true; .inf; .nan; "inf"; 1.0e+12
    detection.false_early_ms: true; .inf; 1.0e+12
    detection.smoothing_grid: [1, {10**12}]; [true, 2]
    detection.margin_grid: [1, .inf]; [1, 1.0e+12]; [false, 2]
    detection.false_early_rate: true; .inf; .nan
    detection.compare: {{train_trials: {10**12}}}; {{rates: [.nan]}}; {{rates: [false]}}
protocol
    : true
"""


def numbers() -> Iterator[tuple[str, list[Any]]]:
    """Yield each place of the table, and what is no number there."""
    for line in NUMBERS.strip().splitlines():
        if not line.startswith(" "):
            section = line
            continue
        place, _, values = line.strip().partition(":")
        yield f"{section}.{place}".strip("."), [yaml.safe_load(v) for v in values.split(";")]


@pytest.mark.parametrize(("key", "values"), list(numbers()))
def test_numbers_are_numbers_finite_and_bounded(
    key: str, values: list[Any], small: dict[str, Any], tmp_path: Path
) -> None:
    """No switch (yes is not 1), no infinity, no NaN, nothing out of the world."""
    for value in values:
        data = copy.deepcopy(small)
        put(data, key, value)
        error = refused(data, tmp_path)
        assert error.key.startswith(key), error.message
        assert error.value is not None
        assert "Decimal(" not in error.message


def _without(action: str) -> dict[str, Any]:
    """The gravity pilot without an action, or with its catch before the release."""
    data: dict[str, Any] = yaml.safe_load((ROOT / "protocols" / "pilot_gravity.yaml").read_text())
    motion = data[COLLECTION]["motion"]
    if action == "order":
        motion[-2], motion[4] = motion[4], motion[-2]
    motion[:] = [phase for phase in motion if phase.get("action") != action]
    return data


@pytest.mark.parametrize(
    ("action", "key", "says"),
    [
        ("catch", "collection.motion", "but never caught: add"),
        ("release", "collection.motion", "must release the plate"),
        ("raise", "collection.motion", "must raise the plate"),
        ("order", "collection.motion[4].action", "must come after"),
    ],
)
def test_a_plate_that_falls_is_caught(action: str, key: str, says: str, tmp_path: Path) -> None:
    error = refused(_without(action), tmp_path)
    assert error.key == key, error.message
    assert says in error.message


def test_protocols_in_stores_are_held_to_the_rules_of_their_day(small: Any, tmp_path: Path) -> None:
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
TEXTS = """yes | no | ~ | 2026-11-23 | 2026-02-30 | 12:30 | 0x10 | 1e12 | 1.0e+12 | .inf | -.inf
 | .nan | -1 | [] | [2.5, {a: 0.5}] | {a: 0.5} | !include x | !!set {a} | *a | << | &a 5
 | "\\e[31mred" | "\\x9b31m" | "\\u202Ered" | 2,5 | 2,5 mm | \u221210 mm | 5 \u00b5m | 1,000 mm
 | $sped | $ | 1 um | '' | 'a: b' | 99999999999999999999 | 1000000 m"""
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
    part = data
    for key in path[:-1]:
        part = part[key]
    part[path[-1]] = PLACE
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


ANYWHERE = given(st.sampled_from(LEAVES), st.sampled_from(re.split(r"\s+\| ", TEXTS)))
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
        ("distance", 25, "outside collection.limits.workspace.x"),
    ],
)
def test_reference_trials_obey_the_limits(
    name: str, level: float, says: str, small: dict[str, Any], tmp_path: Path
) -> None:
    condition = {"depth": 2.8, "speed": 1, "direction": 0, "distance": 9}
    small[COLLECTION]["factors"]["distance"] = {"unit": "mm", "values": [9]}
    small[COLLECTION]["motion"][3]["distance"] = "$distance"
    small[COLLECTION]["references"] = {"every": 5, "condition": condition}
    assert len(plan_of(small, tmp_path)) == 44
    condition[name] = level
    error = refused(small, tmp_path)
    assert says in error.message
    assert error.key == f"collection.references.condition.{name}"
