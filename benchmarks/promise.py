"""Is a promise of false alarms kept in other worlds? Levels of `papillae`, one by each drawn set.

Each set has as many scenes as the bench's validation, 4.1 hours of holding. A level is set on one
set, as `sliplab bench` does it, and judged on all others. `least` figures are those of the lowest
level that there is, which no choice goes below.
"""

from __future__ import annotations

import numpy as np

from benchmarks.measure import Figures
from sliplab.analysis.detectors.alarms import SceneEvidence, false_alarm_rate, promised_levels
from sliplab.analysis.detectors.detector import Evidence
from sliplab.analysis.detectors.feeding import feed
from sliplab.analysis.detectors.papillae import Papillae
from sliplab.plugins.bench.definition import SIZES
from sliplab.plugins.bench.scenes import other_validation, simulated

ASKED = 1.0
"""False alarms an hour."""


def judged(seed: int, number: int, worlds: str) -> list[SceneEvidence]:
    """Return the evidence of `papillae` above zero on one set of scenes."""
    found = []
    for drawn in other_validation(SIZES["full"], seed, number, worlds):
        scene = simulated(drawn)
        evidence = feed(Papillae(), scene)
        some = evidence.value > 0.0
        evidence = Evidence.of(evidence.t_us[some], evidence.value[some])
        world = f"{number}: {scene.world}"  # other sets have worlds of the same names
        found.append(SceneEvidence(evidence, scene.slip, world))
    return found


def measure(sets: int = 2, seed: int = 803322622, worlds: str = "hard") -> Figures:
    """Figures of so many sets of worlds; each takes some two minutes."""
    every = [judged(seed, number, worlds) for number in range(sets)]
    least = false_alarm_rate([scene for one in every for scene in one], 0.0)
    kept = 0
    for number, one in enumerate(every):
        level = max(promised_levels(one, [ASKED])[0].value, 0.0)
        others = [scene for other in every[:number] + every[number + 1 :] for scene in other]
        kept += bool((false_alarm_rate(others or one, level).value or 0.0) <= ASKED)
    nothing = float(np.nan)
    return {
        "sets": float(sets),
        "kept_sets": float(kept),
        "hours": least.hours,
        "least_alarms": float(least.alarms),
        "least_per_hour": nothing if least.value is None else least.value,
        "least_per_hour_low": nothing if least.low is None else least.low,
        "least_per_hour_high": nothing if least.high is None else least.high,
    }
