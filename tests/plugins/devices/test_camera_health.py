"""Cameras say what they are before a campaign; neither library is loaded before it is needed."""

from __future__ import annotations

import subprocess
import sys
from functools import partial
from types import SimpleNamespace
from typing import Any

import dv_processing as dv
import numpy as np
import pytest

from benchmarks.basler_emulation import unplug
from benchmarks.dvxplorer_server import DvxplorerServer, arrays
from sliplab.plugins.devices import basler, dvxplorer
from sliplab.plugins.devices.basler.settings import BaslerSettings
from sliplab.plugins.devices.dvxplorer.settings import DvxplorerSettings
from sliplab.plugins.devices.dvxplorer.source import DvxEventSource
from sliplab.rigs.core.capabilities import DeviceHealth, EventCamera, FrameCamera, RigError
from sliplab.storage.streams import EventChunk

pytestmark = pytest.mark.realtime
FREE = BaslerSettings(px_per_mm=20.0, trigger="free run", exposure_line="Line2")


@pytest.mark.usefixtures("pylon_emulation")
def test_a_frame_camera_says_what_it_is_grabbing_or_not() -> None:
    camera: Any = basler.DRIVER.build(FREE, 20.0)
    try:
        assert isinstance(camera, FrameCamera)
        camera.set_region(64, 48)
        health: DeviceHealth = camera.health()
        assert (health.device, health.model) == ("frame camera", "Emulation")
        assert health.serial == "0815-0000"
        assert health.firmware == "1.1"
        assert health.temperature_c is None  # the emulation has no thermometer
        assert health.clock == "exposure end event, grade exposure line"
        assert "region 64 x 48 px" in health.notes
        assert "250 buffers" in health.notes
        camera.start()
        assert any("of 250 buffers free" in note for note in camera.health().notes)
        unplug(camera.device)
        with pytest.raises(RigError, match="unplugged"):
            camera.health()
    finally:
        camera.close()


def test_an_event_camera_says_what_it_is_and_when_it_is_gone() -> None:
    empty = np.empty(0, np.uint16)
    nothing = EventChunk(empty, empty, np.empty(0, np.uint8), np.empty(0, np.int64))
    with DvxplorerServer(partial(arrays, nothing, np.empty(0, np.int64), 1000)) as server:
        camera: Any = dvxplorer.DRIVER.build(server.settings)
        try:
            assert isinstance(camera, EventCamera)
            health: DeviceHealth = camera.health()
            assert (health.device, health.model) == ("event camera", "stand-in")
            assert (health.serial, health.temperature_c) == ("unknown", None)
            assert "640 x 480 px" in health.notes
        finally:
            camera.close()
        with pytest.raises(RigError, match="closed"):
            camera.health()


class Usb:
    """A fake DVXplorer that answers only to names that the library has."""

    def __init__(self) -> None:
        self.answers: dict[str, Any] = {
            "isRunning": True,
            "getSerialNumber": "DXA00001",
            "getFirmwareVersion": 7,
            "getLogicVersion": 9,
            "getConnectionSpeed": dv.io.camera.libusb_speed.LIBUSB_SPEED_SUPER,
            "getReadoutFPS": dv.io.camera.DVXplorer.ReadoutFPS.CONSTANT_1000,
        }

    def __getattr__(self, name: str) -> Any:
        assert hasattr(dv.io.camera.DVXplorer, name)
        return lambda: self.answers[name]


def test_a_camera_on_usb_is_asked_by_names_that_the_library_has() -> None:
    usb = Usb()
    source = DvxEventSource(usb, usb, usb, (640, 480), "DVXplorer_DXA00001")
    health = source.health(DvxplorerSettings())
    assert (health.serial, health.firmware) == ("DXA00001", "7, logic 9")
    assert {"link super", "read-out constant 1000"} <= set(health.notes)
    usb.answers["isRunning"] = False
    with pytest.raises(RigError, match="connection is lost"):
        source.health(DvxplorerSettings())


@pytest.mark.usefixtures("pylon_emulation")
def test_a_thermometer_is_read_where_there_is_one(monkeypatch: pytest.MonkeyPatch) -> None:
    camera: Any = basler.DRIVER.build(FREE, 20.0)
    try:
        answers = {"DeviceTemperature": 41.5, "BslUSBSpeedMode": "SuperSpeed"}
        peek = camera._nodes.peek
        nodes = SimpleNamespace(
            peek=lambda *names: (
                next((answers[name] for name in names if name in answers), None) or peek(*names)
            )
        )
        monkeypatch.setattr(camera, "_nodes", nodes)
        health = camera.health()
        assert health.temperature_c == 41.5
        assert "link SuperSpeed" in health.notes
    finally:
        monkeypatch.undo()
        camera.close()


def test_neither_library_is_loaded_before_a_camera_is_opened() -> None:
    code = (
        "import sys, sliplab.rigs.device_section, sliplab.plugins.devices.basler.driver; "
        "sys.exit('pypylon' in sys.modules or 'dv_processing' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], timeout=60, check=False).returncode == 0
