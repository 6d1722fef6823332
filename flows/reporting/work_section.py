"""The report's words on work: what spiking buys, and what it costs against other methods."""

from __future__ import annotations

from statistics import fmean
from typing import Any

from sliplab.analysis.report.page import Section, Table, number, percent

Json = dict[str, Any]

METHODS = {
    "majority": "majority class",
    "rate_threshold": "event-rate threshold",
    "logistic": "logistic regression on the event count",
    "logistic_cells": "logistic regression on each cell's events",
    "boosting": "gradient boosting on counts",
    "cnn_frame": "ordinary convolutions on the summed frame",
    "cnn_volume": "ordinary convolutions on space and time",
    "gru": "gated recurrent unit over the steps",
}
"""Other methods in words, by name."""


def section(windows: Json, baselines: Json) -> Section:
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
        *_lost(windows, baselines),
    ]
    return Section(
        "What spiking buys, and what it costs",
        said,
        (),
        [
            Table(["layer", "synaptic operations", "dense multiply-adds", "share"], rows,
                  f"Means of {work['n']} test windows of {number(work['events'], 0)} events."),
            Table(["spiking layer", "spikes a window", "of neurons and steps"], fired),
            *_others(baselines),
        ],
    )  # fmt: skip


def _lost(windows: Json, baselines: Json) -> list[str]:
    """The accuracy that the best other method has more or less."""
    compared = {**windows["beside"], **baselines}
    found = {name: row for name, row in compared.items() if row["argmax"] is not None}
    if not baselines or not found:
        return []
    best = max(found, key=lambda name: float(found[name]["argmax"]))
    ahead = found[best]["network_ahead"]
    points = 100 * ahead["share"]
    sure = ahead["low"] is not None and not ahead["low"] <= 0 <= ahead["high"]
    word = "ahead of" if points > 0 else "behind"
    cost = found[best].get("made", {}).get("multiply_adds")
    return [
        f"It costs: the best other method on these windows is this one: {METHODS[best]}, with "
        f"{percent(found[best]['argmax'])}"
        + (f" for {cost:,} multiply-adds a window" if cost is not None else "")
        + f". The spiking network is {number(abs(points))} points {word} it"
        + _span(ahead)
        + "; "
        + ("trials tell them apart." if sure else "so few trials do not tell them apart.")
        + " It was picked as the best on these very windows, which flatters it.",
        *_means(windows["seeds"], found[best].get("made", {}), best),
    ]


def _means(ours: Json, theirs: Json, best: str) -> list[str]:
    """Mean against mean, where both were trained with several seeds."""
    strict = ours["spread"]["strict"]["mean"]
    shares = _shares(theirs)
    if len(ours["each"]) < 2 or len(shares) < 2 or strict is None:
        return []
    mean = fmean(shares)
    points = 100 * (strict - mean)
    return [
        f"Over {len(ours['each'])} seeds the spiking network's strict accuracy is "
        f"{percent(strict)} in the mean; over {len(shares)} seeds {METHODS[best]} have "
        f"{percent(mean)}: {number(abs(points), 2)} points "
        f"{'ahead' if points > 0 else 'behind'}, ties counted as wrong."
    ]


def _others(baselines: Json) -> list[Table]:
    rows = []
    for name, found in baselines.items():
        made = found["made"]
        ran = made.get("epochs", made.get("rounds", made.get("iterations")))
        most = made.get("most_rounds")
        rows.append(
            [
                METHODS[name],
                "–" if "weights" not in made else f"{made['weights']:,}",
                "–" if "multiply_adds" not in made else f"{made['multiply_adds']:,}",
                f"{ran} of at most {most}" if most is not None else str(ran),
                _over_seeds(made),
            ]
        )
    if not rows:
        return []
    columns = ["method", "weights", "multiply-adds a window", "epochs or rounds", "argmax of seeds"]
    return [Table(columns, rows, "What the other methods are.")]


def _over_seeds(made: Json) -> str:
    """Mean, lowest and highest argmax accuracy of a method that was trained with several seeds."""
    shares = _shares(made)
    if not shares:
        return "–"
    return f"{percent(fmean(shares))} ({percent(min(shares))} to {percent(max(shares))})"


def _shares(made: Json) -> list[float]:
    """Argmax accuracy with each seed; none for what has nothing random."""
    return [row["argmax"] for row in made.get("seeds", ()) if row["argmax"] is not None]


def _span(row: Json) -> str:
    if row["low"] is None:
        return ""
    return f" (difference {100 * row['low']:+.1f} to {100 * row['high']:+.1f} in 95 %)"


def _part(synaptic: Json, dense: Json, layer: str) -> float:
    return float(synaptic[layer] / dense[layer])
