"""Page of the scene's trade-off, and the sensitivities as Markdown, from stored numbers alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.scene_tradeoff.plot import cost_against_error
from benchmarks.scene_tradeoff.variants import table_rows
from benchmarks.scene_tradeoff.windows import PHASES
from sliplab.analysis.metrics.classification import CLASSES
from sliplab.analysis.report.page import Figure, Table, number, percent, render_page

_HERE = Path(__file__).parent
FAMILIES = {
    "levels": "level of physics",
    "cubic": "L3, cubic path; step (ms)",
    "chord": "L3, straight chords; step (ms)",
}
ERRORS = {
    "first_slip_ms": "first slip (ms)",
    "centre_slip_ms": "centre's slip (ms)",
    "event_median_us": "event time, whole trial,\nmedian (µs)",
    "unmatched": "events without a partner\n(share)",
    "early_p95_us": "event time until gross slip,\n95th percentile (µs)",
    "event_p95_us": "event time, whole trial,\n95th percentile (µs)",
    "flipped": "windows with another label\n(share)",
    "tensor_l1": "L1 distance of samples\n(share)",
}
CONTACT_ONLY = ("first_slip_ms", "centre_slip_ms", "flipped")
COLUMNS = (
    "variant",
    "rows/s",
    "wall (ms)",
    "first slip (ms)",
    "centre (ms)",
    "event median (µs)",
    "95 % until gross (µs)",
    "95 % (µs)",
    "unmatched",
    "labels",
    "samples L1",
)
TERMINAL = ("variant", "wall (ms)", "first slip (ms)", "event median (µs)", "labels", "samples L1")
SENSITIVITY_COLUMNS = (
    "parameter",
    "value",
    "first slip (ms)",
    "first slip (%)",
    "incipient lasts (%)",
    "hold (%)",
    "loading (%)",
    "incipient (%)",
    "gross (%)",
)

Result = Mapping[str, Any]
Error = Mapping[str, float | None]


@dataclass(frozen=True)
class SceneCost:
    """Cost and error of a scene's variants; `cost.html` has the text.

    Attributes:
        trials: ids of the trials that were simulated.
    """

    trials: Sequence[str]
    figure: Figure
    table: Table


def render(result: Result) -> str:
    """Return the page as text; everything in it is escaped but the figures' SVG."""
    found, sensitivity = result["windows"], result.get("sensitivity")
    samples = [
        [name.replace("_", " "), str(found["samples"][name]), percent(found["silent_share"][name])]
        for name in CLASSES
    ]
    rates = [[phase, number(found["events_per_s"][phase], 0)] for phase in PHASES]
    values = {
        **result,
        "cost": scene_cost(result),
        "samples": Table(("class", "samples", "without a signal event"), samples),
        "rates": Table(("phase", "signal events/s"), rates),
        "needs": Table(("effect", "by the twin's pilot"), list(result.get("needs", {}).items())),
        "sensitivity": None,
    }
    if sensitivity is not None:
        values["sensitivity"] = Table(SENSITIVITY_COLUMNS, sensitivity_rows(sensitivity))
        values["sensitivity_text"] = _sensitivity_text(sensitivity)
    return render_page(_HERE / "page.html", **values)


def left_out(falls: bool, closed: int, trials: int) -> list[str]:
    """Return the sentences that say which variants a trade-off leaves out, and why.

    Args:
        falls: a plate may fall in these trials.
        closed: number of trials that have a closed form, of `trials`.
    """
    stated = []
    if falls:
        stated.append(
            "Longer steps are left out: while a plate may fall the scene steps by a millisecond."
        )
    if closed < trials:
        stated.append(
            f"L0 is stated for {closed} of {trials} trials: a retraction that also goes sideways "
            "has no closed form."
        )
    return stated


def scene_cost(result: Result) -> SceneCost:
    """Return figure and table of cost and error."""
    series = {
        title: [
            (row["name"], 1e3 * row["wall_s"], _drawn(family, row["error"]))
            for row in result["variants"]
            if row["family"] == family and row["step_ms"] is not None
        ]
        for family, title in FAMILIES.items()
    }
    lines = {"two seeds of one scene": result["seeds"]} | {
        f"{row['level']}, closed forms ({1e3 * row['wall_s']:.2g} ms)": row["error"]
        for row in result["variants"]
        if row["step_ms"] is None
    }
    svg = cost_against_error(series, ERRORS, lines, "wall time of a trial (ms)", simulated=True)
    return SceneCost(result["trials"], Figure(svg), Table(COLUMNS, tradeoff_rows(result)))


def _drawn(family: str, error: Error) -> Error:
    """Leave out of chords what a camera's path does not move: onsets and labels."""
    return {**error, **dict.fromkeys(CONTACT_ONLY)} if family == "chord" else error


def tradeoff_rows(result: Result) -> list[list[str]]:
    """Return the variants as rows of text under `COLUMNS`, and the error of another seed."""
    rows = []
    for title, row in table_rows(result):
        wall_s, error = row["wall_s"], row["error"]
        wall = "–" if wall_s is None else f"{1e3 * wall_s:.3g}"
        times = (
            "first_slip_ms",
            "centre_slip_ms",
            "event_median_us",
            "early_p95_us",
            "event_p95_us",
        )
        shares = ("unmatched", "flipped", "tensor_l1")
        cells = [*(_short(error[key]) for key in times), *(_share(error[key]) for key in shares)]
        rows.append([title, number(row["rows_per_s"], 0), wall, *cells])
    return rows


def short_table(result: Result) -> tuple[list[str], list[list[str]]]:
    """Return columns and rows of the variants that fit a terminal."""
    retained = [COLUMNS.index(name) for name in TERMINAL]
    return [COLUMNS[k] for k in retained], [
        [row[k] for k in retained] for row in tradeoff_rows(result)
    ]


def choice_pairs(result: Result) -> dict[str, str]:
    """Return both choices of a level, each with its reason, and effects that a pilot requires."""
    names = {"by measured windows": "measured", "by closed forms": "closed_form"}
    choice = result["choice"]
    pairs = {
        name: f"{choice[key]['level']}: {choice[key]['reason']}" for name, key in names.items()
    }
    needs = result.get("needs", {})
    if needs:
        asked = [title for title, verdict in needs.items() if verdict == "asked for"]
        pairs = {"asked for by the twin's pilot": ", ".join(asked) or "no effect", **pairs}
    return pairs


def sensitivity_rows(data: Result) -> list[list[str]]:
    """Return rows of text under `SENSITIVITY_COLUMNS`: change at 20 % less / 20 % more."""
    rows = []
    for row in data["rows"]:
        changes: Sequence[Mapping[str, Any] | None] = row["change"]

        def cell(key: str, phase: str = "", of: Sequence[Any] = changes) -> str:
            values = (None if change is None else change[key] for change in of)
            return " / ".join(_signed(v[phase] if v is not None and phase else v) for v in values)

        names = ("first_slip_ms", "first_slip_percent", "incipient_percent")
        rows.append(
            [
                row["parameter"].split(".", 1)[-1],
                "–" if row["value"] is None else f"{row['value']:g}",
                *(cell(name) for name in names),
                *(cell("percent", phase) for phase in PHASES),
            ]
        )
    return rows


def _sensitivity_text(data: Result) -> list[str]:
    text = render_page(_HERE / "sensitivity.md", **{**data, "phases": PHASES})
    return [" ".join(paragraph.split()) for paragraph in text.split("\n\n")]


def sensitivity_markdown(data: Result) -> str:
    """Return the table of sensitivities as Markdown, its text above it."""
    rows = [list(SENSITIVITY_COLUMNS), ["---", *["--:"] * (len(SENSITIVITY_COLUMNS) - 1)]]
    rows += sensitivity_rows(data)
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    return "\n\n".join(_sensitivity_text(data)) + "\n\n" + "\n".join(lines) + "\n"


def _short(value: float | None) -> str:
    return "–" if value is None else f"{value:.3g}" if value < 1000 else f"{value:.0f}"


def _share(value: float | None) -> str:
    return "–" if value is None else f"{100 * value:.3g} %"


def _signed(value: float | None) -> str:
    if value is None:
        return "–"
    text = f"{value:+.1f}" if abs(value) < 99.95 else f"{value:+.0f}"
    return "0" if float(text) == 0 else text.replace("-", "−")
