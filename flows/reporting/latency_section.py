"""The report's words on latency and lead: kinematic slides, falling plates, and disturbed ones."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.metrics.intervals import difference, exact_interval, interval
from sliplab.analysis.report.figures.intervals import Panel, by_condition
from sliplab.analysis.report.figures.style import BLUE, GREEN, ORANGE, RED
from sliplab.analysis.report.page import Figure, Section, Table, number, percent
from sliplab.analysis.report.published import DISTURBANCE_LEAD_STD_MS, PAPER
from sliplab.flows.reporting import clock_words
from sliplab.flows.reporting.detector_section import choice_note
from sliplab.flows.reporting.report_trials import OUTCOMES, VALUES, WORDS, Conditions, values

Json = dict[str, Any]

AXES = {
    "duration_ms": ("incipient slip lasts (ms)", GREEN, ""),
    "latency_incipient_ms": ("incipient latency (ms)", ORANGE, "true onset"),
    "latency_gross_ms": ("gross latency (ms)", RED, "true onset"),
    "lead_ms": ("lead before gross slip (ms)", BLUE, "gross slip"),
}
_NAMES = {
    "duration_ms": "length of incipient slip",
    "latency_incipient_ms": "incipient latency",
    "latency_gross_ms": "gross latency",
    "lead_ms": "lead",
}
_STATISTICS = ("n", "mean", "median", "p95", "std", "min", "max", "missed", "late",
               "false_early")  # fmt: skip
_HEADINGS = ("n", "mean (95 %)", "median (95 %)", "95th percentile (95 %)", "std", "min", "max",
             "missed", "late", "false early")  # fmt: skip
_DOTS = (
    "A dot is a trial, the diamond the mean, the bar its 95 % interval over trials, which may "
    "reach out of the figure"
)
_LATE = {"latency_incipient_ms": "outcome", "lead_ms": "outcome", "latency_gross_ms": "gross"}
"""Which entry of a trial says why a value is missing."""
_LATE_WORDS = (
    "Incipient slip ends where gross slip begins, and gross slip where the plate comes to rest or "
    "the slide ends: a detection from then on is late, and counts neither as latency nor as lead."
)


def kinematic(
    campaigns: list[Collected], evaluation: Json, summary: Json, simulated: bool
) -> Section:
    """How late detections are on kinematic test trials, over all and by each factor's levels."""
    found = Conditions(campaigns, evaluation["trials"], "kinematic")
    groups, breaks = {"all test trials": found.rows}, []
    for factor in found.varied():
        breaks.append(len(groups))
        for text in found.factors[factor]:
            groups[f"{factor} {text}"] = found.level(factor, text)
    shown = ("latency_incipient_ms", "latency_gross_ms")
    lines = {
        "latency_incipient_ms": (PAPER["incipient_latency"].value, "paper's mean, 88 ms"),
        "latency_gross_ms": (PAPER["gross_latency"].value, "paper's mean, 70 ms"),
    }
    picture = _picture(
        groups, shown, breaks, lines, "latency-kinematic",
        f"{_DOTS}. Right of zero is late. All test trials stand on top, then the same trials by "
        f"each factor's levels.{clock_words.figure_note(summary)}",
        "mean latency 88 ms for incipient and 70 ms for gross slip (dotted).", simulated,
    )  # fmt: skip
    table = _statistics(summary, "kinematic", ("incipient", "gross"))
    return Section(
        "Detection latency, kinematic test trials",
        [
            "Detection minus true onset. A detection more than 30 ms before the true onset is a "
            f"false early detection: it is counted, and it has no latency. {_LATE_WORDS}",
            *_late_words("kinematic", summary),
            *_choice(evaluation, campaigns, "kinematic"),
            *(text for name in shown for text in _trends(found, name)),
        ],
        [picture],
        [table, _accounts(summary, "kinematic")],
    )


def gravity(
    campaigns: list[Collected], evaluation: Json, summary: Json, simulated: bool
) -> Section | None:
    """Plates that slip by their own weight, by mass and speed; None without such trials."""
    if not summary["gravity"]["trials"]:
        return None
    found = Conditions(campaigns, evaluation["trials"], "gravity")
    factors = found.varied()[:2]
    groups, breaks = found.cells(factors), found.breaks(factors)
    note = clock_words.figure_note(summary)
    by = " and ".join(factors)
    onsets = _picture(
        groups, ("duration_ms", "latency_incipient_ms"), breaks, {}, "gravity-incipient",
        f"Left: how long incipient slip truly lasts, by {by}; right: how late it is detected. "
        f"{_DOTS}. Where the right is shorter than the left, slip is told before it is gross."
        + note,
        f"incipient latency is {PAPER['incipient_trend'].text}.", simulated,
    )  # fmt: skip
    lead_line = {"lead_ms": (PAPER["gravity_lead"].value, "paper's smallest, 360 ms")}
    gross = _picture(
        groups, ("latency_gross_ms", "lead_ms"), breaks, lead_line, "gravity-gross",
        f"Left: how late gross slip is detected, by {by}; right: how far ahead of it incipient "
        f"slip was. {_DOTS}.{note}",
        f"gross latency has {PAPER['gross_trend'].text}; in every trial incipient slip is "
        "detected at least 360 ms before gross slip (dotted).", simulated,
    )  # fmt: skip
    return Section(
        "Gravity trials: a plate slips by its own weight",
        [
            _lead_words("gravity", summary),
            "Lead is the true gross onset minus the incipient detection. A false early or late "
            f"detection is no lead. {_LATE_WORDS}",
            *_late_words("gravity", summary),
            *_choice(evaluation, campaigns, "gravity"),
            *(text for name in VALUES for text in _trends(found, name)),
        ],
        [onsets, gross],
        [
            _statistics(summary, "gravity", ("incipient", "gross", "lead")),
            _accounts(summary, "gravity"),
            *(_by_level(found, factor) for factor in found.varied()),
        ],
    )


def disturbance(
    campaigns: list[Collected], evaluation: Json, summary: Json, simulated: bool
) -> Section | None:
    """Plates that slip while the sensor is pulled sideways, by level and side."""
    if not summary["disturbance"]["trials"]:
        return None
    found = Conditions(campaigns, evaluation["trials"], "disturbance")
    factors = found.varied()[:2]
    mean = PAPER["disturbance_lead"]
    picture = _picture(
        found.cells(factors), ("latency_incipient_ms", "latency_gross_ms", "lead_ms"),
        found.breaks(factors), {"lead_ms": (mean.value, "paper's mean")}, "disturbance",
        f"By {' and '.join(factors)} of the sideways motion. {_DOTS}. A detector that mistakes the "
        "sideways shear for slip would be early at the higher levels."
        + clock_words.figure_note(summary),
        f"a lead of {mean.text} (dotted: the mean) over all levels.", simulated,
    )  # fmt: skip
    return Section(
        "Disturbance trials: a plate slips while the sensor is pulled sideways",
        [
            _lead_words("disturbance", summary),
            f"Mean and standard deviation of the lead: {_plus_minus(summary)} here, "
            f"{mean.value:.0f} ± {DISTURBANCE_LEAD_STD_MS:.0f} ms in the paper (on its robot).",
            *_late_words("disturbance", summary),
            *_choice(evaluation, campaigns, "disturbance"),
            *(text for name in VALUES for text in _trends(found, name)),
        ],
        [picture],
        [
            _statistics(summary, "disturbance", ("incipient", "gross", "lead")),
            _accounts(summary, "disturbance"),
            *(_by_level(found, factor) for factor in found.varied()),
        ],
    )


def _picture(
    groups: dict[str, list[Json]], shown: Sequence[str], breaks: Sequence[int],
    lines: dict[str, tuple[float | None, str]], name: str, caption: str, paper: str,
    simulated: bool,
) -> Figure:  # fmt: skip
    panels = []
    for quantity in shown:
        label, colour, zero = AXES[quantity]
        value, said = lines.get(quantity, (None, ""))
        panels.append(
            Panel(
                label,
                {row: values(found, quantity) for row, found in groups.items()},
                colour,
                zero,
                None if value is None else (value, said),
                {row: _lacking(found, quantity) for row, found in groups.items()},
            )
        )
    svg = by_condition(list(groups), panels, simulated=simulated, breaks=breaks)
    trials = [(row, trial) for row, found in groups.items() for trial in found]
    data: dict[str, list[object]] = {
        "row": [row for row, _ in trials],
        "trial": [trial["trial"] for _, trial in trials],
    }
    for quantity in shown:
        data[AXES[quantity][0]] = [trial[quantity] for _, trial in trials]
    return Figure(svg, caption, name, data, paper)


def _lacking(rows: Sequence[Json], quantity: str) -> str:
    """How many trials have no value, and why, in short."""
    if not rows:
        return "no trial"
    if quantity not in _LATE:
        count = sum(row[quantity] is None for row in rows)
        return f"{count} without onset" if count else ""
    short = {"missed": "missed", "late": "late", "false_early": "early",
             "without_onsets": "no onset"}  # fmt: skip
    causes = [row[_LATE[quantity]] for row in rows if row[quantity] is None]
    return ", ".join(f"{causes.count(k)} {word}" for k, word in short.items() if k in causes)


def _lead_words(experiment: str, summary: Json) -> str:
    lead, accounts = summary[experiment]["lead_ms"], summary[experiment]["accounted"]
    span = summary[experiment]["intervals"]["lead_ms"]["mean"]
    others = "; ".join(f"{accounts[name]} {WORDS[name]}" for name in OUTCOMES[1:] if accounts[name])
    return (
        f"{accounts['detected_first']} of {accounts['planned']} planned trials were detected "
        f"before gross slip{'; ' + others if others else ''}. The smallest lead is "
        f"{number(lead['min'], 0, 'ms')}, the mean {_with(lead['mean'], span, 0)} ms."
    )


def _late_words(experiment: str, summary: Json) -> list[str]:
    """By how much late detections came after their events; nothing where none was late."""
    words = []
    for kind in ("incipient", "gross"):
        late = [
            row[f"late_{kind}_ms"]
            for row in summary["trials"]
            if row["experiment"] == experiment and row[f"late_{kind}_ms"] is not None
        ]
        if late:
            words.append(f"{kind}: {len(late)}, by {min(late):.0f} to {max(late):.0f} ms")
    return [f"Late after the event: {'; '.join(words)}."] if words else []


def _plus_minus(summary: Json) -> str:
    lead = summary["disturbance"]["lead_ms"]
    return f"{number(lead['mean'], 0)} ± {number(lead['std'], 0, 'ms')}"


def _trends(found: Conditions, name: str) -> list[str]:
    """Whether the mean differs between a factor's first and last level, in one sentence."""
    changes = []
    for factor in found.varied():
        levels = found.factors[factor]
        if len(levels) < 2:
            continue
        first, last = (values(found.level(factor, text), name) for text in (levels[0], levels[-1]))
        span = difference(last, first)
        if span is None or levels[0].endswith(" deg"):  # an angle has no first and last
            continue
        change = sum(last) / len(last) - sum(first) / len(first)
        sure = not span[0] <= 0 <= span[1]
        changes.append(
            f"{levels[0]} to {levels[-1]} {change:+.0f} ms ({span[0]:+.0f} to {span[1]:+.0f}"
            f"{'' if sure else ', not told apart'})"
        )
    if not changes:
        return []
    return [f"Mean {_NAMES[name]}, change with 95 % interval: {'; '.join(changes)}."]


def _by_level(found: Conditions, factor: str) -> Table:
    rows = []
    for text in found.factors[factor]:
        there = found.level(factor, text)
        cells = []
        for name in VALUES:
            known = values(there, name)
            mean = sum(known) / len(known) if known else None
            cells.append(_with(mean, interval(known), 0))
        rows.append([text, str(len(there)), *cells])
    columns = [factor, "trials", *(f"{_NAMES[name]} (ms)" for name in VALUES)]
    return Table(columns, rows, "Means with 95 % intervals over trials.")


def _statistics(summary: Json, experiment: str, kinds: Sequence[str]) -> Table:
    rows = []
    for kind in kinds:
        if kind == "lead":
            name, found, spans = "lead", summary[experiment]["lead_ms"], "lead_ms"
        else:
            name, spans = f"{kind} latency", f"latency_{kind}_ms"
            found = summary[experiment]["latency_ms"][kind]
        known = summary[experiment]["intervals"][spans]
        rows.append(
            [name, *(_with(found[key], known.get(key)) if key in known and key != "n"
                     else number(found[key]) for key in _STATISTICS)]
        )  # fmt: skip
    caption = (
        "Milliseconds; n counts trials. Intervals are over trials: Student's of means, by ranks of "
        "medians (from 6 trials) and percentiles (from 72). "
        f"{clock_words.latency_note(summary)}"
    )
    return Table(("", *_HEADINGS), rows, caption)


def _accounts(summary: Json, experiment: str) -> Table:
    accounts = summary[experiment]["accounted"]
    planned = accounts["planned"]
    row = [experiment, str(planned), *(_counted(accounts[name], planned) for name in OUTCOMES)]
    columns = ("trials", "planned for the test", *(WORDS[name] for name in OUTCOMES))
    caption = "Every planned trial, by its incipient detection; shares with exact 95 % intervals."
    return Table(columns, [row], caption)


def _counted(count: int, planned: int) -> str:
    low, high = exact_interval(count, planned)
    return f"{count} ({100 * low:.0f} to {percent(high, 0)})" if planned else str(count)


def _with(value: float | None, span: Sequence[float] | None, digits: int = 1) -> str:
    if value is None or span is None:
        return number(value, digits)
    return f"{value:.{digits}f} ({span[0]:.{digits}f} to {span[1]:.{digits}f})"


def _choice(evaluation: Json, campaigns: Sequence[Collected], experiment: str) -> list[str]:
    """How smoothing and margin came about, once for each way."""
    names = [item.name for item in campaigns if item.experiment == experiment]
    notes = {choice_note(evaluation["detection"][n]) for n in names if n in evaluation["detection"]}
    return sorted(notes - {""})
