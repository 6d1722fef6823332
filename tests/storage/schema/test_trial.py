"""The models of a trial's documents: same bytes, precise faults."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from sliplab.storage.files import json_text
from sliplab.storage.schema.document import DocumentError, NewerFormat
from sliplab.storage.schema.trial import TrialClockMaps, TrialRecord
from tests.protocols.planning import put_all, rows
from tests.storage.trial_files import record

PATH = Path("record.json")


def test_what_is_read_is_written_again_to_the_byte() -> None:
    data = record("t").to_json() | {
        "recorded_s": 1,
        "seed": 2**63 + 1,
        "a key of a later version": {"x": [1, 2.0, None]},
        "geometry": {"event_px": [640, 480], "frame_px": None, "skin_mm": [[0, 1.5]]},
        "imported": {"format": "aedat4", "from": "a.aedat4", "epoch": "unknown"},
        "quality": {"passed": True, "gates": {"g": {"value": 0, "limit": 0.5, "passed": True}}},
    }
    assert json_text(TrialRecord.parse(data, PATH).to_json()) == json_text(data)


# what is put where (nothing: dropped) | what is said
FAULTS = """
    counts.events: '12' | record.json: counts.events = 12: must be a whole number
    recorded_s: true | record.json: recorded_s = true: must be a number
    recorded_s: .inf | must be a finite number
    quality: | record.json: quality: is missing
    quality.gates.g: {passed: true, value: [1]} | quality.gates.g.value = [1]: must be a number
    condition.depth: deep mm | condition.depth = deep mm: must be a number with its unit
    clocks.arm.map.drift: [0.5] | must be a clock map
    counts.events: 9223372036854775808 | must fit 64 bits
    counts: [] | counts = []: must be a mapping
"""


@pytest.mark.parametrize(("change", "words"), rows(FAULTS))
def test_a_fault_names_file_key_value_and_what_would_be_right(change: str, words: str) -> None:
    data = json.loads(json.dumps(record("t").to_json()))
    put_all(data, change)
    with pytest.raises(DocumentError) as fault:
        TrialRecord.parse(data, PATH)
    assert words in str(fault.value)


def test_a_newer_format_is_told_from_damage() -> None:
    with pytest.raises(NewerFormat, match="format = 2: was written by a newer version"):
        TrialRecord.parse({"format": 2, "trial": 1}, PATH)


def test_a_rejected_attempt_may_lack_the_clock_of_its_events() -> None:
    data = record("t").to_json()
    del data["clocks"]["events"]
    with pytest.raises(DocumentError, match=r"clocks\.events: is missing"):
        TrialRecord.parse(data, PATH)
    data["quality"]["passed"] = False
    found = TrialRecord.parse(data, PATH)
    assert list(found.clocks.devices()) == ["frames", "arm"]


def test_uncertainty_against_events_counts_both_maps() -> None:
    clocks: TrialClockMaps = record("t").clocks
    assert clocks.against_events_ns("events") == 1000.0
    assert clocks.against_events_ns("arm") == 2000.0
    unknown = {**clocks.to_json(), "arm": {**clocks.to_json()["arm"], "uncertainty_ns": None}}
    assert TrialClockMaps.model_validate(unknown).against_events_ns("arm") is None
