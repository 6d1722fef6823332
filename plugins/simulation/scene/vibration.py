"""An arm that trembles while it moves: small sines on top of its path.

No source gives amplitude or frequency for a slow slide; both are settings. How strongly an arm
trembles depends on its pose, so each trial draws its own share of the largest amplitude. The
tremor is the structure's and does not show in the poses that the controller reports.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from sliplab.plugins.simulation.scene.randomness import generator

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]

TONES = 2


class ArmVibration:
    """Two sines an axis, whose frequencies belong to the rig's seed and phases to the trial's."""

    def __init__(self, peak_um: float, frequency_hz: float, rig_seed: int, trial_seed: int) -> None:
        """`peak_um`: largest displacement along an axis; each trial has 0 to 1 of it.

        Frequencies lie within 30 % of `frequency_hz`.
        """
        draw = generator(trial_seed, "vibration")
        self._amplitude_mm = draw.uniform() * peak_um * 1e-3 / TONES
        self._phase: F64 = draw.uniform(0, 2 * np.pi, (TONES, 3))
        spread = generator(rig_seed, "vibration").uniform(0.7, 1.3, (TONES, 3))
        self._rad_per_s: F64 = 2 * np.pi * frequency_hz * spread

    def __bool__(self) -> bool:
        return self._amplitude_mm > 0.0

    def at(self, t_ns: I64) -> F64:
        """Displacement along the plate's x, y and z at full strength, mm, (k, 3) from (k,)."""
        seconds = t_ns * 1e-9
        result = np.zeros((len(t_ns), 3))
        for turn, phase in zip(self._rad_per_s, self._phase, strict=True):
            result += self._amplitude_mm * np.sin(seconds[:, None] * turn + phase)
        return result
