"""Figures of studies beside a hidden world's own, and the world's rig file."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path

from benchmarks.twin import CLEAN, pilot_slides, prior_of
from benchmarks.twin_studies import (
    ASSUMED,
    FIGURES,
    REPETITIONS,
    SPLIT,
    hidden_rig,
    lines,
    shipped,
    within,
)
from sliplab.protocols import load_plan
from sliplab.rigs.rig_file import load_rig_file
from sliplab.rigs.rig_inheritance import rig_yaml


def test_a_figure_that_is_missing_or_too_far_away_does_not_hold() -> None:
    own = {**dict.fromkeys(FIGURES, 100.0), "accuracy": 94.0, "gross": None}
    other = {**own, "accuracy": 95.1, "gravity": 110.0, "gravity_lead": 110.1, "disturbance": None}
    held = within(own, other)
    assert [name for name in FIGURES if held[name]] == ["kinematic", "gravity", "disturbance_lead"]
    assert within(own, {**own, "accuracy": 93.0})["accuracy"]
    assert not within(own, {**own, "kinematic": 112.0})["kinematic"]
    assert within({**own, "kinematic": 79.0}, {**own, "kinematic": 89.0}, 10.1)["kinematic"]
    networks = {name: {"share": 90.0, "low": None, "high": None} for name in ("hidden", "twin")}
    studies = {"hidden": own, "twin": {**own, "gross": 10.0}, "assumed": other}
    table = list(lines([{"world": 3, "studies": studies, "networks": networks}]))
    counts = next(line for line in table if line.startswith("| twin |")).split(" | ")[1:]
    assert counts == ["1 of 1", "1 of 1", "0 of 1", *["1 of 1"] * 4, "0 of 1", "0 of 1 |"]
    assert any(line.startswith("| 3 | assumed | 95.1 |") for line in table)
    assert table[-1] == "| 3 | twin | 90.0 | - |"


def test_a_hidden_rig_file_is_the_world_that_was_drawn(tmp_path: Path) -> None:
    assumed = tmp_path / "assumed.yaml"
    assumed.write_text(rig_yaml(ASSUMED))
    base, _ = load_rig_file(assumed)
    rig, _ = load_rig_file(hidden_rig(tmp_path, assumed, 2, 1))
    world = replace(prior_of(CLEAN, 2), rig=base).world(1, pilot_slides())
    assert rig.scene == world.rig.scene
    assert rig.scene.scene.friction.kinetic != base.scene.scene.friction.kinetic
    plans = [load_plan(shipped(name, tmp_path, count)) for name, count in REPETITIONS.items()]
    assert [len(plan) for plan in plans] == [576, 108, 48]
    counts = Counter(trial.split for trial in plans[0])
    assert all(abs(counts[name] / 576 - share) < 0.02 for name, share in SPLIT.items())
    assert plans[0].protocol.analysis.also is None
