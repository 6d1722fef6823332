"""The report's figures beside those of the paper, in one table, and what that comparison is worth.

The paper's were measured on a real robot with a real skin. Nothing here says that a simulated
figure near a published one is right, or that one far from it is wrong.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sliplab.analysis.report.figures.style import CLASS_WORDS
from sliplab.analysis.report.page import Section, Table, number, percent
from sliplab.analysis.report.published import PAPER

Json = dict[str, Any]

_COLUMNS = ("figure", "paper")
_DIFFERENCES = ("setting", "paper", "here", "the paper's value is")
_SCANNED = ["windows scanned", "to past gross slip", "to the recording's end", "published"]
"""A difference that no setting makes."""


def section(summary: Json) -> Section:
    """Every published figure beside this one's."""
    kind = "simulated" if summary["simulated"] else "measured on this rig"
    simulated = " (simulated)" if summary["simulated"] else ""
    networks = {f"here{simulated}": summary}
    networks |= {f"{_title(found)}{simulated}": found for found in summary["networks"].values()}
    columns = [*_COLUMNS, *networks]
    each = [[*_windows(found), *_times(found)] for found in networks.values()]
    same = list(zip(*each, strict=True))
    rows = [[*row[0][:2], *(_with_interval(*of[2:4]) for of in row)] for row in same]
    counts = [[row[0][0], *(of[4] for of in row)] for row in same]
    said = summary["paper"]
    differences = [
        [row["setting"], row["paper"], row["here"], row["source"]] for row in said["differences"]
    ]
    return Section(
        "Beside the paper",
        [
            "The paper's figures were measured by its authors on their own robot and skin; those "
            f"of this report are {kind}. They are different things of the same name: a figure that "
            "agrees proves nothing about the other, and where they differ either may be right.",
            f"The paper does not say the following; the values here: {'; '.join(said['assumed'])}.",
            *(_how(found) for found in summary["networks"].values()),
        ],
        (),
        [
            Table(
                columns, rows,
                "In brackets 95 % over trials (Student's), windows of a trial together. Accuracy "
                "of raw spike counts, ties shared.",
            ),
            Table(["figure", *networks], counts, "How many windows and trials each figure is of."),
            Table(
                _DIFFERENCES, [*differences, _SCANNED],
                "In which settings the network here"
                + (f" (preset {said['preset']})" if said["preset"] else "")
                + " differs from the paper's.",
            ),
        ],
    )  # fmt: skip


def _with_interval(value: str, interval: str) -> str:
    return value if interval == "–" else f"{value} ({interval})"


def _title(network: Json) -> str:
    """A column's heading."""
    return f"{network['preset']} preset" if network["preset"] else str(network["title"])


def _how(network: Json) -> str:
    """Text on how a network other than the store's own was made and counted."""
    margin = ", ".join(sorted({f"{rule['margin']:g}" for rule in network["detection"].values()}))
    rule = f"judged on the same windows and labels, by a margin of {margin} spikes"
    if network["preset"]:
        return (
            f"“{_title(network)}” is the paper's network, trained on the same windows as the one "
            f"here (seed {network['seed']}), with the paper's values of the settings below; {rule}."
        )
    counted = "Sinabs" if network["engine"] == "sinabs" else "the event-driven kernels"
    if not network["exact"] and network["engine"] != "sinabs":
        counted += (
            ", whose counts may differ from Sinabs' in a few windows because its weights are off "
            "the grid"
        )
    return f"“{_title(network)}” is a model of a file, counted by {counted}; {rule}."


def _windows(summary: Json) -> list[list[str]]:
    kinematic = summary["kinematic"]
    known = kinematic["window_intervals"]
    rows = []
    for name, title, value in (
        ("accuracy", "test accuracy of windows", kinematic["accuracy"]["argmax"]),
        ("incipient_precision", "incipient precision", kinematic["precision"]["incipient"]),
        ("incipient_recall", "incipient recall", kinematic["recall"]["incipient"]),
    ):
        row = known.get(name)
        span, count = "–", "–"
        if row is not None and row["low"] is not None:
            span = f"{percent(row['low'])} to {percent(row['high'])}"
        if row is not None:
            count = f"{row['n']} windows, {row['trials']} trials"
        rows.append([title, PAPER[name].text, percent(value), span, count])
    count, interval = rows[0][-1], kinematic["interval"]
    sure = "–"
    if interval["low"] is not None:
        sure = f"{percent(interval['low'])} to {percent(interval['high'])}"
    right = kinematic["accuracy"]
    rows[1:1] = [
        ["the same, a tie wrong", "–", percent(right["strict"]), sure, count],
        ["the same, won by the margin", "–", percent(right["margin"]), "–", count],
    ]
    rows.append(["most confused pair", PAPER["confused"].text, *_confused(kinematic["confusion"])])
    return rows


def _confused(confusion: Sequence[Sequence[int]]) -> list[str]:
    """The two classes that are most often taken for each other."""
    pairs = {(a, b): confusion[a][b] + confusion[b][a] for a in range(3) for b in range(a + 1, 3)}
    a, b = max(pairs, key=lambda pair: pairs[pair])
    if not pairs[a, b]:
        return ["none", "–", "–"]
    return [f"{CLASS_WORDS[a]} and {CLASS_WORDS[b]}", "–", f"{pairs[a, b]} windows"]


def _times(summary: Json) -> list[list[str]]:
    rows = []
    kinematic = summary["kinematic"]
    for kind in ("incipient", "gross"):
        found = kinematic["latency_ms"][kind]
        span = kinematic["intervals"][f"latency_{kind}_ms"]["mean"]
        rows.append(
            [
                f"kinematic latency, {kind}, mean",
                f"{PAPER[f'{kind}_latency'].text} after onset",
                number(found["mean"], 0, "ms"),
                _span(span),
                f"{found['n']} trials; {found['missed']} missed, {found['late']} late, "
                f"{found['false_early']} early",
            ]
        )
    lead, accounts = summary["gravity"]["lead_ms"], summary["gravity"]["accounted"]
    if accounts["planned"]:
        first = accounts["detected_first"]
        rows.append(
            [
                "gravity lead, smallest",
                PAPER["gravity_lead"].text,
                number(lead["min"], 0, "ms"),
                "–",
                f"{first} of {accounts['planned']} trials detected first",
            ]
        )
    lead, accounts = summary["disturbance"]["lead_ms"], summary["disturbance"]["accounted"]
    if accounts["planned"]:
        rows.append(
            [
                "disturbance lead, mean ± standard deviation",
                PAPER["disturbance_lead"].text,
                f"{number(lead['mean'], 0)} ± {number(lead['std'], 0, 'ms')}",
                _span(summary["disturbance"]["intervals"]["lead_ms"]["mean"]),
                f"{accounts['detected_first']} of {accounts['planned']} trials detected first",
            ]
        )
    return rows


def _span(span: Sequence[float] | None) -> str:
    return "–" if span is None else f"{span[0]:.0f} to {span[1]:.0f} ms"
