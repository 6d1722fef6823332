"""The report's failures, trial by trial, each with the command that shows it."""

from __future__ import annotations

import shlex
from collections import Counter
from typing import Any

from sliplab.analysis.report.page import Section, Table, number
from sliplab.flows.reporting.report_trials import WORDS
from sliplab.storage.trials.store import Store

Json = dict[str, Any]

MOST = 60
"""Rows of the table; `summary.json` has all trials."""
_FAILED = ("missed", "false_early", "late", "without_onsets")
"""Outcomes of an incipient detection that are failures, the worst first."""
_GROSS = ("missed", "late", "false_early")
_COLUMNS = (
    "look at the trial", "what went wrong", "incipient latency (ms)", "gross latency (ms)",
    "lead (ms)",
)  # fmt: skip


def section(store: Store, summary: Json) -> Section:
    """Trials that were missed, late, false early or cannot be judged."""
    trials = summary["trials"]
    failed = sorted(
        ((_rank(row), place) for place, row in enumerate(trials) if _wrong(row)),
    )
    known = Counter(row["trial"] for row in trials)
    folder = shlex.quote(str(store.folder.resolve()))
    rows = []
    for _, place in failed[:MOST]:
        row = trials[place]
        command = f"sliplab view {folder} {shlex.quote(row['trial'])}"
        if known[row["trial"]] > 1:
            command += f" --campaign {shlex.quote(row['campaign'])}"
        rows.append(
            [
                command,
                f"{row['campaign']}: {', '.join(_wrong(row))}",
                *(
                    number(row[name], 0)
                    for name in ("latency_incipient_ms", "latency_gross_ms", "lead_ms")
                ),
            ]
        )
    counts = Counter(text for row in trials for text in _wrong(row))
    causes = "; ".join(f"{count} {text}" for text, count in counts.most_common())
    said = [
        f"{len(failed)} of {len(trials)} judged trials failed in some way"
        + (f": {causes}." if causes else "."),
    ]
    if len(failed) > MOST:
        said.append(
            f"The first {MOST} are listed, incipient failures first; `summary.json` has every "
            "trial under `trials`."
        )
    caption = "Click on a command to mark all of it; it opens the trial in Rerun."
    tables = [Table(_COLUMNS, rows, caption, (0,))] if rows else []
    review = [(f"sliplab review {folder}", "goes through the labels of all trials in a browser.")]
    return Section("Failures, trial by trial", said, (), tables, (), review)


def _wrong(row: Json) -> list[str]:
    """What went wrong in a trial, in words."""
    if row["outcome"] == "without_onsets":
        return ["no onset in the label, cannot be judged"]
    found = []
    if row["outcome"] in _FAILED:
        found.append(f"incipient {WORDS[row['outcome']]}")
    if row["gross"] in _GROSS:
        found.append(f"gross {_gross_word(row)}")
    return found


def _gross_word(row: Json) -> str:
    if row["gross"] == "late":
        return f"late, {row['late_gross_ms']:.0f} ms after it ended"
    return WORDS[row["gross"]]


def _rank(row: Json) -> int:
    return _FAILED.index(row["outcome"]) if row["outcome"] in _FAILED else len(_FAILED)
