"""The forward filter against the enumeration of every path."""

from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sliplab.analysis.detectors.detectors import StateChain, fit_chain, forward, log_odds

LOGS = st.floats(-30, 5, allow_nan=False)


def enumerated(leave: np.ndarray, log_likelihood: np.ndarray) -> np.ndarray:
    """P(state | windows up to each) by adding up all paths, as the model is written down."""
    n, states = log_likelihood.shape
    step = np.zeros((states, states))
    for s in range(states):
        go = leave[s] if s < states - 1 else 0.0
        step[s, s] = 1.0 - go
        if s < states - 1:
            step[s, s + 1] = go
    out = np.zeros((n, states))
    for last in range(n):
        for path in product(range(states), repeat=last + 1):
            weight, before = 1.0, 0
            for k, state in enumerate(path):
                weight *= step[before, state] * np.exp(log_likelihood[k, state])
                before = state
            out[last, path[-1]] += weight
    return out / out.sum(axis=1, keepdims=True)


@settings(max_examples=40)
@given(
    st.integers(1, 5).flatmap(
        lambda n: st.lists(st.tuples(LOGS, LOGS, LOGS), min_size=n, max_size=n)
    ),
    st.tuples(st.floats(1e-6, 0.999), st.floats(1e-6, 0.999)),
)
def test_the_filter_is_the_sum_over_all_paths(
    rows: list[tuple[float, ...]], leave: tuple[float, float]
) -> None:
    seen = np.array(rows)
    found = np.exp(forward(StateChain(np.array(leave)), seen))
    np.testing.assert_allclose(found, enumerated(np.array(leave), seen), rtol=1e-9, atol=1e-300)


@settings(max_examples=40)
@given(st.lists(st.tuples(LOGS, LOGS, LOGS), min_size=2, max_size=30), st.data())
def test_later_windows_and_constants_of_a_window_change_nothing(
    rows: list[tuple[float, ...]], data: st.DataObject
) -> None:
    chain, seen = StateChain(np.array([0.01, 0.02])), np.array(rows)
    cut = data.draw(st.integers(1, len(seen)))
    whole = forward(chain, seen)
    other = seen.copy()
    other[cut:] = other[cut:, ::-1] - 7.0
    assert (forward(chain, other)[:cut] == whole[:cut]).all()
    lifted = seen + np.arange(len(seen))[:, None]
    np.testing.assert_allclose(np.exp(forward(chain, lifted)), np.exp(whole), atol=1e-9)


def test_a_long_trial_and_an_impossible_window_do_not_underflow() -> None:
    seen = np.full((100_000, 3), [-1.0, -1.1, -1.2])
    seen[50_000:] = [-5000.0, -4000.0, -4000.5]
    belief = forward(StateChain(np.array([1e-3, 1e-3])), seen)
    assert not np.isnan(belief).any()
    odds = log_odds(belief, 1)
    # certainty is told from greater certainty, far beyond what 1 - p could hold
    assert odds[50_000] > 900
    assert odds[50_001] > odds[50_000] + 900
    np.testing.assert_allclose(np.exp(belief).sum(axis=1), 1.0)


def test_it_never_goes_back() -> None:
    seen = np.array([[0.0, -9, -9]] * 3 + [[-9.0, 0, -9]] * 3 + [[-9.0, -9, 0]] * 9)
    belief = forward(StateChain(np.array([0.1, 0.1])), seen)
    assert belief.argmax(axis=1).tolist() == [0] * 3 + [1] * 3 + [2] * 9
    # windows like those of no slip, after gross slip, make incipient slip no likelier
    after = forward(StateChain(np.array([0.1, 0.1])), np.vstack([seen, seen[:3]]))
    assert after[-3:].argmax(axis=1).tolist() == [2] * 3


def test_no_windows() -> None:
    belief = forward(StateChain(np.array([0.1, 0.1])), np.empty((0, 3)))
    assert belief.shape == (0, 3)
    assert log_odds(belief, 1).shape == (0,)


def test_the_third_state_needs_two_windows() -> None:
    belief = forward(StateChain(np.array([0.5, 0.5])), np.zeros((2, 3)))
    np.testing.assert_allclose(np.exp(belief), [[0.5, 0.5, 0], [0.25, 0.5, 0.25]])
    assert log_odds(belief, 2)[0] == -np.inf


def test_rates_come_from_durations() -> None:
    # 30 windows without slip in three trials, left in two; 10 of incipient slip, left in one
    trials = [
        np.repeat([0, 1, 2], [10, 4, 5]),
        np.repeat([0, 1], [12, 6]),
        np.zeros(8, int),
        np.empty(0, int),
    ]
    chain = fit_chain(trials, 3)
    np.testing.assert_allclose(chain.leave, [(2 + 1) / (30 + 2), (1 + 1) / (10 + 2)])


def test_a_state_that_was_passed_between_two_windows_was_left() -> None:
    chain = fit_chain([np.array([0, 0, 2])], 3)
    np.testing.assert_allclose(chain.leave, [2 / 4, 2 / 3])


def test_rates_without_any_trial() -> None:
    np.testing.assert_allclose(fit_chain([], 3).leave, [0.5, 0.5])


@pytest.mark.parametrize("labels", [[1, 0], [0, 3], [-1, 0]])
def test_labels_that_go_back_or_are_none(labels: list[int]) -> None:
    with pytest.raises(ValueError, match="must ascend"):
        fit_chain([np.array(labels)], 3)


def test_wrong_input_is_named() -> None:
    with pytest.raises(ValueError, match="inside 0"):
        StateChain(np.array([0.1, 1.0]))
    chain = StateChain(np.array([0.1, 0.1]))
    with pytest.raises(ValueError, match="expected"):
        forward(chain, np.zeros((4, 2)))
    with pytest.raises(ValueError, match="not finite"):
        forward(chain, np.full((4, 3), np.nan))
