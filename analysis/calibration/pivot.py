"""The tool's tip from poses in which it touched one fixed point: least squares in closed form.

For flange poses (R_i, p_i) with the tip t in the flange's axes and the fixed point c in the base's,
R_i t + p_i = c. That is linear in t and c. How well it is known depends on how much the tool leant
between the poses: turning about one axis only says nothing along it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Floats = NDArray[np.float64]

LEAST_POSES = 4
LEAST_SPREAD = 0.1
"""Least RMS travel of the flange, in mm for a mm of tip, in the worst known direction."""


class PivotError(ValueError):
    """Poses from which the tip cannot be found; the text says what to do."""


@dataclass(frozen=True)
class Pivot:
    """Result of pivoting.

    Attributes:
        tip_mm: from the flange, in its axes, (3,).
        point_mm: the fixed point, in the base's axes, (3,).
        residual_mm: root mean square distance of the tip from the point.
        errors_mm: that distance of each pose, (n,).
        spread: how well the orientations determine the worst known direction, 0 to about 1.
        uncertainty_mm: one standard deviation of the tip in that direction.
    """

    tip_mm: Floats
    point_mm: Floats
    residual_mm: float
    errors_mm: Floats
    spread: float
    uncertainty_mm: float


def find_tip(xyz_mm: Floats, rotvec_deg: Floats) -> Pivot:
    """The tip of a tool that stayed on one point.

    Args:
        xyz_mm: places of the flange, (n, 3).
        rotvec_deg: its rotation vectors, degrees, (n, 3).

    Raises:
        PivotError: fewer than four poses, non-finite numbers, or degenerate orientations (all
            alike, or turned about one axis only).
    """
    xyz, turns = np.asarray(xyz_mm, np.float64), np.asarray(rotvec_deg, np.float64)
    if xyz.shape != turns.shape or xyz.ndim != 2 or xyz.shape[1] != 3:
        raise PivotError(f"poses have the shapes {xyz.shape} and {turns.shape}: must be (n, 3)")
    if len(xyz) < LEAST_POSES:
        raise PivotError(f"{len(xyz)} poses: at least {LEAST_POSES} are needed")
    if not (np.isfinite(xyz).all() and np.isfinite(turns).all()):
        raise PivotError("a pose holds a number that is none")
    rotations = Rotation.from_rotvec(np.radians(turns)).as_matrix()
    # the point drops out of the differences from the mean
    apart = (rotations - rotations.mean(axis=0)).reshape(-1, 3)
    spread = float(np.linalg.svd(apart, compute_uv=False)[-1] / np.sqrt(len(xyz)))
    if spread < LEAST_SPREAD:
        raise PivotError(
            f"the orientations are too much alike (spread {spread:.3f}, at least "
            f"{LEAST_SPREAD:g} is needed): lean the tool by 20 degrees or more, about two axes"
        )
    centred = (xyz - xyz.mean(axis=0)).reshape(-1)
    tip = np.linalg.lstsq(apart, -centred, rcond=None)[0]
    ends = rotations @ tip + xyz
    point = ends.mean(axis=0)
    off = ends - point
    errors = np.linalg.norm(off, axis=1)
    sigma = float(np.sqrt((off**2).sum() / (3 * len(xyz) - 6)))
    return Pivot(
        tip,
        point,
        float(np.sqrt((errors**2).mean())),
        errors,
        spread,
        sigma / (spread * float(np.sqrt(len(xyz)))),
    )
