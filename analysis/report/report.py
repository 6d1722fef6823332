"""The report: its sections in order, and the numbers on top of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy.typing as npt

from sliplab.analysis.detectors.predictions import trial_counts
from sliplab.analysis.labels import label_errors
from sliplab.analysis.networks import model_file
from sliplab.analysis.networks.models import choose_model, wanted_models
from sliplab.analysis.networks.training import Fitted
from sliplab.analysis.report import clocks, windows
from sliplab.analysis.report.campaign import collected_section, quality_section
from sliplab.analysis.report.detectors import detector_section
from sliplab.analysis.report.forces import force_section
from sliplab.analysis.report.holdout import holdout_section
from sliplab.analysis.report.labels import label_section
from sliplab.analysis.report.latency import latency_section
from sliplab.analysis.report.onsets import onset_section
from sliplab.analysis.report.outcomes import failure_section
from sliplab.analysis.report.page import (
    Content,
    Number,
    Table,
    number,
    render_page,
)
from sliplab.analysis.report.paper import paper_section
from sliplab.analysis.report.plugin_sections import ReportData, plugin_sections
from sliplab.analysis.report.programs import HOLDOUT
from sliplab.analysis.report.registration import registration_section
from sliplab.analysis.report.skins import skin_section
from sliplab.analysis.report.sources import Sources
from sliplab.analysis.report.tiles import slip_tiles
from sliplab.analysis.report.trial import Example, choose_example, output_section, trial_section
from sliplab.storage.schema.summary import SeedsUsed, Summary


@dataclass(frozen=True)
class ReportMaterial:
    """Material of the page besides the summary's numbers.

    Attributes:
        example: the trial shown in detail, with its `counts` and `end_ns`.
        distances: of each trial's onset from the truth, ms, by rule and onset.
    """

    fitted: Fitted
    example: tuple[Example, Mapping[str, npt.NDArray[Any]]] | None
    distances: Mapping[str, Mapping[str, Sequence[float]]]


def read_shown(sources: Sources) -> ReportMaterial:
    """Read what the page shows besides the summary's numbers."""
    store, campaigns, evaluation = sources.store, list(sources.campaigns), sources.evaluation
    models = wanted_models(store, campaigns, evaluation.reviewed is not None)
    model = choose_model(models)
    example = choose_example(campaigns, evaluation.trials)
    counts: Mapping[str, npt.NDArray[Any]] = {}
    if example is not None:
        rule = evaluation.detection[example.item.name]
        trial = example.recording.trial_id
        counts = trial_counts(store, example.item.name, trial, rule)
    return ReportMaterial(
        model_file.load(model.path),
        None if example is None else (example, counts),
        label_errors.distances(store, campaigns),
    )


@dataclass(frozen=True)
class ProvenanceSection(Content):
    """Hashes, wall times and versions."""

    template: ClassVar[str] = "provenance.html"
    seeds: SeedsUsed
    uncertainty: str
    device: str
    tables: Sequence[Table]


def render(sources: Sources, summary: Summary, sections: Sequence[Content]) -> str:
    """Render the page; everything in it is escaped but the figures' SVG."""
    names = [item.name for item in sources.campaigns]
    return render_page(
        "report.html",
        sections,
        simulated=summary.simulated,
        campaigns=names,
        headline=headline(summary),
    )


def headline(summary: Summary) -> list[Number]:
    """Return the numbers on top of the page."""
    quality = summary.quality
    uncertain, device = clocks.worst_clock(summary.sync)
    note = clocks.short_note(summary.sync, summary.labels)
    if any(rule.choose == "test" for rule in summary.detection.values()):
        note += "; smoothing and margin chosen on test trials"
    return [
        Number("trials committed", str(quality.committed), f"of {quality.planned} planned"),
        *slip_tiles(summary, f"; {note}"),
        Number("clock uncertainty", uncertain, f"worst trial, {device}"),
    ]


def make_sections(sources: Sources, summary: Summary, shown: ReportMaterial) -> list[Content]:
    """Make all sections, in order.

    Raises:
        StoreError: another program's result is of another shape.
    """
    store, campaigns = sources.store, sources.campaigns
    simulated, kinematic = summary.simulated, summary.kinematic
    rows = sources.evaluation.trials
    trial, outputs, seen = None, None, None
    if shown.example is not None:
        example, counts = shown.example
        seen = example.recording
        trial = trial_section(store, example, simulated=simulated)
        rule = sources.evaluation.detection[example.item.name]
        outputs = output_section(example, counts, rule, simulated=simulated)
    holdout = None
    data = ReportData(store, campaigns, simulated, summary)
    if simulated and data.collected_here:
        holdout = holdout_section(summary.holdout, kinematic, HOLDOUT.command(store), HOLDOUT.file)
    sections: list[Content | None] = [
        paper_section(summary),
        holdout,
        collected_section(campaigns, summary),
        registration_section(store, list(campaigns)),
        *plugin_sections(data),
        quality_section(campaigns, summary.references, simulated=simulated),
        skin_section(campaigns, rows),
        trial,
        force_section(store, campaigns, seen, simulated=simulated),
        windows.network_section(kinematic, shown.fitted, simulated=simulated),
        windows.where_section(kinematic, simulated=simulated),
        windows.lead_section(kinematic, simulated=simulated),
        windows.work_section(kinematic),
        outputs,
        latency_section("kinematic", campaigns, rows, summary),
        latency_section("gravity", campaigns, rows, summary),
        latency_section("disturbance", campaigns, rows, summary),
        failure_section(store.folder, summary.trials),
        detector_section(summary.detectors, simulated=simulated),
        onset_section(summary),
        label_section(store, campaigns, summary, shown.distances),
        clocks.clock_section(
            campaigns,
            summary.sync,
            page=(store.folder / "report" / clocks.PAGE).exists(),
            simulated=simulated,
        ),
        *plugin_sections(data, last=True),
        _provenance(summary),
    ]
    return [section for section in sections if section is not None]


def _provenance(summary: Summary) -> ProvenanceSection:
    hashes = [
        [name, value.collection[:16], value.analysis[:16]]
        for name, value in summary.protocols.items()
    ]
    timing = [[name, number(value, 1)] for name, value in summary.timing_s.items()]
    versions = [[name, value] for name, value in summary.versions.items()]
    tables = [
        Table(["protocol", "collection hash", "analysis hash"], hashes),
        Table(["step", "wall time (s)"], timing),
        Table(["package", "version"], versions),
    ]
    return ProvenanceSection(summary.seeds, *clocks.worst_clock(summary.sync), tables)
