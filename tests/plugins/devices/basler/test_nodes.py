"""Settings left in a frame camera do not change a recording, and its record has all settings."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import yaml
from pydantic import ValidationError

from sliplab.plugins.devices.basler.driver import BaslerCamera, find_camera
from sliplab.plugins.devices.basler.fake_live import LiveBasler
from sliplab.plugins.devices.basler.nodes import Nodes
from sliplab.plugins.devices.basler.settings import BaslerSettings
from sliplab.rigs.core.capabilities import RigError
from tests.plugins.devices.basler.test_fake_live import FakeScene

pytestmark = [pytest.mark.usefixtures("pylon_emulation"), pytest.mark.realtime]
LEFT: dict[str, Any] = yaml.safe_load(
    "{PixelFormat: Mono12, Gain: 6.0, GainAuto: Continuous, BlackLevel: 12.0, Gamma: 0.5, "
    "DigitalShift: 2, BinningHorizontal: 2, BinningVertical: 2, ReverseX: true, ReverseY: true, "
    "ExposureAuto: Continuous, ExposureMode: TriggerWidth, AcquisitionMode: SingleFrame, "
    "TriggerActivation: FallingEdge, LineInverter: true}"
)
"""Settings that pylon Viewer changes, away from the maker's."""
OURS: dict[str, Any] = yaml.safe_load(
    "{PixelFormat: Mono8, Gain: 0.0, GainAuto: 'Off', BlackLevel: 0.0, Gamma: 1.0, "
    "DigitalShift: 0, BinningHorizontal: 1, BinningVertical: 1, ReverseX: false, ReverseY: false, "
    "ExposureAuto: 'Off', ExposureMode: Timed, AcquisitionMode: Continuous}"
)
MID_NS = 1_000_000
HARDWARE: dict[str, Any] = {"trigger": "hardware", "trigger_line": "Line1", "sync_line": 2}


@contextmanager
def opened(device: Any, **settings: Any) -> Iterator[BaslerCamera]:
    camera = BaslerCamera(BaslerSettings(px_per_mm=10.0, **settings), device)
    try:
        yield camera
    finally:
        camera.close()


def emulated(**left: Any) -> Any:
    """An emulated camera that somebody had open and left like this."""
    device = find_camera(None)
    device.Open()
    for name, value in left.items():
        device.GetNodeMap().GetNode(name).Value = value
    device.Close()  # the emulation keeps them
    return device


def test_what_was_left_in_the_camera_is_not_in_force() -> None:
    device = emulated(**LEFT, LineSelector="Line1", LineMode="Output", TriggerDelay=500.0)
    with opened(device, **HARDWARE) as camera:
        nodes = device.GetNodeMap()
        for name, value in OURS.items():
            assert nodes.GetNode(name).Value == value, name
        found = camera.describe()["in_force"]
        assert {name: found[name] for name in OURS} == OURS
        assert found["TriggerMode[FrameBurstStart]"] == "Off"
        assert found["TriggerMode[FrameStart]"] == "On"
        assert found["TriggerSource[FrameStart]"] == "Line1"
        assert found["TriggerActivation[FrameStart]"] == "RisingEdge"
        assert found["TriggerDelay[FrameStart]"] == 0.0
        assert (found["LineMode[Line1]"], found["LineInverter[Line1]"]) == ("Input", False)
        assert found["UserSetSelector"] == "Default"
        assert found["ExposureTimeAbs"] == 2000.0
        # a software trigger goes to what is selected
        assert nodes.GetNode("TriggerSelector").Value == "FrameStart"


def test_gain_is_what_the_rig_file_says() -> None:
    with opened(emulated(), **HARDWARE, gain_db=6.0) as camera:
        assert camera.describe()["in_force"]["Gain"] == pytest.approx(6.0, abs=0.01)
        assert camera.describe()["settings"]["gain_db"] == 6.0


def live(mid_exposure_ns: int = MID_NS, **stored: Any) -> LiveBasler:
    return LiveBasler(FakeScene(), mid_exposure_ns, 2, stored)


STORED = {"Gain": 12.0, "BinningHorizontal": 2, "LUTEnable": True, "TestPattern": "Black"}


def test_a_stand_in_keeps_what_was_stored_and_does_not_grab_so() -> None:
    from pypylon import genicam, pylon

    device = live(**STORED)
    device.Open()
    try:
        nodes = device.GetNodeMap()
        assert nodes.GetNode("Gain").Value == 12.0
        with pytest.raises(genicam.GenericException, match=r"simulates BinningHorizontal 1, not 2"):
            device.StartGrabbing(pylon.GrabStrategy_OneByOne)
        nodes.GetNode("UserSetSelector").Value = "Default"
        nodes.GetNode("UserSetLoad").Execute()
        assert nodes.GetNode("Gain").Value == 0.0
        nodes.GetNode("UserSetSelector").Value = "UserSet1"
        nodes.GetNode("UserSetLoad").Execute()
        assert nodes.GetNode("TestPattern").Value == "Black"
    finally:
        device.Close()


@pytest.mark.parametrize("user_set", ["Default", "UserSet1"])
def test_a_camera_with_a_stored_user_set_grabs_as_the_rig_file_says(user_set: str) -> None:
    with opened(live(**STORED), **HARDWARE, user_set=user_set) as camera:
        found = camera.describe()["in_force"]
        assert found["UserSetSelector"] == user_set
        assert (found["Gain"], found["BinningHorizontal"]) == (0.0, 1)
        assert (found["LUTEnable"], found["TestPattern"]) == (False, "Off")
        camera.set_region(64, 48)
        camera.start()
        camera.stop()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"gain_db": 6.0}, r"Gain = 6\.0: the fake simulates Gain 0\.0, not 6\.0"),
        ({"exposure_us": 1000}, r"the fake simulates ExposureTime 2000\.0, not 1000"),
        ({"trigger": "software"}, "the fake simulates TriggerSource Line1 or Line3, not Soft"),
        ({"trigger": "free run"}, "the fake simulates AcquisitionFrameRateEnable False"),
        ({"trigger_line": "Line9"}, "trigger_line = Line9: .* triggered by Line1, Line3"),
        ({"user_set": "HighGain"}, "user_set = HighGain: this camera has Default, UserSet1"),
    ],
)
def test_a_stand_in_refuses_what_it_does_not_show(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(RigError, match=message), opened(live(), **HARDWARE | settings):
        pass


def test_a_stand_in_refuses_another_trigger_than_that_of_a_frame() -> None:
    with opened(live(), **HARDWARE) as camera:
        camera.set_region(64, 48)
        nodes = camera.device.GetNodeMap()
        nodes.GetNode("TriggerSelector").Value = "FrameBurstStart"
        nodes.GetNode("TriggerMode").Value = "On"
        with pytest.raises(RigError, match="only a trigger of FrameStart, not FrameBurstStart On"):
            camera.start()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"trigger_line": "Line9"}, "this camera is triggered by Line1, Line2, Line3"),
        ({"sync_line": 8}, "this camera has Line1, Line2, Line3"),
        ({"exposure_line": "Out1"}, "outputs of this camera are Line1, Line2, Line3"),
        ({"user_set": "UserSet3"}, "this camera has Default"),
    ],
)
def test_what_the_camera_does_not_have_is_named(settings: dict[str, Any], message: str) -> None:
    ((key, value),) = settings.items()
    said = f"{key} = {value}: {message}"
    with pytest.raises(RigError, match=said), opened(emulated(), **HARDWARE | settings):
        pass


def test_a_rate_that_the_camera_cannot_keep_is_refused_at_the_start() -> None:
    with opened(live(), **HARDWARE, rate_hz=200) as camera:
        camera.set_region(64, 48)
        said = r"rate_hz = 200: with exposure_us = 2000, .* at most 160\.0 frames/s"
        with pytest.raises(RigError, match=said):
            camera.start()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"exposure_us": 20_000}, "must be at most 10000, the period of rate_hz = 100"),
        ({"exposure_line": "Line1"}, "is already used as an input: trigger_line"),
        ({"exposure_line": "Line2", "sync_line": 2}, "is already used as an input: sync_line"),
        ({"sync_line": 1}, "must differ from trigger_line"),
    ],
)
def test_settings_that_cannot_be_are_refused_before_a_camera_is_looked_for(
    settings: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValidationError, match=message):
        BaslerSettings(**settings)


def test_a_value_that_a_setting_does_not_have_is_named_with_those_that_it_has() -> None:
    with opened(emulated(), **HARDWARE) as camera:
        nodes = Nodes(camera.device.GetNodeMap())
        with pytest.raises(RigError, match="PixelFormat = Mono99: this camera has Mono8, Mono10,"):
            nodes.put("Mono99", "PixelFormat")
        with pytest.raises(RigError, match=r"Gain = 99.0: Value 99.* must be smaller .* 48"):
            nodes.put(99.0, "Gain")


def test_of_several_cameras_one_must_be_named() -> None:
    code = (
        "from sliplab.plugins.devices.basler.fake_live import emulate; emulate(2); "
        "from sliplab.plugins.devices.basler.driver import find_device_info; "
        "print(find_device_info('0815-0001').GetSerialNumber()); find_device_info(None)"
    )
    line = (sys.executable, "-c", code)
    done = subprocess.run(line, capture_output=True, text=True, timeout=60, check=False)
    assert done.stdout == "0815-0001\n"
    assert "found several: 0815-0000, 0815-0001; select one by serial" in done.stderr
