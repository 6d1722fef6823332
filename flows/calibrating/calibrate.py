"""`sliplab calibrate`: lens and scale of the outside camera, the event camera's crop, the board.

Each measurement returns a `MeasurementResult`, or raises and nothing is written. The ChArUco board
is printed as a PDF of lines at true size, or as a PNG that states its resolution.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from sliplab.flows.calibrating.measurement import CalibrationSession, MeasurementResult, px
from sliplab.flows.running import console
from sliplab.protocols.errors import InputError
from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.core.rig import StopRequested
from sliplab.rigs.core.teaching import grab_frames, press_in_circles
from sliplab.storage.files import make_folder

if TYPE_CHECKING:
    from sliplab.analysis.calibration.charuco import Board

MOST_LENS_PX = 0.5
MOST_CROP_PX = 5.0
CIRCLE_MM_S = 1.0


def see_boards(session: CalibrationSession, views: int) -> list[npt.NDArray[np.uint8]]:
    """Take pictures of a board that a person holds before the outside camera.

    Raises:
        StopRequested: the user requested a stop.
        RigError: the camera provides tracks, or no frame arrived.
    """
    rig, camera = session.rig, session.file.frame_camera
    rig.frames.set_region(camera.width_px, camera.height_px)
    pictures: list[npt.NDArray[np.uint8]] = []
    for number in range(views):
        how = "lean it by 20 to 40 degrees, another way and place each time, into every corner"
        prompt = "lay the board flat on the plate" if number == 0 else how
        if not rig.operator.ask("board", f"{prompt} ({number + 1} of {views})", f"view {number}"):
            raise StopRequested
        picture = grab_frames(rig).images[-1]
        if not picture.size:
            raise RigError("frame camera", "provides tracks and no images: use a rig with `video`")
        if pictures and np.array_equal(picture, pictures[-1]):
            text = (
                "sent exactly the image of the picture before: the board did not move, or it hangs"
            )
            raise RigError("frame camera", f"{text}; nothing was written")
        pictures.append(picture)
        console.say(f"picture {number + 1} of {views} taken")
    rig.operator.ask("board", "take the board away", "away")
    return pictures


def read_pictures(folder: Path) -> list[npt.NDArray[np.uint8]]:
    """Read the grey pictures of a folder in the order of their names.

    Raises:
        InputError: the folder has none, or one cannot be read.
    """
    import cv2

    paths = sorted(p for p in folder.glob("*") if p.suffix.lower() in {".png", ".jpg", ".tif"})
    if not paths:
        raise InputError("--images", "", str(folder), "contains no .png, .jpg or .tif")
    pictures: list[npt.NDArray[np.uint8]] = []
    for path in paths:
        picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if picture is None:
            raise InputError("--images", "", str(path), "is not a readable image")
        pictures.append(picture)
    return pictures


def calibrate_lens(
    pictures: Sequence[npt.NDArray[np.uint8]], board: Any, today: date
) -> MeasurementResult:
    """Fit the lens, and the scale on the plane of the first picture's board.

    Raises:
        RigError: the fit is impossible, or its residual is above 0.5 px.
    """
    from sliplab.analysis.calibration.charuco import BoardError, find_corners, fit_lens

    sizes = {picture.shape for picture in pictures}
    if len(sizes) != 1:
        raise RigError("frame camera", f"images of different sizes: {sorted(sizes)}")
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
            f"the reprojection error is {fit.residual_px:.2f} px (root mean square), largest in "
            f"picture {worst}: at most {MOST_LENS_PX:g} px is allowed. Is the board flat and the "
            "picture sharp? Nothing was written",
        )
    focal, centre = fit.matrix[[0, 1], [0, 1]], fit.matrix[:2, 2]
    scale = round(fit.scale_px_per_mm, 5)
    entry = {
        "scale_px_per_mm": scale,
        "focal": [px(v) for v in focal],
        "centre": [px(v) for v in centre],
        "distortion": [float(v) for v in fit.distortion],
        "tilt": f"{fit.tilt_deg:.3f} deg",
        "size": [f"{width} px", f"{height} px"],
        "views": len(fit.used),
        "measured": today,
        "residual": px(fit.residual_px),
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
    return MeasurementResult(changes, figures)


def calibrate_crop(
    session: CalibrationSession, depth_mm: float, radius_mm: float
) -> MeasurementResult:
    """Find the skin in the event camera's image.

    Raises:
        RigError: no skin was found, or two rounds differ by more than 5 px.
    """
    from sliplab.analysis.calibration.crop import CropError, find_crop

    rig = session.rig
    with console.bar(f"{session.simulated}rounds", 1) as bar:
        counts = press_in_circles(rig, depth_mm, radius_mm, CIRCLE_MM_S, 3000)
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
        "centre": [px(v) for v in crop.centre_px],
        "size": f"{crop.size_px} px",
        "measured": session.today,
        "residual": px(crop.residual_px),
        "method": f"smallest circle round {int(counts.sum())} events of the pressed, moved skin",
    }
    figures = {
        "centre_px": list(crop.centre_px),
        "size_px": crop.size_px,
        "diameter_px": crop.diameter_px,
        "off_the_middle_px": float(np.hypot(*(np.array(crop.centre_px) - middle))),
        "residual_px": crop.residual_px,
    }
    return MeasurementResult({"calibration.event_crop": entry}, figures)


PNG_PX_PER_MM = 50
_MM_PER_INCH = 25.4
_RULER_MM = 50.0
_MARGIN_MM = 12.0


def print_board(board: Board, path: Path) -> dict[str, float]:
    """Write the board with a ruler; return sizes in mm.

    Raises:
        InputError: the file's name ends in neither .pdf nor .png, its folder is missing, or it is
            of a store.
    """
    if path.suffix.lower() not in {".pdf", ".png"}:
        raise InputError("--out", "", str(path), "must end in .pdf or .png")
    if not path.parent.is_dir():
        raise InputError("--out", "", str(path), "its folder does not exist")
    from sliplab.storage.trials.catalogue import refuse_store_file

    refuse_store_file(path, "--out")
    import matplotlib

    matplotlib.use("agg")
    from matplotlib.figure import Figure

    width, height = board.size_mm
    page = max(width, _RULER_MM + 40) + 2 * _MARGIN_MM, height + 4 * _MARGIN_MM
    figure = Figure(figsize=(page[0] / _MM_PER_INCH, page[1] / _MM_PER_INCH))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_xlim(0, page[0])
    axes.set_ylim(0, page[1])
    axes.axis("off")
    _squares(board, axes, ((page[0] - width) / 2, 2.8 * _MARGIN_MM))
    left = (page[0] - width) / 2
    y = 2.0 * _MARGIN_MM
    axes.plot([left, left + _RULER_MM], [y, y], color="black", linewidth=0.5)
    for end in (left, left + _RULER_MM):
        axes.plot([end, end], [y - 1.5, y + 1.5], color="black", linewidth=0.5)
    text = (
        f"between the ticks: {_RULER_MM:g} mm. Print at 100 %, measure it; squares that are not "
        f"{board.square_mm:g} mm\nare given with --square. ChArUco {board.columns} x {board.rows}, "
        f"squares {board.square_mm:g} mm, markers {board.marker_mm:g} mm\n(DICT_5X5_100), "
        f"together {width:g} x {height:g} mm"
    )
    axes.text(left, y - 4, text, fontsize=6, va="top")
    make_folder(path.parent)
    dpi = PNG_PX_PER_MM * _MM_PER_INCH
    if path.suffix.lower() == ".pdf":
        figure.savefig(path, format="pdf", metadata={"CreationDate": None})
    else:
        figure.savefig(path, format="png", dpi=dpi)
    return {
        "width_mm": width,
        "height_mm": height,
        "square_mm": board.square_mm,
        "marker_mm": board.marker_mm,
        "page_width_mm": page[0],
        "page_height_mm": page[1],
    }


def _squares(board: Board, axes: Any, corner: tuple[float, float]) -> None:
    """Draw the board as black rectangles, row by row of the markers' modules."""
    from matplotlib.collections import PolyCollection

    module = board.marker_mm / 7  # five bits and a border of one on either side
    dictionary = board.opencv().getDictionary()
    quads, number = [], 0

    def quad(x: float, y: float, side_x: float, side_y: float) -> None:
        # y counts down the page from the board's top
        top = corner[1] + board.size_mm[1] - y
        quads.append(
            [
                (corner[0] + x + a, top - b)
                for a, b in ((0, 0), (side_x, 0), (side_x, side_y), (0, side_y))
            ]
        )

    for row in range(board.rows):
        for column in range(board.columns):
            x, y = column * board.square_mm, row * board.square_mm
            if (row + column) % 2 == 0:
                quad(x, y, board.square_mm, board.square_mm)
                continue
            inset = (board.square_mm - board.marker_mm) / 2
            bits = dictionary.generateImageMarker(number, 7, borderBits=1)
            number += 1
            for line, black in enumerate(np.asarray(bits) < 128):
                edges = np.flatnonzero(np.diff(np.concatenate([[0], black, [0]]).astype(int)))
                for begin, end in edges.reshape(-1, 2).tolist():
                    quad(
                        x + inset + begin * module,
                        y + inset + line * module,
                        (end - begin) * module,
                        module,
                    )
    shapes = PolyCollection(quads, facecolors="black", edgecolors="none", antialiased=False)
    axes.add_collection(shapes)
