"""The paper's numbers, by one word, and what stands beside it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from sliplab.protocols import InputError, load_plan
from sliplab.protocols.presets import PAPER, at
from sliplab.protocols.settings import AnalysisSettings
from tests.conftest import ROOT

PUBLISHED: dict[str, Any] = {
    "labelling.rule": "paper",
    "labelling.reference": "hold_start",
    "labelling.threshold_px": 2,
    "windows.length_ms": 30,
    "windows.step_ms": 1,
    "windows.crop_px": 400,
    "windows.pool_px": 20,
    "windows.polarity": "positive",
    "samples.per_class": 50,
    "network.outputs_per_class": 1,
    "detection.smoothing": 4,
    "detection.margin": 2,
    "detection.choose": "protocol",
    "detection.stride_ms": None,
}
"""Lu et al.: preprocessing, data set, network, detection."""


def file(name: str, folder: Path, **analysis: Any) -> Path:
    """A protocol that ships, with changes to its `analysis:` section."""
    data = yaml.safe_load((ROOT / "protocols" / f"{name}.yaml").read_text())
    data["analysis"] |= analysis
    path = folder / f"{name}.yaml"
    path.write_text(yaml.safe_dump(data))
    return path


def settings(path: Path) -> AnalysisSettings:
    return load_plan(path).protocol.analysis


def test_the_preset_is_the_papers_table() -> None:
    found = AnalysisSettings.model_validate({"preset": "paper"})
    assert {key: at(found, key) for key in PUBLISHED} == PUBLISHED
    assert {each.key for each in PAPER if each.source == "published"} == PUBLISHED.keys()
    # the paper has a fixed loss and rate and says neither: plain cross-entropy of spike counts
    assert (found.training.gain, found.training.schedule) == (1.0, "constant")
    assert (found.training.learning_rate, found.training.warm_up) == (1e-3, 0.0)
    assert not found.network.biases
    assert not found.training.mirror  # no word of it
    assert found.overrides == ()
    assert found.split.train == pytest.approx(0.70)
    assert found.most_spikes == 30
    assert AnalysisSettings.model_validate(found.model_dump(mode="json")) == found


@pytest.mark.parametrize("name", ["pilot", "kinematic", "pilot_gravity", "disturbance"])
def test_one_key_in_a_shipped_protocol_is_enough(name: str, tmp_path: Path) -> None:
    found = settings(file(name, tmp_path, preset="paper"))
    assert found.overrides == ()
    assert found.comparison_settings() is None


def test_keys_beside_the_preset_go_before_it_and_are_named() -> None:
    data = {"preset": "paper", "network": {"hidden": 64}, "detection": {"margin": 3}}
    found = AnalysisSettings.model_validate(data)
    assert (found.network.hidden, found.network.outputs_per_class) == (64, 1)
    overrides = [(each.key, each.value, here) for each, here in found.overrides]
    assert overrides == [("network.hidden", 32, 64), ("detection.margin", 2.0, 3.0)]


def test_a_plan_warns_of_what_goes_before_the_preset(tmp_path: Path) -> None:
    warned = load_plan(file("pilot", tmp_path, preset="paper", detection={"margin": 3})).warnings()
    assert warned == ["analysis.detection.margin: 3.0 overrides 2.0 of the preset"]
    assert load_plan(file("pilot", tmp_path, preset="paper")).warnings() == []
    assert load_plan(file("pilot", tmp_path)).warnings() == []


def test_an_unknown_preset_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"analysis\.preset = papre: must be 'paper'"):
        load_plan(file("pilot", tmp_path, preset="papre"))
    with pytest.raises(InputError, match=r"analysis\.network = 3: must be a mapping"):
        load_plan(file("pilot", tmp_path, preset="paper", network=3))


def test_margins_of_all_campaigns_are_in_spikes_of_the_model(tmp_path: Path) -> None:
    """A shipped protocol with one output neuron a class once kept the margin of four."""
    model = settings(file("pilot", tmp_path, network={"outputs_per_class": 1}))
    assert model.detection.margin == 2
    for name in ("gravity", "disturbance", "pilot_gravity", "pilot"):
        for own, margin in (({}, 2.0), ({"detection": {"margin": 4}}, 1.0)):
            rule = settings(file(name, tmp_path, **own)).rule_for(1, model.detection.margin)
            assert (rule.margin, rule.smoothing) == (margin, 4)
            assert rule.margin_grid[:2] == (0.5, 1.0)
    assert model.rule_for(1, 2.0) == model.detection


def test_the_network_beside_shares_data_and_differs_in_all_else() -> None:
    data = {"also": "paper", "windows": {"length_ms": 20}, "detection": {"margin": 9}}
    training = {"epochs": 3, "seeds": [4, 5]}
    ours = AnalysisSettings.model_validate({**data, "training": training})
    found = ours.comparison_settings()
    for section in ("labelling", "windows", "samples", "split"):
        assert getattr(found, section) == getattr(ours, section)
    assert (found.training.epochs, found.training.seeds) == (3, (4,))
    assert [each.key for each, _ in found.overrides] == ["windows.length_ms"]
    assert found.detection.compare is None
    assert AnalysisSettings().comparison_settings() is None
