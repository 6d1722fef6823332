"""Results of other programs: tables of the benchmarks of labels."""

from __future__ import annotations

import json

import pytest

from sliplab.plugins.studies.section import label_speed, label_truth
from tests.conftest import ROOT


def kept(name: str) -> dict[str, float]:
    """The figures that the benchmark gave last."""
    found: dict[str, float] = json.loads((ROOT / "benchmarks/results" / name).read_text())[
        "figures"
    ]
    return found


def test_each_way_is_beside_our_own() -> None:
    figures = kept("labels.json")
    rows = {row[0]: row[1:] for row in label_speed(figures).rows}
    assert len(rows) == 4
    own = rows["SlipLab's tracker"]
    assert own[1] == "1"
    assert float(own[0]) == pytest.approx(figures["frame_ms"], rel=5e-3)
    blob = rows["OpenCV's blob detector as it stands"]
    ratio = figures["blob_detector_frame_ms"] / figures["frame_ms"]
    assert float(blob[1]) == pytest.approx(ratio, rel=5e-3)
    assert label_speed({"frame_ms": 1.0}).rows == [["SlipLab's tracker", "1", "1", "–"]]
    with pytest.raises(KeyError):
        label_speed({"x": 1.0})


def test_each_set_of_trials_is_a_column() -> None:
    table = label_truth(kept("labels_truth.json"))
    assert table.columns[1:] == ("slides", "falling plates", "slides with nuisances")
    rows = {row[0]: row[1:] for row in table.rows}
    assert rows["trials"] == ["60", "12", "24"]
    assert rows["onsets of trials that are wrong without a doubt"] == ["–", "0", "0"]
    assert label_truth({"trials": 3.0, "slip_bias_ms": float("nan")}).rows == [
        ["trials", "3"],
        ["the same, median with its sign (ms)", "–"],
    ]
    with pytest.raises(KeyError):
        label_truth({"x": 1.0})
