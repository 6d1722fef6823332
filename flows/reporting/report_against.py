"""`sliplab report --against OTHER`: what changed between two reports, and whether it is noise.

A figure that differs says nothing by itself: another seed, or other trials, would have changed it
as well. So each difference stands beside what chance alone would do. Where networks of several
seeds were trained that is the spread between them; else that between trials, one by one in
both reports where both judged the same. Both summaries hold all that is needed.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from sliplab.analysis.metrics.intervals import (
    STATISTICS,
    between_seeds,
    difference,
    share_difference,
)
from sliplab.protocols.errors import InputError
from sliplab.storage.files import read_json

Json = dict[str, Any]
Basis = Literal["seeds", "same trials", "trials", "intervals", "none"]

SUMMARY = ("report", "summary.json")
BASES: dict[Basis, str] = {
    "seeds": "spread between seeds",
    "same trials": "the same trials, one by one",
    "trials": "trials, each report's own",
    "intervals": "both intervals over trials",
    "none": "no noise known",
}
_TIMES = {
    "latency_incipient_ms": "incipient latency",
    "latency_gross_ms": "gross latency",
    "lead_ms": "lead",
}
_STATISTIC_WORDS = {"mean": "mean", "median": "median", "p95": "95th percentile"}
_SHARES = {
    "detected_first": ("outcome", "detected before gross slip"),
    "false_early": ("outcome", "incipient false early"),
    "missed": ("outcome", "incipient missed"),
    "late": ("outcome", "incipient late"),
    "gross_false_early": ("gross", "gross false early"),
    "gross_missed": ("gross", "gross missed"),
    "gross_late": ("gross", "gross late"),
}


@dataclass(frozen=True)
class Change:
    """One figure of both reports.

    Attributes:
        unit: ``ms``, ``share`` or another; shares are 0..1.
        here, there: its values; ``difference`` is here less there.
        low, high: what the difference may be by chance around what was found, 95 %.
        basis: where that comes from.
        beyond: whether it is more than noise; None where that is not known.
    """

    name: str
    unit: str
    here: float
    there: float
    difference: float
    low: float | None
    high: float | None
    basis: Basis
    beyond: bool | None


def load_other(place: Path) -> Json:
    """The summary of another report.

    Args:
        place: a store that has one, or a ``summary.json``.

    Raises:
        InputError: there is none, or it is none of this version.
    """
    path = place.joinpath(*SUMMARY) if place.is_dir() else place
    right = "must be a store with a report, or its report/summary.json"
    try:
        found = read_json(path)
    except (OSError, ValueError) as error:
        raise InputError("--against", "", str(place), f"{right} ({error})") from None
    if not {"simulated", "trials", "kinematic", "gravity", "protocols"} <= found.keys():
        why = "lacks what is compared; run `sliplab report` on it with this version"
        raise InputError("--against", "", str(place), why)
    return found


def compare(here: Json, there: Json) -> Json:
    """Both summaries side by side.

    Returns:
        ``figures`` (see `Change`), ``settings``: what differs of settings, hashes, seeds and
        versions, as ``what``, ``here``, ``there``; ``simulated`` of each.
    """
    changes = [*_windows(here, there)]
    for experiment in ("kinematic", "gravity", "disturbance"):
        changes += _of_trials(here, there, experiment)
    changes += _plain(here, there)
    return {
        "figures": [asdict(change) for change in changes],
        "settings": settings(here, there),
        "simulated": {"here": here["simulated"], "there": there["simulated"]},
    }


def settings(here: Json, there: Json) -> list[Json]:
    """What made the two reports, as far as it differs."""
    rows = []
    for part in ("simulated", "protocols", "detection", "seeds", "versions"):
        ours, theirs = _flat(here.get(part), part), _flat(there.get(part), part)
        for name in dict.fromkeys([*ours, *theirs]):
            if ours.get(name) != theirs.get(name):
                row = {"what": name, "here": ours.get(name), "there": theirs.get(name)}
                rows.append(row)
    return rows


def _flat(value: Any, name: str) -> dict[str, Any]:
    if isinstance(value, dict):
        parts = [_flat(inner, f"{name}.{key}") for key, inner in value.items()]
        return {key: found for part in parts for key, found in part.items()}
    return {name: value}


def _windows(here: Json, there: Json) -> list[Change]:
    """Figures of windows: by seeds where one report has several, else by intervals over trials."""
    found = []
    ours, theirs = here["kinematic"], there["kinematic"]
    for kind in ("strict", "argmax", "margin"):
        a, b = ([row[kind] for row in part["seeds"]["each"]] for part in (ours, theirs))
        if any(value is None for value in [*a, *b]) or not a or not b:
            continue
        noise = between_seeds(a, b)
        if noise is not None:
            name = f"accuracy, {kind}, mean of seeds"
            found.append(_around(name, float(np.mean(a)), float(np.mean(b)), noise, "seeds"))
    by_seeds = bool(found)
    paired = _strict(ours, theirs) if _same_collection(here, there, "kinematic") else None
    if paired is not None:
        found.append(paired)
    spans = [_spans(part) for part in (ours, theirs)]
    names = {
        "strict": "accuracy, strict",
        "accuracy": "accuracy, argmax",
        "incipient_precision": "incipient precision",
        "incipient_recall": "incipient recall",
    }
    for key, name in names.items():
        if key == "strict" and paired is not None:
            continue
        rows = [part[key] for part in spans if key in part]
        if len(rows) == len(spans):
            noise = math.hypot(*((row["high"] - row["low"]) / 2 for row in rows))
            mine, other = (float(row["share"]) for row in rows)
            title = f"{name}, the chosen network" if by_seeds else name
            found.append(_around(title, mine, other, noise, "intervals"))
    return found


def _strict(ours: Json, theirs: Json) -> Change | None:
    """Strict accuracy on the windows of the same trials; None where these are others."""
    parts = [
        {(row["campaign"], row["trial"]): row for row in part["by_trial"]}
        for part in (ours, theirs)
    ]
    order = sorted(parts[0])
    if order != sorted(parts[1]) or not order:
        return None
    windows = [[float(part[key]["n"]) for key in order] for part in parts]
    hits = [[float(part[key]["n"] - part[key]["errors"]) for key in order] for part in parts]
    span = share_difference((hits[0], windows[0]), (hits[1], windows[1]))
    if span is None:
        return None
    a, b = (sum(hit) / sum(all_of) for hit, all_of in zip(hits, windows, strict=True))
    beyond = not span[0] <= 0 <= span[1]
    name = "accuracy, strict, the chosen network"
    return Change(name, "share", a, b, a - b, *span, "same trials", beyond)


def _spans(kinematic: Json) -> dict[str, Json]:
    """Shares of windows that have an interval."""
    rows = {"strict": kinematic["interval"], **kinematic.get("window_intervals", {})}
    return {name: row for name, row in rows.items() if row["low"] is not None}


def _around(name: str, a: float, b: float, noise: float, basis: Basis) -> Change:
    gap = a - b
    return Change(name, "share", a, b, gap, gap - noise, gap + noise, basis, abs(gap) > noise)


def _of_trials(here: Json, there: Json, experiment: str) -> list[Change]:
    """Latencies, leads and shares of an experiment, by its trials."""
    ours, theirs = (_trials(part, experiment) for part in (here, there))
    if not ours or not theirs:
        return []
    same = ours.keys() == theirs.keys() and _same_collection(here, there, experiment)
    order = list(ours) if same else None
    found = []
    for key, title in _TIMES.items():
        a, b = (_column(part, order, key) for part in (ours, theirs))
        for statistic, word in _STATISTIC_WORDS.items():
            name = f"{experiment}: {title}, {word}"
            found += _drawn(name, "ms", a, b, statistic, same)
    for key, (entry, title) in _SHARES.items():
        value = key.removeprefix("gross_")
        a, b = (
            np.array([float(part[k][entry] == value) for k in (order or part)])
            for part in (ours, theirs)
        )
        if a.any() or b.any():
            found += _drawn(f"{experiment}: {title}", "share", a, b, "mean", same)
    return found


def _trials(summary: Json, experiment: str) -> dict[tuple[str, str], Json]:
    return {
        (row["campaign"], row["trial"]): row
        for row in summary["trials"]
        if row["experiment"] == experiment
    }


def _same_collection(here: Json, there: Json, experiment: str) -> bool:
    """Whether the trials were not only called the same, but collected by the same protocol."""
    names = {row["campaign"] for row in here["trials"] if row["experiment"] == experiment}
    hashes = [
        [part["protocols"].get(name, {}).get("collection") for name in sorted(names)]
        for part in (here, there)
    ]
    return hashes[0] == hashes[1]


def _column(
    rows: dict[tuple[str, str], Json], order: list[tuple[str, str]] | None, key: str
) -> np.ndarray[Any, np.dtype[np.float64]]:
    values = [rows[name][key] for name in (order or rows)]
    return np.array([math.nan if value is None else value for value in values], np.float64)


def _drawn(name: str, unit: str, a: Any, b: Any, statistic: str, same: bool) -> list[Change]:
    """A figure of trials; nothing where a report has no value of it."""
    if not np.isfinite(a).any() or not np.isfinite(b).any():
        return []
    measure = STATISTICS[statistic]
    ours, theirs = float(measure(a, axis=0)), float(measure(b, axis=0))
    span = difference(a, b, statistic, paired=same)
    if span is None:
        return [Change(name, unit, ours, theirs, ours - theirs, None, None, "none", None)]
    beyond = not span[0] <= 0 <= span[1]
    basis: Basis = "same trials" if same else "trials"
    return [Change(name, unit, ours, theirs, ours - theirs, *span, basis, beyond)]


def _plain(here: Json, there: Json) -> list[Change]:
    """Figures of which no noise is known."""
    rows = (
        ("gravity: lead, smallest", "ms", ("gravity", "lead_ms", "min")),
        ("disturbance: lead, smallest", "ms", ("disturbance", "lead_ms", "min")),
        ("labels: incipient, median distance from the truth", "ms",
         ("labels", "error_ms", "incipient", "median_abs")),
        ("labels: gross, median distance from the truth", "ms",
         ("labels", "error_ms", "gross", "median_abs")),
        ("clocks: worst uncertainty", "µs", ("sync", "worst_uncertainty_us")),
        ("synaptic operations a window", "", ("kinematic", "work", "synaptic_operations", "all")),
        ("trials committed", "", ("quality", "committed")),
        ("attempts taken again", "", ("quality", "retaken")),
    )  # fmt: skip
    found = []
    for name, unit, path in rows:
        a, b = (_at(part, path) for part in (here, there))
        if a is not None and b is not None:
            beyond = None if a != b else False
            found.append(Change(name, unit, a, b, a - b, None, None, "none", beyond))
    return found


def _at(summary: Any, path: tuple[str, ...]) -> float | None:
    for key in path:
        summary = summary.get(key) if isinstance(summary, dict) else None
    return None if summary is None else float(summary)
