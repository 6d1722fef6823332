"""Map the image back to the plate's plane, by the plate's own marker.

Seen askew, a plate that falls takes the papillae's markers and its own by different ways, and their
difference is not the motion on the plate. The marker is a square of one size wherever the plate is,
so its corners along a trial determine the perspective; the directions of the plane's axes are
neither observable nor needed. Straight on, nothing is found and nothing is changed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

Floats = NDArray[np.float64]

CORNER_PX = 0.03
"""Standard deviation of a corner's coordinate."""
_TILT = 1e-4
_STRETCH = 0.1
"""Priors: perspective a pixel (30 degrees at 300 mm and 20 px/mm are 1e-4), and stretch."""
_FRAMES = 16
_SURE = 25.0
"""Reduction of chi squared required to fit perspective; noise of four parameters gives 4."""


@dataclass(frozen=True)
class Perspective:
    """Perspective of a picture: x' = (x + A x) / (1 + g x) about the picture's centre.

    Attributes:
        stretch: (2,) of A = [[a, b], [b, -a]], which keeps areas at the centre.
        tilt: (2,) g, 1/px.
    """

    centre: Floats
    stretch: Floats
    tilt: Floats

    def flat(self, xy: Floats) -> Floats:
        """Places in the plane, px at the picture's centre, (..., 2) from (..., 2)."""
        p = xy - self.centre
        a, b = self.stretch
        depth = 1.0 + p @ self.tilt
        moved = p + np.stack(
            (a * p[..., 0] + b * p[..., 1], b * p[..., 0] - a * p[..., 1]), axis=-1
        )
        result: Floats = moved / depth[..., None] + self.centre
        return result


def plane_of(
    corners: Floats, seen: NDArray[np.bool_], size_px: tuple[int, int]
) -> Perspective | None:
    """The plane in which a square's corners make the same square in every frame.

    Args:
        corners: (n, 4, 2) px. seen: (n,) bool, where they were measured.
        size_px: width and height of the picture.

    Returns:
        None where no tilt of the camera can be detected.
    """
    here = np.flatnonzero(seen & np.isfinite(corners).all(axis=(1, 2)))
    if len(here) < 2:
        return None
    centre = (np.array(size_px, np.float64) - 1) / 2
    places = corners[here].mean(axis=1)
    # spread along the plate's path: in most frames it hangs where it was before it fell
    way = np.hypot(*(places - places[0]).T)
    order = np.argsort(way, kind="stable")
    targets = np.linspace(way[order[0]], way[order[-1]], _FRAMES)
    chosen = np.unique(order[np.minimum(np.searchsorted(way[order], targets), len(order) - 1)])
    squares = corners[here[chosen]]

    def misfit(values: Floats) -> Floats:
        plane = Perspective(centre, values[:2] * _STRETCH, values[2:] * _TILT)
        return np.concatenate((_unlike(plane.flat(squares)).ravel() / CORNER_PX, values))

    straight = misfit(np.zeros(4))
    fit = least_squares(misfit, np.zeros(4))
    if float(straight @ straight) - 2 * float(fit.cost) < _SURE:
        return None
    return Perspective(centre, fit.x[:2] * _STRETCH, fit.x[2:] * _TILT)


def _unlike(quads: Floats) -> Floats:
    """Return the residuals of (k, 4, 2) corners from one best-fitting square."""
    middle = quads - quads.mean(axis=1, keepdims=True)
    z = middle[..., 0] + 1j * middle[..., 1]
    unit = np.array([-1 - 1j, 1 - 1j, 1 + 1j, -1 + 1j]) / 2
    # one size and one turn for all: the plate slides and does not turn
    scale = (z * unit.conj()).sum() / (np.abs(unit) ** 2).sum() / len(z)
    off = z - scale * unit
    return np.stack((off.real, off.imag), axis=-1)
