"""A detector by papillae as its calibration on a skin says."""

from __future__ import annotations

from pathlib import Path

from sliplab.analysis.detectors.papillae import VERSION, Papillae, PapillaeSettings
from sliplab.protocols.errors import InputError
from sliplab.storage.files import read_json
from sliplab.storage.schema.detector import DetectorCalibration
from sliplab.storage.schema.document import DocumentError, NewerFormat

SUFFIX = ".json"
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
    return found


def calibrated(found: DetectorCalibration) -> Papillae:
    """Return the detector of a calibration; alarms are above its `level`."""
    size_px = found.width_px, found.height_px
    return Papillae(PapillaeSettings(size_px, found.hot, found.fewest_places))
