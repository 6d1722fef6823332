"""A device's clock to the sync box's, as straight lines that join, in exact integers.

A trial's streams are stamped by clocks that count from different days and run at slightly
different speeds. The raw stamps are never rewritten; a `ClockMap` stored with them gives their
meaning. Absolute times near 2**62 ns do not fit a float64 (its step there is 1024 ns), so nothing
here turns a time into a float.
"""

from __future__ import annotations

import bisect
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

BILLION = 1_000_000_000
DRIFT_UNITS = BILLION**2
"""A drift is counted in parts in 10^18: a line is then good to the nanosecond over 30 years, also
one that was made of two others."""
MAX_DRIFT = DRIFT_UNITS // 4
"""25 %: far beyond any clock, and what keeps every product below inside an int64."""

_LEAST, _MOST = -(2**63), 2**63 - 1
_FEW = 8
"""Number of times up to which mapping them one by one is faster."""


@dataclass(frozen=True)
class ClockMap:
    """Device time to reference time, piece by piece a straight line.

    On the piece of knot k, ``ref = reference_ns[k] + d + d * drift[k] / 10**18`` with
    ``d = device - device_ns[k]``; the last term is rounded to the nearest nanosecond, halves
    upwards, and is exact for every int64. Piece k reaches from its knot to the next one, the first
    and the last one on for ever. The map never reverses the order of two times; with a negative
    drift two neighbouring nanoseconds may fall on one.

    Attributes:
        device_ns: the knots on the device's clock, rising, ns. That of a straight line is any time.
        reference_ns: the same instants on the reference clock, ns.
        drift: what the reference gains on the device after each knot, parts in 10**18, at most
            25 %.

    Raises:
        TypeError: a field is not made of integers.
        ValueError: lengths differ, knots do not rise, a drift is over 25 %, or a piece does not
            end where the next one begins.
    """

    device_ns: tuple[int, ...]
    reference_ns: tuple[int, ...]
    drift: tuple[int, ...]

    def __post_init__(self) -> None:
        for name in ("device_ns", "reference_ns", "drift"):
            object.__setattr__(self, name, _integers(name, getattr(self, name)))
        if not len(self.device_ns) == len(self.reference_ns) == len(self.drift) > 0:
            raise ValueError("ClockMap: as many device_ns, reference_ns and drift, at least one")
        for value in self.drift:
            if abs(value) > MAX_DRIFT:
                raise ValueError(f"ClockMap.drift = {value}: must lie within ±{MAX_DRIFT} (25 %)")
        for k, (a, b) in enumerate(pairwise(self.device_ns)):
            if a >= b:
                raise ValueError(f"ClockMap.device_ns = {a}, {b}: knots must rise")
            end = self._line(k, b)
            # drifts end at 10**-18, which is a nanosecond over decades
            if abs(end - self.reference_ns[k + 1]) > (b - a) >> 58:
                raise ValueError(
                    f"ClockMap.reference_ns = {self.reference_ns[k + 1]}: the piece before ends "
                    f"at {end}"
                )

    @classmethod
    def line(cls, device_ns: int, reference_ns: int, drift_ppb: int = 0) -> ClockMap:
        """A straight line through one instant on both clocks; drift in parts per billion."""
        return cls((device_ns,), (reference_ns,), (drift_ppb * BILLION,))

    @classmethod
    def through(cls, device_ns: Sequence[int], reference_ns: Sequence[int]) -> ClockMap:
        """Straight lines through two or more instants on both clocks, ns, rising on both."""
        drift = []
        for (a, b), (c, d) in zip(pairwise(device_ns), pairwise(reference_ns), strict=True):
            # rounded so that the piece ends on the next knot
            drift.append((2 * (d - c - b + a) * DRIFT_UNITS + b - a) // (2 * (b - a)))
        return cls(tuple(device_ns[:-1]), tuple(reference_ns[:-1]), tuple(drift))

    def drift_ppm(self, device_ns: int | None = None) -> float:
        """Return the reference's rate offset at a time, ppm; by default the mean of all knots."""
        if device_ns is not None or len(self.drift) == 1:
            k = 0 if device_ns is None else self._piece(device_ns)
            return self.drift[k] / 1e12
        run = self.device_ns[-1] - self.device_ns[0]
        return (self.reference_ns[-1] - self.reference_ns[0] - run) / run * 1e6

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
        if type(times) is int or (
            isinstance(times, int | np.integer) and not isinstance(times, bool)
        ):
            return _fits(self._line(self._piece(int(times)), int(times)))
        array = _int64(times)
        if array.size <= _FEW:
            few = [_fits(self._line(self._piece(t), t)) for t in array.ravel().tolist()]
            return np.array(few, np.int64).reshape(array.shape)
        first = self._piece(int(array.min()))
        if first == self._piece(int(array.max())):
            return self._map(first, array)
        result = np.empty(array.shape, np.int64)
        piece = np.searchsorted(np.array(self.device_ns[1:]), array, side="right")
        for k in np.unique(piece).tolist():
            result[piece == k] = self._map(k, array[piece == k])
        return result

    @overload
    def to_device(self, times: int) -> int: ...
    @overload
    def to_device(self, times: NDArray[np.integer[Any]]) -> NDArray[np.int64]: ...
    def to_device(self, times: int | NDArray[np.integer[Any]]) -> int | NDArray[np.int64]:
        """Reference times as device times, ns: the inverse, rounded to the nearest nanosecond.

        There and back differs from the start by at most 1 ns, either way round, for times within
        nine years of the knots. Arguments, results and errors as in `to_reference`.
        """
        return self.inverse.to_reference(times)

    @cached_property
    def inverse(self) -> ClockMap:
        """The map from the reference clock to the device's."""
        # 1 / (1 + drift) - 1, rounded
        drift = tuple(-_round(value * DRIFT_UNITS, DRIFT_UNITS + value) for value in self.drift)
        return ClockMap(self.reference_ns, self.device_ns, drift)

    def then(self, after: ClockMap) -> ClockMap:
        """This map followed by `after`, as one map: within 3 ns of the two steps."""
        knots = sorted({*self.device_ns[1:], *(self.to_device(t) for t in after.device_ns[1:])})
        first = knots[0] - 1 if knots else self.device_ns[0]
        images = [after.to_reference(self.to_reference(knot)) for knot in knots or [first]]
        # before every knot both are on their first pieces, behind every knot on their last
        outer = [_both(self.drift[k], after.drift[k]) for k in (0, -1)]
        if not knots:
            return ClockMap((first,), tuple(images), (outer[0],))
        inner = ClockMap.through(tuple(knots), tuple(images)).drift if len(knots) > 1 else ()
        before = images[0] - 1 - _round(outer[0], DRIFT_UNITS)
        return ClockMap((first, *knots), (before, *images), (outer[0], *inner, outer[1]))

    def to_json(self) -> dict[str, list[int]]:
        """The three fields as lists of Python ints (a JSON reader must not use floats)."""
        return {name: list(getattr(self, name)) for name in ("device_ns", "reference_ns", "drift")}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> ClockMap:
        """The map that `to_json` wrote.

        Raises:
            ValueError: a field is missing or unknown, or out of range.
            TypeError: a field is not made of integers.
        """
        names = {"device_ns", "reference_ns", "drift"}
        if set(data) != names:
            raise ValueError(f"a clock map has the fields {sorted(names)}, not {sorted(data)}")
        return cls(**{name: tuple(data[name]) for name in names})

    def _piece(self, device: int) -> int:
        knots = self.device_ns
        return bisect.bisect_right(knots, device, 1) - 1 if len(knots) > 1 else 0

    def _line(self, k: int, device: int) -> int:
        """`device` on the line of piece k, in Python's integers."""
        d = device - self.device_ns[k]
        return self.reference_ns[k] + d + _round(d * self.drift[k], DRIFT_UNITS)

    def _map(self, k: int, times: NDArray[np.int64]) -> NDArray[np.int64]:
        """Times on the line of piece k, all in int64.

        With d = q 1e9 + r and drift = a 1e9 + b, d * drift / 1e18 is
        q a + (q b + r a + r b / 1e9) / 1e9, of which no term is wider than 64 bits.
        """
        anchor, image = self.device_ns[k], self.reference_ns[k]
        low, high = int(times.min()), int(times.max())
        # the map is monotonic: when both ends fit, everything between them does
        for end in (low, high):
            _fits(end - anchor)
            _fits(self._line(k, end))
        a, b = divmod(self.drift[k], BILLION)
        offset = times - anchor
        if max(abs(low - anchor), abs(high - anchor)) * (abs(a) + 1) < 1 << 62:
            # what is below 1e-9 of the last term's unit cannot change how the sum is rounded
            gained = offset * a
            if b:
                q = offset // BILLION
                gained += q * b + (offset - q * BILLION) * b // BILLION
            gained += BILLION // 2
            gained //= BILLION
        else:
            q, r = np.divmod(offset, BILLION)
            gained, rest = np.divmod(q * b, BILLION)
            more, small = np.divmod(r * a, BILLION)
            last, least = np.divmod(r * b, BILLION)
            up, rest = np.divmod(rest + small + last, BILLION)
            gained += q * a + more + up
            gained += rest * BILLION + least >= DRIFT_UNITS // 2
        offset += gained
        offset += image
        return offset


def _both(one: int, two: int) -> int:
    """The drift of two maps in a row, parts in 10**18."""
    return one + two + _round(one * two, DRIFT_UNITS)


def _round(value: int, unit: int) -> int:
    """``value / unit`` to the nearest integer, halves up."""
    return (2 * value + unit) // (2 * unit)


def _integers(name: str, values: Any) -> tuple[int, ...]:
    if isinstance(values, str) or not hasattr(values, "__iter__"):
        raise TypeError(f"ClockMap.{name} = {values!r}: must be integers")
    for value in values:
        if isinstance(value, bool) or not isinstance(value, int | np.integer):
            raise TypeError(f"ClockMap.{name} = {value!r}: must be an integer")
        if not _LEAST <= value <= _MOST:
            raise ValueError(f"ClockMap.{name} = {value}: does not fit an int64")
    return tuple(int(value) for value in values)


def _int64(times: Any) -> NDArray[np.int64]:
    array = np.asarray(times)
    if array.dtype.kind not in "iu" or not np.can_cast(array.dtype, np.int64):
        raise TypeError(f"times must be int64, not {array.dtype}: floats lose nanoseconds")
    return array.astype(np.int64)


def _fits(value: Any) -> int:
    if not _LEAST <= value <= _MOST:
        raise OverflowError(f"the time {value} ns does not fit an int64")
    return int(value)


IDENTITY = ClockMap.line(0, 0)
"""The reference clock's own map."""
