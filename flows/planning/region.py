"""Whether the outside camera's region covers what a protocol's motion shows to it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from sliplab.flows.planning.device_checks import Check
from sliplab.protocols.program import Move

if TYPE_CHECKING:
    from sliplab.flows.planning.run_request import RunRequest


def check_region(run_request: RunRequest) -> list[Check]:
    """Markers that leave the recorded region somewhere on their way, none if it has no video.

    The centre marker must stay in it, since gross slip is read from it. Outer ones that leave are
    only told of: they are not measured while they are cut by the edge.
    """
    size_px = run_request.rig.frame_px(run_request.plan)
    if size_px is None:
        return []
    scale = run_request.rig.frame_camera.scale_px_per_mm
    half = [side / scale / 2 for side in size_px]
    radius = float(run_request.rig.skin.radius)
    reach = _reach(run_request)
    skin = max(math.hypot(x, y) for x, y in run_request.rig.skin.layout_mm())
    spare = min(limit - way - radius for limit, way in zip(half, reach, strict=True))
    if spare < 0:
        text = (
            f"{2 * half[0]:.1f} x {2 * half[1]:.1f} mm is too small: the centre marker goes "
            f"{max(reach):.1f} mm from the middle and has a radius of {radius:g} mm; widen "
            f"recording.region by {-2 * spare:.1f} mm"
        )
        return [Check("region", False, text)]
    text = f"covers the centre marker on every way, with {spare:.1f} mm to spare"
    if spare < skin:
        text += f"; markers more than {spare:.1f} mm from the centre leave it on the longest"
    return [Check("region", True, text)]


def _reach(run_request: RunRequest) -> tuple[float, float]:
    """How far from the middle recorded motion takes the sensor, mm, right and up."""
    x = y = 0.0
    for trial in run_request.plan:
        for step in run_request.plan.program(trial).steps:
            if isinstance(step, Move) and step.recorded:
                x, y = max(x, abs(step.to.x_mm)), max(y, abs(step.to.y_mm))
    return x, y
