"""One straight line from a device's clock to the sync box's, in exact integers.

A trial's streams are stamped by clocks that count from different days and run at slightly
different speeds. The raw stamps are never rewritten; a `ClockMap` stored beside them says what they
mean. Absolute times near 2**62 ns do not fit a float64 (its step there is 1024 ns), so nothing here
turns a time into a float.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

BILLION = 1_000_000_000
MAX_DRIFT_PPB = 100_000_000
"""10 %: far beyond any clock, and what keeps every product below inside an int64."""

_INT64 = np.iinfo(np.int64)


@dataclass(frozen=True)
class ClockMap:
    """Device time to reference time: ``ref = reference_anchor + d + d * drift_ppb / 1e9``.

    ``d = device - device_anchor``; the last term is rounded to the nearest nanosecond, halves
    upwards, and is exact for every int64. The map never reverses the order of two times; with a
    negative drift two neighbouring nanoseconds may fall on one.

    Attributes:
        device_anchor_ns: a time on the device's clock, ns.
        reference_anchor_ns: the same instant on the reference clock, ns.
        drift_ppb: what the reference gains on the device, parts per billion, at most 10 %.

    Raises:
        TypeError: a field is not an integer.
        ValueError: a field is outside int64, or the drift is over 10 %.
    """

    device_anchor_ns: int
    reference_anchor_ns: int
    drift_ppb: int

    def __post_init__(self) -> None:
        for name in ("device_anchor_ns", "reference_anchor_ns", "drift_ppb"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int | np.integer):
                raise TypeError(f"ClockMap.{name} = {value!r}: must be an integer")
            if not _INT64.min <= value <= _INT64.max:
                raise ValueError(f"ClockMap.{name} = {value}: does not fit an int64")
            object.__setattr__(self, name, int(value))
        if abs(self.drift_ppb) > MAX_DRIFT_PPB:
            raise ValueError(
                f"ClockMap.drift_ppb = {self.drift_ppb}: must lie within ±{MAX_DRIFT_PPB} (10 %)"
            )

    @overload
    def to_reference(self, times: int) -> int: ...
    @overload
    def to_reference(self, times: NDArray[np.integer[Any]]) -> NDArray[np.int64]: ...
    def to_reference(self, times: int | NDArray[np.integer[Any]]) -> int | NDArray[np.int64]:
        """Device times as reference times, ns.

        Args:
            times: one integer, or an integer array of any shape, ns on the device's clock.

        Returns:
            an int, or an int64 array of the same shape, ns on the reference clock.

        Raises:
            TypeError: not integers.
            OverflowError: a time or its image is outside int64.
        """
        return _apply(
            times,
            self.device_anchor_ns,
            self.reference_anchor_ns,
            BILLION,
            BILLION + self.drift_ppb,
        )

    @overload
    def to_device(self, times: int) -> int: ...
    @overload
    def to_device(self, times: NDArray[np.integer[Any]]) -> NDArray[np.int64]: ...
    def to_device(self, times: int | NDArray[np.integer[Any]]) -> int | NDArray[np.int64]:
        """Reference times as device times, ns: the inverse, rounded to the nearest nanosecond.

        There and back differs from the start by at most 1 ns, either way round. Arguments,
        results and errors as in `to_reference`.
        """
        return _apply(
            times,
            self.reference_anchor_ns,
            self.device_anchor_ns,
            BILLION + self.drift_ppb,
            BILLION,
        )

    def then(self, after: ClockMap) -> ClockMap:
        """This map followed by `after`, as one map.

        The drift is rounded to whole ppb, so away from this map's anchor it may differ from the two
        steps by 0.5 ns a second, besides 2 ns of rounding.
        """
        product = self.drift_ppb * after.drift_ppb
        return ClockMap(
            self.device_anchor_ns,
            after.to_reference(self.reference_anchor_ns),
            self.drift_ppb + after.drift_ppb + (product + BILLION // 2) // BILLION,
        )

    def to_json(self) -> dict[str, int]:
        """The three fields as a dict of Python ints (a JSON reader must not use floats)."""
        return {
            "device_anchor_ns": self.device_anchor_ns,
            "reference_anchor_ns": self.reference_anchor_ns,
            "drift_ppb": self.drift_ppb,
        }

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> ClockMap:
        """The map that `to_json` wrote.

        Raises:
            ValueError: a field is missing or unknown, or out of range.
            TypeError: a field is not an integer.
        """
        names = {"device_anchor_ns", "reference_anchor_ns", "drift_ppb"}
        if set(data) != names:
            raise ValueError(f"a clock map has the fields {sorted(names)}, not {sorted(data)}")
        return cls(**{name: data[name] for name in names})


IDENTITY = ClockMap(0, 0, 0)
"""The reference clock's own map."""


def _apply(
    times: int | NDArray[np.integer[Any]], anchor: int, image: int, unit: int, scaled: int
) -> int | NDArray[np.int64]:
    """``image + (times - anchor) * scaled / unit``, rounded half up.

    With d = q * unit + r the product is q * scaled + r * scaled / unit; r < unit, so that
    r * scaled stays below 1.1e18 and nothing has to be wider than 64 bits.
    """
    if isinstance(times, int | np.integer) and not isinstance(times, bool):
        quotient, rest = divmod(int(times) - anchor, unit)
        return _fits(image + quotient * scaled + (rest * scaled * 2 + unit) // (2 * unit))
    array = np.asarray(times)
    if array.dtype.kind not in "iu" or not np.can_cast(array.dtype, np.int64):
        raise TypeError(f"times must be int64, not {array.dtype}: floats lose nanoseconds")
    if array.size == 0:
        return np.empty(array.shape, np.int64)
    # the map is monotonic: when both ends fit, everything between them does
    for end in (int(array.min()), int(array.max())):
        _fits(end - anchor)
        _fits(_apply(end, anchor, image, unit, scaled) - image)
    offset = array.astype(np.int64) - anchor
    quotients = offset // unit
    offset -= quotients * unit
    offset *= scaled
    # halves up without doubling: unit is even or, after an odd drift, no half exists
    offset += unit // 2
    offset //= unit
    offset += quotients * scaled
    offset += image
    return offset


def _fits(value: Any) -> int:
    if not _INT64.min <= value <= _INT64.max:
        raise OverflowError(f"the time {value} ns does not fit an int64")
    return int(value)
