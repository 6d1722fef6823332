"""Comparison of two reports: differences, their significance, and the page.

A difference alone says nothing: another seed, or other trials, would have changed the figure
as well. So each difference is compared with its expected random variation: the spread between seeds
if several were trained, otherwise that between trials, paired if both reports evaluated the same
trials. Both summaries contain all inputs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from sliplab.analysis.metrics.intervals import (
    STATISTICS,
    between_seeds,
    difference,
    share_difference,
)
from sliplab.analysis.report.figures.intervals import differences
from sliplab.analysis.report.outcomes import is_lost, lost_ms
from sliplab.analysis.report.page import Figure, Number, Table, render_page
from sliplab.protocols.errors import InputError
from sliplab.storage.schema.document import DocumentError, NewerFormat
from sliplab.storage.schema.evaluation import SeedTimes, Share
from sliplab.storage.schema.summary import Experiment, Kinematic, Summary, TrialOutcome
from sliplab.storage.streams import Json

Basis = Literal["seeds", "same trials", "trials", "intervals", "none"]

PAGE = "against.html"
SUMMARY = ("report", "summary.json")
BASES: dict[Basis, str] = {
    "seeds": "spread between seeds",
    "same trials": "the same trials, one by one",
    "trials": "trials, each report's own",
    "intervals": "both intervals over trials",
    "none": "no noise known",
}
COLUMNS = (
    "figure",
    "here",
    "there",
    "difference",
    "95 % by chance",
    "more than noise?",
    "judged by",
)
TERMINAL = ("figure", "here", "there", "difference", "more than noise?")
_TIMES = {
    "latency_incipient_ms": "incipient latency",
    "latency_gross_ms": "gross latency",
    "lead_ms": "lead",
}
_STATISTICS = {"mean": "mean", "median": "median", "p95": "95th percentile"}
_SHARES = (
    ("outcome", "detected_first", "detected before gross slip"),
    ("outcome", "false_early", "incipient false early"),
    ("outcome", "missed", "incipient missed"),
    ("outcome", "late", "incipient late"),
    ("gross", "false_early", "gross false early"),
    ("gross", "missed", "gross missed"),
    ("gross", "late", "gross late"),
)


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

    @staticmethod
    def of(
        name: str,
        unit: str,
        here: float,
        there: float,
        span: tuple[float, float] | None,
        basis: Basis,
    ) -> Change:
        """Compare a difference with its interval; without one, its noise is unknown."""
        gap = here - there
        if span is None:
            return Change(name, unit, here, there, gap, None, None, "none", None)
        beyond = not span[0] <= 0 <= span[1]
        return Change(name, unit, here, there, gap, *span, basis, beyond)


@dataclass(frozen=True)
class ReportDifference:
    """One setting, hash, seed or version in which two reports differ."""

    what: str
    here: Any
    there: Any


@dataclass(frozen=True)
class ReportComparison:
    """Compare two reports.

    Attributes:
        simulated: here, and there.
    """

    figures: Sequence[Change]
    settings: Sequence[ReportDifference]
    simulated: tuple[bool, bool]

    def to_json(self) -> Json:
        """Return it as plain data."""
        return {
            "figures": [asdict(change) for change in self.figures],
            "settings": [asdict(row) for row in self.settings],
            "simulated": dict(zip(("here", "there"), self.simulated, strict=True)),
        }


_OTHERS = {
    "one_camera": "is a report on a rig with one camera, without a spiking network to compare",
    "classes": "is a report on recordings of classes; only reports on slip are compared",
}
"""Summaries that are not compared, each by a key that only it has."""


def load_other(place: Path) -> Summary:
    """Read the summary of another report.

    Args:
        place: a store that has one, or a ``summary.json``.

    Raises:
        InputError: it does not exist, or has another version.
    """
    path = place.joinpath(*SUMMARY) if place.is_dir() else place
    try:
        return Summary.load(path)
    except OSError as error:
        why = f"must be a store with a report, or its report/summary.json ({error})"
    except DocumentError as error:
        why = f"lacks what is compared ({error}); run `sliplab report` on it with this version"
        why = not_compared(path) or why
    except NewerFormat as error:
        why = str(error)
    raise InputError("--against", "", str(place), why) from None


def not_compared(path: Path) -> str | None:
    """Return why the summary in a file is not compared with others; None where it is."""
    text = path.read_text(encoding="utf-8", errors="replace")
    return next((why for key, why in _OTHERS.items() if f'"{key}":' in text), None)


def compare(here: Summary, there: Summary) -> ReportComparison:
    """Compare both reports figure by figure."""
    changes = _windows(here, there)
    for experiment in ("kinematic", "gravity", "disturbance"):
        changes += _of_trials(here, there, experiment)
    changes += _plain(here, there)
    return ReportComparison(changes, _settings(here, there), (here.simulated, there.simulated))


def _settings(here: Summary, there: Summary) -> list[ReportDifference]:
    rows = []
    parts = [here.to_json(), there.to_json()]
    for name in ("simulated", "protocols", "detection", "seeds", "versions"):
        ours, theirs = (_flat(part.get(name), name) for part in parts)
        rows += [
            ReportDifference(what, ours.get(what), theirs.get(what))
            for what in dict.fromkeys([*ours, *theirs])
            if ours.get(what) != theirs.get(what)
        ]
    return rows


def _flat(value: object, name: str) -> dict[str, object]:
    """Return the leaves of mappings in each other by dotted names."""
    if not isinstance(value, dict):
        return {name: value}
    parts = [_flat(inner, f"{name}.{key}") for key, inner in sorted(value.items())]
    return {key: found for part in parts for key, found in part.items()}


def _windows(here: Summary, there: Summary) -> list[Change]:
    """Compare windows: by seeds where one report has several, else by intervals over trials."""
    found = []
    ours, theirs = here.kinematic, there.kinematic
    for kind in ("strict", "argmax", "margin"):
        a, b = ([getattr(row, kind) for row in part.seeds.each] for part in (ours, theirs))
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
    spans: list[dict[str, Share]] = [
        {"strict": part.interval, **part.window_intervals} for part in (ours, theirs)
    ]
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
        known = [
            (row.share, row.low, row.high)
            for row in rows
            if row.share is not None and row.low is not None and row.high is not None
        ]
        if len(known) == len(spans):
            noise = math.hypot(*((high - low) / 2 for _, low, high in known))
            mine, other = (float(share) for share, _, _ in known)
            title = f"{name}, the chosen network" if by_seeds else name
            found.append(_around(title, mine, other, noise, "intervals"))
    return found


def _strict(ours: Kinematic, theirs: Kinematic) -> Change | None:
    """Compare strict accuracy on the windows of the same trials; None where these are others."""
    parts = [{(row.campaign, row.trial): row for row in part.by_trial} for part in (ours, theirs)]
    order = sorted(parts[0])
    if order != sorted(parts[1]) or not order:
        return None
    windows = [[float(part[key].n) for key in order] for part in parts]
    hits = [[float(part[key].n - part[key].errors) for key in order] for part in parts]
    span = share_difference((hits[0], windows[0]), (hits[1], windows[1]))
    if span is None:
        return None
    a, b = (sum(hit) / sum(all_of) for hit, all_of in zip(hits, windows, strict=True))
    return Change.of("accuracy, strict, the chosen network", "share", a, b, span, "same trials")


def _around(
    name: str, a: float, b: float, noise: float, basis: Basis, unit: str = "share"
) -> Change:
    return Change.of(name, unit, a, b, (a - b - noise, a - b + noise), basis)


def _of_trials(here: Summary, there: Summary, experiment: str) -> list[Change]:
    """Compare latencies, leads and shares of an experiment, by its trials."""
    ours, theirs = (
        {(row.campaign, row.trial): row for row in part.trials if row.experiment == experiment}
        for part in (here, there)
    )
    if not ours or not theirs:
        return []
    same = ours.keys() == theirs.keys() and _same_collection(here, there, experiment)
    rows = [list(ours.values()), [theirs[key] for key in ours] if same else list(theirs.values())]
    found = _of_seeds(getattr(here, experiment), getattr(there, experiment), experiment)
    who = ", the chosen network" if found else ""
    for key, title in _TIMES.items():

        def time(row: TrialOutcome, key: str = key) -> float:
            value = getattr(row, key)
            return math.nan if value is None else float(value)

        def with_lost(row: TrialOutcome, key: str = key) -> float:
            return lost_ms(key) if is_lost(row, key) else time(row, key)

        for statistic, word in _STATISTICS.items():
            name = f"{experiment}: {title}, {word}{who}"
            value = with_lost if statistic == "median" else time
            found += _measured(name, "ms", rows, value, statistic, same)
    for entry, outcome, title in _SHARES:

        def hit(row: TrialOutcome, entry: str = entry, outcome: str = outcome) -> float:
            return float(getattr(row, entry) == outcome)

        if any(hit(row) for of in rows for row in of):
            found += _measured(f"{experiment}: {title}{who}", "share", rows, hit, "mean", same)
    return found


def _of_seeds(ours: Experiment, theirs: Experiment, experiment: str) -> list[Change]:
    """Compare median times of all trained networks; nothing where both reports have one."""
    found = []
    for key, title in _TIMES.items():
        a, b = ([_median(it, key) for it in part.by_seed or (part,)] for part in (ours, theirs))
        mine, other = ([value for value in each if value is not None] for each in (a, b))
        if len(mine) < len(a) or len(other) < len(b):
            continue
        noise = between_seeds(mine, other)
        if noise is not None:
            name = f"{experiment}: {title}, median, mean of seeds"
            means = float(np.mean(mine)), float(np.mean(other))
            found.append(_around(name, *means, noise, "seeds", "ms"))
    return found


def _median(times: SeedTimes | Experiment, key: str) -> float | None:
    """Return the median of a time of `_TIMES`."""
    of = {
        "latency_incipient_ms": times.latency_ms.incipient,
        "latency_gross_ms": times.latency_ms.gross,
        "lead_ms": times.lead_ms,
    }
    return of[key].median


def _same_collection(here: Summary, there: Summary, experiment: str) -> bool:
    """Check that trials were not only called the same, but collected by the same protocol."""
    names = sorted({row.campaign for row in here.trials if row.experiment == experiment})
    hashes = [
        [of.collection if (of := part.protocols.get(name)) else None for name in names]
        for part in (here, there)
    ]
    return hashes[0] == hashes[1]


def _measured(
    name: str,
    unit: str,
    rows: Sequence[Sequence[TrialOutcome]],
    value: Callable[[TrialOutcome], float],
    statistic: str,
    same: bool,
) -> list[Change]:
    """Compare a figure of trials; nothing where a report has no value of it."""
    a, b = (np.array([value(row) for row in of], np.float64) for of in rows)
    if not np.isfinite(a).any() or not np.isfinite(b).any():
        return []
    measure: Callable[..., npt.NDArray[np.float64]] = STATISTICS[statistic]
    ours, theirs = float(measure(a, axis=0)), float(measure(b, axis=0))
    if not math.isfinite(ours) or not math.isfinite(theirs):
        return []
    span = difference(a, b, statistic, paired=same)
    return [Change.of(name, unit, ours, theirs, span, "same trials" if same else "trials")]


def _plain(here: Summary, there: Summary) -> list[Change]:
    """Compare figures of which no noise is known."""

    def rows(of: Summary) -> Iterable[tuple[str, str, float | None]]:
        errors, work = of.labels.error_ms, of.kinematic.work
        operations = None if work is None else work.synaptic_operations.get("all")
        truth = "median distance from the truth"
        yield "gravity: lead, smallest", "ms", of.gravity.lead_ms.min
        yield "disturbance: lead, smallest", "ms", of.disturbance.lead_ms.min
        yield f"labels: incipient, {truth}", "ms", errors.incipient.median_abs
        yield f"labels: gross, {truth}", "ms", errors.gross.median_abs
        yield "clocks: worst uncertainty", "µs", of.sync.worst_uncertainty_us
        yield "synaptic operations a window", "", operations
        yield "trials committed", "", of.quality.committed
        yield "attempts taken again", "", of.quality.retaken

    found = []
    for (name, unit, a), (_, _, b) in zip(rows(here), rows(there), strict=True):
        if a is not None and b is not None:
            change = Change.of(name, unit, float(a), float(b), None, "none")
            found.append(replace(change, beyond=None if a != b else False))
    return found


def render(compared: ReportComparison, here: Path, there: Path) -> str:
    """Render the page; everything in it is escaped but the figures' SVG."""
    simulated, other = compared.simulated
    figures = []
    panels = (("ms", "Times", 1.0, "ms"), ("share", "Shares", 100.0, "points"))
    for unit, title, factor, axis in panels:
        rows = [
            (row.name, factor * row.difference, factor * row.low, factor * row.high)
            for row in compared.figures
            if row.unit == unit and row.low is not None and row.high is not None
        ]
        if rows:
            label = f"difference, here less there ({axis})"
            svg = differences(rows, label, simulated=simulated or other)
            figures.append((title, Figure(svg)))
    made = [[row.what, _short(row.here), _short(row.there)] for row in compared.settings]
    one = "The one here is" if simulated else "The one there is"
    return render_page(
        "against.html",
        simulated=simulated or other,
        which="Both reports are" if simulated == other else one,
        here=str(here.resolve()),
        there=str(there.resolve()),
        headline=_headline(compared),
        figures=figures,
        changes=Table(COLUMNS, table(compared.figures)),
        settings=Table(("what", "here", "there"), made),
    )


def short_table(figures: Sequence[Change]) -> tuple[list[str], list[list[str]]]:
    """Return columns and rows that fit a terminal."""
    retained = [COLUMNS.index(name) for name in TERMINAL]
    return [COLUMNS[k] for k in retained], [[row[k] for k in retained] for row in table(figures)]


def table(figures: Sequence[Change]) -> list[list[str]]:
    """Return rows of text under `COLUMNS`."""
    verdicts = {None: "not known", True: "yes", False: "no"}
    return [
        [
            row.name,
            _value(row.here, row.unit),
            _value(row.there, row.unit),
            _gap(row.difference, row.unit),
            "–"
            if row.low is None or row.high is None
            else f"{_gap(row.low, row.unit)} to {_gap(row.high, row.unit)}",
            verdicts[row.beyond],
            BASES[row.basis],
        ]
        for row in figures
    ]


def _headline(compared: ReportComparison) -> list[Number]:
    judged = [row for row in compared.figures if row.basis != "none"]
    beyond = sum(bool(row.beyond) for row in judged)
    by_chance = f"{len(judged) / 20:.0f} of {len(judged)} by chance"
    return [
        Number("figures", str(len(compared.figures)), f"{len(judged)} with noise that is known"),
        Number("more than noise", str(beyond), by_chance),
        Number("settings", str(len(compared.settings)), "differ"),
    ]


def _short(value: object) -> str:
    text = "–" if value is None else str(value)
    return text if len(text) <= 24 else f"{text[:16]}…"


def _value(value: float, unit: str) -> str:
    if unit == "share":
        return f"{100 * value:.1f} %"
    return f"{value:,.0f}" if not unit else f"{value:.1f} {unit}"


def _gap(value: float, unit: str) -> str:
    if unit == "share":
        return f"{100 * value:+.1f}"
    return f"{value:+,.0f}" if not unit else f"{value:+.1f}"
