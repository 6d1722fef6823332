"""Latency in the report: bounds of its intervals, cut bars, and changes between levels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from sliplab.analysis.metrics.intervals import difference, interval
from sliplab.analysis.report import latency
from sliplab.analysis.report.figures import intervals
from sliplab.analysis.report.figures.intervals import Panel
from sliplab.analysis.report.outcomes import TIMES, Conditions, trial_intervals
from sliplab.storage.schema.summary import RuleSettings, TrialOutcome

RULES = [RuleSettings(smoothing=4, margin=8.0, false_early_ms=30.0)]


class Levels(Conditions):
    """Eight trials of two factors of two levels, without an effect."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.factors = {name: ["1 mm", "2 mm"] for name in ("depth", "width")}
        self._rows = [
            (trial(rng.normal(0, 40, 4)), {"depth": f"{k % 2 + 1} mm", "width": f"{k // 4 + 1} mm"})
            for k in range(8)
        ]


def trial(times: Sequence[float]) -> TrialOutcome:
    found = {"campaign": "c", "experiment": "gravity", "trial": "t", "outcome": "detected_first"}
    return TrialOutcome.model_validate(
        {**found, "gross": "detected", **dict(zip(TIMES, map(float, times), strict=True))}
    )


def test_an_interval_is_the_same_in_summary_table_and_figure(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    drawn: list[Panel] = []
    monkeypatch.setattr(latency, "by_condition", lambda _rows, panels, **_: drawn.extend(panels))
    trials = [trial([10.0, -20.0, -20.0, 5.0]), trial([900.0, 200.0, 300.0, 900.0])]
    found = Levels(np.random.default_rng(0))
    found._rows = [(row, {"depth": "1 mm"}) for row in trials]
    of_all = trial_intervals(trials, RULES)
    latency.draw_times({"all": trials}, TIMES, (), "figure", RULES, True)
    cells = latency._by_level(found, "depth", RULES).rows[0]
    for name, panel, cell in zip(TIMES, drawn, cells[2:], strict=True):
        low, high = of_all.of(name).mean
        assert low == (-30.0 if name.startswith("latency") else 0.0)
        assert interval(panel.values["all"], least=panel.least) == (low, high)
        assert f"({low:.0f} to {high:.0f})" in cell


@pytest.mark.parametrize(("least", "arrows"), [(-np.inf, 2), (-30.0, 1)])
def test_bar_that_is_cut_ends_in_an_arrow(
    monkeypatch: pytest.MonkeyPatch, least: float, arrows: int
) -> None:
    drawn = []

    def keep(figure: Any, _simulated: bool) -> str:
        drawn.extend(line.get_marker() for line in figure.axes[0].lines)
        return ""

    monkeypatch.setattr(intervals, "svg_text", keep)
    panel = Panel("ms", {"a": (-20.0, 0.0, 200.0)}, least=least)
    intervals.by_condition(["a"], [panel], simulated=True)
    assert len({"<", ">"} & {*drawn}) == arrows


def test_changes_of_a_section_hold_at_once() -> None:
    """Of eight changes without an effect none is significant in 95 % of reports."""
    rng, alone, together = np.random.default_rng(2), 0, 0
    for _ in range(200):
        found = Levels(rng)
        trends: dict[str, Any] = latency._trends(found, TIMES)
        assert [len(of) for of in trends.values()] == [2] * 4
        changes = [it for of in trends.values() for it in of]
        together += all(it.low <= 0 <= it.high for it in changes)
        spans = [
            difference(*([getattr(row, name) for row in found.at(depth=f"{k} mm")] for k in (2, 1)))
            for name in TIMES
        ]
        alone += all(span is not None and span[0] <= 0 <= span[1] for span in spans)
    assert together >= 180
    assert alone < together
