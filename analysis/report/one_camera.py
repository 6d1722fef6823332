"""The report on a rig with one camera: its results, and those that need the other camera."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from sliplab.analysis.campaigns import Collected, missing_stream
from sliplab.analysis.evaluation.evaluation import evaluation_of
from sliplab.analysis.labels import label_errors
from sliplab.analysis.labels.reviewed import StoreLabels as KeptLabels
from sliplab.analysis.report import clocks
from sliplab.analysis.report.campaign import collected_section, quality_section, references_of
from sliplab.analysis.report.cover import Cover, quality_notices, slip_answer
from sliplab.analysis.report.figures.campaign import rates_over_motion
from sliplab.analysis.report.labels import label_section
from sliplab.analysis.report.page import Content, Figure, Number, Rendered, Table, number
from sliplab.analysis.report.plugin_sections import ReportData, plugin_sections, sections_key
from sliplab.analysis.report.registration import registration_key, registration_section
from sliplab.analysis.report.skins import skin_section
from sliplab.analysis.report.sources import VERSION
from sliplab.analysis.report.summary import (
    label_sources,
    package_versions,
    planned_part,
    protocol_hashes,
    quality_part,
    sync_part,
)
from sliplab.analysis.report.tiles import slip_tiles
from sliplab.analysis.windows.dataset import recorded_span
from sliplab.protocols.shown import plural
from sliplab.storage.schema.summary import LabelSummary, MotionRate, OneCameraSummary, StepLeftOut
from sliplab.storage.trials.derived import make_key
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import StoreError, TrialStore

F64 = npt.NDArray[np.float64]
BEFORE_S, BIN_S = 1.0, 0.1
"""Drawn time before the motion, and the interval over which a rate is taken."""
NO_LABELS = "not done yet; run `sliplab label`"
NO_CLASSIFIER = "not done yet; run `sliplab train`, then `sliplab evaluate`"


def is_evaluated(store: TrialStore, campaigns: Sequence[Collected]) -> bool:
    """Check that the spiking network was evaluated on trials without frames."""
    if missing_stream(list(campaigns)) != "frames" or not has_labels(store, campaigns):
        return False
    try:
        evaluation_of(store)
    except StoreError:
        return False
    return True


def has_labels(store: TrialStore, campaigns: Sequence[Collected]) -> bool:
    """Check that every trial has its label."""
    labels = KeptLabels(store)
    return all(labels.fresh(item, trial) for item in campaigns for _, trial in item.trials)


def one_camera_key(
    store: TrialStore, campaigns: list[Collected], evaluations: Sequence[str] = ()
) -> str:
    """Return the key of all inputs of the report.

    Args:
        evaluations: keys of those that it shows.

    Raises:
        StoreError: there are frames, and a trial has no label yet.
    """
    labels, inputs = KeptLabels(store), []
    frames = missing_stream(campaigns) == "events"
    labelled = frames or has_labels(store, campaigns)
    for item in campaigns:
        for trial, recording in item.trials:
            if frames and not labels.fresh(item, recording):
                raise StoreError(f"{item.name}: {trial.id} has no label yet; run `sliplab label`")
            label = labels.key(item, recording) if labelled else None
            inputs.append([item.name, trial.id, recording.checksum, label])
    inputs += [[key] for key in evaluations]
    plans = [
        [item.title, item.question, item.planned.collection_hash, len(item.campaign.quarantined())]
        for item in campaigns
    ]
    besides = [*sections_key(store, campaigns), *registration_key(store, campaigns)]
    return make_key("report, one camera", VERSION, [inputs, plans, *besides], None)


def one_camera_summary(
    store: TrialStore,
    campaigns: list[Collected],
    planned_bytes: Mapping[str, int],
    *,
    evaluated: bool,
) -> OneCameraSummary:
    """Make the summary.

    Args:
        planned_bytes: of the committed trials, by campaign.
        evaluated: a network was trained and evaluated.
    """
    frames = missing_stream(campaigns) == "events"
    labels, rates = None, None
    labelled = frames or has_labels(store, campaigns)
    if labelled:
        labels = LabelSummary(
            error_ms=label_errors.label_errors(store, campaigns),
            rules_ms=label_errors.rules_compared(store, campaigns),
            source=label_sources(campaigns),
            holds=label_errors.holds_compared(store, campaigns),
        )
    left_out = {} if labelled else {"label": NO_LABELS}
    left_out |= {} if evaluated else dict.fromkeys(("train", "evaluate"), NO_CLASSIFIER)
    if not frames:
        rates = {item.name: _rate(item) for item in campaigns}
    return OneCameraSummary(
        simulated=store.simulated,
        one_camera="frames" if frames else "events",
        left_out=tuple(StepLeftOut(name=name, reason=why) for name, why in left_out.items()),
        labels=labels,
        event_rates=rates,
        references=references_of(store, campaigns),
        clocks_us=_clocks(campaigns),
        sync=sync_part(campaigns),
        quality=quality_part(campaigns),
        planned={item.name: planned_part(item, planned_bytes[item.name]) for item in campaigns},
        versions=package_versions(),
        protocols=protocol_hashes(campaigns),
    )


def _clocks(campaigns: Sequence[Collected]) -> dict[str, float]:
    """Return each clock's own uncertainty in the worst trial, microseconds."""
    worst: dict[str, float] = {}
    for item in campaigns:
        for _, recording in item.trials:
            for device, known in recording.clocks.devices().items():
                if known.uncertainty_ns is not None:
                    worst[device] = max(worst.get(device, 0.0), known.uncertainty_ns / 1e3)
    return worst


def one_camera_cover(summary: OneCameraSummary) -> Cover:
    """Return the first screen."""
    notices = quality_notices(summary.quality)
    return Cover("report.html", slip_answer(summary), notices, headline(summary))


def headline(summary: OneCameraSummary) -> list[Number]:
    """Return the numbers below the first screen."""
    quality = summary.quality
    found = [Number("trials committed", str(quality.committed), f"of {quality.planned} planned")]
    if (labels := summary.labels) is not None:
        both = labels.rules_ms.apart
        found.append(
            Number("labelled by both rules", str(both.gross.n), "trials with a known gross onset")
        )
    found += slip_tiles(summary)
    for name, rate in (summary.event_rates or {}).items():
        found.append(
            Number(
                "events in the motion",
                number(None if rate.motion is None else rate.motion / 1000, 1, "thousand/s"),
                f"median of {plural(rate.trials, 'trial')} of {name}",
            )
        )
    if summary.one_camera == "events":
        value, device = clocks.worst_clock(summary.sync)
    else:
        device = max(
            summary.clocks_us, key=lambda name: summary.clocks_us[name], default="no clock"
        )
        value = number(summary.clocks_us.get(device), 1, "µs")
    found.append(Number("clock uncertainty", value, f"worst trial, {device}"))
    return found


@dataclass(frozen=True)
class LeftOutSection(Content):
    """Sections that this report leaves out, and the reason."""

    template: ClassVar[str] = "left_out.html"
    camera: str
    given: bool
    """The onsets came with the recordings."""
    steps: Table

    @property
    def notices(self) -> list[str]:
        """Steps that are left out."""
        return [f"{name}: {reason}" for name, reason in self.steps.rows]


@dataclass(frozen=True)
class OwnClocks(Content):
    """Clocks of devices, where there are no events to hold them against."""

    template: ClassVar[str] = "own_clocks.html"
    folded: ClassVar[bool] = True
    clocks: Table


@dataclass(frozen=True)
class RateSection(Content):
    """Event rates in the hold and over the motion."""

    template: ClassVar[str] = "rates.html"
    figure: Figure
    rates: Table


def left_out_section(summary: OneCameraSummary) -> LeftOutSection:
    """Return which camera is missing, and the sections that need it."""
    rows = [[each.name, each.reason] for each in summary.left_out]
    given = summary.labels is not None and "given" in summary.labels.error_ms.rule
    return LeftOutSection(summary.one_camera, given, Table(("step", "why it is left out"), rows))


def rate_section(campaigns: Sequence[Collected], summary: OneCameraSummary) -> RateSection | None:
    """Show event rates; None without events."""
    if (rates := summary.event_rates) is None:
        return None
    each = {item.name: [_binned(r) for _, r in item.trials] for item in campaigns if item.trials}
    longest = max((len(rate) for found in each.values() for rate in found), default=0)
    seconds = (np.arange(longest) + 0.5) * BIN_S - BEFORE_S
    curves, data = {}, {"time from the start of the motion (s)": seconds.tolist()}
    for name, found in each.items():
        table = np.full((len(found), longest), np.nan)
        for row, rate in zip(table, found, strict=True):
            row[: len(rate)] = rate
        # from where on most trials are over, the median would be of the slow ones alone
        there = np.isfinite(table).mean(axis=0) >= 0.5
        low, middle, high = np.full((3, longest), np.nan)
        low[there], middle[there], high[there] = np.nanquantile(
            table[:, there], (0.25, 0.5, 0.75), axis=0
        )
        curves[name] = (low, middle, high)
        data[f"{name}: median (events/s)"] = [None if np.isnan(v) else v for v in middle.tolist()]
    rows = [
        [name, str(rate.trials), number(rate.hold, 0), number(rate.motion, 0)]
        for name, rate in rates.items()
    ]
    return RateSection(
        Figure(
            rates_over_motion(seconds, curves, simulated=summary.simulated), "event-rates", data
        ),
        Table(("campaign", "trials", "in the hold (events/s)", "in the motion (events/s)"), rows),
    )


def one_camera_sections(
    store: TrialStore,
    campaigns: list[Collected],
    summary: OneCameraSummary,
    own: Sequence[Content] = (),
) -> list[Content | Rendered]:
    """Make all sections, in order.

    Args:
        own: those about what was evaluated.
    """
    simulated = summary.simulated
    sections: list[Content | Rendered | None] = [
        left_out_section(summary),
        *own,
        collected_section(campaigns, summary),
        registration_section(store, campaigns),
        *plugin_sections(ReportData(store, campaigns, simulated, summary)),
        quality_section(campaigns, summary.references, simulated=simulated),
        skin_section(campaigns),
    ]
    if summary.labels is not None:
        sections.append(label_section(store, campaigns, summary))
    sections.append(rate_section(campaigns, summary))
    if summary.one_camera == "events":
        page = (store.folder / "report" / clocks.PAGE).exists()
        sections.append(
            clocks.clock_section(campaigns, summary.sync, page=page, simulated=simulated)
        )
    else:
        rows = [
            [device, summary.sync.grades.get(device, "–"), number(uncertainty, 1)]
            for device, uncertainty in summary.clocks_us.items()
        ]
        sections.append(OwnClocks(Table(("clock", "timed by", "uncertainty (µs)"), rows)))
    return [section for section in sections if section is not None]


def _binned(recording: Recording) -> F64:
    """Events a second from a second before the motion to its end, by tenths of a second."""
    begin, end = recording.motion_ns
    times = _times(recording)
    first, width = begin - round(BEFORE_S * 1e9), round(BIN_S * 1e9)
    bins = max((end - first) // width, 1)
    edges = first + width * np.arange(bins + 1)
    rate: F64 = np.diff(np.searchsorted(times, edges)) / BIN_S
    rate[edges[:-1] < recorded_span(recording)[0]] = np.nan
    return rate


def _rate(item: Collected) -> MotionRate:
    hold, motion = [], []
    for _, recording in item.trials:
        times, (begin, end) = _times(recording), recording.motion_ns
        start = recorded_span(recording)[0]
        before, middle, after = np.searchsorted(times, (start, begin, end)).tolist()
        if begin > start:
            hold.append((middle - before) / (begin - start) * 1e9)
        motion.append((after - middle) / (end - begin) * 1e9)
    return MotionRate(
        trials=len(item.trials),
        hold=float(np.median(hold)) if hold else None,
        motion=float(np.median(motion)) if motion else None,
    )


def _times(recording: Recording) -> npt.NDArray[np.int64]:
    """Times of all events on the time line, ns."""
    times = recording.clock("events").to_reference(recording.events().t_us * 1000)
    return np.asarray(times, np.int64)
