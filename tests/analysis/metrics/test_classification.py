"""Accuracies that a silent network cannot flatter and no order of the classes can change."""

import itertools
import json
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sliplab.analysis.metrics import classification
from sliplab.analysis.metrics.classification import CLASSES, accuracy, confusion, score, winners

# one sample of each hard kind: true class, counts, and what each accuracy gives it
TABLE = [
    (0, (5, 0, 0), (1, 1, 1)),
    (0, (5, 4, 0), (1, 1, 0)),  # leads by one
    (1, (0, 2, 0), (1, 1, 1)),  # leads by exactly the margin
    (1, (3, 3, 0), (1 / 2, 0, 0)),
    (2, (3, 3, 0), (0, 0, 0)),  # not among the two that tie
    (2, (0, 0, 0), (1 / 3, 0, 0)),
    (2, (9, 0, 0), (0, 0, 0)),
]


def arrays() -> tuple[np.ndarray, np.ndarray]:
    return np.array([row[1] for row in TABLE]), np.array([row[0] for row in TABLE])


def test_accuracies_of_hand_counted_samples() -> None:
    counts, labels = arrays()
    found = accuracy(counts, labels, margin=2)
    expected = [sum(row[2][k] for row in TABLE) / len(TABLE) for k in range(3)]
    assert [found.argmax, found.strict, found.margin] == pytest.approx(expected, abs=1e-15)
    assert found.n == len(TABLE)


@pytest.mark.parametrize("true", range(3))
def test_a_silent_network_is_a_third_right_whatever_the_class(true: int) -> None:
    found = accuracy(np.zeros((50, 3), int), np.full(50, true))
    assert (found.argmax, found.strict, found.margin) == (1 / 3, 0.0, 0.0)


@given(st.lists(st.tuples(st.integers(0, 2), *[st.integers(0, 4)] * 3), min_size=1, max_size=40))
def test_the_order_of_the_classes_changes_no_accuracy_at_all(rows: list[tuple[int, ...]]) -> None:
    data = np.array(rows)
    labels, counts = data[:, 0], data[:, 1:]
    reference = accuracy(counts, labels)
    table = confusion(counts, labels)
    for order in itertools.permutations(range(3)):
        place = np.argsort(order)  # old class -> new class
        assert accuracy(counts[:, order], place[labels]) == reference
        moved = confusion(counts[:, order], place[labels])
        np.testing.assert_array_equal(moved, table[list(order)][:, [*order, 3]])


@given(st.lists(st.tuples(st.integers(0, 2), *[st.integers(0, 30)] * 3), min_size=1, max_size=40))
def test_strict_and_margin_only_take_away(rows: list[tuple[int, ...]]) -> None:
    data = np.array(rows)
    found = accuracy(data[:, 1:], data[:, 0], margin=2)
    assert found.margin is not None
    assert found.argmax >= found.strict >= found.margin
    table = confusion(data[:, 1:], data[:, 0])
    assert found.strict == np.trace(table) / len(data)
    np.testing.assert_array_equal(table.sum(axis=1), np.bincount(data[:, 0], minlength=3))


def test_confusion_precision_and_recall() -> None:
    counts, labels = arrays()
    result = score(counts, labels)
    assert result.confusion == ((2, 0, 0, 0), (0, 1, 0, 1), (1, 0, 0, 2))
    assert result.precision == {"no_slip": 2 / 3, "incipient": 1.0, "gross": None}
    assert result.recall == {"no_slip": 1.0, "incipient": 1 / 2, "gross": 0.0}
    assert result.balance == {"no_slip": 2 / 7, "incipient": 2 / 7, "gross": 3 / 7}


def test_a_class_that_is_not_there_has_no_recall() -> None:
    result = score(np.array([[1, 0, 0]]), np.array([0]))
    assert result.recall == {"no_slip": 1.0, "incipient": None, "gross": None}


def test_no_samples_give_none_and_plain_json() -> None:
    result = score(np.zeros((0, 3), int), np.zeros(0, int))
    assert result.accuracy.argmax is result.accuracy.strict is result.accuracy.margin is None
    assert set(classification.class_balance(np.zeros(0, int)).values()) == {None}
    text = json.dumps(result.to_json(), allow_nan=False)
    assert json.loads(text)["confusion"] == [[0] * 4] * 3


def test_a_tie_has_no_winner_even_without_a_margin() -> None:
    counts = np.array([[2, 2, 1], [0, 0, 0], [0, 0, 1], [1.5, 0, 0]])
    assert winners(counts, 0).tolist() == [-1, -1, 2, 0]
    assert winners(counts, 1.5).tolist() == [-1, -1, -1, 0]


@pytest.mark.parametrize(
    ("counts", "labels", "message"),
    [
        (np.zeros((2, 4)), np.zeros(2, int), r"\(2, 4\).*expected \(n, 3\)"),
        (np.zeros((2, 3)), np.zeros(3, int), "labels for 2 rows"),
        (np.zeros((2, 3)), np.array([0, 3]), r"0\.\.3; expected 0\.\.2"),
        (np.zeros((2, 3)), np.array([0, -1]), "expected"),
        (np.zeros((2, 3)), np.array([0.0, 1.0]), "expected integers"),
        (np.array([[0, np.nan, 0]]), np.array([0]), "not finite"),
    ],
)
def test_wrong_input_is_named(counts: np.ndarray, labels: np.ndarray, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        score(counts, labels)


def test_class_names_are_the_summary_keys() -> None:
    assert CLASSES == ("no_slip", "incipient", "gross")


@given(
    classes=st.sampled_from([2, 5, 36, 200]), n=st.integers(1, 60), seed=st.integers(0, 2**32 - 1)
)
def test_ties_of_any_number_of_classes_are_shared_exactly(classes: int, n: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    counts, labels = rng.integers(0, 3, (n, classes)), rng.integers(0, classes, n)
    found = accuracy(counts, labels)
    shared, alone = Fraction(), 0
    table = np.zeros((classes, classes + 1), int)
    for row, label in zip(counts.tolist(), labels.tolist(), strict=True):
        best = [k for k in range(classes) if row[k] == max(row)]
        shared += Fraction(label in best, len(best))
        alone += best == [label]
        table[label, best[0] if len(best) == 1 else classes] += 1
    assert found.argmax == float(shared / n)
    assert found.strict == alone / n
    np.testing.assert_array_equal(confusion(counts, labels), table)
    order = rng.permutation(classes)
    assert accuracy(counts[:, order], np.argsort(order)[labels]) == found


def test_many_classes_have_labels_of_their_own() -> None:
    assert winners(np.eye(256, dtype=int)).tolist() == list(range(256))
    assert winners(np.eye(127, dtype=int)).dtype == np.int8
    names = tuple(f"object {k}" for k in range(36))
    result = score(np.eye(36, dtype=int), np.arange(36), names=names)
    assert result.recall == dict.fromkeys(names, 1.0)
    assert result.balance == dict.fromkeys(names, 1 / 36)
    with pytest.raises(ValueError, match=r"\(1, 36\); expected \(n, 3\)"):
        score(np.ones((1, 36)), np.array([0]))
    with pytest.raises(ValueError, match=r"expected 0\.\.35"):
        accuracy(np.ones((1, 36)), np.array([36]))
