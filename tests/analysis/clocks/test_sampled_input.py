"""An input that is looked at in step with the ticks: its stamps stand still, then all move."""

from __future__ import annotations

import numpy as np
import pytest

from sliplab.analysis.clocks.clocks import ClockRefused, fit_clock
from tests.analysis.clocks.test_clocks import TICK_NS, code

CYCLE_NS = 2_000_000
LIMIT = {"jitter_ns": 600_000.0, "max_drift_ppm": 400.0}


def sampled(phase_ns: int, ppm: float, seconds: float = 4.0) -> tuple[np.ndarray, np.ndarray]:
    """The box's pulses, and when a controller that looks every 2 ms first sees each."""
    reference = np.flatnonzero(code(int(seconds * 1e9 / TICK_NS), 77)).astype(np.int64) * TICK_NS
    true = np.round(reference * (1 + ppm * 1e-6)).astype(np.int64) + phase_ns
    return -(-true // CYCLE_NS) * CYCLE_NS, reference


@pytest.mark.parametrize("ppm", [-150.0, -40.0, 5.0, 60.0, 190.0])
@pytest.mark.parametrize("share", [0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 0.8, 0.9, 0.95, 0.98])
def test_stamps_that_move_by_a_unit_are_no_drift(ppm: float, share: float) -> None:
    # the edge of a unit is passed at this share of the train
    phase_ns = -round(share * 4e9 * ppm * 1e-6)
    device, reference = sampled(phase_ns, ppm)
    assert np.ptp(device - reference) == CYCLE_NS
    fit = fit_clock(
        device, reference, **LIMIT, resolution_ns=CYCLE_NS, rounding="up", in_order=True
    )
    true = np.round(reference * (1 + ppm * 1e-6)).astype(np.int64) + phase_ns
    assert np.abs(fit.map.to_reference(true) - reference).max() <= fit.uncertainty_ns
    assert fit.uncertainty_ns < 2.5e6  # its gate is 3 ms


def test_a_clock_that_really_drifts_too_much_is_refused() -> None:
    device, reference = sampled(0, 900.0)
    with pytest.raises(ClockRefused, match="differ by"):
        fit_clock(device, reference, **LIMIT, resolution_ns=CYCLE_NS, rounding="up")
