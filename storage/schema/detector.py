"""A detector's calibration on one skin, as `sliplab calibrate detector` writes it."""

from __future__ import annotations

from sliplab.storage.schema.document import Bool, Document, Int, Number, Part
from sliplab.storage.schema.evaluation import AlarmRate


class PapillaPlace(Part):
    """A place in the event camera's image that moved in a rub: a marker's edge, or part of it."""

    x_px: Number
    y_px: Number
    cells: Int
    rate_hz: Number
    """Events of the place in a quarter of a second, by the second."""


class Rub(Part):
    """A short slide over the plate."""

    direction_deg: Number
    places: Int
    """Most places that moved at once before the first evidence."""
    largest: Number
    """Largest evidence."""
    alarm_ms: Number | None
    """First evidence above the level, after the slide's command; null where none was."""


class DetectorCalibration(Document):
    """Level, hot cells and places of one skin, for the detector by papillae."""

    format: Int = 1
    detector: str
    """Its name."""
    version: Int
    """Of the detector: another one needs another calibration."""
    rig: str
    skin: str
    """Serial number."""
    camera: str | None = None
    """Serial number of the event camera; null where it reports none, and in older files."""
    simulated: Bool
    measured: str
    """Day, 2026-11-29."""
    width_px: Int
    height_px: Int
    cell_px: Int
    """Side of a cell; cells are counted row by row."""
    noise_hz: Number
    """Events a second of the median cell at rest."""
    hot: tuple[Int, ...]
    """Cells that give events at rest; they are left out."""
    fewest_places: Int
    """Places that move at once in a slide."""
    places: tuple[PapillaPlace, ...]
    """Just before the first evidence, of the rub with the most; the detector finds its places anew,
    as markers move."""
    level: Number
    """Evidence above it is an alarm: at least the largest one of hold and unload."""
    hold: AlarmRate
    """False alarms at the level while nothing moved. Its upper end is what is promised."""
    hold_largest: Number
    unload_largest: Number
    depth_mm: Number
    speed_mm_s: Number
    """Of the rubs."""
    rubs: tuple[Rub, ...]
