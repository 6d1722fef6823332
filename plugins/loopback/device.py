"""Declaration of the driver `loopback`; cheap to import."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from sliplab.plugins.simulation.settings import MockSettings
from sliplab.protocols.key_errors import KeyedError
from sliplab.rigs.core.driver import EventCameraDriver, RigDriver, SensorDriver, lazy
from sliplab.rigs.device_section import DeviceSettings
from sliplab.rigs.stream_settings import keyed_drivers

if TYPE_CHECKING:
    from sliplab.rigs.rig_file import RigFile

STREAMS = "streams."
"""Before the name of a further camera's stream, among the names of fakes."""


def _faults(rig: RigFile) -> Iterator[KeyedError]:
    """Check that the fakes simulate what the rig file says of the real devices."""
    mock, devices = rig.mock, rig.devices
    if mock is None or devices is None:
        return
    assert isinstance(mock, MockSettings)
    if len(rig.cameras) < 2:
        text = "must hold events and frames: a loopback rig has both cameras"
        yield KeyedError("cameras", list(rig.cameras), text)
    assert devices.frame_camera is not None
    stated_us, exposure_us = devices.frame_camera.exposure_us, mock.frame_camera.exposure_us
    for key, value, right in (
        ("devices.frame_camera.exposure_us", stated_us, exposure_us),
        ("timing.frames", rig.timing.frames, devices.frame_camera_driver.grade),
        ("mock.frame_camera.level", mock.frame_camera.level, "video"),
    ):
        if value != right:
            yield KeyedError(key, value, f"must be {right}, which is what the fakes simulate")
    if devices.has_force and not mock.has_force:
        text = "is needed: it is what the fake of devices.force_sensor shows"
        yield KeyedError("mock.force", None, text)
    opening_mm, simulated = rig.grip_opening_mm, mock.gripper and mock.gripper.opening_mm
    if opening_mm is not None and simulated != opening_mm:
        text = f"must be {opening_mm:g}: the fake of devices.gripper moves these fingers"
        yield KeyedError("mock.gripper.opening_mm", simulated, text)
    for key, driver, _ in keyed_drivers(devices, rig.streams):
        fake: Any = None
        if isinstance(driver, SensorDriver):
            continue  # `stream_faults` has looked at its `simulate`
        if isinstance(driver, EventCameraDriver):
            fake = driver.reach
        elif key.startswith("devices."):
            fake = getattr(driver, "of_arm", False) or getattr(driver, "fake", None)
        if not fake:
            text = "has no fake for a loopback rig: write driver: devices"
            yield KeyedError(f"{key}.driver", driver.name, text)


DRIVER = RigDriver(
    name="loopback",
    title="real drivers on fakes",
    sections=("devices", "mock"),
    settings=DeviceSettings,
    build=lazy("sliplab.plugins.loopback.rig:build_rig"),
    faults=_faults,
    builder=lazy("sliplab.plugins.loopback.rig:rig_builder"),
    levels=lazy("sliplab.plugins.simulation.levels:physics_levels"),
)
