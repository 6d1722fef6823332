"""From kept runs to the rows of the detector's trade-off: one detector a row, means over seeds.

A row is a network's setting, a precision, a stride and a rule. The rule is the paper's pair of
smoothing and margin, or a pair that validation trials of all seeds together choose. Test trials
only judge. The front is over figures of test trials; which rows would be on it by validation
trials stands beside, because a front picked by test trials flatters whoever is on it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from sliplab.analysis.detectors.latency import NEVER
from sliplab.analysis.detectors.rule_sweep import Figures, Trials, choose_pair, score, sweep
from sliplab.analysis.metrics.pareto import front
from sliplab.flows.searching.detector_tradeoff_data import Data, true_onsets
from sliplab.flows.searching.detector_tradeoff_grid import PAPER, Setting, counted_stride, strides
from sliplab.flows.searching.detector_tradeoff_runs import PRECISIONS, Kept, Run, trial_counts

SMOOTHINGS = (1, 2, 3, 4, 6, 8, 12, 16, 24)
MARGINS = (0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0, 20.0, 24.0, 30.0, 40.0)
"""In spikes for each of a class's output neurons."""
PAPER_PAIR = (SMOOTHINGS.index(4), MARGINS.index(2.0))
LOOSE = 0.1
"""Share of validation trials that the looser choice may leave false early, for either onset."""
RULES = ("paper's", "chosen", f"chosen, {100 * LOOSE:g} %")
"""The paper's pair; that of validation trials at the protocol's share, and at the looser one."""

OBJECTIVES = {
    "strict": -1,
    "mean_ms": 1,
    "p95_ms": 1,
    "false_early_either": 1,
    "lost_either": 1,
    "us_per_s": 1,
    "synaptic_operations_per_s": 1,
}
"""What the front is over, and whether it is to be low (1) or high (-1)."""

BUDGETS = (0.02, 0.05, 0.1, 0.2)
"""Shares of trials that may be false early, for the short list."""

MOST_MISSED = 0.05
"""Share of trials that a detector of the short list may miss or see late."""

Row = dict[str, Any]


@dataclass(frozen=True)
class Judged:
    """What the rule finds with every pair in the trials of one seed: int64 (n, S, M, 2)."""

    validation: npt.NDArray[np.int64]
    test: npt.NDArray[np.int64]
    falling: npt.NDArray[np.int64]


def make_rows(
    data: Data, kept: Kept, runs: Sequence[Run], advance: Callable[[], None]
) -> tuple[list[Row], dict[str, str]]:
    """All rows whose runs are kept, with their places on the front; and what is left out.

    Args:
        advance: called after each setting.
    """
    truth = Truth(data)
    rows: list[Row] = []
    left_out: dict[str, str] = {}
    for setting in dict.fromkeys(run.setting for run in runs):
        ours = [kept.read(run) for run in runs if run.setting == setting and kept.done(run)]
        for precision in PRECISIONS:
            there = [one for one in ours if "left out" not in one[0]["precisions"][precision]]
            for figures, _ in ours:
                why = figures["precisions"][precision].get("left out")
                if why:
                    left_out[f"{setting.words}, seed {figures['seed']}, {precision}"] = why
            if there:
                rows += _rows(truth, setting, precision, there, data.ask.stride_ms)
        advance()
    for name, part in (("front", "test"), ("front_validation", "validation")):
        for row, on in zip(rows, front(_costs(rows, part)), strict=True):
            row[name] = bool(on)
    return rows, left_out


class Truth:
    """True onsets of each part, how many trials each has, and margins in spikes of a class."""

    def __init__(self, data: Data) -> None:
        self.validation, self.test = true_onsets(data.validation), true_onsets(data.test)
        self.falling = true_onsets(data.falling) if data.falling else None
        edges = np.cumsum([0, len(data.validation), len(data.test), len(data.falling)])
        self.parts = [slice(a, b) for a, b in pairwise(edges.tolist())]
        self.rate = data.settings.detection.false_early_rate
        self.margins = [each * data.settings.network.outputs_per_class for each in MARGINS]

    def judged(
        self, arrays: dict[str, npt.NDArray[Any]], precision: str, counted_ms: int, every: int
    ) -> Judged:
        """Detections at a stride of `every` counted windows."""
        none = np.full((len(SMOOTHINGS), len(self.margins), 2), NEVER, np.int64)
        found = [
            sweep(counts[::every], ends[::every], SMOOTHINGS, self.margins) if len(ends) else none
            for counts, ends in trial_counts(arrays, precision, counted_ms)
        ]
        stacked = np.stack(found)
        return Judged(*(stacked[part] for part in self.parts))


def _rows(
    truth: Truth, setting: Setting, precision: str, there: list[Any], finest_ms: int
) -> list[Row]:
    counted = counted_stride(setting.length_ms, finest_ms)
    rows = []
    for stride in strides(setting.length_ms, finest_ms):
        each = [truth.judged(arrays, precision, counted, stride // counted) for _, arrays in there]
        pooled = np.concatenate([one.validation for one in each])
        known = _repeated(truth.validation, len(each))
        chosen = [
            choose_pair(pooled, known, SMOOTHINGS, truth.margins, r) for r in (truth.rate, LOOSE)
        ]
        for rule, pair in zip(RULES, (PAPER_PAIR, *chosen), strict=True):
            figures = [one[0] for one in there]
            rows.append(
                {
                    **setting.as_dict(),
                    "precision": precision,
                    "stride_ms": stride,
                    "rule": rule,
                    "smoothing": SMOOTHINGS[pair[0]],
                    "margin": truth.margins[pair[1]],
                    "paper": _is_paper(setting, precision, stride, rule),
                    "seeds": [one["seed"] for one in figures],
                    **_figures(truth, precision, stride, pair, figures, each),
                }
            )
    return rows


def _is_paper(setting: Setting, precision: str, stride: int, rule: str) -> bool:
    own = precision == PRECISIONS[0] and rule == RULES[0]
    return setting == PAPER and stride == PAPER.length_ms and own


def _figures(
    truth: Truth,
    precision: str,
    stride: int,
    pair: tuple[int, int],
    figures: list[Any],
    each: list[Judged],
) -> dict[str, Any]:
    """By part, each figure by seed; and work."""
    s, m = pair
    result: dict[str, Any] = {}
    for part in ("validation", "test"):
        onsets = getattr(truth, part)
        found = [vars(score(getattr(one, part)[:, s, m], onsets)) for one in each]
        result[part] = {name: [row[name] for row in found] for name in found[0]}
        result[part]["strict"] = [one["precisions"][precision][part]["strict"] for one in figures]
    if truth.falling is not None:
        falls = [score(one.falling[:, s, m], truth.falling) for one in each]
        result["falling"] = {
            name: [getattr(row, name) for row in falls]
            for name in ("lead_min_ms", "missed", "late", "false_early", "trials")
        }
    else:
        result["falling"] = None
    work = [one["precisions"][precision] for one in figures]
    per_s = 1000 / stride
    result["work"] = {
        "us_single": [one["us_single"] for one in work],
        "us_batched": [one["us_batched"] for one in work],
        "synaptic_operations": [one["synaptic_operations"] for one in work],
        "us_per_s": [per_s * one["us_single"] for one in work],
        "synaptic_operations_per_s": [per_s * one["synaptic_operations"] for one in work],
    }
    return result


def mean(values: Sequence[float | None]) -> float | None:
    """Over seeds; None where a seed has no such figure."""
    there = [value for value in values if value is not None]
    return float(np.mean(there)) if len(there) == len(values) and there else None


def objective(row: Row, name: str, part: str = "test") -> float | None:
    """A row's mean of one of `OBJECTIVES`."""
    return mean((row["work"] if name in row["work"] else row[part])[name])


def _costs(rows: Sequence[Row], part: str) -> npt.NDArray[np.float64]:
    """What is not there is infinitely bad."""
    costs = np.full((len(rows), len(OBJECTIVES)), np.inf)
    for i, row in enumerate(rows):
        for k, (name, sign) in enumerate(OBJECTIVES.items()):
            value = objective(row, name, part)
            if value is not None:
                costs[i, k] = sign * value
    return costs


def short_list(rows: Sequence[Row]) -> list[tuple[float, Row]]:
    """For each of `BUDGETS` the quickest detector that keeps it, by validation trials alone.

    Quickest is the lowest mean latency; among equals the fewest synaptic operations a second. A
    budget that none keeps has no line.
    """
    found = []
    for budget in BUDGETS:
        ours = [
            (late, objective(row, "synaptic_operations_per_s", "validation") or 0.0, place)
            for place, row in enumerate(rows)
            if (late := objective(row, "mean_ms", "validation")) is not None
            and _within(row, "false_early_either", budget)
            and _within(row, "lost_either", MOST_MISSED)
        ]
        if ours:
            found.append((budget, rows[min(ours)[-1]]))
    return found


def _within(row: Row, name: str, limit: float) -> bool:
    value = objective(row, name, "validation")
    return value is not None and value <= limit


def _repeated(trials: Trials, times: int) -> Trials:
    return Trials(*(np.tile(values, times) for values in vars(trials).values()))


def pair_table(data: Data, kept: Kept, runs: Sequence[Run]) -> list[dict[str, Any]]:
    """Every pair of smoothing and margin at the paper's setting and stride, on test trials."""
    truth = Truth(data)
    counted = counted_stride(PAPER.length_ms, data.ask.stride_ms)
    ours = [kept.read(run)[1] for run in runs if run.setting == PAPER and kept.done(run)]
    every = PAPER.length_ms // counted
    each = [truth.judged(arrays, PRECISIONS[0], counted, every).test for arrays in ours]
    rows = []
    for s, smoothing in enumerate(SMOOTHINGS if each else ()):
        for m, margin in enumerate(truth.margins):
            found: list[Figures] = [score(one[:, s, m], truth.test) for one in each]
            names = ("mean_ms", "p95_ms", "lost_either", "false_early_either")
            means = {name: mean([getattr(row, name) for row in found]) for name in names}
            rows.append({"smoothing": smoothing, "margin": margin, **means})
    return rows
