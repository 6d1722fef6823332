"""The phases of a trial's motion, without rules about their order.

Every number in a phase may be a factor: ``$name`` is replaced by its level in the current trial.
"""

from __future__ import annotations

from decimal import Decimal
from typing import Annotated, Literal

from pydantic import BeforeValidator, Field, PlainSerializer, WithJsonSchema

from sliplab.protocols.key_errors import register_tags
from sliplab.protocols.quantity import (
    REF_SCHEMA,
    AnyMillimetresOrRef,
    DegreesOrRef,
    DegreesPerSecondOrRef,
    FactorRef,
    MillimetresOrRef,
    NewtonsOrRef,
    PercentOrRef,
    PositiveSecondsOrRef,
    SecondsOrRef,
    SpeedOrRef,
    word_or_ref,
)
from sliplab.protocols.yaml_file import StrictModel, rule


class Approach(StrictModel):
    """Travel, clear of the plate, to above the place where the trial begins."""

    phase: Literal["approach"]
    clearance: MillimetresOrRef
    speed: SpeedOrRef


class Press(StrictModel):
    """Straight in along the plate's normal, to an indentation depth or to a normal force."""

    phase: Literal["press"]
    depth: MillimetresOrRef | None = None
    """With `force`, the deepest that it may go; left out then, `limits.depth` is."""
    force: NewtonsOrRef | None = None
    """Normal force at which it ends, on a rig with a force sensor."""
    speed: SpeedOrRef

    @rule
    def _ends(self) -> Press:
        if self.depth is None and self.force is None:
            raise ValueError("must have a 'depth', or a 'force'")
        return self


class HoldPhase(StrictModel):
    """Standing still: `settle` passes first, then `duration`, which may be recorded."""

    phase: Literal["hold"]
    duration: PositiveSecondsOrRef
    settle: SecondsOrRef = Decimal(0)


class Slide(StrictModel):
    """Along the plate at constant depth; the path is centred on the plate."""

    phase: Literal["slide"]
    distance: MillimetresOrRef
    speed: SpeedOrRef
    direction: DegreesOrRef


SideField = Annotated[
    Literal["left", "right"] | FactorRef,
    BeforeValidator(word_or_ref),
    PlainSerializer(str),
    WithJsonSchema({"anyOf": [{"enum": ["left", "right"]}, REF_SCHEMA]}),
]


class Disturbance(StrictModel):
    """A sideways motion during retraction, as a share of the retraction's speed."""

    share: PercentOrRef
    side: SideField


class Retract(StrictModel):
    """Slowly out along the normal, with an optional sideways disturbance."""

    phase: Literal["retract"]
    distance: MillimetresOrRef
    speed: SpeedOrRef
    disturbance: Disturbance | None = None


class TwistPhase(StrictModel):
    """A rotation of the sensor about the plate's normal, through its centre, in contact."""

    phase: Literal["twist"]
    angle: DegreesOrRef
    """Counterclockwise as the outside camera sees it; clockwise if negative."""
    speed: DegreesPerSecondOrRef


class PlateMotion(StrictModel):
    """Something done to the sliding plate."""

    phase: Literal["plate"]
    action: Literal["raise", "release", "catch"]
    duration: SecondsOrRef = Decimal(0)


class Place(StrictModel):
    """A place in plate coordinates, or a way; what is left out stays as it is."""

    x: AnyMillimetresOrRef | None = None
    """To the right, along the plate."""
    y: AnyMillimetresOrRef | None = None
    """Up, along the plate."""
    depth: AnyMillimetresOrRef | None = None
    """Into the plate: the indentation of the highest papilla, negative clear of the plate."""

    @rule
    def _somewhere(self) -> Place:
        if self.x is None and self.y is None and self.depth is None:
            raise ValueError("is empty; give x, y or depth")
        return self


class Travel(StrictModel):
    """A straight move to a place, or by a way from where the sensor is.

    Between press and release it is a motion in contact: recorded, and slip is looked for in it.
    """

    phase: Literal["move"]
    to: Place | None = None
    by: Place | None = None
    speed: SpeedOrRef

    @rule
    def _one(self) -> Travel:
        if (self.to is None) == (self.by is None):
            raise ValueError("must have either 'to' or 'by'")
        return self


class Release(StrictModel):
    """Out along the normal until clear of the plate."""

    phase: Literal["release"]
    clearance: MillimetresOrRef
    speed: SpeedOrRef


class Return(StrictModel):
    """Back to above the plate's centre."""

    phase: Literal["return"]
    speed: SpeedOrRef


_PHASES = (
    "approach",
    "press",
    "hold",
    "slide",
    "retract",
    "twist",
    "plate",
    "move",
    "release",
    "return",
)
register_tags(*_PHASES)
Phase = Annotated[
    Approach
    | Press
    | HoldPhase
    | Slide
    | Retract
    | TwistPhase
    | PlateMotion
    | Travel
    | Release
    | Return,
    Field(discriminator="phase"),
]
