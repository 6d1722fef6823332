"""What really happened in a simulated trial: the answers that labels are held against."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from rigs.capabilities import RigError
from rigs.mock.faults import NEVER
from rigs.mock.world import World
from storage.clockmap import ClockMap

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]
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
        `reference_ns`; `threshold_mm`; `level` of physics; and `simulated`, which is true.
        Markers' displacements are taken as linear between the rows; the onsets of sliding are
        located within them.

    Raises:
        RigError: the reference is older than the history that is kept (minutes).
    """
    world.advance()
    n = len(world.skin)
    threshold_mm = threshold_px / world.settings.frame_camera.px_per_mm
    history = world.physics.track
    if reference_true_ns < history.begin_ns:
        raise RigError("simulation", "the trial is too long: its beginning is forgotten")
    start = history.at(np.array([reference_true_ns], np.int64))[0]
    t_ns, rows = history.between(reference_true_ns, history.end_ns)
    t_ns = t_ns.copy()
    t_ns[0] = reference_true_ns
    places = rows[:, : 2 * n].reshape(-1, n, 2) - start[: 2 * n].reshape(n, 2)
    moved = np.hypot(places[:, :, 0], places[:, :, 1])
    slid = rows[:, 2 * n : 3 * n] - start[2 * n : 3 * n]
    moved[0], slid[0] = 0.0, 0.0

    def on_box(true_ns: float | None) -> int | None:
        return None if true_ns is None else int(box.to_reference(round(true_ns)))

    torn_ns = dict(world.faults.torn())

    def there(i: int, true_ns: float | None) -> float | None:
        """What happened to a papilla after it was torn off is no slip."""
        late = true_ns is not None and true_ns >= torn_ns.get(i, NEVER)
        return None if late else true_ns

    crossed, began = _first(moved > threshold_mm), _first(slid > SLIP_MM)
    markers = [
        on_box(there(i, _crossing(t_ns, moved[:, i], threshold_mm, crossed[i]))) for i in range(n)
    ]
    slips = [
        on_box(there(i, _first_slip(rows[:, 3 * n + i], reference_true_ns, began[i])))
        for i in range(n)
    ]
    return {
        "simulated": True,
        "level": world.settings.scene.level,
        "threshold_mm": threshold_mm,
        "reference_ns": box.to_reference(reference_true_ns),
        "incipient_ns": min((t for t in markers if t is not None), default=None),
        "gross_ns": markers[0],
        "per_papilla_ns": markers,
        "first_slip_ns": min((t for t in slips if t is not None), default=None),
        "slip_per_papilla_ns": slips,
    }


def _first(above: npt.NDArray[np.bool_]) -> list[int | None]:
    """First row of each column, (k, n), that is true."""
    rows = above.argmax(axis=0).tolist()
    return [row if above[row, i] else None for i, row in enumerate(rows)]


def _crossing(t_ns: I64, distance: F64, limit: float, k: int | None) -> float | None:
    """When a distance, first beyond a limit in row `k`, exceeds it: straight between the rows."""
    if k is None:
        return None
    low, high = float(distance[k - 1]), float(distance[k])
    share = (limit - low) / (high - low)
    return float(t_ns[k - 1]) + share * float(t_ns[k] - t_ns[k - 1])


def _first_slip(slipped_s: F64, reference_ns: int, k: int | None) -> float | None:
    """When a tip that slides in row `k` went from stick to slip: located within its step."""
    # a row or two may pass before the way slid counts; the tip began where it last stuck
    return None if k is None else max(float(slipped_s[k]) * 1e9, float(reference_ns))
