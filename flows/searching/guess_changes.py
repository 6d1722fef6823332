"""Figures of a study's trials at one setting of the scene, and how they change with it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from sliplab.analysis.metrics.intervals import difference, share_difference

Json = dict[str, Any]

AS_IT_IS = "as it is"
"""The name of the setting that changes nothing."""
FIGURES = {
    "strict": "windows right",
    "incipient_ms": "incipient latency",
    "gross_ms": "gross latency",
    "gravity_lead_ms": "gravity lead",
    "disturbance_lead_ms": "disturbance lead",
    "depth_zero_mm": "depth zero",
}
"""What is compared, and how it is called. Depth zero is what the rig found by touching the plate:
it tells contact by events, so a guess of the camera moves it, and with it every depth."""
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
"""The guesses in words: the three families of decision 12 that decide accuracy, and whatever moves
an onset or a rate by a tenth (its table)."""
UNITS = {name: "%" if name == "strict" else name.rsplit("_", 1)[1] for name in FIGURES}


def figures(setting: Json) -> dict[str, float | None]:
    """The compared figures of one setting, by the names of `FIGURES`."""
    values = _values(setting)
    right = sum(found[0] for found in setting["windows"].values())
    count = sum(found[1] for found in setting["windows"].values())
    summary: dict[str, float | None] = {"strict": right / count if count else None}
    for name, found in values.items():
        there = [value for value in found.values() if value is not None]
        middle = np.median if name in ("incipient_ms", "gross_ms") else np.mean
        summary[name] = float(middle(there)) if there else None
    return summary


def changes(base: Json, other: Json) -> dict[str, tuple[float, float] | None]:
    """The 95 % interval of each figure's change, over trials that both have."""
    found: dict[str, tuple[float, float] | None] = {}
    first, second = _values(other), _values(base)
    for name in first:
        both = sorted(first[name].keys() & second[name].keys())
        pair = [np.array([of[name][t] for t in both], np.float64) for of in (first, second)]
        statistic = "median" if name in ("incipient_ms", "gross_ms") else "mean"
        found[name] = difference(pair[0], pair[1], statistic, paired=True)
    trials = sorted(other["windows"].keys() & base["windows"].keys())
    hits = [np.array([of["windows"][t] for t in trials]).reshape(-1, 2).T for of in (other, base)]
    found["strict"] = share_difference((hits[0][0], hits[0][1]), (hits[1][0], hits[1][1]))
    return found


def _values(setting: Json) -> dict[str, dict[str, float | None]]:
    """Latencies and leads by trial; None where a trial has none."""
    found: dict[str, dict[str, float | None]] = {name: {} for name in FIGURES if name != "strict"}
    for row in setting["trials"]:
        latency = row["latency"] or {}
        trial = f"{row['campaign']}/{row['trial']}"
        found["depth_zero_mm"][trial] = row["depth_zero_mm"]
        for name, key in _keys(row["experiment"]):
            found[name][trial] = latency.get(key)
    return found


def _keys(experiment: str) -> Iterator[tuple[str, str]]:
    if experiment == "kinematic":
        yield from (("incipient_ms", "latency_incipient_ms"), ("gross_ms", "latency_gross_ms"))
    else:
        yield f"{experiment}_lead_ms", "lead_ms"
