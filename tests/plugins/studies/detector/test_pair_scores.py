"""Every pair of a sweep is the rule's, and every figure is the summary's."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sliplab.analysis.detectors.latency import (
    NEVER,
    TrueSlip,
    score_trial,
    summarise_latency,
    summarise_lead,
)
from sliplab.analysis.detectors.rule_sweep import SpikeCounts, Trials, sweep
from sliplab.analysis.detectors.smoothing_rule import detect
from sliplab.plugins.studies.detector.pair_scores import score
from sliplab.protocols.detection import Detection

MS = 1_000_000
SMOOTHINGS, MARGINS = (1, 2, 5), (0.0, 0.5, 1.0, 3.0)


@st.composite
def trials(draw: st.DrawFn) -> list[SpikeCounts]:
    found = []
    for _ in range(draw(st.integers(1, 6))):
        n = draw(st.integers(1, 20))
        flat = draw(st.lists(st.integers(0, 6), min_size=3 * n, max_size=3 * n))
        times = sorted(draw(st.lists(st.integers(0, 600), min_size=3, max_size=3)))
        ends = (np.arange(n, dtype=np.int64) + 1) * 30 * MS
        counts = np.array(flat, np.int64).reshape(n, 3)
        found.append(SpikeCounts(counts, ends, TrueSlip(*(t * MS for t in times))))
    return found


def swept(found: list[SpikeCounts]) -> tuple[np.ndarray, Trials]:
    pairs = [sweep(t.counts.astype(np.uint8), t.end_ns, SMOOTHINGS, MARGINS) for t in found]
    tolerance = np.full(len(found), 30 * MS, np.int64)
    slips = [np.array(of) for of in zip(*(vars(t.slip).values() for t in found), strict=True)]
    return np.stack(pairs), Trials(*slips, tolerance)


@settings(max_examples=30)
@given(trials())
def test_pairs_and_figures_are_those_of_the_rule(found: list[SpikeCounts]) -> None:
    each, truth = swept(found)
    for s, smoothing in enumerate(SMOOTHINGS):
        for m, margin in enumerate(MARGINS):
            rule = Detection(smoothing=smoothing, margin=margin)
            said = [detect(t.counts, t.end_ns, rule) for t in found]
            for k, one in enumerate(said):
                reported = [NEVER if v is None else v for v in (one.incipient_ns, one.gross_ns)]
                assert each[k, s, m].tolist() == reported
            scored = [score_trial(one, t.slip, 30 * MS) for one, t in zip(said, found, strict=True)]
            latency, lead = summarise_latency(scored), summarise_lead(scored)
            figures, n = score(each[:, s, m], truth), len(found)
            assert figures.mean_ms == pytest.approx(latency.incipient.mean)
            assert figures.p95_ms == pytest.approx(latency.incipient.p95)
            assert figures.gross_mean_ms == pytest.approx(latency.gross.mean)
            assert figures.lead_min_ms == pytest.approx(lead.min)
            for kind, suffix in (("incipient", ""), ("gross", "_gross")):
                for name in ("missed", "late", "false_early"):
                    share = getattr(figures, f"{name}{suffix}")
                    assert share * n == pytest.approx(getattr(getattr(latency, kind), name))
            either = sum(t.false_early_incipient or t.false_early_gross for t in scored)
            assert figures.false_early_either * n == pytest.approx(either)
            lost = sum(any(t.uncounted[2:]) for t in scored)
            assert figures.lost_either * n == pytest.approx(lost)
            assert figures.trials == n


def test_a_trial_shorter_than_the_average_has_no_detection() -> None:
    counts = np.array([[0, 9, 0]], np.uint8)
    found = sweep(counts, np.array([30 * MS]), (1, 2), (1.0,))
    assert found.tolist() == [[[30 * MS, NEVER]], [[NEVER, NEVER]]]
