"""A trial with two event cameras through the real drivers, in real time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sliplab.protocols import InputError
from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.rig_file import load_rig_file
from sliplab.storage.trials.store import TrialStore
from sliplab.storage.trials.verify import verify
from tests.conftest import ROOT
from tests.flows.conftest import take_all, write
from tests.flows.live import at_work, quick, request_in, rig_yaml, stage_of
from tests.rigs.waiting import until

pytestmark = [pytest.mark.realtime, pytest.mark.xdist_group("scene")]

SIDE = {
    "kind": "events",
    "device": {"driver": "dvxplorer"},
    "mock": {"width": 320, "height": 240, "px_per_mm": 7},
}


@pytest.mark.long
def test_two_event_cameras_are_recorded_on_one_time_line(tmp_path: Path) -> None:
    run_request = request_in(tmp_path / "live", quick(), rig_yaml(tmp_path, streams={"side": SIDE}))
    with stage_of(run_request.rig) as stage:
        with at_work(run_request, stage) as (work, campaign):
            take_all(work)
            (recording,) = campaign.recordings()
            sent = stage.sent()
        assert verify(TrialStore.open(run_request.store)) == []
        record = recording.record
        side = record.streams["side"]
        assert (side.kind, side.size_px) == ("events", (320, 240))
        assert 1000 < side.rows <= sent["side"]
        assert record.clocks.streams["side"].grade == "trigger input"
        assert (record.clocks.streams["side"].uncertainty_ns or 0) < 100_000
        assert record.quality.gates["event_gap_side_s"].passed
        assert "side" in record.devices
        # both see the slide begin: they are silent before, and it is the same moment
        start, end = recording.step("hold")[0], recording.motion_ns[1]
        edges = np.arange(start, end, 50_000_000)
        rates = []
        for name in ("events", "side"):
            found = recording.events(start, end, name)
            times = np.asarray(recording.clock(name).to_reference(found.t_us * 1000))
            rates.append(np.histogram(times, edges)[0])
        assert np.corrcoef(rates)[0, 1] > 0.7


@pytest.mark.long
def test_a_second_camera_that_is_unplugged_stops_the_arm(tmp_path: Path) -> None:
    run_request = request_in(tmp_path / "live", quick(), rig_yaml(tmp_path, streams={"side": SIDE}))
    with (
        stage_of(run_request.rig) as stage,
        at_work(run_request, stage) as (work, campaign),
    ):
        unplugged: list[float] = []

        def unplug_once_it_slides() -> bool:
            right_mm = stage.arm_place()[0]
            if right_mm > 1.0 and not unplugged:
                unplugged.append(right_mm)
                stage.inject("side", "device_gone")
            return False

        work.rig.should_stop = unplug_once_it_slides
        with pytest.raises(RigError, match=r"side \(event camera\)"):
            take_all(work)
        until(stage.at_rest, 5.0)
        assert 1.0 < unplugged[0] < 7.0
        assert campaign.committed() == set()
        (aside,) = campaign.quarantined()
        assert "side (event camera)" in aside["cause"]


def test_a_frame_camera_cannot_be_a_further_one_on_a_loopback_rig(tmp_path: Path) -> None:
    back = {
        "kind": "frames",
        "scale_px_per_mm": 4,
        "region_px": [64, 64],
        "device": {"driver": "basler"},
        "mock": {"px_per_mm": 4},
    }
    data = {"extends": str(ROOT / "rigs" / "loopback.yaml"), "streams": {"back": back}}
    path = write(tmp_path / "rig.yaml", data)
    with pytest.raises(InputError, match="has no fake for a loopback rig") as raised:
        load_rig_file(path)
    assert raised.value.key == "streams.back.device.driver"
