"""The ground truth of a simulated trial, for checking labels."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from sliplab.plugins.simulation.fault_book import NEVER
from sliplab.plugins.simulation.world import SimulatedWorld
from sliplab.protocols.timing import FrameGrade
from sliplab.rigs.core.capabilities import PlateCourse, RigError, TrueOnsets, Truth
from sliplab.storage.clockmap import IDENTITY, ClockMap
from sliplab.storage.kernels import njit

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]
TWIST_RAD = math.radians(0.5)
"""A sensor that turned further than this in its motion was twisted."""
SLIP_MM = 1e-6
"""Sliding distance at which a tip has slipped: above rounding and microseconds of sliding."""


def truth_of(
    world: SimulatedWorld,
    box: ClockMap,
    reference_true_ns: int,
    threshold_px: float = 2.0,
    hold_true_ns: int | None = None,
) -> Truth:
    """Return the onsets after the start of the slide or retraction, on the sync box's clock.

    Args:
        box: true time to sync box time.
        reference_true_ns: start of the motion in contact; displacements are measured from the
            tips' positions then. In a twist the centre stays where it is, and gross slip begins
            with the last of the other tips.
        threshold_px: displacement in the outside image that counts as slip.
        hold_true_ns: start of the recorded hold, to measure displacements from there too.

    Returns:
        the truth without its `clocks`; with `hold_true_ns` also `from_hold`. Markers' displacements
        are linear between rows; onsets of sliding are located within rows.

    Raises:
        RigError: a reference is older than the stored history (minutes).
    """
    world.advance()
    threshold_mm = threshold_px / world.settings.frame_camera.px_per_mm
    onsets = _counted_from(world, box, reference_true_ns, threshold_mm)
    found: Truth = {
        "simulated": True,
        "level": world.settings.scene.level,
        "threshold_mm": threshold_mm,
        "reference_ns": onsets["reference_ns"],
        "incipient_ns": onsets["incipient_ns"],
        "gross_ns": onsets["gross_ns"],
        "per_papilla_ns": onsets["per_papilla_ns"],
        "first_slip_ns": onsets["first_slip_ns"],
        "slip_per_papilla_ns": onsets["slip_per_papilla_ns"],
    }
    if hold_true_ns is not None:
        found["from_hold"] = {
            **_counted_from(world, box, hold_true_ns, threshold_mm),
            "hold_slip_mm": _moved_mm(world, hold_true_ns, reference_true_ns),
        }
    return found


COURSE = "plate course"
"""Name of the record of forces that `watch_plate` keeps."""
_COURSE_NS = 1_000_000


def watch_plate(world: SimulatedWorld) -> None:
    """Keep the forces on the plate from now on, for `plate_course`."""
    world.keep_wrench(COURSE)


def plate_course(world: SimulatedWorld, since_true_ns: int) -> PlateCourse:
    """Return heights, normal forces and depths every millisecond since a true time.

    Raises:
        RigError: `watch_plate` was not called before in this trial.
    """
    end_ns = world.advance()
    forces = world.physics.more_wrenches.get(COURSE)
    if forces is None:
        raise RigError("plate", "its course is not stored: call watch_plate first")
    t_ns = np.arange(max(since_true_ns, forces.begin_ns), end_ns + 1, _COURSE_NS, dtype=np.int64)
    return {
        "t_ms": ((t_ns - since_true_ns) / 1e6).tolist(),
        "height_mm": world.tips_at(t_ns)[1].tolist(),
        "normal_n": forces.at(t_ns)[:, 2].tolist(),
        "depth_mm": world.depth_mm(t_ns).tolist(),
        "stroke_mm": world.settings.scene.plate.stroke_mm,
    }


def _moved_mm(world: SimulatedWorld, start_ns: int, end_ns: int) -> list[float]:
    """Return each marker's displacement on the plate from one true time to another."""
    n = len(world.physics.tips.state)
    places = world.physics.track.at(np.array([start_ns, end_ns], np.int64))[:, : 2 * n]
    moved = (places[1] - places[0]).reshape(n, 2)
    return [float(mm) for mm in np.hypot(moved[:, 0], moved[:, 1])]


def _counted_from(
    world: SimulatedWorld, box: ClockMap, reference_true_ns: int, threshold_mm: float
) -> TrueOnsets:
    """Return the onsets after a true time, with displacements from then; see `truth_of`."""
    history = world.physics.track
    if reference_true_ns < history.begin_ns:
        raise RigError("simulation", "the trial is too long: its start is no longer stored")
    start = history.at(np.array([reference_true_ns], np.int64))[0]
    t_ns, rows = history.between(reference_true_ns, history.end_ns)
    t_ns = t_ns.copy()
    t_ns[0] = reference_true_ns
    crossed, began = _onsets(rows, start, t_ns, threshold_mm)

    def on_box(true_ns: float | None) -> int | None:
        return None if true_ns is None else int(box.to_reference(round(true_ns)))

    torn_ns = dict(world.faults.torn())

    def there(i: int, true_ns: float | None) -> float | None:
        """Return the time, or None for a papilla that was torn off before, which is no slip."""
        late = true_ns is not None and true_ns >= torn_ns.get(i, NEVER)
        return None if late else true_ns

    markers = [on_box(there(i, true_ns)) for i, true_ns in enumerate(crossed)]
    gross = markers[0]
    if np.ptp(world.turn_at(t_ns)) > TWIST_RAD:
        others = [t for t in markers[1:] if t is not None]
        gross = max(others) if len(others) == len(markers) - 1 else None
    slips = [on_box(there(i, true_ns)) for i, true_ns in enumerate(began)]
    return {
        "reference_ns": box.to_reference(reference_true_ns),
        "incipient_ns": min((t for t in markers if t is not None), default=None),
        "gross_ns": gross,
        "per_papilla_ns": markers,
        "first_slip_ns": min((t for t in slips if t is not None), default=None),
        "slip_per_papilla_ns": slips,
    }


def clocks_of(
    world: SimulatedWorld, box: ClockMap, recorded_ns: tuple[int, int], frames: FrameGrade
) -> dict[str, list[list[int]]]:
    """Return the readings of the clocks at every second of a recording, without jitter.

    Args:
        box: true time to sync box time.
        recorded_ns: true start and end of the recording; the end is added to the readings.
        frames: with `host arrival` the frame camera's time stamps are the host's.

    Returns:
        for `arm`, `event_camera` and `frame_camera` pairs of that clock and the box's, ns.
    """
    clocks = world.clocks
    found = {"arm": clocks.arm, "event_camera": clocks.event_camera}
    found["frame_camera"] = IDENTITY if frames == "host arrival" else clocks.frame_camera
    return {name: readings_of(clock, box, recorded_ns) for name, clock in found.items()}


def readings_of(clock: ClockMap, box: ClockMap, recorded_ns: tuple[int, int]) -> list[list[int]]:
    """Return pairs of one clock's reading and the box's, ns, as `clocks_of` has them."""
    start_ns, end_ns = recorded_ns
    times = [*range(start_ns, end_ns, 1_000_000_000), end_ns]
    return [[clock.to_reference(t), box.to_reference(t)] for t in times]


def _onsets(
    rows: F64, start: F64, t_ns: I64, threshold_mm: float
) -> tuple[list[float | None], list[float | None]]:
    """Return the times at which displacements exceed the threshold, and tips begin to slide.

    Both in true ns, or None. `rows` are rows of the track; the first is treated as `start`.
    """
    n = rows.shape[1] // 4
    crossed: list[float | None] = [None] * n
    began: list[float | None] = [None] * n
    moved, slid = (found.tolist() for found in _first_beyond(rows, start, n, threshold_mm, SLIP_MM))
    for i in range(n):
        if moved[i]:
            k = moved[i]
            shift = rows[k - 1 : k + 1, 2 * i : 2 * i + 2] - start[2 * i : 2 * i + 2]
            low, high = np.hypot(shift[:, 0], shift[:, 1]).tolist()
            low = low if k > 1 else 0.0
            # linear between the rows
            share = (threshold_mm - low) / (high - low)
            crossed[i] = float(t_ns[k - 1]) + share * float(t_ns[k] - t_ns[k - 1])
        if slid[i]:
            # as the solver located it within its step; some rows may pass before the slid distance
            # counts: sliding began at the tip's last stick
            began[i] = max(float(rows[slid[i], 3 * n + i]) * 1e9, float(t_ns[0]))
    return crossed, began


@njit(cache=True, nogil=True)
def _first_beyond(
    rows: F64, start: F64, n: int, moved_mm: float, slid_mm: float
) -> tuple[I64, I64]:
    """Return the first rows in which a marker has moved and its tip has slid farther; else 0."""
    moved, slid = np.zeros(n, np.int64), np.zeros(n, np.int64)
    for k in range(1, len(rows)):
        for i in range(n):
            x, y = rows[k, 2 * i] - start[2 * i], rows[k, 2 * i + 1] - start[2 * i + 1]
            if not moved[i] and math.hypot(x, y) > moved_mm:
                moved[i] = k
            if not slid[i] and rows[k, 2 * n + i] - start[2 * n + i] > slid_mm:
                slid[i] = k
    return moved, slid
