"""`sliplab teach`: contact plane, depth zero and tool centre point.

Each measurement returns a `MeasurementResult`, or raises and nothing is written. A residual that is
too large is a failure like any other.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from sliplab.flows.calibrating.measurement import (
    CalibrationSession,
    MeasurementResult,
    PlannedMove,
    mm,
)
from sliplab.flows.running import console
from sliplab.protocols.errors import InputError
from sliplab.protocols.program import Position
from sliplab.protocols.shown import plural
from sliplab.rigs.core.capabilities import Pose, RigError
from sliplab.rigs.core.plate_frame import PlateFrame
from sliplab.rigs.core.teaching import OBLIQUE_SLOPE, Creep, MarkerFinder, Touch, jog_poses, touch
from sliplab.rigs.rig_file import RigFile
from sliplab.storage.streams import FrameChunk

F64 = npt.NDArray[np.float64]

MOST_PLANE_MM = 0.1
MOST_DIFFERENCE_MM = 0.15
MOST_TOOL_MM = 0.3
REGION_MM = 36.0
"""Side of the outside camera's region while touching, mm."""


def plane_places(span_mm: float) -> dict[str, tuple[float, float]]:
    """Return where the plane is touched, in plate coordinates: three points, and one to check."""
    diagonal = -span_mm / 2**0.5
    return {
        "centre": (0.0, 0.0),
        "right": (span_mm, 0.0),
        "above": (0.0, span_mm),
        "check": (diagonal, diagonal),
    }


def planned_touches(
    places: Sequence[tuple[str, tuple[float, float]]], creep: Creep
) -> list[PlannedMove]:
    """Return the touches that a command will make."""
    return [
        PlannedMove(f"touch {name}", *xy, -creep.clearance_mm, creep.search_mm, creep.speed_mm_s)
        for name, xy in places
    ]


def planned_zero(creep: Creep, with_markers: bool) -> list[PlannedMove]:
    """Return the touches that find depth zero."""
    places = [("centre, straight in", (0.0, 0.0))]
    if with_markers:
        places.append(("centre, aslant", (OBLIQUE_SLOPE * creep.search_mm, 0.0)))
    return planned_touches(places, creep)


def check_touches(file: RigFile, name: str, span_mm: float, creep: Creep) -> None:
    """Check touches against the rig's limits.

    Raises:
        InputError: the search goes deeper than the rig may, or the points lie too far out.
    """
    limits = file.limits
    if creep.search_mm > float(limits.depth):
        text = f"is deeper than the rig may go: limits.depth = {float(limits.depth):g} mm"
        raise InputError("--search", "", f"{creep.search_mm:g} mm", text)
    if span_mm > float(limits.reach):
        text = f"is farther than the rig may go: limits.reach = {float(limits.reach):g} mm"
        raise InputError("--span", "", f"{span_mm:g} mm", text)
    if name == "plane" and span_mm < 5.0:
        raise InputError("--span", "", f"{span_mm:g} mm", "must be at least 5 mm")


def teach_plane(
    session: CalibrationSession, span_mm: float, creep: Creep, repeats: int
) -> MeasurementResult:
    """Find the contact plane from three touches, and check it by a fourth.

    Raises:
        RigError: a touch never came, or the fourth is off the plane by more than 0.1 mm.
    """
    rig = session.rig
    rig.plate_frame = rig.plate_frame.with_zero(0.0)
    places = plane_places(span_mm)
    found: dict[str, list[Touch]] = {name: [] for name in places}
    with console.bar(f"{session.simulated}touches", repeats * len(places)) as bar:
        for number in range(repeats):
            for index, (name, xy) in enumerate(places.items()):
                seed = 1000 * (number + 1) + index
                found[name].append(touch(rig, *xy, creep, seed))
                bar.advance(1, f"{name} {found[name][-1].depth_mm:+.3f} mm")
    depths = {name: [t.depth_mm for t in touches] for name, touches in found.items()}
    points = {
        name: rig.plate_frame.pose(Position(*xy, float(np.mean(depths[name])))).xyz_mm
        for name, xy in places.items()
    }
    scatter = max(float(np.ptp(values)) / 2 for values in depths.values())
    method = f"touches by event rate at {creep.speed_mm_s:g} mm/s, {repeats} a point"
    return _plane_found(session, points, scatter, method, depths)


def teach_plane_by_hand(session: CalibrationSession) -> MeasurementResult:
    """Find the contact plane from four points to which a person jogs the arm.

    Raises:
        StopRequested: the user requested a stop.
        RigError: as `teach_plane`.
    """
    where = {
        "centre": "the plate's centre",
        "right": "a point at least 5 mm (better 12) to the right of it, as the outside camera "
        "sees the plate",
        "above": "a point at least 5 mm (better 12) above the centre",
        "check": "any point on the other side, below and to the left",
    }
    prompts = [
        (f"jog the arm until the centre papilla just touches {text}", f"touched {name}")
        for name, text in where.items()
    ]
    poses = jog_poses(session.rig, prompts)
    points = {name: pose.xyz_mm for name, pose in zip(where, poses, strict=True)}
    return _plane_found(session, points, 0.0, "jogged by hand and confirmed", None)


def _plane_found(
    session: CalibrationSession,
    points: dict[str, tuple[float, float, float]],
    scatter_mm: float,
    method: str,
    depths: dict[str, list[float]] | None,
) -> MeasurementResult:
    try:
        frame = PlateFrame.taught([points[name] for name in ("centre", "right", "above")])
    except ValueError as error:
        raise RigError("arm", f"{error}; nothing was written, teach the plane again") from None
    off = frame.position(points["check"]).depth_mm
    residual = max(abs(off), scatter_mm)
    if residual > MOST_PLANE_MM:
        raise RigError(
            "arm",
            f"the fourth touch is {off:+.3f} mm off the plane of the three, and touches repeat "
            f"within {scatter_mm:.3f} mm: at most {MOST_PLANE_MM:g} mm is good. Is something "
            "loose, or the skin dirty? Nothing was written",
        )
    before = session.rig.plate_frame
    turned = np.degrees(np.arccos(np.clip(float(before.axes[2] @ frame.axes[2]), -1.0, 1.0)))
    moved = float(before.axes[2] @ (frame.origin - before.origin))
    entry = {
        **{name: [mm(v) for v in points[name]] for name in ("centre", "right", "above")},
        "taught": session.today,
        "residual": mm(residual),
        "method": method,
    }
    figures = {
        "residual_mm": residual,
        "check_mm": off,
        "repeat_mm": scatter_mm,
        "moved_mm": moved,
        "turned_deg": float(turned),
        "points_mm": {name: list(xyz) for name, xyz in points.items()},
    }
    if depths is not None:
        figures["depths_mm"] = depths
    # a depth zero was measured from the plane that was there
    return MeasurementResult(
        {"calibration.contact_plane": entry}, figures, ("calibration.depth_zero",)
    )


def marker_finder(session: CalibrationSession) -> MarkerFinder:
    """Return a function that finds the markers in the outside camera's frames, in their order."""
    from sliplab.analysis.labels.markers import MarkerTracker

    layout = np.array(session.file.skin.layout_mm()) * session.file.frame_camera.scale_px_per_mm
    tracker = MarkerTracker(layout)

    def find(chunk: FrameChunk) -> F64:
        if chunk.markers_px is not None:
            return chunk.markers_px.astype(np.float64)
        return np.stack([tracker.update(image)[0] for image in chunk.images])

    return find


def teach_zero(
    session: CalibrationSession, creep: Creep, repeats: int, with_markers: bool
) -> MeasurementResult:
    """Find depth zero at the plate's centre, by event rate and by the markers' motion.

    Raises:
        RigError: a touch never came, or the two differ by more than 0.15 mm.
    """
    rig, camera = session.rig, session.file.frame_camera
    rig.plate_frame = rig.plate_frame.with_zero(0.0)
    if with_markers:
        side = max(16, round(REGION_MM * camera.scale_px_per_mm / 16) * 16)
        rig.frames.set_region(min(side, camera.width_px), min(side, camera.height_px))
    methods = ("events", "markers") if with_markers else ("events",)
    depths: dict[str, list[float]] = {method: [] for method in methods}
    with console.bar(f"{session.simulated}touches", repeats * len(methods)) as bar:
        for number in range(repeats):
            for method in methods:
                find = marker_finder(session) if method == "markers" else None
                depths[method].append(touch(rig, 0.0, 0.0, creep, 2000 + number, find).depth_mm)
                bar.advance(1, f"by {method} {depths[method][-1]:+.3f} mm")
    events = np.array(depths["events"])
    zero, residual = float(events.mean()), float(np.ptp(events)) / 2
    entry: dict[str, object] = {"zero": mm(zero), "by_events": mm(zero)}
    figures: dict[str, object] = {
        "zero_mm": zero,
        "by_events_mm": events.tolist(),
        "by_markers_mm": None,
        "difference_mm": None,
    }
    method = f"event rate, {plural(repeats, 'touch')} at {creep.speed_mm_s:g} mm/s"
    if with_markers:
        markers = np.array(depths["markers"])
        difference = zero - float(markers.mean())
        residual = max(residual, float(np.ptp(markers)) / 2, abs(difference) / 2)
        method = f"event rate, checked by marker motion, {plural(repeats, 'touch')} each"
        entry |= {"by_markers": mm(float(markers.mean())), "difference": mm(difference)}
        figures |= {"by_markers_mm": markers.tolist(), "difference_mm": difference}
        if abs(difference) > MOST_DIFFERENCE_MM:
            raise RigError(
                "arm",
                f"events put the surface at {zero:.3f} mm and markers at {markers.mean():.3f} mm: "
                f"more than {MOST_DIFFERENCE_MM:g} mm apart. Is calibration.touch_depth = "
                f"{rig.touch_mm:g} mm right? Nothing was written",
            )
    entry |= {"taught": session.today, "residual": mm(residual), "method": method}
    figures["residual_mm"] = residual
    return MeasurementResult({"calibration.depth_zero": entry}, figures)


def teach_tool(session: CalibrationSession, poses: int, tool: Pose) -> MeasurementResult:
    """Find the tool centre point: a person brings the tip onto one point, leaning differently.

    Args:
        tool: from the flange to the point that the controller reports now.

    Raises:
        StopRequested: the user requested a stop.
        RigError: orientations too much alike, or the tip was off the point by more than 0.3 mm.
    """
    from scipy.spatial.transform import Rotation

    from sliplab.analysis.calibration.pivot import PivotError, find_tip

    prompts = [
        (
            f"jog the tip onto the fixed point, the tool leaning another way each time by 20 to "
            f"40 degrees ({number} of {poses})",
            f"pivot {number}",
        )
        for number in range(1, poses + 1)
    ]
    found = jog_poses(session.rig, prompts)
    turns = Rotation.from_rotvec(np.radians([pose.rotvec_deg for pose in found]))
    flange = turns * Rotation.from_rotvec(np.radians(tool.rotvec_deg)).inv()
    xyz = np.array([pose.xyz_mm for pose in found]) - flange.apply(np.array(tool.xyz_mm))
    try:
        pivot = find_tip(xyz, np.degrees(flange.as_rotvec()))
    except PivotError as error:
        raise RigError("arm", f"{error}; nothing was written") from None
    if pivot.residual_mm > MOST_TOOL_MM:
        worst = int(pivot.errors_mm.argmax()) + 1
        raise RigError(
            "arm",
            f"the tip was off the point by {pivot.residual_mm:.3f} mm (root mean square), most "
            f"in pose {worst}: at most {MOST_TOOL_MM:g} mm is good. Nothing was written",
        )
    off = float(np.linalg.norm(pivot.tip_mm - np.array(tool.xyz_mm)))
    entry = {
        "offset": [mm(v) for v in pivot.tip_mm],
        "pivot": [mm(v) for v in pivot.point_mm],
        "poses": poses,
        "taught": session.today,
        "residual": mm(pivot.residual_mm),
        "method": "pivoting about a fixed point, least squares",
    }
    figures = {
        "offset_mm": pivot.tip_mm.tolist(),
        "off_the_tool_set_mm": off,
        "uncertainty_mm": pivot.uncertainty_mm,
        "residual_mm": pivot.residual_mm,
        "errors_mm": pivot.errors_mm.tolist(),
        "spread": pivot.spread,
    }
    return MeasurementResult({"calibration.tool_centre_point": entry}, figures)
