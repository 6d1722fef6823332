"""Intervals, temperature and calibration error against closed forms."""

import json

import numpy as np
import pytest

from sliplab.analysis.metrics import reliability
from sliplab.analysis.metrics.reliability import by_lead, calibration, cross_entropy, lead


def test_leads_are_counted_by_hand() -> None:
    counts = np.array([[3, 3, 0], [0, 0, 0], [5, 4, 0], [2, 3, 0], [9, 0, 0], [0, 14, 1]])
    labels = np.array([0, 0, 0, 0, 0, 1])
    assert lead(counts).tolist() == [0, 0, 1, 1, 9, 13]
    rows = [(r.lead, r.to, r.n, r.right) for r in by_lead(counts, labels, np.arange(6))]
    # a tie is never right, whichever class argmax would take
    assert rows == [(0, 0, 2, 0), (1, 1, 2, 1), (8, 11, 1, 1), (12, 15, 1, 1)]


def test_the_usual_margins_begin_a_row_and_the_last_is_open() -> None:
    leads = np.array([0, 1, 2, 7, 8, 95, 96, 240])
    counts = np.stack([leads, np.zeros(8, int), np.zeros(8, int)], axis=1)
    rows = by_lead(counts, np.zeros(8, int), np.arange(8))
    assert [(r.lead, r.to, r.n) for r in rows] == [
        (0, 0, 1),
        (1, 1, 1),
        (2, 2, 1),
        (6, 7, 1),
        (8, 11, 1),
        (64, 95, 1),
        (96, None, 2),
    ]


def test_temperature_has_a_closed_form_for_one_kind_of_lead() -> None:
    """Counts (k, 0, -inf-like): right in a share p of the cases: softmax(k / T) = p."""
    k, right, wrong = 6.0, 80, 20
    counts = np.tile([k, 0.0, -1e6], (right + wrong, 1))
    labels = np.repeat([0, 1], [right, wrong])
    found = reliability.fit_temperature(counts, labels)
    assert found == pytest.approx(k / np.log(right / wrong), rel=1e-4)
    # nothing else gives less
    best = cross_entropy(counts, labels, found)
    for factor in (0.9, 1.1):
        assert cross_entropy(counts, labels, found * factor) > best


def test_calibration_error_by_hand() -> None:
    p = np.array([[0.9, 0.1, 0.0], [0.9, 0.1, 0.0], [0.5, 0.5, 0.0], [0.5, 0.3, 0.2]])
    labels = np.array([0, 1, 0, 0])
    # bin of 0.9: said 1.8, right 1; bin of 0.5: said 1.0, right a half (tie) and 1
    assert reliability.expected_calibration_error(p, labels) == pytest.approx((0.8 + 0.5) / 4)


def test_drawn_from_the_said_probabilities_there_is_little_error() -> None:
    rng = np.random.default_rng(1)
    counts = rng.poisson(4, (20_000, 3))
    p = np.exp(counts / 3.0)
    p /= p.sum(axis=1, keepdims=True)
    labels = (rng.random(len(p))[:, None] > p.cumsum(axis=1)).sum(axis=1)
    found = calibration(counts[:10_000], labels[:10_000], counts[10_000:], labels[10_000:])
    assert found.temperature == pytest.approx(3.0, rel=0.05)
    assert found.ece < 0.02 < found.uncalibrated.ece


def test_only_validation_windows_are_fitted() -> None:
    rng = np.random.default_rng(2)
    counts, labels = rng.poisson(4, (300, 3)), rng.integers(0, 3, 300)
    held = (counts[200:], labels[200:])
    first = calibration(counts[:100], labels[:100], *held)
    second = calibration(counts[100:200], labels[100:200], *held)
    assert first.temperature == second.temperature


def test_nothing_gives_none_and_plain_json() -> None:
    none = (np.zeros((0, 3), int), np.zeros(0, int))
    some = (np.array([[1, 0, 0]]), np.array([0]))
    assert by_lead(*none, np.zeros(0, int)) == []
    assert calibration(*none, *some).ece is None
    assert calibration(*some, *none).temperature is None
    json.dumps(calibration(*some, *some).to_json(), allow_nan=False)
