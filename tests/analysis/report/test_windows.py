"""Other methods are compared with their seeds, mean against mean."""

from __future__ import annotations

import pytest

from sliplab.analysis.report.page import render_section
from sliplab.analysis.report.windows import WorkSection, work_section
from sliplab.storage.schema import evaluation
from sliplab.storage.schema.evaluation import Seeds, SeedScores, SeedSpread, Share, TrainedBaseline
from sliplab.storage.schema.summary import Kinematic


def made(strict: tuple[float, ...], argmax: tuple[float, ...]) -> tuple[WorkSection, str]:
    """The section of a network with these accuracies, and a rival's; and its words."""
    layers = {"conv1": 10.0, "all": 10.0}
    work = evaluation.WindowWork(
        synaptic_operations=layers,
        dense_multiply_adds={"conv1": 100, "all": 100},
        share=0.1,
        spikes={"iaf1": 3.0},
        rates={"iaf1": 0.01},
        events=7.0,
        n=5,
    )
    mean = SeedSpread(mean=sum(strict) / len(strict), min=min(strict), max=max(strict))
    each = tuple(
        SeedScores(
            seed=k, chosen=not k, validation_strict=None, argmax=share, strict=share, margin=share
        )
        for k, share in enumerate(strict)
    )
    rivals = {}
    if argmax:
        seeds = [{"seed": k, "argmax": share} for k, share in enumerate(argmax)]
        rivals["cnn_frame"] = TrainedBaseline(
            argmax=argmax[0],
            low=None,
            high=None,
            network_ahead=Share(share=-0.01, low=-0.02, high=-0.001, n=5, trials=2),
            made={"epochs": 10, "weights": 1234, "multiply_adds": 5678, "seeds": seeds},
        )
    found = work_section(
        Kinematic.model_construct(
            work=work,
            seeds=Seeds(each=each, spread={"strict": mean}),
            beside={},
            trained_baselines=rivals,
        )
    )
    assert found is not None
    return found, " ".join(render_section(found, simulated=True).html.split())


def test_means_of_seeds_stand_against_each_other() -> None:
    found, said = made((0.93, 0.94, 0.95), (0.96, 0.95, 0.94))
    assert "Over 3 seeds the spiking network's strict accuracy is 94.0 % in the mean" in said
    assert "have 95.0 %: 1.00 points behind, ties counted as wrong" in said
    assert "behind it (difference -2.0 to -0.1 in 95 %); the difference is significant." in said
    assert found.others.rows[0][-1] == "95.0 % (94.0 % to 96.0 %)"


@pytest.mark.parametrize(("ours", "theirs"), [((0.9,), (0.9, 0.8)), ((0.9, 0.8), (0.9,))])
def test_one_seed_is_no_mean(ours: tuple[float, ...], theirs: tuple[float, ...]) -> None:
    _, said = made(ours, theirs)
    assert "Cost:" in said
    assert "Over" not in said


def test_without_other_methods_nothing_is_said_of_them() -> None:
    assert "Cost:" not in made((0.9, 0.8), ())[1]
