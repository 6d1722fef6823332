"""Rig files: a rig's devices, the position of its plate, and its limits."""

from __future__ import annotations

import math
from collections.abc import Iterator
from datetime import date
from decimal import Decimal
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator

from sliplab.protocols.errors import InputError
from sliplab.protocols.hashing import hash_text
from sliplab.protocols.key_errors import NAME_PATTERN, KeyedError
from sliplab.protocols.plan import Plan
from sliplab.protocols.program import Move, Position, Twist
from sliplab.protocols.quantity import (
    PositiveMillimetres,
    PositiveNewtons,
    PositiveSeconds,
)
from sliplab.protocols.shown import MASK, is_secret
from sliplab.protocols.timing import DeviceClock, Timing
from sliplab.protocols.yaml_file import (
    StrictModel,
    input_error,
    mask_secrets,
    parse_yaml,
    raise_all,
    rule,
    validate,
    without_secrets,
)
from sliplab.rigs.core.arm_settings import check_units
from sliplab.rigs.core.calibration import Calibration, without_skin, without_taught
from sliplab.rigs.core.driver import Driver, RigDriver
from sliplab.rigs.core.gripper_range import GripperRange
from sliplab.rigs.core.registry import find_driver
from sliplab.rigs.core.sections import RigSection, SimulatedRig
from sliplab.rigs.device_section import DeviceSettings, Simulated
from sliplab.rigs.rig_inheritance import read_rig, rig_path
from sliplab.rigs.rig_limits import Motion, RigLimits, check_arm, check_depth_unit, check_zero
from sliplab.rigs.stream_settings import (
    FrameStream,
    Streams,
    keyed_drivers,
    named_drivers,
    stream_faults,
)
from sliplab.rigs.twin import TwinRecord

CAMERAS = {"events": "event camera", "frames": "frame camera"}
"""Streams by name in rig files and protocols, and the devices that give them."""


class PapillaLayout(StrictModel):
    """The sensor's papillae by ring, from the centre outwards."""

    serial: str = Field(min_length=1, max_length=40)
    made: date | None = None
    """When it was cured; bench records keep its age."""
    ring_counts: Annotated[
        tuple[Annotated[int, Field(ge=1, le=60)], ...], Field(min_length=1, max_length=60)
    ]
    ring_spacing: PositiveMillimetres
    radius: PositiveMillimetres

    def layout_mm(self) -> list[tuple[float, float]]:
        """Nominal (x, y) of every papilla from the centre, centre first, mm."""
        places = []
        for ring, count in enumerate(self.ring_counts):
            radius = ring * float(self.ring_spacing)
            for index in range(count):
                angle = 2 * math.pi * index / count
                places.append((radius * math.cos(angle), radius * math.sin(angle)))
        return places


class Estimates(StrictModel):
    """Measured data rates of this rig's streams, for the plan's estimate of disk space."""

    noise_events_per_s: float = Field(ge=0, le=1e9)
    signal_events_per_mm: float = Field(ge=0, le=1e9)
    """Events per millimetre of recorded motion in contact."""
    events_per_fall: float = Field(default=0.0, ge=0, le=1e9)
    """Additional events of a falling plate."""
    bytes_per_event: float = Field(gt=0, le=1000)
    bytes_per_frame: float = Field(ge=0, le=1e9)
    """Size of one frame without the plate's marker: the papillae on a dark background."""
    bytes_per_plate_frame: float = Field(ge=0, le=1e9)
    """Size of one frame with the plate's marker."""
    bytes_per_tracked_frame: float = Field(ge=0, le=1e9)
    """Size of one frame that is stored as marker positions only."""
    fixed_bytes: float = Field(ge=0, le=1e12)
    """Size of a trial's other data: poses, pulses, record."""


class FrameCameraSpec(StrictModel):
    """The outside camera."""

    scale_px_per_mm: float = Field(gt=0, le=200)
    width_px: int = Field(default=1920, ge=16, le=100_000)
    height_px: int = Field(default=1200, ge=16, le=100_000)
    """Pixels of the whole sensor."""
    rate_hz: int | None = Field(default=None, ge=1, le=1000)
    """Frames a second of a camera that runs by itself; left out, the sync box's ticks a second."""
    spool: bool = False
    """Write raw frames and encode them after the trial, where live encoding is too slow."""


LONGEST_TIMEOUT_S = 5
"""Longest timeout of a reflex: with a longer one a sense that is lost would be none."""


class ReflexSettings(StrictModel):
    """What a reflex does when slip can no longer be detected (docs/reflex.md)."""

    safe_state: Literal["stop", "grip"] = "stop"
    """`stop`: the arm stops and stays in contact. `grip`: the gripper tightens too, by `grip`."""
    grip: PositiveMillimetres | None = None
    """Tightening of the safe state `grip`, within the limits of force and depth."""
    force: PositiveNewtons | None = None
    """Force at which closing fingers stall, in reflexes and in the safe state; left out, the least
    that the gripper can be set to."""
    stream_timeout: PositiveSeconds = Decimal("0.2")
    """Longest time without an event or a pulse of the event camera; at most 5 s."""
    decision_timeout: PositiveSeconds = Decimal("0.1")
    """Longest time from reading events to the decision on them; at most 5 s."""

    @rule
    def _senses_are_missed_soon(self) -> Iterator[KeyedError]:
        for name in ("stream_timeout", "decision_timeout"):
            if (seconds := getattr(self, name)) > LONGEST_TIMEOUT_S:
                text = f"must be at most {LONGEST_TIMEOUT_S} s, or a lost sense goes unnoticed"
                yield KeyedError(f".{name}", f"{seconds} s", text)


class RigFile(StrictModel):
    """A rig file."""

    rig: Literal[1]
    """Version of the file format."""
    name: Annotated[str, Field(pattern=NAME_PATTERN)]
    driver: Literal["mock", "devices", "loopback"]
    """`mock`: simulated devices in this process, in virtual time. `devices`: the real devices.
    `loopback`: the real drivers in real time, on fakes that show the simulated scene."""
    poll: PositiveSeconds
    """Period at which streams are read and stop requests checked."""
    sensor: str = Field(min_length=1, max_length=40)
    """Serial number of the event camera and its housing."""
    calibration: Calibration
    limits: RigLimits
    skin: PapillaLayout
    cameras: tuple[Literal["events", "frames"], ...] = ("events", "frames")
    """Cameras that the rig has: `events` in the sensor, `frames` through the plate."""
    frame_camera: FrameCameraSpec
    estimates: Estimates
    timing: Timing = Timing()
    """Signals that reach each device, and the quality of their clocks."""
    devices: DeviceSettings | None = None
    """Drivers of the devices; not for `mock`."""
    mock: Annotated[SimulatedRig, Simulated()] | None = None
    """The simulated scene and devices; not for `devices`."""
    streams: Streams = Field(default={})
    """Further devices, each under the name of its stream: a second event camera, a thermometer."""
    twin: TwinRecord | None = None
    """How the simulated scene was fitted to a pilot; written by `sliplab calibrate scene`."""
    reflex: ReflexSettings | None = None
    """Safe state of reflexes; left out, a failure stops the arm and moves it clear, as in any
    trial."""

    alerts: dict[str, Any] | Literal["****"] | None = None
    """To whom messages about the campaigns go (docs/alerts.md); masked in a store's copy."""

    @field_validator("cameras")
    @classmethod
    def _one_at_least(cls, cameras: tuple[str, ...]) -> tuple[str, ...]:
        if not cameras or len(set(cameras)) != len(cameras):
            raise ValueError("must hold 'events' or 'frames' or both, none twice")
        return cameras

    @rule
    def _has_its_sections(self) -> Iterator[KeyedError]:
        for name in ("mock", "devices"):
            found, needed = getattr(self, name), name in self.sections
            if needed and found is None:
                yield KeyedError(name, None, f"is needed by driver: {self.driver}")
            if not needed and found is not None:
                yield KeyedError(name, "...", f"has no meaning with driver: {self.driver}")
        if self.twin is not None and self.mock is None:
            yield KeyedError("twin", "...", f"has no meaning with driver: {self.driver}")
        if self.devices is not None:
            for name, words in CAMERAS.items():
                key = words.replace(" ", "_")
                named = getattr(self.devices, key) is not None
                if not named and name in self.cameras:
                    yield KeyedError(f"devices.{key}", None, "is missing")
                if named and name not in self.cameras:
                    text = f"must be null: the rig has no {words} (cameras)"
                    yield KeyedError(f"devices.{key}", "...", text)

    @rule
    def _streams_are_complete(self) -> Iterator[KeyedError]:
        yield from stream_faults(self.streams, self.driver, self.sections)

    @rule
    def _driver_can_run_it(self) -> Iterator[KeyedError]:
        yield from find_driver(self.driver, RigDriver).faults(self)

    @rule
    def _mock_agrees(self) -> Iterator[KeyedError]:
        if self.mock is not None:
            yield from self.mock.rig_faults(self)

    @rule
    def _limited_force_is_measured(self) -> Iterator[KeyedError]:
        if self.limits.force is not None and not self.has_force:
            text = "needs a force sensor, and this rig has none"
            yield KeyedError("limits.force", f"{self.limits.force} N", text)

    @rule
    def _safe_state_can_be_reached(self) -> Iterator[KeyedError]:
        wanted, allowed = self.reflex, self.gripper_range
        if wanted is None:
            return
        if wanted.safe_state == "grip":
            if allowed is None:
                text = "needs a gripper, and this rig has none; write safe_state: stop"
                yield KeyedError("reflex.safe_state", "grip", text)
            if wanted.grip is None:
                text = "is needed by safe_state: grip, such as 0.4 mm"
                yield KeyedError("reflex.grip", None, text)
        if wanted.force is not None and allowed is None:
            text = "needs a gripper, and this rig has none; leave it out"
            yield KeyedError("reflex.force", f"{wanted.force} N", text)
        elif wanted.force is not None and allowed is not None:
            low, high = allowed.force_n
            if not low <= wanted.force <= high:
                text = f"must be from {low:g} to {high:g} N, which the gripper can be set to"
                yield KeyedError("reflex.force", f"{wanted.force} N", text)

    @rule
    def _poll_is_short(self) -> Iterator[KeyedError]:
        if self.poll > 1:
            yield KeyedError("poll", self.poll, "must be at most 1 s: a stop waits that long")

    @rule
    def _rate_of_its_own(self) -> Iterator[KeyedError]:
        if self.frame_camera.rate_hz is not None and self.timing.frames == "hardware trigger":
            text = "must be left out with timing.frames: hardware trigger, the sync box's ticks"
            yield KeyedError("frame_camera.rate_hz", self.frame_camera.rate_hz, text)

    @property
    def sections(self) -> tuple[str, ...]:
        """Sections that the rig's driver needs; the first one has the devices that are driven."""
        return find_driver(self.driver, RigDriver).sections

    @property
    def simulated(self) -> bool:
        """True if all data of this rig are simulated."""
        return "mock" in self.sections

    def read_at_least(self, poll_s: float) -> RigFile:
        """Return the rig with its streams read at least this often."""
        return self.model_copy(update={"poll": min(self.poll, Decimal(str(poll_s)))})

    @property
    def in_virtual_time(self) -> bool:
        """True if the rig runs in virtual time, not in real time."""
        return "devices" not in self.sections

    @property
    def _driven(self) -> RigSection | None:
        section: RigSection | None = getattr(self, self.sections[0])
        return section

    @property
    def has_plate(self) -> bool:
        """True if the plate hangs on a slider that can be raised, released and caught."""
        return self.simulated or (self.devices is not None and self.devices.plate is not None)

    @property
    def has_force(self) -> bool:
        """True if there is a force sensor."""
        return self._driven is not None and self._driven.has_force

    @property
    def gripper_range(self) -> GripperRange | None:
        """Values that the gripper's commands may have; None without a gripper."""
        return None if self._driven is None else self._driven.gripper_range

    @property
    def grip_opening_mm(self) -> float | None:
        """Opening of the gripper at which the arm's depth is the depth in contact, if any."""
        gripper = getattr(self._driven, "gripper", None)
        return None if gripper is None else gripper.opening_mm

    def drivers(self) -> Iterator[tuple[str, Driver[Any], Any]]:
        """Return the part in the rig, driver and settings of every device, the arm first."""
        return named_drivers(self.devices, self.streams)

    @property
    def frame_source(self) -> str:
        """Output of the outside camera: ``video`` or ``tracks``."""
        return "video" if self.mock is None else self.mock.frame_source

    def frame_bytes(self, with_plate: bool) -> float:
        """Return the expected size of one frame on disk, with or without the plate's marker."""
        known = self.estimates
        if self.frame_source == "tracks":
            return known.bytes_per_tracked_frame
        return known.bytes_per_plate_frame if with_plate else known.bytes_per_frame

    def frame_rate_hz(self, plan: Plan) -> int:
        """Return the frames a second of the frame camera."""
        return self.frame_camera.rate_hz or plan.protocol.collection.recording.sync_rate

    def frame_px(self, plan: Plan) -> tuple[int, int] | None:
        """Return width and height of the recorded region in px, multiples of 16; None: no video."""
        recording = plan.protocol.collection.recording
        if "frames" not in recording.streams or "frames" not in self.cameras:
            return None
        scale = self.frame_camera.scale_px_per_mm
        sides = (float(recording.region.width), float(recording.region.height))
        return tuple(max(16, round(side * scale / 16) * 16) for side in sides)  # type: ignore[return-value]

    def with_events(self, plan: Plan) -> bool:
        """Return whether events are recorded."""
        both = set(self.cameras) & set(plan.protocol.collection.recording.streams)
        return "events" in both


def load_rig_file(path: Path, *, stored: bool = False) -> tuple[RigFile, str]:
    """Load and validate a rig file; return it and its text, with the files it extends merged in.

    Args:
        path: a file, or the name of a rig that ships with the package, such as ``mock``.
        stored: True for a campaign's own copy, to which newer rules do not apply.

    Raises:
        InputError: the file is invalid; names file, key, value and what would be right.
    """
    found = read_rig(rig_path(path))
    try:
        rig = validate(RigFile, found.data, found.path, None if stored else _check)
        return rig, found.text
    except InputError as error:
        unread = {each.key for each in found.data.faults}  # these name their file already
        raise InputError.joined(
            each if each.key in unread else found.placed(each) for each in error.faults
        ) from None


def _check(rig: RigFile) -> None:
    """Check a rig file that a person gives. Raises KeyedError, all that is wrong."""
    arm = None if rig.devices is None else rig.devices.arm
    raise_all(
        (
            lambda: None if arm is None else check_units(arm),
            lambda: _masked_secrets(rig),
            lambda: check_zero(rig.calibration, rig.limits),
            lambda: check_depth_unit(rig.limits),
            lambda: _check_poll(rig),
        )
    )


def _check_poll(rig: RigFile) -> Iterator[KeyedError]:
    """Check that the period is one that a computer can keep."""
    if rig.poll < Decimal("0.001"):
        text = "must be at least 1 ms: no computer looks more often"
        yield KeyedError("poll", f"{rig.poll} s", text)


def _masked_secrets(rig: RigFile) -> Iterator[KeyedError]:
    if rig.simulated or rig.devices is None:
        return
    for where, driver, settings in keyed_drivers(rig.devices, rig.streams):
        for name in driver.settings.model_fields:
            if is_secret(name) and getattr(settings, name) == MASK:
                key = f"{where}.{name}"
                text = "is masked, as in a store's copy of a rig file: write the rig's password"
                yield KeyedError(key, MASK, text)


def rig_hash(text: str) -> str:
    """Hash a rig file's content, as `load_rig_file` returns it, with passwords masked."""
    return hash_text(mask_secrets(text))


def same_rig(one: str, other: str, *, skin: str | None = None) -> bool:
    """Return whether the contents of two rig files describe the same rig.

    A key that has its default value may as well be left out. The simulated faults are ignored: a
    campaign that a fault ended continues without it. The plate's taught position and passwords are
    ignored too.

    Args:
        skin: serial number of another skin that was mounted. The second may name it, and what was
            measured on it.
    """
    if one == other:
        return True
    first: dict[str, Any]
    second: dict[str, Any]
    first, second = (parse_yaml(text, "rig.yaml") for text in (one, other))
    if skin is not None:
        before, now = (data["skin"].get("serial") for data in (first, second))
        if now in (before, skin):
            first, second = without_skin(first), without_skin(second)
    if _lasting(first) == _lasting(second):
        return True
    try:
        rigs = [validate(RigFile, data, "rig.yaml") for data in (first, second)]
    except InputError:  # a campaign's own copy may be older than a rule
        return False
    one_rig, other_rig = (_lasting(rig.model_dump(mode="json")) for rig in rigs)
    return one_rig == other_rig


def _lasting(data: dict[str, Any]) -> dict[str, Any]:
    """Return what must stay the same during a campaign of a rig file's data."""
    retained = without_secrets(data)
    if isinstance(retained.get("mock"), dict):
        retained["mock"].pop("faults", None)
    return without_taught(retained)


def _check_exposure(rig: RigFile, plan: Plan, file: str) -> Iterator[InputError]:
    """Check that exposures end before the next tick, where every tick triggers a frame."""
    rate = plan.protocol.collection.recording.sync_rate
    triggered: dict[str, Any] = {}
    if rig.timing.frames == "hardware trigger":
        sections = {name: getattr(rig, name) for name in ("devices", "mock")}
        triggered = {
            f"{name}.frame_camera": None if section is None else section.frame_camera
            for name, section in sections.items()
        }
    for name, stream in rig.streams.items():
        if isinstance(stream, FrameStream) and stream.timing.grade == "hardware trigger":
            triggered |= {
                f"streams.{name}.{part}": getattr(stream, part) for part in ("device", "mock")
            }
    for name, camera in triggered.items():
        if camera is not None and camera.exposure_us * rate > 1e6:
            yield InputError(
                file,
                f"{name}.exposure_us",
                f"{camera.exposure_us:g}",
                f"must be at most {1e6 / rate:g}, the period of {plan.file}'s sync_rate: "
                "every tick triggers a frame",
            )


def _check_cameras(rig: RigFile, plan: Plan) -> Iterator[InputError]:
    """Hold the streams that a protocol names against the rig; it need not name any."""
    recording = plan.protocol.collection.recording
    if "streams" not in recording.model_fields_set:
        return
    for name, words in CAMERAS.items():
        if name in recording.streams and name not in rig.cameras:
            text = (
                f"the rig {rig.name} has no {words}; leave out 'streams' to record what a rig has"
            )
            yield InputError(plan.file, "collection.recording.streams", name, text)


def _check_force(rig: RigFile, plan: Plan) -> Iterator[InputError]:
    """Check that a protocol that asks for forces has a rig that measures them."""
    gates = plan.protocol.collection.gates
    for name in ("normal_force", "hold_force"):
        value = getattr(gates, name)
        if value is not None and not rig.has_force:
            text = f"needs a force sensor, and the rig {rig.name} has none: leave the gate out"
            yield InputError(plan.file, f"collection.gates.{name}", f"{value} N", text)
    reference = gates.reference
    if reference is not None and reference.friction is not None and not rig.has_force:
        text = f"needs a force sensor, and the rig {rig.name} has none: leave the gate out"
        key = "collection.gates.reference.friction"
        yield InputError(plan.file, key, f"{reference.friction} %", text)
    presses = [
        step.until_force_n
        for trial in plan
        for step in plan.program(trial).steps
        if isinstance(step, Move) and step.until_force_n is not None
    ]
    if not presses:
        return
    if not rig.has_force:
        text = f"needs a force sensor, and the rig {rig.name} has none: press to a depth"
        yield InputError(plan.file, "collection.motion: press.force", f"{max(presses):g} N", text)
    limit = rig.limits.force
    if limit is not None and max(presses) > limit:
        text = f"exceeds limits.force = {limit} N of the rig {rig.name}"
        yield InputError(plan.file, "collection.motion: press.force", f"{max(presses):g} N", text)


def check_plan(rig: RigFile, plan: Plan, file: str) -> None:
    """Check every motion of a plan against the rig's limits.

    Raises:
        InputError: what the rig lacks or forbids, one fault a key.
    """
    found: dict[tuple[str, str], InputError] = {}
    for fault in _plan_faults(rig, plan, file):
        found.setdefault((fault.file, fault.key), fault)
    if found:
        raise InputError.joined(found.values())


def _plan_faults(rig: RigFile, plan: Plan, file: str) -> Iterator[InputError]:
    most_us = 1e6 / 4 / plan.protocol.collection.recording.sync_rate
    clocks: dict[str, DeviceClock] = {
        f"timing.{name}": getattr(rig.timing, name)
        for name in ("event_camera", "frame_camera", "arm_controller")
    }
    clocks |= {f"streams.{name}.timing": stream.timing for name, stream in rig.streams.items()}
    for name, clock in clocks.items():
        jitter_us = clock.jitter_us
        if jitter_us > most_us:
            yield InputError(
                file,
                f"{name}.jitter_us",
                f"{jitter_us:g}",
                f"must be at most {most_us:g}, a quarter of a tick of {plan.file}'s sync_rate: "
                "pulses could not be distinguished",
            )
    yield from _check_cameras(rig, plan)
    yield from _check_exposure(rig, plan, file)
    yield from _check_force(rig, plan)
    for name in rig.sections:
        yield from getattr(rig, name).plan_faults(plan, file)
    frame_px = rig.frame_px(plan)
    for side, axis in (("width", 0), ("height", 1)):
        available = getattr(rig.frame_camera, f"{side}_px")
        if frame_px is not None and frame_px[axis] > available:
            yield InputError(
                file,
                f"frame_camera.{side}_px",
                available,
                f"the region of {plan.file} needs {frame_px[axis]} px",
            )
    over: set[str] = set()
    for motion in _motions(plan):
        to = motion.to
        reach_mm = (to.x_mm**2 + to.y_mm**2) ** 0.5
        extents = {"depth": to.depth_mm, "speed": motion.speed_mm_s, "reach": reach_mm}
        for name, value in extents.items():
            limit, unit = float(getattr(rig.limits, name)), "mm/s" if name == "speed" else "mm"
            if value > limit + 1e-9 and name not in over:
                over.add(name)
                text = f"{motion.what} needs {value:g} {unit} {motion.where}"
                yield InputError(file, f"limits.{name}", f"{limit:g} {unit}", text)
    if rig.devices is not None:
        for fault in check_arm(rig.devices.arm.limits, rig.calibration, _motions(plan)):
            yield input_error(file, fault)


def _motions(plan: Plan) -> Iterator[Motion]:
    """Yield every motion of a plan's conditions and of its maintenance."""
    seen = set()
    for trial in plan:
        if trial.condition in seen:
            continue
        seen.add(trial.condition)
        program, what = plan.program(trial), f"trial {trial.id} of {plan.file}"
        at = program.home
        yield Motion(at, what, "where it begins")
        for step in program.steps:
            if isinstance(step, Move | Twist):
                speed_mm_s = step.speed_mm_s if isinstance(step, Move) else 0.0
                turn_deg, at = abs(step.to.twist_deg - at.twist_deg), step.to
                yield Motion(at, what, f"in its phase '{step.phase}'", speed_mm_s, turn_deg)
    upkeep = plan.protocol.collection.maintenance
    if (warm_up := upkeep.warm_up) is not None:
        home, deep = (Position(0, 0, float(at)) for at in (-warm_up.clearance, warm_up.depth))
        where = "in collection.maintenance.warm_up"
        yield Motion(home, plan.file, where)
        yield Motion(deep, plan.file, where, float(warm_up.speed))
    if (rezero := upkeep.rezero) is not None:
        home, deep = (Position(0, 0, float(at)) for at in (-rezero.search, rezero.search))
        where = "in collection.maintenance.rezero"
        yield Motion(home, plan.file, where, zeroed=False)
        yield Motion(deep, plan.file, where, float(rezero.speed), zeroed=False)
