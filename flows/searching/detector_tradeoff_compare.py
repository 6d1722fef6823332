"""One factor at a time against the paper's point: which differences are more than seed noise.

Stride, precision and rule are compared with the paper's setting as well. Differences are taken seed
by seed; the intervals are each by itself, so of twenty one would leave zero out by chance.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any

from sliplab.analysis.metrics.paired import paired_difference
from sliplab.flows.searching.detector_tradeoff_grid import PAPER
from sliplab.flows.searching.detector_tradeoff_rows import RULES, Row
from sliplab.flows.searching.detector_tradeoff_runs import PRECISIONS

FACTORS = {
    "length_ms": "window length (ms)",
    "step_ms": "step (ms)",
    "pool_px": "pooling (px)",
    "width": "width (×)",
    "stride_ms": "stride (ms)",
    "precision": "precision",
    "rule": "rule",
}
FIGURES = {
    "strict": ("test", "strict"),
    "mean_ms": ("test", "mean_ms"),
    "false_early_either": ("test", "false_early_either"),
    "us_single": ("work", "us_single"),
    "synaptic_operations": ("work", "synaptic_operations"),
}


def comparisons(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Each line through the paper's point, the paper's own value among them.

    Networks are compared with the pair that validation trials chose for each, at a stride of a
    window's length: the paper's own pair is of its own windows and says little of others.

    Returns:
        one for each value: ``factor``, ``value``, ``paper``, ``row`` (the place among `rows`), and
        by figure the differences from the paper's value as `analysis.metrics.paired.Difference`
        has them.
    """
    found = []
    for factor in FACTORS:
        line = [(k, row) for k, row in enumerate(rows) if _on_line(row, factor)]
        line.sort(key=lambda item: _order(item[1][factor]))
        start = next((row for _, row in line if _own(row, factor)), None)
        for place, row in line:
            found.append(
                {
                    "factor": factor,
                    "value": row[factor],
                    "paper": row is start,
                    "row": place,
                    "difference": None if start is None else _differences(row, start),
                }
            )
    return found


def _on_line(row: Row, factor: str) -> bool:
    """Whether all but one factor are where the line is."""
    fixed: dict[str, Callable[[], bool]] = {
        **{
            name: (lambda name=name: row[name] == getattr(PAPER, name))  # type: ignore[misc]
            for name in ("length_ms", "step_ms", "pool_px", "width")
        },
        "stride_ms": lambda: row["stride_ms"] == row["length_ms"],
        "precision": lambda: row["precision"] == "trained",
        "rule": lambda: row["rule"] == "chosen",
    }
    return all(holds() for name, holds in fixed.items() if name != factor)


def _own(row: Row, factor: str) -> bool:
    """Whether a row has the paper's value of a factor."""
    if factor == "stride_ms":
        return bool(row["stride_ms"] == row["length_ms"])
    own = {**PAPER.as_dict(), "precision": "trained", "rule": "paper's"}
    return bool(row[factor] == own[factor])


def _order(value: Any) -> float:
    """Numbers as they are, words as they are listed."""
    words = (*PRECISIONS, *RULES)
    return words.index(value) if isinstance(value, str) else value


def _differences(row: Row, start: Row) -> dict[str, Any]:
    """By figure, over the seeds that both have."""
    both = [seed for seed in row["seeds"] if seed in start["seeds"]]
    result = {}
    for name, (part, key) in FIGURES.items():
        ours, theirs = (
            [of[part][key][of["seeds"].index(seed)] for seed in both] for of in (row, start)
        )
        difference = paired_difference(ours, theirs)
        result[name] = {**asdict(difference), "told": difference.significant}
    return result
