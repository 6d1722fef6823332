"""Figures of studies beside a hidden world's own, and the world's rig file."""

from __future__ import annotations

import statistics
from collections import Counter
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest

from benchmarks import twin_studies
from benchmarks.twin import CLEAN, pilot_slides, prior_of
from benchmarks.twin_studies import (
    FIGURES,
    ONSETS,
    FloatArray,
    NetworkOutcome,
    lines,
    medians_ms,
    within,
)
from sliplab.analysis.detectors.latency import DetectedOnsets, TrueSlip
from sliplab.analysis.detectors.onset_references import Decided, OnsetReference
from sliplab.analysis.evaluation.trials import EvaluatedTrials
from sliplab.plugins.simulation.settings import scene_of
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
    spans = {"accuracy": (0.9, 1.2), "gross": None, "kinematic": (0.11, 0.2)}
    spans |= {"gravity": (-0.2, -0.09), "gravity_lead": (-0.3, -0.2)}
    assert [name for name, far in twin_studies.beyond(spans).items() if far] == [
        "kinematic",
        "gravity_lead",
    ]
    studies: dict[str, Any] = {"hidden": {"figures": own}}
    studies["twin"] = {"figures": {**own, "gross": 10.0}, "spans": dict.fromkeys(FIGURES)}
    studies["assumed"] = {"figures": other, "spans": dict.fromkeys(FIGURES) | spans}
    networks = {"hidden": {"accuracy": 90.0, "span": (0.0, 0.0)}}
    networks["twin"] = {"accuracy": 89.0, "span": (-1.5, -0.25)}
    by_change_point = {**studies, "twin": {"figures": own, "spans": dict.fromkeys(FIGURES)}}
    both = {"paper": studies, "change_point": by_change_point}
    table = list(lines([{"world": 3, "studies": both, "networks": networks}]))
    titles = [k for k, line in enumerate(table) if line.startswith("Times from the onset by")]
    assert [table[k].split(": ")[1] for k in titles] == ["2 pixels (paper)", "change point"]
    assert any(line.startswith("| twin | 1 of 1") for line in table[titles[1] :])
    table = table[: titles[1]] + table[-3:]
    near, far = (line for line in table if line.startswith("| twin |"))
    held = near.split(" | ")[1:]
    assert held == ["1 of 1", "1 of 1", "0 of 1", *["1 of 1"] * 4, "0 of 1 |"]
    assert far.split(" | ")[1:] == [*["0 of 1"] * 7, "1 of 1 |"]
    assert any(line.startswith("| 3 | assumed | 95.1 |") for line in table)
    assert table[-1] == "| 3 | twin | 89.0 | 1.0 | 0.2 to 1.5 |"


def test_a_median_lies_within_its_step() -> None:
    # 5 of 12 lie below the step from 14 to 24, which holds 4
    times = np.array([9.0] * 5 + [19.0] * 4 + [29.0] * 3 + [np.nan])
    assert medians_ms(times, 10.0) == pytest.approx(14.0 + 10.0 * (6 - 5) / 4)
    # clocks that differ by less than a millisecond leave times in their steps
    assert medians_ms(times + 3e-4, 10.0) == medians_ms(times, 10.0)
    rng = np.random.default_rng(3)
    rows = 10.0 * rng.integers(-3, 9, (50, 2, 17)) - 1.0
    rows[rng.random(rows.shape) < 0.6] = np.nan
    rows[7, 1] = np.nan
    for row, ours in zip(rows.reshape(100, 17), medians_ms(rows, 10.0).ravel(), strict=True):
        there = row[np.isfinite(row)].tolist()
        known = statistics.median_grouped(there, 10) if there else np.nan
        assert ours == pytest.approx(known, nan_ok=True)
    plain = pd.DataFrame(rows.reshape(100, 17)).median(axis=1).to_numpy()
    assert medians_ms(rows).ravel() == pytest.approx(plain, nan_ok=True)
    assert np.isnan(plain[15])


def test_medians_of_rounded_times_come_near_those_of_exact_ones() -> None:
    rng = np.random.default_rng(4)
    errors = []
    for middle in rng.uniform(50.0, 60.0, 200):
        times = middle + rng.normal(0.0, 20.0, 501)
        rounded = 10.0 * np.floor(times / 10.0) + 5.0
        errors.append(
            (medians_ms(rounded, 10.0) - np.median(times), np.median(rounded) - np.median(times))
        )
    ours, single = np.sqrt(np.mean(np.square(errors), axis=0))
    assert ours < 1.0 < 2.0 < single


def outcome(hits: FloatArray, times: FloatArray) -> NetworkOutcome:
    """Return an outcome whose times are the same for each figure."""
    trials = [f"trial{k}" for k in range(hits.shape[1])]
    values = {
        name: pd.DataFrame(hits if figure.time is None else times, columns=trials)
        for name, figure in FIGURES.items()
    }
    return NetworkOutcome(values, pd.Series(50.0, trials), 10.0)


def test_a_trial_that_only_one_study_has_leaves_the_others_in_pairs() -> None:
    rng = np.random.default_rng(9)
    times = np.repeat(300.0 + rng.normal(0.0, 60.0, (1, 40)), 2, axis=0)
    own = outcome(np.full((2, 40), 45.0), times)
    fewer = outcome(np.full((2, 40), 45.0), times)
    for name, values in fewer.values.items():
        fewer.values[name] = values.drop(columns=["trial3", "trial17"])
    fewer = NetworkOutcome(fewer.values, fewer.windows.drop(["trial3", "trial17"]), 10.0)
    assert fewer.figure("accuracy") == pytest.approx(90.0)
    assert fewer.against(own, "accuracy") == pytest.approx((0.0, 0.0))
    apart = outcome(np.full((2, 40), 45.0), times[:, ::-1])
    (low, high), (low_apart, high_apart) = (
        it.against(own, "gravity") or (np.nan, np.nan) for it in (fewer, apart)
    )
    assert 0.0 <= high - low < 0.5 * (high_apart - low_apart)


def test_a_study_of_slides_alone_has_no_figures_of_others() -> None:
    slides = outcome(np.full((2, 10), 45.0), np.full((2, 10), 120.0))
    for name in ("gravity", "gravity_lead", "disturbance", "disturbance_lead"):
        slides.values[name] = pd.DataFrame([{}, {}], dtype=np.float64)
    assert slides.figures()["gravity"] is None
    assert slides.against(slides, "gravity") is None
    studies: dict[str, Any] = {"hidden": {"figures": slides.figures()}}
    spans = {name: slides.against(slides, name) for name in FIGURES}
    studies["twin"] = {"figures": slides.figures(), "spans": spans}
    networks = {"hidden": {"accuracy": 90.0, "span": (0.0, 0.0)}}
    both = dict.fromkeys(ONSETS, studies)
    table = list(lines([{"world": 3, "studies": both, "networks": networks}]))
    assert "| 3 | twin | 90.0 | 120.0 | 120.0 | 3 of 3 |" in table
    assert "| twin | 1 of 1 | 1 of 1 | 1 of 1 | 1 of 1 |" in table


def test_times_count_from_the_onset_that_is_asked_for() -> None:
    ms = 1_000_000
    paper = OnsetReference(TrueSlip(500 * ms, 900 * ms, 2000 * ms))
    point = OnsetReference(TrueSlip(380 * ms, 815 * ms, 2000 * ms))
    found = DetectedOnsets(600 * ms, 920 * ms)
    decided = [
        Decided(found, {"paper": paper, "change_point": point}, 30 * ms),
        Decided(found, {"paper": paper}, 30 * ms),
    ]
    rows: Any = [(SimpleNamespace(trial=name, experiment="kinematic"), None) for name in "ab"]
    trials = [("tiny", "a"), ("tiny", "b")]
    samples: Any = SimpleNamespace(
        y=np.array([0, 1, 2, 2]), trial=np.array([0, 0, 0, 1]), trials=trials
    )
    judged = [
        EvaluatedTrials(np.array([[9, 0, 0], [0, 9, 0], [0, 9, 0], [0, 0, 9]]), samples, rows)
    ]
    by_paper, by_point = (NetworkOutcome.of(judged, [decided], onset) for onset in ONSETS)
    assert by_paper.values["kinematic"].to_dict("list") == {"a": [100.0], "b": [100.0]}
    assert by_paper.values["gross"].to_dict("list") == {"a": [20.0], "b": [20.0]}
    assert by_point.values["kinematic"]["a"].tolist() == [220.0]
    assert by_point.values["gross"]["a"].tolist() == [105.0]
    assert by_point.values["gross"]["b"].isna().all()
    assert by_paper.figure("accuracy") == by_point.figure("accuracy") == pytest.approx(75.0)
    assert by_paper.figures()["gravity"] is None
    of_windows = NetworkOutcome.of([EvaluatedTrials(judged[0].counts, samples, [])], [()], "paper")
    assert of_windows.figure("accuracy") == pytest.approx(75.0)
    assert of_windows.figures()["kinematic"] is None


def test_figures_are_means_over_networks_and_their_intervals_hold() -> None:
    rng = np.random.default_rng(7)
    held, same = [], []
    for _ in range(40):
        # trials differ far more than two studies of them, which have their chance in common
        chance = rng.normal(0.0, 60.0, (1, 60))
        one = outcome(np.full((2, 60), 45.0), 300.0 + chance + rng.normal(0.0, 5.0, (2, 60)))
        other = outcome(
            np.stack([np.full(60, 44.0), np.full(60, 43.0)]),
            330.0 + 1.1 * chance + rng.normal(0.0, 5.0, (2, 60)),
        )
        assert one.figure("accuracy") == pytest.approx(90.0)
        assert other.figure("accuracy") == pytest.approx(87.0)
        low, high = other.against(one, "gravity") or (np.nan, np.nan)
        held.append(low <= 0.1 <= high)
        same.append(high - low)
    assert sum(held) >= 35
    # a median of 60 is uncertain by 19 ms; taken apart, the two would differ by a share of 0.17
    assert np.mean(same) < 0.1
    low, high = other.against(one, "accuracy") or (np.nan, np.nan)
    assert (low, high) == pytest.approx((-4.0, -2.0))
    nothing = outcome(np.full((2, 60), 45.0), np.full((2, 60), np.nan))
    assert nothing.against(one, "gross") is None
    assert nothing.figures()["gross"] is None


@pytest.mark.long
def test_a_hidden_rig_file_is_the_world_that_was_drawn(tmp_path: Path) -> None:
    assumed = tmp_path / "assumed.yaml"
    assumed.write_text(rig_yaml(twin_studies.ASSUMED))
    base, _ = load_rig_file(assumed)
    rig, _ = load_rig_file(twin_studies.hidden_rig(tmp_path, assumed, 2, 1))
    world = replace(prior_of(CLEAN, 2), rig=base).world(1, pilot_slides())
    assert scene_of(rig) == scene_of(world.rig)
    assert scene_of(rig).scene.friction.kinetic != scene_of(base).scene.friction.kinetic
    plans = [load_plan(path) for path in twin_studies.protocols(tmp_path, 3, whole_grid=False)]
    assert [len(plan) for plan in plans] == [576, 108, 144]
    counts = Counter(trial.split for trial in plans[0])
    assert all(abs(counts[name] / 576 - share) < 0.02 for name, share in twin_studies.SPLIT.items())
    assert plans[0].protocol.analysis.also is None
    assert plans[0].protocol.analysis.training.seeds == (0, 1, 2)
    (grid,) = (load_plan(path) for path in twin_studies.protocols(tmp_path, 2, whole_grid=True))
    assert Counter(trial.split for trial in grid) == {"train": 605, "validation": 127, "test": 132}
