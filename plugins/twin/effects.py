"""The effects of a simulated scene, and the settings that leave each of them out.

Plans, slides and cameras differ in what they can show of them: those that no straight slide shows
are listed as well, so that none is left out in silence.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from sliplab.storage.streams import Json

LONG_STEP_MS = 8
"""Step of the contact that is tried in place of a shorter one."""


@dataclass(frozen=True, eq=False)
class Effect:
    """One effect of a scene.

    Attributes:
        key: short name. title: for people.
        without: settings of the section `mock:` that leave it out, as mappings in each other.
        beside: base settings of the comparison with and without it.
        only_with: keys of effects that are left out with it.
    """

    key: str
    title: str
    without: Json
    beside: Json = field(default_factory=dict)
    only_with: tuple[str, ...] = ()


def _skin(**settings: Any) -> Json:
    return {"scene": {"skin": settings}}


def _friction(**settings: Any) -> Json:
    return {"scene": {"friction": settings}}


def _camera(**settings: Any) -> Json:
    return {"event_camera": settings}


EFFECTS = (
    Effect("relaxation", "relaxation of the skin after pressing", _skin(relaxation_share=0.0)),
    Effect("stick_slip", "static over kinetic friction (stick-slip)", _friction(static_excess=0.0)),
    Effect("path", "friction that varies along a path", _friction(path_variation=0.0)),
    Effect("speed", "friction that rises with speed", _friction(strengthening=0.0)),
    Effect(
        "bending",
        "large deflection, up to buckling",
        {"scene": {"level": "L1"}},
        {"scene": {"level": "L2"}},
        ("relaxation", "stick_slip", "speed"),
    ),
    Effect(
        "base",
        "compliance of the base",
        _skin(base_normal_n_per_m=None, base_tangential_n_per_m=None),
    ),
    Effect(
        "papillae",
        "differences between papillae",
        {
            "scene": {
                "skin": {"papillae": None, "height_scatter_mm": 0.0, "position_scatter_mm": 0.0},
                "friction": {"papilla_scatter": 0.0},
            }
        },
    ),
    Effect("vibration", "vibration of the arm", {"arm": {"vibration_um": 0.0}}),
    Effect("growth", "markers that grow with force", _camera(growth_mm_per_n=0.0)),
    Effect("mismatch", "mismatch of the pixels' thresholds", _camera(threshold_sigma=0.0)),
    Effect(
        "negative",
        "thresholds of their own for negative events",
        _camera(threshold_off=None, threshold_off_sigma=None),
    ),
    Effect("refractory", "refractory time of a pixel", _camera(refractory_us=0.0)),
    Effect("bandwidth", "bandwidth of a pixel", _camera(cutoff_hz=0.0)),
    Effect("noise", "noise of all pixels", _camera(noise_hz=0.0)),
    Effect("leakage", "leakage as a part of the noise", _camera(leak_share=0.0)),
    Effect("falling", "leakage that moves a pixel's reference level", _camera(leak="events")),
    Effect("hot", "hot pixels", _camera(hot_pixels=0)),
    Effect("readout", "read-out in scans", _camera(readout_hz=0.0)),
    Effect("columns", "columns that are read one after the other", _camera(scan_us=0.0)),
    Effect("chords", "smooth paths between two steps", _camera(path="chord")),
)
NOT_SHOWN = {
    "dynamics of the falling plate": "gravity trials",
    "damping and stiction of the plate's slider": "gravity trials",
    "what a twist of the sensor does": "trials with a twist",
}
"""Effects that no straight slide shows, and trials that do."""


def effects_of(mock: Any) -> Iterator[Effect]:
    """Yield the effects that a simulated rig's scene has.

    Args:
        mock: settings of the rig, with its scene at the highest level.
    """
    step_ms = mock.scene.step_ms
    if step_ms < LONG_STEP_MS:
        yield Effect(
            "steps",
            f"steps of the contact of {step_ms} instead of {LONG_STEP_MS} ms",
            {"scene": {"step_ms": LONG_STEP_MS}},
        )
    for effect in EFFECTS:
        if _differs(mock, effect.without):
            yield effect


def lacking(mock: Any) -> Iterator[Effect]:
    """Yield the effects that a simulated rig's scene could have and has not."""
    for effect in EFFECTS:
        if not _differs(mock, effect.without):
            yield effect


def merged(*settings: Mapping[str, Any]) -> Json:
    """Return settings in which later ones replace earlier ones, key by key."""
    found: Json = {}
    for one in settings:
        for key, value in one.items():
            inner = isinstance(value, Mapping)
            found[key] = merged(found.get(key, {}), value) if inner else value
    return found


def _differs(part: Any, settings: Mapping[str, Any]) -> bool:
    return any(
        _differs(getattr(part, key), value)
        if isinstance(value, Mapping)
        else getattr(part, key) != value
        for key, value in settings.items()
    )
