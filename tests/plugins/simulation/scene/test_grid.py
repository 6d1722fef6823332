"""The whole kinematic grid by contact alone: what every lab's first figure shows."""

import itertools
from typing import Any

import numpy as np
import pytest

from benchmarks.one_slide import SlideRun, run_slide
from sliplab.plugins.simulation.physics import springs_of
from sliplab.plugins.simulation.settings import MockSettings, skin_of

DEPTHS = (2.4, 2.6, 2.8, 3.0, 3.2, 3.4)
SPEEDS = (0.6, 0.8, 1.0, 1.2, 1.4, 1.6)
DIRECTIONS = range(0, 360, 45)


@pytest.fixture(scope="module")
def runs() -> tuple[np.ndarray, np.ndarray]:
    """Of the 864 trials, simulated: onsets, s after the start of the slide, (864, 19), and how
    far all markers together move in the image a second, mm/s, while loading, through three thirds
    of the incipient phase, and in gross slip, (864, 5)."""
    settings = MockSettings(seed=1)
    skin = skin_of(settings)
    rows, motion = [], []
    grid = itertools.product(DEPTHS, SPEEDS, DIRECTIONS, range(3))
    for seed, (depth, speed, direction, _) in enumerate(grid):
        springs = springs_of(settings, skin, seed)
        run = run_slide(springs, depth, speed, direction, step_mm=0.25)
        rows.append(run.slipped_s)
        motion.append(_motion(run, settings.event_camera.shift_mm_per_n))
    return np.array(rows), np.array(motion)


def _motion(run: SlideRun, shift_mm_per_n: float) -> list[float]:
    force = run.loads.reshape(len(run.loads), -1, 3)[:, :, :2]
    moved = shift_mm_per_n * np.linalg.norm(np.diff(force, axis=0), axis=2).sum(axis=1)
    t_s = run.t_ns * 1e-9
    first, last = np.nanmin(run.slipped_s), run.slipped_s[0]
    borders = [0.0, first, *(first + (last - first) * np.array([1 / 3, 2 / 3, 1.0])), t_s[-1]]
    way = np.concatenate([[0.0], np.cumsum(moved)])
    return (np.diff(np.interp(borders, t_s, way)) / np.diff(borders)).tolist()


@pytest.fixture(scope="module")
def grid(runs: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """The onsets alone."""
    return runs[0]


def test_every_papilla_of_every_trial_slips(grid: np.ndarray) -> None:
    assert grid.shape == (864, 19)
    assert np.all(np.isfinite(grid))


def test_slip_runs_from_the_outer_layer_to_the_centre_in_all_864(grid: np.ndarray) -> None:
    ring = skin_of(MockSettings(seed=1)).ring
    outer, middle, centre = (grid[:, ring == layer] for layer in (2, 1, 0))
    assert np.all(outer.max(axis=1) < middle.min(axis=1))
    assert np.all(middle.max(axis=1) < centre[:, 0])


def test_incipient_slip_is_long_enough_for_fifty_windows_in_most(grid: np.ndarray) -> None:
    incipient = grid[:, 0] - grid.min(axis=1)
    assert np.mean(incipient > 50 * 0.030) > 0.95
    assert incipient.max() < 15 / 0.6


def test_deeper_and_slower_is_later(grid: np.ndarray) -> None:
    first = grid.min(axis=1).reshape(6, 6, 24).mean(axis=2)
    gross = grid[:, 0].reshape(6, 6, 24).mean(axis=2)
    for onset in (first, gross):
        assert np.all(np.diff(onset, axis=0) > 0)
        assert np.all(np.diff(onset, axis=1) < 0)


def test_markers_move_most_while_loading_and_little_in_gross_slip(runs: Any) -> None:
    """The story of the event rate: a sharp rise before the first slip, falling through the
    incipient phase as papillae let go one after another, low but not silent in gross slip."""
    loading, early, middle, late, gross = runs[1].T
    assert np.mean(loading > early) > 0.97
    assert np.all(early > middle)
    assert np.all(middle > late)
    assert np.mean(late > gross) > 0.85  # only the centre still sticks then
    assert np.median(gross / loading) < 0.2
    assert np.median(gross / loading) > 0.01


def test_an_even_scene_is_silent_in_gross_slip() -> None:
    """Without friction that varies, nothing tells gross slip from holding still."""
    friction = {"path_variation": 0.0, "static_excess": 0.0}
    settings = MockSettings.model_validate({"seed": 1, "scene": {"friction": friction}})
    run = run_slide(springs_of(settings, skin_of(settings), 1), 2.8, 1.0, step_mm=0.25)
    motion = _motion(run, settings.event_camera.shift_mm_per_n)
    assert motion[4] < 1e-3 * motion[0]
