"""Settings of the simulated rig, in one place that is cheap to import.

`sliplab plan` reads rig files for rates and image sizes, so nothing here may import numba or
OpenCV. Names carry the unit. The defaults are plausible assumed values; none of them was measured
on a real skin, and everything computed from them is simulated.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field

from sliplab.plugins.simulation.scene.optics import (
    EventOptics,
    Finite,
    NonNegative,
    Positive,
    Reflections,
)
from sliplab.protocols.errors import InputError
from sliplab.protocols.key_errors import KeyedError
from sliplab.protocols.nuisances import FlickerNuisance
from sliplab.protocols.plan import Plan
from sliplab.protocols.timing import Delay, ForceTiming, Timing
from sliplab.protocols.yaml_file import StrictModel, rule
from sliplab.rigs.core.faults import Fault, StreamGone, check_papillae, check_single
from sliplab.rigs.core.gripper_range import GripperRange
from sliplab.rigs.core.sections import SimulatedRig, SimulatedStream

if TYPE_CHECKING:
    from sliplab.plugins.simulation.scene import skin as scene_skin
    from sliplab.rigs.rig_file import RigFile

SCALE_ERROR = 0.005
"""Largest relative error of a measured scale."""
Share = Annotated[float, Field(ge=0, lt=1)]
Triple = tuple[Finite, Finite, Finite]
Seed = Annotated[int, Field(ge=0, lt=2**63)]


class Papilla(StrictModel):
    """One papilla as it came out."""

    height_mm: Positive
    friction: Positive = 1.0
    """Its friction over the mean."""
    offset_mm: tuple[Finite, Finite] = (0.0, 0.0)
    """From its place in the layout."""


MOST_PAPILLAE = 1_000
"""Of a simulated skin: memory and time grow with the square; sensors have up to some hundred."""


class SkinSettings(StrictModel):
    """The papillae: a centre and two rings, lower towards the outside."""

    seed: Seed | None = None
    """Seed of the fabrication scatter: another seed is another skin. Default: the rig's seed."""
    ring_counts: tuple[Annotated[int, Field(ge=1, le=48)], ...] = (1, 6, 12)
    """Papillae per layer, from the centre outwards."""
    heights_mm: tuple[Positive, ...] = (10.1, 9.0, 7.9)
    """Height above the skin plane, one per layer."""
    spacing_mm: Positive = 5.6
    """Radial distance between neighbouring layers."""
    radius_mm: Positive = 2.0
    youngs_modulus_mpa: Positive = 0.6
    poisson_ratio: Annotated[float, Field(ge=0, lt=0.5)] = 0.49
    bending: Positive = 12.0
    """Denominator of the bending term: 12 for a guided end, 3 for a free one."""
    base_normal_n_per_m: Positive | None = 150.0
    """Stiffness of the membrane under a papilla; null for rigid, where the centre may buckle."""
    base_tangential_n_per_m: Positive | None = 200.0
    height_scatter_mm: NonNegative = 0.08
    """Half the range of a uniform deviation of each height."""
    position_scatter_mm: NonNegative = 0.05
    """Standard deviation of each papilla's position, clipped at two sigma."""
    relaxation_share: Share = 0.2
    """Share of a suddenly applied force that relaxes away (standard linear solid)."""
    relaxation_s: Positive = 1.0
    papillae: tuple[Papilla, ...] | None = None
    """Every papilla as measured, from the centre outwards and counterclockwise from +x; null: drawn
    by the seed with the scatters above."""

    @rule
    def _few(self) -> None:
        if (count := sum(self.ring_counts)) > MOST_PAPILLAE:
            text = f"are {count:,} papillae; at most {MOST_PAPILLAE:,} can be simulated"
            raise KeyedError(".ring_counts", f"{len(self.ring_counts)} layers", text)

    @rule
    def _layers(self) -> SkinSettings:
        if self.papillae is not None and len(self.papillae) != sum(self.ring_counts):
            raise KeyedError(
                "mock.scene.skin.papillae",
                f"{len(self.papillae)} of them",
                f"must be the {sum(self.ring_counts)} of ring_counts, or null",
            )
        if len(self.ring_counts) != len(self.heights_mm):
            raise KeyedError(
                "mock.scene.skin.heights_mm",
                list(self.heights_mm),
                f"must have one height for each of the {len(self.ring_counts)} layers",
            )
        return self


class Friction(StrictModel):
    """Coulomb friction between tips and plate."""

    kinetic: Positive = 0.85
    static_excess: Share = 0.03
    """Excess of static over slow kinetic friction of a tip."""
    strengthening: NonNegative = 0.01
    """Friction at sliding speed w is kinetic times 1 + strengthening ln(1 + w / weak_mm_s)."""
    weak_mm_s: Positive = 0.1
    creep_mm_s: NonNegative = 0.0
    """Speed at which a stuck tip creeps at its limit; 0: it does not creep."""
    creep_share: Annotated[float, Field(gt=0, le=0.1)] = 0.05
    """Share of the limit over which the speed of creep falls by e."""
    least_mm_s: NonNegative = 0.0
    """A tip that slides slower sticks again (stick-slip); 0: it sticks when it rests."""
    path_variation: Annotated[float, Field(ge=0, le=0.3)] = 0.05
    """Relative standard deviation of friction along each tip's path, drawn for every trial."""
    correlation_mm: Positive = 0.5
    papilla_scatter: Annotated[float, Field(ge=0, le=0.3)] = 0.05
    """Relative standard deviation between papillae (fabrication), clipped at two sigma."""


class MockPlateSettings(StrictModel):
    """The sliding plate of gravity trials, its slider and its marker."""

    mass_kg: Positive = 0.205
    """Initially mounted mass; the operator changes it."""
    stiction_n: NonNegative = 0.001
    damping_s: NonNegative = 0.01
    """Ratio of damping to stiffness in each tip's spring; not damping to ground."""
    stroke_mm: Positive = 25.0
    """Distance that the plate falls to its stop."""
    gravity_m_s2: Positive = 9.81
    marker_id: Annotated[int, Field(ge=0, le=49)] = 0
    """Identity in OpenCV's DICT_4X4_50."""
    marker_side_mm: Positive = 6.0
    """Side of the black square, without the white quiet zone of one module."""
    marker_centre_mm: tuple[Finite, Finite] = (16.6, 16.6)
    """Position in plate coordinates; in a region of 41.6 mm, clear of the skin after any fall."""


class PlatePosition(StrictModel):
    """The plate's true position in the arm's base frame, which teaching must find."""

    nominal_origin_mm: Triple = (400.0, 0.0, 300.0)
    nominal_rotvec_deg: Triple = (69.28203230275508, 69.28203230275508, 69.28203230275508)
    """Tool orientation with axes parallel to the plate's: x right, y up, z into the plate."""
    tilt_deg: Annotated[float, Field(ge=-10, le=10)] = 0.4
    tilt_axis_deg: Finite = 25.0
    """In-plane direction of the axis of the tilt, from the plate's x."""
    offset_mm: Finite = 0.35
    """Distance of the true surface behind the nominal one, along its normal."""

    @rule
    def _turn(self) -> PlatePosition:
        if math.hypot(*self.nominal_rotvec_deg) > 360.0:
            raise KeyedError(
                "mock.scene.contact.nominal_rotvec_deg",
                list(self.nominal_rotvec_deg),
                "is a rotation vector in degrees, at most 360 long",
            )
        return self


class SceneSettings(StrictModel):
    """The physics of the scene, independent of the devices."""

    level: Literal["auto", "L1", "L2", "L3"] = "auto"
    """Physics level of the contact (`scene.springs`); `auto` uses the level a plan needs."""
    step_ms: Literal[1, 2, 4, 8, 16, 32] = 2
    """Time step of the contact while the plate is held; 1 ms while it may fall."""
    skin: SkinSettings = SkinSettings()
    friction: Friction = Friction()
    plate: MockPlateSettings = MockPlateSettings()
    contact: PlatePosition = PlatePosition()
    plate_radius_mm: Positive | None = None
    """Of a plate that is convex towards the sensor, highest at its origin; null: flat."""


class MockEventCameraSettings(EventOptics):
    """The event camera inside the sensor and the markers that it sees."""


Tilt = Annotated[float, Field(ge=-30, le=30)]


class MockFrameCameraSettings(StrictModel):
    """The camera that sees the skin through the plate."""

    level: Literal["video", "tracks"] = "video"
    """`video`: images are rendered and stored. `tracks`: every frame has only the marker positions
    with the noise of tracking a video, at a fraction of the time and size."""
    width: Annotated[int, Field(ge=32, le=8192)] = 1920
    height: Annotated[int, Field(ge=32, le=8192)] = 1200
    px_per_mm: Positive = 20.0
    """Scale at the image centre."""
    tilt_deg: tuple[Tilt, Tilt] = (0.0, 0.0)
    """Tilt of the plate relative to the image plane: about its x, then about its y."""
    k1: Annotated[float, Field(ge=-1, le=1)] = 0.0
    """Radial distortion of the lens, OpenCV's first coefficient."""
    distance_mm: Positive = 300.0
    """Distance from lens to plate; only used with a tilt or a distortion."""
    rate_hz: Annotated[float, Field(gt=0, le=1000)] = 100.0
    exposure_us: Annotated[int, Field(ge=10, le=100_000)] = 2000
    """Exposure; motion while the shutter is open is blurred."""
    tip_radius_mm: Positive = 1.0
    """Radius of the white marker on each papilla. Tips in this scene do not push each other aside,
    so markers as wide as a papilla (2 mm) would overlap."""
    tip_level: Annotated[int, Field(ge=0, le=240)] = 200
    ground_level: Annotated[int, Field(ge=15, le=255)] = 25
    noise: Annotated[float, Field(ge=0, le=3)] = 1.5
    """Standard deviation of the grey levels, in patches around the evaluated features."""
    reflections: Reflections = Reflections()
    centroid_noise_px: NonNegative = 0.0045
    """Root mean square error of a tracked papilla's column and row at the level `tracks`; measured
    at the level `video` with the settings above, along a slide."""
    plate_noise_px: NonNegative = 0.02
    """The same for the centre of the plate's marker, along a fall: the subpixel error of fitting
    its sides."""
    latency_us: Annotated[int, Field(ge=0, le=1_000_000)] = 4000
    """Delay from the end of exposure to the host."""
    arrival_jitter_us: Annotated[float, Field(ge=0, le=1_000_000)] = 5000.0
    """Additional delay of a frame where only its arrival time is known
    (`timing.frames: host arrival`); half-normal, up to this limit of four sigma."""


class MockArmSettings(StrictModel):
    """The arm and its controller."""

    pose_rate_hz: Annotated[float, Field(gt=0, le=10_000)] = 500.0
    pose_noise_um: NonNegative = 2.0
    latency_us: Annotated[int, Field(ge=0, le=1_000_000)] = 1000
    """Delay from a controller's cycle to the host."""
    arrival_jitter_us: Annotated[float, Field(ge=0, le=1_000_000)] = 200.0
    """Additional delay of a pose; half-normal, up to this limit of four sigma."""
    vibration_um: NonNegative = 15.0
    """Largest tremor along each axis while the arm moves, scaled randomly in each trial; the
    reported poses do not show it."""
    vibration_hz: Positive = 5.0
    """Centre frequency of the tremor, whose frequencies are within 30 % of it."""
    input_sampling_us: Annotated[int, Field(ge=0, le=100_000)] = 0
    """Sampling period of the digital input; 0 for exact edge times."""
    tip_offset_mm: Triple = (0.0, 0.0, 0.0)
    """True position of the centre papilla's tip from the reported tool centre point, in the tool's
    axes, which pivoting must find."""
    start_xyz_mm: Triple | None = None
    """Position of the arm at power-on; 60 mm clear of the plate if left out."""


class FurtherDevice(SimulatedStream):
    """A simulated further device, which has a clock and delays of its own."""

    def stream_faults(self, stream: Any) -> Iterator[KeyedError]:
        """Return what is worse than the stream's timing states."""
        timing = stream.timing
        clock_ppm = getattr(self, "clock_ppm", 0.0)
        yield from _at_most(".mock.clock_ppm", clock_ppm, "timing.drift_ppm", timing.drift_ppm)
        if timing.grade == "arm clock":
            text = "must be host time: the simulated sensor has its own clock"
            yield KeyedError(".timing.grade", timing.grade, text)
        if timing.grade in {"host arrival", "host time"}:
            yield from _delay_faults(self, timing.delay, ".mock", "timing.delay")


Row = tuple[Finite, Finite, Finite, Finite, Finite, Finite]


class MockForceSensorSettings(FurtherDevice):
    """A force/torque sensor behind the plate: the contact's true forces, and its own faults.

    Axes: x right, y up, z into the plate; torques are about the plate's centre. The defaults are
    those of a small six-axis transducer (a range of some 10 N), rounded; none was measured.
    """

    seed: Seed | None = None
    """Fabrication: cross-talk and drift of the clock. Left out, the rig's seed."""
    rate_hz: Annotated[int, Field(ge=10, le=7000)] = 1000
    noise_n: NonNegative = 0.005
    """Standard deviation of a sample's force along each axis."""
    noise_nm: NonNegative = 0.0001
    """The same of its torque about each axis."""
    drift_n_per_min: NonNegative = 0.02
    """Largest drift of zero along each axis; a trial has a random share of it, of either sign."""
    drift_nm_per_min: NonNegative = 0.0004
    cross_talk: tuple[Row, Row, Row, Row, Row, Row] | None = None
    """Cross-talk matrix C; a reading is (1 + C) times the load of Fx, Fy,
    Fz in N and Tx, Ty, Tz in N m. Left out, it is drawn from the seed."""
    cross_talk_share: Share = 0.01
    """Largest share of one axis that shows on another where the matrix is drawn."""
    lever_m: Positive = 0.02
    """Length that compares forces with torques where the matrix is drawn."""
    range_n: Positive = 50.0
    """Force along any axis beyond which readings are not to be trusted: a fault."""
    clock_ppm: Annotated[float, Field(ge=0, le=20_000)] = 50.0
    """Largest drift of its clock, of either sign; drawn from the seed."""
    latency_us: Annotated[int, Field(ge=0, le=1_000_000)] = 500
    """From a sample to the host."""
    arrival_jitter_us: Annotated[float, Field(ge=0, le=1_000_000)] = 1000.0
    """Delay besides; half-normal, four standard deviations wide."""
    bias: Literal["trial", "session", "never"] = "trial"
    """When the present reading becomes zero."""


class MockGripperSettings(StrictModel):
    """Fingers that press the sensor deeper into contact as they close.

    The defaults are those of an adaptive parallel gripper with a stroke of 85 mm, as its maker
    states them, but for acceleration and reaction, which are assumed; none was measured.
    """

    opening_mm: Positive = 40.0
    """Opening at which the arm's depth is the depth in contact."""
    range_mm: tuple[NonNegative, Positive] = (0.0, 85.0)
    """Least and largest opening."""
    speed_mm_s: tuple[Positive, Positive] = (20.0, 150.0)
    """Least and largest speed of the opening."""
    force_n: tuple[Positive, Positive] = (20.0, 235.0)
    """Least and largest force at which closing fingers stall: normal force on the plate."""
    acceleration_mm_s2: Positive = 1000.0
    reaction_us: Annotated[int, Field(ge=0, le=1_000_000)] = 8000
    """From a command to the beginning of its motion."""

    @rule
    def _in_range(self) -> MockGripperSettings:
        for name in ("range_mm", "speed_mm_s", "force_n"):
            low, high = getattr(self, name)
            if low >= high:
                raise KeyedError(f"mock.gripper.{name}", [low, high], "must rise")
        low, high = self.range_mm
        if not low < self.opening_mm <= high:
            text = f"must be above {low:g} and at most {high:g}, as range_mm says"
            raise KeyedError("mock.gripper.opening_mm", self.opening_mm, text)
        return self


class ClockErrors(StrictModel):
    """Errors of the devices' clocks. Drifts are a property of the rig."""

    arm_ppm: Annotated[float, Field(ge=0, le=20_000)] = 50.0
    """Largest drift of either sign, drawn from the rig's seed. `timing` must allow as much."""
    event_camera_ppm: Annotated[float, Field(ge=0, le=20_000)] = 30.0
    frame_camera_ppm: Annotated[float, Field(ge=0, le=20_000)] = 20.0
    sync_box_ppm: Annotated[float, Field(ge=0, le=20_000)] = 10.0
    offset_h: Annotated[float, Field(ge=0, le=1e6)] = 12.0
    """Longest time for which a clock has run before a trial; drawn for every trial."""
    pulse_jitter_us: NonNegative = 2.0
    """Standard deviation of pulse time stamps on arm and event camera."""
    frame_jitter_us: NonNegative = 1.0
    exposure_jitter_us: NonNegative = 1.0
    """Standard deviation of the sync box's time stamps of exposures that it did not trigger."""
    read_shortest_us: NonNegative = 200.0
    """Shortest time of a request for a device's clock, and of its answer."""
    read_spread_us: NonNegative = 100.0
    """Mean additional time of either, exponentially distributed."""
    read_longest_us: NonNegative = 5000.0
    """Limit at which this time is clipped."""

    @rule
    def _reads(self) -> ClockErrors:
        if self.read_longest_us < self.read_shortest_us:
            raise KeyedError(
                "mock.clocks.read_longest_us",
                self.read_longest_us,
                f"must be at least read_shortest_us = {self.read_shortest_us:g}",
            )
        return self


class MockSettings(SimulatedRig):
    """A simulated rig."""

    seed: Seed = 1
    """Seed of fabrication scatter, contrast thresholds and clock drifts, which identify the rig."""
    scene: SceneSettings = SceneSettings()
    event_camera: MockEventCameraSettings = MockEventCameraSettings()
    frame_camera: MockFrameCameraSettings = MockFrameCameraSettings()
    arm: MockArmSettings = MockArmSettings()
    force: MockForceSensorSettings | None = None
    """Left out, the rig has no force sensor; `{}` is one with its defaults."""
    gripper: MockGripperSettings | None = None
    """Left out, the rig has no gripper; `{}` is one with its defaults."""
    clocks: ClockErrors = ClockErrors()
    faults: tuple[Fault, ...] = ()
    """Faults to inject; docs/faults.md lists the kinds."""

    @rule
    def _faults(self) -> MockSettings:
        check_papillae(self.faults, sum(self.scene.skin.ring_counts))
        check_single(self.faults, self.event_camera.cutoff_hz)
        return self

    @property
    def has_force(self) -> bool:
        """True if there is a force sensor."""
        return self.force is not None

    @property
    def gripper_range(self) -> GripperRange | None:
        """Values that the gripper's commands may have; None without a gripper."""
        made = self.gripper
        return made if made is None else GripperRange(made.range_mm, made.speed_mm_s, made.force_n)

    @property
    def frame_source(self) -> str:
        """Output of the outside camera: ``video`` or ``tracks``."""
        return self.frame_camera.level

    def rig_faults(self, rig: RigFile) -> Iterator[KeyedError]:
        """Return where the simulated devices are not those that the rig file states."""
        for name, stream in rig.streams.items():
            jitter = {"events": "pulse_jitter_us", "frames": "frame_jitter_us"}.get(stream.kind)
            if jitter is None or stream.timing.grade == "host arrival":
                continue
            limit = f"streams.{name}.timing.jitter_us", stream.timing.jitter_us
            yield from _at_most(f"mock.clocks.{jitter}", getattr(self.clocks, jitter), *limit)
        for index, fault in enumerate(self.faults):
            if isinstance(fault, StreamGone) and fault.stream not in rig.streams:
                known = ", ".join(rig.streams) or "none"
                text = f"is no further device of the rig; it has: {known}"
                yield KeyedError(f"mock.faults[{index}].stream", fault.stream, text)
        camera, stated = self.frame_camera, rig.frame_camera
        if abs(stated.scale_px_per_mm - camera.px_per_mm) > SCALE_ERROR * camera.px_per_mm:
            text = f"must be mock.frame_camera.px_per_mm = {camera.px_per_mm:g}"
            yield KeyedError("frame_camera.scale_px_per_mm", stated.scale_px_per_mm, text)
        if stated.rate_hz is not None and camera.rate_hz != stated.rate_hz:
            text = f"must be mock.frame_camera.rate_hz = {camera.rate_hz:g}"
            yield KeyedError("frame_camera.rate_hz", stated.rate_hz, text)
        block_ms, reflex = self.event_camera.block_ms, rig.reflex
        if reflex is not None and reflex.stream_timeout * 1000 <= block_ms:
            text = f"must be over {block_ms} ms, the camera's blocks"
            yield KeyedError("reflex.stream_timeout", f"{reflex.stream_timeout} s", text)
        sensor = None if rig.devices is None else rig.devices.force_sensor_driver
        yield from _timing_faults(self, rig.timing, sensor is not None and sensor.of_arm)

    def plan_faults(self, plan: Plan, file: str) -> Iterator[InputError]:
        """Check that the pixels can see a flickering light, if the plan has one."""
        cutoff_hz = self.event_camera.cutoff_hz
        for trial in plan if cutoff_hz else ():
            if any(isinstance(each, FlickerNuisance) for each in plan.program(trial).nuisances):
                yield InputError(
                    file,
                    "mock.event_camera.cutoff_hz",
                    cutoff_hz,
                    f"must be 0 for the flicker of trial {trial.id} of {plan.file}: behind a low "
                    "pass it is not computed",
                )
                return


def skin_of(settings: MockSettings) -> scene_skin.Skin:
    """Return the skin of a simulated rig."""
    # numpy, which a rig file does without
    import numpy as np

    from sliplab.plugins.simulation.scene import skin as scene_skin

    made = settings.scene.skin
    geometry = scene_skin.SkinGeometry(
        **made.model_dump(exclude={"seed", "relaxation_share", "relaxation_s", "papillae"}),
        friction_scatter=settings.scene.friction.papilla_scatter,
    )
    measured = None
    if made.papillae is not None:
        columns = zip(*((p.height_mm, p.friction, p.offset_mm) for p in made.papillae), strict=True)
        measured = scene_skin.MeasuredGeometry(
            *(np.array(column, np.float64) for column in columns)
        )
    seed = settings.seed if made.seed is None else made.seed
    return scene_skin.make_skin(geometry, seed, measured)


def _timing_faults(mock: MockSettings, timing: Timing, force_of_arm: bool) -> Iterator[KeyedError]:
    """Return the clocks and delays of a simulated rig that are worse than `timing` states.

    Args:
        force_of_arm: forces come with the arm's poses, by its clock.
    """
    for device, drift, jitter, used in (
        ("sync_box", "sync_box_ppm", "exposure", timing.frames == "exposure line"),
        ("event_camera", "event_camera_ppm", "pulse", True),
        ("frame_camera", "frame_camera_ppm", "frame", timing.frames != "host arrival"),
        ("arm_controller", "arm_ppm", "pulse", timing.arm == "digital input"),
    ):
        limits = [(drift, "drift_ppm"), (f"{jitter}_jitter_us", "jitter_us")][: 1 + used]
        for name, key in limits:
            limit = f"timing.{device}.{key}", getattr(getattr(timing, device), key)
            yield from _at_most(f"mock.clocks.{name}", getattr(mock.clocks, name), *limit)
    if timing.frames == "host arrival":
        camera, delay = mock.frame_camera, timing.frame_delay
        yield from _delay_faults(camera, delay, "mock.frame_camera", "timing.frame_delay")
    if mock.force is not None and not force_of_arm:
        how = timing.force or ForceTiming()
        if how.grade != "host time":
            text = "must be host time: the simulated sensor has a clock"
            yield KeyedError("timing.force.grade", how.grade, text)
        limit = "timing.force.drift_ppm", how.drift_ppm
        yield from _at_most("mock.force.clock_ppm", mock.force.clock_ppm, *limit)
        yield from _delay_faults(mock.force, how.delay, "mock.force", "timing.force.delay")
    if timing.arm == "host time":
        yield from _delay_faults(mock.arm, timing.pose_delay, "mock.arm", "timing.pose_delay")


def _at_most(key: str, value: float, name: str, limit: float) -> Iterator[KeyedError]:
    if value > limit:
        yield KeyedError(key, value, f"must be at most {name} = {limit:g}")


def _delay_faults(device: Any, delay: Delay, key: str, name: str) -> Iterator[KeyedError]:
    """Return what of a device's delay is beyond the one of its timing, at `name`."""
    latency_us, jitter_us = device.latency_us, device.arrival_jitter_us
    if latency_us < delay.shortest_us:
        text = f"must be at least {name}.shortest_us = {delay.shortest_us:g}"
        yield KeyedError(f"{key}.latency_us", latency_us, text)
    if latency_us + jitter_us > delay.longest_us:
        text = (
            f"must be at most {delay.longest_us - latency_us:g}: with latency_us, "
            f"{name}.longest_us = {delay.longest_us:g}"
        )
        yield KeyedError(f"{key}.arrival_jitter_us", jitter_us, text)


def scene_of(rig: RigFile) -> MockSettings:
    """Return the simulated scene and devices of a rig file.

    Raises:
        ValueError: a real rig has none.
    """
    if not isinstance(rig.mock, MockSettings):
        raise ValueError(f"the rig {rig.name} is real: there is no simulated scene")
    return rig.mock
