"""The front is the definition's, whatever the order, with ties and infinities."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sliplab.plugins.studies.detector.pareto import front

COST = st.one_of(st.integers(0, 3).map(float), st.just(float("inf")), st.floats(-1, 1))


def by_definition(rows: list[list[float]]) -> list[bool]:
    def beats(a: list[float], b: list[float]) -> bool:
        pairs = list(zip(a, b, strict=True))
        return all(x <= y for x, y in pairs) and any(x < y for x, y in pairs)

    return [not any(beats(other, row) for other in rows) for row in rows]


@settings(max_examples=60)
@given(
    st.integers(1, 5).flatmap(
        lambda k: st.lists(st.lists(COST, min_size=k, max_size=k), min_size=1, max_size=40)
    )
)
def test_it_is_what_nothing_beats(rows: list[list[float]]) -> None:
    assert front(np.array(rows)).tolist() == by_definition(rows)


@settings(max_examples=40)
@given(st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), min_size=1, max_size=30))
def test_order_does_not_matter(rows: list[tuple[int, int]]) -> None:
    on = front(np.array(rows))
    assert front(np.array(rows[::-1])).tolist() == on.tolist()[::-1]


def test_equal_rows_stand_together_and_none_is_no_row() -> None:
    assert front(np.array([[1.0, 2.0], [1.0, 2.0], [2.0, 2.0]])).tolist() == [True, True, False]
    assert front(np.empty((0, 3))).tolist() == []


def test_what_is_no_table_of_numbers_is_refused() -> None:
    with pytest.raises(ValueError, match=r"\(n, k\)"):
        front(np.zeros(3))
    with pytest.raises(ValueError, match="at least 1"):
        front(np.empty((2, 0)))
    with pytest.raises(ValueError, match="row 1 hold a NaN"):
        front(np.array([[0.0, 1.0], [np.nan, 1.0]]))
