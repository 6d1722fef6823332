"""Tips that share a block against the same tips with a block each: lanes do not touch.

The law itself is held by `reference`, which shares nothing with the solver.
"""

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from sliplab.plugins.simulation.scene.contact import (
    BLOCK,
    LANES,
    ContactStep,
    make_blocks,
    move_tips,
    store_state,
)
from sliplab.plugins.simulation.scene.skin import SkinGeometry, make_skin
from sliplab.plugins.simulation.scene.slip import relaxing
from sliplab.plugins.simulation.scene.springs import (
    EARLIER,
    FREE,
    PLACE_X,
    SHORTER,
    SLIDING,
    STUCK,
    Springs,
    new_tips,
)
from sliplab.storage.kernels import njit
from tests.plugins.simulation.scene.steps import RICH, ideal_skin, line, rough, run, springs_of

SWITCHES = {**RICH, "damping_s": 0.01}


@njit()
def states(table, field, law, state, sensor, plate_y, h):  # type: ignore[no-untyped-def]
    """The state after each row, (m, n, 18)."""
    n, blocks = state.shape[0], make_blocks(table, field, state)
    decay, gain = relaxing(h, law.relaxation_s)
    found = np.empty((sensor.shape[0], *state.shape))
    for k in range(sensor.shape[0]):
        move_tips(
            blocks, n, field, law, sensor[k], plate_y[k], k * h, ContactStep(h, decay, gain, 0.0)
        )
        store_state(blocks, state)
        found[k] = state
    return found


def both(springs: Springs, sensor: np.ndarray, plate_y: np.ndarray, h: float) -> Any:
    """States of tips that have a block each, and of tips that share blocks in another order."""
    full = np.zeros((len(sensor), 5))
    full[:, : sensor.shape[1]] = sensor
    n = len(springs.table)

    def solve(which: np.ndarray) -> np.ndarray:
        table, field = springs.table[which].copy(), springs.friction[which].copy()
        state = new_tips(len(which)).state
        result: np.ndarray = states(table, field, springs.law, state, full, plate_y, h)
        return result

    alone = [solve(np.array([i])) for i in range(n)]
    shuffled = np.random.default_rng(n).permutation(n)
    together = np.empty((len(sensor), n, 18))
    together[:, shuffled] = solve(shuffled)
    return np.concatenate(alone, axis=1), together


SIDE, TILT = st.floats(-8, 8), st.floats(-0.05, 0.05)
WAYPOINT = st.tuples(SIDE, SIDE, st.floats(-0.3, 3.6), TILT, TILT, st.floats(-3, 3))
# a tip is pushed straight back while its normal force vanishes
PUSHED_BACK = [(0.0, 1.0, 1.0, 0, 0, 0), (0.0, 0, 2.25, 1 / 32, 0, 0), (0.0, 4, 2, 1 / 32, 0, 0)]


@pytest.mark.long
@settings(max_examples=120, deadline=None)
@given(
    seed=st.integers(0, 500),
    level=st.sampled_from([1, 2, 3]),
    off=st.sampled_from([None, *SWITCHES]),
    exact=st.booleans(),
    variation=st.sampled_from([0.0, 0.05, 0.3]),
    # touching, letting go, turns back and sideways, lifting off, tilts, and the plate as well
    waypoints=st.lists(WAYPOINT, min_size=2, max_size=6),
    steps=st.sampled_from([1, 7, 60, 400]),
    h=st.sampled_from([1e-4, 2e-3, 0.1]),
)
@example(0, 2, None, True, 0.0, PUSHED_BACK, 1, 0.1)
def test_tips_that_share_a_block_are_as_alone(
    seed: int, level: int, off: Any, exact: Any, variation: Any, waypoints: Any, steps: int, h: Any
) -> None:
    skin = make_skin(SkinGeometry(height_scatter_mm=0.08, friction_scatter=0.05), seed)
    options = {name: value for name, value in SWITCHES.items() if name != off}
    springs = rough(skin, variation, seed, level, exact_turns=exact, **options)
    corners = [(0.0,) * 6, *waypoints]
    way = np.concatenate([line(a, b, steps) for a, b in zip(corners, waypoints, strict=False)])
    alone, together = both(springs, way[:, :5], way[:, 5], h)
    assert np.array_equal(alone, together, equal_nan=True)
    assert np.all(np.isfinite(np.delete(together, np.s_[13], axis=2)))


@pytest.mark.long
def test_the_scenes_of_that_test_have_every_kind_of_step() -> None:
    corners = [(0, 0, -0.3), (0, 0, 3.2), (6, 0, 3.2), (6, 5, 2.0), (4, 1, 3.4), (4, 1, 0.2)]
    springs = rough(ideal_skin(), 0.3, 1, **SWITCHES)
    way = np.concatenate([line(a, b, 400) for a, b in itertools.pairwise(corners)])
    alone, together = both(springs, way, np.zeros(len(way)), 2e-3)
    assert np.array_equal(alone, together, equal_nan=True)
    modes = together[:, :, 14]
    kinds = {(a, b) for a, b in zip(modes[:-1].ravel(), modes[1:].ravel(), strict=True)}
    assert kinds >= {(FREE, FREE), (FREE, STUCK), (STUCK, STUCK), (STUCK, SLIDING)}
    assert kinds >= {(SLIDING, SLIDING), (SLIDING, STUCK), (SLIDING, FREE)}


@pytest.mark.parametrize("counts", [(1,), (1, 6), (1, 6, 12, 18), (4, 6, 12, 18)])
def test_any_number_of_tips_is_as_good(counts: tuple[int, ...]) -> None:
    heights = tuple(10.1 - 0.6 * k for k in range(len(counts)))
    skin = make_skin(SkinGeometry(ring_counts=counts, heights_mm=heights), 1)
    springs = springs_of(skin, **SWITCHES)
    way = np.concatenate([line((0, 0, 0), (0, 0, 3), 50), line((0, 0, 3), (5, 3, 3), 200)])
    tips = new_tips(len(skin))
    _, load = run(springs, tips, way, h=2e-3)
    shuffled = np.random.default_rng(1).permutation(len(skin))
    for which in (*np.arange(len(skin))[:, None], shuffled):
        part = replace(springs, table=springs.table[which], friction=springs.friction[which])
        some = new_tips(len(which))
        assert np.array_equal(run(part, some, way, h=2e-3)[1], load[:, which])
        assert np.array_equal(some.state, tips.state[which], equal_nan=True)


def test_rows_of_a_block_are_the_columns_of_state_and_table() -> None:
    springs = springs_of(ideal_skin())
    tips = new_tips(19)
    tips.state[:, :] = np.arange(19 * 18).reshape(19, 18)
    blocks = make_blocks(springs.table, springs.friction, tips.state)
    assert blocks.shape == (1,)
    assert blocks.itemsize == 8 * LANES * len(BLOCK.names)
    assert np.array_equal(blocks["place_x"][0, :19], tips.state[:, PLACE_X])
    assert np.array_equal(blocks["earlier"][0, :19], tips.state[:, EARLIER])
    assert np.array_equal(blocks["layout_x"][0, :19], springs.layout[:, 0])
    assert np.array_equal(blocks["shorter"][0, :19], springs.table[:, SHORTER])
    again = new_tips(19)
    store_state(blocks, again.state)
    assert np.array_equal(again.state, tips.state)
