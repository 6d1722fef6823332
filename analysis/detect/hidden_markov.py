"""A slip goes one way: the forward filter of a left-to-right hidden Markov model.

A trial is at rest, then slips at its rim, then slips as a whole, and never goes back. That is all
this model knows besides what a window looks like in each state, and it is why it can detect a weak
change earlier than an average can: evidence adds up over windows instead of being forgotten. The
recursion is the forward one of Rabiner (1989), equation 19, normalised at every step and kept in
logarithms, so that neither thousands of windows nor an impossible one underflow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Chain:
    """States in their only order; the last is never left.

    Attributes:
        leave: float64 (states - 1,), probability of going from each state to the next at a
            window's end, inside 0..1.
    """

    leave: FloatArray

    def __post_init__(self) -> None:
        """Probabilities that are none are refused."""
        if self.leave.ndim != 1 or not ((self.leave > 0) & (self.leave < 1)).all():
            raise ValueError(f"leave = {self.leave}: must be probabilities inside 0..1")

    @property
    def states(self) -> int:
        """How many states there are."""
        return len(self.leave) + 1


def fit_chain(labels: Sequence[npt.NDArray[np.integer]], states: int) -> Chain:
    """The chain of labelled trials: how often each state was left, by the windows spent in it.

    The share of the windows after which a state was left is the likeliest value; one departure in
    two windows is added, so that a state nobody saw, or nobody left, still has one.

    Args:
        labels: states of each trial's windows in the order of time, integer (n,); a trial may
            have none, and may end in any state.

    Raises:
        ValueError: a label that is no state, or labels that go back.
    """
    left, spent = np.zeros(states - 1), np.zeros(states - 1)
    for trial in labels:
        trial = np.asarray(trial, np.int64)
        if not len(trial):
            continue
        if trial.min() < 0 or trial.max() >= states or (np.diff(trial) < 0).any():
            raise ValueError(f"labels must ascend within 0..{states - 1}")
        spent += np.bincount(trial, minlength=states)[:-1]
        # a state between two windows was passed through without a window of its own
        left[trial[0] : trial[-1]] += 1
    return Chain((left + 1) / (np.maximum(spent, left) + 2))


def forward(chain: Chain, log_likelihood: FloatArray) -> FloatArray:
    """The states' log probabilities given all windows up to each one.

    The chain is in its first state before the first window. Within one window it moves on by one
    state at most, so the last of three needs two windows.

    Args:
        log_likelihood: float64 (n, states), of each window in each state, up to a constant of the
            window; finite.

    Returns:
        float64 (n, states), each row's exponentials add up to 1; -inf where a state cannot have
        been reached.

    Raises:
        ValueError: another shape, or a value that is not finite.
    """
    if log_likelihood.ndim != 2 or log_likelihood.shape[1] != chain.states:
        raise ValueError(f"likelihoods {log_likelihood.shape}; expected (n, {chain.states})")
    if not np.isfinite(log_likelihood).all():
        raise ValueError("a log likelihood is not finite")
    out = np.empty(log_likelihood.shape)
    stay = np.append(np.log1p(-chain.leave), 0.0)
    _forward(stay, np.log(chain.leave), np.ascontiguousarray(log_likelihood, np.float64), out)
    return out


@njit(cache=True, nogil=True)
def _add(a: Any, b: Any) -> Any:
    """log(exp(a) + exp(b)), either of which may be -inf."""
    high, low = max(a, b), min(a, b)
    return high if low == -np.inf else high + np.log1p(np.exp(low - high))


@njit(cache=True, nogil=True)
def _forward(stay: Any, go: Any, seen: Any, out: Any) -> None:
    windows, states = seen.shape
    belief = np.full(states, -np.inf)
    belief[0] = 0.0
    for n in range(windows):
        total = -np.inf
        # from the last state down: each needs what its predecessor was before this window
        for s in range(states - 1, -1, -1):
            moved = belief[s] + stay[s]
            if s > 0:
                moved = _add(moved, belief[s - 1] + go[s - 1])
            belief[s] = moved + seen[n, s]
            total = _add(total, belief[s])
        for s in range(states):
            belief[s] -= total
            out[n, s] = belief[s]


def log_odds(log_probability: FloatArray, state: int) -> FloatArray:
    """Log odds of having come to `state` or beyond, float64 (n,), from `forward`; may be -inf.

    From logarithms, so that a belief next to certainty is still told from one nearer to it.
    """
    before = np.logaddexp.reduce(log_probability[:, :state], axis=1)
    after: FloatArray = np.logaddexp.reduce(log_probability[:, state:], axis=1) - before
    return after
