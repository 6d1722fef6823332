"""What really happened in a simulated trial: the answers that labels are held against."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from rigs.capabilities import RigError
from rigs.mock.world import World
from storage.clockmap import ClockMap

F64 = npt.NDArray[np.float64]
SLIP_MM = 1e-6
"""A tip has slipped once it slid this far: beyond rounding, and microseconds of sliding."""


def truth_of(
    world: World, box: ClockMap, reference_true_ns: int, threshold_px: float = 2.0
) -> dict[str, Any]:
    """Onsets after the start of the slide or retraction, on the sync box's clock.

    Args:
        box: true time to sync box time.
        reference_true_ns: start of the step `slide` or `retract`; displacements are measured from
            where the tips were then.
        threshold_px: displacement in the outside picture that counts as slip.

    Returns:
        JSON, times in ns or None: `per_papilla_ns`, when each marker's displacement relative to
        the plate exceeded the threshold; `incipient_ns`, the first of them; `gross_ns`, the
        centre's; `first_slip_ns` and `slip_per_papilla_ns`, when tips physically began to slide;
        `reference_ns`; `threshold_mm`; and `simulated`, which is true. Between steps of the
        scene's grid the displacement is taken as linear.

    Raises:
        RigError: the reference is older than the history that is kept (minutes).
    """
    world.advance()
    n = len(world.skin)
    threshold_mm = threshold_px / world.settings.frame_camera.px_per_mm
    first = reference_true_ns // world.step_ns
    if first < world.track.base:
        raise RigError("simulation", "the trial is too long: its beginning is forgotten")
    rows = world.track.rows(first, world.track.end)
    share = min(max(reference_true_ns / world.step_ns - first, 0.0), 1.0)
    start = rows[0] + share * (rows[min(1, len(rows) - 1)] - rows[0])
    places = rows[:, : 2 * n].reshape(-1, n, 2) - start[: 2 * n].reshape(n, 2)
    moved = np.hypot(places[:, :, 0], places[:, :, 1])
    slid = rows[:, 2 * n : 3 * n] - start[2 * n : 3 * n]
    moved[0], slid[0] = 0.0, 0.0

    def times(distance: F64, limit: float) -> list[int | None]:
        return [_crossing(world, box, distance[:, i], limit, first) for i in range(n)]

    markers, slips = times(moved, threshold_mm), times(slid, SLIP_MM)
    return {
        "simulated": True,
        "threshold_mm": threshold_mm,
        "reference_ns": box.to_reference(reference_true_ns),
        "incipient_ns": min((t for t in markers if t is not None), default=None),
        "gross_ns": markers[0],
        "per_papilla_ns": markers,
        "first_slip_ns": min((t for t in slips if t is not None), default=None),
        "slip_per_papilla_ns": slips,
    }


def _crossing(
    world: World, box: ClockMap, distance: F64, limit: float, first_step: int
) -> int | None:
    above = np.flatnonzero(distance > limit)
    if not len(above):
        return None
    k = int(above[0])
    low, high = float(distance[k - 1]), float(distance[k])
    share = (limit - low) / (high - low)
    step = first_step + k - 1
    return box.to_reference(step * world.step_ns + round(share * world.step_ns))
