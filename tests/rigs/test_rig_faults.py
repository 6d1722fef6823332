"""Devices that go in the middle of a trial: the arm is stopped first, and all others after it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rigs.capabilities import ArmFault, RigError
from tests.rigs.test_rig import Memory, after_the_stop, make_rig, run, short_plan, watched

STOPS = ["arm.stop", "events.stop", "frames.stop", "sync.stop"]


def gone(device: str) -> dict[str, Any]:
    return {"kind": "device_gone", "device": device, "at_s": 0.8}


@pytest.mark.parametrize("device", ["arm", "event_camera", "frame_camera", "sync_box"])
def test_whichever_device_goes_the_others_are_stopped_in_order(device: str) -> None:
    rig = make_rig(faults=[gone(device)])
    notes = watched(rig)
    with pytest.raises(RigError, match="does not answer") as caught:
        run(rig, short_plan(), Memory())
    assert caught.value.device == device.replace("_", " ")
    calls = after_the_stop(notes)
    assert [call for call in calls if call in STOPS] == STOPS
    assert ("arm.start" in calls) == (device != "arm")  # it retracts if it can
    notes.clear()
    rig.close()
    closed = [call for call in notes if call.endswith("close")]
    assert closed == ["arm.close", "events.close", "frames.close", "sync.close"]


@pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError("disk full")])
def test_whoever_stops_the_rig_hears_that_the_arm_could_not_be(error: BaseException) -> None:
    """The arm goes while the third poll of the recording is written, which fails."""
    rig = make_rig(faults=[gone("arm")])
    sink = Memory(fail_after=3, error=error)
    wait = rig.clock.wait

    def slow_disk(chunk: Any) -> None:
        wait(1.0)
        raise error

    sink.add_events = slow_disk  # type: ignore[method-assign]
    notes = watched(rig)
    with pytest.raises(ArmFault, match="does not answer") as caught:
        run(rig, short_plan(), sink)
    assert caught.value.__cause__ is error
    assert [call for call in after_the_stop(notes) if call in STOPS] == STOPS


def test_a_device_that_comes_back_between_polls_has_lost_a_little() -> None:
    fault = {**gone("event_camera"), "seconds": 0.01, "at_s": 0.85}
    rig, sound = make_rig(faults=[fault]), Memory()
    run(rig, short_plan(), sound)
    plain = Memory()
    run(make_rig(), short_plan(), plain)
    lost = len(plain.all("events t_us")) - len(sound.all("events t_us"))
    assert 0 < lost < 0.1 * len(plain.all("events t_us"))


@pytest.mark.parametrize("device", ["arm", "event_camera", "frame_camera"])
def test_a_clock_that_begins_again_does_not_stop_a_trial(device: str) -> None:
    rig = make_rig(faults=[{"kind": "clock_restart", "device": device, "at_s": 0.2}])
    sink, plain = Memory(), Memory()
    hit, sound = run(rig, short_plan(), sink), run(make_rig(), short_plan(), plain)
    assert hit.truth["per_papilla_ns"] == sound.truth["per_papilla_ns"]
    stamps = {"arm": "arm pulses", "event_camera": "event pulses", "frame_camera": "frame times"}
    for name, stream in stamps.items():
        assert np.any(np.diff(sink.all(stream)) < 0) == (name == device)
        assert len(sink.all(stream)) == len(plain.all(stream))
