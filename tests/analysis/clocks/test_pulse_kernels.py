"""Compiled loops over pulses against numpy, to the bit."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from sliplab.analysis.clocks import pulse_kernels
from sliplab.analysis.clocks.pulse_kernels import best_shift, changes, places_of, robust_values

Floats = NDArray[np.float64]
TIMES = st.lists(st.integers(0, 40), min_size=1, max_size=30).map(
    lambda times: np.sort(np.array(times, np.float64))
)


def nearest(grid: Floats, values: Floats) -> NDArray[np.int64]:
    if grid.size == 1:
        return np.zeros(values.size, np.int64)
    right = np.clip(np.searchsorted(grid, values), 1, grid.size - 1)
    left = right - 1
    return np.where(values - grid[left] <= grid[right] - values, left, right).astype(np.int64)


@given(predicted=TIMES, y=TIMES, gate=st.integers(0, 5))
def test_pairs_are_each_others_nearest(predicted: Floats, y: Floats, gate: int) -> None:
    there = nearest(y, predicted)
    mutual = nearest(predicted, y)[there] == np.arange(predicted.size)
    expected = np.flatnonzero(mutual & (np.abs(y[there] - predicted) <= gate))
    i, j = pulse_kernels.pair(predicted, y, float(gate))
    assert i.tolist() == expected.tolist()
    assert j.tolist() == there[expected].tolist()


@given(predicted=TIMES, y=TIMES, reach=st.integers(1, 9))
def test_partners_lie_within_reach(predicted: Floats, y: Floats, reach: int) -> None:
    apart = y[None, :] - predicted[:, None]
    expected = np.nonzero((apart >= -reach) & (apart < reach))
    which, partner = pulse_kernels.partners(predicted, y, float(reach))
    assert which.tolist() == expected[0].tolist()
    assert partner.tolist() == expected[1].tolist()


@given(ordered=TIMES, window=st.integers(0, 9))
def test_the_fullest_window_is_the_first_of_the_best(ordered: Floats, window: int) -> None:
    held = np.searchsorted(ordered, ordered + window, side="right") - np.arange(ordered.size)
    assert pulse_kernels.fullest(ordered, float(window)) == ordered[int(held.argmax())]


@given(values=st.lists(st.floats(-1e9, 1e9), min_size=1, max_size=50), share=st.floats(0, 1))
def test_median_and_quantile_are_numpys(values: list[float], share: float) -> None:
    array = np.array(values)
    assert pulse_kernels.median(array) == np.median(array)
    assert pulse_kernels.quantile(array, share) == np.quantile(array, share)


@pytest.mark.parametrize("n", [2, 3, 9])
def test_normal_equations_are_weighted_sums(n: int) -> None:
    rng = np.random.default_rng(n)
    x, y = np.sort(rng.uniform(0, 100, 400)), rng.normal(0, 3, 400)
    knots = np.linspace(x[0], x[-1], n)
    piece, share = places_of(x, knots)
    at = np.clip(np.searchsorted(knots, x, side="right") - 1, 0, n - 2)
    assert piece.tolist() == at.tolist()
    assert share.tolist() == ((x - knots[at]) / (knots[at + 1] - knots[at])).tolist()
    matrix, right = pulse_kernels.normal_equations(piece, share, y, y, 5.0, 2.0, n)
    weights = np.where(np.abs(y) <= 5.0, np.minimum(1.0, 2.0 / np.maximum(np.abs(y), 1e-9)), 0.0)
    assert matrix[0, 0] == np.bincount(piece, weights * (1 - share) ** 2, n - 1)[0]
    assert matrix[-1, -1] == np.bincount(piece, weights * share**2, n - 1)[-1]
    between = np.bincount(piece, weights * share * (1 - share), n - 1)
    assert np.diag(matrix, 1).tolist() == np.diag(matrix, -1).tolist() == between.tolist()
    assert right[0] == np.bincount(piece, weights * (1 - share) * y, n - 1)[0]
    assert right[-1] == np.bincount(piece, weights * share * y, n - 1)[-1]
    values = rng.normal(0, 1, n)
    line = values[piece] + share * (values[piece + 1] - values[piece])
    assert pulse_kernels.residuals_at(piece, share, y, values).tolist() == (y - line).tolist()


def hats(x: Floats, knots: Floats) -> Floats:
    """The line's basis at pulses, (n, k)."""
    return np.stack([np.interp(x, knots, each) for each in np.eye(knots.size)], axis=1)


@pytest.mark.parametrize("n", [2, 4, 7])
def test_a_change_stands_out_as_least_squares_says(n: int) -> None:
    rng = np.random.default_rng(n)
    x = np.sort(rng.uniform(0, 1, 150))
    x[[0, -1]] = 0.0, 1.0
    knots = np.linspace(0, 1, n)
    basis = hats(x, knots)
    residuals = rng.normal(0, 3, x.size)
    residuals[::17] = 40.0
    weights = np.where(np.abs(residuals) <= 9.0, np.minimum(1.0, 4.0 / np.abs(residuals)), 0.0)
    inverse = np.linalg.inv(basis.T * weights @ basis)
    piece, share = places_of(x, knots)
    found = changes(x, piece, share, residuals, 9.0, 4.0, 6.0, inverse, 1, 5)

    def shown(column: Floats) -> Floats:
        # what is left of a column beside the basis, with weights
        return column - basis @ (inverse @ (basis.T @ (weights * column)))

    def high(column: Floats) -> tuple[float, float]:
        left = shown(column)
        norm = float((weights * left**2).sum())
        top = float((weights * left * residuals).sum())
        return (abs(top) / norm**0.5, top / norm) if norm > 0.5 else (0.0, 0.0)

    used = weights > 0
    steps, ends, tails, bends = [], [], [], []
    for j in np.flatnonzero(used):
        edge = min(used[j:].sum(), used[:j].sum())
        beside = min((used & (piece == piece[j]) & later).sum() for later in (x >= x[j], x < x[j]))
        if edge >= 3:
            steps.append(high((x >= x[j]) * 1.0))
            ends += steps[-1:] if edge <= 32 else []
        if 3 <= edge <= 8:
            behind = used & ((x >= x[j]) if used[j:].sum() == edge else (x < x[j]))
            # the share of a step of these pulses that the line does not take
            kept = (weights * shown((x >= x[j]) * 1.0) ** 2).sum() / weights[behind].sum()
            total = np.clip(residuals[behind], -6.0, 6.0).sum()
            tails.append((abs(total) / (edge * kept) ** 0.5, abs(total / (edge * kept)), j))
        if edge >= 3 and beside >= 5:
            slope = np.maximum(x - x[j], 0.0)
            left = shown(slope)
            norm = (weights * left**2).sum()
            bends.append((abs((weights * left * residuals).sum()) / norm**0.5, j))
    assert found[0] == pytest.approx(max(bends)[0], rel=1e-6)
    assert found[1] == max(bends)[1]
    assert found[2:4] == pytest.approx(max(steps), rel=1e-9)
    assert found[4:6] == pytest.approx(max(ends), rel=1e-9)
    assert (found[6], abs(found[7]), found[8]) == pytest.approx(max(tails), rel=1e-9)


@pytest.mark.parametrize("n", [2, 3, 9])
def test_the_robust_values_solve_hubers_equations(n: int) -> None:
    rng = np.random.default_rng(n)
    x = np.sort(rng.uniform(0, 100, 400))
    knots = np.linspace(x[0], x[-1], n)
    y = np.sin(x / 30) + rng.normal(0, 0.1, x.size)
    y[::11] += rng.uniform(1, 9, y[::11].size)
    piece, share = places_of(x, knots)
    begin = np.zeros(n)
    values, residuals, inside = robust_values(
        piece, share, y, np.zeros(x.size), begin, 1e-6, 5.0, 1.345, 1e-9
    )
    sigma = 1.4826 * np.median(np.abs(residuals))
    assert residuals == pytest.approx(y - np.interp(x, knots, values), abs=1e-12)
    assert inside.tolist() == (np.abs(residuals) <= 5 * sigma).tolist()
    pull = np.where(inside, np.clip(residuals, -1.345 * sigma, 1.345 * sigma), 0.0)
    assert hats(x, knots).T @ pull == pytest.approx(np.zeros(n), abs=1e-5)
    # without a gate and a limit they are least squares
    values = robust_values(piece, share, y, np.zeros(x.size), begin, 1e-6, np.inf, np.inf, 1e-9)[0]
    assert values == pytest.approx(np.linalg.lstsq(hats(x, knots), y, rcond=None)[0], abs=1e-8)


def test_the_largest_sizes_are_those_of_the_product() -> None:
    rng = np.random.default_rng(5)
    draws, root = rng.normal(size=(50, 6)), np.tril(rng.normal(size=(6, 6)))
    assert pulse_kernels.largest_sizes(draws, root) == pytest.approx(
        np.abs(draws @ root.T).max(axis=1)
    )


@pytest.mark.parametrize("at_ends", [False, True])
def test_most_off_looks_at_every_window(at_ends: bool) -> None:
    rng = np.random.default_rng(3)
    on_line = rng.random(60) < 0.6
    fits = np.concatenate([[0], np.cumsum(on_line)])
    low = np.sort(rng.integers(0, 70, 60))
    high = low + rng.integers(0, 3, 60)
    for width in (8, 60):
        off = [0]
        for first in [0, 60 - width] if at_ends else range(61 - width):
            there = high[first + width - 1] - low[first]
            if there <= 1.5 * width:
                off.append(min(width, there) - (fits[first + width] - fits[first]))
        assert pulse_kernels.most_off(width, fits, low, high, at_ends) == max(off)


@given(st.integers(0, 2**32 - 1), st.integers(1, 6), st.floats(0.1, 0.9))
def test_the_best_shift_is_that_of_all_parts_that_begin_or_end_a_train(
    seed: int, most: int, share: float
) -> None:
    rng = np.random.default_rng(seed)
    there = (rng.random(40) < share).astype(np.int8)
    at = np.flatnonzero(rng.random(40 - 2 * most) < 0.6) + most
    explained = {
        shift: max(
            int((there[part + shift] - there[part]).sum())
            for cut in range(at.size + 1)
            for part in (at[:cut], at[cut:])
        )
        for shift in range(-most, most + 1)
        if shift != 0
    }
    found, more = best_shift(there, at, most)
    assert more == max(0, *explained.values())
    if more > 0:
        assert found == next(shift for shift, value in explained.items() if value == more)
