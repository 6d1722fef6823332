"""The report's words on windows: the network beside other methods, where it errs, what it costs."""

from __future__ import annotations

from typing import Any

import numpy as np

from sliplab.analysis.metrics.classification import CLASSES
from sliplab.analysis.networks.training import Fitted
from sliplab.analysis.report.figures import windows as figures
from sliplab.analysis.report.figures.style import CLASS_WORDS
from sliplab.analysis.report.page import Figure, Section, Table, number, percent
from sliplab.analysis.report.published import PAPER
from sliplab.flows.reporting import others_section, work_section
from sliplab.flows.reporting.work_section import METHODS

Json = dict[str, Any]

_WORST = 10


def window_sections(
    windows: Json, baselines: Json, fitted: Fitted, simulated: bool
) -> list[Section]:
    """All sections on the test windows.

    Args:
        windows: the evaluation's ``windows``.
        baselines: figures of other methods by name; see
            `flows.learning.window_baselines.baselines`.
    """
    sections = [_network(windows, baselines, fitted, simulated), _where(windows, simulated)]
    if windows["reliability"]:
        sections.append(_lead(windows, simulated))
    if windows["work"] is not None:
        sections.append(work_section.section(windows, baselines))
    return sections


def _network(windows: Json, baselines: Json, fitted: Fitted, simulated: bool) -> Section:
    """Accuracy on windows of test trials, with the other methods beside it."""
    accuracy = windows["accuracy"]
    kinds = ("argmax", "strict", "margin")
    rows = [["spiking network", *(percent(accuracy[kind]) for kind in kinds), ""]]
    for name, found in {**windows["beside"], **baselines}.items():
        rows.append(
            [METHODS[name], percent(found["argmax"]), "", "", _points(found["network_ahead"])]
        )
    classes = [
        [word, percent(windows["precision"][name]), percent(windows["recall"][name])]
        for name, word in zip(CLASSES, CLASS_WORDS, strict=True)
    ]
    missing = (
        [] if baselines else ["Stronger methods are compared by `sliplab evaluate --baselines`."]
    )
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
                "two highest spike counts are equal. Everything off the diagonal is an error.",
                "confusion",
                {
                    "true class": list(CLASS_WORDS),
                    **{
                        f"called {word} (windows)": [row[k] for row in windows["confusion"]]
                        for k, word in enumerate((*CLASS_WORDS, "undecided"))
                    },
                },
                f"accuracy {PAPER['accuracy'].text}; incipient precision "
                f"{PAPER['incipient_precision'].text} and recall {PAPER['incipient_recall'].text}; "
                f"most confused {PAPER['confused'].text}.",
            ),
            Figure(
                figures.training_curves(
                    [vars(record) for record in fitted.history],
                    fitted.chosen_epoch,
                    simulated=simulated,
                ),
                "Training; the dashed line is the epoch with the best strict validation accuracy, "
                "whose weights are used. Where validation turns while training still improves, the "
                "network begins to learn its training trials by heart.",
                "training",
                _history(fitted),
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
    accuracy = windows["accuracy"]
    levels = [
        [factor, level, str(row["trials"]), str(row["n"]), _share(row)]
        for factor, rows in windows["by_factor"].items()
        for level, row in others_section.in_order(rows)
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
            "Strict accuracy, with 95 % intervals (Student's, over trials): windows of a trial "
            "are right together and wrong together."
        ],
        [
            Figure(
                figures.recall_by_tenth(windows["by_tenth"], simulated=simulated),
                "Recall by where the window's middle lies in its class's phase: no slip ends and "
                "incipient slip begins at the first slip, gross slip begins at the centre's. Bars "
                "are 95 % intervals over trials. It falls where a phase looks like its neighbour.",
                "recall-by-tenth",
                _tenths(windows["by_tenth"]),
            ),
            *(
                [others_section.factors(windows["by_factor"], accuracy["strict"], simulated)]
                if windows["by_factor"]
                else []
            ),
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
                figures.reliability(windows["reliability"], simulated=simulated),
                "Share of windows called rightly, by how far the winner leads; below, how many "
                "windows there are. Bars are 95 % intervals over trials. "
                "The paper's detection asks for a lead of 2 with one output neuron a "
                "class.",
                "lead-reliability",
                _leads(windows["reliability"]),
            )
        ],
    )


def _history(fitted: Fitted) -> dict[str, list[object]]:
    rows = [vars(record) for record in fitted.history]
    headings = {
        "epoch": "epoch",
        "loss": "training loss (nats)",
        "val_loss": "validation loss (nats)",
        "train_argmax": "training accuracy, argmax (share)",
        "val_argmax": "validation accuracy, argmax (share)",
        "val_strict": "validation accuracy, strict (share)",
    }
    return {heading: [row[name] for row in rows] for name, heading in headings.items()}


def _tenths(tenths: Json) -> dict[str, list[object]]:
    rows = [(name, row) for name, of in tenths.items() for row in of]
    return {
        "class": [name for name, _ in rows],
        "phase, from (%)": [10 * row["tenth"] - 10 for _, row in rows],
        "recall (share)": [row["share"] for _, row in rows],
        "95 % interval, low (share)": [row["low"] for _, row in rows],
        "95 % interval, high (share)": [row["high"] for _, row in rows],
        "windows": [row["n"] for _, row in rows],
    }


def _leads(rows: list[Json]) -> dict[str, list[object]]:
    headings = {
        "lead": "lead, from (spikes)",
        "to": "lead, to (spikes)",
        "n": "windows",
        "share": "right (share)",
        "low": "95 % interval, low (share)",
        "high": "95 % interval, high (share)",
    }
    return {heading: [row[name] for row in rows] for name, heading in headings.items()}


def _of_seeds(seeds: Json) -> list[str]:
    each, strict = seeds["each"], seeds["spread"]["strict"]
    if len(each) < 2:
        return ["One seed was trained: how much seeds differ is not known."]
    return [
        f"{len(each)} seeds were trained; their strict accuracy is {percent(strict['mean'])} in "
        f"the mean, from {percent(strict['min'])} to {percent(strict['max'])}. The one shown was "
        "chosen by validation windows."
    ]


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
