"""Rest positions of markers and offsets from them, which every label counts.

A recording begins with a hold, in which nothing should move. Rest is the mean over its first part,
as in the paper, or over its last, just before the motion; what lies between the two is slip in the
hold, or a marker that was hidden over one of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from sliplab.analysis.labels.camera_shift import CameraShift, camera_shift, no_shift
from sliplab.analysis.labels.onsets import mean_positions, relative_to_plate
from sliplab.analysis.labels.places import SURE_PX, Places

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]
Reference = Literal["hold_start", "hold_end"]


@dataclass(frozen=True)
class Offsets:
    """Offsets of m markers from one place each, over n frames, and where they rested.

    Attributes:
        away: (n, m, 2) px, the camera's own motion taken out, NaN where a marker was not seen.
        sigma: (n, m) standard deviation of a coordinate, px.
        rests: (m, 2) mean of `away` by part of the hold, NaN where a marker was hidden in it.
    """

    away: F64
    sigma: F64
    camera: CameraShift
    rests: dict[Reference, F64]

    def counted_from(self, reference: Reference) -> F64:
        """(n, m, 2) offsets from one rest; of a marker that was hidden there, from the other."""
        other: Reference = "hold_end" if reference == "hold_start" else "hold_start"
        return self.away - _either(self.rests[reference], self.rests[other])

    @property
    def hold_slip_px(self) -> F64:
        """Distance that each marker moved in the hold, (m,) px; NaN where that is unknown."""
        moved = self.rests["hold_end"] - self.rests["hold_start"]
        return np.hypot(moved[:, 0], moved[:, 1])


def offsets(places: Places, frame_ns: I64, start_ns: int, reference_ms: float) -> Offsets:
    """Offsets of markers, in trials with a sliding plate relative to the plate's own marker.

    A marker whose place is not known to a quarter of a pixel is not seen in that frame.

    Args:
        frame_ns: (n,) int64 on the time line, from the start of the hold on.
        start_ns: of the motion. reference_ms: length of the hold's first and last part.

    Raises:
        ValueError: there is no frame in the hold.
    """
    held, length_ns = frame_ns < start_ns, int(reference_ms * 1e6)
    parts: dict[Reference, npt.NDArray[np.bool_]] = {
        "hold_start": held & (frame_ns < frame_ns[:1] + length_ns),
        "hold_end": held & (frame_ns >= start_ns - length_ns),
    }
    sure = places.sigma <= SURE_PX
    xy = relative_to_plate(np.where(sure[..., None], places.flat_xy, np.nan), places.flat_plate)
    sigma = np.where(sure, places.sigma, np.nan)
    away = xy - _either(*(mean_positions(xy, frames) for frames in parts.values()))
    if places.plate is None:
        camera = camera_shift(away)
        away = away - camera.px[:, None, :]
        sigma = np.hypot(sigma, camera.sigma[:, None])
    else:
        camera = no_shift(len(frame_ns))
        sigma = np.hypot(sigma, places.plate.sigma[:, None])
    rests = {name: mean_positions(away, frames) for name, frames in parts.items()}
    return Offsets(away, sigma, camera, rests)


def _either(places: F64, others: F64) -> F64:
    """(m, 2) places, and where they are unknown the others."""
    result: F64 = np.where(np.isnan(places), others, places)
    return result
