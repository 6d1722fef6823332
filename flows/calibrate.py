"""What `sliplab teach` and `sliplab calibrate` do: measure, judge, and say what is to be written.

Each step gives a `Finding`, or raises and nothing is written. A finding that is too poor to be
relied on is a failure like any other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from flows import console
from protocols.errors import InputError
from protocols.program import Position
from rigs.capabilities import Pose, RigError
from rigs.plate_frame import PlateFrame
from rigs.rig import Rig
from rigs.rig_file import RigFile
from rigs.teaching import Creep, MarkerFinder, Touch, jogged, look, stir, touch
from storage.streams import FrameChunk

F64 = npt.NDArray[np.float64]

MOST_PLANE_MM = 0.1
MOST_DIFFERENCE_MM = 0.15
MOST_TOOL_MM = 0.3
MOST_LENS_PX = 0.5
MOST_CROP_PX = 5.0
STIR_MM_S = 1.0
REGION_MM = 36.0
"""Side of what the outside camera looks at while touching."""


@dataclass(frozen=True)
class Finding:
    """What was measured: keys of the rig file to set and to remove, and figures for people."""

    changes: dict[str, Any]
    figures: dict[str, Any]
    remove: tuple[str, ...] = ()


@dataclass(frozen=True)
class Planned:
    """One motion that a command will make: plate coordinates of the rig's present plane."""

    what: str
    x_mm: float
    y_mm: float
    from_mm: float
    to_mm: float
    speed_mm_s: float


@dataclass
class Bench:
    """The rig at hand.

    Attributes:
        today: the day that entries get.
    """

    file: RigFile
    rig: Rig
    today: date = field(default_factory=date.today)

    @property
    def simulated(self) -> str:
        """``simulated `` before a number of a simulated rig."""
        return "simulated " if self.file.simulated else ""


def plane_places(span_mm: float) -> dict[str, tuple[float, float]]:
    """Where the plane is touched: three points, and one that checks them; plate coordinates."""
    aside = -span_mm / 2**0.5
    return {
        "centre": (0.0, 0.0), "right": (span_mm, 0.0), "above": (0.0, span_mm),
        "check": (aside, aside),
    }  # fmt: skip


def planned_touches(
    places: Sequence[tuple[str, tuple[float, float]]], creep: Creep
) -> list[Planned]:
    """The touches that a command will make."""
    return [
        Planned(f"touch {name}", *xy, -creep.clearance_mm, creep.search_mm, creep.speed_mm_s)
        for name, xy in places
    ]


def check_touches(file: RigFile, name: str, span_mm: float, creep: Creep) -> None:
    """Hold touches against the rig's limits.

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


def teach_plane(bench: Bench, span_mm: float, creep: Creep, repeats: int) -> Finding:
    """The contact plane from three touches, and a fourth that checks them.

    Raises:
        RigError: a touch never came, or the fourth is off the plane by more than 0.1 mm.
    """
    rig = bench.rig
    rig.frame = rig.frame.with_zero(0.0)
    places = plane_places(span_mm)
    found: dict[str, list[Touch]] = {name: [] for name in places}
    with console.bar(f"{bench.simulated}touches", repeats * len(places)) as bar:
        for number in range(repeats):
            for index, (name, xy) in enumerate(places.items()):
                seed = 1000 * (number + 1) + index
                found[name].append(touch(rig, *xy, creep, seed))
                bar.advance(1, f"{name} {found[name][-1].depth_mm:+.3f} mm")
    depths = {name: [t.depth_mm for t in touches] for name, touches in found.items()}
    points = {
        name: rig.frame.pose(Position(*xy, float(np.mean(depths[name])))).xyz_mm
        for name, xy in places.items()
    }
    scatter = max(float(np.ptp(values)) / 2 for values in depths.values())
    method = f"touches by event rate at {creep.speed_mm_s:g} mm/s, {repeats} a point"
    return _plane_found(bench, points, scatter, method, depths)


def teach_plane_by_hand(bench: Bench) -> Finding:
    """The contact plane from four points to which a person jogs the arm.

    Raises:
        StopRequested: the person said stop.
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
    poses = jogged(bench.rig, prompts)
    points = {name: pose.xyz_mm for name, pose in zip(where, poses, strict=True)}
    return _plane_found(bench, points, 0.0, "jogged by hand and confirmed", None)


def _plane_found(
    bench: Bench,
    points: dict[str, tuple[float, float, float]],
    scatter_mm: float,
    method: str,
    depths: dict[str, list[float]] | None,
) -> Finding:
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
    before = bench.rig.frame
    turned = np.degrees(np.arccos(np.clip(float(before.axes[2] @ frame.axes[2]), -1.0, 1.0)))
    moved = float(before.axes[2] @ (frame.origin - before.origin))
    entry = {
        **{name: [_mm(v) for v in points[name]] for name in ("centre", "right", "above")},
        "taught": bench.today,
        "residual": _mm(residual),
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
    return Finding({"calibration.contact_plane": entry}, figures, ("calibration.depth_zero",))


def marker_finder(bench: Bench) -> MarkerFinder:
    """Finds the markers in what the rig's outside camera hands over, from the first frame on."""
    from analysis.markers import MarkerTracker

    layout = np.array(bench.file.skin.layout_mm()) * bench.file.frame_camera.scale_px_per_mm
    tracker = MarkerTracker(layout)

    def find(chunk: FrameChunk) -> F64:
        if chunk.markers_px is not None:
            return chunk.markers_px.astype(np.float64)
        return np.stack([tracker.update(image)[0] for image in chunk.images])

    return find


def teach_zero(bench: Bench, creep: Creep, repeats: int, with_markers: bool) -> Finding:
    """Depth zero at the plate's centre, by event rate and by the markers' motion.

    Raises:
        RigError: a touch never came, or the two differ by more than 0.15 mm.
    """
    rig, camera = bench.rig, bench.file.frame_camera
    rig.frame = rig.frame.with_zero(0.0)
    if with_markers:
        side = max(16, round(REGION_MM * camera.scale_px_per_mm / 16) * 16)
        rig.frames.set_region(min(side, camera.width_px), min(side, camera.height_px))
    ways = ("events", "markers") if with_markers else ("events",)
    depths: dict[str, list[float]] = {way: [] for way in ways}
    with console.bar(f"{bench.simulated}touches", repeats * len(ways)) as bar:
        for number in range(repeats):
            for way in ways:
                find = marker_finder(bench) if way == "markers" else None
                depths[way].append(touch(rig, 0.0, 0.0, creep, 2000 + number, find).depth_mm)
                bar.advance(1, f"by {way} {depths[way][-1]:+.3f} mm")
    events = np.array(depths["events"])
    zero, residual = float(events.mean()), float(np.ptp(events)) / 2
    entry: dict[str, Any] = {"zero": _mm(zero), "by_events": _mm(zero)}
    figures: dict[str, Any] = {
        "zero_mm": zero,
        "by_events_mm": events.tolist(),
        "by_markers_mm": None,
        "difference_mm": None,
    }
    method = f"event rate, {repeats} touches at {creep.speed_mm_s:g} mm/s"
    if with_markers:
        markers = np.array(depths["markers"])
        difference = zero - float(markers.mean())
        residual = max(residual, float(np.ptp(markers)) / 2, abs(difference) / 2)
        method = f"event rate, checked by marker motion, {repeats} touches each"
        entry |= {"by_markers": _mm(float(markers.mean())), "difference": _mm(difference)}
        figures |= {"by_markers_mm": markers.tolist(), "difference_mm": difference}
        if abs(difference) > MOST_DIFFERENCE_MM:
            raise RigError(
                "arm",
                f"events put the surface at {zero:.3f} mm and markers at {markers.mean():.3f} mm: "
                f"more than {MOST_DIFFERENCE_MM:g} mm apart. Is calibration.touch_depth = "
                f"{rig.touch_mm:g} mm right? Nothing was written",
            )
    entry |= {"taught": bench.today, "residual": _mm(residual), "method": method}
    figures["residual_mm"] = residual
    return Finding({"calibration.depth_zero": entry}, figures)


def teach_tool(bench: Bench, poses: int, tool: Pose) -> Finding:
    """The tool centre point: a person brings the tip onto one fixed point in many ways.

    Args:
        tool: from the flange to the point that the controller reports now.

    Raises:
        StopRequested: the person said stop.
        RigError: orientations too much alike, or the tip was off the point by more than 0.3 mm.
    """
    from scipy.spatial.transform import Rotation

    from analysis.calibration_pivot import PivotError, find_tip

    prompts = [
        (
            f"jog the tip onto the fixed point, the tool leaning another way each time by 20 to "
            f"40 degrees ({number} of {poses})",
            f"pivot {number}",
        )
        for number in range(1, poses + 1)
    ]
    found = jogged(bench.rig, prompts)
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
        "offset": [_mm(v) for v in pivot.tip_mm],
        "pivot": [_mm(v) for v in pivot.point_mm],
        "poses": poses,
        "taught": bench.today,
        "residual": _mm(pivot.residual_mm),
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
    return Finding({"calibration.tool_centre_point": entry}, figures)


def see_boards(bench: Bench, views: int) -> list[npt.NDArray[np.uint8]]:
    """Pictures of a board that a person holds before the outside camera.

    Raises:
        StopRequested: the person said stop.
        RigError: the camera hands over tracks, or no frame came.
    """
    from rigs.rig import StopRequested

    rig, camera = bench.rig, bench.file.frame_camera
    rig.frames.set_region(camera.width_px, camera.height_px)
    pictures = []
    for number in range(views):
        how = "lean it by 20 to 40 degrees, another way and place each time, into every corner"
        prompt = "lay the board flat on the plate" if number == 0 else how
        if not rig.operator.ask("board", f"{prompt} ({number + 1} of {views})", f"view {number}"):
            raise StopRequested
        pictures.append(look(rig).images[-1])
        if not pictures[-1].size:
            raise RigError(
                "frame camera", "hands over tracks and no pictures: take a rig with `video`"
            )
        console.say(f"picture {number + 1} of {views} taken")
    rig.operator.ask("board", "take the board away", "away")
    return pictures


def read_pictures(folder: Path) -> list[npt.NDArray[np.uint8]]:
    """Grey pictures of a folder in the order of their names.

    Raises:
        InputError: none there, or one that cannot be read.
    """
    import cv2

    paths = sorted(p for p in folder.glob("*") if p.suffix.lower() in {".png", ".jpg", ".tif"})
    if not paths:
        raise InputError("--images", "", str(folder), "holds no .png, .jpg or .tif")
    pictures = []
    for path in paths:
        picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if picture is None:
            raise InputError("--images", "", str(path), "is no picture that can be read")
        pictures.append(picture)
    return pictures


def calibrate_lens(pictures: Sequence[npt.NDArray[np.uint8]], board: Any, today: date) -> Finding:
    """Lens, and scale on the plane of the first picture's board.

    Raises:
        RigError: pictures from which they cannot be found, or a residual above 0.5 px.
    """
    from analysis.calibration_charuco import BoardError, find_corners, fit_lens

    sizes = {picture.shape for picture in pictures}
    if len(sizes) != 1:
        raise RigError("frame camera", f"pictures of several sizes: {sorted(sizes)}")
    height, width = next(iter(sizes))
    views = []
    with console.bar("pictures", len(pictures)) as bar:
        for number, picture in enumerate(pictures, 1):
            try:
                views.append(find_corners(picture, board))
            except BoardError as error:
                raise RigError("frame camera", f"picture {number}: {error}") from None
            bar.advance(1, f"{len(views[-1])} corners")
    try:
        fit = fit_lens(views, board, (width, height))
    except BoardError as error:
        raise RigError("frame camera", f"{error}; nothing was written") from None
    if fit.residual_px > MOST_LENS_PX:
        worst = int(fit.used[int(fit.residuals_px.argmax())]) + 1
        raise RigError(
            "frame camera",
            f"corners are off by {fit.residual_px:.2f} px (root mean square), most in picture "
            f"{worst}: at most {MOST_LENS_PX:g} px is good. Is the board flat and the picture "
            "sharp? Nothing was written",
        )
    focal, centre = fit.matrix[[0, 1], [0, 1]], fit.matrix[:2, 2]
    scale = round(fit.scale_px_per_mm, 5)
    entry = {
        "scale_px_per_mm": scale,
        "focal": [_px(v) for v in focal],
        "centre": [_px(v) for v in centre],
        "distortion": [float(v) for v in fit.distortion],
        "tilt": f"{fit.tilt_deg:.3f} deg",
        "size": [f"{width} px", f"{height} px"],
        "views": len(fit.used),
        "measured": today,
        "residual": _px(fit.residual_px),
        "method": f"ChArUco board, squares of {board.square_mm:g} mm, model {fit.model}",
    }
    figures = {
        "scale_px_per_mm": scale,
        "focal_px": focal.tolist(),
        "centre_px": centre.tolist(),
        "distortion": fit.distortion.tolist(),
        "model": fit.model,
        "tilt_deg": fit.tilt_deg,
        "residual_px": fit.residual_px,
        "residuals_px": fit.residuals_px.tolist(),
        "corners": [len(view) for view in views],
        "cover_percent": 100 * fit.cover,
        "focal_doubt_percent": 100 * fit.focal_doubt,
    }
    changes = {"calibration.lens": entry, "frame_camera.scale_px_per_mm": scale}
    return Finding(changes, figures)


def calibrate_crop(bench: Bench, depth_mm: float, radius_mm: float) -> Finding:
    """Where the skin is in the event camera's picture.

    Raises:
        RigError: no skin found, or its two halves differ by more than 5 px.
    """
    from analysis.calibration_crop import CropError, find_crop

    rig = bench.rig
    with console.bar(f"{bench.simulated}rounds", 1) as bar:
        counts = stir(rig, depth_mm, radius_mm, STIR_MM_S, 3000)
        bar.advance(1, f"{int(counts.sum())} events")
    try:
        crop = find_crop(counts)
    except CropError as error:
        raise RigError("event camera", f"{error}; nothing was written") from None
    if crop.residual_px > MOST_CROP_PX:
        raise RigError(
            "event camera",
            f"the skin's centre differs by {crop.residual_px:.1f} px between two rounds: at most "
            f"{MOST_CROP_PX:g} px is good. Nothing was written",
        )
    middle = np.array([rig.events.width - 1, rig.events.height - 1]) / 2
    entry = {
        "centre": [_px(v) for v in crop.centre_px],
        "size": f"{crop.size_px} px",
        "measured": bench.today,
        "residual": _px(crop.residual_px),
        "method": f"smallest circle round {int(counts.sum())} events of the pressed, moved skin",
    }
    figures = {
        "centre_px": list(crop.centre_px),
        "size_px": crop.size_px,
        "diameter_px": crop.diameter_px,
        "off_the_middle_px": float(np.hypot(*(np.array(crop.centre_px) - middle))),
        "residual_px": crop.residual_px,
    }
    return Finding({"calibration.event_crop": entry}, figures)


def _mm(value: float) -> str:
    return f"{value:.4f} mm"


def _px(value: float) -> str:
    return f"{value:.3f} px"
