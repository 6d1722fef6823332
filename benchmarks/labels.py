"""Following the markers, beside OpenCV's blob detectors on the same drawn frames, on one core.

The detectors only find blobs: naming them would come on top. `x_best_opencv` takes the fastest of
a tuned detector and connected components in each round; their parameters are printed (standard
error). Accuracy is reckoned on frames without noise, each blob given to the nearest true centre;
`centroid_diff_px` is against connected components over the whole frame, weighted by intensity.
Decoding is left out there and told apart: `decode_x_realtime` alone, with tracking, and with
tracking and the plate's ArUco marker, from a stored file of default frames with two threads.
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.measure import RUNS, SEED, Figures, alternate, one_core, rate, ratio, spread
from sliplab.analysis.labels.markers import MarkerTracks
from sliplab.analysis.labels.plate_tracking import VideoTracks, track_video
from sliplab.plugins.simulation.scene.frames import FrameOptics, PlateView
from sliplab.plugins.simulation.settings import MockFrameCameraSettings, MockSettings
from sliplab.plugins.simulation.world import SimulatedWorld
from sliplab.storage.streams import F64, U8
from sliplab.storage.trials.video import VideoWriter, read_frames

_CV2: Any = cv2  # its stubs lack the blob detector
RATE_HZ = 100
SIDE_PX = 800
STORED_PX = 832
"""Of a stored default frame: the kinematic grid's 41.6 mm."""
LEVEL = 69
"""A quarter of the way from the frames' ground to their tips."""
KEPT = 16
"""Frames that are looked at to and fro, so that all find them in the cache, as a decoder's are."""
DEFAULT: dict[str, Any] = {"blobColor": 255}
"""As shipped (thresholds 50 to 220 in steps of 10), but for bright blobs."""
TUNED: dict[str, Any] = {
    "blobColor": 255,
    "minThreshold": 112.0,
    "maxThreshold": 122.0,
    "thresholdStep": 10.0,
    "minRepeatability": 1,
    "filterByInertia": False,
    "filterByConvexity": False,
    "filterByCircularity": False,
}
PARAMETERS = {
    "default SimpleBlobDetector": DEFAULT,
    "tuned SimpleBlobDetector": TUNED,
    "threshold + connectedComponentsWithStats": {"threshold": LEVEL, "connectivity": 8},
}


def track(frames: Iterable[U8], layout_px: F64) -> MarkerTracks:
    """Track the markers alone."""
    return track_video(frames, layout_px, with_plate=False).markers


def measure(frames: int = 600, runs: int = RUNS) -> Figures:
    """Times per frame, centroids against each other and the truth, and decoding with tracking."""
    print(json.dumps(PARAMETERS), file=sys.stderr)
    few, truth = _video(min(frames, KEPT), MockFrameCameraSettings().noise)
    images = _to_and_fro(few, frames)
    clean, truth = _video(frames, 0.0)
    layout = truth[0] - truth[0, 0]
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    default, tuned = _default_detector(), _tuned_detector()
    try:
        with one_core():
            taken = alternate(
                runs,
                ours=lambda: track(images, layout),
                default=lambda: [default.detect(image) for image in images],
                tuned=lambda: [tuned.detect(image) for image in images],
                components=lambda: [components(image) for image in images],
            )
    finally:
        cv2.setNumThreads(threads)
    best = [min(pair) for pair in zip(taken["tuned"], taken["components"], strict=True)]
    figures = {
        **ratio("x_blob_detector", taken["default"], taken["ours"]),
        **ratio("x_best_opencv", best, taken["ours"]),
    }
    for name, prefix in (
        ("ours", ""),
        ("default", "blob_detector_"),
        ("tuned", "tuned_detector_"),
        ("components", "components_"),
    ):
        figures |= spread(f"{prefix}frame_ms", [value * 1e3 / frames for value in taken[name]])
    ours = track(clean, layout).xy
    pairs = list(zip(clean, truth, strict=True))
    by_components = np.stack([_nearest(components(image), at) for image, at in pairs])
    by_default = np.stack([_nearest(_points(default, image), at) for image, at in pairs])
    by_tuned = np.stack([_nearest(_points(tuned, image), at) for image, at in pairs])
    figures |= {
        "centroid_diff_px": _rms(ours - by_components),
        "error_px": _rms(ours - truth),
        "components_error_px": _rms(by_components - truth),
        "blob_detector_error_px": _rms(by_default - truth),
        "tuned_detector_error_px": _rms(by_tuned - truth),
        "blob_detector_found_share": float(np.isfinite(by_default[..., 0]).mean()),
    }
    return figures | _from_file(min(frames, 300), layout, runs)


def components(image: U8) -> F64:
    """Threshold, connected components, and each one's centroid weighted by intensity.

    The threshold is fixed and as low as the tracker's, where centroids are best; the labels' type
    is the one for which OpenCV takes its fastest way.
    """
    binary = cv2.threshold(image, LEVEL, 255, cv2.THRESH_BINARY)[1]
    stats = cv2.connectedComponentsWithStats(binary, connectivity=8, ltype=cv2.CV_16U)[2]
    found = []
    for left, top, width, height, area in stats[1:].tolist():
        if area >= 50:
            part = cv2.subtract(image[top : top + height, left : left + width], float(LEVEL))
            moments = cv2.moments(part)
            weight = moments["m00"]
            found.append((left + moments["m10"] / weight, top + moments["m01"] / weight))
    return np.array(found, np.float64).reshape(-1, 2)


def _default_detector() -> Any:
    """As OpenCV ships it (thresholds 50 to 220 in steps of 10), but for bright blobs."""
    parameters = _CV2.SimpleBlobDetector_Params()
    for name, value in DEFAULT.items():
        setattr(parameters, name, value)
    return _CV2.SimpleBlobDetector_create(parameters)


def _tuned_detector() -> Any:
    """With a single threshold, half-way, and no filter but the area's."""
    parameters = _CV2.SimpleBlobDetector_Params()
    for name, value in TUNED.items():
        setattr(parameters, name, value)
    return _CV2.SimpleBlobDetector_create(parameters)


def _to_and_fro(few: list[U8], count: int) -> list[U8]:
    """`count` frames: all of `few` forwards, then backwards, and so on."""
    there = few + few[-2:0:-1]
    return [there[index % len(there)] for index in range(count)]


def _video(
    frames: int, noise: float, side: int = SIDE_PX, plate: bool = False
) -> tuple[list[U8], F64]:
    """A skin that slides 6 mm, and the true centres in pixels; a plate falls by a millimetre."""
    camera = MockFrameCameraSettings()
    optics = FrameOptics(
        px_per_mm=camera.px_per_mm,
        tip_radius_mm=camera.tip_radius_mm,
        tip_level=camera.tip_level,
        ground_level=camera.ground_level,
        noise=noise,
    )
    view = PlateView(optics, side, side)
    layout = SimulatedWorld(MockSettings(seed=SEED)).skin.layout_mm
    along = np.linspace(-3.0, 3.0, 600)[:frames, None, None]
    tips = layout[None] + along * np.array([1.0, 0.3])
    images = np.empty((frames, side, side), np.uint8)
    heights = -(np.linspace(0.0, 1.0, frames) ** 2) if plate else None
    view.draw(images, tips, heights, np.arange(frames, dtype=np.int64), SEED)
    return list(images), view.centre_px(tips)


def _from_file(frames: int, layout: F64, runs: int) -> Figures:
    """Stored default frames, with and without a plate, decoded and tracked."""
    seconds = frames / RATE_HZ
    with tempfile.TemporaryDirectory() as folder:
        slide, fall = Path(folder) / "slide.mkv", Path(folder) / "fall.mkv"
        for path, plate in ((slide, False), (fall, True)):
            images, _ = _video(frames, MockFrameCameraSettings().noise, STORED_PX, plate)
            video = VideoWriter(path, STORED_PX, STORED_PX, RATE_HZ)
            video.write(np.stack(images))
            video.close()

        def decode() -> int:
            return sum(1 for _ in read_frames(slide, threads=2))

        def decode_and_track() -> MarkerTracks:
            return track(read_frames(slide, threads=2), layout)

        def with_plate() -> VideoTracks:
            return track_video(read_frames(fall, threads=2), layout, with_plate=True)

        taken = alternate(runs, decode=decode, track=decode_and_track, plate=with_plate)
    return {
        **rate("decode_x_realtime", seconds, taken["decode"]),
        **rate("decode_track_x_realtime", seconds, taken["track"]),
        **rate("aruco_x_realtime", seconds, taken["plate"]),
    }


def _points(detector: Any, image: U8) -> F64:
    return np.array([point.pt for point in detector.detect(image)], np.float64).reshape(-1, 2)


def _nearest(found: F64, truth: F64) -> F64:
    """The blob nearest to each true centre, (m, 2); NaN where none is within 5 px."""
    result = np.full(truth.shape, np.nan)
    if len(found):
        apart = np.hypot(*np.moveaxis(found[None] - truth[:, None], -1, 0))
        near = apart.min(axis=1) < 5.0
        result[near] = found[apart.argmin(axis=1)][near]
    return result


def _rms(apart: F64) -> float:
    """Root mean square distance, px; NaN (a marker not found) is left out."""
    return float(np.sqrt(np.nanmean(np.sum(apart**2, axis=-1))))
