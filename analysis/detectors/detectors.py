"""Rules of detection side by side: each turns a network's spikes into evidence, window by window.

A rule returns the evidence, from all windows so far, that slip has begun; a threshold on the
evidence makes it a detection. So rules of any kind can be set to the same rate of false alarms
(`detectors.detector_comparison`) and then compared by how late they are. No other comparison is
fair: each becomes arbitrarily quick when it is allowed more false alarms.

A rule is written once. Stored trials give it all their windows, a running stream one at a time.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
from scipy.special import log_softmax

from sliplab.analysis.detectors.latency import DetectedOnsets, TrueSlip
from sliplab.analysis.detectors.onset_references import References
from sliplab.analysis.metrics.classification import CLASSES, GROSS, INCIPIENT, NO_SLIP
from sliplab.analysis.networks import baselines
from sliplab.analysis.networks.baselines import Logistic
from sliplab.storage.kernels import njit

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
Array = npt.NDArray[np.integer] | FloatArray

RULE = "rule, "
"""Beginning of the name of a network's rule of detection among detectors."""
ADDED = 0.5
"""Windows added to each bin of a histogram (Krichevsky and Trofimov, 1981): no bin stays empty."""


# --------------------------------------------------------------------------------------------------
# A slip goes one way: the forward filter of a left-to-right hidden Markov model.
#
# A trial is at rest, then slips at its rim, then slips as a whole, and never goes back. That is
# all this model knows besides what a window looks like in each state, and it is why it can detect
# a weak change earlier than an average can: evidence adds up over windows instead of being
# forgotten. The recursion is the forward one of Rabiner (1989), equation 19, normalised at every
# step and stored as logarithms, so that neither thousands of windows nor an impossible one
# underflow.


@dataclass(frozen=True)
class StateChain:
    """States in their only order; the last is never left.

    Attributes:
        leave: float64 (states - 1,), probability of going from each state to the next at a
            window's end, inside 0..1.
    """

    leave: FloatArray

    def __post_init__(self) -> None:
        """Check the probabilities."""
        if self.leave.ndim != 1 or not ((self.leave > 0) & (self.leave < 1)).all():
            raise ValueError(f"leave = {self.leave}: must be probabilities inside 0..1")

    @property
    def states(self) -> int:
        """Number of states."""
        return len(self.leave) + 1


def fit_chain(labels: Sequence[npt.NDArray[np.integer]], states: int) -> StateChain:
    """The chain of labelled trials: how often each state was left, by the windows spent in it.

    The share of the windows after which a state was left is the likeliest value; one departure in
    two windows is added, so that a state that was never seen, or never left, has one, too.

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
        # a state between two windows was passed through without its own window
        left[trial[0] : trial[-1]] += 1
    return StateChain((left + 1) / (np.maximum(spent, left) + 2))


def forward(chain: StateChain, log_likelihood: FloatArray) -> FloatArray:
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
    return _advanced(chain, _first_state(chain), log_likelihood)


def _first_state(chain: StateChain) -> FloatArray:
    """Return the log probabilities before the first window, float64 (states,)."""
    belief = np.full(chain.states, -np.inf)
    belief[0] = 0.0
    return belief


def _advanced(chain: StateChain, belief: FloatArray, log_likelihood: FloatArray) -> FloatArray:
    """Return `forward` from `belief` on, which becomes that after the last window."""
    out = np.empty(log_likelihood.shape)
    stay = np.append(np.log1p(-chain.leave), 0.0)
    seen = np.ascontiguousarray(log_likelihood, np.float64)
    _forward(stay, np.log(chain.leave), belief, seen, out)
    return out


@njit(cache=True, nogil=True)
def _add(a: Any, b: Any) -> Any:
    """log(exp(a) + exp(b)), either of which may be -inf."""
    high, low = max(a, b), min(a, b)
    return high if low == -np.inf else high + np.log1p(np.exp(low - high))


@njit(cache=True, nogil=True)
def _forward(stay: Any, go: Any, belief: Any, seen: Any, out: Any) -> None:
    windows, states = seen.shape
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
    """Log odds of having reached `state` or a later one, float64 (n,), from `forward`; may be -inf.

    Computed from logarithms, so that probabilities close to 1 remain distinct.
    """
    before = np.logaddexp.reduce(log_probability[:, :state], axis=1)
    after: FloatArray = np.logaddexp.reduce(log_probability[:, state:], axis=1) - before
    return after


# --------------------------------------------------------------------------------------------------
# A sequential test for a change: Page's CUSUM on log likelihood ratios.
#
# Of all tests with a given mean time to a false alarm CUSUM has the shortest worst mean delay, if
# the windows before and after the change are independent and their distributions known (Lorden
# 1971, Moustakides 1986). It is Wald's sequential probability ratio test begun again whenever it
# decides for "no change", so that test is left out.


def cusum(log_ratio: FloatArray, level: float = 0.0) -> FloatArray:
    """Page's statistic after each window, float64 (n,), never negative.

    ``g(t) = max(0, g(t-1) + l(t))``.

    Args:
        log_ratio: float64 (n,), log likelihood after the change less before it, finite.
        level: g before the first window.

    Raises:
        ValueError: another shape, or a value that is not finite.
    """
    if log_ratio.ndim != 1 or not np.isfinite(log_ratio).all():
        raise ValueError(f"log ratios {log_ratio.shape}: must be finite and one a window")
    out = np.empty(len(log_ratio))
    for n, value in enumerate(log_ratio.tolist()):
        level = max(0.0, level + value)
        out[n] = level
    return out


# --------------------------------------------------------------------------------------------------
# Likelihood of a window's counts without slip, in incipient and in gross slip.
#
# Two models, both fitted on training trials alone. Histograms take the three spike counts for
# independent given the state, which they are not; they say what counting alone reaches. The other
# is a multinomial logistic regression on any features, turned into likelihoods by weighing the
# classes equally: p(seen | state) is p(state | seen) times p(seen) where all states are equally
# common, and p(seen) is the same for every state, so detectors never need it.


class Likelihood(Protocol):
    """Likelihood of a window in each state."""

    def log(self, features: Array) -> FloatArray:
        """Log likelihoods float64 (n, classes) of features (n, k), up to a constant a window."""


@dataclass(frozen=True)
class Histograms:
    """Independent histograms of small whole numbers.

    Attributes:
        table: float64 (k, classes, bins), log shares; a value beyond the last bin is of the last.
    """

    table: FloatArray

    def log(self, features: Array) -> FloatArray:
        """Return the same as `Likelihood.log`; features are whole numbers from 0."""
        bins = np.clip(np.asarray(features, np.int64), 0, self.table.shape[2] - 1)
        out = np.zeros((len(bins), self.table.shape[1]))
        for column, table in zip(bins.T, self.table, strict=True):
            out += table[:, column].T
        return out


def fit_histograms(
    features: Array, labels: npt.NDArray[np.integer], classes: int, bins: int
) -> Histograms:
    """Shares of each value by class, with `ADDED` windows in each bin.

    Args:
        features: whole numbers (n, k), 0 to ``bins - 1``; larger ones go into the last bin.
        labels: integer (n,), 0 to ``classes - 1``; a class without windows is taken as even.

    Raises:
        ValueError: lengths differ, or a label that is no class.
    """
    labels = _check(features, labels, classes)
    values = np.clip(np.asarray(features, np.int64), 0, bins - 1)
    table = np.empty((values.shape[1], classes, bins))
    for k, column in enumerate(values.T):
        counted = np.bincount(labels * bins + column, minlength=classes * bins)
        filled = counted.reshape(classes, bins) + ADDED
        table[k] = np.log(filled / filled.sum(axis=1, keepdims=True))
    return Histograms(table)


@dataclass(frozen=True)
class BalancedLogistic:
    """Multinomial logistic regression with all classes weighing the same."""

    fitted: Logistic

    def log(self, features: Array) -> FloatArray:
        """Return the same as `Likelihood.log`."""
        fitted = self.fitted
        scaled = (np.asarray(features, np.float64) - fitted.mean) / fitted.scale
        # not a matrix product, whose rounding depends on how many windows there are: a detector
        # a window's output must not depend on later windows
        offsets = fitted.weights[0]
        linear = np.broadcast_to(offsets, (len(scaled), len(offsets))).copy()
        for column, weights in zip(scaled.T, fitted.weights[1:], strict=True):
            linear += column[:, None] * weights
        return np.asarray(log_softmax(linear, axis=1))


def fit_logistic(
    features: Array, labels: npt.NDArray[np.integer], classes: int
) -> BalancedLogistic:
    """The regression; it is blind to the classes' order.

    Args:
        features: (n, k), finite; a constant one gets no weight.
        labels: integer (n,), 0 to ``classes - 1``.

    Raises:
        ValueError: lengths differ, or a label that is no class.
    """
    labels = _check(features, labels, classes)
    raw = np.asarray(features, np.float64)
    if len(raw):
        return BalancedLogistic(baselines.fit_logistic(raw, labels, classes, balanced=True))
    empty = np.zeros(raw.shape[1])
    return BalancedLogistic(Logistic(np.zeros((1 + raw.shape[1], classes)), empty, empty + 1, 0))


def _check(features: Array, labels: npt.NDArray[np.integer], classes: int) -> npt.NDArray[np.int64]:
    found = np.asarray(labels).astype(np.int64)
    if features.ndim != 2 or found.shape != features.shape[:1]:
        raise ValueError(f"features {features.shape} for {found.shape} labels")
    if len(found) and (found.min() < 0 or found.max() >= classes):
        raise ValueError(f"labels range over {found.min()}..{found.max()}; of {classes} classes")
    return found


@dataclass(frozen=True)
class Predictions:
    """Predictions of one trial: the input of every detector.

    Attributes:
        counts: int64 (n, 3), the network's output spikes in each window.
        events: int64 (n,), events in each window.
        end_ns: int64 (n,), end of each window on the trial's time line, ascending.
    """

    counts: IntArray
    events: IntArray
    end_ns: IntArray

    def __post_init__(self) -> None:
        """Check that the columns have matching shapes."""
        n = len(self.end_ns)
        if self.counts.shape != (n, len(CLASSES)) or self.events.shape != (n,):
            raise ValueError(
                f"{n} window ends for {len(self.counts)} windows: counts {self.counts.shape} and "
                f"events {self.events.shape}; expected (n, {len(CLASSES)}) and (n,)"
            )
        if (np.diff(self.end_ns) <= 0).any():
            raise ValueError("window ends do not increase")

    def __len__(self) -> int:
        return len(self.end_ns)

    def __getitem__(self, part: slice) -> Predictions:
        """Return some of the windows."""
        return Predictions(self.counts[part], self.events[part], self.end_ns[part])


@dataclass(frozen=True)
class TrialWithSlip:
    """A trial with its true slip, and that by other references, on the time line of its windows."""

    predictions: Predictions
    slip: TrueSlip
    references: References = field(default_factory=dict)

    def states(self, length_ns: int) -> IntArray:
        """The class that each window of this length holds most of, by its middle; int64 (n,)."""
        middle = self.predictions.end_ns - length_ns // 2
        return (middle >= self.slip.incipient_ns).astype(np.int64) + (middle >= self.slip.gross_ns)


@dataclass(frozen=True)
class WindowEvidence:
    """Evidence of windows that follow each other; no value depends on a later window.

    Attributes:
        end_ns: int64 (n,), end of each window.
        incipient: float64 (n,), evidence for slip from all windows up to each one.
        gross_after: the same for gross slip, given the window in which incipient slip was
            detected; only values after that window mean anything. Of -1 where that was before.
        smoothed: (n, 3), mean counts of the windows that the evidence rests on.
        no_slip: float64 (n,), evidence for no slip, of a rule that has it.
    """

    end_ns: IntArray
    incipient: FloatArray
    gross_after: Callable[[int], FloatArray]
    smoothed: Array = field(default_factory=lambda: np.empty((0, len(CLASSES))))
    no_slip: FloatArray = field(default_factory=lambda: np.empty(0))


class DetectionRule(ABC):
    """Evidence that slip has begun.

    A rule stores nothing: `push` takes its state after the last window and returns the next one.
    So the windows of a trial at once, and one by one, give the same evidence, to the bit.
    """

    @property
    def span(self) -> int:
        """Fewest windows that a decision is based on."""
        return 1

    @abstractmethod
    def begin(self) -> Any:
        """Return the state before the first window."""

    @abstractmethod
    def push(self, state: Any, windows: Predictions) -> tuple[Any, WindowEvidence]:
        """Return the state after the next windows, and their evidence."""

    def detected(self, state: Any) -> Any:
        """Return the state, given that incipient slip was detected in the last window."""
        return state

    def evidence(self, predictions: Predictions) -> WindowEvidence:
        """Return the evidence of one trial."""
        return self.push(self.begin(), predictions)[1]


@dataclass(frozen=True)
class Smoothing(DetectionRule):
    """The paper's rule: mean counts of the last `width` windows, and by how much a class leads.

    The evidence is the lead over every other class in spikes, negative where the class trails, and
    -inf before `width` windows. Means are computed from whole sums.
    """

    width: int

    @property
    def span(self) -> int:
        """See `DetectionRule`."""
        return self.width

    def begin(self) -> IntArray:
        """See `DetectionRule`; the counts of the last ``width - 1`` windows."""
        return np.empty((0, len(CLASSES)), np.int64)

    def push(self, state: IntArray, windows: Predictions) -> tuple[IntArray, WindowEvidence]:
        """See `DetectionRule`."""
        every = np.concatenate([state, windows.counts])
        sums = np.zeros((len(every) + 1, len(CLASSES)), np.int64)
        sums[1:] = every.cumsum(axis=0)
        stop = np.arange(len(state), len(every)) + 1
        start = np.maximum(stop - self.width, 0)
        trailing, held = sums[stop] - sums[start], stop - start

        def lead(target: int) -> FloatArray:
            rivals = np.delete(trailing, target, axis=1).max(axis=1, initial=0)
            found: FloatArray = (trailing[:, target] - rivals) / self.width
            found[held < self.width] = -np.inf
            return found

        no_slip, incipient, gross = (lead(k) for k in range(len(CLASSES)))
        found = WindowEvidence(
            windows.end_ns, incipient, lambda first: gross, trailing / held[:, None], no_slip
        )
        return every[max(len(every) - self.width + 1, 0) :], found


@dataclass(frozen=True)
class Reading:
    """Features from which a window's likelihoods are read.

    Attributes:
        likelihood: fitted on training trials.
        events: whether the number of events is among the features; see `features`.
        weight: factor on log likelihoods. Windows that overlap hold each event several times:
            stride over length counts it once again.
    """

    likelihood: Likelihood
    events: bool
    weight: float

    def log(self, predictions: Predictions) -> FloatArray:
        """Log likelihoods float64 (n, 3)."""
        return self.weight * self.likelihood.log(features(predictions, self.events))


@dataclass(frozen=True)
class Filter(DetectionRule):
    """The hidden Markov filter; the evidence is log odds."""

    chain: StateChain
    reading: Reading

    def begin(self) -> FloatArray:
        """See `DetectionRule`; the log probabilities of the states, float64 (states,)."""
        return _first_state(self.chain)

    def push(self, state: FloatArray, windows: Predictions) -> tuple[FloatArray, WindowEvidence]:
        """See `DetectionRule`."""
        beliefs = _advanced(self.chain, state.copy(), self.reading.log(windows))
        gross = log_odds(beliefs, GROSS)
        found = WindowEvidence(
            windows.end_ns, log_odds(beliefs, INCIPIENT), lambda first: gross, windows.counts
        )
        return beliefs[-1] if len(beliefs) else state, found


@dataclass(frozen=True)
class Cusum(DetectionRule):
    """Page's test of no slip against incipient slip; after that, of incipient against gross."""

    reading: Reading

    def begin(self) -> tuple[float, float]:
        """See `DetectionRule`; the statistics of both tests."""
        return 0.0, 0.0

    def push(
        self, state: tuple[float, float], windows: Predictions
    ) -> tuple[tuple[float, float], WindowEvidence]:
        """See `DetectionRule`."""
        log = self.reading.log(windows)
        slip = cusum(log[:, INCIPIENT] - log[:, NO_SLIP], state[0])
        ratio = log[:, GROSS] - log[:, INCIPIENT]

        def gross_after(first: int) -> FloatArray:
            out = np.zeros(len(ratio))
            out[first + 1 :] = cusum(ratio[first + 1 :], state[1] if first < 0 else 0.0)
            return out

        found = WindowEvidence(windows.end_ns, slip, gross_after, windows.counts)
        if not len(slip):
            return state, found
        return (float(slip[-1]), float(gross_after(-1)[-1])), found

    def detected(self, state: tuple[float, float]) -> tuple[float, float]:
        """See `DetectionRule`; the second test begins."""
        return state[0], 0.0


@dataclass(frozen=True)
class Levels:
    """Threshold that the evidence must EXCEED."""

    incipient: float
    gross: float


@dataclass(frozen=True)
class Tuned:
    """A rule with its levels, such as validation trials set."""

    name: str
    detector: DetectionRule
    levels: Levels

    def classes(self, evidence: WindowEvidence, gross_found: bool) -> npt.NDArray[np.int8]:
        """Return the class of each window, int8 (n,); -1 where none is valid.

        Gross slip once that was detected, incipient slip where its evidence exceeds the level.

        Args:
            gross_found: gross slip was detected in one of the windows or before.
        """
        slips = np.where(evidence.incipient > self.levels.incipient, INCIPIENT, NO_SLIP)
        return np.full_like(slips, GROSS, np.int8) if gross_found else slips.astype(np.int8)


def decide(evidence: WindowEvidence, levels: Levels) -> DetectedOnsets:
    """Return incipient, then gross slip, each at the end of the window that detected it."""
    first = first_above(evidence.incipient, levels.incipient)
    if first is None:
        return DetectedOnsets(None, None)
    second = first_above(evidence.gross_after(first), levels.gross, first + 1)
    end = evidence.end_ns
    return DetectedOnsets(int(end[first]), None if second is None else int(end[second]))


def first_above(evidence: FloatArray, level: float, start: int = 0) -> int | None:
    """Return the first window from `start` on whose evidence exceeds the level."""
    found = np.flatnonzero(evidence[start:] > level)
    return start + int(found[0]) if len(found) else None


def features(predictions: Predictions, events: bool) -> FloatArray:
    """Return the counts; with `events` also log(1 + events), and all products of two.

    float64 (n, 3), or (n, 14) with events; the counts come first.
    """
    counts = predictions.counts.astype(np.float64)
    if not events:
        return counts
    each = [*counts.T, np.log1p(predictions.events)]
    products = [one * other for k, one in enumerate(each) for other in each[k:]]
    return np.stack([*each, *products], axis=1)


@dataclass(frozen=True)
class Learned:
    """A detector fitted on training trials, for windows of any stride.

    Attributes:
        chain: how often states are left, by consecutive windows.
        readings: by name, likelihoods of windows of full weight.
    """

    chain: StateChain
    readings: dict[str, Reading]

    def detectors(self, stride_share: float) -> dict[str, DetectionRule]:
        """A filter and a test for each reading, by name.

        Args:
            stride_share: stride over length of the windows that they will read.
        """
        # a state is left as often per second whatever the stride
        chain = StateChain(-np.expm1(stride_share * np.log1p(-self.chain.leave)))
        weighed = {n: replace(r, weight=stride_share) for n, r in self.readings.items()}
        return {
            **{f"hmm {name}": Filter(chain, reading) for name, reading in weighed.items()},
            **{f"cusum {name}": Cusum(reading) for name, reading in weighed.items()},
        }


def learn(trials: Sequence[TrialWithSlip], length_ns: int, most: int) -> Learned:
    """Learn from labelled training trials in consecutive windows.

    Args:
        length_ns: a window's length.
        most: spikes that a class can give in a window.
    """
    labels = [trial.states(length_ns) for trial in trials]
    flat = np.concatenate([np.empty(0, np.int64), *labels])
    both = np.concatenate([np.empty((0, 14)), *(features(t.predictions, True) for t in trials)])
    counts = both[:, :3]
    classes = len(CLASSES)
    return Learned(
        fit_chain(labels, classes),
        {
            "histograms": Reading(fit_histograms(counts, flat, classes, most + 1), False, 1.0),
            "counts": Reading(fit_logistic(counts, flat, classes), False, 1.0),
            "counts and events": Reading(fit_logistic(both, flat, classes), True, 1.0),
        },
    )
