"""Two clocks by taps that two signals show: arrays or CSV files; the onsets are found here."""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sliplab.analysis.clocks.pulse_match import NoMatchError
from sliplab.analysis.clocks.taps import TapMap, find_taps, map_by_taps
from sliplab.plugins.align.align import MAX_DRIFT_PPM, WITHIN_S, AlignmentRefused, MappedTimes
from sliplab.plugins.align.events import Floats, Ints, events_from, signal_of_csv
from sliplab.protocols.errors import InputError


@dataclass(frozen=True)
class TapAlignment:
    """The map from clock A to clock B by taps; see `sliplab.analysis.clocks.taps`."""

    found: TapMap

    def map(self, times: ArrayLike, unit: str | None = None) -> MappedTimes:
        """Map times of clock A to clock B, as `Alignment.map` does; every time is known."""
        ns = events_from(times, "times", unit).ns
        low, high = self.found.bounds(ns)
        within = (ns >= self.found.first_ns) & (ns <= self.found.last_ns)
        every, none = np.ones(ns.size, np.bool_), np.zeros(ns.size, np.bool_)
        return MappedTimes(low + (high - low) // 2, low, high, every, within, none)

    def to_json(self) -> dict[str, Any]:
        """Return the summary that ``sliplab align --taps --json`` prints."""
        at = self.found.first_ns
        low, high = (int(each[0]) for each in self.found.bounds(np.array([at])))
        return {
            "paired_by": "taps",
            "taps": self.found.taps,
            "first_ns": at,
            "last_ns": self.found.last_ns,
            "offset_ns": (low + high) // 2 - at,
            "half_ns": (high - low) // 2,
            "drift_ppm": list(self.found.drift_ppm),
        }


def align_taps(
    a: Any,
    b: Any,
    *,
    offset_s: float | None = None,
    within_s: float = WITHIN_S,
    max_drift_ppm: float = MAX_DRIFT_PPM,
    unit: str | None = None,
) -> TapAlignment:
    """Fit the map from clock A to clock B, from sharp taps that two sensors felt.

    Args:
        a, b: signals: a CSV file with a column of times and others of numbers; or a pair of times
            (n,), floats in s or integers in ns, and values (n,) or (n, axes).
        offset_s: B less A, approximately; without it both must show equally many taps.
        within_s: by how much `offset_s` may be wrong.
        max_drift_ppm: largest difference of the clocks' rates.
        unit: of the times, if another one.

    Raises:
        AlignmentRefused: no clear tap, none in common, or taps that contradict each other.
        InputError: a file or values that cannot be right.
    """
    near = None if offset_s is None else (round(offset_s * 1e9), round(within_s * 1e9))
    try:
        first, second = (
            find_taps(name, *_signal(each, name, unit)) for each, name in ((a, "A"), (b, "B"))
        )
        return TapAlignment(map_by_taps(first, second, max_drift_ppm, near))
    except NoMatchError as error:
        raise AlignmentRefused(error.reason, str(error)) from None


def _signal(source: Any, name: str, unit: str | None) -> tuple[Ints, Floats]:
    if isinstance(source, str | PathLike):
        t_ns, values = signal_of_csv(Path(source), unit)
        name = str(source)
    else:
        try:
            times, given = source
            values = np.asarray(given, np.float64)
        except (TypeError, ValueError):
            right = "must be a CSV file, or a pair of times and values of numbers"
            raise InputError(name, "", None, right) from None
        t_ns = events_from(times, name, unit).ns
    if not values.size:
        raise InputError(name, "values", None, "has no samples")
    if values.ndim not in {1, 2} or len(values) != len(t_ns):
        raise InputError(name, "values", values.shape, f"must have {len(t_ns)} rows, one a time")
    if np.any(np.diff(t_ns) < 0):
        k = int(np.flatnonzero(np.diff(t_ns) < 0)[0]) + 1
        raise InputError(
            name, f"sample {k + 1}", f"{t_ns[k] / 1e9:.9g} s", "falls back behind the one before"
        )
    if not np.isfinite(values).all():
        k = int(np.flatnonzero(~np.isfinite(values.reshape(len(values), -1)).all(axis=1))[0])
        raise InputError(name, f"sample {k + 1}", "", "must be finite numbers")
    return t_ns, values
