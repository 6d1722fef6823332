"""The simulated TacTip-like sensor: 127 pins seen by a camera that runs by itself."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from sliplab.analysis.campaigns import collected
from sliplab.analysis.labels.labelling import label_recording
from sliplab.flows.collect import collect
from sliplab.flows.planning.run_request import make_request
from sliplab.plugins.simulation.settings import scene_of
from sliplab.protocols.errors import InputError
from sliplab.rigs.rig_file import load_rig_file
from sliplab.storage.trials.store import TrialStore
from tests.conftest import ROOT
from tests.flows.conftest import tiny, write

RIG = ROOT / "rigs" / "tactip.yaml"


@pytest.mark.long
def test_a_trial_of_127_pins_passes_its_gates_and_is_labelled(tmp_path: Path) -> None:
    data = tiny()
    data["collection"]["factors"]["direction"]["values"] = [0]
    data["analysis"]["split"] = {"method": "ranked"}
    request = make_request(write(tmp_path / "tiny.yaml", data), RIG, tmp_path / "store")
    assert collect(request)["committed"] == 1
    (item,) = collected(TrialStore.open(tmp_path / "store"))
    ((_, recording),) = item.trials
    record = recording.record
    assert len(record.geometry.skin_mm) == 127
    assert record.counts.events == 0
    assert record.clocks.frames.grade == "host arrival"
    # 60 a second, though the box ticks 100 times: none counts as lost
    assert record.quality.gates["frames_lost"].value == 0
    assert abs(record.counts.frames / record.recorded_s - 60) < 3

    label = label_recording(recording, item.settings.labelling)
    truth = (recording.simulation_truth() or {})["from_hold"]
    for onset, true in (
        (label.onsets.incipient_ns, truth["incipient_ns"]),
        (label.onsets.gross_ns, truth["gross_ns"]),
    ):
        # a frame, and half of the delay that the rig file promises
        assert abs(onset - true) < 17e6 + 25e6
    assert (label.doubts.incipient, label.doubts.gross) == (None, None)


def test_the_layout_of_the_rig_file_is_that_of_the_scene() -> None:
    rig, _ = load_rig_file(RIG)
    assert rig.skin.ring_counts == scene_of(rig).scene.skin.ring_counts
    assert float(rig.skin.ring_spacing) == scene_of(rig).scene.skin.spacing_mm
    assert float(rig.skin.radius) == scene_of(rig).scene.skin.radius_mm
    assert rig.frame_camera.rate_hz == scene_of(rig).frame_camera.rate_hz


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"timing": {"frames": "hardware trigger"}}, "must be left out with timing.frames"),
        ({"frame_camera": {"rate_hz": 30}}, "must be mock.frame_camera.rate_hz = 60"),
    ],
)
def test_a_rate_that_cannot_be_is_refused(
    tmp_path: Path, change: dict[str, dict[str, Any]], message: str
) -> None:
    path = write(tmp_path / "rig.yaml", {"extends": str(RIG), "name": "other", **change})
    with pytest.raises(InputError, match=message):
        load_rig_file(path)
