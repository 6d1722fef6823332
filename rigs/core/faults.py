"""The table of faults: of simulated devices, and of the fakes that real drivers speak to.

A kind of fault of simulated devices is a model: its name, its meaning, its parameters and the
devices that have it, at times that a rig file names (`mock: faults: [...]`); docs/faults.md lists
them for users. Fakes have those `on_wire`, and further ones, which tests inject at once.
Cheap to import, as all settings are.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Annotated, ClassVar, Literal, TypeVar, get_args

from pydantic import Field

from sliplab.protocols.key_errors import KeyedError, register_tags
from sliplab.protocols.yaml_file import StrictModel, rule

Seconds = Annotated[float, Field(gt=0, le=1e6)]
Count = Annotated[int, Field(ge=1, le=100_000)]
Papilla = Annotated[int, Field(ge=0, le=10_000)]
Factor = Annotated[float, Field(gt=0, le=10)]
PlateMm = Annotated[float, Field(ge=-1000, le=1000)]
Device = Literal["arm", "event_camera", "frame_camera", "sync_box", "force_sensor"]
CabledDevice = Literal["arm", "event_camera", "frame_camera", "sync_box", "force_sensor", "gripper"]
RestartDevice = Literal["arm", "event_camera", "frame_camera"]
PulseDevice = Literal["arm", "event_camera", "sync_box"]


INJECT = "inject"
"""Method of a fake that is told the kind."""


class BaseFault(StrictModel):
    """What every fault has."""

    wired: ClassVar[Mapping[str, str]] = {}
    """Devices whose fakes have it, each with the method of the fake that causes it
    (`rigs.core.driver`). A driver's name stands for the fake of that driver alone."""
    trial: Annotated[int, Field(ge=1, le=1_000_000)] | None = None
    """Number of the trial on this rig, from 1; every trial if left out."""

    @property
    def target(self) -> str | None:
        """The device that has it, or the stream of a further device; None if it names none."""
        target: str | None = getattr(self, "device", getattr(self, "stream", None))
        return target


F = TypeVar("F", bound=BaseFault)


def on_wire(**methods: str) -> Callable[[type[F]], type[F]]:
    """Return a decorator that says which fakes have a fault; see `BaseFault.wired`."""

    def mark(model: type[F]) -> type[F]:
        model.wired = methods
        return model

    return mark


class _TimedFault(BaseFault):
    at_s: Annotated[float, Field(ge=0, le=1e6)] = 0.5
    """Time of the fault after the moment that `since` names."""
    since: Literal["trial", "recording"] = "recording"
    """`trial`: the trial's start; `recording`: the start of the sync box."""


@on_wire(arm=INJECT)
class ArmProtectiveStop(_TimedFault):
    """The arm makes a protective stop, and does not move until the operator clears it."""

    kind: Literal["arm_protective_stop"]
    at_mm: Annotated[float, Field(gt=0, le=10_000)] | None = None
    """A distance instead of a time: the path length of the tool since `since`, mm."""

    @rule
    def _one_moment(self) -> ArmProtectiveStop:
        if self.at_mm is not None and "at_s" in self.model_fields_set:
            raise ValueError("needs a time (at_s) or a point (at_mm), not both")
        return self


class ArmOffPath(_TimedFault):
    """The tool leaves its path sideways, which its poses show."""

    kind: Literal["arm_off_path"]
    mm: Annotated[float, Field(gt=0, le=10)] = 0.5
    """Largest deviation, in the plate's plane."""
    seconds: Seconds = 1.0
    """Time in which the deviation grows linearly; then it stays until the trial's end."""
    direction_deg: Annotated[float, Field(ge=-360, le=360)] | None = None
    """Direction on the plate, from its x towards its y; if left out, to the left of the tool's
    motion at that time (the plate's y if it does not move along the plate)."""


class FramesLost(_TimedFault):
    """Frames that never reach the host; the camera's counter continues."""

    kind: Literal["frames_lost"]
    count: Count = 1


class FrameLate(_TimedFault):
    """Frames that reach the host late, in order and correctly stamped; they delay later ones."""

    kind: Literal["frame_late"]
    count: Count = 1
    seconds: Seconds = 0.1


class EventGap(_TimedFault):
    """The event camera loses all data, including pulses, for some time."""

    kind: Literal["event_gap"]
    seconds: Seconds = 0.1


@on_wire(event_camera="stall")
class EventStall(_TimedFault):
    """The event camera sends nothing for some time, and then everything."""

    kind: Literal["event_stall"]
    seconds: Seconds = 0.1


class EventBurst(_TimedFault):
    """Flicker: noise events on the whole array."""

    kind: Literal["event_burst"]
    seconds: Seconds = 0.1
    million_per_s: Annotated[float, Field(gt=0, le=1000)] = 20.0
    """Mean rate of the additional events, both polarities together, in 1e6 per second."""


class ClockDrift(_TimedFault):
    """A device's clock runs faster or slower from some time on."""

    kind: Literal["clock_drift"]
    device: Device
    ppm: Annotated[float, Field(ge=-10_000, le=10_000)]
    """Change of the clock's drift; negative if it loses time."""


@on_wire(arm=INJECT)
class ClockJump(_TimedFault):
    """A device's clock jumps."""

    kind: Literal["clock_jump"]
    device: Device
    seconds: Annotated[float, Field(ge=-1e6, le=1e6)]
    """Size of the jump, backwards if negative."""


@on_wire(sync_box="reset", ati_net_ft=INJECT)
class ClockRestart(_TimedFault):
    """A device's clock restarts at 0, as after a power loss."""

    kind: Literal["clock_restart"]
    device: RestartDevice


class PulsesLost(_TimedFault):
    """Sync pulses that a device does not report."""

    kind: Literal["pulses_lost"]
    count: Count = 1
    device: PulseDevice = "event_camera"


class PulsesDuplicated(_TimedFault):
    """Sync pulses that a device reports twice."""

    kind: Literal["pulses_duplicated"]
    count: Count = 1
    seconds: Seconds = 0.0002
    """Time from a pulse to its duplicate, as of a bouncing contact."""
    device: PulseDevice = "event_camera"


class PulsesLate(_TimedFault):
    """Sync pulses that a device stamps too late."""

    kind: Literal["pulses_late"]
    count: Count = 1
    seconds: Seconds = 0.001
    device: PulseDevice = "event_camera"


class PapillaTorn(_TimedFault):
    """A papilla tears off: no contact force and no marker from then on."""

    kind: Literal["papilla_torn"]
    papilla: Papilla
    """Counted from the centre (0) outwards, ring by ring."""


class MarkerOccluded(_TimedFault):
    """A marker is hidden from the outside camera for some time."""

    kind: Literal["marker_occluded"]
    papilla: Papilla | None = None
    """Papilla of the marker, counted as for `papilla_torn`."""
    plate: bool = False
    """True for the plate's ArUco marker instead."""
    seconds: Seconds = 0.3

    @rule
    def _one_marker(self) -> MarkerOccluded:
        if self.plate == (self.papilla is not None):
            raise ValueError("needs either a papilla (its number) or plate: true")
        return self


class PlateStuck(BaseFault):
    """The slider jams: a released plate does not fall."""

    kind: Literal["plate_stuck"]


class PapillaSticky(BaseFault):
    """One papilla grips more (or less) than the others of its layer."""

    kind: Literal["papilla_sticky"]
    papilla: Papilla
    """Counted as for `papilla_torn`."""
    factor: Factor = 1.6
    """Its friction over what it would be without the fault."""


class SkinWear(BaseFault):
    """Tips wear: each grips more or less, the further it has slid on this rig.

    Friction is exp(per_m s) times that of a new tip. The path s is what the tip slid in earlier
    trials since the rig was switched on, in metres.
    """

    kind: Literal["skin_wear"]
    per_m: Annotated[float, Field(ge=-100, le=100)] = -0.1
    """Relative change of friction per metre; negative: the tips become smoother."""


class PlateSpot(BaseFault):
    """A round spot on the plate, on which friction differs; factors of several multiply."""

    kind: Literal["plate_spot"]
    centre_mm: tuple[PlateMm, PlateMm]
    """On the plate, x and y; a sliding plate takes it with it."""
    radius_mm: Annotated[float, Field(gt=0, le=1000)]
    factor: Factor = 0.6
    """Friction on it over friction beside it. A tip stands on it if its middle does."""


class MainsLight(_TimedFault):
    """Lamps on the mains flicker, which the event camera sees as if all of the image did.

    Intensity is 1 + share sin(2 pi hz t + phase) times that of steady light; the phase belongs to
    the trial. A further event camera and the outside camera do not see it.
    """

    kind: Literal["mains_light"]
    at_s: Annotated[float, Field(ge=0, le=1e6)] = 0.0
    """When it begins; it lasts to the trial's end."""
    share: Annotated[float, Field(gt=0, le=0.5)] = 0.08
    """Amplitude over the mean of the intensity."""
    hz: Annotated[float, Field(ge=10, le=1000)] = 100.0
    """Of the light, which is twice that of the mains."""


class Knock(_TimedFault):
    """The sensor rings against the plate after a knock, which the reported poses do not show.

    The displacement is um exp(-0.05 w t) sin(w t) with w = 2 pi hz, t from `at_s` on, in a
    direction that belongs to the trial.
    """

    kind: Literal["knock"]
    um: Annotated[float, Field(gt=0, le=10_000)] = 50.0
    """Amplitude."""
    hz: Annotated[float, Field(ge=1, le=250)] = 30.0
    """Frequency of the oscillation."""


class Shaking(_TimedFault):
    """The sensor shakes against the plate to the trial's end, which the poses do not show.

    The frequency f rises from `low_hz` to `high_hz` in `sweep_s`, by equal factors in equal times,
    and begins again. The amplitude is mm_s / (2 pi f); the direction belongs to the trial.
    """

    kind: Literal["shaking"]
    at_s: Annotated[float, Field(ge=0, le=1e6)] = 0.0
    mm_s: Annotated[float, Field(gt=0, le=100)] = 0.5
    """Peak speed."""
    low_hz: Annotated[float, Field(ge=0.1, le=250)] = 1.0
    high_hz: Annotated[float, Field(ge=0.1, le=250)] = 200.0
    sweep_s: Seconds = 10.0

    @rule
    def _rises(self) -> Shaking:
        if self.high_hz <= self.low_hz:
            raise ValueError(f"high_hz must be over low_hz = {self.low_hz:g}")
        return self


class EventNoise(_TimedFault):
    """More noise events of a steady rate to the trial's end, of all pixels or some."""

    kind: Literal["event_noise"]
    at_s: Annotated[float, Field(ge=0, le=1e6)] = 0.0
    hz: Annotated[float, Field(gt=0, le=10_000)] = 0.05
    """Mean rate of each of these pixels."""
    pixels: Annotated[int, Field(ge=1, le=1_000_000)] | None = None
    """Number of them, drawn by the rig's seed; all if left out."""
    positive: Annotated[float, Field(ge=0, le=1)] = 0.75
    """Share of positive events."""


class SkinBrushed(_TimedFault):
    """An object brushes over the skin: a side force that passes over the papillae.

    On a papilla at s along the way it is newtons exp(-(v t - s)^2 / (2 width_mm^2)). The event
    camera sees the bend; friction holds the tips, and the outside camera sees nothing.
    """

    kind: Literal["skin_brushed"]
    newtons: Annotated[float, Field(gt=0, le=10)] = 0.05
    mm_s: Annotated[float, Field(gt=0, le=1000)] = 20.0
    width_mm: Annotated[float, Field(gt=0, le=100)] = 2.0
    direction_deg: Annotated[float, Field(ge=-360, le=360)] | None = None
    """Of the way on the skin; if left out, it belongs to the trial."""


class ArmRamp(BaseFault):
    """The arm speeds up and brakes gently in every straight move that begins or ends in contact."""

    kind: Literal["arm_ramp"]
    mm_s2: Annotated[float, Field(ge=0.01, le=1e6)] = 1.0
    """Its acceleration, and its deceleration."""


class DiskFull(_TimedFault):
    """Writes of the recording fail (ENOSPC) for the rest of the trial."""

    kind: Literal["disk_full"]


@on_wire(arm=INJECT, event_camera="close", sync_box="close", force_sensor="close", gripper="close")
class DeviceGone(_TimedFault):
    """A device loses its power or its cable; every call fails."""

    kind: Literal["device_gone"]
    device: CabledDevice
    seconds: Seconds | None = None
    """Time until it answers again, permanent if left out. It returns switched on and idle."""


class StreamGone(_TimedFault):
    """A further device loses its power or its cable."""

    kind: Literal["stream_gone"]
    stream: Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,31}$")]
    """Name of its stream."""
    seconds: Seconds | None = None
    """If left out, the device is gone for good."""


AnyFault = (
    ArmProtectiveStop
    | ArmOffPath
    | FramesLost
    | FrameLate
    | EventGap
    | EventStall
    | EventBurst
    | ClockDrift
    | ClockJump
    | ClockRestart
    | PulsesLost
    | PulsesDuplicated
    | PulsesLate
    | PapillaTorn
    | MarkerOccluded
    | PlateStuck
    | PapillaSticky
    | SkinWear
    | PlateSpot
    | MainsLight
    | Knock
    | Shaking
    | EventNoise
    | SkinBrushed
    | ArmRamp
    | DiskFull
    | DeviceGone
    | StreamGone
)
Fault = Annotated[AnyFault, Field(discriminator="kind")]
"""One fault, discriminated by its `kind`."""


def kind_of(model: type[BaseFault]) -> str:
    """Return the name of a kind of fault."""
    name: str = get_args(model.model_fields["kind"].annotation)[0]
    return name


KINDS: tuple[str, ...] = tuple(kind_of(model) for model in get_args(AnyFault))
"""Kinds that a rig file may name."""
register_tags(*KINDS)


_IN_FAKES: Mapping[str, Mapping[str, str]] = {
    # it answers and sends nothing more; its connections stay open, new ones are accepted
    "device_silent": {
        "arm": INJECT,
        "ati_net_ft": INJECT,
        **dict.fromkeys(("sync_box", "force_sensor", "gripper"), "silence"),
    },
    # the answer to the next request comes only with the answer to the one after it
    "answer_late": {"arm": INJECT, "sync_box": "answer_late"},
    # the next `rigs.core.fakes.PACKETS_LOST` packets of poses are not sent
    "poses_lost": {"arm": INJECT},
    # a person presses the emergency stop
    "arm_emergency_stop": {"arm": INJECT},
    # a light curtain or a door stops the arm; a running program is paused
    "arm_safeguard_stop": {"arm": INJECT},
    # the operator switches the arm off, but not its controller
    "arm_power_off": {"arm": INJECT},
    # the operator takes remote control away
    "arm_remote_off": {"arm": INJECT},
    # the operator presses stop, or pause, at the pendant
    "arm_program_end": {"arm": INJECT},
    "arm_program_paused": {"arm": INJECT},
    # the load is out of a force sensor's range; of some records where they are counted
    "force_overload": {"force_sensor": "overload", "ati_net_ft": INJECT},
    # records of a force sensor do not arrive, come after the next one, or twice, or cut short
    "records_lost": {"ati_net_ft": INJECT},
    "records_reordered": {"ati_net_ft": INJECT},
    "records_duplicated": {"ati_net_ft": INJECT},
    "records_malformed": {"ati_net_ft": INJECT},
    "gripper_fault": {"gripper": "fail"},
}
"""Kinds that only fakes have, with what `BaseFault.wired` says of the others."""


def wired(device: str) -> dict[str, str]:
    """Return the faults of a device's fakes: by kind, the method of the fake that causes it."""
    every = {**{kind_of(it): it.wired for it in get_args(AnyFault)}, **_IN_FAKES}
    return {kind: methods[device] for kind, methods in every.items() if device in methods}


def check_papillae(faults: tuple[AnyFault, ...], count: int) -> None:
    """Check the papillae that `faults` name against a skin of `count` papillae.

    Raises:
        KeyedError: the skin has no such papilla.
    """
    for index, fault in enumerate(faults):
        papilla = getattr(fault, "papilla", None)
        if papilla is not None and papilla >= count:
            raise KeyedError(
                f"mock.faults[{index}].papilla",
                papilla,
                f"the skin has {count} papillae, numbered from 0 (the centre) to {count - 1}",
            )


def check_single(faults: tuple[AnyFault, ...], cutoff_hz: float) -> None:
    """Check the faults that a trial can have but one of, and what they need.

    Args:
        cutoff_hz: of the event camera's pixels; 0 if they have no low pass.

    Raises:
        KeyedError: two faults of one kind meet in a trial, or pixels with a low pass see a light.
    """
    seen: dict[type[AnyFault], list[int | None]] = {MainsLight: [], ArmRamp: []}
    for index, fault in enumerate(faults):
        trials = seen.get(type(fault))
        if trials is None:
            continue
        if trials and (fault.trial in trials or None in trials or fault.trial is None):
            raise KeyedError(
                f"mock.faults[{index}].kind",
                fault.kind,
                "must be in the list once only for a trial",
            )
        trials.append(fault.trial)
        if isinstance(fault, MainsLight) and cutoff_hz > 0:
            raise KeyedError(
                f"mock.faults[{index}].kind",
                fault.kind,
                "needs mock.event_camera.cutoff_hz = 0: flicker behind a low pass is not computed",
            )
