"""The comparison on trials whose onsets are plain: fair, complete, and blind to test trials."""

from __future__ import annotations

import copy
import json
from dataclasses import replace

import numpy as np
import pytest

from sliplab.analysis.detectors.detector_comparison import Parts, compare, thinned
from sliplab.analysis.detectors.detectors import Predictions, TrialWithSlip
from sliplab.analysis.detectors.latency import TrueSlip
from sliplab.analysis.detectors.onset_references import OnsetReference, References
from sliplab.protocols.detection import ComparisonSettings, Detection
from sliplab.protocols.settings import AnalysisSettings
from sliplab.storage.schema.evaluation import DetectorComparison, PartTrials

MS = 1_000_000
DETECTION = Detection(
    smoothing_grid=(1, 4), compare=ComparisonSettings(rates=(0.0, 0.2), train_trials=9)
)
SETTINGS = AnalysisSettings(detection=DETECTION)


def trial(seed: int, stride: int) -> TrialWithSlip:
    """Each millisecond's spikes and events from the state it is in; windows sum 30 of them."""
    rng = np.random.default_rng(seed)
    onset, gross, end = 600 + int(rng.integers(0, 90)), 1300, 2000
    rates = np.zeros((end, 3))
    rates[:onset], rates[onset:gross], rates[gross:] = (
        (0.3, 0.1, 0.1),
        (0.1, 0.3, 0.1),
        (0.1, 0.1, 0.3),
    )
    fired = rng.random((end, 3)) < rates
    sums = np.concatenate([np.zeros((1, 3), int), fired.cumsum(axis=0)])
    ends = np.arange(30, end + 1, stride)
    counts = sums[ends] - sums[ends - 30]
    slip = TrueSlip(onset * MS, gross * MS, int(ends[-1] + 1) * MS)
    return TrialWithSlip(Predictions(counts, counts.sum(axis=1), ends * MS), slip)


def parts(validation: int = 10, test: int = 10) -> Parts:
    return Parts(
        [trial(k, 30) for k in range(9)],
        [trial(100 + k, 10) for k in range(validation)],
        [trial(200 + k, 10) for k in range(test)],
    )


@pytest.fixture(scope="module")
def compared() -> dict[str, object]:
    found = compare(parts(), SETTINGS, DETECTION)
    assert found is not None
    return found


def test_every_detector_at_every_stride_and_rate(compared: DetectorComparison) -> None:
    assert compared.trials == PartTrials(train=9, validation=10, test=10)
    assert compared.strides_ms == (10, 30)
    names = [(entry.name, entry.stride_ms) for entry in compared.detectors]
    assert len(names) == len(set(names)) == 16
    assert names[0] == ("smoothing", 30)
    for entry in compared.detectors:
        assert [rate.allowed for rate in entry.rates] == [0, 2]
        for rate in entry.rates:
            early = rate.validation.latency_ms.incipient.false_early
            assert early <= rate.allowed
            for part in (rate.validation, rate.test):
                values = part.latency_ms.incipient
                assert values.n + values.missed + values.false_early == 10
                assert len(part.false_early_before_ms) == values.false_early
                assert all(before > 30 for before in part.false_early_before_ms)
                share = part.false_early_rate
                assert share.low <= share.value == values.false_early / 10 <= share.high
    json.dumps(compared.to_json(), allow_nan=False)


def test_what_adds_up_evidence_beats_the_average_here(compared: DetectorComparison) -> None:
    late = {
        (entry.name, entry.stride_ms): entry.rates[0].test.median_with_missed_ms
        for entry in compared.detectors
    }
    # independent windows of known distribution: what CUSUM and the filter are the best for
    assert late["hmm counts", 10] < late["smoothing", 30]
    assert late["cusum counts", 10] < late["smoothing", 30]


def test_no_level_and_no_choice_knows_the_test_trials(compared: DetectorComparison) -> None:
    one = Parts(parts().train, parts().validation, [trial(900, 10)])
    other = compare(one, SETTINGS, DETECTION)
    for mine, theirs in zip(compared.detectors, other.detectors, strict=True):
        for a, b in zip(mine.rates, theirs.rates, strict=True):
            assert (a.levels, a.choice, a.validation) == (b.levels, b.choice, b.validation)


def test_other_onsets_judge_and_decide_nothing(compared: DetectorComparison) -> None:
    def seen(every: list[TrialWithSlip]) -> list[TrialWithSlip]:
        return [replace(t, references=references(t.slip)) for t in every]

    def references(slip: TrueSlip) -> References:
        earlier = replace(slip, incipient_ns=slip.incipient_ns - 300 * MS)
        return {"paper": OnsetReference(slip), "true": OnsetReference(earlier)}

    of = parts()
    judged = Parts(seen(of.train), seen(of.validation), seen(of.test))
    found = compare(judged, SETTINGS, DETECTION)
    for mine, theirs in zip(found.detectors, compared.detectors, strict=True):
        assert mine.curve == theirs.curve
        for a, b in zip(mine.rates, theirs.rates, strict=True):
            assert a.model_copy(update={"by_reference": {}}) == b
            assert a.by_reference["paper"].latency_ms == a.test.latency_ms
            late, label = (a.by_reference[n].latency_ms.incipient for n in ("true", "paper"))
            assert late.false_early <= label.false_early
            if label.n == late.n == 10:
                assert late.median == pytest.approx(label.median + 300)
            assert a.by_reference["change_point"].lacking == 10


def test_one_stride_is_compared_once() -> None:
    few = Parts(
        parts().train,
        *([thinned(t, 3) for t in p] for p in (parts(3, 3).validation, parts(3, 3).test)),
    )
    detection = DETECTION.model_copy(
        update={"compare": ComparisonSettings(rates=(0.0, 0.2), train_trials=9, stride_ms=30)}
    )
    found = compare(few, AnalysisSettings(detection=detection), detection)
    assert found.strides_ms == (30,)
    assert len(found.detectors) == 8


def test_thinned_windows_are_the_consecutive_ones() -> None:
    fine, coarse = trial(5, 10), trial(5, 30)
    kept = thinned(fine, 3).predictions
    assert kept.end_ns.tolist() == coarse.predictions.end_ns.tolist()
    assert (kept.counts == coarse.predictions.counts).all()


@pytest.mark.parametrize("missing", ["train", "validation", "test", "compare"])
def test_nothing_to_compare(missing: str) -> None:
    there = copy.copy(vars(parts(2, 2)))
    if missing == "compare":
        assert compare(Parts(**there), SETTINGS, Detection(compare=None)) is None
        return
    there[missing] = []
    assert compare(Parts(**there), SETTINGS, DETECTION) is None
