"""Rows of the detector sweep: one detector per row, figures by seed, the Pareto front.

A row is a network's setting, a precision, a stride and a rule. The rule is the paper's pair of
smoothing and margin, or a pair that validation trials of all seeds together choose. Test trials
only judge. The front is over figures of test trials; which rows would be on it by validation
trials is also given, because a front chosen on test trials is biased in its favour.

Factors are compared one at a time with the paper's value: which differences are more than seed
noise. Differences are taken seed by seed; the intervals are not corrected for multiple comparisons:
one in twenty would exclude zero by chance.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict
from itertools import pairwise

import numpy as np
import numpy.typing as npt
import pandas as pd

from sliplab.analysis.detectors.latency import NEVER, true_slip
from sliplab.analysis.detectors.rule_sweep import Trials, choose_pair, sweep
from sliplab.analysis.sweeps.runner import Arrays
from sliplab.plugins.studies.detector.document import BySeed, DetectorRow, DetectorTradeoff, mean
from sliplab.plugins.studies.detector.grid import PAPER, NetworkSetting, counted_stride, strides
from sliplab.plugins.studies.detector.pair_scores import score
from sliplab.plugins.studies.detector.paired import paired_difference
from sliplab.plugins.studies.detector.pareto import front
from sliplab.plugins.studies.detector.search import (
    PRECISIONS,
    DetectorSearch,
    LabelledTrial,
    trial_counts,
)
from sliplab.storage.streams import Json

SMOOTHINGS = (1, 2, 3, 4, 6, 8, 12, 16, 24)
MARGINS = (0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0, 20.0, 24.0, 30.0, 40.0)
"""Margins, in spikes for each of a class's output neurons."""
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
"""Figures of the front, each to be low (1) or high (-1)."""

BUDGETS = (0.02, 0.05, 0.1, 0.2)
"""Shares of trials that may be false early, for the short list."""
MOST_MISSED = 0.05
"""Share of trials that a detector of the short list may miss or see late."""

FACTORS = {
    "length_ms": "window length (ms)",
    "step_ms": "step (ms)",
    "pool_px": "pooling (px)",
    "width": "width (×)",
    "stride_ms": "stride (ms)",
    "precision": "precision",
    "rule": "rule",
}
COMPARED = {
    "strict": "test",
    "mean_ms": "test",
    "false_early_either": "test",
    "us_single": "work",
    "synaptic_operations": "work",
}
"""Figures that are compared by factor, and the part of a row that has them."""
FALLING = ("lead_min_ms", "missed", "late", "false_early", "trials")
PAIR_FIGURES = ("mean_ms", "p95_ms", "lost_either", "false_early_either")

Detections = tuple[npt.NDArray[np.int64], ...]
"""Detections of one seed in validation, test and falling trials: int64 (n, S, M, 2) each."""


class _Truth:
    """True onsets of each part of the trials, and margins in spikes of a class."""

    def __init__(self, search: DetectorSearch) -> None:
        trials = search.trials
        self.finest_ms = search.size.stride_ms
        self.validation, self.test = _true_onsets(trials.validation), _true_onsets(trials.test)
        self.falling = _true_onsets(trials.falling) if trials.falling else None
        edges = np.cumsum([0, len(trials.validation), len(trials.test), len(trials.falling)])
        self.parts = [slice(a, b) for a, b in pairwise(edges.tolist())]
        self.rate = trials.settings.detection.false_early_rate
        self.margins = [each * trials.settings.network.outputs_per_class for each in MARGINS]

    def detect(self, arrays: Arrays, precision: str, length_ms: int, stride_ms: int) -> Detections:
        """Return one seed's detections by every pair, at a stride."""
        counted = counted_stride(length_ms, self.finest_ms)
        every = stride_ms // counted
        none = np.full((len(SMOOTHINGS), len(self.margins), 2), NEVER, np.int64)
        found = np.stack(
            [
                sweep(counts[::every], ends[::every], SMOOTHINGS, self.margins)
                if len(ends)
                else none
                for counts, ends in trial_counts(arrays, precision, counted)
            ]
        )
        return tuple(found[part] for part in self.parts)

    def choose(self, each: Sequence[Detections]) -> list[tuple[int, int]]:
        """Return the pair of each rule; all seeds choose together."""
        pooled = np.concatenate([one[0] for one in each])
        columns = (np.tile(values, len(each)) for values in vars(self.validation).values())
        known = Trials(*columns)
        rates = (self.rate, LOOSE)
        chosen = [choose_pair(pooled, known, SMOOTHINGS, self.margins, rate) for rate in rates]
        return [PAPER_PAIR, *chosen]


def _true_onsets(part: Sequence[LabelledTrial]) -> Trials:
    slips = [slip for used in part if (slip := true_slip(used.label)) is not None]
    tolerance = [round(used.item.settings.detection.false_early_ms * 1e6) for used in part]
    columns = (
        [getattr(slip, name) for slip in slips] for name in ("incipient_ns", "gross_ns", "end_ns")
    )
    return Trials(*(np.array(values, np.int64) for values in (*columns, tolerance)))


def make_rows(
    search: DetectorSearch, advance: Callable[[], None] = lambda: None
) -> tuple[list[DetectorRow], dict[str, str]]:
    """Return the rows of all stored runs, and those left out, with the reason.

    Args:
        advance: called after each setting.
    """
    truth = _Truth(search)
    rows: list[DetectorRow] = []
    left_out: dict[str, str] = {}
    for setting in search.grid.settings:
        ours = [
            search.read(run)
            for run in search.runs
            if run.setting == setting and search.sweep.done(run)
        ]
        for precision in PRECISIONS:
            there = []
            for figures, arrays in ours:
                why = figures["precisions"][precision].get("left out")
                if why:
                    left_out[f"{setting.title}, seed {figures['seed']}, {precision}"] = why
                else:
                    there.append((figures, arrays))
            if there:
                rows += _rows(truth, setting, precision, there)
        advance()
    on = {part: front(_costs(rows, part)) for part in ("test", "validation")}
    marks = zip(on["test"], on["validation"], strict=True)
    return [
        row.model_copy(update={"front": bool(test), "front_validation": bool(validation)})
        for row, (test, validation) in zip(rows, marks, strict=True)
    ], left_out


def _rows(
    truth: _Truth, setting: NetworkSetting, precision: str, there: Sequence[tuple[Json, Arrays]]
) -> list[DetectorRow]:
    rows = []
    measured = [one["precisions"][precision] for one, _ in there]
    for stride in strides(setting.length_ms, truth.finest_ms):
        each = [truth.detect(a, precision, setting.length_ms, stride) for _, a in there]
        for rule, pair in zip(RULES, truth.choose(each), strict=True):
            own = precision == PRECISIONS[0] and rule == RULES[0]
            validation, test, falling = _figures(truth, pair, measured, each)
            row = {
                **asdict(setting),
                "precision": precision,
                "stride_ms": stride,
                "rule": rule,
                "smoothing": SMOOTHINGS[pair[0]],
                "margin": truth.margins[pair[1]],
                "paper": setting == PAPER and stride == PAPER.length_ms and own,
                "seeds": [one["seed"] for one, _ in there],
                "validation": validation,
                "test": test,
                "falling": falling,
                "work": _work(measured, 1000 / stride),
                "front": False,
                "front_validation": False,
            }
            rows.append(DetectorRow.model_validate(row))
    return rows


def _figures(
    truth: _Truth, pair: tuple[int, int], measured: Sequence[Json], each: Sequence[Detections]
) -> tuple[BySeed, BySeed, BySeed | None]:
    """Return figures of validation, test and falling trials by one pair."""

    def scores(part: int, onsets: Trials) -> BySeed:
        found = [vars(score(one[part][:, pair[0], pair[1]], onsets)) for one in each]
        return {name: tuple(row[name] for row in found) for name in found[0]}

    validation, test = scores(0, truth.validation), scores(1, truth.test)
    validation["strict"] = tuple(one["validation"]["strict"] for one in measured)
    test["strict"] = tuple(one["test"]["strict"] for one in measured)
    if truth.falling is None:
        return validation, test, None
    falling = scores(2, truth.falling)
    return validation, test, {name: falling[name] for name in FALLING}


def _work(measured: Sequence[Json], per_s: float) -> BySeed:
    names = ("us_single", "us_batched", "synaptic_operations")
    work = {name: tuple(one[name] for one in measured) for name in names}
    return {
        **work,
        "us_per_s": tuple(per_s * value for value in work["us_single"]),
        "synaptic_operations_per_s": tuple(per_s * v for v in work["synaptic_operations"]),
    }


def _costs(rows: Sequence[DetectorRow], part: str) -> npt.NDArray[np.float64]:
    """Return the objectives, all to be minimised; missing ones are infinite."""
    values = [
        [
            None if (v := row.objective(name, part)) is None else sign * v
            for name, sign in OBJECTIVES.items()
        ]
        for row in rows
    ]
    costs = np.array(values, np.float64).reshape(len(rows), len(OBJECTIVES))
    return np.where(np.isnan(costs), np.inf, costs)


def short_list(rows: Sequence[DetectorRow]) -> list[tuple[float, DetectorRow]]:
    """Return for each of `BUDGETS` the quickest detector that keeps it, by validation trials alone.

    Quickest is the lowest mean latency; among equals the fewest synaptic operations a second. A
    budget that none keeps has no line.
    """

    def within(row: DetectorRow, name: str, limit: float) -> bool:
        value = row.objective(name, "validation")
        return value is not None and value <= limit

    found = []
    for budget in BUDGETS:
        ours = [
            (late, row.objective("synaptic_operations_per_s", "validation") or 0.0, place)
            for place, row in enumerate(rows)
            if (late := row.objective("mean_ms", "validation")) is not None
            and within(row, "false_early_either", budget)
            and within(row, "lost_either", MOST_MISSED)
        ]
        if ours:
            found.append((budget, rows[min(ours)[-1]]))
    return found


def pair_table(search: DetectorSearch) -> list[Json]:
    """Return every pair of smoothing and margin at the paper's setting and stride, test trials."""
    truth, length = _Truth(search), PAPER.length_ms
    ours = [
        search.read(run)[1]
        for run in search.runs
        if run.setting == PAPER and search.sweep.done(run)
    ]
    each = [truth.detect(arrays, PRECISIONS[0], length, length)[1] for arrays in ours]
    rows = []
    for s, smoothing in enumerate(SMOOTHINGS if each else ()):
        for m, margin in enumerate(truth.margins):
            found = [score(one[:, s, m], truth.test) for one in each]
            means = {name: mean([getattr(row, name) for row in found]) for name in PAIR_FIGURES}
            rows.append({"smoothing": smoothing, "margin": margin, **means})
    return rows


def comparisons(rows: Sequence[DetectorRow]) -> list[Json]:
    """Return each line through the paper's setting, the paper's own value among them.

    Networks are compared with the pair that validation trials chose for each, at a stride of a
    window's length: the paper's pair belongs to its windows and says little of others.

    Returns:
        one for each value: ``factor``, ``value``, ``paper``, ``row`` (the place among `rows`), and
        by figure the differences from the paper's value as `paired.PairedDifference`
        has them, with ``told`` where they are significant.
    """
    found = []
    for factor in FACTORS:
        line = _line(rows, factor)
        own = [at for at in line if _has_papers_value(rows[at], factor)]
        start = rows[own[0]] if own else None
        found += [
            {
                "factor": factor,
                "value": getattr(rows[at], factor),
                "paper": rows[at] is start,
                "row": at,
                "difference": None if start is None else _differences(rows[at], start),
            }
            for at in line
        ]
    return found


def _line(rows: Sequence[DetectorRow], factor: str) -> list[int]:
    """Return the places of rows that differ in one factor alone, in the order of its values."""
    words = (*PRECISIONS, *RULES)

    def order(at: int) -> float:
        value = getattr(rows[at], factor)
        return float(words.index(value) if isinstance(value, str) else value)

    others = [name for name in FACTORS if name != factor]
    return sorted(
        (k for k, row in enumerate(rows) if all(_at_base(row, n) for n in others)), key=order
    )


def _has_papers_value(row: DetectorRow, factor: str) -> bool:
    return row.rule == RULES[0] if factor == "rule" else _at_base(row, factor)


def _at_base(row: DetectorRow, factor: str) -> bool:
    """Return whether a factor has the value that the lines of the other factors go through."""
    base = {
        **asdict(PAPER),
        "stride_ms": row.setting.length_ms,
        "precision": "trained",
        "rule": "chosen",
    }
    return bool(getattr(row, factor) == base[factor])


def _differences(row: DetectorRow, start: DetectorRow) -> dict[str, Json]:
    """Return differences by figure, over the seeds that both have."""
    both = [seed for seed in row.seeds if seed in start.seeds]
    result = {}
    for name, part in COMPARED.items():
        ours, theirs = (
            [getattr(of, part)[name][of.seeds.index(seed)] for seed in both] for of in (row, start)
        )
        difference = paired_difference(ours, theirs)
        result[name] = {**asdict(difference), "told": difference.significant}
    return result


def table(rows: Sequence[DetectorRow], simulated: bool) -> pd.DataFrame:
    """Return means over seeds, of two figures also the extremes; columns name their units."""
    return pd.DataFrame([_flat(row, simulated) for row in rows])


def _flat(row: DetectorRow, simulated: bool) -> Json:
    found: Json = {
        name: getattr(row, name)
        for name in ("length_ms", "step_ms", "pool_px", "precision", "stride_ms", "rule")
    }
    found |= {"width_factor": row.setting.width, "smoothing_windows": row.smoothing}
    found |= {"margin_spikes": row.margin, "seeds": len(row.seeds)}
    validation = {name: row.validation[name] for name in ("strict", "mean_ms")}
    parts = {
        "test_": row.test,
        "validation_": validation,
        "falling_": row.falling or {},
        "": row.work,
    }
    for prefix, values in parts.items():
        for name, by_seed in values.items():
            title = prefix + name + _UNITS.get(name, "")
            found[title] = mean(by_seed)
            if prefix == "test_" and name in ("strict", "mean_ms"):
                there = [value for value in by_seed if value is not None]
                found[f"{title}_lowest"] = min(there, default=None)
                found[f"{title}_highest"] = max(there, default=None)
    flags = {name: getattr(row, name) for name in ("paper", "front", "front_validation")}
    return {**found, **flags, "simulated": simulated}


_SHARES = [
    f"{name}{of}"
    for name in ("missed", "late", "lost", "false_early")
    for of in ("", "_gross", "_either")
]
_UNITS = {
    **dict.fromkeys(("strict", *_SHARES), "_share"),
    **dict.fromkeys(("us_single", "us_batched", "synaptic_operations"), "_per_window"),
    "trials": "_count",
}


def search_result(
    search: DetectorSearch, full: bool, simulated: bool, advance: Callable[[], None] = lambda: None
) -> DetectorTradeoff:
    """Return all numbers of the stored runs.

    Args:
        full: every value of the factors was tried with every other.
        advance: called after each setting.
    """
    rows, left_out = make_rows(search, advance)
    trials = search.trials
    found = {
        **plan(search, simulated),
        "full": full,
        "left_out": {**search.grid.left_out, **left_out},
        "ask": asdict(search.size),
        "trials": {
            name: len(getattr(trials, name)) for name in ("train", "validation", "test", "falling")
        },
        "windows": trials.settings.windows.model_dump(mode="json"),
        "false_early_ms": trials.settings.detection.false_early_ms,
        "false_early_rate": trials.settings.detection.false_early_rate,
        "objectives": {k: "low" if sign > 0 else "high" for k, sign in OBJECTIVES.items()},
        "rows": rows,
        "comparisons": comparisons(rows),
        "pairs": pair_table(search),
        "warnings": search.warnings(),
    }
    return DetectorTradeoff.model_validate(found)


def plan(search: DetectorSearch, simulated: bool) -> Json:
    """Return the pending work."""
    pending = len(search.sweep.pending)
    return {
        "step": "tradeoff",
        "simulated": simulated,
        "settings": [asdict(setting) for setting in search.grid.settings],
        "left_out": search.grid.left_out,
        "runs": len(search.runs),
        "kept": len(search.runs) - pending,
        "pending": pending,
    }
