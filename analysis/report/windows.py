"""Windows in the report: the network against other methods, its errors and its cost."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import fmean
from typing import Any, ClassVar, Protocol

import numpy as np
import pandas as pd

from sliplab.analysis.metrics.alarm_rates import few_words
from sliplab.analysis.metrics.classification import CLASSES
from sliplab.analysis.networks.training import Fitted
from sliplab.analysis.report.alarms import alarm_words
from sliplab.analysis.report.figures import intervals
from sliplab.analysis.report.figures import windows as figures
from sliplab.analysis.report.figures.style import CLASS_WORDS
from sliplab.analysis.report.page import Content, Figure, Table, number, percent
from sliplab.protocols.quantity import level_order
from sliplab.storage.schema.evaluation import (
    Accuracy,
    Baseline,
    ProbabilityCalibration,
    Seeds,
    Share,
    TrainedBaseline,
    WindowWork,
)
from sliplab.storage.schema.summary import Kinematic

METHODS = {
    "majority": "majority class",
    "rate_threshold": "event-rate threshold",
    "logistic": "logistic regression on the event count",
    "logistic_cells": "logistic regression on each cell's events",
    "logistic_slices": "logistic regression on each cell's events by tenths of the window",
    "boosting": "gradient boosting on counts",
    "cnn_frame": "ordinary convolutions on the summed frame",
    "cnn_volume": "ordinary convolutions on space and time",
    "cnn_steps": "ordinary convolutions over the steps",
    "gru": "gated recurrent unit over the steps",
    "mean_displacement": "two thresholds on the mean displacement",
    "largest_displacement": "two thresholds on the largest displacement",
}
"""Other methods as text, by name."""
WORST = 10
"""Trials that are listed with their errors."""
_HEADINGS = {
    "epoch": "epoch",
    "loss": "training loss (nats)",
    "val_loss": "validation loss (nats)",
    "train_argmax": "training accuracy, argmax (share)",
    "val_argmax": "validation accuracy, argmax (share)",
    "val_strict": "validation accuracy, strict (share)",
}


@dataclass(frozen=True)
class NetworkSection(Content):
    """Accuracy on windows of test trials, compared with other methods."""

    template: ClassVar[str] = "network.html"
    length_ms: int
    accuracy: Accuracy
    interval: Share
    alarms: str
    seeds: Seeds
    strong: bool
    """Stronger methods were trained."""
    warnings: Sequence[str]
    confusion: Figure
    training: Figure
    methods: Table
    classes: Table

    @property
    def strict(self) -> str:
        """Strict accuracy with its interval."""
        return warned_words(self.interval)

    @property
    def notices(self) -> Sequence[str]:
        """Faults of the network."""
        return self.warnings


def network_section(kinematic: Kinematic, fitted: Fitted, *, simulated: bool) -> NetworkSection:
    """Compare the network with other methods on the same windows."""
    accuracy, baselines = kinematic.accuracy, kinematic.trained_baselines
    own = [percent(value) for value in (accuracy.argmax, accuracy.strict, accuracy.margin)]
    methods = [
        [METHODS[name], percent(found.argmax), "", "", points_words(found.network_ahead)]
        for name, found in {**kinematic.beside, **baselines}.items()
    ]
    history = [vars(record) for record in fitted.history]
    return NetworkSection(
        fitted.windows.length_ms,
        accuracy,
        kinematic.interval,
        alarm_words(kinematic.false_alarms),
        kinematic.seeds,
        bool(baselines),
        fitted.warnings,
        confusion_figure(kinematic, simulated=simulated),
        training_figure(history, fitted.chosen_epoch, simulated=simulated),
        Table(
            ["method", "argmax", "strict", "margin", "network ahead by (points)"],
            [["spiking network", *own, ""], *methods],
        ),
        class_table(kinematic),
    )


def confusion_figure(kinematic: Kinematic, *, simulated: bool) -> Figure:
    """Draw the confusion matrix."""
    confusion = np.asarray(kinematic.confusion)
    called = {
        f"called {word} (windows)": confusion[:, k].tolist()
        for k, word in enumerate((*CLASS_WORDS, "undecided"))
    }
    return Figure(
        figures.confusion(confusion, simulated=simulated),
        name="confusion",
        data={"true class": list(CLASS_WORDS), **called},
    )


def training_figure(
    history: Sequence[dict[str, Any]], chosen_epoch: int, *, simulated: bool
) -> Figure:
    """Draw loss and accuracy over the epochs.

    Args:
        history: a row for each epoch, by the names in `_HEADINGS`.
    """
    return Figure(
        figures.training_curves(history, chosen_epoch, simulated=simulated),
        name="training",
        data={heading: [row[name] for row in history] for name, heading in _HEADINGS.items()},
    )


def class_table(kinematic: Kinematic) -> Table:
    """List precision and recall of each class."""
    return Table(
        ["class", "precision", "recall"],
        [
            [word, percent(kinematic.precision[name]), percent(kinematic.recall[name])]
            for name, word in zip(CLASSES, CLASS_WORDS, strict=True)
        ],
    )


@dataclass(frozen=True)
class WhereSection(Content):
    """Accuracy by condition, phase and trial.

    Attributes:
        all_trials: how many `worst` is of.
    """

    template: ClassVar[str] = "where.html"
    tenths: Figure
    factors: Figure | None
    levels: Table
    still: Table
    worst: Table
    all_trials: int


def where_section(kinematic: Kinematic, *, simulated: bool) -> WhereSection:
    """Look for where the network errs."""
    levels = [
        [factor, level, str(row.trials), str(row.n), share_words(row)]
        for factor, rows in kinematic.by_factor.items()
        for level, row in _in_order(rows)
    ]
    still = kinematic.no_slip
    phases = (
        []
        if still is None
        else [("while holding", still.hold), ("while moving, before the first slip", still.loading)]
    )
    worst = [
        [
            row.trial,
            f"{row.errors} of {row.n}",
            ", ".join(f"{count} {what.replace('_', ' ')}" for what, count in row.taken.items()),
        ]
        for row in kinematic.by_trial[:WORST]
        if row.errors
    ]
    tenths = pd.DataFrame(
        [
            {
                "class": name,
                "phase, from (%)": 10 * row.tenth - 10,
                "recall (share)": row.share,
                "95 % interval, low (share)": row.low,
                "95 % interval, high (share)": row.high,
                "windows": row.n,
            }
            for name, rows in kinematic.by_tenth.items()
            for row in rows
        ],
        dtype=object,
    )
    return WhereSection(
        Figure(
            figures.recall_by_tenth(kinematic.by_tenth, simulated=simulated),
            name="recall-by-tenth",
            data={str(name): column for name, column in tenths.to_dict("list").items()},
        ),
        factor_figure(kinematic.by_factor, kinematic.accuracy, simulated=simulated)
        if kinematic.by_factor
        else None,
        Table(["factor", "level", "trials", "windows", "right"], levels),
        Table(
            ["no slip", "trials", "windows", "right"],
            [[word, str(row.trials), str(row.n), share_words(row)] for word, row in phases],
        ),
        Table(["trial", "wrong", "what was called what"], worst),
        len(kinematic.by_trial),
    )


def factor_figure(
    by_factor: Mapping[str, Mapping[str, Share]], accuracy: Accuracy, *, simulated: bool
) -> Figure:
    """Draw accuracy by each factor's levels, next to that of all windows."""
    strict = accuracy.strict
    groups = {
        factor: [
            intervals.ShareInterval(level, row.share, row.low, row.high)
            for level, row in _in_order(rows)
        ]
        for factor, rows in by_factor.items()
    }
    line = None if strict is None else (strict, "all test windows")
    named = [replace(it, name=f"{factor} {it.name}") for factor, of in groups.items() for it in of]
    return Figure(
        intervals.shares(
            groups, "windows classified correctly (%)", simulated=simulated, line=line
        ),
        name="accuracy-by-factor",
        data=share_data(named),
    )


def share_data(
    rows: Sequence[intervals.ShareInterval], what: str = "strict accuracy"
) -> dict[str, Sequence[object]]:
    """Return drawn shares as columns."""
    return {
        "name": [row.name for row in rows],
        f"{what} (share)": [row.value for row in rows],
        "95 % interval, low (share)": [row.low for row in rows],
        "95 % interval, high (share)": [row.high for row in rows],
    }


def _in_order(rows: Mapping[str, Share]) -> list[tuple[str, Share]]:
    """Sort a factor's levels by their number, words after numbers."""
    return sorted(rows.items(), key=lambda item: level_order(item[0]))


@dataclass(frozen=True)
class LeadSection(Content):
    """Share of right windows by the winner's lead in spikes."""

    template: ClassVar[str] = "lead.html"
    folded: ClassVar[bool] = True
    calibration: ProbabilityCalibration
    figure: Figure


def lead_section(kinematic: Kinematic, *, simulated: bool) -> LeadSection | None:
    """Draw the share right by lead; None if there are no windows."""
    if not kinematic.reliability:
        return None
    headings = {
        "lead": "lead, from (spikes)",
        "to": "lead, to (spikes)",
        "n": "windows",
        "share": "right (share)",
        "low": "95 % interval, low (share)",
        "high": "95 % interval, high (share)",
    }
    rows = kinematic.reliability
    data = {heading: [getattr(row, key) for row in rows] for key, heading in headings.items()}
    svg = figures.reliability(rows, simulated=simulated)
    return LeadSection(kinematic.calibration, Figure(svg, name="lead-reliability", data=data))


@dataclass(frozen=True)
class BestBaseline:
    """The best other method on these windows.

    Attributes:
        shares: argmax accuracy with each seed.
    """

    title: str
    found: Baseline
    multiply_adds: int | None
    shares: Sequence[float]

    @property
    def mean(self) -> float:
        """Mean of the seeds."""
        return fmean(self.shares)


@dataclass(frozen=True)
class WorkSection(Content):
    """Computation of the network, and its accuracy compared with the best other method.

    Attributes:
        seeds: of the spiking network.
    """

    template: ClassVar[str] = "work.html"
    folded: ClassVar[bool] = True
    work: WindowWork
    seeds: Seeds
    rival: BestBaseline | None
    layers: Table
    fired: Table
    others: Table


class JudgedWindows(Protocol):
    """A network's test windows: its work, and other methods on them."""

    @property
    def work(self) -> WindowWork | None: ...
    @property
    def seeds(self) -> Seeds: ...
    @property
    def beside(self) -> dict[str, Baseline]: ...
    @property
    def trained_baselines(self) -> dict[str, TrainedBaseline]: ...


def work_section(scores: JudgedWindows) -> WorkSection | None:
    """Compare computation and accuracy; None where the work was not counted."""
    work = scores.work
    if work is None:
        return None
    synaptic, dense = work.synaptic_operations, work.dense_multiply_adds
    layers = [
        [name, f"{synaptic[name]:,.0f}", f"{dense[name]:,}", percent(synaptic[name] / dense[name])]
        for name in synaptic
    ]
    fired = [
        [name, number(work.spikes[name], 1), percent(rate, 2)] for name, rate in work.rates.items()
    ]
    return WorkSection(
        work,
        scores.seeds,
        _rival(scores),
        Table(["layer", "synaptic operations", "dense multiply-adds", "share"], layers),
        Table(["spiking layer", "spikes a window", "of neurons and steps"], fired),
        _others(scores.trained_baselines),
    )


def _rival(scores: JudgedWindows) -> BestBaseline | None:
    """Find the best other method, where stronger ones were trained."""
    every: dict[str, Baseline] = {**scores.beside, **scores.trained_baselines}
    known = {name: row for name, row in every.items() if row.argmax is not None}
    if not scores.trained_baselines or not known:
        return None
    best = max(known, key=lambda name: known[name].argmax or 0.0)
    found = known[best]
    made = found.made if isinstance(found, TrainedBaseline) else {}
    return BestBaseline(METHODS[best], found, made.get("multiply_adds"), _shares(made))


def _others(baselines: Mapping[str, TrainedBaseline]) -> Table:
    """List the other methods."""
    rows = []
    for name, found in baselines.items():
        made, shares = found.made, _shares(found.made)
        ran = made.get("epochs", made.get("rounds", made.get("iterations")))
        most = made.get("most_rounds")
        spread = "–"
        if shares:
            spread = f"{percent(fmean(shares))} ({percent(min(shares))} to {percent(max(shares))})"
        rows.append(
            [
                METHODS[name],
                *(
                    "–" if key not in made else f"{made[key]:,}"
                    for key in ("weights", "multiply_adds")
                ),
                f"{ran} of at most {most}" if most is not None else str(ran),
                spread,
            ]
        )
    columns = ["method", "weights", "multiply-adds a window", "epochs or rounds", "argmax of seeds"]
    return Table(columns, rows)


def _shares(made: Mapping[str, Any]) -> list[float]:
    """Return argmax accuracy with each seed; none for what has nothing random."""
    return [row["argmax"] for row in made.get("seeds", ()) if row["argmax"] is not None]


def share_words(row: Share) -> str:
    """Return a share with its interval."""
    if row.share is None or row.low is None:
        return percent(row.share)
    return f"{percent(row.share)} ({percent(row.low)} to {percent(row.high)})"


def warned_words(row: Share) -> str:
    """Return a share with its interval, and a warning where so few trials bound it badly."""
    few = "" if row.low is None else few_words(row.trials, "errors")
    return "; ".join(filter(None, (share_words(row), few)))


def points_words(row: Share) -> str:
    """Return a difference of shares in percentage points, with its interval."""
    if row.share is None or row.low is None or row.high is None:
        return number(None if row.share is None else 100 * row.share)
    return f"{100 * row.share:+.1f} ({100 * row.low:+.1f} to {100 * row.high:+.1f})"
