"""The baselines find what there is to find, exactly where that can be said."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sliplab.analysis.metrics.classification import accuracy
from sliplab.analysis.networks import baselines
from sliplab.analysis.networks.baselines import RIDGE, cell_sums, cheap_votes, fit_logistic
from sliplab.analysis.windows.sparse import SparseWindows


def samples(totals: list[int]) -> SparseWindows:
    """Samples (2, 1, 2, 2) with these totals."""
    x = np.zeros((len(totals), 8), np.uint8)
    for row, total in zip(x, totals, strict=True):
        row[: total // 255] = 255
        row[total // 255] = total % 255
    return SparseWindows.of(x.reshape(-1, 2, 1, 2, 2))


def shares(
    train_x: SparseWindows,
    train_y: np.ndarray,
    test_x: SparseWindows,
    test_y: np.ndarray,
    classes: int = 3,
) -> dict[str, float | None]:
    """Accuracy on the test samples, ties shared."""
    votes = cheap_votes(train_x, train_y, test_x, classes)
    return {name: accuracy(each, test_y).argmax for name, each in votes.items()}


def test_sums_of_cells_and_steps_are_those_of_dense_counts() -> None:
    rng = np.random.default_rng(3)
    dense = (rng.poisson(0.3, (20, 4, 2, 3, 3)) * rng.integers(0, 255, (20, 4, 2, 3, 3))) % 256
    dense[7] = 0
    x = SparseWindows.of(dense.astype(np.uint8))
    np.testing.assert_array_equal(cell_sums(x), dense.sum(axis=1).reshape(20, 18))
    np.testing.assert_array_equal(baselines.step_sums(x), dense.sum(axis=(2, 3, 4)))
    assert cell_sums(x.take(np.arange(0))).shape == (0, 18)


def test_logistic_on_cells_finds_what_the_rate_cannot() -> None:
    rng = np.random.default_rng(4)
    y = rng.integers(0, 3, 240)
    dense = np.zeros((240, 2, 1, 2, 2), np.uint8)
    dense.reshape(240, 2, 4)[np.arange(240), rng.integers(0, 2, 240), y] = rng.integers(5, 50, 240)
    x = SparseWindows.of(dense)
    first, last = np.arange(160), np.arange(160, 240)
    votes, said = baselines.logistic_cells(x.take(first), y[first], x.take(last))
    assert accuracy(votes, y[last]).strict == 1.0
    assert (said["weights"], said["multiply_adds"]) == (15, 12)
    rate = shares(x.take(first), y[first], x.take(last), y[last])["logistic"]
    assert rate < 0.6


def test_separable_rates_are_found_by_both() -> None:
    rng = np.random.default_rng(0)
    y = rng.integers(0, 3, 300)
    low, high = np.array([0, 400, 100])[y], np.array([60, 900, 200])[y]  # incipient is highest
    x = samples(rng.integers(low, high).tolist())
    first, last = np.arange(200), np.arange(200, 300)
    found = shares(x.take(first), y[first], x.take(last), y[last])
    assert found["rate_threshold"] == 1.0
    assert found["logistic"] > 0.95
    assert found["majority"] < 0.5


def brute_force(totals: np.ndarray, labels: np.ndarray) -> int:
    cuts = [*np.unique(totals), np.inf]
    best = 0
    for low, high in itertools.combinations_with_replacement(cuts, 2):
        parts = (totals < low, (totals >= low) & (totals < high), totals >= high)
        best = max(best, sum(np.bincount(labels[p], minlength=3).max() for p in parts))
    return int(best)


cases = st.lists(st.tuples(st.integers(0, 9), st.integers(0, 2)), min_size=1, max_size=25)


@settings(deadline=None)
@given(cases)
def test_thresholds_are_the_best_there_are(rows: list[tuple[int, int]]) -> None:
    data = np.array(rows)
    totals, labels = data[:, 0].astype(float), data[:, 1]
    low, high, table = baselines.fit_rate_thresholds(totals, labels)
    assert low <= high
    where = np.searchsorted([low, high], totals)
    right = sum(np.bincount(labels[where == k], minlength=3).max() for k in range(3))
    assert right == brute_force(totals, labels)
    for k in np.unique(where):
        np.testing.assert_array_equal(table[k], np.bincount(labels[where == k], minlength=3))
    assert table.any(axis=1).all()


@pytest.mark.long
@settings(deadline=None, max_examples=20)
@given(cases)
def test_the_order_of_the_classes_changes_nothing(rows: list[tuple[int, int]]) -> None:
    data = np.array(rows)
    x, y = samples(data[:, 0].tolist()), data[:, 1]
    reference = shares(x, y, x, y)
    for order in itertools.permutations(range(3)):
        found = shares(x, np.array(order)[y], x, np.array(order)[y])
        for name in ("majority", "rate_threshold"):
            assert found[name] == reference[name]


def test_equal_classes_share_the_majority() -> None:
    x, y = samples([1] * 6), np.array([0, 1, 2] * 2)
    found = shares(x, y, x.take(np.arange(2)), np.array([0, 0]))
    assert found["majority"] == 1 / 3
    assert found["rate_threshold"] == 1 / 3
    assert found["logistic"] == pytest.approx(1 / 3)


def test_a_total_below_all_seen_is_called_as_its_neighbour() -> None:
    low, high, table = baselines.fit_rate_thresholds(
        np.array([5.0, 6, 9, 10]), np.array([0, 0, 1, 1])
    )
    votes = table[np.searchsorted([low, high], [0, 7, 8, 99])]
    assert votes.argmax(axis=1).tolist() == [0, 0, 1, 1]


def test_logistic_is_at_its_minimum_and_repeats() -> None:
    rng = np.random.default_rng(1)
    totals, labels = rng.gamma(2, 100, 200), rng.integers(0, 3, 200)
    raw = np.stack([totals, np.log1p(totals)], axis=1)
    fitted = fit_logistic(raw, labels)
    w = fitted.weights
    np.testing.assert_array_equal(w, fit_logistic(raw, labels).weights)

    features = (raw - fitted.mean) / fitted.scale
    np.testing.assert_allclose(features.mean(axis=0), 0, atol=1e-12)
    np.testing.assert_allclose(features.std(axis=0), 1)
    x = np.concatenate([np.ones((200, 1)), features], axis=1)
    p = np.exp(x @ w)
    p /= p.sum(axis=1, keepdims=True)
    gradient = x.T @ (p - np.eye(3)[labels]) / 200 + RIDGE * w * np.array([[0], [1], [1]])
    np.testing.assert_allclose(gradient, 0, atol=1e-4)


def test_equal_totals_make_no_division_by_zero() -> None:
    fitted = fit_logistic(np.full((4, 2), 7.0), np.array([0, 0, 0, 1]))
    assert fitted.scale.tolist() == [1, 1]
    votes = fitted.scores(np.full((1, 2), 7.0))
    assert accuracy(votes, np.array([0])).strict == 1.0


def test_no_test_samples_is_no_score() -> None:
    x, y = samples([1, 2]), np.array([0, 1])
    found = shares(x, y, x.take(np.arange(0)), y[:0])
    assert set(found.values()) == {None}


def test_wrong_input_is_named() -> None:
    x, y = samples([1, 2]), np.array([0, 1])
    with pytest.raises(ValueError, match="no training samples"):
        shares(x.take(np.arange(0)), y[:0], x, y)
    with pytest.raises(ValueError, match="differ in number"):
        shares(x, y[:1], x, y)
    with pytest.raises(ValueError, match=r"expected 0\.\.2"):
        shares(x, y + 2, x, y)


def test_slices_tell_when_as_well_as_where() -> None:
    """Five classes with equal events of each cell; two of them by the half of the window alone."""
    rng = np.random.default_rng(0)
    y = np.arange(300) % 5
    dense = rng.poisson(0.1, (300, 10, 4, 1, 1)).astype(np.uint8)
    for sample, label in zip(dense, y, strict=True):
        half = slice(0, 5) if label < 4 else slice(5, 10)
        sample[half, min(label, 3)] += 1
    x = SparseWindows.of(dense)
    expected = dense.reshape(300, 2, 5, 4).sum(axis=2).reshape(300, 8)
    np.testing.assert_array_equal(baselines.slice_sums(x, 2), expected)
    np.testing.assert_array_equal(baselines.slice_sums(x, 99), dense.reshape(300, 40))
    np.testing.assert_array_equal(baselines.slice_sums(x, 1), cell_sums(x))
    first, last = np.arange(200), np.arange(200, 300)
    parts = (x.take(first), y[first], x.take(last))
    votes, said = baselines.logistic_slices(*parts, 5, 2)
    assert (said["slices"], said["weights"]) == (2, 9 * 5)
    assert (votes.argmax(axis=1) == y[last]).mean() > 0.95
    cells, _ = baselines.logistic_cells(*parts, 5)
    assert 0.5 < (cells.argmax(axis=1) == y[last]).mean() < 0.9
    found = shares(*parts, y[last], 5)
    assert list(found) == ["majority", "logistic"]
    assert found["majority"] == 1 / 5
