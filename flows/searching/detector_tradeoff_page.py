"""The detector's trade-off for people: tables and plots, made from its numbers alone."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sliplab.analysis.report.figures.tradeoffs import (
    Bar,
    Panel,
    Point,
    factor_lines,
    front_panels,
)
from sliplab.analysis.report.page import Figure, Section, Table, number, percent, render_page
from sliplab.flows.searching.detector_tradeoff_compare import FACTORS
from sliplab.flows.searching.detector_tradeoff_rows import (
    LOOSE,
    MOST_MISSED,
    OBJECTIVES,
    Row,
    mean,
    objective,
    short_list,
)
from sliplab.flows.searching.detector_tradeoff_text import (
    COLUMNS,
    cells,
    distinct,
    format_difference,
    front_rows,
    hundred,
    ordered_front,
    scaled,
    seed_range,
    spread,
)

MOST_ROWS = 40
"""Of the front on the page; the table as CSV has all."""

PANELS = (
    Panel("mean_ms", "strict", "mean incipient latency (ms)", "strict accuracy (%)"),
    Panel(
        "mean_ms", "false_early_either", "mean incipient latency (ms)", "false early trials (%)"
    ),
    Panel(
        "synaptic_operations_per_s", "strict", "synaptic operations/s (million)",
        "strict accuracy (%)", True,
    ),
    Panel(
        "synaptic_operations_per_s", "mean_ms", "synaptic operations/s (million)",
        "mean incipient latency (ms)", True,
    ),
    Panel(
        "us_per_s", "p95_ms", "computing time (ms a second, one thread)",
        "95th percentile latency (ms)", True,
    ),
    Panel("us_per_s", "lost_either", "computing time (ms a second, one thread)",
          "missed or late trials (%)", True),
)  # fmt: skip
DRAWN = {
    **dict.fromkeys(("strict", "false_early_either", "lost_either"), 100.0),
    "us_per_s": 1e-3,
    "synaptic_operations_per_s": 1e-6,
}
"""By what figures are multiplied in the plots."""


def render(result: Mapping[str, Any]) -> str:
    """The page as text; everything in it is escaped but the figures' SVG."""
    return render_page(
        "detector_tradeoff.html", make_sections(result), simulated=result["simulated"],
        kept=result["kept"], runs=result["runs"],
    )  # fmt: skip


def make_sections(result: Mapping[str, Any]) -> list[Section]:
    """What the page shows, in order."""
    sections = [_tried(result)]
    if result["rows"]:
        sections += [_short_list(result), _front(result), _plots(result), _factors(result)]
        sections += [_cross(result), _pairs(result)]
    return [section for section in sections if section.tables or section.figures or section.text]


def _tried(result: Mapping[str, Any]) -> Section:
    ask, trials = result["ask"], result["trials"]
    cross = (
        "every value of the four factors with every other"
        if result["full"]
        else "each of the four factors alone with the others at the paper's values, and pooling "
        "crossed with the shortest and the longest window; the other crosses were not tried "
        "(`--full` tries them)"
    )
    text = [
        f"{len(result['settings'])} settings of window length, step, pooling and width were "
        f"trained with {ask['seeds']} seeds: {cross}. {result['kept']} of {result['runs']} "
        f"trainings are there. Each learned from {ask['samples']} windows of {trials['train']} "
        f"trials in at most {ask['epochs']} epochs, less than the store's own network: figures "
        "say how settings differ, not how good each could become.",
        "Stride, precision, smoothing and margin were read off the same networks. The paper's "
        "pair is 4 windows and 2 spikes for each of a class's output neurons; chosen pairs are "
        "those with the lowest median latency on "
        f"{trials['validation']} validation trials of which at most "
        f"{percent(result['false_early_rate'], 0)} are false early and as many missed or late, "
        f"for either onset; or at most {percent(LOOSE, 0)}. Figures are "
        f"of {trials['test']} test trials, means over seeds.",
        "Windows of every length lie in the same stretches of a trial. Width is a factor on the "
        "channels of both convolutions and on the hidden neurons.",
    ]
    if result["pending"]:
        text.append(
            f"{result['pending']} trainings are still to be made: the same command goes on there."
        )
    left_out = [[name, why] for name, why in result["left_out"].items()]
    warned = [[name, "; ".join(each)] for name, each in result["warnings"].items()]
    tables = [Table(("left out", "why"), left_out)] if left_out else []
    tables += [Table(("network", "warning"), warned)] if warned else []
    return Section("What was tried", text, (), tables)


def _front(result: Mapping[str, Any]) -> Section:
    rows = distinct(result["rows"])
    on = sum(row["front"] for row in rows)
    both = sum(row["front"] and row["front_validation"] for row in rows)
    paper = next((row for row in rows if row["paper"]), None)
    text = [
        f"{on} of {len(rows)} detectors are on the front: none of the others is nowhere worse and "
        "somewhere better in strict accuracy, mean and 95th percentile latency, false early and "
        "missed or late trials, computing time and synaptic operations a second. Work counts by "
        "the second, because a shorter stride has more windows.",
        f"{both} of them (✓) are also on the front of validation trials. A detector that is on it "
        "by test trials alone may be there by luck.",
    ]
    if paper is not None:
        text.append(
            "The paper's detector (★) is on the front."
            if paper["front"]
            else "The paper's detector (★) is not on the front."
        )
    columns, table = list(COLUMNS), front_rows(result, MOST_ROWS)
    caption = (
        "Network: window/step, pooling, width. In brackets lowest and highest over seeds. Latency "
        "is of counted detections of incipient slip; false early, and missed or late, are shares "
        "of trials, for either onset (false early in brackets: incipient, gross). µs: one thread, "
        "one window at a time and in a batch."
    )
    if on > MOST_ROWS:
        caption += f" The first {MOST_ROWS} by latency; the CSV has all."
    if result["trials"]["falling"]:
        shown = ordered_front(result, MOST_ROWS)
        leads = [number(mean(row["falling"]["lead_min_ms"]), 0) for row in shown]
        columns.append("shortest lead (ms)")
        table = [[*cells, lead] for cells, lead in zip(table, leads, strict=True)]
        caption += " Lead: of gravity and disturbance trials, counted detections."
    else:
        text.append("The store has no labelled gravity or disturbance trials: no leads.")
    return Section("The Pareto front", text, (), [Table(columns, table, caption)])


def _short_list(result: Mapping[str, Any]) -> Section:
    rows = [[percent(budget, 0), *cells(row)] for budget, row in short_list(result["rows"])]
    text = [
        "The front is long, because it has seven figures. For each share of trials that may be "
        "false early (either onset), this is the detector with the lowest mean latency of those "
        f"that keep it and miss at most {percent(MOST_MISSED, 0)}, late ones among them. "
        "Validation trials picked it; figures are of test trials, which may be over the budget.",
    ]
    if not rows:
        text.append("No detector keeps any of the budgets.")
    tables = [Table(("budget", *COLUMNS), rows)] if rows else []
    return Section("A short list", text, (), tables)


def _plots(result: Mapping[str, Any]) -> Section:
    def values(row: Row) -> dict[str, float | None]:
        found = {name: objective(row, name) for name in OBJECTIVES}
        for name, scale in DRAWN.items():
            value = found[name]
            found[name] = None if value is None else scale * value
        return found

    points = [Point(values(row), row["front"], row["paper"]) for row in result["rows"]]
    svg = front_panels(points, PANELS, simulated=result["simulated"])
    return Section(
        "Speed, work and error",
        [],
        [Figure(svg, "A point of the front need not look best in two figures: there are seven.")],
    )


def _factors(result: Mapping[str, Any]) -> Section:
    bars: dict[str, list[Bar]] = {title: [] for title in FACTORS.values()}
    table = []
    for item in result["comparisons"]:
        row, title = result["rows"][item["row"]], FACTORS[item["factor"]]
        ranges = {
            "strict": seed_range(row["test"]["strict"], 100),
            "mean_ms": seed_range(row["test"]["mean_ms"], 1),
        }
        value = f"{item['value']:g}" if not isinstance(item["value"], str) else item["value"]
        bars[title].append(Bar(value, item["paper"], ranges))
        found = item["difference"]
        if item["paper"] or found is None:
            shown = ["paper's" if item["paper"] else "–"] * 3
        else:
            shown = [
                format_difference(found["strict"], 100, "points"),
                format_difference(found["mean_ms"], 1, "ms"),
                format_difference(found["false_early_either"], 100, "points"),
            ]
        table.append(
            [f"{title}: {value}", spread(row["test"]["strict"], 100, 1),
             spread(row["test"]["mean_ms"], 1, 0), *shown]
        )  # fmt: skip
    drawn = {title: each for title, each in bars.items() if each}
    figures = {"strict": "strict accuracy (%)", "mean_ms": "mean latency (ms)"}
    svg = factor_lines(drawn, figures, simulated=result["simulated"])
    seeds = max((len(row["seeds"]) for row in result["rows"]), default=0)
    text = [
        "One factor at a time, the others at the paper's values, with the pair that validation "
        "trials chose and, but for the line of strides, at a stride of a window's length.",
        "Differences are taken seed by seed, with Student's 95 % interval over seeds. 'More than "
        "seeds' says that it leaves zero out; each stands by itself, so one in twenty would by "
        "chance. All seeds are judged on the same trials, whose luck no seed shows."
        if seeds > 1
        else "With one seed nothing can be said of what is more than seed noise.",
    ]
    return Section(
        "One factor at a time",
        text,
        [Figure(svg, "Bars: lowest to highest seed. The star is the paper's value.")],
        [
            Table(
                ("factor", "strict (%)", "mean latency (ms)", "strict, difference",
                 "latency, difference", "false early, difference"),
                table,
            )
        ],
    )  # fmt: skip


def _cross(result: Mapping[str, Any]) -> Section:
    """Length by pooling."""
    there = {
        (row["length_ms"], row["pool_px"]): row
        for row in result["rows"]
        if row["precision"] == "trained" and row["rule"] == "chosen"
        and row["stride_ms"] == row["length_ms"] and row["step_ms"] == 1 and row["width"] == 1
    }  # fmt: skip
    lengths = sorted({length for length, _ in there})
    pools = sorted({pool for _, pool in there})
    rows = []
    for length in lengths:
        cells = [f"{length} ms"]
        for pool in pools:
            row = there.get((length, pool))
            cells.append(
                "–"
                if row is None
                else f"{hundred(mean(row['test']['strict']))} %, "
                f"{number(mean(row['test']['mean_ms']), 0)} ms, "
                f"{scaled(mean(row['work']['synaptic_operations_per_s']), 1e6)} M/s"
            )
        rows.append(cells)
    columns = ["window", *(f"cells of {pool} px" for pool in pools)]
    caption = "Strict accuracy, mean latency, synaptic operations a second; steps of 1 ms, ×1."
    return Section("Window length and pooling", (), (), [Table(columns, rows, caption)])


def _pairs(result: Mapping[str, Any]) -> Section:
    pairs = {(row["smoothing"], row["margin"]): row for row in result["pairs"]}
    margins = sorted({margin for _, margin in pairs})
    rows = [
        [
            f"{smoothing}",
            *(
                f"{number(pairs[smoothing, margin]['mean_ms'], 0)} ms, "
                f"{hundred(pairs[smoothing, margin]['false_early_either'], 0)} / "
                f"{hundred(pairs[smoothing, margin]['lost_either'], 0)} %"
                for margin in margins
            ),
        ]
        for smoothing in sorted({smoothing for smoothing, _ in pairs})
    ]
    columns = ["windows", *(f"margin {margin:g}" for margin in margins)]
    caption = "Mean incipient latency; false early / missed or late test trials (either onset)."
    return Section(
        "Smoothing and margin with the paper's windows",
        ["30 ms windows, one after the other: every pair, on test trials."],
        (),
        [Table(columns, rows, caption)] if rows else (),
    )
