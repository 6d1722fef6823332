"""Causal detectors side by side: each turns a trial's windows into evidence, window by window.

A detector says how strongly everything up to a window speaks for slip having begun; a threshold
on that makes it a detection. So detectors of any kind can be set to the same rate of false alarms
(`analysis.detect.detector_choice`) and then compared by how late they are, which is the only fair
way: each can be made as quick as one likes by letting it cry slip more often.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import numpy.typing as npt

from sliplab.analysis.detect.detection import Found, lead_of
from sliplab.analysis.detect.hidden_markov import Chain, fit_chain, forward, log_odds
from sliplab.analysis.detect.sequential import cusum
from sliplab.analysis.detect.true_slip import TrueSlip
from sliplab.analysis.detect.window_likelihood import Likelihood, fit_histograms, fit_logistic
from sliplab.analysis.nets.metrics import CLASSES, GROSS, INCIPIENT, NO_SLIP

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


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
        """Columns that do not fit each other are refused."""
        n = len(self.end_ns)
        if self.counts.shape != (n, len(CLASSES)) or self.events.shape != (n,):
            raise ValueError(
                f"counts {self.counts.shape} and events {self.events.shape} of {n} windows"
            )
        if (np.diff(self.end_ns) <= 0).any():
            raise ValueError("window ends do not increase")

    def __len__(self) -> int:
        return len(self.end_ns)


@dataclass(frozen=True)
class Labelled:
    """A trial with its true slip, on the time line of its windows."""

    predictions: Predictions
    slip: TrueSlip

    def states(self, length_ns: int) -> IntArray:
        """The class that each window of this length holds most of, by its middle; int64 (n,)."""
        middle = self.predictions.end_ns - length_ns // 2
        return (middle >= self.slip.incipient_ns).astype(np.int64) + (middle >= self.slip.gross_ns)


@dataclass(frozen=True)
class Evidence:
    """What a detector makes of one trial; no value depends on a later window.

    Attributes:
        end_ns: int64 (n,), end of each window.
        incipient: float64 (n,), how strongly everything up to each window speaks for slip.
        gross_after: the same for gross slip, given the window in which incipient slip was
            detected; only values after that window mean anything.
    """

    end_ns: IntArray
    incipient: FloatArray
    gross_after: Callable[[int], FloatArray]


class Detector(Protocol):
    """Evidence that slip has begun."""

    def evidence(self, predictions: Predictions) -> Evidence:
        """The evidence of one trial."""


@dataclass(frozen=True)
class Smoothing:
    """The paper's rule: mean counts of the last `width` windows, and by how much a class leads.

    The evidence is the lead in spikes.
    """

    width: int

    def evidence(self, predictions: Predictions) -> Evidence:
        """See `Detector`."""
        gross = lead_of(predictions.counts, self.width, GROSS)
        return Evidence(
            predictions.end_ns,
            lead_of(predictions.counts, self.width, INCIPIENT),
            lambda first: gross,
        )


@dataclass(frozen=True)
class Reading:
    """What a window's likelihoods are read from.

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
class Filter:
    """The hidden Markov filter; the evidence is log odds."""

    chain: Chain
    reading: Reading

    def evidence(self, predictions: Predictions) -> Evidence:
        """See `Detector`."""
        belief = forward(self.chain, self.reading.log(predictions))
        gross = log_odds(belief, GROSS)
        return Evidence(predictions.end_ns, log_odds(belief, INCIPIENT), lambda first: gross)


@dataclass(frozen=True)
class Cusum:
    """Page's test of no slip against incipient slip; after that, of incipient against gross."""

    reading: Reading

    def evidence(self, predictions: Predictions) -> Evidence:
        """See `Detector`."""
        log = self.reading.log(predictions)
        ratio = log[:, GROSS] - log[:, INCIPIENT]

        def gross_after(first: int) -> FloatArray:
            out = np.zeros(len(ratio))
            out[first + 1 :] = cusum(ratio[first + 1 :])
            return out

        return Evidence(predictions.end_ns, cusum(log[:, INCIPIENT] - log[:, NO_SLIP]), gross_after)


@dataclass(frozen=True)
class Levels:
    """What the evidence must EXCEED."""

    incipient: float
    gross: float


def decide(evidence: Evidence, levels: Levels) -> Found:
    """First incipient, then gross slip; each dated by the end of the window that told."""
    first = first_above(evidence.incipient, levels.incipient)
    if first is None:
        return Found(None, None)
    second = first_above(evidence.gross_after(first), levels.gross, first + 1)
    end = evidence.end_ns
    return Found(int(end[first]), None if second is None else int(end[second]))


def first_above(evidence: FloatArray, level: float, start: int = 0) -> int | None:
    """The first window from `start` on whose evidence exceeds the level."""
    found = np.flatnonzero(evidence[start:] > level)
    return start + int(found[0]) if len(found) else None


def features(predictions: Predictions, events: bool) -> FloatArray:
    """The counts; if wanted, the logarithm of one plus the events, and all products of two.

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
    """What training trials taught, for windows of any stride.

    Attributes:
        chain: how often states are left, by consecutive windows.
        readings: by name, likelihoods of windows of full weight.
    """

    chain: Chain
    readings: dict[str, Reading]

    def detectors(self, stride_share: float) -> dict[str, Detector]:
        """A filter and a test for each reading, by name.

        Args:
            stride_share: stride over length of the windows that they will read.
        """
        # a state is left as often per second whatever the stride
        chain = Chain(-np.expm1(stride_share * np.log1p(-self.chain.leave)))
        weighed = {n: replace(r, weight=stride_share) for n, r in self.readings.items()}
        return {
            **{f"hmm {name}": Filter(chain, reading) for name, reading in weighed.items()},
            **{f"cusum {name}": Cusum(reading) for name, reading in weighed.items()},
        }


def learn(trials: Sequence[Labelled], length_ns: int, most: int) -> Learned:
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
