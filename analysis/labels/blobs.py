"""White round blobs in a frame, and which papilla each of them is.

The paper's method of finding markers: threshold, then blobs. It is the slow one, used on the first
frame of a video and wherever a marker was lost; `analysis.labels.markers` follows them from there.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

from sliplab.protocols.later import Later
from sliplab.storage.kernels import njit

if TYPE_CHECKING:
    import cv2
else:
    cv2 = Later("cv2")

Frame = NDArray[np.uint8]
Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Blobs:
    """Bright round blobs of one frame.

    Attributes:
        xy: (k, 2) float64, intensity-weighted centroids in pixels; the centre of the top left pixel
            is (0, 0).
        area: (k,) float64, pixels above the threshold.
        roundness: (k,) float64, 1 for a disc, 0.955 for a square, 2ab/(a² + b²) for an ellipse.
    """

    xy: Floats
    area: Floats
    roundness: Floats


def find_blobs(
    frame: Frame,
    min_area_px: float = 50.0,
    max_area_px: float = 20_000.0,
    min_roundness: float = 0.965,
) -> Blobs:
    """Bright discs anywhere in a frame: threshold and connected components.

    Roundness is A²/(2π(μ20 + μ02)) of the pixels above the threshold: a disc has the smallest
    second moment of all shapes of its area, so hollow, long and square ones fall below 1.

    Args:
        frame: (h, w) uint8.
        min_area_px, max_area_px: bounds on the number of pixels.
        min_roundness: blobs less round are left out. A blob cut by the frame's edge mostly is.

    Raises:
        TypeError: the frame is not 2-D uint8.
    """
    frame = checked_frame(frame)
    # the grey level that best parts the frame into dark and bright (Otsu 1979)
    level, binary = cv2.threshold(frame, 0, 1, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(binary, connectivity=4, ltype=cv2.CV_16U)
    found: list[tuple[float, float, float, float]] = []
    for label in range(1, len(stats)):
        left, top, width, height, area = (int(v) for v in stats[label])
        if not (min_area_px <= area <= max_area_px and 0.6 < width / height < 1.67):
            continue
        box = np.s_[top : top + height, left : left + width]
        moments = _moments(frame[box], labels[box], label, int(level))
        if moments[3] >= min_roundness:
            found.append((moments[0] + left, moments[1] + top, float(area), moments[3]))
    table = np.array(found, np.float64).reshape(-1, 4)
    return Blobs(table[:, :2].copy(), table[:, 2].copy(), table[:, 3].copy())


def match_layout(
    xy: Floats, layout_px: Floats, tolerance_px: float
) -> tuple[Floats, NDArray[np.int64]]:
    """Assign blobs to markers; the layout may shift but not turn.

    The shift under which most markers have a blob within the tolerance wins, the smaller residual
    among equals; the blobs are then given to the markers at the least total distance.

    Args:
        xy: (k, 2) blobs, pixels; more or fewer than there are markers.
        layout_px: (m, 2) nominal positions, pixels, about any origin.
        tolerance_px: farther than this from its place no blob is a marker.

    Returns:
        the shift (2,), and (m,) int64 indices into `xy`, -1 for a marker without a blob.
    """
    m = len(layout_px)
    if len(xy) == 0:
        return np.zeros(2), np.full(m, -1, np.int64)
    shifts = (xy[:, None] - layout_px[None]).reshape(-1, 2)
    distance, _ = cKDTree(xy).query(
        layout_px[None] + shifts[:, None], distance_upper_bound=tolerance_px
    )
    near = np.isfinite(distance)
    # a found marker outweighs any distance within the tolerance
    loss = np.where(near, distance, 2 * m * tolerance_px).sum(axis=1)
    shift = shifts[int(loss.argmin())]
    for _ in range(3):
        apart = np.hypot(*np.moveaxis(xy[None] - layout_px[:, None] - shift, -1, 0))
        rows, columns = linear_sum_assignment(np.where(apart < tolerance_px, apart, 1e6))
        retained = apart[rows, columns] < tolerance_px
        rows, columns = rows[retained], columns[retained]
        if len(rows) == 0:
            break
        shift = np.median(xy[columns] - layout_px[rows], axis=0)
    index = np.full(m, -1, np.int64)
    index[rows] = columns
    return shift, index


def checked_frame(frame: Frame) -> Frame:
    """A frame fit for the kernels: contiguous; a TypeError when it is not (h, w) uint8."""
    if frame.dtype != np.uint8 or frame.ndim != 2:
        raise TypeError(f"a frame must be (h, w) uint8, not {frame.shape} {frame.dtype}")
    return np.ascontiguousarray(frame)


@njit(cache=True, nogil=True)
def _moments(part: Any, labels: Any, label: int, threshold: int) -> Any:
    """(x, y, weight, roundness) of a component; x, y weighted by the excess over the threshold."""
    weight, wx, wy = 0.0, 0.0, 0.0
    n, sx, sy, sxx = 0.0, 0.0, 0.0, 0.0
    for i in range(part.shape[0]):
        for j in range(part.shape[1]):
            if labels[i, j] == label:
                w = float(part[i, j]) - threshold
                weight += w
                wx += w * j
                wy += w * i
                n += 1
                sx += j
                sy += i
                sxx += i * i + j * j
    # a pixel is a square, with its own second moment
    spread = sxx - (sx * sx + sy * sy) / n + n / 6
    return wx / weight, wy / weight, weight, n * n / (2 * np.pi * spread)
