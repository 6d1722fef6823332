"""The `calibration:` section of a rig file: measurements on the rig, and their validity.

`sliplab teach` and `sliplab calibrate` write its entries, each with the day, the residual and the
method; `sliplab check` refuses missing and outdated entries (docs/calibration.md).
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection
from dataclasses import dataclass
from datetime import date
from typing import Annotated, Any

from pydantic import BeforeValidator, Field, WithJsonSchema

from sliplab.protocols.quantity import parse, quantity_schema
from sliplab.protocols.yaml_file import StrictModel, rule


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

    @rule
    def _spans(self) -> ContactPlane:
        """Check that the points span a plane; `rigs.core.plate_frame` builds the frame."""
        right, above = (
            [b - a for a, b in zip(self.centre, point, strict=True)]
            for point in (self.right, self.above)
        )
        lengths = math.hypot(*right), math.hypot(*above)
        if min(lengths) < 5.0:
            raise ValueError("points must be at least 5 mm from the centre")
        cosine = sum(a * b for a, b in zip(right, above, strict=True)) / (lengths[0] * lengths[1])
        if abs(cosine) > 0.98:
            raise ValueError("the three points lie almost on one line")
        return self


class DepthZero(StrictModel):
    """Depth at which the skin first touches, measured from the contact plane into the plate."""

    zero: Millimetre
    """Depth zero when the rig starts; a protocol's `rezero` measures it again."""
    by_events: Millimetre | None = None
    by_markers: Millimetre | None = None
    difference: Millimetre | None = None
    """By events minus by markers."""
    taught: date
    residual: Millimetre
    """Half the range of repeated touches, or half the difference, whichever is larger."""
    method: Method


class ToolCentrePoint(StrictModel):
    """Place of the centre papilla's tip on the tool, by pivoting about a fixed point."""

    offset: Point
    """Offset from the flange, in the flange's axes: the value to set as the controller's tool."""
    pivot: Point
    """The fixed point, in the arm's base frame."""
    poses: int = Field(ge=4, le=10_000)
    taught: date
    residual: Millimetre
    """Root mean square distance of the tip from the fixed point."""
    method: Method


class LensCalibration(StrictModel):
    """The outside camera: pinhole model with Brown distortion, in OpenCV's convention."""

    scale_px_per_mm: float = Field(gt=0, le=200)
    """Scale on the plate's plane, at the image centre."""
    focal: tuple[Pixel, Pixel]
    centre: tuple[Pixel, Pixel]
    """Principal point: the optical axis in the image."""
    distortion: tuple[Coefficient, Coefficient, Coefficient, Coefficient, Coefficient]
    """k1, k2, p1, p2, k3."""
    tilt: Degree
    """Angle between the plate and the image plane."""
    size: tuple[Pixel, Pixel]
    """Width and height of the images used."""
    views: int = Field(ge=1, le=10_000)
    measured: date
    residual: Pixel
    """Root mean square reprojection error of the corners."""
    method: Method


class EventCrop(StrictModel):
    """Position of the skin in the event camera's image."""

    centre: tuple[Pixel, Pixel]
    """Column, row."""
    size: Pixel
    """Side of the square that holds the skin."""
    measured: date
    residual: Pixel
    """Distance between the centres found in two halves of the recording."""
    method: Method


class MaxAge(StrictModel):
    """Maximum age of each entry; null: any age, and the entry may be missing."""

    contact_plane: Days | None = 30
    depth_zero: Days | None = 1
    tool_centre_point: Days | None = 180
    lens: Days | None = 90
    event_crop: Days | None = 180


class Calibration(StrictModel):
    """Measurements on this rig."""

    contact_plane: ContactPlane
    touch_depth: Millimetre = 0.0
    """Depth of the centre papilla when touching off detects it, measured once with a gauge."""
    depth_zero: DepthZero | None = None
    tool_centre_point: ToolCentrePoint | None = None
    lens: LensCalibration | None = None
    event_crop: EventCrop | None = None
    max_age: MaxAge = MaxAge()

    @property
    def zero_mm(self) -> float:
        """Depth zero when a rig starts."""
        return 0.0 if self.depth_zero is None else self.depth_zero.zero

    @property
    def centre_px(self) -> tuple[float, float] | None:
        """Return the skin's centre in the event camera's image; None if not measured."""
        return None if self.event_crop is None else self.event_crop.centre


COMMANDS = {
    "contact_plane": "sliplab teach plane",
    "depth_zero": "sliplab teach zero",
    "tool_centre_point": "sliplab teach tool",
    "lens": "sliplab calibrate lens",
    "event_crop": "sliplab calibrate crop",
}
"""The command that calibrates each entry."""
_SAME_SCALE = 1e-3


@dataclass(frozen=True)
class CalibrationFault:
    """An invalid entry: its key, its value, and the value that would be right."""

    key: str
    value: str | None
    expected: str
    command: str
    """Command that calibrates it, without ``--rig``."""


def find_faults(
    calibration: Calibration,
    *,
    simulated: bool,
    needed: Collection[str],
    scale_px_per_mm: float,
    today: date,
) -> list[CalibrationFault]:
    """Return the entries that are missing, too old, or contradict each other.

    An age that the rig file itself states under `max_age` applies to any rig, and its entry must
    exist. The defaults apply to real rigs only, and only to entries that are `needed`.

    Args:
        needed: names of the entries that the plan relies on.
        scale_px_per_mm: scale of the frame camera in the rig file.
        today: the day on which ages are computed.
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
        text = f"was found before the plane was taught again on {plane.taught}"
        found.append(_fault("depth_zero", "taught", str(zero.taught), text))
    lens = calibration.lens
    if lens is not None and abs(scale_px_per_mm / lens.scale_px_per_mm - 1.0) > _SAME_SCALE:
        found.append(
            CalibrationFault(
                "frame_camera.scale_px_per_mm",
                f"{scale_px_per_mm:g}",
                f"must be calibration.lens.scale_px_per_mm = {lens.scale_px_per_mm:g}, unless the "
                "lens was replaced",
                COMMANDS["lens"],
            )
        )
    return found


def measured_on(calibration: Calibration, name: str) -> date | None:
    """Return the day of an entry; None if there is none."""
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
        return _fault(name, key, str(day), text)
    if age < -1:  # time zones differ by up to a day
        return _fault(name, key, str(day), f"is in the future; today is {today}")
    return None


def _fault(name: str, key: str, value: str, text: str) -> CalibrationFault:
    return CalibrationFault(f"calibration.{name}.{key}", value, text, COMMANDS[name])


ON_THE_SKIN = ("tool_centre_point", "depth_zero", "event_crop")
"""Entries that depend on the skin, as `touch_depth` does."""


def without_skin(data: dict[str, Any]) -> dict[str, Any]:
    """Return a rig file's data without the skin's own number and what was measured on it."""
    skin = {key: value for key, value in data["skin"].items() if key not in {"serial", "made"}}
    of_skin = {*ON_THE_SKIN, "touch_depth"}
    retained = {k: v for k, v in data["calibration"].items() if k not in of_skin}
    return {**data, "skin": {"serial": "-", **skin}, "calibration": retained}


def without_taught(data: dict[str, Any]) -> dict[str, Any]:
    """Return a rig file's data without the plate's taught position and without ages.

    Both are measured again during a campaign and do not make it another rig: coordinates are
    relative to the plate. Scale and lens stay, because measurements in images depend on them.
    """
    calibration = data.get("calibration")
    if not isinstance(calibration, dict):
        return data
    moved = {"contact_plane", "depth_zero", "max_age"}
    retained = {key: value for key, value in calibration.items() if key not in moved}
    return {**data, "calibration": retained}
