"""The trade-off of a simulated scene for people: a page with plots and tables, and a table in text.

Everything on it comes from the numbers that `flows.searching.tradeoff` wrote, so that the page can
be made again from them alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from sliplab.analysis.metrics.classification import CLASSES
from sliplab.analysis.report.figures import tradeoffs as figures
from sliplab.analysis.report.page import Figure, Section, Table, number, percent, render_page
from sliplab.analysis.sweeps.scene_windows import PHASES

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
    "variant", "rows/s", "wall (ms)", "first slip (ms)", "centre (ms)", "event median (µs)",
    "95 % until gross (µs)", "95 % (µs)", "unmatched", "labels", "samples L1",
)  # fmt: skip
TERMINAL = ("variant", "wall (ms)", "first slip (ms)", "event median (µs)", "labels", "samples L1")
SENSITIVITY_COLUMNS = (
    "parameter", "value", "first slip (ms)", "first slip (%)", "incipient lasts (%)",
    "hold (%)", "loading (%)", "incipient (%)", "gross (%)",
)  # fmt: skip


def render(result: Mapping[str, Any]) -> str:
    """The page as text; everything in it is escaped but the figures' SVG."""
    return render_page(
        "tradeoff_scene.html", make_sections(result), simulated=True,
        protocol=result["protocol"], rig=result["rig"],
    )  # fmt: skip


def make_sections(result: Mapping[str, Any]) -> list[Section]:
    """What the page shows, in order."""
    sections = [_cost(result), _choice(result), _windows(result)]
    if "sensitivity" in result:
        sections.append(_sensitivity(result["sensitivity"]))
    return sections


def tradeoff_rows(result: Mapping[str, Any]) -> list[list[str]]:
    """The variants as rows of text under `COLUMNS`, and what two seeds differ by."""
    rows = []
    for row in result["variants"]:
        name = row["level"]
        if row["step_ms"] is not None:
            name += f" {row['step_ms']} ms {row['path']}"
        if row["family"] == "cubic" and row["step_ms"] == result["rig_step_ms"]:
            continue  # the same run stands among the levels
        rows.append(_row(name, row["rows_per_s"], row["wall_s"], row["error"]))
    rows.append(_row("another seed", None, None, result["seeds"]))
    return rows


def short_table(result: Mapping[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Columns and rows of the variants that fit a terminal."""
    kept = [COLUMNS.index(name) for name in TERMINAL]
    return [COLUMNS[k] for k in kept], [[row[k] for k in kept] for row in tradeoff_rows(result)]


def choice_pairs(result: Mapping[str, Any]) -> dict[str, str]:
    """Both choices of a level, each with its reason."""
    names = {"by measured windows": "measured", "by closed forms": "closed_form"}
    choice = result["choice"]
    return {name: f"{choice[key]['level']}: {choice[key]['reason']}" for name, key in names.items()}


def _row(
    name: str, rows_per_s: float | None, wall_s: float | None, error: Mapping[str, float | None]
) -> list[str]:
    return [
        name,
        number(rows_per_s, 0),
        "–" if wall_s is None else f"{1e3 * wall_s:.3g}",
        *(_short(error[key]) for key in ("first_slip_ms", "centre_slip_ms")),
        *(_short(error[key]) for key in ("event_median_us", "early_p95_us", "event_p95_us")),
        *(_share(error[key]) for key in ("unmatched", "flipped", "tensor_l1")),
    ]


def _cost(result: Mapping[str, Any]) -> Section:
    picture = figures.cost_against_error(
        _series(result), ERRORS, _lines(result), "wall time of a trial (ms)", simulated=True
    )
    trials = len(result["trials"])
    return Section(
        "Cost and error",
        [
            f"Mean of {trials} trials of the plan, spread over its conditions: "
            f"{'; '.join(result['trials'])}. Errors are against L3 at steps of 1 ms with cubic "
            "paths, with the same seeds, without noise and before the camera's read-out; wall "
            "times are of the whole trial as the rig file has it, pictures left out.",
            *result["left_out"],
        ],
        [
            Figure(
                picture,
                "A hollow mark has no error at all. Straight chords differ from cubic paths in "
                "events alone. Below the dashed line a variant is nearer to "
                "the reference than the same scene is to itself with another seed.",
            )
        ],
        [
            Table(
                COLUMNS,
                tradeoff_rows(result),
                "Onsets of L0 are closed forms with even friction; its labels are told by slips "
                "of tips, those of the others by markers. Event times are stamps of whole "
                "microseconds; the nth event of a pixel and polarity is held against the nth one.",
            )
        ],
    )


def _series(
    result: Mapping[str, Any],
) -> dict[str, list[tuple[str, float, Mapping[str, float | None]]]]:
    """Points of the picture by family; what has no run stands among the lines."""
    return {
        title: [
            (row["name"], 1e3 * row["wall_s"], _drawn(family, row["error"]))
            for row in result["variants"]
            if row["family"] == family and row["step_ms"] is not None
        ]
        for family, title in FAMILIES.items()
    }


def _drawn(family: str, error: Mapping[str, float | None]) -> Mapping[str, float | None]:
    """The path between rows is the camera's: it moves no onset and no label."""
    return {**error, **dict.fromkeys(CONTACT_ONLY)} if family == "chord" else error


def _lines(result: Mapping[str, Any]) -> dict[str, Mapping[str, float | None]]:
    lines: dict[str, Mapping[str, float | None]] = {"two seeds of one scene": result["seeds"]}
    for row in result["variants"]:
        if row["step_ms"] is None:
            lines[f"{row['level']}, closed forms ({1e3 * row['wall_s']:.2g} ms)"] = row["error"]
    return lines


def _choice(result: Mapping[str, Any]) -> Section:
    choice = result["choice"]
    measured, reckoned = choice["measured"], choice["closed_form"]
    verdict = (
        "Both agree."
        if choice["agree"]
        else "They do not agree: closed forms hold each onset against two seeds, and both must "
        "pass; labels take both onsets together, and samples cut into milliseconds have little in "
        "common as soon as anything moved."
    )
    return Section(
        "The level that the protocol needs",
        [
            f"By measured windows: {measured['level']}. {measured['reason']}.",
            f"By closed forms, which is what a plan goes by: {reckoned['level']}. "
            f"{reckoned['reason']}.",
            verdict,
        ],
    )


def _windows(result: Mapping[str, Any]) -> Section:
    found = result["windows"]
    names = [name.replace("_", " ") for name in CLASSES]
    samples = [
        [
            names[k],
            str(found["samples"][name]),
            percent(found["silent_share"][name]),
        ]
        for k, name in enumerate(CLASSES)
    ]
    rates = [[phase, number(found["events_per_s"][phase], 0)] for phase in PHASES]
    hold, ceiling = found["hold_share"], found["ceiling"]
    return Section(
        "What the samples hold",
        [
            f"h = {number(hold, 3)} of the no-slip samples end before the motion begins. Where "
            "steady sliding is silent, silence is all that tells them from gross slip, and "
            f"accuracy cannot pass 1 - h/3 = {number(ceiling, 3)}. The share of gross samples "
            "without a single signal event says how near this scene is to that."
        ],
        tables=[
            Table(("class", "samples", "without a signal event"), samples),
            Table(
                ("phase", "signal events/s"),
                rates,
                "Of the protocol's polarity, inside its crop, noise left out.",
            ),
        ],
    )


def sensitivity_rows(data: Mapping[str, Any]) -> list[list[str]]:
    """Rows of text under `SENSITIVITY_COLUMNS`: change at 20 % less / 20 % more."""
    rows = []
    for row in data["rows"]:
        lower, higher = [*row["change"], None][:2]
        single = len(row["change"]) == 1

        def cell(*keys: str, change: Sequence[Any] = (lower, higher), one: bool = single) -> str:
            shown = []
            for value in change[: 1 if one else 2]:
                for key in keys:
                    value = None if value is None else value[key]
                shown.append(_signed(value))
            return " / ".join(shown)

        rows.append([
            row["parameter"].split(".", 1)[-1],
            "–" if row["value"] is None else f"{row['value']:g}",
            cell("first_slip_ms"), cell("first_slip_percent"), cell("incipient_percent"),
            *(cell("percent", phase) for phase in PHASES),
        ])  # fmt: skip
    return rows


def _sensitivity_words(data: Mapping[str, Any]) -> list[str]:
    base = data["base"]
    rates = ", ".join(f"{phase} {number(base['events_per_s'][phase], 0)}" for phase in PHASES)
    return [
        f"Change at {100 * data['change']:.0f} % less / {100 * data['change']:.0f} % more of each "
        f"number (simulated). Onsets: mean of {data['contact_trials']} trials, first slip "
        f"{number(base['first_slip_s'], 3)} s after the start, incipient slip lasts "
        f"{number(base['incipient_s'], 3)} s. Event rates: {data['event_trials']} trials with "
        f"noise and read-out, positive events in the crop a second: {rates}.",
        "Seeds are the same on both sides, so that small changes are real. Poisson's ratio goes no "
        "higher than 0.499; what is switched off has a dash. The last row is the mean change by "
        "another seed of the same trials, for scale.",
    ]


def _sensitivity(data: Mapping[str, Any]) -> Section:
    table = Table(SENSITIVITY_COLUMNS, sensitivity_rows(data))
    return Section("What the guesses decide", _sensitivity_words(data), tables=[table])


def sensitivity_markdown(data: Mapping[str, Any]) -> str:
    """The table of sensitivities as Markdown, with what it says above it."""
    rows = [list(SENSITIVITY_COLUMNS), ["---", *["--:"] * (len(SENSITIVITY_COLUMNS) - 1)]]
    rows += sensitivity_rows(data)
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    return "\n\n".join(_sensitivity_words(data)) + "\n\n" + "\n".join(lines) + "\n"


def _short(value: float | None) -> str:
    return "–" if value is None else f"{value:.3g}" if value < 1000 else f"{value:.0f}"


def _share(value: float | None) -> str:
    return "–" if value is None else f"{100 * value:.3g} %"


def _signed(value: float | None) -> str:
    if value is None:
        return "–"
    text = f"{value:+.1f}" if abs(value) < 99.95 else f"{value:+.0f}"
    return "0" if float(text) == 0 else text.replace("-", "−")
