"""What the report's accuracy costs in false alarms under nuisances."""

from __future__ import annotations

from sliplab.analysis.metrics.alarm_rates import alarm_rate
from sliplab.analysis.report.alarms import alarm_words
from sliplab.plugins.bench.stress.document import StressRecord
from sliplab.plugins.bench.stress.rates import stress_alarms

QUIET = {"quiet": alarm_rate([1, 1, 0], [0.01, 0.01, 0.005])}


def test_false_alarms_under_nuisances_are_those_of_the_networks_rule() -> None:
    cell = {
        "strength": None,
        "trials": 12,
        "hold_h": 0.5,
        "missed": 0,
        "latency_ms": None,
        "latency_true_ms": None,
        "clean": {"value": 1.0, "low": 0.7, "high": 1.0},
    }
    rate = {"value": 168.0, "low": 90.0, "high": 260.0}
    figures = [
        {**cell, "nuisance": "all", "false_alarms": 84, "per_hour": rate},
        {**cell, "nuisance": "none", "false_alarms": 1, "per_hour": {**rate, "value": 2.0}},
        {**cell, "nuisance": "brush", "false_alarms": 83, "per_hour": rate},
    ]
    smoothing = [{**it, "per_hour": {**rate, "value": 599.0}} for it in figures]
    common = {"network": "own", "stride_ms": 30}
    record = StressRecord.model_validate(
        {
            "simulated": True,
            "campaign": "c",
            "rig": "r",
            "protocol": "p",
            "trials": 12,
            "without_onsets": 0,
            "hold_h": 0.5,
            "accuracy": [],
            "detectors": [
                {**common, "rule": "smoothing", "figures": smoothing},
                {**common, "rule": "rule, 4 windows", "figures": figures},
            ],
        }
    )
    found = stress_alarms(record, "own")
    assert {name: it.value for name, it in found.items()} == {"nuisances": 168.0, "none": 2.0}
    assert stress_alarms(record, "preset: paper") == stress_alarms(None, "own") == {}
    text = alarm_words(QUIET | found)
    assert "80.0 (9.7 to 289.0) in quiet holding (2 in 0.025 h of 3 trials; below 24" in text
    assert "168 (90 to 260) under nuisances" in text
