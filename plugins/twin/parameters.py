"""The parameters of a simulated rig that a pilot may determine.

None of them was measured when a rig file was written: they are assumed. Each is a
number of the rig file's section `mock:`, positive, and is estimated as a logarithm, so that an
interval is a factor either way. The threshold of events is not among them: contrast, threshold and
its mismatch scale together without changing an event, so the threshold keeps the rig's value.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from sliplab.storage.streams import F64

Stream = Literal["frames", "events", "force"]


@dataclass(frozen=True)
class SceneParameter:
    """One number of a simulated rig.

    Attributes:
        key: in the section `mock:` of a rig file, with dots; `LAYER_STEP` for the step between the
            heights of neighbouring layers.
        title: for people. unit: of its values.
        streams: those without which nothing is learned of it.
        most: largest value that a rig file may have.
    """

    key: str
    title: str
    unit: str
    streams: tuple[Stream, ...]
    most: float = np.inf


LAYER_STEP = "scene.skin.layer_step_mm"
"""Scale of `scene.skin.heights_mm`: one factor changes all steps, the centre is fixed."""

CONTACT = (
    SceneParameter("scene.friction.kinetic", "kinetic friction", "", ("frames", "force")),
    SceneParameter(
        "scene.friction.static_excess", "excess of static friction", "", ("frames",), 0.9
    ),
    SceneParameter(
        "scene.friction.path_variation", "friction's variation along a path", "", ("frames",), 0.3
    ),
    SceneParameter(
        "scene.friction.correlation_mm", "length of friction's variation", "mm", ("frames",)
    ),
    SceneParameter(
        "scene.friction.papilla_scatter", "friction's scatter by papilla", "", ("frames",), 0.3
    ),
    SceneParameter(
        "scene.skin.youngs_modulus_mpa", "Young's modulus of the skin", "MPa", ("force",)
    ),
    SceneParameter(
        "scene.skin.base_normal_n_per_m", "normal stiffness of the base", "N/m", ("force",)
    ),
    SceneParameter(
        "scene.skin.base_tangential_n_per_m",
        "tangential stiffness of the base",
        "N/m",
        ("frames", "force"),
    ),
    SceneParameter(LAYER_STEP, "step of height between layers", "mm", ("frames",)),
    SceneParameter(
        "scene.skin.height_scatter_mm", "scatter of the papillae's heights", "mm", ("frames",)
    ),
    SceneParameter(
        "scene.skin.position_scatter_mm", "scatter of the papillae's places", "mm", ("frames",)
    ),
    SceneParameter(
        "scene.skin.relaxation_share", "share of a force that relaxes", "", ("frames",), 0.9
    ),
    SceneParameter("scene.skin.relaxation_s", "time of relaxation", "s", ("frames",)),
    SceneParameter("arm.vibration_um", "arm's vibration", "um", ("frames",)),
    SceneParameter("arm.vibration_hz", "frequency of the vibration", "Hz", ("frames",)),
)
CAMERA = (
    SceneParameter("event_camera.px_per_mm", "scale of the event camera", "px/mm", ("events",)),
    SceneParameter("event_camera.radius_mm", "radius of the markers", "mm", ("events",)),
    SceneParameter(
        "event_camera.shift_mm_per_n", "image's shift per force", "mm/N", ("events", "force")
    ),
    SceneParameter(
        "event_camera.growth_mm_per_n", "markers' growth per force", "mm/N", ("events", "force")
    ),
    SceneParameter("event_camera.edge_px", "width of the markers' edge", "px", ("events",)),
    SceneParameter("event_camera.contrast", "markers' contrast (threshold kept)", "", ("events",)),
    SceneParameter("event_camera.threshold_sigma", "mismatch of the threshold", "", ("events",)),
    SceneParameter("event_camera.cutoff_hz", "bandwidth of a pixel", "Hz", ("events",)),
    SceneParameter("event_camera.refractory_us", "refractory time", "us", ("events",)),
    SceneParameter("event_camera.noise_hz", "noise of a pixel", "Hz", ("events",)),
    SceneParameter(
        "event_camera.leak_share", "share of leakage in the noise", "", ("events",), 1.0
    ),
    SceneParameter("event_camera.hot_pixels", "hot pixels", "", ("events",)),
    SceneParameter("event_camera.hot_hz", "rate of a hot pixel", "Hz", ("events",)),
    SceneParameter("event_camera.readout_hz", "scan rate of the read-out", "Hz", ("events",)),
    SceneParameter("event_camera.scan_us", "duration of a scan", "us", ("events",)),
)
PARAMETERS = (*CONTACT, *CAMERA)


GAIN_SLOPES: Mapping[str, float] = {
    "scene.skin.youngs_modulus_mpa": 1.0,
    "scene.skin.base_normal_n_per_m": 1.0,
    "scene.skin.base_tangential_n_per_m": 1.0,
    "event_camera.shift_mm_per_n": -1.0,
    "event_camera.growth_mm_per_n": -1.0,
}
"""Exponents of the force sensor's gain in what is fitted. A skin that is stiffer by a factor, seen
with an image that moves less by it, differs from a gain in nothing that a pilot shows."""


def value_of(mock: Any, parameter: SceneParameter) -> float:
    """Return a parameter's value in a simulated rig's settings; 0 where it is switched off."""
    if parameter.key == LAYER_STEP:
        heights = mock.scene.skin.heights_mm
        return float(heights[0] - heights[-1]) / max(len(heights) - 1, 1)
    for name in parameter.key.split("."):
        mock = getattr(mock, name)
    return float(mock)


def settings_of(mock: Any, values: Mapping[str, float]) -> dict[str, Any]:
    """Return settings of `mock:` in which parameters have other values, as nested mappings.

    Args:
        mock: settings of a simulated rig that are changed.
        values: by key.
    """
    found: dict[str, Any] = {}
    for key, value in values.items():
        changed: Any = float(value)
        if key == LAYER_STEP:
            heights = np.array(mock.scene.skin.heights_mm)
            step = (heights[0] - heights[-1]) / max(len(heights) - 1, 1)
            key = "scene.skin.heights_mm"
            changed = tuple((heights[0] + (heights - heights[0]) * value / step).tolist())
        elif key == "event_camera.hot_pixels":
            changed = round(value)
        *parents, last = key.split(".")
        part = found
        for name in parents:
            part = part.setdefault(name, {})
        part[last] = changed
    return found


def prior_bounds(mock: Any, parameters: Sequence[SceneParameter], spread: float) -> tuple[F64, F64]:
    """Return least and largest logarithm of each parameter around a rig's values, both (p,).

    Args:
        spread: largest factor less 1, either way: 0.3 is from 1/1.3 to 1.3 times the value.
    """
    middle, reach = np.log([value_of(mock, it) for it in parameters]), np.log1p(spread)
    return middle - reach, np.minimum(middle + reach, np.log([it.most for it in parameters]))


def drawn(
    mock: Any, parameters: Sequence[SceneParameter], spread: float, rng: np.random.Generator
) -> dict[str, float]:
    """Draw values around those of a rig, uniform in their logarithms within `prior_bounds`."""
    logarithms = rng.uniform(*prior_bounds(mock, parameters, spread))
    return {it.key: float(v) for it, v in zip(parameters, np.exp(logarithms), strict=True)}
