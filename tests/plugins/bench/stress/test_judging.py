"""Alarms, outcomes and the order of detectors under nuisances."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.stats import chi2

from sliplab.analysis.detectors.detectors import Predictions, Smoothing, WindowEvidence
from sliplab.analysis.detectors.latency import TrueSlip
from sliplab.plugins.bench.stress.judging import (
    ALL,
    StressTrial,
    TrialDetection,
    alarms,
    figures,
    groups,
    ordered,
    outcome,
    stressed,
)

MS, S = 1_000_000, 1_000_000_000
STRIDE = 30 * MS
TOLERANCE = 30 * MS
SLIP = TrueSlip(10 * S, 15 * S, 19 * S)


def predictions(incipient: np.ndarray) -> Predictions:
    """Windows in which the class of incipient slip leads by these spikes."""
    counts = np.zeros((len(incipient), 3), np.int64)
    counts[:, 1] = incipient
    end_ns = STRIDE * (1 + np.arange(len(incipient), dtype=np.int64))
    return Predictions(counts, counts.sum(axis=1), end_ns)


def test_after_an_alarm_it_rests_and_begins_anew() -> None:
    lead = np.zeros(200, np.int64)
    lead[10:130] = 9
    found = alarms(Smoothing(4), 5.0, predictions(lead))
    # three of four windows with 9 exceed 5; then a second of rest, and four windows of its own
    assert found[0] == 13 * STRIDE
    first_after = found[0] // STRIDE + 1 + 33  # windows that end after the second
    assert found[1] == (first_after + 3) * STRIDE - (
        0 if first_after * STRIDE > found[0] + S else 1
    )
    assert (np.diff(found) > S).all()
    assert len(alarms(Smoothing(4), 9.0, predictions(lead))) == 0


def test_what_lies_before_an_alarm_is_forgotten() -> None:
    """Evidence of a detector that adds up begins at nothing again."""

    @dataclass(frozen=True)
    class Summing:
        def evidence(self, predictions: Predictions) -> WindowEvidence:
            total = predictions.counts[:, 1].cumsum().astype(np.float64)
            return WindowEvidence(predictions.end_ns, total, lambda first: total)

    found = alarms(Summing(), 49.5, predictions(np.ones(400, np.int64)))
    assert found[0] == 50 * STRIDE
    assert np.diff(found) == pytest.approx([(33 + 50) * STRIDE] * (len(found) - 1), abs=STRIDE)


@pytest.mark.parametrize(
    ("at_ns", "expected"),
    [
        ([], TrialDetection(0, None)),
        ([SLIP.incipient_ns - TOLERANCE], TrialDetection(0, SLIP.incipient_ns - TOLERANCE)),
        ([SLIP.incipient_ns - TOLERANCE - 1], TrialDetection(1, None)),
        ([1 * S, 5 * S, 11 * S, 13 * S], TrialDetection(2, 11 * S)),
        ([SLIP.gross_ns - 1], TrialDetection(0, SLIP.gross_ns - 1)),
        ([SLIP.gross_ns], TrialDetection(0, None)),
    ],
)
def test_an_alarm_is_false_a_detection_or_too_late(
    at_ns: list[int], expected: TrialDetection
) -> None:
    assert outcome(np.array(at_ns, np.int64), SLIP, TOLERANCE) == expected


def trial(nuisance: str = "none", strength: float = 100.0, hold_s: int = 10) -> StressTrial:
    slip = TrueSlip(hold_s * S, hold_s * S + 5 * S, hold_s * S + 9 * S)
    return StressTrial(nuisance, strength, 0, slip, slip.incipient_ns - 100 * MS)


def test_figures_count_what_happened() -> None:
    at = 10 * S + 40 * MS
    rows = [
        (trial(), TrialDetection(0, at)),
        (trial(), TrialDetection(2, at)),
        (trial(), TrialDetection(0, None)),
    ]
    found = figures("none", 100.0, rows)
    assert (found.trials, found.false_alarms, found.missed) == (3, 2, 1)
    assert found.clean.value == pytest.approx(1 / 3)
    assert found.per_hour.value == pytest.approx(2 / (30 / 3600))
    assert (found.latency_ms, found.latency_true_ms) == (40.0, 140.0), "one of three missed"


def test_rate_of_alarms_is_wider_where_trials_of_a_condition_differ() -> None:
    """The same 72 alarms: six in each trial under brushing, or all in three of them."""
    quiet = [(trial("none"), TrialDetection(0, None))] * 12
    alike = [(trial("brush"), TrialDetection(6, None))] * 12
    apart = [(trial("brush"), TrialDetection(24 if k < 3 else 0, None)) for k in range(12)]
    poisson = [chi2.ppf(share, 144 + odd) / 2 for share, odd in ((0.025, 0), (0.975, 2))]
    found = figures(ALL, None, quiet + alike).per_hour
    # conditions differ in every repetition alike, so that is no chance
    assert (found.low, found.high) == pytest.approx([15 * count for count in poisson])
    wide = figures(ALL, None, quiet + apart).per_hour
    assert wide.value == found.value
    assert wide.low is not None
    assert wide.high is not None
    assert wide.high - wide.low > 3 * 15 * (poisson[1] - poisson[0])


def test_one_trial_has_a_rate_without_interval() -> None:
    found = figures("none", 100.0, [(trial(), TrialDetection(3, None))]).per_hour
    assert (found.low, found.high) == (None, None)


def test_missed_slips_are_infinitely_late_in_the_median() -> None:
    at = [10 * S + ms * MS for ms in (40, 60, 80)]
    rows = [(trial(), TrialDetection(0, ns)) for ns in at]
    assert figures("none", None, rows).latency_ms == 60.0
    missed = [(trial(), TrialDetection(0, None))] * 2
    assert figures("none", None, rows + missed).latency_ms == 80.0
    assert figures("none", None, rows + missed).latency_true_ms == 180.0
    assert figures("none", None, rows + missed * 2).latency_ms is None


def test_groups_hold_each_trial_once_at_each_level() -> None:
    trials = [trial(name, s) for name in ("none", "tap") for s in (50.0, 100.0) for _ in range(3)]
    sizes = {(name, s): sum(map(belongs, trials)) for name, s, belongs in groups(trials)}
    assert sizes == {
        (ALL, None): 12,
        ("none", None): 6,
        ("none", 50.0): 3,
        ("none", 100.0): 3,
        ("tap", None): 6,
        ("tap", 50.0): 3,
        ("tap", 100.0): 3,
    }


@dataclass(frozen=True)
class Says:
    """A detector that does not look: its evidence is a function of time alone."""

    kind: str
    seed: int = 0

    def evidence(self, predictions: Predictions) -> WindowEvidence:
        n, end_ns = len(predictions), predictions.end_ns
        said = {
            "always": lambda: np.ones(n),
            "never": lambda: np.zeros(n),
            # one alarm in 50 s in the mean: about the best that guessing can do here
            "random": lambda: (
                np.random.default_rng([self.seed, n]).random(n) < STRIDE / (50 * S)
            ).astype(float),
            "clock": lambda: (np.abs(end_ns - 44.9 * S) < STRIDE).astype(float),
        }[self.kind]()
        return WindowEvidence(end_ns, said, lambda first: said)


def test_who_does_not_look_is_at_the_bottom() -> None:
    rng = np.random.default_rng(1)
    trials, seen = [], []
    for hold_s in np.repeat([36, 44, 52, 60], 20):
        it = trial(hold_s=int(hold_s))
        windows = it.slip.end_ns // STRIDE
        lead = rng.poisson(1.0, windows)
        lead[it.slip.incipient_ns // STRIDE :] += 6
        trials.append(it)
        seen.append(predictions(lead))
    honest = [(t, alarms(Smoothing(4), 5.0, p)) for t, p in zip(trials, seen, strict=True)]
    judged = {"honest": honest}
    for kind in ("always", "never", "random", "clock"):
        judged[kind] = [
            (t, alarms(Says(kind, k), 0.5, p))
            for k, (t, p) in enumerate(zip(trials, seen, strict=True))
        ]
    found = ordered(
        stressed(name, "", 30, [(t, outcome(at, t.slip, TOLERANCE)) for t, at in rows])
        for name, rows in reversed(judged.items())
    )
    clean = {it.network: it.figures[0].clean.value for it in found}
    assert found[0].network == "honest"
    assert clean["honest"] > 0.95
    assert clean["always"] == clean["never"] == 0
    assert clean["random"] < 0.15
    assert clean["clock"] == 0.25  # the one length of hold that it knows
