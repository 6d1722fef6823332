"""The report's words on the campaign that nothing was chosen by, beside the test trials."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sliplab.analysis.metrics.intervals import exact_interval
from sliplab.analysis.report.page import Section, Table, number, percent
from sliplab.flows.reporting.report_extras import FILES, command, odd_shape
from sliplab.flows.reporting.report_trials import intervals, trial_summary
from sliplab.storage.trials.store import Store

Json = dict[str, Any]

TITLE = "Another skin and seed, which chose nothing"
COLUMNS = ("figure", "hold-out", "n")
_SHARES = {"strict": "windows right, strict", "argmax": "windows right, ties shared"}
_KINDS = ("incipient", "gross")
_OUT = {"missed": "missed", "late": "late", "false_early": "false early"}


def part(found: Json) -> Json:
    """The part of the summary: all but single trials and dates, with intervals."""
    rows = [trial_summary(row) for row in found["rows"]]
    return {
        **{name: found[name] for name in ("trials", "protocol_seed", "skin_seed", "model")},
        "versions": [each["version"] for each in found["evaluations"]],
        "windows": found["windows"],
        **found["kinematic"],
        "intervals": intervals(rows),
    }


def rows_of(found: Json) -> list[list[str]]:
    """Figures of the hold-out campaign as rows of `COLUMNS`."""
    return _rows(part(found), {name: found["windows"][name] for name in _SHARES})


def section(store: Store, found: Json | None, summary: Json) -> Section:
    """Hold-out and test trials side by side; how to measure it where it is not.

    Raises:
        StoreError: the file is of another shape.
    """
    if found is None:
        return Section(
            TITLE,
            ["Not measured in this store. It takes a minute or two:"],
            commands=[(command(store, "holdout"), "makes it.")],
        )
    try:
        return _made(found, summary)
    except (KeyError, TypeError, AttributeError) as error:
        raise odd_shape("holdout", error) from None


def _made(found: Json, summary: Json) -> Section:
    kinematic = summary["kinematic"]
    theirs = {"strict": kinematic["interval"], "argmax": kinematic["window_intervals"]["accuracy"]}
    test = _rows(kinematic, theirs)
    table = [
        [name, value, n, *others[1:]]
        for (name, value, n), others in zip(rows_of(found), test, strict=True)
    ]
    times = len(found["evaluations"])
    said = [
        "Test trials have judged every change of the program, so its design is a little what they "
        f"liked. These {found['trials']} slides have another skin (seed {found['skin_seed']}) and "
        f"another seed of their own ({found['protocol_seed']}), which nothing else uses: network, "
        "smoothing and margin are those of this store as they are, and nothing was chosen by them. "
        f"They were judged {times} time{'s' if times > 1 else ''} here, by version"
        f"{'s' if times > 1 else ''} {', '.join(e['version'] for e in found['evaluations'])}; "
        f"the dates stand in `{FILES['holdout']}`.",
        "The skin is one more of the same design: between two skins figures differ by more than "
        "these intervals, which are over trials of one.",
    ]
    columns = (COLUMNS[0], "hold-out (95 %)", "n", "test trials (95 %)", "n")
    caption = "Intervals are over trials; counts have exact ones. Times are of counted detections."
    return Section(TITLE, said, (), [Table(columns, table, caption)])


def _rows(kinematic: Json, shares: dict[str, Json]) -> list[list[str]]:
    rows = []
    for name, title in _SHARES.items():
        row = shares[name]
        span = None if row["low"] is None else (100 * row["low"], 100 * row["high"])
        n = f"{row['trials']} trials, {row['n']} windows"
        rows.append([title, _with(percent(row["share"]), span, 1, "%"), n])
    for kind in _KINDS:
        latency = kinematic["latency_ms"][kind]
        known = kinematic["intervals"][f"latency_{kind}_ms"]
        for statistic in ("median", "mean"):
            value = _with(number(latency[statistic], 0, "ms"), known[statistic], 0, "ms")
            rows.append([f"{kind} latency, {statistic}", value, f"{latency['n']} trials"])
        all_of = latency["n"] + sum(latency[name] for name in _OUT)
        for name, word in _OUT.items():
            low, high = exact_interval(latency[name], all_of)
            value = _with(str(latency[name]), (100 * low, 100 * high), 1, "%")
            rows.append([f"{kind}: {word}", value, f"{all_of} trials"])
    return rows


def _with(value: str, span: Sequence[float] | None, digits: int, unit: str) -> str:
    if span is None:
        return value
    return f"{value} ({span[0]:.{digits}f} to {span[1]:.{digits}f} {unit})"
