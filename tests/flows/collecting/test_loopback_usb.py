"""A trial whose frames come through the driver of USB cameras, in real time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sliplab.storage.trials.store import TrialStore
from sliplab.storage.trials.verify import verify
from tests.flows.conftest import take_all
from tests.flows.live import at_work, quick, request_in, rig_yaml, stage_of

pytestmark = [pytest.mark.realtime, pytest.mark.xdist_group("scene")]

RATE_HZ = 30


def usb_rig(folder: Path) -> Path:
    """The shipped loopback rig with a USB camera in place of a Basler."""
    picture = {"width_px": 640, "height_px": 480, "rate_hz": RATE_HZ}
    return rig_yaml(
        folder,
        frame_camera={"scale_px_per_mm": 10, **picture},
        timing={"frames": "host arrival"},
        devices={"frame_camera": {"driver": "uvc", "exposure_us": 2000, **picture}},
        mock={"frame_camera": {"rate_hz": RATE_HZ}},
    )


@pytest.mark.long
def test_frames_of_a_usb_camera_show_the_slide(tmp_path: Path) -> None:
    run_request = request_in(tmp_path / "live", quick(), usb_rig(tmp_path))
    with (
        stage_of(run_request.rig) as stage,
        at_work(run_request, stage) as (work, campaign),
    ):
        take_all(work)
        (recording,) = campaign.recordings()
    assert verify(TrialStore.open(run_request.store)) == []
    record = recording.record
    assert record.simulated
    assert record.clocks.frames.grade == "host arrival"
    assert record.quality.gates["frames_lost"].passed
    start, end = recording.motion_ns
    times = recording.frame_times()
    assert np.diff(times).min() > 0
    inside = (times >= start) & (times < end)
    assert abs(inside.sum() - RATE_HZ * (end - start) / 1e9) < 4
    # the picture changes while the sensor slides, and hardly in the hold
    hold, _ = recording.step("hold")
    still = np.flatnonzero((times > hold + 1e8) & (times < start - 1e8))
    images = [np.asarray(image, np.float64) for image in recording.frames()]
    moved = [abs(images[k] - images[k - 1]).mean() for k in np.flatnonzero(inside)[2:-2]]
    rest = [abs(images[k] - images[k - 1]).mean() for k in still[1:]]
    assert np.median(moved) > np.median(rest)
