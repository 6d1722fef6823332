"""The report's words on detectors: each at the same rate of false early detections."""

from __future__ import annotations

from typing import Any

from sliplab.analysis.report.figures.tradeoffs import latency_over_rate
from sliplab.analysis.report.page import Figure, Section, Table, number, percent

_WORDS = {
    "smoothing": "paper's rule",
    "smoothing chosen": "paper's rule, window chosen",
    "hmm histograms": "hidden Markov, histograms",
    "hmm counts": "hidden Markov, counts",
    "hmm counts and events": "hidden Markov, counts and events",
    "cusum histograms": "CUSUM, histograms",
    "cusum counts": "CUSUM, counts",
    "cusum counts and events": "CUSUM, counts and events",
}
_PAPER = ("smoothing", "smoothing chosen")

_COLUMNS = (
    "detector",
    "stride (ms)",
    "false early in validation",
    "false early in test (95 %)",
    "incipient, median / 95 % (ms)",
    "missed, late",
    "gross, median (ms); missed, late",
    "lead, median (ms)",
)


def choice_note(settings: dict[str, Any]) -> str:
    """How smoothing and margin were chosen, in words; nothing where the protocol says them.

    Args:
        settings: a campaign's entry of the evaluation's ``detection``.
    """
    if settings["choose"] == "validation":
        return "Smoothing and margin were chosen by validation trials."
    if settings["choose"] == "test":
        return (
            "Smoothing and margin were chosen by the kinematic test trials themselves, as in the "
            "paper: what is measured on them flatters."
        )
    return ""


def section(evaluation: dict[str, Any], simulated: bool) -> Section | None:
    """The comparison; None where there is none."""
    compared = evaluation["detectors"]
    if compared is None:
        return None
    entries = [(entry, "") for entry in compared["detectors"]]
    entries += [(entry, ", states carried") for entry in compared.get("carried", ())]
    trials = compared["trials"]
    smoothing = entries[0][0]["rates"][0]["choice"]
    panels = {
        _panel(stride, compared["strides_ms"]): {
            _WORDS[entry["name"]] + ending: [
                (point["rate"], point["median_ms"]) for point in entry["curve"]
            ]
            for entry, ending in entries
            if entry["stride_ms"] == stride
        }
        for stride in sorted(compared["strides_ms"], reverse=True)
    }
    return Section(
        "Detectors at equal rates of false early detections",
        [
            "A detector can be made as quick as one likes by letting it cry slip more often. So "
            f"each one's level is set by the {trials['validation']} validation trials, as low as "
            "lets no more of them be false early than allowed, and it is then judged on "
            f"{trials['test']} test trials; filters and tests learned from {trials['train']} "
            "training trials. Nothing was chosen by a test trial. The paper's rule averages "
            f"{smoothing} windows; its margin is the level.",
            *_best(entries),
            "Intervals are Clopper and Pearson's: with so few trials the rate that a level really "
            "has is known no better. Test rates above the asked one are to be expected.",
        ],
        [
            Figure(
                latency_over_rate(panels, simulated=simulated),
                "Median latency of each detector over how often it may cry slip too early; each "
                "mark is one more validation trial that may be false early. Lower is quicker at "
                "the same rate; the grey and black lines are the paper's rule.",
                "detectors",
                _points(panels),
                "only its own rule, with a window chosen by mean latency on its test trials.",
            )
        ],
        _tables(entries, trials["validation"]),
    )


def _points(panels: dict[str, dict[str, list[tuple[float, Any]]]]) -> dict[str, list[object]]:
    rows = [
        (title, name, rate, late)
        for title, lines in panels.items()
        for name, points in lines.items()
        for rate, late in points
    ]
    return {
        "stride": [row[0] for row in rows],
        "detector": [row[1] for row in rows],
        "false early, validation trials (share)": [row[2] for row in rows],
        "median incipient latency, test trials (ms)": [row[3] for row in rows],
    }


def _panel(stride: int, strides: list[int]) -> str:
    return f"every {stride} ms" if stride < max(strides) else f"every {stride} ms, no overlap"


def _tables(entries: list[tuple[dict[str, Any], str]], trials: int) -> list[Table]:
    """One table for each number of trials that may be false early."""
    rates: dict[int, list[int]] = {}
    for place, rate in enumerate(entries[0][0]["rates"]):
        rates.setdefault(rate["allowed"], []).append(place)
    tables = []
    for allowed, places in rates.items():
        asked = " or ".join(percent(entries[0][0]["rates"][place]["asked"]) for place in places)
        bound = f"at most {allowed}" if allowed else "less than one trial, so none"
        caption = f"{asked} of {trials} validation trials false early: {bound}."
        rows = [
            [
                _WORDS[entry["name"]] + ending,
                str(entry["stride_ms"]),
                *_cells(entry["rates"][places[0]]),
            ]
            for entry, ending in entries
        ]
        tables.append(Table(_COLUMNS, rows, caption))
    return tables


def _cells(rate: dict[str, Any]) -> list[str]:
    test = rate["test"]
    incipient, gross = (test["latency_ms"][kind] for kind in ("incipient", "gross"))
    share = test["false_early_rate"]
    return [
        str(rate["validation"]["latency_ms"]["incipient"]["false_early"]),
        f"{incipient['false_early']} ({100 * share['low']:.0f} to {percent(share['high'], 0)})",
        f"{number(incipient['median'], 0)} / {number(incipient['p95'], 0)}",
        _lost(incipient),
        f"{number(gross['median'], 0)}; {_lost(gross)}",
        number(test["lead_ms"]["median"], 0),
    ]


def _lost(found: dict[str, Any]) -> str:
    return f"{found['missed']}, {found['late']}"


def _best(entries: list[tuple[dict[str, Any], str]]) -> list[str]:
    """The one that validation trials find quickest, beside the paper's rule, at the last rate."""
    rule = entries[0][0]["rates"][-1]
    others = [
        (entry["rates"][-1]["validation"]["median_with_missed_ms"], place)
        for place, (entry, _) in enumerate(entries)
        if entry["name"] not in _PAPER
    ]
    there = [(late, place) for late, place in others if late is not None]
    theirs = rule["test"]["median_with_missed_ms"]
    if not there or theirs is None:
        return []
    best, ending = entries[min(there)[1]]
    found = best["rates"][-1]["test"]
    if found["median_with_missed_ms"] is None:
        return []
    return [
        f"With {rule['allowed']} false early validation trials allowed, validation trials find "
        f"this one quickest: {_WORDS[best['name']]}{ending}, every {best['stride_ms']} ms. On test "
        f"trials its median incipient latency is {number(found['median_with_missed_ms'], 0, 'ms')} "
        f"({found['latency_ms']['incipient']['false_early']} false early), that of the paper's "
        f"rule {number(theirs, 0, 'ms')} ({rule['test']['latency_ms']['incipient']['false_early']} "
        "false early)."
    ]
