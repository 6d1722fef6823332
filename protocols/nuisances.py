"""Nuisances: disturbances that look like slip, as named elements of a protocol.

    collection:
      factors:
        nuisance: {values: [none, tap_table, vibration, mix]}
        strength: {unit: percent, values: [50, 100, 200]}
      nuisances: {apply: $nuisance, strength: $strength}

A simulated rig produces each by physics (plug-in `simulation`). On a real rig the arm
makes its own motions, which are in the hold, and the operator is asked to make the rest.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from decimal import Decimal
from typing import Annotated, Any, ClassVar, Literal, get_args

from pydantic import BeforeValidator, Field, PlainSerializer, WithJsonSchema, field_validator

from sliplab.protocols.key_errors import KeyedError, register_tags
from sliplab.protocols.quantity import (
    REF_SCHEMA,
    FactorRef,
    PercentOrRef,
    PositiveCelsius,
    PositiveDegrees,
    PositiveDegreesPerSecond,
    PositiveHertz,
    PositiveMillimetres,
    PositiveNewtons,
    PositivePercent,
    PositiveSeconds,
    PositiveSpeed,
    canonical,
    word_or_ref,
)
from sliplab.protocols.shown import one_of
from sliplab.protocols.yaml_file import StrictModel

NONE, MIX = "none", "mix"
"""Levels that apply no nuisance, and all of them at once."""
QUIET_S = 2.0
"""End of the hold in which the arm is at rest: labels count from there."""


class _Nuisance(StrictModel):
    scales: ClassVar[str]
    """The field that is proportional to the strength."""
    by_arm: ClassVar[bool] = False
    """The arm makes it, in the hold."""
    asks: ClassVar[str] = ""
    """What the operator of a real rig is asked for, with fields in braces."""

    @property
    def request(self) -> str:
        """Instruction for the operator of a real rig; empty if the arm does it."""
        values = {key: canonical(v) if isinstance(v, Decimal) else v for key, v in self}
        return self.asks.format(**values)

    def scaled(self, share: Decimal) -> Any:
        """Return the same at another strength, 1 for its own."""
        return self.model_copy(update={self.scales: getattr(self, self.scales) * share})


class Tap(_Nuisance):
    """A knock on the arm or on the table, after which the sensor rings against the plate."""

    scales = "distance"
    kind: Literal["tap"]
    on: Literal["arm", "table"]
    distance: PositiveMillimetres
    """Amplitude of the damped oscillation."""
    ring: PositiveHertz
    """Its frequency."""
    every: PositiveSeconds = Decimal(2)
    """Mean time from one to the next."""

    @property
    def request(self) -> str:
        """Instruction for the operator of a real rig; the way in micrometres."""
        return (
            f"knock on the {self.on} about every {canonical(self.every)} s, so that it moves by "
            f"{canonical(self.distance * 1000)} um"
        )


class VibrationNuisance(_Nuisance):
    """The sensor shakes against the plate, its frequency rising evenly in octaves, over and over.

    Its peak speed is the same at every frequency f, so the amplitude is speed / (2 pi f).
    """

    scales = "speed"
    asks = (
        "shake the table by a sweep from {low} to {high} Hz in {sweep} s, peak speed {speed} mm/s"
    )
    kind: Literal["vibration"]
    speed: PositiveSpeed
    """Peak speed."""
    low: PositiveHertz = Decimal(1)
    high: PositiveHertz = Decimal(200)
    sweep: PositiveSeconds = Decimal(10)
    """Time from `low` to `high`."""


class ArmMotion(_Nuisance):
    """The arm starts and stops: a short way along the plate's x, and back."""

    scales = "distance"
    by_arm = True
    kind: Literal["arm_motion"]
    distance: PositiveMillimetres
    speed: PositiveSpeed = Decimal(5)
    every: PositiveSeconds = Decimal(2)


class Rotation(_Nuisance):
    """The arm turns the sensor about the plate's normal, and back."""

    scales = "angle"
    by_arm = True
    kind: Literal["rotation"]
    angle: PositiveDegrees
    speed: PositiveDegreesPerSecond = Decimal(5)
    every: PositiveSeconds = Decimal(3)


class Regrasp(_Nuisance):
    """The arm lets go a little, and presses again."""

    scales = "distance"
    by_arm = True
    kind: Literal["regrasp"]
    distance: PositiveMillimetres
    speed: PositiveSpeed = Decimal(2)
    every: PositiveSeconds = Decimal(3)


class FlickerNuisance(_Nuisance):
    """Lamps on the mains, with light that gets into the sensor."""

    scales = "share"
    asks = "light the sensor by a lamp that flickers at {frequency} Hz by {share} %"
    kind: Literal["flicker"]
    share: PositivePercent
    """Amplitude of the intensity over its mean."""
    frequency: PositiveHertz = Decimal(100)
    """Twice that of the mains."""


class Brush(_Nuisance):
    """Another object brushes over the papillae from the side, one after the other."""

    scales = "force"
    asks = "brush over the skin's rim about every {every} s with {force} N"
    kind: Literal["brush"]
    force: PositiveNewtons
    """Largest side force on a papilla."""
    speed: PositiveSpeed = Decimal(20)
    width: PositiveMillimetres = Decimal(2)
    """Standard deviation of the force along its way."""
    every: PositiveSeconds = Decimal(3)


class LostPackets(_Nuisance):
    """Packets of the event camera that get lost, events and sync pulses with them."""

    scales = "duration"
    asks = "load the event camera's link so that packets get lost"
    kind: Literal["lost_packets"]
    duration: PositiveSeconds
    """What one packet holds."""
    every: PositiveSeconds = Decimal("0.5")


class HotPixels(_Nuisance):
    """More pixels that send events without a change of light."""

    scales = "rate"
    asks = "raise the event camera's bias until more hot pixels appear"
    kind: Literal["hot_pixels"]
    pixels: Annotated[int, Field(ge=1, le=1_000_000)]
    rate: PositiveHertz
    """Mean rate of events of each."""


class Warmth(_Nuisance):
    """A warmer event camera: its noise doubles with every 8 degC."""

    scales = "rise"
    asks = "warm the event camera by {rise} degC"
    kind: Literal["warmth"]
    rise: PositiveCelsius


AnyNuisance = (
    Tap
    | VibrationNuisance
    | ArmMotion
    | Rotation
    | Regrasp
    | FlickerNuisance
    | Brush
    | LostPackets
    | HotPixels
    | Warmth
)
Nuisance = Annotated[AnyNuisance, Field(discriminator="kind")]
register_tags(*(get_args(m.model_fields["kind"].annotation)[0] for m in get_args(AnyNuisance)))

SHIPPED: dict[str, AnyNuisance] = {
    "tap_table": Tap(kind="tap", on="table", distance="20 um", ring="60 Hz"),
    "tap_arm": Tap(kind="tap", on="arm", distance="100 um", ring="15 Hz"),
    "vibration": VibrationNuisance(kind="vibration", speed="0.5 mm/s"),
    "arm_motion": ArmMotion(kind="arm_motion", distance="30 um"),
    "rotation": Rotation(kind="rotation", angle="0.2 deg"),
    "regrasp": Regrasp(kind="regrasp", distance="300 um"),
    "flicker": FlickerNuisance(kind="flicker", share="3 %"),
    "brush": Brush(kind="brush", force="0.05 N"),
    "lost_packets": LostPackets(kind="lost_packets", duration="10 ms"),
    "hot_pixels": HotPixels(kind="hot_pixels", pixels=50, rate="10 Hz"),
    "warm_camera": Warmth(kind="warmth", rise="20 degC"),
}
"""Nuisances that every protocol knows. Their sizes are estimates: no source gives them."""


WordField = Annotated[
    str | FactorRef,
    BeforeValidator(word_or_ref),
    PlainSerializer(str),
    WithJsonSchema({"anyOf": [{"type": "string"}, REF_SCHEMA]}),
]


class Nuisances(StrictModel):
    """The `nuisances:` section: which apply in a trial, and how strong."""

    apply: WordField
    """A name below or of those that ship, `none`, or `mix`: all of them at once; or a factor with
    these as levels."""
    strength: PercentOrRef = Decimal(100)
    """Of the sizes of the elements."""
    elements: dict[str, Nuisance] = Field(default_factory=dict)
    """Nuisances of this protocol by name; one that ships is replaced by its name."""

    @field_validator("elements")
    @classmethod
    def _own_names(cls, elements: dict[str, Nuisance]) -> dict[str, Nuisance]:
        for name in elements:
            if name in {NONE, MIX}:
                raise ValueError(f"cannot be named '{name}', which stands for itself")
        return elements

    @property
    def known(self) -> dict[str, AnyNuisance]:
        """All elements by name."""
        return {**SHIPPED, **self.elements}

    def check_name(self, name: object, key: str) -> None:
        """Hold a level against the names.

        Raises:
            KeyedError: it is none of them.
        """
        names = [NONE, MIX, *self.known]
        if name not in names:
            raise KeyedError(key, name, one_of(name, names))

    def applied(self, condition: Mapping[str, Any]) -> tuple[str, Decimal]:
        """The name that applies in a trial with this condition, and its strength in percent."""

        def of(field: Any) -> Any:
            return condition[field.factor] if isinstance(field, FactorRef) else field

        return of(self.apply), of(self.strength)

    def in_trial(self, condition: Mapping[str, Any]) -> tuple[AnyNuisance, ...]:
        """The nuisances of a trial with this condition, at its strength."""
        name, percent = self.applied(condition)
        if name == NONE or not percent:
            return ()
        found = self.known.values() if name == MIX else (self.known[name],)
        return tuple(each.scaled(percent / 100) for each in found)


@dataclass(frozen=True)
class TrialNuisances:
    """The nuisances of one trial.

    Attributes:
        elements: at the trial's strength.
        seconds: planned duration of the recording.
    """

    elements: tuple[AnyNuisance, ...]
    seconds: float


def requests(elements: tuple[AnyNuisance, ...]) -> str:
    """Instruction for the operator; empty if the arm does it all."""
    return "; ".join(each.request for each in elements if each.request)
