"""The report's words on windows: the network beside other methods, where it errs, what it costs."""

from __future__ import annotations

from typing import Any

import numpy as np

from analysis import figures, window_figures
from analysis.metrics import CLASSES
from analysis.report import Figure, Section, Table, number, percent
from analysis.training import Fitted

Json = dict[str, Any]

_METHODS = {
    "majority": "majority class",
    "rate_threshold": "event-rate threshold",
    "logistic": "logistic regression on the event count",
    "logistic_cells": "logistic regression on each cell's events",
    "boosting": "gradient boosting on counts",
    "cnn_frame": "ordinary convolutions on the summed frame",
    "cnn_volume": "ordinary convolutions on space and time",
    "gru": "gated recurrent unit over the steps",
}
_WORST = 10


def window_sections(windows: Json, beside: Json, fitted: Fitted, simulated: bool) -> list[Section]:
    """All sections on the test windows.

    Args:
        windows: the evaluation's ``windows``.
        beside: what was trained to compare, by name; see `flows.window_baselines.beside`.
    """
    sections = [_network(windows, beside, fitted, simulated), _where(windows, simulated)]
    if windows["reliability"]:
        sections.append(_lead(windows, simulated))
    if windows["work"] is not None:
        sections.append(_cost(windows, beside))
    return sections


def _network(windows: Json, beside: Json, fitted: Fitted, simulated: bool) -> Section:
    """Accuracy on windows of test trials, with the other methods beside it."""
    accuracy = windows["accuracy"]
    kinds = ("argmax", "strict", "margin")
    rows = [["spiking network", *(percent(accuracy[kind]) for kind in kinds), ""]]
    for name, found in {**windows["beside"], **beside}.items():
        rows.append(
            [_METHODS[name], percent(found["argmax"]), "", "", _points(found["network_ahead"])]
        )
    classes = [
        [word, percent(windows["precision"][name]), percent(windows["recall"][name])]
        for name, word in zip(CLASSES, figures.CLASS_WORDS, strict=True)
    ]
    missing = [] if beside else ["Stronger methods are compared by `sliplab evaluate --baselines`."]
    return Section(
        "The network on windows of 30 ms" if fitted.windows.length_ms == 30 else "The network",
        [
            f"{accuracy['n']} windows of {windows['interval']['trials']} test trials that were "
            "used neither for training nor for choosing the model. Argmax shares a tie among its "
            "classes, strict wants a unique winner, margin wants it to lead as a detection must. "
            f"Strict accuracy with its 95 % interval over trials: {_share(windows['interval'])}.",
            *_of_seeds(windows["seeds"]),
            *missing,
            *(f"Warning: {text}" for text in fitted.warnings),
        ],
        [
            Figure(
                figures.confusion(np.asarray(windows["confusion"]), simulated=simulated),
                "Rows are true classes and add up to 100 %. The last column holds windows whose "
                "two highest spike counts are equal.",
            ),
            Figure(
                figures.training_curves(
                    [vars(record) for record in fitted.history],
                    fitted.chosen_epoch,
                    simulated=simulated,
                ),
                "Training; the dashed line is the epoch with the best strict validation accuracy, "
                "whose weights are used.",
            ),
        ],
        [
            Table(
                ["method", *kinds, "network ahead by (points)"],
                rows,
                "Accuracy on the same windows; intervals are 95 %, over trials.",
            ),
            Table(["class", "precision", "recall"], classes),
        ],
    )


def _where(windows: Json, simulated: bool) -> Section:
    """By condition, phase and trial."""
    levels = [
        [factor, level, str(row["trials"]), str(row["n"]), _share(row)]
        for factor, rows in windows["by_factor"].items()
        for level, row in rows.items()
    ]
    still = [
        [word, str(row["trials"]), str(row["n"]), _share(row)]
        for word, row in (
            ("while holding", windows["no_slip"]["hold"]),
            ("while moving, before the first slip", windows["no_slip"]["loading"]),
        )
    ]
    worst = [
        [
            row["trial"],
            f"{row['errors']} of {row['n']}",
            ", ".join(f"{count} {_taken(what)}" for what, count in row["taken"].items()),
        ]
        for row in windows["by_trial"][:_WORST]
        if row["errors"]
    ]
    return Section(
        "Where the network is right",
        [
            "Strict accuracy, with 95 % intervals that draw whole trials again: windows of a trial "
            "are right together and wrong together. With a handful of trials they are too narrow."
        ],
        [
            Figure(
                window_figures.recall_by_tenth(windows["by_tenth"], simulated=simulated),
                "Recall by where the window's middle lies in its class's phase: no slip ends and "
                "incipient slip begins at the first slip, gross slip begins at the centre's.",
            )
        ],
        [
            Table(["factor", "level", "trials", "windows", "right"], levels),
            Table(["no slip", "trials", "windows", "right"], still),
            Table(
                ["trial", "wrong", "what was called what"],
                worst,
                f"The {len(worst)} worst trials of {len(windows['by_trial'])}.",
            ),
        ],
    )


def _lead(windows: Json, simulated: bool) -> Section:
    """What a lead means."""
    fit = windows["calibration"]
    said = ["A window without a unique winner has the lead 0 and counts as wrong."]
    if fit["temperature"] is not None and fit["ece"] is not None:
        said.append(
            f"Spike counts divided by {number(fit['temperature'], 2)} (fitted on validation "
            "windows) and put through a softmax are probabilities whose expected calibration "
            f"error is {percent(fit['ece'])} on test windows; undivided ones are off by "
            f"{percent(fit['uncalibrated']['ece'])}."
        )
    return Section(
        "What a lead in spikes means",
        said,
        [
            Figure(
                window_figures.reliability(windows["reliability"], simulated=simulated),
                "Bars are Wilson's 95 % intervals, which take windows for independent.",
            )
        ],
    )


def _cost(windows: Json, beside: Json) -> Section:
    """What spiking buys, and what it costs."""
    work = windows["work"]
    synaptic, dense = work["synaptic_operations"], work["dense_multiply_adds"]
    rows = [
        [
            layer,
            f"{synaptic[layer]:,.0f}",
            f"{dense[layer]:,}",
            percent(_part(synaptic, dense, layer)),
        ]
        for layer in synaptic
    ]
    fired = [
        [layer, number(work["spikes"][layer], 1), percent(rate, 2)]
        for layer, rate in work["rates"].items()
    ]
    said = [
        f"It buys: {synaptic['all']:,.0f} synaptic operations a window, where the same layers "
        f"computed densely do {dense['all']:,} multiply-adds: {percent(work['share'])}. A synaptic "
        "operation is one addition that a spike, or an event, causes at one neuron, counted by "
        "where it fired; a multiply-add does more. What is neither is not counted: keeping "
        "potentials, memory, moving spikes about. So this says nothing about joules.",
        *_lost(windows, beside),
    ]
    return Section(
        "What spiking buys, and what it costs",
        said,
        (),
        [
            Table(["layer", "synaptic operations", "dense multiply-adds", "share"], rows,
                  f"Means of {work['n']} test windows of {number(work['events'], 0)} events."),
            Table(["spiking layer", "spikes a window", "of neurons and steps"], fired),
            *_others(beside),
        ],
    )  # fmt: skip


def _lost(windows: Json, beside: Json) -> list[str]:
    """The accuracy that the best other method has more or less."""
    there = {**windows["beside"], **beside}
    found = {name: row for name, row in there.items() if row["argmax"] is not None}
    if not beside or not found:
        return []
    best = max(found, key=lambda name: float(found[name]["argmax"]))
    ahead = found[best]["network_ahead"]
    points = 100 * ahead["share"]
    sure = ahead["low"] is not None and not ahead["low"] <= 0 <= ahead["high"]
    word = "ahead of" if points > 0 else "behind"
    cost = found[best].get("made", {}).get("multiply_adds")
    return [
        f"It costs: the best other method on these windows is this one: {_METHODS[best]}, with "
        f"{percent(found[best]['argmax'])}"
        + (f" for {cost:,} multiply-adds a window" if cost is not None else "")
        + f". The spiking network is {number(abs(points))} points {word} it"
        + _span(ahead)
        + "; "
        + ("trials tell them apart." if sure else "so few trials do not tell them apart.")
        + " It was picked as the best on these very windows, which flatters it."
    ]


def _others(beside: Json) -> list[Table]:
    rows = []
    for name, found in beside.items():
        made = found["made"]
        ran = made.get("epochs", made.get("rounds", made.get("iterations")))
        most = made.get("most_epochs", made.get("most_rounds"))
        rows.append(
            [
                _METHODS[name],
                "–" if "weights" not in made else f"{made['weights']:,}",
                "–" if "multiply_adds" not in made else f"{made['multiply_adds']:,}",
                f"{ran} of at most {most}" if most is not None else str(ran),
            ]
        )
    if not rows:
        return []
    columns = ["method", "weights", "multiply-adds a window", "epochs or rounds"]
    return [Table(columns, rows, "What the other methods are.")]


def _span(row: Json) -> str:
    if row["low"] is None:
        return ""
    return f" (difference {100 * row['low']:+.1f} to {100 * row['high']:+.1f} in 95 %)"


def _of_seeds(seeds: Json) -> list[str]:
    each, strict = seeds["each"], seeds["spread"]["strict"]
    if len(each) < 2:
        return ["One seed was trained: how much seeds differ is not known."]
    return [
        f"{len(each)} seeds were trained; their strict accuracy is {percent(strict['mean'])} in "
        f"the mean, from {percent(strict['min'])} to {percent(strict['max'])}. The one shown was "
        "chosen by validation windows."
    ]


def _part(synaptic: Json, dense: Json, layer: str) -> float:
    return float(synaptic[layer] / dense[layer])


def _taken(what: str) -> str:
    return what.replace("_", " ")


def _share(row: Json) -> str:
    if row["share"] is None or row["low"] is None:
        return percent(row["share"])
    return f"{percent(row['share'])} ({percent(row['low'])} to {percent(row['high'])})"


def _points(row: Json) -> str:
    if row["share"] is None or row["low"] is None:
        return number(None if row["share"] is None else 100 * row["share"])
    return f"{100 * row['share']:+.1f} ({100 * row['low']:+.1f} to {100 * row['high']:+.1f})"
