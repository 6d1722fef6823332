"""The published JSON Schemas: as strict as they can be, and never stricter than the readers."""

from __future__ import annotations

import json
from collections.abc import Callable
from datetime import date
from pathlib import Path
from typing import Any

import pytest
import yaml
from jsonschema import Draft7Validator

from sliplab.flows.planning.json_schemas import document_model, file_schema, kinds
from sliplab.protocols.adapter import Adapter
from sliplab.protocols.errors import InputError
from sliplab.protocols.model import Protocol
from sliplab.protocols.yaml_file import StrictModel, validate
from sliplab.rigs.rig_file import RigFile, load_rig_file
from sliplab.storage.files import json_text, read_json
from tests.conftest import ROOT
from tests.docs.nonsense import changed_at, check_refusals, checker, leaves, nonsense
from tests.flows.older import older_store
from tests.plugins.adapters.adapters import SLIDES

FILES: list[tuple[str, Path]] = [
    *(("protocol", path) for path in sorted((ROOT / "protocols").glob("*.yaml"))),
    *(("rig", path) for path in sorted((ROOT / "rigs").glob("*.yaml"))),
    ("adapter", ROOT / "examples" / "ev-objects" / "adapter.yaml"),
]
MODELS: dict[str, type[StrictModel]] = {"protocol": Protocol, "rig": RigFile, "adapter": Adapter}


def _read(path: Path) -> Any:
    """A file as an editor sees it: dates are text."""
    return _plain(yaml.safe_load(path.read_text()))


def _plain(part: Any) -> Any:
    if isinstance(part, dict):
        return {key: _plain(value) for key, value in part.items()}
    if isinstance(part, list):
        return [_plain(item) for item in part]
    return part.isoformat() if isinstance(part, date) else part


@pytest.mark.parametrize("kind", kinds())
def test_schemas_are_schemas_and_published_as_they_are(kind: str) -> None:
    made = file_schema(kind)
    Draft7Validator.check_schema(made)
    published = (ROOT / "docs" / "schema" / f"{kind}.json").read_text()
    assert published == json_text(made), f"run: sliplab schema {kind} --out docs/schema/{kind}.json"


@pytest.mark.parametrize(("kind", "path"), FILES, ids=lambda item: getattr(item, "name", item))
def test_every_shipped_file_is_accepted(kind: str, path: Path) -> None:
    found = [
        f"{error.json_path}: {error.message}" for error in checker(kind).iter_errors(_read(path))
    ]
    assert not found


@pytest.fixture(scope="module")
def older(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store of an older version."""
    return older_store(tmp_path_factory.mktemp("older") / "store")


@pytest.mark.parametrize(
    ("kind", "pattern", "count"),
    [
        ("trial", "campaigns/*/trials/*/record.json", 4),
        ("label", "derived/labels/*/*.json", 4),
        ("evaluation", "derived/evaluation/*.json", 1),
        ("summary", "report/summary.json", 1),
    ],
)
def test_documents_of_a_store_are_accepted_and_read(
    older: Path, kind: str, pattern: str, count: int
) -> None:
    paths = sorted(older.glob(pattern))
    assert len(paths) == count
    for path in paths:
        data = read_json(path)
        found = [f"{e.json_path}: {e.message}" for e in checker(kind).iter_errors(data)]
        assert not found
        assert document_model(kind)[0].parse(data, path).to_json() == data


EVERY = [False, pytest.param(True, marks=pytest.mark.long)]
"""One kind of nonsense at each place, or all of them."""


@pytest.mark.quick(1)
@pytest.mark.parametrize("every", EVERY)
@pytest.mark.parametrize(
    ("kind", "pattern"),
    [
        ("trial", "campaigns/*/trials/*/record.json"),
        ("label", "derived/labels/*/*.json"),
        ("evaluation", "derived/evaluation/*.json"),
        ("summary", "report/summary.json"),
    ],
)
def test_nothing_is_refused_in_a_document_that_its_reader_takes(
    older: Path, kind: str, pattern: str, every: bool
) -> None:
    """Documents of classes are tested where a store has them (tests/plugins/classes)."""
    path = min(older.glob(pattern))
    assert check_refusals(kind, path, every=every) > (100 if every else 25)


@pytest.mark.parametrize("every", EVERY)
@pytest.mark.parametrize(
    ("kind", "data"),
    [
        ("protocol", _read(ROOT / "protocols" / "gravity.yaml")),
        ("rig", _plain(yaml.safe_load(load_rig_file(Path("loopback"))[1]))),
        ("adapter", SLIDES),
    ],
    ids=["gravity", "loopback", "slides"],
)
def test_nothing_is_refused_that_the_readers_take(kind: str, data: Any, every: bool) -> None:
    """With every value made nonsense, one at a time, the readers refuse what the schema does."""
    refused = 0
    for at, junks in nonsense(leaves(data), every):
        for junk in junks:
            wrong = changed_at(data, at, junk)
            if checker(kind).is_valid(wrong):
                continue
            refused += 1
            with pytest.raises(InputError):
                validate(MODELS[kind], wrong, "wrong.yaml")
    assert refused > (200 if kind != "adapter" else 80) // (1 if every else 4)


Change = Callable[[Any], None]


def _put(*at: Any, to: Any) -> tuple[tuple[Any, ...], Any]:
    return at, to


PILOT = _read(ROOT / "protocols" / "pilot.yaml")
MOTION = ("collection", "motion")
WRONG_PROTOCOLS = {
    "unknown key": _put("collection", "repetition", to=2),
    "unknown key in a phase": _put(*MOTION, 1, "sped", to="1 mm/s"),
    "unknown phase": _put(*MOTION, 1, "phase", to="jump"),
    "a phase's other key": _put(*MOTION, 1, "direction", to="0 deg"),
    "wrong unit": _put(*MOTION, 1, "speed", to="2 kg"),
    "no unit": _put(*MOTION, 3, "distance", to=12),
    "a speed below 0": _put(*MOTION, 0, "speed", to="-2 mm/s"),
    "a speed of 0": _put(*MOTION, 0, "speed", to="0.00 mm/s"),
    "no reference": _put(*MOTION, 1, "depth", to="$Depth"),
    "a factor's unit": _put("collection", "factors", "depth", "unit", to="furlong"),
    "a factor's name": _put("collection", "factors", "Depth", to={"unit": "mm", "values": [1]}),
    "both levels and range": _put(
        "collection", "factors", "depth", "range", to={"from": 1, "to": 2, "step": 1}
    ),
    "a level with a comma": _put("collection", "factors", "depth", "values", 0, to="2,4 mm"),
    "no factors": _put("collection", "factors", to={}),
    "repetitions": _put("collection", "repetitions", to=0),
    "a seed as text": _put("collection", "seed", to="one"),
    "a protocol's name": _put("name", to="My Protocol"),
    "another version": _put("protocol", to=2),
    "an even kernel": _put("analysis", "network", to={"conv1_kernel": 4}),
    "epochs as text": _put("analysis", "training", "epochs", to="many"),
    "an unknown rule": _put("analysis", "labelling", "rule", to="mine"),
    "a list for a mapping": _put("analysis", "windows", to=[30]),
}


@pytest.mark.parametrize("at_to", WRONG_PROTOCOLS.values(), ids=WRONG_PROTOCOLS.keys())
def test_wrong_protocols_are_refused(at_to: tuple[tuple[Any, ...], Any]) -> None:
    assert not checker("protocol").is_valid(changed_at(PILOT, *at_to))


@pytest.mark.parametrize("key", ["protocol", "name", "collection"])
def test_a_missing_key_is_refused(key: str) -> None:
    assert not checker("protocol").is_valid({k: v for k, v in PILOT.items() if k != key})


UR5 = _read(ROOT / "rigs" / "ur5.yaml")
NOISY = _read(ROOT / "rigs" / "mock_noisy.yaml")
WRONG_RIGS = {
    "unknown driver": (UR5, _put("driver", to="abacus")),
    "unknown arm": (UR5, _put("devices", "arm", "driver", to="kuka")),
    "an arm's missing host": (UR5, _put("devices", "arm", to={"driver": "ur"})),
    "wrong unit": (UR5, _put("limits", "speed", to="5 kg")),
    "a plane without units": (
        UR5,
        _put("calibration", "contact_plane", "centre", to=[1.0, 2.0, 3.0]),
    ),
    "ages in hours": (UR5, _put("calibration", "max_age", to={"lens": "3 h"})),
    "an age without a unit": (UR5, _put("calibration", "max_age", to={"lens": 3})),
    "unknown key in a file that extends": (NOISY, _put("mock", "event_camera", "nose_hz", to=1)),
    "wrong value in a file that extends": (NOISY, _put("mock", "event_camera", "noise_hz", to=-1)),
    "a file that extends a list": (NOISY, _put("extends", to=["mock.yaml"])),
    "an unknown fault": (NOISY, _put("mock", "faults", to=[{"kind": "earthquake"}])),
}


@pytest.mark.parametrize(("data", "at_to"), WRONG_RIGS.values(), ids=WRONG_RIGS.keys())
def test_wrong_rig_files_are_refused(data: Any, at_to: tuple[tuple[Any, ...], Any]) -> None:
    assert not checker("rig").is_valid(changed_at(data, *at_to))


def test_only_a_file_that_extends_may_leave_keys_out() -> None:
    assert checker("rig").is_valid(NOISY)
    assert not checker("rig").is_valid({k: v for k, v in NOISY.items() if k != "extends"})


def test_keys_are_explained() -> None:
    """An editor shows what stands below a field in the models, by the key a file has."""
    models = file_schema("protocol")["definitions"]
    reported = models["Training"]["properties"]["patience"]["description"]
    assert reported.startswith("Epochs without a better validation accuracy")
    assert models["LevelRange"]["properties"].keys() == {"from", "to", "step"}


def test_the_command_prints_and_writes_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from sliplab.flows.cli.app import app

    out = tmp_path / "rig.json"
    assert not app(["schema", "rig", "--out", str(out)], standalone_mode=False)
    deeper = tmp_path / "new" / "rig.json"
    assert not app(["schema", "rig", "--out", str(deeper)], standalone_mode=False)
    assert deeper.read_bytes() == out.read_bytes()
    assert json.loads(out.read_text()) == file_schema("rig")
    capsys.readouterr()
    assert not app(["schema", "protocol"], standalone_mode=False)
    assert json.loads(capsys.readouterr().out) == file_schema("protocol")
    assert not app(["schema", "--out", str(tmp_path / "all")], standalone_mode=False)
    written = {path.stem: path.read_text() for path in (tmp_path / "all").iterdir()}
    assert set(written) == set(kinds())
    assert json.loads(written["rig"]) == file_schema("rig")
    with pytest.raises(InputError, match="must be a folder; one file needs a KIND"):
        app(["schema", "--out", str(out)], standalone_mode=False)
    with pytest.raises(InputError, match="must be one of protocol, rig, adapter, trial, label"):
        app(["schema", "store"], standalone_mode=False)
