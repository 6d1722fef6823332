"""What the outside camera's frames suffer from: losses, delays, and things in front of the lens."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from sliplab.rigs.mock.fault_settings import DeviceGone, FrameLate, FramesLost, MarkerOccluded
from sliplab.rigs.mock.free_run import Trigger
from sliplab.rigs.mock.world import World
from sliplab.rigs.scene.frames import Exposures, Way

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]

OUT_OF_SIGHT_MM = 500.0
"""Beside or below the plate's centre: where a marker is put that nobody can see."""


class FrameFaults:
    """The frame camera's share in the faults of whatever trial runs."""

    def __init__(self, world: World, trigger: Trigger) -> None:
        self._world, self._trigger = world, trigger

    def lost(self, ticks: I64) -> Mask:
        """Which frames never reach the host, (k,) for the frames on k ticks."""
        lost = np.zeros(len(ticks), np.bool_)
        if not len(ticks):
            return lost
        for fault, begin_ns, _ in self._world.faults.spans(FramesLost):
            first = self._trigger.tick_at(begin_ns)
            lost |= (ticks >= first) & (ticks < first + fault.count)
        for gone, begin_ns, end_ns in self._world.faults.spans(DeviceGone):
            if gone.device == "frame_camera":
                true_ns = self._trigger.true_ns(ticks)
                lost |= (true_ns >= begin_ns) & (true_ns < end_ns)
        return lost

    def arrival_ns(self, ticks: I64, on_time_ns: I64) -> I64:
        """When frames reach the host, ns: their order is kept, so that one waits for the other.

        Args:
            ticks: (k,), rising.
            on_time_ns: (k,), when they would come without any fault.
        """
        arrival = on_time_ns
        for fault, begin_ns, _ in self._world.faults.spans(FrameLate):
            first = self._trigger.tick_at(begin_ns)
            after = ticks >= first
            if after.any():
                last_late = np.minimum(ticks[after], first + fault.count - 1)
                # on time they come a fixed while after their ticks
                early = self._trigger.true_ns(ticks[after]) - self._trigger.true_ns(last_late)
                late = on_time_ns[after] - early + round(fault.seconds * 1e9)
                arrival = arrival.copy()
                arrival[after] = np.maximum(arrival[after], late)
        return arrival

    def hide(self, mid_ns: I64, seen: Exposures) -> Exposures:
        """What k exposures about `mid_ns` see: hidden markers are moved out of the picture.

        A torn papilla has no white spot any more, and an occluded marker none for a while.
        """
        hidden: list[tuple[int | None, Mask]] = [
            (papilla, mid_ns >= due_ns) for papilla, due_ns in self._world.faults.torn()
        ]
        for fault, begin_ns, end_ns in self._world.faults.spans(MarkerOccluded):
            hidden.append((fault.papilla, (mid_ns >= begin_ns) & (mid_ns < end_ns)))
        hidden = [(papilla, when) for papilla, when in hidden if when.any()]
        if not hidden:
            return seen
        tips_mm, plate_mm, ways = seen.tips_mm.copy(), seen.plate_mm.copy(), dict(seen.ways)
        for papilla, when in hidden:
            _put_away(papilla, tips_mm, plate_mm, when)
            for index in ways.keys() & set(np.flatnonzero(when).tolist()):
                way = Way(ways[index].tips_mm.copy(), ways[index].plate_mm.copy())
                _put_away(papilla, way.tips_mm, way.plate_mm, slice(None))
                ways[index] = way
        return Exposures(tips_mm, plate_mm, ways)


def _put_away(papilla: int | None, tips_mm: F64, plate_mm: F64, when: Mask | slice) -> None:
    if papilla is None:
        plate_mm[when] = -OUT_OF_SIGHT_MM
    else:
        tips_mm[when, papilla] = [-OUT_OF_SIGHT_MM, 0.0]
