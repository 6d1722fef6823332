"""`sliplab calibrate`: scale and lens of the outside camera, and where the event camera sees skin.

Each step gives a `Finding`, or raises and nothing is written; see `flows.calibrating.teach`.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from sliplab.flows.calibrating.measuring import CalibrationSession, Finding, px
from sliplab.flows.running import console
from sliplab.protocols.errors import InputError
from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.core.rig import StopRequested
from sliplab.rigs.core.teaching import look, stir

MOST_LENS_PX = 0.5
MOST_CROP_PX = 5.0
STIR_MM_S = 1.0


def see_boards(session: CalibrationSession, views: int) -> list[npt.NDArray[np.uint8]]:
    """Pictures of a board that a person holds before the outside camera.

    Raises:
        StopRequested: the person said stop.
        RigError: the camera hands over tracks, or no frame came.
    """
    rig, camera = session.rig, session.file.frame_camera
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
    from sliplab.analysis.calibration.charuco import BoardError, find_corners, fit_lens

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
    return Finding(changes, figures)


def calibrate_crop(session: CalibrationSession, depth_mm: float, radius_mm: float) -> Finding:
    """Where the skin is in the event camera's picture.

    Raises:
        RigError: no skin found, or its two halves differ by more than 5 px.
    """
    from sliplab.analysis.calibration.crop import CropError, find_crop

    rig = session.rig
    with console.bar(f"{session.simulated}rounds", 1) as bar:
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
    return Finding({"calibration.event_crop": entry}, figures)
