"""Reading and writing a GenICam camera's settings by name, where they are there at all.

Names differ between families (`ExposureTime`, `ExposureTimeAbs`); SFNC 2 names come first.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import numpy as np

from sliplab.rigs.core.capabilities import RigError
from sliplab.storage.streams import ClockReads

DEVICE = "frame camera"
_LOOK_S = 0.01
# command, value and ticks a second of the clock, by family; None: nanoseconds
_LATCHES = (
    ("TimestampLatch", "TimestampLatchValue", None),
    ("GevTimestampControlLatch", "GevTimestampValue", "GevTimestampTickFrequency"),
)


class Nodes:
    """The node map of an open camera.

    Args:
        node_map: what `GetNodeMap` of pypylon's device gives.
    """

    def __init__(self, node_map: Any) -> None:
        from pypylon import genicam

        self._map, self._genicam = node_map, genicam

    def has(self, name: str) -> bool:
        """Whether a setting is there and may be written now."""
        node = self._map.GetNode(name)
        return node is not None and node.GetAccessMode() in (self._genicam.RW, self._genicam.WO)

    def offers(self, name: str, choice: str) -> bool:
        """Whether a setting can be set and `choice` is one of its values."""
        return self.has(name) and choice in self._map.GetNode(name).Symbolics

    def choices(self, name: str) -> tuple[str, ...]:
        """Values that an enumeration may be set to now; none where it is none or cannot be set."""
        return tuple(getattr(self._map.GetNode(name), "Symbolics", ())) if self.has(name) else ()

    def select(self, name: str, *choices: str) -> None:
        """Set a selector to the first of `choices` that it offers; left alone where it has none."""
        for choice in choices:
            if self.offers(name, choice):
                self.put(choice, name)
                return

    def each(self, selector: str) -> Iterator[str]:
        """Set a selector to each of its values; once, with nothing set, where there is none."""
        for choice in self.choices(selector) or ("",):
            if choice:
                self.put(choice, selector)
            yield choice

    def get(self, name: str) -> Any:
        """The value of a setting.

        Raises:
            RigError: it is not there, or the camera is gone.
        """
        try:
            return self._map.GetNode(name).Value
        except (self._genicam.GenericException, AttributeError) as error:
            raise RigError(DEVICE, f"{name} cannot be read: {_short(error)}") from None

    def peek(self, *names: str) -> Any:
        """The value of the first of `names` that can be read now; None where none can."""
        for name in names:
            node = self._map.GetNode(name)
            if node is None:
                continue
            if node.GetAccessMode() in (self._genicam.RW, self._genicam.RO):
                with suppress(self._genicam.GenericException):
                    return node.Value
        return None

    def limit(self, name: str, which: str) -> int:
        """`Min`, `Max` or `Inc` of a whole number."""
        try:
            return int(getattr(self._map.GetNode(name), which))
        except (self._genicam.GenericException, AttributeError) as error:
            raise RigError(DEVICE, f"{name} has no {which}: {_short(error)}") from None

    def put(self, value: Any, *names: str) -> None:
        """Set every one of `names` that is there.

        Raises:
            RigError: none is there, or the camera refuses the value.
        """
        found = [name for name in names if self.has(name)]
        if not found:
            raise RigError(DEVICE, f"this camera has no {' or '.join(names)} to set")
        for name in found:
            try:
                self._map.GetNode(name).Value = value
            except self._genicam.GenericException as error:
                raise RigError(DEVICE, f"{name} = {value}: {self._why(name, error)}") from None

    def _why(self, name: str, error: Exception) -> str:
        """Why a value is refused; of an enumeration pylon says no more than its name."""
        choices, text = self.choices(name), _short(error)
        if choices and text.startswith("Feature "):
            return f"this camera has {', '.join(choices)}"
        return text

    def put_near(self, value: float, name: str) -> None:
        """Set a number as near to `value` as it goes, if it is there. Raises RigError."""
        if not self.has(name):
            return
        node = self._map.GetNode(name)
        self.put(type(value)(min(max(value, node.Min), node.Max)), name)

    def execute(self, name: str, within_s: float = 0.0) -> None:
        """Give a command, and wait until it is done where a time is given.

        Raises:
            RigError: it is not there, fails or takes longer.
        """
        try:
            node = self._map.GetNode(name)
            node.Execute()
            end = time.monotonic() + within_s
            while within_s and not node.IsDone():
                if time.monotonic() > end:
                    raise RigError(DEVICE, f"{name} is not done within {within_s:g} s")
                threading.Event().wait(_LOOK_S)
        except (self._genicam.GenericException, AttributeError) as error:
            raise RigError(DEVICE, f"{name} failed: {_short(error)}") from None


def centre_region(nodes: Nodes, width_px: int, height_px: int) -> None:
    """Read out a centred region only. Raises RigError where the sensor cannot."""
    for size, offset, wanted in (
        ("Width", "OffsetX", width_px),
        ("Height", "OffsetY", height_px),
    ):
        nodes.put(0, offset)
        most, step = nodes.limit(size, "Max"), nodes.limit(size, "Inc")
        least = nodes.limit(size, "Min")
        if not least <= wanted <= most or (wanted - least) % step:
            raise RigError(
                DEVICE,
                f"{size.lower()} of {wanted} px: must lie between {least} and {most} px "
                f"in steps of {step}",
            )
        nodes.put(wanted, size)
        step = nodes.limit(offset, "Inc")
        nodes.put((most - wanted) // 2 // step * step, offset)


def has_latch(nodes: Nodes) -> bool:
    """Whether the host can read the camera's clock."""
    return any(nodes.has(command) for command, _, _ in _LATCHES)


def latch_clock(nodes: Nodes) -> ClockReads:
    """Latch the camera's clock and read it: one row. Raises RigError where it has none."""
    for command, value, frequency in _LATCHES:
        if not nodes.has(command):
            continue
        per_s = int(nodes.get(frequency)) if frequency else 10**9
        before_ns = time.monotonic_ns()
        nodes.execute(command)
        after_ns = time.monotonic_ns()
        # the latch is what happened between the two; reading it out may take its time
        row = (int(nodes.get(value)) * 10**9 // per_s, before_ns, after_ns)
        return ClockReads(*(np.array([each], np.int64) for each in row))
    raise RigError(DEVICE, "this camera has no clock that the host can read")


def _short(error: Exception) -> str:
    """GenICam's text without the place in its source."""
    return str(error).split(" : ")[0].strip() or type(error).__name__
