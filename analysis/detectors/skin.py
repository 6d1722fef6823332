"""A detector by papillae as its calibration on a skin says."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import suppress
from datetime import date
from pathlib import Path

from sliplab.analysis.detectors.alarms import BOUND_OF_NONE
from sliplab.analysis.detectors.papillae import LEAST, VERSION, Papillae, PapillaeSettings
from sliplab.protocols.errors import InputError
from sliplab.storage.files import read_json
from sliplab.storage.schema.detector import DetectorCalibration
from sliplab.storage.schema.document import DocumentError, NewerFormat

SUFFIX = ".json"
LONGEST_H = 10.1
"""Longest hold that a calibration makes, h."""
NAME = "papillae"


def is_calibration(path: Path) -> bool:
    """Return whether a file is a calibration; a network's description is JSON, too."""
    try:
        return path.suffix == SUFFIX and "detector" in read_json(path)
    except (OSError, ValueError):
        return False


def load_calibration(path: Path) -> DetectorCalibration:
    """Read a calibration.

    Raises:
        InputError: it cannot be read, or is of another detector.
    """
    try:
        found = DetectorCalibration.load(path)
    except OSError as error:
        raise InputError(path, "", None, f"cannot be read: {error.strerror}") from None
    except (DocumentError, NewerFormat) as error:
        raise InputError(path, "", None, str(error).removeprefix(f"{path}: ")) from None
    for key, value, right in (
        ("detector", found.detector, NAME),
        ("version", found.version, VERSION),
    ):
        if value != right:
            text = f"must be {right}: run `sliplab calibrate detector` again"
            raise InputError(path, key, value, text)
    for name, seen, held, must in _rules(found):
        if not held:
            raise InputError(path, name, seen, f"{must}: the file was changed, measure again")
    return found


def _rules(found: DetectorCalibration) -> Iterator[tuple[str, object, bool, str]]:
    """Yield a key, its value, whether it can be what was measured, and what would be right."""
    width, height, hold = found.width_px, found.height_px, found.hold
    day = None
    with suppress(ValueError):
        day = date.fromisoformat(found.measured)
    yield "measured", found.measured, day is not None, "must be a day, such as 2026-11-29"
    sizes = min(width, height, found.cell_px) > 0
    yield "cell_px", found.cell_px, sizes, "cells and sensor must have a size"
    cells = -(-width // found.cell_px) * -(-height // found.cell_px)
    yield (
        "hot",
        list(found.hot),
        all(0 <= it < cells for it in found.hot),
        f"must be from 0 to {cells - 1}",
    )
    fewest = found.fewest_places
    yield "fewest_places", fewest, fewest > 0, "must be at least 1"
    places = found.places
    yield "places", len(places), len(places) > 0, "some must have moved"
    inside = all(0 <= it.x_px <= width and 0 <= it.y_px <= height for it in places)
    yield "places", len(places), inside, f"must lie within {width} x {height} pixels"
    level = max(LEAST, found.hold_largest, found.unload_largest)
    yield "level", found.level, found.level == level, f"must be {level:g}, of hold and unload"
    yield (
        "hold.hours",
        hold.hours,
        0 < hold.hours <= LONGEST_H,
        f"must be above 0, at most {LONGEST_H:g}",
    )
    high = BOUND_OF_NONE / hold.hours
    shown = hold.high is not None and math.isclose(hold.high, high, rel_tol=1e-6)
    yield "hold.high", hold.high, shown, f"so many hours without an alarm show {high:.3g}"


def calibrated(found: DetectorCalibration) -> Papillae:
    """Return the detector of a calibration; alarms are above its `level`."""
    size_px = found.width_px, found.height_px
    return Papillae(PapillaeSettings(size_px, found.hot, found.fewest_places))
