"""Check a recorded motion against the commanded one: place across the path, speed along it.

Everything comes from the stored poses, so the check is the same for every arm. It finds a
controller that slows a move down and still reports it as done.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sliplab.rigs.core.rig import Way
from sliplab.storage.streams import F64, I64

WINDOW_S = 0.5
"""The shortest stretch over which a speed is measured, s."""
ARRIVAL_WINDOW_S = 1.0
"""The same where poses are timed by their arrival: a busy host reads some of them late."""
_WINDOW_POSES = 5
_NOISE = 0.01
"""Stretches are long enough for the poses' noise to change a speed by this share of it."""
_SETTLE_S, _ACCELERATION_MM_S2 = 0.1, 50.0
"""What an arm may take at either end of a way to gather speed, at a quarter of it at the most."""


def path_deviation_mm(pose_ns: I64, pose_mm: F64, ways: Sequence[Way]) -> float:
    """Return how far the tool was, at most, from the ways of the recorded steps, to a micrometre.

    Only across: along its way an arm may be early or late, as it gathers speed. -1 without poses
    in some step, or when the arm's clock is not to be believed.
    """
    worst = 0.0
    for way in ways:
        if way.end_ns <= way.start_ns:
            continue
        inside = (pose_ns >= way.start_ns) & (pose_ns <= way.end_ns)
        if not inside.any():
            return -1.0
        begin = np.asarray(way.begin_mm)
        along = np.asarray(way.end_mm) - begin
        from_begin = pose_mm[inside] - begin
        length_2 = float(along @ along)
        share = np.zeros(len(from_begin)) if length_2 == 0 else from_begin @ along / length_2
        across: F64 = from_begin - np.clip(share, 0.0, 1.0)[:, None] * along
        worst = max(worst, float(np.max(np.linalg.norm(across, axis=1))))
    return round(worst, 3)


def speed_deviation_percent(pose_ns: I64, host_ns: I64, pose_mm: F64, ways: Sequence[Way]) -> float:
    """Return by how much, at most, the speed along a recorded way is off, percent, to a tenth.

    Measured in overlapping stretches of `WINDOW_S` or longer, as the noise of the poses demands;
    where the arm gathers speed and where it slows down are left out. -1 where it cannot be told:
    too few poses, or a clock that is not to be believed.

    Args:
        pose_ns: controller's time of every pose, (n,).
        host_ns: when each reached the host, (n,); equal to `pose_ns` where that is all there is.
        pose_mm: tool centre points in the arm's base frame, (n, 3).
    """
    worst = 0.0
    for way in ways:
        begin = np.asarray(way.begin_mm)
        along = np.asarray(way.end_mm) - begin
        length = float(np.linalg.norm(along))
        if length == 0.0:
            continue
        inside = (pose_ns >= way.start_ns) & (pose_ns <= way.end_ns)
        t_s = (pose_ns[inside] - way.start_ns) / 1e9
        if len(t_s) < 2 or np.any(np.diff(t_s) < 0):
            return -1.0
        gone_mm = (pose_mm[inside] - begin) @ (along / length)
        part = _at_speed(gone_mm, length, way.speed_mm_s)
        arrival = np.array_equal(pose_ns[inside], host_ns[inside])
        shortest_s = ARRIVAL_WINDOW_S if arrival else WINDOW_S
        speeds = _speeds(t_s[part], gone_mm[part], way.speed_mm_s, shortest_s)
        if not len(speeds) or not np.all(np.isfinite(speeds)):
            return -1.0
        worst = max(worst, float(np.max(np.abs(speeds / way.speed_mm_s - 1.0))))
    return round(100.0 * worst, 1)


def _at_speed(gone_mm: F64, length: float, speed: float) -> slice:
    """The poses of a way without its ramps, and one more on either side."""
    edge = min(speed * _SETTLE_S + speed**2 / (2 * _ACCELERATION_MM_S2), length / 4)
    begun, not_over = gone_mm >= edge, gone_mm <= length - edge
    first = int(np.argmax(begun)) if begun.any() else len(gone_mm)
    last = len(gone_mm) - 1 - int(np.argmax(not_over[::-1]))
    return slice(max(first - 1, 0), last + 2)


def _speeds(t_s: F64, gone_mm: F64, speed: float, shortest_s: float) -> F64:
    """Slopes of place over time in overlapping stretches, mm/s; empty where there are none."""
    seconds = float(t_s[-1] - t_s[0]) if len(t_s) > 1 else 0.0
    if seconds <= 0.0:
        return np.empty(0)
    rate = len(t_s) / seconds
    noise = _noise_mm(t_s, gone_mm) / (_NOISE * speed)
    # the slope of n points over T scatters by noise * sqrt(12 / n) / T, and n is rate * T
    shortest_s = max(shortest_s, float(np.cbrt(12 * noise**2 / rate)), _WINDOW_POSES / rate)
    stretches = max(1, int(seconds / shortest_s))
    width = seconds / stretches
    begins = np.linspace(t_s[0], t_s[-1] - width, 2 * stretches - 1)
    # the pose before and the one behind belong to it: no gap between poses goes unseen
    firsts = np.maximum(np.searchsorted(t_s, begins, "right") - 1, 0)
    ends = np.searchsorted(t_s, begins + width, "left") + 1
    slopes = [
        _slope(t_s[first:end], gone_mm[first:end])
        for first, end in zip(firsts.tolist(), ends.tolist(), strict=True)
    ]
    return np.array(slopes)


def _slope(t_s: F64, gone_mm: F64) -> float:
    """Of the straight line through some poses; infinite where all have one time."""
    from_middle = t_s - t_s.mean()
    spread = float(from_middle @ from_middle)
    return float(from_middle @ gone_mm) / spread if spread > 0.0 else np.inf


def _noise_mm(t_s: F64, gone_mm: F64) -> float:
    """Scatter of poses about the line between their neighbours, mm, as a standard deviation."""
    if len(t_s) < 3:
        return 0.0
    between = t_s[2:] - t_s[:-2]
    share = np.divide(t_s[1:-1] - t_s[:-2], between, np.full(len(between), 0.5), where=between > 0)
    off = gone_mm[1:-1] - ((1 - share) * gone_mm[:-2] + share * gone_mm[2:])
    return float(1.4826 * np.median(np.abs(off)) / np.sqrt(1.5))
