"""What other methods cost and reach is said with their seeds, mean against mean."""

from __future__ import annotations

from typing import Any

import pytest

from sliplab.flows.reporting.work_section import section

Json = dict[str, Any]


def windows(*strict: float) -> Json:
    mean = sum(strict) / len(strict)
    return {
        "work": {
            "synaptic_operations": {"conv1": 10.0, "all": 10.0},
            "dense_multiply_adds": {"conv1": 100, "all": 100},
            "spikes": {"iaf1": 3.0},
            "rates": {"iaf1": 0.01},
            "share": 0.1,
            "n": 5,
            "events": 7.0,
        },
        "beside": {},
        "seeds": {
            "each": [{"seed": k} for k, _ in enumerate(strict)],
            "spread": {"strict": {"mean": mean, "min": min(strict), "max": max(strict)}},
        },
    }


def baselines(*argmax: float) -> Json:
    made = {
        "epochs": 10,
        "weights": 1234,
        "multiply_adds": 5678,
        "seeds": [{"seed": k, "argmax": share} for k, share in enumerate(argmax)],
    }
    ahead = {"share": -0.01, "low": -0.02, "high": -0.001}
    return {"cnn_frame": {"argmax": argmax[0], "network_ahead": ahead, "made": made}}


def test_means_of_seeds_stand_against_each_other() -> None:
    made = section(windows(0.93, 0.94, 0.95), baselines(0.96, 0.95, 0.94))
    said = " ".join(made.text)
    assert "Over 3 seeds the spiking network's strict accuracy is 94.0 % in the mean" in said
    assert "have 95.0 %: 1.00 points behind, ties counted as wrong" in said
    assert made.tables[-1].rows[0][-1] == "95.0 % (94.0 % to 96.0 %)"


@pytest.mark.parametrize(("ours", "theirs"), [((0.9,), (0.9, 0.8)), ((0.9, 0.8), (0.9,))])
def test_one_seed_is_no_mean(ours: tuple[float, ...], theirs: tuple[float, ...]) -> None:
    made = section(windows(*ours), baselines(*theirs))
    assert "It costs:" in " ".join(made.text)
    assert "Over" not in " ".join(made.text)


def test_without_other_methods_nothing_is_said_of_them() -> None:
    assert "It costs:" not in " ".join(section(windows(0.9, 0.8), {}).text)
