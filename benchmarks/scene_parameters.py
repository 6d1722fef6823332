"""Sensitivity analysis: one assumed number of the simulated scene lower, then higher.

None of these numbers was measured on a real skin. The change of onsets and event rates of the scene
alone says which are worth measuring first; `benchmarks.guesses` says the same of a whole study.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from sliplab.storage.streams import Json

CHANGE = 0.2
LARGEST_POISSON = 0.499
CONTACT = (
    "scene.skin.youngs_modulus_mpa",
    "scene.skin.poisson_ratio",
    "scene.skin.base_normal_n_per_m",
    "scene.skin.base_tangential_n_per_m",
    "scene.skin.height_scatter_mm",
    "scene.skin.relaxation_share",
    "scene.skin.relaxation_s",
    "scene.friction.kinetic",
    "scene.friction.static_excess",
    "scene.friction.strengthening",
    "scene.friction.path_variation",
    "scene.friction.correlation_mm",
    "scene.friction.papilla_scatter",
)
CAMERA = tuple(
    f"event_camera.{name}"
    for name in (
        "shift_mm_per_n",
        "growth_mm_per_n",
        "radius_mm",
        "edge_px",
        "contrast",
        "threshold",
        "threshold_sigma",
        "refractory_us",
        "noise_hz",
        "readout_hz",
    )
)
OTHER_SEED = "another seed"

AS_IT_IS = "as it is"
"""The name of the setting that changes nothing."""
NAMES = {
    "scene.friction.path_variation": "friction's variation on its path",
    "scene.friction.correlation_mm": "length of that variation",
    "scene.friction.papilla_scatter": "friction's scatter by papilla",
    "scene.friction.kinetic": "friction",
    "scene.skin.youngs_modulus_mpa": "Young's modulus of the skin",
    "scene.skin.base_normal_n_per_m": "stiffness of its base, along",
    "event_camera.shift_mm_per_n": "image's shift by force",
    "event_camera.growth_mm_per_n": "image's growth by force",
    "event_camera.radius_mm": "radius of the markers",
    "event_camera.contrast": "contrast of the markers",
    "event_camera.threshold": "threshold of events",
    "event_camera.noise_hz": "noise of events",
}
"""Titles of the assumed numbers: those that decide accuracy (docs/decisions/scene.md), and
whatever moves an onset or a rate by a tenth (`benchmarks.scene_tradeoff`)."""


@dataclass(frozen=True)
class ParameterSetting:
    """One assumed number at a factor of its value; the scene as it is has neither."""

    parameter: str | None = None
    factor: float = 1.0

    @property
    def name(self) -> str:
        """The name of the setting's results."""
        return AS_IT_IS if self.parameter is None else f"{self.parameter} x {self.factor:g}"

    def value(self, simulated: Any) -> float | None:
        """Return the changed number; None for the scene as it is.

        Args:
            simulated: settings of a simulated rig.
        """
        own = None if self.parameter is None else value_of(simulated, self.parameter)
        return None if own is None else own * self.factor

    def change(self, simulated: Any) -> Json:
        """Return the changed number as mappings in each other; Poisson's ratio stays below 1/2."""
        value = self.value(simulated)
        if self.parameter is None or value is None:
            return {}
        if self.parameter.endswith("poisson_ratio"):
            value = min(value, LARGEST_POISSON)
        found: Json = {}
        for part in reversed(self.parameter.split(".")):
            found = {part: found or value}
        return found


def lower_and_higher(parameters: Sequence[str]) -> list[ParameterSetting]:
    """Return each parameter lower, then higher."""
    factors = (1.0 - CHANGE, 1.0 + CHANGE)
    return [ParameterSetting(name, factor) for name in parameters for factor in factors]


def value_of(simulated: Any, name: str) -> float | None:
    """Return a number of a simulated rig's settings by its dotted name; None if there is none."""
    value: Any = simulated
    for part in name.split("."):
        value = getattr(value, part, None)
    return float(value) if isinstance(value, int | float) else None


def in_all(names: Sequence[str], scenes: Sequence[Any]) -> list[str]:
    """Return the parameters that are not zero in any of several rigs' simulated scenes.

    Args:
        scenes: settings of simulated rigs; None for a real one, which has no parameters.
    """
    return [name for name in names if all(value_of(scene, name) for scene in scenes)]


@dataclass(frozen=True)
class SceneOutcome:
    """Onsets and event rates of the scene at one setting.

    Attributes:
        onsets_s: of each trial first slip and duration of incipient slip, s (n, 2); NaN: none.
        rates: events a second by phase.
    """

    onsets_s: npt.NDArray[np.float64]
    rates: Mapping[str, float | None]


def sensitivity_table(
    values: Mapping[str, float | None],
    base: SceneOutcome,
    outcomes: Mapping[ParameterSetting, SceneOutcome],
    other_seed: SceneOutcome,
    event_trials: int,
) -> Json:
    """Return the change of onsets and event rates for each parameter, as plain data.

    Args:
        values: of each parameter.
        base: the scene as it is.
        outcomes: of the settings that were tried.
        event_trials: how many trials event rates are of.

    Returns:
        `rows`, each with `parameter`, `value`, and `change`: a list of two (lower, higher) of
        `first_slip_ms`, `first_slip_percent`, `incipient_percent` and by phase `percent`; None
        where there is nothing to compare. The last row is another seed and has one change.
    """
    rows: list[Json] = []
    for name, value in values.items():
        pair = [outcomes.get(setting) for setting in lower_and_higher([name])]
        change = [None if other is None else outcome_change(base, other) for other in pair]
        rows.append({"parameter": name, "value": value, "change": change})
    last = outcome_change(base, other_seed)
    rows.append({"parameter": OTHER_SEED, "value": None, "change": [last]})
    return {
        "simulated": True,
        "change": CHANGE,
        "contact_trials": len(base.onsets_s),
        "event_trials": event_trials,
        "base": {
            "first_slip_s": _mean(base.onsets_s[:, 0]),
            "incipient_s": _mean(base.onsets_s[:, 1]),
            "events_per_s": base.rates,
        },
        "rows": rows,
    }


def outcome_change(base: SceneOutcome, other: SceneOutcome) -> Json:
    """Return the change of onsets, over trials that have them in both, and of event rates."""
    both = np.isfinite(base.onsets_s) & np.isfinite(other.onsets_s)
    apart = np.where(both, other.onsets_s - base.onsets_s, np.nan)
    first = _mean(apart[:, 0])
    whole = [_mean(np.where(both, base.onsets_s, np.nan)[:, k]) for k in range(2)]
    rates = {phase: (rate, other.rates[phase]) for phase, rate in base.rates.items()}
    return {
        "first_slip_ms": None if first is None else 1e3 * first,
        "first_slip_percent": _percent(first, whole[0]),
        "incipient_percent": _percent(_mean(apart[:, 1]), whole[1]),
        "percent": {
            phase: None if a is None or b is None else _percent(b - a, a)
            for phase, (a, b) in rates.items()
        },
    }


def _percent(part: float | None, whole: float | None) -> float | None:
    return None if part is None or not whole else 100.0 * part / whole


def _mean(values: npt.NDArray[np.float64]) -> float | None:
    there = values[np.isfinite(values)]
    return float(there.mean()) if len(there) else None
