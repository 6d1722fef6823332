"""Every number of the simulated rig, in one place that is cheap to import.

`sliplab plan` reads rig files to learn rates and picture sizes, so nothing here may pull in numba
or OpenCV. Units stand in the names. The defaults are fitted guesses that tell a plausible story;
none of them was measured on a real skin, and whatever is computed from them is a simulation.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import Field, model_validator

from protocols.yaml_file import KeyedError, StrictModel

Positive = Annotated[float, Field(gt=0, le=1e9)]
NonNegative = Annotated[float, Field(ge=0, le=1e9)]
Share = Annotated[float, Field(ge=0, lt=1)]
Finite = Annotated[float, Field(ge=-1e9, le=1e9)]
Triple = tuple[Finite, Finite, Finite]
Seed = Annotated[int, Field(ge=0, lt=2**63)]


class Skin(StrictModel):
    """The papillae: a centre and two rings, falling outwards."""

    seed: Seed | None = None
    """Fabrication scatter: another seed is another skin. Left out, the rig's seed."""
    ring_counts: tuple[Annotated[int, Field(ge=1, le=48)], ...] = (1, 6, 12)
    """Papillae a layer, from the centre out."""
    heights_mm: tuple[Positive, ...] = (10.1, 9.0, 7.9)
    """Height above the skin plane, a layer each."""
    spacing_mm: Positive = 5.6
    """Radial distance between neighbouring layers."""
    radius_mm: Positive = 2.0
    youngs_modulus_mpa: Positive = 0.6
    poisson_ratio: Annotated[float, Field(ge=0, lt=0.5)] = 0.49
    bending: Positive = 12.0
    """Denominator of the bending term: 12 for a guided end, 3 for a free one."""
    base_normal_n_per_m: Positive = 150.0
    """Stiffness of the membrane under a papilla; without it the centre would buckle."""
    base_tangential_n_per_m: Positive = 200.0
    height_scatter_mm: NonNegative = 0.08
    """Half the range of a uniform deviation of each height."""
    position_scatter_mm: NonNegative = 0.05
    """Standard deviation of each papilla's place, cut at two of them."""
    relaxation_share: Share = 0.2
    """Share of a suddenly applied force that relaxes away (standard linear solid)."""
    relaxation_s: Positive = 1.0

    @model_validator(mode="after")
    def _layers(self) -> Skin:
        if len(self.ring_counts) != len(self.heights_mm):
            raise KeyedError(
                "scene.skin.heights_mm",
                list(self.heights_mm),
                f"must hold one height for each of the {len(self.ring_counts)} layers",
            )
        return self


class Friction(StrictModel):
    """Coulomb friction between tips and plate."""

    kinetic: Positive = 0.85
    static_excess: Share = 0.03
    """How much more a stuck tip withstands than a sliding one."""
    path_variation: Annotated[float, Field(ge=0, le=0.3)] = 0.05
    """Relative standard deviation of friction along each tip's path, drawn anew every trial."""
    correlation_mm: Positive = 0.5
    papilla_scatter: Annotated[float, Field(ge=0, le=0.3)] = 0.05
    """Relative standard deviation between papillae (fabrication), cut at two of them."""


class Plate(StrictModel):
    """The sliding plate of gravity trials, its slider and its marker."""

    mass_kg: Positive = 0.205
    """Mass mounted at first; the operator changes it."""
    stiction_n: NonNegative = 0.001
    damping_s: NonNegative = 0.01
    """Damping over stiffness inside each tip's spring; to ground it would hold the plate up."""
    stroke_mm: Positive = 25.0
    """How far the plate may fall before it meets its stop."""
    gravity_m_s2: Positive = 9.81
    marker_id: Annotated[int, Field(ge=0, le=49)] = 0
    """Identity in OpenCV's DICT_4X4_50."""
    marker_side_mm: Positive = 6.6
    """Side of the black square; the white quiet zone of one module comes on top."""
    marker_centre_mm: tuple[Finite, Finite] = (15.8, 15.8)
    """In plate coordinates; clear of the skin and inside a region of 42 mm."""


class Contact(StrictModel):
    """Where the plate truly is, in the arm's base frame: what teaching has to find out."""

    nominal_origin_mm: Triple = (400.0, 0.0, 300.0)
    nominal_rotvec_deg: Triple = (69.28203230275508, 69.28203230275508, 69.28203230275508)
    """Tool orientation with its axes on the plate's: x right, y up, z into the plate."""
    tilt_deg: Annotated[float, Field(ge=-10, le=10)] = 0.4
    tilt_axis_deg: Finite = 25.0
    """In-plane direction of the axis of the tilt, from the plate's x."""
    offset_mm: Finite = 0.35
    """How far the true surface lies behind the nominal one, along its normal."""

    @model_validator(mode="after")
    def _turn(self) -> Contact:
        if math.hypot(*self.nominal_rotvec_deg) > 360.0:
            raise KeyedError(
                "scene.contact.nominal_rotvec_deg",
                list(self.nominal_rotvec_deg),
                "is a rotation vector in degrees, at most 360 long",
            )
        return self


class Scene(StrictModel):
    """The physics: what is there, whether or not anything looks at it."""

    step_us: Annotated[int, Field(ge=100, le=10_000)] = 1000
    """Step of the scene's grid of virtual time."""
    skin: Skin = Skin()
    friction: Friction = Friction()
    plate: Plate = Plate()
    contact: Contact = Contact()


class EventCamera(StrictModel):
    """The event camera inside the sensor and the markers that it sees."""

    width: Annotated[int, Field(ge=64, le=4096)] = 640
    height: Annotated[int, Field(ge=64, le=4096)] = 480
    px_per_mm: Positive = 14.0
    shift_mm_per_n: Finite = 4.5
    """How far a marker moves in the image for a tangential force, in mm of the skin."""
    growth_mm_per_n: Finite = 0.4
    """How much a marker's radius grows with normal force."""
    radius_mm: Positive = 1.2
    edge_px: Positive = 0.8
    """Scale of the logistic edge; the profile is cut at five of them."""
    contrast: Positive = 2.08
    """Log intensity of a marker over its surroundings."""
    threshold: Positive = 0.2
    threshold_sigma: NonNegative = 0.03
    """Spread between pixels, cut at three of them."""
    refractory_us: NonNegative = 500.0
    noise_hz: Annotated[float, Field(ge=0, le=100)] = 0.01
    """Noise events a pixel and second."""
    leak_share: Annotated[float, Field(ge=0, le=1)] = 0.5
    """Share of the noise that is leakage (always positive); the rest is shot noise of both."""
    block_steps: Literal[1, 2, 4, 8, 16, 32, 64] = 32
    """Steps that the camera sends together: its latency, and the longest chord of a path."""
    chord_px: Positive = 0.005
    """Largest distance of a marker's path from its chord."""


class FrameCamera(StrictModel):
    """The camera that looks through the plate."""

    width: Annotated[int, Field(ge=32, le=8192)] = 1920
    height: Annotated[int, Field(ge=32, le=8192)] = 1200
    px_per_mm: Positive = 12.0
    rate_hz: Annotated[float, Field(gt=0, le=1000)] = 100.0
    exposure_us: Annotated[int, Field(ge=10, le=100_000)] = 2000
    tip_radius_mm: Positive = 1.0
    """Of the white spot on each papilla's top. The tips of this scene do not push each other aside,
    so a spot as wide as its papilla (2 mm) would run into its neighbour's."""
    tip_level: Annotated[int, Field(ge=0, le=240)] = 200
    ground_level: Annotated[int, Field(ge=15, le=255)] = 25
    noise: Annotated[float, Field(ge=0, le=3)] = 1.5
    """Standard deviation of the grey levels, in patches round what is looked at."""
    latency_us: Annotated[int, Field(ge=0, le=1_000_000)] = 4000
    """From the end of exposure to the host."""


class Arm(StrictModel):
    """The arm and its controller."""

    pose_rate_hz: Annotated[float, Field(gt=0, le=10_000)] = 500.0
    pose_noise_um: NonNegative = 2.0
    latency_us: Annotated[int, Field(ge=0, le=1_000_000)] = 1000
    """From a controller's cycle to the host."""
    input_sampling_us: Annotated[int, Field(ge=0, le=100_000)] = 0
    """Grid on which the digital input is sampled; 0 stamps each edge when it comes."""
    start_xyz_mm: Triple | None = None
    """Where the arm stands when the rig is switched on; left out, 60 mm clear of the plate."""


class Clocks(StrictModel):
    """How far the devices' clocks are from the truth. Drifts belong to the rig."""

    arm_ppm: Annotated[float, Field(ge=0, le=1000)] = 50.0
    """Largest drift, either way; each rig's seed draws its own."""
    event_camera_ppm: Annotated[float, Field(ge=0, le=1000)] = 30.0
    frame_camera_ppm: Annotated[float, Field(ge=0, le=1000)] = 20.0
    sync_box_ppm: Annotated[float, Field(ge=0, le=1000)] = 10.0
    offset_h: Annotated[float, Field(ge=0, le=1e6)] = 12.0
    """Longest time that a clock has run before a trial begins; drawn anew every trial."""
    pulse_jitter_us: NonNegative = 2.0
    """Standard deviation of the stamp of a pulse on arm and event camera."""
    frame_jitter_us: NonNegative = 1.0


FaultKind = Literal["arm_protective_stop", "frames_lost", "pulses_lost", "event_gap"]


class Fault(StrictModel):
    """Something that goes wrong on purpose."""

    kind: FaultKind
    trial: Annotated[int, Field(ge=1)] | None = None
    """Which trial begun on this rig, counting from 1; left out, every one."""
    at_s: NonNegative = 0.5
    """When it happens, after the moment that `since` names."""
    since: Literal["trial", "recording"] = "recording"
    """`trial`: the trial's first moment; `recording`: the start of the sync box."""
    count: Annotated[int, Field(ge=1, le=100_000)] = 1
    """How many frames or pulses are lost."""
    seconds: Positive = 0.1
    """How long a gap lasts."""
    device: Literal["event_camera", "arm"] = "event_camera"
    """Whose pulses are lost."""


class MockSettings(StrictModel):
    """A simulated rig."""

    seed: Seed = 1
    """Fabrication scatter, contrast thresholds and clock drifts: what makes it this rig."""
    scene: Scene = Scene()
    event_camera: EventCamera = EventCamera()
    frame_camera: FrameCamera = FrameCamera()
    arm: Arm = Arm()
    clocks: Clocks = Clocks()
    faults: tuple[Fault, ...] = ()
