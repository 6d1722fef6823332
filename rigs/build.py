"""From a rig file to a rig that can be run, by the drivers that the file names."""

from __future__ import annotations

import math
import signal
import threading
from collections.abc import Callable
from contextlib import ExitStack, suppress
from typing import Any

from sliplab.protocols.timing import ForceTiming
from sliplab.rigs.core.arm_settings import BaseArmSettings, PlaneSettings
from sliplab.rigs.core.capabilities import (
    Arm,
    ForceSensor,
    FrameCamera,
    Gripper,
    Operator,
    Plate,
    Pose,
    RigError,
    Simulation,
)
from sliplab.rigs.core.device_stream import DeviceStream
from sliplab.rigs.core.driver import (
    EventCameraDriver,
    ForceSensorDriver,
    FrameCameraDriver,
    RigDriver,
    SensorDriver,
)
from sliplab.rigs.core.guard import Guard, PlateLimits
from sliplab.rigs.core.host_clock import HostClock
from sliplab.rigs.core.operators import ConsoleOperator, PersonAtPlate
from sliplab.rigs.core.plate_frame import PlateFrame
from sliplab.rigs.core.registry import find_driver
from sliplab.rigs.core.rig import Rig
from sliplab.rigs.device_section import DeviceSettings
from sliplab.rigs.discovery import need_libraries, need_video
from sliplab.rigs.rig_file import RigFile
from sliplab.rigs.stream_settings import (
    EventStream,
    ForceStream,
    FrameStream,
    SensorStream,
    Stream,
)
from sliplab.storage.schema.trial import StreamRecord

DRIVEN_TAIL_S = 0.3
"""Time for which real drivers are read after the last pulse, s."""
ShouldStop = Callable[[], bool]


def never() -> bool:
    """Return False: no stop is ever requested."""
    return False


def build_rig(file: RigFile, should_stop: ShouldStop = never) -> Rig:
    """Build the rig that a rig file describes; its arm is not connected yet.

    Args:
        should_stop: returns whether a stop was requested; looked at while anything moves.

    Raises:
        RigError: a device that must be present at this stage, such as a camera, is missing.
        ModuleNotFoundError: a maker's library, or one for video, is not installed.
    """
    need_video(file)
    if file.devices is not None:
        need_libraries(file.devices, file.streams)
    rig = find_driver(file.driver, RigDriver).build(file, should_stop)
    if not file.in_virtual_time:
        rig.on_close = (_stop_on_suspension(), *rig.on_close)
    return rig


def _stop_on_suspension() -> Callable[[], None]:
    """Let Ctrl-Z do what Ctrl-C does, until the function that is returned is called.

    A suspended program watches no arm. Only the main thread can answer signals; in another one
    nothing changes.
    """
    if threading.current_thread() is not threading.main_thread():
        return lambda: None
    before = signal.signal(signal.SIGTSTP, lambda *_: signal.raise_signal(signal.SIGINT))

    def restore() -> None:
        with suppress(ValueError):  # closed in another thread
            signal.signal(signal.SIGTSTP, signal.SIG_DFL if before is None else before)

    return restore


def taught_frame(file: RigFile) -> PlateFrame:
    """Return the plate's frame as taught."""
    plane = file.calibration.contact_plane
    taught = PlateFrame.taught((plane.centre, plane.right, plane.above))
    return taught.with_zero(file.calibration.zero_mm)


def tool_of(file: RigFile) -> Pose:
    """Return the controller's tool frame, from the flange: as taught, else as given."""
    taught = file.calibration.tool_centre_point
    if file.devices is None:
        return Pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    tool = file.devices.arm.tool
    return Pose(tool.tcp_mm if taught is None else taught.offset, tool.tcp_rotvec_deg)


def calibrated_arm(file: RigFile, devices: DeviceSettings) -> BaseArmSettings:
    """Return the arm's settings with the taught tool, and limits that follow the taught plane."""
    arm = devices.arm
    limits, plane = arm.limits, file.calibration.contact_plane
    if limits.plate is None:
        plate = PlaneSettings(centre_mm=plane.centre, right_mm=plane.right, above_mm=plane.above)
        limits = limits.model_copy(update={"plate": plate})
    tool = arm.tool.model_copy(update={"tcp_mm": tool_of(file).xyz_mm})
    return arm.model_copy(update={"limits": limits, "tool": tool})


def build_real(file: RigFile, should_stop: ShouldStop) -> Rig:
    """Build a rig of real devices, whose plate an operator moves. Raises RigError."""
    assert file.devices is not None
    console, plate = ConsoleOperator(), file.devices.plate
    person = PersonAtPlate(console, plate.mass_kg) if plate else None
    return driven_rig(file, person or console, person, should_stop)


def driven_rig(
    file: RigFile,
    operator: Operator,
    plate: Plate | None,
    should_stop: ShouldStop,
    simulation: Simulation | None = None,
    open_frames: Callable[[], FrameCamera] | None = None,
    on_close: tuple[Callable[[], None], ...] = (),
) -> Rig:
    """Build a rig of drivers; if one fails, the others are closed again.

    Args:
        simulation: the simulated scene behind the fakes; None on a real rig.
        open_frames: open the frame camera on that scene.
        on_close: called last when the rig is closed.

    Raises:
        RigError: a device is missing, or delivers other times than the rig file says.
    """
    devices = file.devices
    assert devices is not None
    assert devices.sync_box is not None
    with ExitStack() as undo:
        frames = events = None
        if "frames" in file.cameras:
            frames = open_frames() if open_frames else _frame_camera(file, devices)
            undo.callback(frames.close)
            _check_grade(file.timing.frames, frames, "timing.frames")
        if "events" in file.cameras:
            events = devices.event_camera_driver.build(devices.event_camera)
            undo.callback(events.close)
        settings = calibrated_arm(file, devices)
        arm = devices.arm_driver.builder(_arm_measures(file, devices))(settings)
        further = []
        for name, stream in file.streams.items():
            simulated = simulation is not None
            further.append(driven_stream(name, stream, arm, taught_frame(file), simulated))
            undo.callback(further[-1].close)
        rig = Rig(
            name=file.name,
            clock=HostClock(),
            arm=arm,
            event_camera=events,
            frame_camera=frames,
            sync=devices.sync_box_driver.build(devices.sync_box),
            operator=operator,
            plate_frame=taught_frame(file),
            poll_s=float(file.poll),
            timing=file.timing,
            touch_mm=file.calibration.touch_depth,
            tail_s=DRIVEN_TAIL_S,
            plate=plate,
            force=_force_sensor(file, devices, arm),
            force_limit_n=force_limit(file),
            guard=Guard(settings.limits, plate_limits(file)),
            further=tuple(further),
            gripper=_gripper(devices),
            grip_opening_mm=file.grip_opening_mm or 0.0,
            simulation=simulation,
            should_stop=should_stop,
            on_close=on_close,
        )
        undo.pop_all()
    return rig


def _arm_measures(file: RigFile, devices: DeviceSettings) -> bool:
    """Return whether a force sensor of the rig reads the arm's own wrench."""
    drivers = [devices.force_sensor_driver, *(stream.driver for stream in file.streams.values())]
    return any(isinstance(it, ForceSensorDriver) and it.of_arm for it in drivers)


def _frame_camera(file: RigFile, devices: DeviceSettings) -> FrameCamera:
    scale = file.frame_camera.scale_px_per_mm
    return devices.frame_camera_driver.build(devices.frame_camera, scale)


def driven_stream(
    name: str, stream: Stream, arm: Arm, plate: PlateFrame, simulated: bool = False
) -> DeviceStream:
    """Build a further device by its driver; the arm's controller may measure its forces.

    Args:
        simulated: it is one of a loopback rig.

    Raises:
        RigError: it is missing, or delivers other time stamps than the rig file says.
    """
    driver, settings = stream.driver, stream.device
    device: Any = None
    if isinstance(driver, EventCameraDriver):
        device = driver.build(settings)
    elif isinstance(driver, FrameCameraDriver) and isinstance(stream, FrameStream):
        device = driver.build(settings, stream.scale_px_per_mm)
    elif isinstance(driver, ForceSensorDriver):
        device = driver.build(settings, arm)
    elif isinstance(driver, SensorDriver):
        simulate = driver.simulate if simulated else None
        device = simulate(settings, HostClock()) if simulate else driver.build(settings)
    assert device is not None  # the rig file was checked against its driver
    with ExitStack() as undo:
        undo.callback(device.close)
        if isinstance(stream, FrameStream):
            _check_grade(stream.timing.grade, device, f"streams.{name}.timing.grade")
        made = further_stream(name, stream, device, plate)
        undo.pop_all()
    return made


def further_stream(name: str, stream: Stream, device: Any, plate: PlateFrame) -> DeviceStream:
    """Return a further device of a rig with what a trial's record says of its stream.

    Args:
        plate: the plate's frame as taught, in whose axes forces are.

    Raises:
        RigError: a frame camera cannot record the region that the rig file says, or another device
            differs from what the file says of it.
    """
    stated: dict[str, Any] = {"kind": stream.kind, "rows": 0, "timing": stream.timing}
    if isinstance(stream, EventStream):
        stated["size_px"] = (device.width, device.height)
        return DeviceStream(name, device, StreamRecord(**stated))
    if isinstance(stream, FrameStream):
        device.set_region(*stream.region_px)
        stated["size_px"], stated["px_per_mm"] = stream.region_px, stream.scale_px_per_mm
        stated["mid_exposure_ns"] = device.mid_exposure_ns
        if stream.rate_hz is not None:
            stated["rate_hz"] = stream.rate_hz
        return DeviceStream(name, device, StreamRecord(**stated))
    if isinstance(stream, ForceStream):
        if device.grade != stream.timing.grade:
            text = (
                f"its times are of the grade '{device.grade}'; "
                f"write streams.{name}.timing.grade: {device.grade}"
            )
            raise RigError(f"{name} (force sensor)", text)
        matrix = plate.force_matrix(device.mounting)
        return DeviceStream(name, device, StreamRecord(**stated, to_plate=matrix))
    if isinstance(stream, SensorStream):
        return DeviceStream(name, device, StreamRecord(**stated))
    if device.unit != stream.unit:
        text = f"reads in {device.unit}, and the rig file says streams.{name}.unit: {stream.unit}"
        raise RigError(f"{name} (scalar sensor)", text)
    return DeviceStream(name, device, StreamRecord(**stated, unit=stream.unit))


def plate_limits(file: RigFile) -> PlateLimits:
    """Return the limits of a rig file, which hold for every motion of the rig."""
    limits, skin = file.limits, file.skin
    rim_mm = max(math.hypot(x, y) for x, y in skin.layout_mm()) + float(skin.radius)
    return PlateLimits(float(limits.depth), float(limits.reach), float(limits.speed), rim_mm)


def force_limit(file: RigFile) -> float | None:
    """Return the force at which the arm is stopped, N, if there is a limit."""
    return None if file.limits.force is None else float(file.limits.force)


def _force_sensor(file: RigFile, devices: DeviceSettings, arm: Arm) -> ForceSensor | None:
    """The rig's force sensor, if it has one.

    Raises:
        RigError: the rig file says another grade than its own.
    """
    driver = devices.force_sensor_driver
    if driver is None or devices.force_sensor is None:
        return None
    sensor = driver.build(devices.force_sensor, arm)
    stated = (file.timing.force or ForceTiming()).grade
    if sensor.grade != stated:
        raise RigError(
            "force sensor",
            f"its times are of the grade '{sensor.grade}', and the rig file says "
            f"timing.force.grade: {stated}; write timing.force: {{grade: {sensor.grade}}}",
        )
    return sensor


def _gripper(devices: DeviceSettings) -> Gripper | None:
    """Make the rig's gripper, if it has one; not connected yet."""
    driver = devices.gripper_driver
    return None if driver is None else driver.build(devices.gripper)


def _check_grade(grade: str, frames: FrameCamera, key: str) -> None:
    """Check that the rig file states the grade of time stamps that the camera delivers.

    Raises:
        RigError: it states another grade.
    """
    stamping = getattr(frames, "stamping", None)
    if stamping is not None and stamping.grade != grade:
        raise RigError(
            "frame camera",
            f"its time stamps are of grade '{stamping.grade}' ({stamping.means}), but the rig file "
            f"says {key}: {grade}; wire and configure the camera for that, or "
            f"write {key}: {stamping.grade}",
        )
