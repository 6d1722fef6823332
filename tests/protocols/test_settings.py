"""Settings that follow from each other."""

from __future__ import annotations

import pytest

from sliplab.protocols.settings import AnalysisSettings


@pytest.mark.parametrize("outputs", [1, 4, 10])
def test_what_is_in_spikes_goes_with_the_number_of_output_neurons(outputs: int) -> None:
    data = {"network": {"outputs_per_class": outputs}}
    found = AnalysisSettings.model_validate(data)
    assert found.training.gain == pytest.approx(0.25 / outputs)
    assert found.detection.margin == 2 * outputs
    assert found.detection.margin_grid[:2] == (0.5 * outputs, outputs)
    assert found.most_spikes == 30 * outputs
    # written out and read again it is the same
    assert AnalysisSettings.model_validate(found.model_dump(mode="json")) == found
    said = {**data, "training": {"gain": 0.1}, "detection": {"margin": 3, "margin_grid": [1, 3]}}
    found = AnalysisSettings.model_validate(said)
    assert (found.training.gain, found.detection.margin) == (0.1, 3.0)
    assert found.detection.margin_grid == (1.0, 3.0)
