"""Pages, tables and figures: escaped, whole, with units, and never without "simulated"."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Sequence
from functools import partial
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import pytest

from sliplab.analysis.report.cover import Answer, Cover
from sliplab.analysis.report.figures import campaign, clocks, intervals, trials
from sliplab.analysis.report.figures.detectors import latency_over_rate
from sliplab.analysis.report.figures.intervals import (
    Panel,
    ShareInterval,
    by_condition,
    differences,
)
from sliplab.analysis.report.outcomes import FailureSection
from sliplab.analysis.report.page import Content, Figure, Table, csv_text, render_page
from sliplab.analysis.report.trial import TrialSection
from sliplab.plugins.studies.generalise.section import GeneralisationSection
from sliplab.plugins.studies.plot import AxisPair as Pair
from sliplab.plugins.studies.plot import DetectorPoint, cost_and_error

EVIL = "<img src=x onerror=alert(1)>"
SVG = "<svg xmlns='http://www.w3.org/2000/svg'></svg>"
ROWS = ["0.165 kg, 0.3 mm/s", "0.205 kg, 0.3 mm/s"]

LEAD = Panel(
    "lead (ms)",
    {ROWS[0]: [360.0, 420.0]},
    zero="gross slip",
    notes={ROWS[0]: "2 missed"},
    limit=(-120.0, "first tip slips (true)"),
)
DEPTHS = [ShareInterval("2.4 mm", 0.9, 0.85, 0.95), ShareInterval("2.6 mm", None, None, None)]
POINTS = [
    DetectorPoint({"x": 10.0, "y": 90.0}, True, False),
    DetectorPoint({"x": 20.0, "y": 95.0}, False, True),
]
WINDOWS = "windows classified correctly (%)"
DRAWN: dict[str, tuple[Callable[..., str], tuple[str, ...]]] = {
    "by_condition": (
        partial(by_condition, ROWS, [LEAD], breaks=[1]),
        ("lead (ms)", *ROWS, "0: gross slip", "dotted: first tip", "2 missed", "none"),
    ),
    "latency_over_rate": (
        partial(latency_over_rate, {"every 10 ms": {"CUSUM": [(0.0, 40.0), (0.1, None)]}}, -120.0),
        ("every 10 ms", "CUSUM", "first tip slips (true)", "−100"),
    ),
    "shares": (
        partial(intervals.shares, {"depth": DEPTHS}, WINDOWS, line=(0.92, "all")),
        (WINDOWS, "depth", "2.4 mm", "2.6 mm", "all"),
    ),
    "differences": (partial(differences, [("lead", 12.0, 3.0, 20.0)], "ms"), ("lead", "ms")),
    "over_campaign": (
        partial(campaign.over_campaign, [1, 2, 4], [1e4, 2e4, 1e4], [0.1, 0.2, 0.1], {3: 2}),
        ("(thousand/s)", "(% of its limit)", "attempts", "trial, in the plan's order"),
    ),
    "references": (
        partial(
            campaign.references,
            [1, 5],
            {"events (1/s)": [10.0, 11.0], "first slip (ms)": [None, 900.0]},
        ),
        ("events (1/s)", "first slip (ms)"),
    ),
    "clocks": (
        partial(
            clocks.uncertainty_by_trial,
            {"events, trigger input": ([1, 2], [0.3, 0.4])},
            {"kinematic": 1},
        ),
        ("uncertainty, 95 % (µs)", "kinematic", "events, trigger input"),
    ),
    "labels": (
        partial(
            trials.label_uncertainty,
            {"paper's rule": {"incipient": [1.0, 4.0], "gross": [2.0]}},
            {"incipient": [3.0], "gross": []},
        ),
        ("distance from the truth (ms)", "width of its 95 % interval (ms)"),
    ),
    "front": (
        partial(cost_and_error, POINTS, [Pair("x", "y", "work (µs/s)", "latency (ms)")]),
        ("work (µs/s)", "latency (ms)", "Pareto front", "paper's settings"),
    ),
}


def render(*sections: Content, simulated: bool = False, notices: Sequence[str] = ()) -> str:
    """A report with these sections."""
    campaigns: Any = [SimpleNamespace(name=EVIL, title=EVIL, question=EVIL)]
    cover = Cover("report.html", Answer([EVIL], Figure(SVG), EVIL), notices, [])
    return render_page(
        cover.template, sections, simulated=simulated, campaigns=campaigns, cover=cover
    )


@pytest.mark.quick(3)
@pytest.mark.parametrize("name", sorted(DRAWN))
def test_figures_are_whole_and_say_what_they_are(name: str) -> None:
    draw, words = DRAWN[name]
    text = draw(simulated=True)
    tree = ElementTree.fromstring(text)
    found = "\n".join(item.text or "" for item in tree.iter() if item.tag.endswith("}text"))
    for word in (*words, "simulated"):
        assert word in found
    assert text == draw(simulated=True)  # the same bytes again
    assert "simulated" not in draw(simulated=False)


def test_a_figures_data_are_columns_with_units() -> None:
    text = csv_text({"trial": ["a, b", "c"], "latency (ms)": [1.5, None, 2.5]}, simulated=True)
    rows = list(csv.reader(io.StringIO(text)))
    assert rows == [
        ["trial", "latency (ms)", "simulated"],
        ["a, b", "1.5", "yes"],
        ["c", "", "yes"],
        ["", "2.5", "yes"],
    ]
    assert csv_text({"x (s)": [1]}, simulated=False).splitlines() == ["x (s),simulated", "1,no"]


def test_a_page_escapes_everything_but_its_figures() -> None:
    figure = Figure(SVG, "name", {})
    commands = Table((EVIL, "command"), [[EVIL, f"sliplab view {EVIL}"]], commands=(1,))
    sections = (
        TrialSection(EVIL, {EVIL: 1.0}, EVIL, True, figure),
        FailureSection(1, 2, [(EVIL, 1)], 1, commands, EVIL),
        GeneralisationSection(EVIL),
    )
    page = render(*sections, simulated=True, notices=[EVIL])
    assert "<img" not in page
    assert page.count("&lt;img src=x onerror=alert(1)&gt;") > 9
    assert SVG in page
    assert 'href="figures/name.svg"' in page
    assert 'href="data/name.csv"' in page
    assert '<td class="command"><code>sliplab view ' in page
    torn = render(TrialSection("a", {}, "", False, Figure(SVG), "is cut short"))
    assert "It is not whole: it was salvaged from a file that is cut short." in torn
    plain = render(TrialSection("a", {}, "", False, Figure(SVG)))
    assert "not whole" not in plain
    assert "figures/" not in plain
    assert "imulated" not in plain.split("</style>")[1]
    assert plain.startswith("<!doctype html>")


def test_first_screen_names_failures_and_unmeasured_results_once() -> None:
    none = Table((), [])
    fine = FailureSection(0, 2, [], 1, none, "s")
    assert "<li>Nothing.</li>" in render(fine)
    failed = FailureSection(1, 2, [("gross late", 1)], 1, none, "s")
    page = render(GeneralisationSection("sliplab generalise s"), failed)
    assert '<li><a href="#s2">1 of 2 evaluated trials failed: 1 gross late</a></li>' in page
    assert page.count("Other skins, and levels left out") == 2  # its name and its command
    first, rest = page.split('<a id="unmeasured"></a>')
    assert '<a href="#unmeasured">Not measured: Other skins, and levels left out</a>' in first
    assert "<details><summary>Other skins" in rest
    assert "sliplab generalise s" in rest
    assert '<section id="s1">' not in page


def in_a_page(table: Table) -> str:
    """A page that shows a table."""
    return render(GeneralisationSection("", None, table))


def test_words_read_from_the_left_and_commands_as_code() -> None:
    table = Table(
        ("trial", "cause", "lead (ms)", "none"),
        [["a", "late", "12", ""], ["b", "", "–", "–"], ["c", "early", "-3", ""]],
    )
    assert table.texts == {0, 1}
    page = in_a_page(table)
    assert '<th class="text">cause</th><th>lead (ms)</th>' in page
    assert '<td class="text">late</td><td>12</td>' in page


def test_a_column_with_a_sentence_has_its_heading_on_the_left() -> None:
    sentence = "30 ms windows every 10 ms, one class of two spikes ahead"
    table = Table(("", "detector", "ms"), [["a", sentence, "12"], ["b", "5 ms", "30"]])
    assert table.texts == {0, 1}
    page = in_a_page(table)
    assert '<th class="text">detector</th><th>ms</th>' in page
    assert f'<td class="words">{sentence}</td><td>12</td>' in page
