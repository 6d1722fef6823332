"""Figures about clocks, for campaigns of any size."""

import pytest

from sliplab.analysis.report.figures.clocks import OverTrials, over_trials


@pytest.mark.parametrize("count", [1, 2, 40])
def test_a_campaign_of_any_size_fits_the_figure(count: int) -> None:
    """One trial used to leave no room for its axes, of which matplotlib warns."""
    numbers = list(range(count))
    series = {"events": ("event camera", numbers, [0.5 + 0.01 * number for number in numbers])}
    panels = [OverTrials("uncertainty (µs)", series), OverTrials("drift (ppm)", series)]
    svg = over_trials(panels, {"pilot": 0.0}, simulated=True)
    assert "simulated" in svg
    assert svg.count("<svg") == 1
