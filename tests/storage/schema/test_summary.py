"""A report's numbers: kept to the byte, and refused by key where they lack something."""

from __future__ import annotations

from pathlib import Path

import pytest

from sliplab.storage.files import json_text, read_json, write_json
from sliplab.storage.schema.document import DocumentError
from sliplab.storage.schema.summary import Summary
from tests.flows.older import older_store


@pytest.fixture(scope="module")
def older(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A summary that an older version wrote."""
    return older_store(tmp_path_factory.mktemp("older")) / "report" / "summary.json"


def test_an_older_summary_is_written_as_it_was_read(older: Path) -> None:
    found = Summary.load(older)
    assert json_text(found.to_json()) == older.read_text()
    assert found.kinematic.accounted.planned == len(found.trials)
    assert found.kinematic.latency_ms.incipient.n == found.kinematic.intervals.lead_ms.n


def test_unknown_keys_are_kept(older: Path, tmp_path: Path) -> None:
    data = read_json(older)
    data["later"] = {"a": 1}
    data["kinematic"]["interval"]["method"] = "t"
    path = tmp_path / "summary.json"
    write_json(path, data)
    assert Summary.load(path).to_json() == data


def test_what_is_missing_or_wrong_is_named(older: Path, tmp_path: Path) -> None:
    path = tmp_path / "summary.json"
    data = read_json(older)
    del data["gravity"]["lead_ms"]["median"]
    write_json(path, data)
    with pytest.raises(DocumentError, match=r"summary\.json: gravity\.lead_ms\.median: is missing"):
        Summary.load(path)
    write_json(path, {**read_json(older), "simulated": "yes"})
    with pytest.raises(DocumentError, match=r"simulated.*must be true or false"):
        Summary.load(path)
