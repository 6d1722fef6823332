"""The `calibration:` section of a rig file: measurements on the rig, and how long each holds.

`sliplab teach` and `sliplab calibrate` write its entries, each with the day, the residual and the
method; `sliplab check` refuses what is missing or too old (docs/calibration.md).
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection
from dataclasses import dataclass
from datetime import date
from typing import Annotated, Any

from pydantic import BeforeValidator, Field, WithJsonSchema, model_validator

from sliplab.protocols.quantity import parse, quantity_schema
from sliplab.protocols.yaml_file import StrictModel


def _mm(raw: object) -> float:
    return float(parse(raw, "mm"))


def _px(raw: object) -> float:
    return float(parse(raw, "px"))


def _deg(raw: object) -> float:
    return float(parse(raw, "deg"))


_DAYS = re.compile(r"\s*(\d{1,5})\s*d\s*")


def _days(raw: object) -> int:
    match = _DAYS.fullmatch(raw) if isinstance(raw, str) else None
    if match is None:
        raise ValueError("must be a whole number of days, such as '30 d', or null: no limit")
    return int(match[1])


Millimetre = Annotated[float, BeforeValidator(_mm), WithJsonSchema(quantity_schema("mm"))]
Pixel = Annotated[float, BeforeValidator(_px), WithJsonSchema(quantity_schema("px"))]
Degree = Annotated[float, BeforeValidator(_deg), WithJsonSchema(quantity_schema("deg"))]
Days = Annotated[
    int,
    BeforeValidator(_days),
    WithJsonSchema({"type": "string", "pattern": f"^{_DAYS.pattern}$", "examples": ["30 d"]}),
]
Point = tuple[Millimetre, Millimetre, Millimetre]
Coefficient = Annotated[float, Field(ge=-1e6, le=1e6)]
Method = Annotated[str, Field(min_length=1, max_length=120)]


class ContactPlane(StrictModel):
    """The plate, taught by touching three points with the sensor's centre papilla."""

    centre: Point
    right: Point
    """Any point at least 5 mm to the right of the centre, as the sensor sees the plate."""
    above: Point
    """Any point at least 5 mm above the centre."""
    taught: date
    residual: Millimetre | None = None
    """Distance of a fourth touch from the plane of the three."""
    method: Method | None = None

    @model_validator(mode="after")
    def _spans(self) -> ContactPlane:
        """Three points that are a plane; the frame itself is made by `rigs.core.plate_frame`."""
        right, above = (
            [b - a for a, b in zip(self.centre, point, strict=True)]
            for point in (self.right, self.above)
        )
        lengths = math.hypot(*right), math.hypot(*above)
        if min(lengths) < 5.0:
            raise ValueError("needs points at least 5 mm from the centre")
        cosine = sum(a * b for a, b in zip(right, above, strict=True)) / (lengths[0] * lengths[1])
        if abs(cosine) > 0.98:
            raise ValueError("has its three points almost on one line")
        return self


class DepthZero(StrictModel):
    """Depth at which the skin first touches, measured from the contact plane into the plate."""

    zero: Millimetre
    """Depth zero with which the rig begins; a protocol's `rezero` finds it again."""
    by_events: Millimetre | None = None
    by_markers: Millimetre | None = None
    difference: Millimetre | None = None
    """By events minus by markers."""
    taught: date
    residual: Millimetre
    """Half the range of repeated touches, or half the difference, whichever is more."""
    method: Method


class ToolCentrePoint(StrictModel):
    """Place of the centre papilla's tip on the tool, by pivoting about a fixed point."""

    offset: Point
    """From the flange, in the flange's axes: what the controller's tool has to be."""
    pivot: Point
    """The fixed point, in the arm's base frame."""
    poses: int = Field(ge=4, le=10_000)
    taught: date
    residual: Millimetre
    """Root mean square distance of the tip from the fixed point."""
    method: Method


class Lens(StrictModel):
    """The outside camera: pinhole and Brown's distortion, as OpenCV writes them."""

    scale_px_per_mm: float = Field(gt=0, le=200)
    """On the plate's plane, at the picture's centre."""
    focal: tuple[Pixel, Pixel]
    centre: tuple[Pixel, Pixel]
    """Principal point: the optical axis in the picture."""
    distortion: tuple[Coefficient, Coefficient, Coefficient, Coefficient, Coefficient]
    """k1, k2, p1, p2, k3."""
    tilt: Degree
    """Between the plate and the picture."""
    size: tuple[Pixel, Pixel]
    """Of the pictures that it was measured in: width, height."""
    views: int = Field(ge=1, le=10_000)
    measured: date
    residual: Pixel
    """Root mean square distance of corners from where the model puts them."""
    method: Method


class EventCrop(StrictModel):
    """Place of the skin in the event camera's picture."""

    centre: tuple[Pixel, Pixel]
    """Column, row."""
    size: Pixel
    """Side of the square that holds the skin."""
    measured: date
    residual: Pixel
    """Distance between the centres found in two halves of the recording."""
    method: Method


class MaxAge(StrictModel):
    """The age that each entry may have; null: it may be any age, and may be missing."""

    contact_plane: Days | None = 30
    depth_zero: Days | None = 1
    tool_centre_point: Days | None = 180
    lens: Days | None = 90
    event_crop: Days | None = 180


class Calibration(StrictModel):
    """Measurements on this rig."""

    contact_plane: ContactPlane
    touch_depth: Millimetre = 0.0
    """Depth of the centre papilla when touching off notices it, found once with a gauge."""
    depth_zero: DepthZero | None = None
    tool_centre_point: ToolCentrePoint | None = None
    lens: Lens | None = None
    event_crop: EventCrop | None = None
    max_age: MaxAge = MaxAge()

    @property
    def zero_mm(self) -> float:
        """Depth zero that a rig begins with."""
        return 0.0 if self.depth_zero is None else self.depth_zero.zero

    @property
    def centre_px(self) -> tuple[float, float] | None:
        """Return where the event camera sees the skin's centre; None: nobody has looked."""
        return None if self.event_crop is None else self.event_crop.centre


COMMANDS = {
    "contact_plane": "sliplab teach plane",
    "depth_zero": "sliplab teach zero",
    "tool_centre_point": "sliplab teach tool",
    "lens": "sliplab calibrate lens",
    "event_crop": "sliplab calibrate crop",
}
"""Commands by the entry that they calibrate."""
_SAME_SCALE = 1e-3


@dataclass(frozen=True)
class CalibrationFault:
    """An entry that cannot be relied on: its key, what stands there, and what would be right."""

    key: str
    value: str | None
    expected: str
    command: str
    """Return the command that calibrates it, without ``--rig``."""


def find_faults(
    calibration: Calibration,
    *,
    simulated: bool,
    needed: Collection[str],
    scale_px_per_mm: float,
    today: date,
) -> list[CalibrationFault]:
    """Entries that are missing, too old, or contradict each other.

    An age that the rig file itself gives under `max_age` counts for any rig, and its entry must be
    there. The defaults count for real rigs only, and there for what is `needed`.

    Args:
        needed: names of the entries that the plan at hand relies on.
        scale_px_per_mm: of the frame camera as the rig file has it.
        today: the day from which ages count.
    """
    found = []
    for name in COMMANDS:
        limit: int | None = getattr(calibration.max_age, name)
        stated = name in calibration.max_age.model_fields_set
        if limit is None or not (stated or (name in needed and not simulated)):
            continue
        fault = _too_old(name, getattr(calibration, name), limit, today)
        found += [fault] if fault else []
    zero, plane = calibration.depth_zero, calibration.contact_plane
    if zero is not None and zero.taught < plane.taught:
        text = f"was found before the plane was taught anew on {plane.taught}"
        found.append(_mend("depth_zero", "taught", str(zero.taught), text))
    lens = calibration.lens
    if lens is not None and abs(scale_px_per_mm / lens.scale_px_per_mm - 1.0) > _SAME_SCALE:
        found.append(
            CalibrationFault(
                "frame_camera.scale_px_per_mm",
                f"{scale_px_per_mm:g}",
                f"must be calibration.lens.scale_px_per_mm = {lens.scale_px_per_mm:g}, or the "
                "lens is another",
                COMMANDS["lens"],
            )
        )
    return found


def measured_on(calibration: Calibration, name: str) -> date | None:
    """The day of an entry; None where there is none."""
    entry = getattr(calibration, name)
    day: date | None = getattr(entry, "taught", None) or getattr(entry, "measured", None)
    return day


def _too_old(name: str, entry: Any, limit: int, today: date) -> CalibrationFault | None:
    if entry is None:
        return CalibrationFault(f"calibration.{name}", None, "is missing", COMMANDS[name])
    key = "taught" if hasattr(entry, "taught") else "measured"
    day: date = getattr(entry, key)
    age = (today - day).days
    if age > limit:
        text = f"is {age} d old, calibration.max_age.{name} allows {limit} d"
        return _mend(name, key, str(day), text)
    if age < -1:  # a day is not the same everywhere
        return _mend(name, key, str(day), f"lies in the future, today is {today}")
    return None


def _mend(name: str, key: str, value: str, text: str) -> CalibrationFault:
    return CalibrationFault(f"calibration.{name}.{key}", value, text, COMMANDS[name])


def without_taught(data: dict[str, Any]) -> dict[str, Any]:
    """A rig file's data without where the plate was found to be, and without ages.

    Both are found again in the course of a campaign and make no other rig: coordinates are the
    plate's. Scale and lens stay: what is measured in pictures depends on them.
    """
    calibration = data.get("calibration")
    if not isinstance(calibration, dict):
        return data
    moved = {"contact_plane", "depth_zero", "max_age"}
    kept = {key: value for key, value in calibration.items() if key not in moved}
    return {**data, "calibration": kept}
