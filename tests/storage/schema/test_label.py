"""The label of a trial as a document: older ones, damaged ones, and writing what was read."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from sliplab.storage.errors import StoreError
from sliplab.storage.files import json_text, read_json, write_json
from sliplab.storage.schema.label import LABELS, TrialLabel
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.store import TrialStore
from tests.flows.older import older_store


def test_a_label_of_an_older_version_is_written_as_it_was_read(tmp_path: Path) -> None:
    store = TrialStore.open(older_store(tmp_path / "store"))
    labels = Derived.of(store, LABELS, "small")
    paths = sorted(labels.folder.glob("*.json"))
    assert len(paths) == 4
    for path in paths:
        label = labels.load(path.stem, TrialLabel)
        assert json_text(label.to_json()) == path.read_text()
        assert label.by_rule("paper").known_ns("gross") == label.gross_ns
        assert len(label.per_marker_ns) == len(label.change_point.low_ns) == 19


def test_keys_that_older_versions_did_not_write_have_defaults() -> None:
    label = TrialLabel.model_validate({"incipient_ns": 1, "gross_ns": None, "end_ns": 9, "new": 3})
    assert label.references is None
    assert label.doubts.of("incipient") is None
    assert label.to_json() == {"incipient_ns": 1, "gross_ns": None, "end_ns": 9, "new": 3}
    with pytest.raises(ValueError, match="change_point: is missing; run `sliplab label`"):
        label.by_rule("change_point")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"incipient_ns": 1.5}, r"incipient_ns = 1.5: must be a whole number"),
        ({"rule": "mine"}, r"rule = mine: must be 'paper', 'change_point', 'force' or 'given'"),
        ({"paper": {"gross_ns": 1}}, r"paper.incipient_ns: is missing"),
    ],
)
def test_a_damaged_label_names_file_key_and_value(tmp_path: Path, change: Any, said: str) -> None:
    store = TrialStore.open(older_store(tmp_path / "store"))
    labels = Derived.of(store, LABELS, "small")
    path = min(labels.folder.glob("*.json"))
    write_json(path, {**read_json(path), **change})
    with pytest.raises(StoreError, match=rf"{path.name}: {said}.*it is damaged: delete it"):
        labels.load(path.stem, TrialLabel)
