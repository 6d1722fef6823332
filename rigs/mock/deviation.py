"""An arm that leaves its path: the tool drifts sideways, and takes the skin along."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from sliplab.rigs.mock.fault_settings import ArmOffPath
from sliplab.rigs.mock.faults import NEVER, FaultBook
from sliplab.rigs.mock.geometry import ContactPlane

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]
_LOOK_BACK_NS = 1_000_000
_MOVING_MM = 1e-9
_X, _Y = 6, 7
"""Columns of an arm state (`rigs.mock.path`): the sensor's place on the plate."""


class Deviation:
    """How far the tool is from where it was told to be, as an arm state to be added."""

    def __init__(
        self, book: FaultBook, plane: ContactPlane, commanded: Callable[[I64], F64]
    ) -> None:
        """`commanded`: from rising true times, ns, (n,) to states, (n, 11)."""
        self._book, self._plane, self._commanded = book, plane, commanded
        self._frozen_ns = NEVER

    def __bool__(self) -> bool:
        return bool(self._book.of(ArmOffPath))

    def freeze(self, at_ns: int) -> None:
        """The arm stopped: whatever pulled it aside pulls no further."""
        self._frozen_ns = min(self._frozen_ns, at_ns)

    def at(self, t_ns: I64) -> F64:
        """Deviations at true times, (n, 11): place of the tool and of the sensor, mm."""
        result = np.zeros((len(t_ns), 11))
        for fault, begin, end in self._book.spans(ArmOffPath):
            t = np.minimum(t_ns, self._frozen_ns)
            way_mm = fault.mm * np.clip((t - begin) / (end - begin), 0.0, 1.0)
            if way_mm.any():
                aside = way_mm[:, None] * self._direction(fault, begin)
                result[:, :3] += aside @ self._plane.rotation[:, :2].T
                result[:, _X : _Y + 1] += aside
        return result

    def _direction(self, fault: ArmOffPath, at_ns: int) -> F64:
        """Unit vector on the plate, (2,)."""
        if fault.direction_deg is not None:
            angle = math.radians(fault.direction_deg)
            return np.array([math.cos(angle), math.sin(angle)])
        # looking back: what lies ahead may still be changed
        states = self._commanded(np.array([at_ns - _LOOK_BACK_NS, at_ns], np.int64))
        x, y = (states[1] - states[0])[_X : _Y + 1].tolist()
        length = math.hypot(x, y)
        return np.array([0.0, 1.0]) if length < _MOVING_MM else np.array([-y, x]) / length
