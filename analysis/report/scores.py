"""The table of scores, `report/scores.parquet`: a row for each figure of a report and each trial.

Rows are made of the report's numbers, `summary.json`, whatever its kind: a number that is added
there is a row here. `figure` is the number's key (docs/summary.md) without the parts that are
columns: `networks.NAME.gravity.lead_ms.mean` is `lead_ms.mean` with an experiment and a detector.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, get_args

from sliplab.analysis.metrics.intervals import STATISTICS
from sliplab.analysis.report.outcomes import lost_ms
from sliplab.storage.schema.summary import GrossOutcome, Outcome
from sliplab.storage.streams import Json

if TYPE_CHECKING:
    import pandas as pd

FILE = "scores.parquet"
_NONE: Mapping[Any, Any] = MappingProxyType({})
Row = dict[str, Any]
"""A row, by column."""
COLUMNS = {
    "figure": "str",
    "campaign": "str",
    "experiment": "str",
    "split": "str",
    "condition": "str",
    "trial": "str",
    "detector": "str",
    "value": "float64",
    "low": "float64",
    "high": "float64",
    "n": "Int64",
    "unit": "str",
    "simulated": "bool",
}
"""Types of the columns. Text is empty where a row is not of one campaign, trial and so on; the
detector is empty for the store's own network. The interval, `low` to `high`, is 95 %; an end is
infinite where nothing bounds it. `n` counts what the value is over."""

EXPERIMENTS = ("kinematic", "gravity", "disturbance", "classes")
"""Keys that are an experiment; recordings of classes have figures as kinematic trials have."""
_SPLITS = ("train", "validation", "test")
_TESTED = {*EXPERIMENTS, "trials", "networks", "detectors", "holdout"}
"""Keys of a summary that are about test trials, unless a key inside names another split."""
_BY_NAME = {
    **dict.fromkeys(("networks", "baselines", "beside", "trained_baselines"), "detector"),
    **dict.fromkeys(
        ("choices", "data", "event_rates", "holds", "planned", "references"), "campaign"
    ),
}
"""Mappings of names to figures, and the column of the names."""
_LEVELS = ("seed", "tenth", "lead", "to", "stride_ms", "asked", "allowed", "ms")
"""Keys by which the rows of a list are told apart; they go into the condition."""
_OUTCOMES = {"outcome": get_args(Outcome), "gross": get_args(GrossOutcome)}
_TIMES = {"latency_incipient_ms": "latency_ms.incipient", "latency_gross_ms": "latency_ms.gross"}
"""Figures of times that have another name among the intervals."""
_ONSETS = ("incipient", "gross")
_MAIN = ("share", "value", "argmax", "percent_per_100_trials")
"""Keys of the number whose interval is `low` to `high`; the first two are not named in `figure`."""
_KNOWN = {
    *("n", "low", "high", "campaign", "experiment", "trial", "condition", "name", "intervals"),
    *(f"median_{kind}_ms" for kind in _ONSETS),
    *("detection", "left_out", "paper", "protocols", "seed", "timing_s", "versions"),
}
"""Keys that are columns, settings, or differ between equal runs."""
_ENDINGS = {"_ms": "ms", "_us": "µs", "_per_s": "1/s", "_s": "s", "_px": "px", "_trials": "%"}
_UNITS = {
    **dict.fromkeys(("accuracy", "each", "spread", "precision", "recall", "balance"), "share"),
    **dict.fromkeys(("strict", "argmax", "ece", "coverage", "false_early_rate"), "share"),
    **dict.fromkeys(("interval", "window_intervals", "by_factor", "by_tenth"), "share"),
    **dict.fromkeys(("no_slip", "reliability", "baselines", "network_ahead"), "share"),
    **dict.fromkeys(("by_length", "share", "rate", "rates", "outcome"), "share"),
    **dict.fromkeys(("connection_sparsity", "activation_sparsity"), "share"),
    **dict.fromkeys(("seconds", "seconds_collected"), "s"),
    **dict.fromkeys(("bytes", "bytes_collected", "footprint_bytes"), "B"),
    "event_rates": "1/s",
    "false_alarms": "1/h",
    "hours": "h",
    "levels": "",
}
"""Units by key, also of what is inside it; "" where that has none."""
_COUNTS = {
    *("missed", "late", "false_early", "detected_first", "trials", "windows", "right", "errors"),
    *("without_onsets", "alarms", "clusters", "choice"),
    *("lacking", "early_by_paper", "not_before", "unsure"),
}
"""Keys without a unit, wherever they are."""


def score_table(
    summary: Json,
    conditions: Mapping[tuple[str, str], Mapping[str, str]] = _NONE,
    units: Mapping[str, str] = _NONE,
    splits: Mapping[str, str] = _NONE,
) -> pd.DataFrame:
    """Return the table of a report's numbers, in their order.

    Args:
        summary: as in `summary.json`.
        conditions: levels by factor, by campaign and trial.
        units, splits: see `score_rows`.

    Returns:
        a frame with the `COLUMNS`.
    """
    import pandas as pd

    rows = list(score_rows(summary, units, splits))
    for row in rows:
        if levels := conditions.get((row["campaign"], row["trial"])):
            row["condition"] = _with({"condition": ""}, levels)["condition"]
    return pd.DataFrame(rows, columns=list(COLUMNS)).astype(COLUMNS)


def score_rows(
    summary: Json, units: Mapping[str, str] = _NONE, splits: Mapping[str, str] = _NONE
) -> Iterator[Row]:
    """Yield the rows of a report's numbers.

    Args:
        units: further ones, by a key of the figure's name; they also hold for what is inside.
        splits: parts of the split that further keys of the summary are about.
    """
    start: Row = {name: "" for name, kind in COLUMNS.items() if kind == "str"}
    start |= dict.fromkeys(("value", "low", "high"), math.nan)
    start |= {"n": None, "simulated": bool(summary["simulated"])}
    for key, value in summary.items():
        if key not in {*_KNOWN, "seeds"}:
            split = splits.get(key, "test" if key in _TESTED else "")
            for row in _entry({**start, "split": split}, key, value):
                own = (units[of] for of in reversed(row["figure"].split(".")) if of in units)
                yield {**row, "unit": next(own, row["unit"])}


def _entry(at: Row, key: str, value: Any) -> Iterator[Row]:
    """Yield the rows of what a key stands for.

    Args:
        at: the columns as they are known outside of it.
    """
    if isinstance(value, str) and at["trial"] and key in _OUTCOMES:
        for name in _OUTCOMES[key]:
            yield _row(_named(at, key), name, float(value == name)) | {"unit": "share"}
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield _row(at, key, value)
    elif value is None and (at["n"] is not None or at["trial"] or at["condition"]):
        yield _row(at, key, math.nan)
    elif isinstance(value, dict):
        if key == "by_factor":
            for factor, levels in value.items():
                for level, share in levels.items():
                    yield from _part(_with(_named(at, key), {factor: level}), share)
        elif key in _BY_NAME:
            inside = at if key == "networks" else _named(at, key)
            for name, of in value.items():
                yield from _entry({**inside, _BY_NAME[key]: name}, "", of)
        elif key in EXPERIMENTS:
            yield from _part({**at, "experiment": key}, value)
        else:
            yield from _part(_named(at, key), value)
    elif isinstance(value, list):
        yield from _list(at if key in ("trials", "detectors") else _named(at, key), value)


def _part(at: Row, part: Mapping[str, Any]) -> Iterator[Row]:
    """Yield the rows of a mapping's numbers, and of what is in it."""
    at = {**at, "n": part.get("n")}
    main = next((key for key in _MAIN if key in part), "") if "low" in part else ""
    spans = _spans(part)
    for key, value in part.items():
        if key in _KNOWN:
            continue
        if key == main:
            ends = {end: math.nan if part[end] is None else part[end] for end in ("low", "high")}
            yield _row({**at, **ends}, "" if key in _MAIN[:2] else key, value)
        elif value is None and (lost := lost_ms(part, key)) is not None:
            yield _row(at, key, lost)
        else:
            for row in _entry(at, key, value):
                yield row | spans.pop(row["figure"].removeprefix(f"{at['figure']}."), {})
    for figure, span in spans.items():
        yield _row(at, figure, None) | span


def _spans(part: Mapping[str, Any]) -> dict[str, Row]:
    """Return the intervals that a mapping has beside its figures, by figure."""
    pairs = {
        f"{_TIMES.get(time, time)}.{name}": of.get(name)
        for time, of in part.get("intervals", {}).items()
        for name in STATISTICS
    }
    pairs |= {
        f"latency_ms.{kind}.median": part[key]
        for kind in _ONSETS
        if (key := f"median_{kind}_ms") in part  # of decisions by an onset
    }
    return {
        figure: {
            "low": -math.inf if pair[0] is None else pair[0],
            "high": math.inf if pair[1] is None else pair[1],
        }
        for figure, pair in pairs.items()
        if pair is not None
    }


def _list(at: Row, items: list[Any]) -> Iterator[Row]:
    """Yield the rows of a list: of mappings by the keys that tell them apart, else by place."""
    for place, item in enumerate(items):
        if not isinstance(item, dict):
            inside = _with(at, {"column" if "row=" in at["condition"] else "row": place})
            yield from _list(inside, item) if isinstance(item, list) else _entry(inside, "", item)
            continue
        inside = at | {key: item[key] for key in ("campaign", "experiment", "trial") if key in item}
        inside = _with(inside, item.get("condition", {}))
        inside = _with(inside, {key: item[key] for key in _LEVELS if item.get(key) is not None})
        if "name" in item:
            of_class = at["figure"] == "by_class"
            inside = _with(inside, {"class": item["name"]} if of_class else {})
            inside["detector"] = "" if of_class else item["name"]
        yield from _part(inside, {key: of for key, of in item.items() if key not in _LEVELS})


def _row(at: Row, key: str, value: float | None) -> Row:
    at = _named(at, key)
    return {**at, "value": math.nan if value is None else float(value), "unit": _unit(at["figure"])}


def _named(at: Row, key: str) -> Row:
    """Add a key to a figure's name; one that names a part of the split goes into its column."""
    if key in _SPLITS:
        return {**at, "split": key}
    split = "validation" if key.startswith("validation_") else at["split"]
    return {**at, "split": split, "figure": ".".join(filter(None, (at["figure"], key)))}


def _with(at: Row, levels: Mapping[str, Any]) -> Row:
    """Add levels to a condition."""
    parts = [f"{name}={level}" for name, level in levels.items()]
    return {**at, "condition": ", ".join(filter(None, (at["condition"], *parts)))}


def _unit(figure: str) -> str:
    """Return the unit that the last key with one names; nothing of counts."""
    keys = figure.split(".")
    for key in () if keys[-1] in _COUNTS else reversed(keys):
        ending = next((end for end in _ENDINGS if key.endswith(end)), None)
        unit = _UNITS.get(key, _ENDINGS.get(ending or ""))
        if unit is not None:
            return unit
    return ""
