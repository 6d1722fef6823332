"""Further devices of a real rig: drivers of packages, two of one make, a camera that lies."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sliplab.protocols import InputError
from sliplab.rigs.build import driven_stream
from sliplab.rigs.core.capabilities import RigError, ScalarSensor
from sliplab.rigs.core.device_stream import DeviceStream
from sliplab.rigs.core.plate_frame import PlateFrame
from sliplab.rigs.discovery import ping_devices
from sliplab.rigs.rig_file import RigFile, load_rig_file
from sliplab.rigs.rig_lock import lock_names
from sliplab.rigs.stream_settings import Stream
from sliplab.storage.streams import NullSink, ScalarChunk
from tests.conftest import ROOT
from tests.flows.conftest import write
from tests.rigs.core.test_registry import Install, install

__all__ = ["install"]

THERMOMETER = """
from typing import Literal
import numpy as np
from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.core.device_settings import DriverSettings
from sliplab.rigs.core.driver import ScalarSensorDriver
from sliplab.storage.streams import ScalarChunk

class Settings(DriverSettings):
    driver: Literal["lab_thermometer"] = "lab_thermometer"
    port: str = "/dev/null"

class Thermometer:
    unit = "degC"
    closed = False
    def __init__(self, settings): self.port = settings.port
    def connect(self):
        if self.port == "/dev/absent":
            raise RigError("scalar sensor", "there is no /dev/absent")
    def start(self): self.count = 0
    def read(self):
        self.count += 1
        now = np.array([self.count * 1000], np.int64)
        return ScalarChunk(now, now, np.array([20.0 + self.count]), self.unit)
    def stop(self): pass
    def close(self): Thermometer.closed = True

DRIVER = ScalarSensorDriver(
    name="lab_thermometer", title="a lab's thermometer", settings=Settings,
    ping=lambda settings: None if settings.port == "/dev/null" else "is not there",
    locks=lambda settings: {f"thermometer-{settings.port}": "the thermometer"},
    build=Thermometer,
)
"""
CAMERA = """
from typing import Literal
from sliplab.rigs.core.device_settings import FrameCameraSettings
from sliplab.rigs.core.driver import FrameCameraDriver

class Settings(FrameCameraSettings):
    driver: Literal["lab_camera"] = "lab_camera"

class Stamping:
    grade, means = "host arrival", "host arrival"

class Camera:
    mid_exposure_ns, stamping, closed = 1_000_000, Stamping(), False
    def __init__(self, settings, px_per_mm): self.px_per_mm = px_per_mm
    def set_region(self, width, height): self.region = width, height
    def close(self): Camera.closed = True

DRIVER = FrameCameraDriver(
    name="lab_camera", title="a lab's camera", settings=Settings, ping=lambda settings: None,
    build=Camera,
)
"""
WARM = {"kind": "scalar", "unit": "degC", "device": {"driver": "lab_thermometer"}}
SIDE = {"kind": "events", "device": {"driver": "dvxplorer"}}


class Arm:
    """An arm that no device here asks anything of."""


def built(name: str, stream: Stream) -> DeviceStream:
    """A further device by its driver, on a plate as an arm's base."""
    frame = PlateFrame.taught(((0.0, 0.0, 0.0), (60.0, 0.0, 0.0), (0.0, 60.0, 0.0)))
    arm: Any = Arm()
    return driven_stream(name, stream, arm, frame)


def real_rig(folder: Path, streams: dict[str, Any], **devices: Any) -> RigFile:
    """The shipped rig with a UR arm and further devices."""
    box = {"sync_box": {"port": "/dev/serial/by-id/box"}}
    arm = {"arm": {"password": "x"}} if "password" in str(devices) else {}
    data = {"extends": str(ROOT / "rigs" / "ur5.yaml"), "streams": streams}
    data["devices"] = {**box, **arm, **devices}
    return load_rig_file(write(folder / "rig.yaml", data), stored=True)[0]


def test_a_scalar_sensor_of_a_package_is_read(install: Install, tmp_path: Path) -> None:
    install("lab_thermometer", THERMOMETER, "lab_thermometer = lab_thermometer:DRIVER")
    file = real_rig(tmp_path, {"warm": WARM})
    device = built("warm", file.streams["warm"])
    assert isinstance(device.device, ScalarSensor)
    assert device.about.unit == "degC"
    assert device.through_host
    got: list[ScalarChunk] = []

    class Sink(NullSink):
        def add(self, device: str, chunk: Any) -> None:
            assert device == "warm"
            got.append(chunk)

    device.connect()
    device.start()
    device.drain(Sink())
    device.finish(Sink())
    device.close()
    assert np.array_equal(np.concatenate([chunk.value for chunk in got]), [21.0, 22.0])


def test_it_is_pinged_and_locked_by_its_name(install: Install, tmp_path: Path) -> None:
    install("lab_thermometer", THERMOMETER, "lab_thermometer = lab_thermometer:DRIVER")
    absent = {**WARM, "device": {"driver": "lab_thermometer", "port": "/dev/absent"}}
    file = real_rig(tmp_path, {"warm": absent})
    assert file.devices is not None
    found = ping_devices(file.devices, file.streams)
    assert found["warm (scalar sensor)"] == "is not there"
    assert "thermometer-dev-absent.lock" in lock_names(file)
    with pytest.raises(RigError, match=r"warm \(scalar sensor\): there is no /dev/absent"):
        built("warm", file.streams["warm"]).connect()


def test_a_sensor_in_another_unit_is_refused_and_closed(install: Install, tmp_path: Path) -> None:
    install("lab_thermometer", THERMOMETER, "lab_thermometer = lab_thermometer:DRIVER")
    file = real_rig(tmp_path, {"warm": {**WARM, "unit": "K"}})
    with pytest.raises(RigError, match=r"reads in degC, and the rig file says streams.warm.unit"):
        built("warm", file.streams["warm"])
    import lab_thermometer  # type: ignore[import-not-found]

    assert lab_thermometer.Thermometer.closed


def test_a_camera_that_delivers_another_grade_is_refused(install: Install, tmp_path: Path) -> None:
    install("lab_camera", CAMERA, "lab_camera = lab_camera:DRIVER")
    back = {"kind": "frames", "scale_px_per_mm": 4, "region_px": [64, 48]}
    back["device"] = {"driver": "lab_camera"}
    triggered = real_rig(tmp_path, {"back": back}).streams["back"]
    with pytest.raises(RigError, match=r"write streams.back.timing.grade: host arrival"):
        built("back", triggered)
    import lab_camera  # type: ignore[import-not-found]

    assert lab_camera.Camera.closed
    arrives = {**back, "rate_hz": 30, "timing": {"grade": "host arrival"}}
    made = built("back", real_rig(tmp_path, {"back": arrives}).streams["back"])
    assert made.device.region == (64, 48)
    assert (made.about.size_px, made.about.px_per_mm) == ((64, 48), 4)
    assert (made.about.rate_hz, made.about.mid_exposure_ns) == (30, 1_000_000)


def usb(serial: str | None) -> dict[str, Any]:
    """A DVXplorer on this computer."""
    return {"driver": "dvxplorer", "source": {"kind": "usb", "serial": serial}}


def test_two_devices_are_not_one(tmp_path: Path) -> None:
    streams = {"side": {**SIDE, "device": usb("B")}}
    file = real_rig(tmp_path, streams, event_camera=usb("A"))
    assert [part for part, _, _ in file.drivers()][-1] == "side (event camera)"


@pytest.mark.parametrize(
    ("first", "stream", "key", "text"),
    [
        ("A", {"device": {"driver": "basler"}}, ".device.driver", "of a kind of"),
        ("A", {"device": {"driver": "dvx"}}, ".device.driver", "one of dvxplorer"),
        ("A", {"device": None}, ".device", "is needed by driver: devices"),
        ("A", {"mock": {}}, ".mock", "has no meaning with driver: devices"),
        ("A", {"device": {**usb("B"), "noise_filter_us": 0}}, ".device.noise_filter_us", "must be"),
        ("A", {"device": usb("A")}, ".device", "is the same device as devices.event_camera"),
        (None, {"device": usb(None)}, ".device", "is the same device as devices.event_camera"),
    ],
)
def test_wrong_device_is_named(first: Any, stream: Any, key: str, text: str, tmp_path: Any) -> None:
    side = {name: value for name, value in {**SIDE, **stream}.items() if value is not None}
    with pytest.raises(InputError, match=text) as raised:
        real_rig(tmp_path, {"side": side}, event_camera=usb(first))
    assert raised.value.key == f"streams.side{key}"


def test_a_second_force_sensor_is_one_of_the_drivers_of_the_first(tmp_path: Path) -> None:
    wrist = {"kind": "wrench", "device": {"driver": "ati_net_ft", "host": "192.0.2.7"}}
    stream = real_rig(tmp_path, {"wrist": wrist}).streams["wrist"]
    assert (stream.timing.grade, stream.timing.delay.longest_us) == ("host time", 5000)
    made = built("wrist", stream)
    assert made.about.to_plate is not None
    assert np.allclose(np.abs(np.linalg.det(np.array(made.about.to_plate))), 1.0)
    said = {**wrist, "timing": {"grade": "arm clock"}}
    with pytest.raises(RigError, match=r"write streams.wrist.timing.grade: host time"):
        built("wrist", real_rig(tmp_path, {"wrist": said}).streams["wrist"])
