"""The hold-out campaign in the report, compared with test trials; it was used for no selection."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

from sliplab.analysis.detectors.latency import summarise_latency, summarise_lead
from sliplab.analysis.metrics.intervals import exact_interval
from sliplab.analysis.report.alarms import QUIET, rate_words
from sliplab.analysis.report.outcomes import trial_intervals, trial_outcome
from sliplab.analysis.report.page import Content, Table, percent, with_interval
from sliplab.analysis.report.seeds import seed_words
from sliplab.protocols.shown import plural
from sliplab.storage.schema.evaluation import AlarmRate, LatencyByOnset, Share
from sliplab.storage.schema.holdout import HoldoutResult
from sliplab.storage.schema.summary import (
    HoldoutSummary,
    HoldoutWindows,
    Kinematic,
    TrialIntervals,
)

COLUMNS = ("figure", "hold-out", "n")
_OUT = {"missed": "missed", "late": "late", "false_early": "false early"}


def holdout_part(found: HoldoutResult) -> HoldoutSummary:
    """Return the part of the summary: all but single trials and dates, with intervals."""
    scored = [row.latency for row in found.rows if row.latency is not None]
    figures = {
        **dict(found.kinematic),
        # results of older versions have medians without missed and late detections
        "latency_ms": summarise_latency(scored),
        "lead_ms": summarise_lead(scored),
    }
    return HoldoutSummary(
        **figures,
        protocol_seed=found.protocol_seed,
        skin_seed=found.skin_seed,
        model=found.model,
        versions=tuple(each.version for each in found.evaluations),
        windows=HoldoutWindows.model_validate(found.windows.to_json()),
        false_alarms=found.false_alarms,
        intervals=trial_intervals([trial_outcome(row) for row in found.rows]),
    )


def holdout_rows(holdout: HoldoutSummary) -> list[list[str]]:
    """Return figures of the hold-out campaign as rows of `COLUMNS`."""
    windows = {"strict": holdout.windows.strict, "argmax": holdout.windows.argmax}
    return _rows(windows, holdout.false_alarms, holdout.latency_ms, holdout.intervals)


@dataclass(frozen=True)
class HoldoutSection(Content):
    """Hold-out and test trials side by side, or how to measure it.

    Attributes:
        command: that measures it; file: which has the dates.
        seeds: that were trained on the store.
    """

    template: ClassVar[str] = "holdout.html"
    holdout: HoldoutSummary | None
    command: str
    file: str
    seeds: str
    table: Table | None

    @property
    def unmeasured(self) -> bool:
        """True where it was not measured."""
        return self.holdout is None


def holdout_section(
    holdout: HoldoutSummary | None, kinematic: Kinematic, command: str, file: str
) -> HoldoutSection:
    """Compare hold-out and test trials."""
    if holdout is None:
        return HoldoutSection(None, command, file, "", None)
    windows = {"strict": kinematic.interval, "argmax": kinematic.window_intervals["accuracy"]}
    quiet = kinematic.false_alarms.get(QUIET)
    test = _rows(windows, quiet, kinematic.latency_ms, kinematic.intervals)
    rows = [[*mine, *theirs[1:]] for mine, theirs in zip(holdout_rows(holdout), test, strict=True)]
    columns = (COLUMNS[0], "hold-out (95 %)", "n", "test trials (95 %)", "n")
    return HoldoutSection(holdout, command, file, seed_words(kinematic.seeds), Table(columns, rows))


def _rows(
    windows: Mapping[str, Share],
    quiet: AlarmRate | None,
    latencies: LatencyByOnset,
    intervals: TrialIntervals,
) -> list[list[str]]:
    rows = []
    titles = {"strict": "windows right, strict", "argmax": "windows right, ties shared"}
    for name, title in titles.items():
        row = windows[name]
        span = None if row.low is None or row.high is None else (100 * row.low, 100 * row.high)
        n = f"{plural(row.trials, 'trial')}, {plural(row.n, 'window')}"
        rows.append([title, _with(percent(row.share), span, 1, "%"), n])
    held = "–" if quiet is None else f"{plural(quiet.clusters, 'trial')}, {quiet.hours:.3f} h"
    rows.append(["false alarms an hour, quiet holding", rate_words(quiet), held])
    for kind, latency in (("incipient", latencies.incipient), ("gross", latencies.gross)):
        known = intervals.of(f"latency_{kind}_ms")
        for statistic in ("median", "mean"):
            value, span = getattr(latency, statistic), getattr(known, statistic)
            all_of = latency.n
            if statistic == "median":  # missed and late ones are in it
                all_of += latency.missed + latency.late
            text = with_interval(value, span, 0, "ms")
            rows.append([f"{kind} latency, {statistic}", text, f"{plural(all_of, 'trial')}"])
        counts = {word: getattr(latency, name) for name, word in _OUT.items()}
        all_of = latency.n + sum(counts.values())
        for word, count in counts.items():
            low, high = exact_interval(count, all_of)
            value = _with(str(count), (100 * low, 100 * high), 1, "%")
            rows.append([f"{kind}: {word}", value, f"{plural(all_of, 'trial')}"])
    return rows


def _with(value: str, span: Sequence[float] | None, digits: int, unit: str) -> str:
    if span is None:
        return value
    return f"{value} ({span[0]:.{digits}f} to {span[1]:.{digits}f} {unit})"
