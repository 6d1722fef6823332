"""Slides that are faster, or pressed less deep, than those of the shipped protocols, labelled."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from sliplab.analysis.labels.labelling import label_recording
from sliplab.protocols.labelling import Labelling
from tests.flows.collecting.test_session import session
from tests.flows.conftest import take_all, tiny

FRAME_MS = 10.0
LONG = ((2.4, 6.0), (1.8, 1.6))
SLIDES = [(2.4, 20.0), *(pytest.param(*each, marks=pytest.mark.long) for each in LONG)]


@pytest.mark.long
@pytest.mark.parametrize(("depth_mm", "speed_mm_s"), SLIDES, ids=str)
def test_onsets_are_within_two_frames_of_the_truth(
    tmp_path: Path, depth_mm: float, speed_mm_s: float
) -> None:
    """At 6 mm/s a marker steps by 1.2 px a frame; at 1.8 mm the outer ring does not touch."""
    data: dict[str, Any] = tiny()
    factors = data["collection"]["factors"]
    factors["depth"]["values"], factors["speed"]["values"] = [depth_mm], [speed_mm_s]
    factors["direction"]["values"] = [0, 60, 120, 200]
    data["analysis"]["split"] = {"method": "ranked"}
    work, campaign = session(tmp_path / "a", data, frame_camera={"level": "tracks"})
    take_all(work)
    for recording in campaign.recordings():
        label, truth = label_recording(recording, Labelling()), recording.simulation_truth()
        assert truth is not None
        assert label.camera.largest_px == 0.0
        assert (label.doubts.incipient, label.doubts.gross) == (None, None)
        for onset in ("incipient_ns", "gross_ns"):
            late_ms = (getattr(label.onsets, onset) - truth["from_hold"][onset]) / 1e6
            assert -FRAME_MS < late_ms < 2 * FRAME_MS
