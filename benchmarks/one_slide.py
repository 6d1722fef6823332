"""One straight slide by contact alone: forces and slips of a trial without any device.

Levels, grids and benchmarks need thousands of slides and no clock, camera or store. Onsets are
exact at any step; its length only says how often forces are reported.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sliplab.plugins.simulation.scene.contact import advance
from sliplab.plugins.simulation.scene.springs import Springs, new_tips, track_width

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]

PRESS_STEPS = 8
HOLD_STEPS = 1


@dataclass(frozen=True)
class SlideRun:
    """Result of one slide; rows from the start of the slide on.

    Attributes:
        t_ns: row times after the start of the slide, (m,); the first is 0.
        track: `scene.contact.record`'s rows, (m, track_width(n)).
        loads: forces x, y and normal of each tip, N, (m, 3 n).
        began_s: start of the slide in the time of `track`'s slips, s.
    """

    t_ns: I64
    track: F64
    loads: F64
    began_s: float

    @property
    def slipped_s(self) -> F64:
        """First slip of each tip after the start of the slide, s, (n,); NaN: none."""
        n = self.loads.shape[1] // 3
        slid = self.track[:, 2 * n : 3 * n] - self.track[0, 2 * n : 3 * n]
        first = np.argmax(slid > 0.0, axis=0)
        times = self.track[first, 3 * n + np.arange(n)] - self.began_s
        return np.where(first > 0, np.maximum(times, 0.0), np.nan)


def run_slide(
    springs: Springs,
    depth_mm: float,
    speed_mm_s: float,
    direction_deg: float = 0.0,
    *,
    length_mm: float = 15.0,
    press_mm_s: float = 2.0,
    settled_s: float = 3.0,
    step_mm: float = 1.0,
) -> SlideRun:
    """Press straight in, hold still, slide; every motion at constant speed."""
    steps = max(round(length_mm / step_mm), 1)
    press_s, slide_s = depth_mm / press_mm_s, length_mm / speed_mm_s
    first = PRESS_STEPS + HOLD_STEPS
    share = np.arange(1, steps + 1) / steps
    seconds = np.empty(first + steps + 1)
    seconds[: PRESS_STEPS + 1] = np.arange(PRESS_STEPS + 1) * (press_s / PRESS_STEPS)
    hold = settled_s * np.arange(1, HOLD_STEPS + 1) / HOLD_STEPS
    seconds[PRESS_STEPS + 1 : first + 1] = press_s + hold
    seconds[first + 1 :] = press_s + settled_s + slide_s * share
    t_ns = np.rint(seconds * 1e9).astype(np.int64)
    sensor = np.zeros((first + steps, 5))
    sensor[:, 2] = depth_mm
    sensor[:PRESS_STEPS, 2] = depth_mm * np.arange(1, PRESS_STEPS + 1) / PRESS_STEPS
    angle, distance = math.radians(direction_deg), length_mm * share
    sensor[first:, 0], sensor[first:, 1] = distance * math.cos(angle), distance * math.sin(angle)
    n = len(springs.table)
    track, loads = np.empty((len(sensor), track_width(n))), np.empty((len(sensor), 3 * n))
    advance(
        springs.table,
        springs.friction,
        springs.law,
        new_tips(n).state,
        t_ns,
        sensor,
        np.zeros(len(t_ns)),
        track,
        loads,
        springs.spots,
    )
    rows = slice(first - 1, None)
    return SlideRun(t_ns[first:] - t_ns[first], track[rows], loads[rows], t_ns[first] * 1e-9)
