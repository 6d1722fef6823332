"""Settings that follow from each other."""

from __future__ import annotations

from typing import Any

import pytest

from sliplab.protocols import load_plan
from sliplab.protocols.hashing import hash_data
from sliplab.protocols.key_errors import KeyedError
from sliplab.protocols.settings import AnalysisSettings
from sliplab.protocols.windows import Windows
from tests.conftest import ROOT


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


def test_settings_without_taxels_are_stored_as_before_there_were_any() -> None:
    square = {"length_ms": 30, "step_ms": 1, "crop_px": 400, "pool_px": 20, "polarity": "positive"}
    assert Windows().model_dump() == square
    assert Windows(taxels=None).model_dump(mode="json") == square
    # of SlipLab 1.0: keys of models and of evaluations are made from them
    found = hash_data(AnalysisSettings().model_dump(mode="json"))
    assert found == "ba3f1eaee0a4518bbe74c3f30c34533e8dcbba3fc60ff1ec2808ad03f67edb7c"
    plan = load_plan(ROOT / "protocols" / "kinematic.yaml")
    data = plan.protocol.analysis.model_dump(mode="json")
    assert data["training"]["seeds"] == [0, 1, 2]
    data["training"]["seeds"] = [0]  # the shipped protocol trained one network then
    assert hash_data(data) == "fea09f2994b5c46b7ea14175ca0080c60de8d3efc4f186fb5165a7fc61a4b77c"


def test_taxels_are_channels_of_one_cell() -> None:
    found = Windows(length_ms=250, taxels=39, polarity="both")
    assert (found.steps, found.channels, found.cells) == (250, 78, 1)
    assert Windows(taxels=39).channels == 39
    assert Windows(taxels=39, parts=3).channels == 117
    assert found.model_dump()["taxels"] == 39
    assert Windows.model_validate(found.model_dump()) == found
    assert found != Windows(length_ms=250, polarity="both")


def test_a_network_that_begins_as_a_regression_learns_slower() -> None:
    data: dict[str, Any] = {"windows": {"taxels": 39}}
    found = AnalysisSettings.model_validate(data)
    assert found.network.start == "regression"
    usual = AnalysisSettings().training.learning_rate
    assert found.training.learning_rate == usual / 8
    assert AnalysisSettings.model_validate(found.model_dump(mode="json")) == found
    compared = AnalysisSettings.model_validate({**data, "also": "paper"}).comparison_settings()
    assert compared is not None
    assert (compared.network.start, compared.network.hidden) == ("random", 32)
    sized = AnalysisSettings.model_validate({**data, "network": {"hidden": 32}})
    assert sized.network.start == "random"
    given = AnalysisSettings.model_validate({**data, "training": {"learning_rate": 0.1}})
    assert given.training.learning_rate == 0.1


@pytest.mark.parametrize(
    ("network", "windows", "key", "right"),
    [
        ({}, {}, "start", "needs windows.taxels"),
        ({"biases": False}, {"taxels": 4}, "biases", "must be true"),
        ({"hidden": 8}, {"taxels": 4}, "hidden", "must be left out"),
        ({"conv1_kernel": 1}, {"taxels": 4}, "conv1_kernel", "must be left out"),
        ({}, {"taxels": 5000}, "start", "4096 channels at most"),
    ],
)
def test_what_does_not_go_with_a_start_by_regression(
    network: dict[str, Any], windows: dict[str, Any], key: str, right: str
) -> None:
    data = {"network": {"start": "regression", **network}, "windows": windows}
    with pytest.raises(ValueError, match=right) as caught:
        AnalysisSettings.model_validate(data)
    (error,) = caught.value.errors()
    assert error["ctx"]["error"].key == f"analysis.network.{key}"


@pytest.mark.parametrize(
    ("data", "key", "right"),
    [
        ({"taxels": 39, "crop_px": 200}, "crop_px", "must be left out with taxels = 39"),
        ({"taxels": 39, "pool_px": 1}, "pool_px", "must be left out with taxels = 39"),
        ({"taxels": 39, "length_ms": 5, "step_ms": 2}, "step_ms", "must divide length_ms"),
        ({"parts": 2}, "parts", "needs taxels"),
        ({"parts": 9, "taxels": 4, "length_ms": 8}, "parts", "must not exceed the 8 steps"),
        ({"crop_px": 30}, "pool_px", "must divide crop_px"),
    ],
)
def test_what_does_not_fit_a_window_is_named(data: dict[str, Any], key: str, right: str) -> None:
    with pytest.raises(ValueError, match=right) as caught:
        Windows.model_validate(data)
    (error,) = caught.value.errors()  # type: ignore[attr-defined]
    assert isinstance(error["ctx"]["error"], KeyedError)
    assert error["ctx"]["error"].key == f"analysis.windows.{key}"
