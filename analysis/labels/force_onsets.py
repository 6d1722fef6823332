"""Onsets of slip from the force along the plate: where its rise slackens, and where it ends.

While all tips stick, the force along the plate grows in proportion to the motion. With the first
tips that slide the rise becomes flatter (incipient), and once most of the load slides it ends
(gross): the drop of the tangential stiffness that is read as slip from a force sensor alone. Either
is the knee of two straight lines that meet, fitted by least squares to the force along the slide.

Forces are sums over the skin: what one tip does hardly shows in them, and the centre of a skin,
which slips last, carries a small share. So this gross onset comes before that of the centre's
marker as a rule (docs/force.md).
"""

from __future__ import annotations

import numpy as np

from sliplab.analysis.force import PlateForces, has_forces, plate_forces
from sliplab.storage.schema.label import RuleOnsets
from sliplab.storage.streams import F64
from sliplab.storage.trials.recording import Recording

BINS = 600
"""Means of neighbouring samples that a line is fitted to, at most."""
_FEWEST = 20
FLAT = 0.5
"""The rise has ended where its slope behind the knee is below this share of the one before."""
FLATTER = 0.9
"""It has slackened where it is below this one."""


def force_onsets(forces: PlateForces, start_ns: int, stop_ns: int) -> RuleOnsets:
    """Find the onsets in the force during a slide.

    Args:
        start_ns: start of the slide on the time line; stop_ns: its end.
    """
    part = forces.between(start_ns, stop_ns)
    none = RuleOnsets(incipient_ns=None, gross_ns=None)
    if len(part.t_ns) < _FEWEST:
        return none
    late = part.force_n[len(part.t_ns) // 2 :, :2].mean(axis=0)
    size = float(np.hypot(*late))
    if size == 0.0:
        return none
    along = part.force_n[:, :2] @ (late / size)
    t_s = np.asarray((part.t_ns - start_ns) * 1e-9, np.float64)
    gross_s = knee_s(t_s, along, FLAT)
    if gross_s is None:
        return none
    before = t_s < gross_s
    incipient_s = knee_s(t_s[before], along[before], FLATTER)
    if incipient_s is not None:  # each knee again, of the part that the other one leaves
        after = t_s >= incipient_s
        gross_s = knee_s(t_s[after], along[after], FLAT) or gross_s
        before = t_s < gross_s
        incipient_s = knee_s(t_s[before], along[before], FLATTER)
    return RuleOnsets(
        incipient_ns=None if incipient_s is None else start_ns + round(incipient_s * 1e9),
        gross_ns=start_ns + round(gross_s * 1e9),
    )


def onsets_by_force(recording: Recording) -> RuleOnsets | None:
    """Find a trial's onsets in its forces; None without forces, or without a slide."""
    if recording.motion_phase != "slide" or not has_forces(recording):
        return None
    return force_onsets(plate_forces(recording), *recording.motion_ns)


def knee_s(t_s: F64, values: F64, flatter: float) -> float | None:
    """Return where two straight lines that meet fit a rising curve best, s.

    Args:
        t_s, values: (n,), rising times.
        flatter: largest share of the slope before the knee that may be left behind it.

    Returns:
        None with fewer than 20 samples, or where the curve does not rise and then bend so.
    """
    if len(t_s) < _FEWEST:
        return None
    edges = np.linspace(0, len(t_s), min(BINS, len(t_s)) + 1).astype(np.int64)
    counts = np.diff(edges)
    t = np.add.reduceat(t_s, edges[:-1]) / counts
    y = np.add.reduceat(values, edges[:-1]) / counts
    knots = t[2:-2]
    basis, _ = np.linalg.qr(np.stack([np.ones_like(t), t], axis=1))
    left = y - basis @ (basis.T @ y)

    def hinges(columns: F64) -> F64:
        """Return products of the hinge of each knot, max(t - knot, 0), with columns (n, m)."""
        behind = np.cumsum((t[:, None] * columns)[::-1], axis=0)[::-1]
        count = np.cumsum(columns[::-1], axis=0)[::-1]
        return behind[3:-1] - knots[:, None] * count[3:-1]

    # what a hinge adds to a line is what of it no line can show; its square is that of the hinge
    # less that of its projection, and sums over what lies behind a knot are made once for all
    since = hinges(np.stack([t, np.ones_like(t)], axis=1))
    square = since[:, 0] - knots * since[:, 1] - (hinges(basis) ** 2).sum(axis=1)
    k = int(np.argmax(hinges(left[:, None])[:, 0] ** 2 / square))
    design = np.stack([np.ones_like(t), t, np.maximum(t - knots[k], 0.0)], axis=1)
    _, before, bend = np.linalg.lstsq(design, y, rcond=None)[0].tolist()
    if before <= 0.0 or before + bend >= flatter * before:
        return None
    return float(knots[k])
