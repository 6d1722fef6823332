"""Counts of the quality gates, against a straightforward reference count."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sliplab.analysis.labels.labelling import label_recording
from sliplab.analysis.quality import BURST_US, _event_burst
from sliplab.protocols.labelling import Labelling
from sliplab.storage.trials.recording import Recording
from tests.flows.collecting.test_session import session
from tests.flows.conftest import tiny_gravity


@pytest.mark.parametrize("count", [0, 1, 2, 500])
def test_the_fullest_stretch_is_what_a_search_finds(count: int) -> None:
    times = np.sort(np.random.default_rng(count).integers(0, 200_000, count)).astype(np.int64)
    times[count // 2 :] += BURST_US  # an edge falls on an event
    counts = [int(((times >= t) & (times < t + BURST_US)).sum()) for t in times]
    assert _event_burst(times) == max(counts, default=0)


def heavy(depth: str) -> dict[str, Any]:
    """One plate of 0.245 kg, with a hold of 1 s, at a depth."""
    data = tiny_gravity()
    collection = data["collection"]
    collection["maintenance"] = {}
    collection["factors"]["mass"]["values"] = [0.245]
    collection["motion"][2]["depth"] = depth
    collection["motion"][5] |= {"settle": "0.5 s", "duration": "1 s"}
    collection["gates"]["retakes"] = 0
    return data


def take(folder: Path, data: dict[str, Any], level: str = "tracks") -> Recording:
    """Its one trial, committed or quarantined."""
    work, campaign = session(folder, data, frame_camera={"level": level})
    work.take(list(work.plan))
    committed = list(campaign.recordings())
    return (
        committed[0] if committed else Recording(next((campaign.folder / "quarantine").iterdir()))
    )


def test_a_plate_that_slips_in_the_hold_fails_its_gate(tmp_path: Path) -> None:
    still = take(tmp_path / "still", heavy("4 mm"))
    gate = still.record.quality.gates["hold_slip_px"]
    assert gate.passed
    assert gate.limit == 1.0
    assert gate.value < 0.1
    slipping = take(tmp_path / "slipping", heavy("3.4 mm"))
    record = slipping.record
    gates = record.quality.gates
    assert [name for name, gate in gates.items() if not gate.passed] == ["hold_slip_px"]
    truth = record.simulation_truth["from_hold"]["hold_slip_mm"]
    # means over 0.2 s at either end of a slip that slows down
    most = max(truth) * record.geometry.px_per_mm
    assert 0.5 * most < gates["hold_slip_px"].value <= most


@pytest.mark.long
def test_without_its_gate_or_with_a_video_the_label_doubts_the_trial(tmp_path: Path) -> None:
    data = heavy("3.4 mm")
    with_video = take(tmp_path / "video", data, "video")
    del data["collection"]["gates"]["hold_slip"]
    without = take(tmp_path / "without", data)
    for recording in (with_video, without):
        assert "hold_slip_px" not in recording.record.quality.gates
        kept = label_recording(recording, Labelling()).document().to_json()
        assert kept["incipient_ns"] is kept["gross_ns"] is None
        assert "px in the hold" in kept["doubts"]["incipient"]
        assert kept["references"]["hold_start"]["incipient_ns"] is not None
