"""Figures of labels: slips in the hold, and how far apart both ends of it leave the onsets."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from sliplab.analysis.labels.label_errors import distances, holds_compared
from sliplab.storage.schema.label import LABELS as STEP
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.recording import Recording
from tests.analysis.labels.reviewable import NAME, Reviewable, label

MS = 1_000_000


def held(slips_px: list[float | None], start_ms: int | None, end_ms: int) -> dict[str, Any]:
    """A label of this version with incipient onsets counted from either end of the hold."""
    none = {"incipient": None, "gross": None}
    start, end = (
        {"incipient_ns": at, "gross_ns": 900 * MS, "doubts": none}
        for at in (None if start_ms is None else start_ms * MS, end_ms * MS)
    )
    return {
        **label(),
        "rule": "paper",
        "reference": "hold_start",
        "paper": start,
        "change_point": end,
        "references": {"hold_start": start, "hold_end": end},
        "hold_slip_px": slips_px,
    }


def test_slips_in_the_hold_are_counted_and_their_size_told(tmp_path: Path) -> None:
    made = Reviewable(tmp_path / "s", 5)
    derived = Derived.of(made.store, STEP, NAME)
    labels = [
        held([0.01, 0.02], 300, 300),
        held([0.9, None], 300, 310),
        held([1.1, 7.5], 120, 1900),
        held([None, None], None, 300),
    ]
    for trial, known in zip(made.ids, labels, strict=False):  # the fifth is as labels were
        derived.write(trial, made.keys[trial], known)
    found = holds_compared(made.store, [made.item])[NAME]
    assert (found.trials, found.slipped, found.limit_px) == (4, 1, 1.0)
    assert found.most_px == 7.5
    assert found.apart_ms.incipient.to_json() == {
        "n": 3,
        "median": 10.0,
        "median_abs": 10.0,
        "max_abs": 1780.0,
    }
    assert found.apart_ms.gross.max_abs == 0.0


def test_labels_from_before_say_nothing_of_the_hold(tmp_path: Path) -> None:
    made = Reviewable(tmp_path / "s", 3)
    assert holds_compared(made.store, [made.item]) == {}


def test_a_label_is_held_against_the_truth_of_its_own_reference(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = Reviewable(tmp_path / "s", 2)
    truth = {"incipient_ns": 1900 * MS, "gross_ns": 900 * MS, "first_slip_ns": 290 * MS}
    truth["from_hold"] = {"incipient_ns": 115 * MS, "gross_ns": 898 * MS}
    monkeypatch.setattr(Recording, "simulation_truth", lambda self: truth)
    derived = Derived.of(made.store, STEP, NAME)
    derived.write(made.ids[0], made.keys[made.ids[0]], held([0.1], 120, 1904))
    other = held([0.1], 120, 1904)
    other |= {"reference": "hold_end", "paper": other["references"]["hold_end"]}
    derived.write(made.ids[1], made.keys[made.ids[1]], other)
    assert distances(made.store, [made.item])["paper"] == {
        "incipient": [5.0, 4.0],
        "gross": [2.0, 0.0],
    }
