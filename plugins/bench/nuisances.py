"""Nuisances of test scenes: those of protocols, except motions of the arm.

They act in the whole scene, in its hold as in its slide, at strengths that the scene's seed draws.
"""

from __future__ import annotations

from decimal import Decimal

import numpy as np

from sliplab.plugins.simulation.nuisances import faults_of
from sliplab.plugins.simulation.settings import MockSettings
from sliplab.protocols.nuisances import SHIPPED, TrialNuisances
from sliplab.rigs.core.faults import AnyFault

SLIDE_S = 12.0
"""Nuisances go on for so long after the hold."""
NUISANCES = tuple(name for name, nuisance in SHIPPED.items() if not nuisance.by_arm)


def nuisance_faults(
    name: str, hold_s: float, rig: MockSettings, rng: np.random.Generator
) -> tuple[AnyFault, ...]:
    """Return the faults of a scene with a nuisance, at half to double its strength.

    Args:
        hold_s: length of the scene's hold.
        rig: that is disturbed.
    """
    percent = round(100 * 2 ** rng.uniform(-1.0, 1.0))
    scaled = SHIPPED[name].scaled(Decimal(percent) / 100)
    nuisances = TrialNuisances((scaled,), hold_s + SLIDE_S)
    return tuple(faults_of(nuisances, rig.event_camera, int(rng.integers(2**31))))
