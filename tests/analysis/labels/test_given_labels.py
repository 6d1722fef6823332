"""Labels that came with recordings: taken as they are, with what is unknown said."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from sliplab.analysis.labels.given_labels import UNKNOWN, given_label
from sliplab.analysis.labels.labelling import label_results
from sliplab.analysis.windows.dataset import recorded_span
from sliplab.storage.schema.label import TrialLabel
from tests.analysis.foreign import chunk, foreign_campaign
from tests.patching import loose

SLIP = "adapter: 1\nname: slips\nexperiment: kinematic\n"
MS = 1_000_000


def label_of(tmp_path: Path, given: Any, **origin: Any) -> TrialLabel:
    """The label of a trial that came with `given`."""
    about = {**origin} if given is None else {**origin, "given": {"source": "o.csv", **given}}
    trials = {"a": (chunk([0, 10, 999_999]), about)}
    item = foreign_campaign(tmp_path / "store", SLIP, trials, experiment="kinematic")
    ((_, recording),) = item.trials
    label, arrays = label_results(recording, item.settings.labelling)
    assert arrays == {}
    assert label.rule == label.source == "given"
    assert recorded_span(recording) == recording.motion_ns == (0, 1000 * MS)
    return label


def test_onsets_and_their_uncertainty_are_those_of_the_data_set(tmp_path: Path) -> None:
    given = {"incipient_ns": 200 * MS, "gross_ns": 500 * MS, "uncertainty_ns": 2.0 * MS}
    label = label_of(tmp_path, given)
    assert (label.incipient_ns, label.gross_ns, label.end_ns) == (200 * MS, 500 * MS, 1000 * MS)
    assert label.doubts.incipient is label.doubts.gross is None
    assert label.intervals.incipient_ns == (198 * MS, 202 * MS)
    assert label.by_rule("given").known_ns("gross") == 500 * MS
    with pytest.raises(ValueError, match="paper: is missing"):
        label.by_rule("paper")


def test_an_onset_that_is_not_given_is_in_doubt(tmp_path: Path) -> None:
    first = label_of(tmp_path / "1", {"incipient_ns": 200 * MS})
    assert (first.incipient_ns, first.gross_ns) == (200 * MS, None)
    assert (first.doubts.incipient, first.doubts.gross) == (None, UNKNOWN)
    assert first.intervals is None
    # without the first slip nothing is made of the second
    second = label_of(tmp_path / "2", {"gross_ns": 200 * MS})
    assert (second.incipient_ns, second.gross_ns) == (None, None)
    assert label_of(tmp_path / "3", None).doubts.incipient == UNKNOWN


def test_classes_of_parts_are_kept(tmp_path: Path) -> None:
    spans = [{"start_ns": 0, "end_ns": 400 * MS, "name": "can"}]
    label = label_of(tmp_path, {"spans": spans})
    assert [(s.start_ns, s.end_ns, s.name) for s in label.spans] == [(0, 400 * MS, "can")]
    assert label.incipient_ns is None
    assert label.doubts.incipient is None  # nothing about slip was asked
    written = TrialLabel.parse(label.to_json(), tmp_path / "l.json")
    assert written == label


def test_a_collected_trial_has_no_given_label() -> None:
    class Collected:
        class record:
            imported = None

    with pytest.raises(ValueError, match=r"labelling.rule = given: .*use the rule paper"):
        loose(given_label)(Collected())
