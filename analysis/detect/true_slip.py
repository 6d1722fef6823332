"""Begin, gross onset and end of a trial's true slip, by which every detection is judged.

Incipient slip ends where gross slip begins, and gross slip ends where the sensor and the plate stop
moving on each other. A detection after that warns of nothing: it is late, however long the
recording goes on. Each evaluation, choice and search asks the two functions here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

NEVER = int(np.iinfo(np.int64).max)
"""The time of what was not detected, where times are held in an array."""


@dataclass(frozen=True)
class TrueSlip:
    """True onsets and end of a trial's slip, nanoseconds on the time line of its windows.

    Attributes:
        incipient_ns, gross_ns: the onsets.
        end_ns: where gross slip ended.

    Raises:
        ValueError: not in this order.
    """

    incipient_ns: int
    gross_ns: int
    end_ns: int

    def __post_init__(self) -> None:
        """The three are in order, or refused."""
        if self.gross_ns < self.incipient_ns:
            raise ValueError(
                f"gross onset {self.gross_ns} ns is before incipient onset {self.incipient_ns} ns"
            )
        if self.end_ns < self.gross_ns:
            raise ValueError(f"end {self.end_ns} ns is before gross onset {self.gross_ns} ns")


def true_slip(label: Mapping[str, Any]) -> TrueSlip | None:
    """The slip that a label tells of; None where it lacks an onset.

    Args:
        label: with ``incipient_ns``, ``gross_ns`` and ``end_ns``. A person may have set the gross
            onset after the end: the slip then ends as it begins.
    """
    incipient, gross = label["incipient_ns"], label["gross_ns"]
    if incipient is None or gross is None:
        return None
    return TrueSlip(incipient, gross, max(label["end_ns"], gross))


def is_false_early(found_ns: Any, onset_ns: Any, tolerance_ns: Any) -> Any:
    """Check if a detection comes before the onset by MORE than the tolerance.

    Args:
        found_ns: an integer or an array of them, `NEVER` where nothing was detected; likewise:
        onset_ns: true onset.
        tolerance_ns: of a detection before it.
    """
    return found_ns < onset_ns - tolerance_ns


def is_late(found_ns: Any, end_ns: Any) -> Any:
    """Check if a detection comes at the end of its event or after it.

    Args:
        found_ns: an integer or an array of them, `NEVER` where nothing was detected (not late).
        end_ns: likewise: gross onset for incipient slip, the slip's end for gross slip.
    """
    return (found_ns >= end_ns) & (found_ns != NEVER)
