"""Comparison of two reports: the difference of their tables of scores, and the page.

A difference alone says nothing: another seed, or other trials, would have changed the figure
as well. So each difference is compared with its expected random variation: that between trials,
paired if both reports evaluated the same ones, and of means over seeds that between seeds, with
that between trials if those differ. Both tables contain all inputs.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from sliplab.analysis.metrics.intervals import (
    STATISTICS,
    Span,
    between_seeds,
    count_difference,
    difference,
    share_difference,
)
from sliplab.analysis.report.figures.intervals import differences
from sliplab.analysis.report.page import Figure, Number, Table, render_page
from sliplab.analysis.report.scores import Row, score_rows
from sliplab.protocols.errors import InputError
from sliplab.protocols.plugin import plugins
from sliplab.protocols.plugins import import_foreign
from sliplab.storage.schema.document import Document, DocumentError, NewerFormat
from sliplab.storage.schema.summary import OneCameraSummary, Summary
from sliplab.storage.streams import Json
from sliplab.storage.trials.store import refuse_url

Basis = Literal["seeds", "seeds and trials", "same trials", "trials", "intervals", "none"]

PAGE = "against.html"
SUMMARY = ("report", "summary.json")
BASES: dict[Basis, str] = {
    "seeds": "spread between seeds, on these trials",
    "seeds and trials": "spread between seeds and between trials",
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
    "latency_incipient_ms": ("latency_ms.incipient.median", "incipient latency"),
    "latency_gross_ms": ("latency_ms.gross.median", "gross latency"),
    "lead_ms": ("lead_ms.median", "lead"),
}
_WORDS = {"mean": "mean", "median": "median", "p95": "95th percentile"}
_WINDOWS = (
    ("seeds.each.strict", "accuracy, strict", "seeds"),
    ("seeds.each.argmax", "accuracy, argmax", "seeds"),
    ("seeds.each.margin", "accuracy, margin", "seeds"),
    ("by_trial.strict", "accuracy, strict", "windows"),
    ("interval", "accuracy, strict", "intervals"),
    ("window_intervals.accuracy", "accuracy, argmax", "intervals"),
    ("window_intervals.incipient_precision", "incipient precision", "intervals"),
    ("window_intervals.incipient_recall", "incipient recall", "intervals"),
    ("trials.strict", "accuracy on recordings, strict", "intervals"),
    ("trials.argmax", "accuracy on recordings, argmax", "intervals"),
    ("work.synaptic_operations.all", "synaptic operations a window", "none"),
)
_TRIALS = (
    *((f"by_seed.{median}", f"{title}, median", "seeds") for median, title in _TIMES.values()),
    *(
        (figure, f"{title}, {word}", statistic)
        for figure, (_, title) in _TIMES.items()
        for statistic, word in _WORDS.items()
    ),
    ("lead_ms.min", "lead, smallest", "none"),
    ("outcome.detected_first", "detected before gross slip", "counts"),
    *(
        (f"{key}.{name}", f"{onset} {name.replace('_', ' ')}", "counts")
        for key, onset in (("outcome", "incipient"), ("gross", "gross"))
        for name in ("false_early", "missed", "late")
    ),
)
_TRUTH = "median distance from the truth"
_OTHERS = (
    ("labels.error_ms.incipient.median_abs", f"labels: incipient, {_TRUTH}", "none"),
    ("labels.error_ms.gross.median_abs", f"labels: gross, {_TRUTH}", "none"),
    ("sync.worst_uncertainty_us", "clocks: worst uncertainty", "none"),
    ("quality.committed", "trials committed", "none"),
    ("quality.retaken", "attempts taken again", "none"),
)
FIGURES = (
    ("kinematic", "", _WINDOWS),
    ("classes", "", _WINDOWS),
    *((name, f"{name}: ", _TRIALS) for name in ("kinematic", "gravity", "disturbance")),
    ("", "", _OTHERS),
)
"""Figures that are compared, by experiment, with what their titles begin with. Of each: its name in
the table of scores, its title, and the statistic over its rows, or the source of its noise. Of two
with the same title the first one that both reports have is compared."""
_OF_CHOSEN = {"seeds.each.strict": "interval", "seeds.each.argmax": "window_intervals.accuracy"}
"""Figures of seeds, and the chosen network's with its interval over trials."""
_SETTINGS = ("simulated", "protocols", "detection", "seeds", "versions")


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


def load_report(place: Path, option: str = "--against") -> Document:
    """Read the summary of a report of any kind.

    Args:
        place: a store that has one, or a ``summary.json``.
        option: that named it.

    Raises:
        InputError: it does not exist, is damaged, or has another version.
    """
    refuse_url(place)
    path = place.joinpath(*SUMMARY) if place.is_dir() else place
    right = "must be a store with a report, or its report/summary.json"
    why = ""
    others = plugins().declared("documents").items()
    found = [import_foreign(each) for name, (each, _) in others if name.endswith("-summary")]
    for kind in (Summary, OneCameraSummary, *found):
        try:
            return kind.load(path)
        except OSError as error:
            why = f"{right} ({error})"
        except DocumentError as error:
            again = "run `sliplab report` on it with this version"
            why = why or f"{right}; lacks what is compared ({error}): {again}"
        except NewerFormat as error:
            why = str(error)
    raise InputError(option, "", str(place), why)


def compare(here: Document, there: Document) -> ReportComparison:
    """Compare the figures that both reports have."""
    both = here.to_json(), there.to_json()
    tables = [_by_figure(summary) for summary in both]
    found: dict[str, Change] = {}
    for experiment, beginning, figures in FIGURES:
        who = ""
        for figure, words, how in figures:
            ours, theirs = (table.get((experiment, figure), ()) for table in tables)
            name = beginning + words + (", mean of seeds" if how == "seeds" else who)
            if not ours or not theirs or name in found:
                continue
            if how == "seeds":
                mine, others = (_trial_rows(table, experiment) for table in tables)
                one = _OF_CHOSEN.get(figure, figure.removeprefix("by_seed."))
                x, y = (table.get((experiment, one), ()) for table in tables)
                over = None if _same_trials(mine, others, *both) else (x, y)
                change = _of_seeds(name, ours, theirs, over)
            elif how in BASES:
                change = _of_figures(name, ours, theirs, how)
            else:
                change = _of_trials(name, ours, theirs, how, _same_trials(ours, theirs, *both))
            if change is not None:
                found[name] = change
                who = ", the chosen network" if how == "seeds" else who
    simulated = bool(both[0]["simulated"]), bool(both[1]["simulated"])
    return ReportComparison(list(found.values()), _settings(*both), simulated)


Rows = Sequence[Row]


def _by_figure(summary: Json) -> Mapping[tuple[str, str], Rows]:
    """Return the rows of the report's own network by experiment and figure.

    A report of one seed has that seed's figures under the names of those of several.
    """
    found: dict[tuple[str, str], list[Row]] = defaultdict(list)
    for row in score_rows(summary):
        if not row["detector"]:
            found[row["experiment"], row["figure"]].append(row)
    for experiment, figure in list(found):
        found.setdefault((experiment, f"by_seed.{figure}"), found[experiment, figure])
    return found


def _trial_rows(table: Mapping[tuple[str, str], Rows], experiment: str) -> Rows:
    """Return the rows of an experiment's trials."""
    return [
        row for (of, _), rows in table.items() if of == experiment for row in rows if row["trial"]
    ]


def _same_trials(ours: Rows, theirs: Rows, here: Json, there: Json) -> bool:
    """Check that trials were not only called the same, but collected by the same protocol."""
    names = [{(row["campaign"], row["trial"]) for row in rows} for rows in (ours, theirs)]
    hashes = [
        {name: part["protocols"].get(name, {}).get("collection") for name, _ in names[0]}
        for part in (here, there)
    ]
    return bool(names[0]) and names[0] == names[1] and hashes[0] == hashes[1]


def _of_trials(name: str, ours: Rows, theirs: Rows, statistic: str, same: bool) -> Change | None:
    """Compare a statistic over trials; of windows only over the same trials."""
    basis: Basis = "same trials" if same else "trials"
    if same:
        there = {(row["campaign"], row["trial"]): row for row in theirs}
        theirs = [there[row["campaign"], row["trial"]] for row in ours]
    a, b = _values(ours), _values(theirs)
    if statistic == "windows":
        n, m = (np.array([row["n"] for row in rows], np.float64) for rows in (ours, theirs))
        span = share_difference((a * n, n), (b * m, m)) if same else None
        if span is None:
            return None
        return _changed(name, ours, (a @ n / n.sum(), b @ m / m.sum()), span, basis)
    if counted := statistic == "counts":
        statistic = "mean"
    if statistic != "median":  # a lost detection has a rank, but no size
        a, b = (np.where(np.isinf(values), np.nan, values) for values in (a, b))
    if not np.isfinite(a).any() or not np.isfinite(b).any():
        return None
    both = [float(STATISTICS[statistic](values, axis=0)) for values in (a, b)]
    if not np.isfinite(both).all() or (ours[0]["unit"] == "share" and not any(both)):
        return None
    if counted:
        span = count_difference(a, b, paired=same)
    else:
        span = difference(a, b, statistic, paired=same)
    return _changed(name, ours, both, span, basis)


def _of_seeds(name: str, ours: Rows, theirs: Rows, over: tuple[Rows, Rows] | None) -> Change | None:
    """Compare means over seeds.

    Args:
        over: of different trials, the figure of one network with its interval over them.
    """
    a, b = _values(ours), _values(theirs)
    if not np.isfinite([*a, *b]).all() or max(len(a), len(b)) < 2:
        return None
    both, noise = (float(a.mean()), float(b.mean())), between_seeds(a, b)
    if noise is None:
        return _changed(name, ours, both, None, "none")
    below, above = (noise, noise) if over is None else _reach(over[0], over[1], noise)
    return _around(name, ours, both, below, above, "seeds" if over is None else "seeds and trials")


def _of_figures(name: str, ours: Rows, theirs: Rows, how: str) -> Change | None:
    """Compare figures over all trials."""
    a, b = _values(ours), _values(theirs)
    if not np.isfinite([*a, *b]).all():
        return None
    both = float(a.mean()), float(b.mean())
    if how == "none":
        return _changed(name, ours, both, None, "none")
    return _around(name, ours, both, *_reach(ours, theirs), "intervals")


def _reach(ours: Rows, theirs: Rows, *further: float) -> tuple[float, float]:
    """Return how far a difference reaches below and above itself, by both figures' intervals.

    The distances to their ends are added in squares (Zou and Donner 2008), with `further` ones.
    """
    if not ours or not theirs:
        return math.nan, math.nan
    here, there = ours[0], theirs[0]
    below = here["value"] - here["low"], there["high"] - there["value"]
    above = here["high"] - here["value"], there["value"] - there["low"]
    return math.hypot(*below, *further), math.hypot(*above, *further)


def _around(
    name: str, rows: Rows, both: Sequence[float], below: float, above: float, basis: Basis
) -> Change:
    gap = both[0] - both[1]
    known = math.isfinite(below) and math.isfinite(above)
    return _changed(name, rows, both, (gap - below, gap + above) if known else None, basis)


def _values(rows: Rows) -> npt.NDArray[np.float64]:
    return np.array([row["value"] for row in rows], np.float64)


def _changed(
    name: str, rows: Rows, both: Sequence[float], span: Span | None, basis: Basis
) -> Change:
    """Compare a difference with its interval; without one, its noise is unknown."""
    here, there = map(float, both)
    unit, gap = str(rows[0]["unit"]), here - there
    if span is None:
        return Change(name, unit, here, there, gap, None, None, "none", None if gap else False)
    return Change(name, unit, here, there, gap, *span, basis, not span[0] <= 0 <= span[1])


def _settings(here: Json, there: Json) -> list[ReportDifference]:
    """Return the settings in which two summaries differ."""
    ours, theirs = (
        dict(leaf for name in _SETTINGS for leaf in _leaves(name, part.get(name)))
        for part in (here, there)
    )
    return [
        ReportDifference(what, ours.get(what), theirs.get(what))
        for what in dict.fromkeys([*ours, *theirs])
        if ours.get(what) != theirs.get(what)
    ]


def _leaves(name: str, value: object) -> Iterator[tuple[str, object]]:
    """Yield the leaves of mappings in each other by dotted names."""
    if not isinstance(value, dict):
        yield name, value
        return
    for key, inner in sorted(value.items()):
        yield from _leaves(f"{name}.{key}", inner)


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
