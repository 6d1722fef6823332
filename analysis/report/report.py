"""The report: its first screen, and its sections in order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from sliplab.analysis.detectors.predictions import trial_counts
from sliplab.analysis.networks import model_file
from sliplab.analysis.networks.models import choose_model, wanted_models
from sliplab.analysis.report import clocks, windows
from sliplab.analysis.report.campaign import collected_section, quality_section
from sliplab.analysis.report.cover import Cover, quality_notices, slip_answer
from sliplab.analysis.report.detectors import detector_section
from sliplab.analysis.report.forces import force_section
from sliplab.analysis.report.holdout import holdout_section
from sliplab.analysis.report.labels import label_section
from sliplab.analysis.report.latency import latency_section
from sliplab.analysis.report.onsets import onset_section
from sliplab.analysis.report.outcomes import failure_section
from sliplab.analysis.report.page import Content, Number, Rendered, Table, number
from sliplab.analysis.report.paper import paper_section
from sliplab.analysis.report.plugin_sections import ReportData, plugin_sections
from sliplab.analysis.report.programs import HOLDOUT
from sliplab.analysis.report.registration import registration_section
from sliplab.analysis.report.skins import skin_section
from sliplab.analysis.report.sources import Sources
from sliplab.analysis.report.tiles import slip_tiles
from sliplab.analysis.report.trial import choose_example, output_section, trial_section
from sliplab.storage.schema.summary import SeedsUsed, Summary


@dataclass(frozen=True)
class ProvenanceSection(Content):
    """Hashes, wall times and versions."""

    template: ClassVar[str] = "provenance.html"
    folded: ClassVar[bool] = True
    seeds: SeedsUsed
    uncertainty: str
    device: str
    tables: Sequence[Table]


def report_cover(summary: Summary) -> Cover:
    """Return the first screen."""
    notices = [*quality_notices(summary.quality), *_choice(summary)]
    return Cover("report.html", slip_answer(summary), notices, headline(summary))


def headline(summary: Summary) -> list[Number]:
    """Return the numbers below the first screen."""
    quality = summary.quality
    uncertain, device = clocks.worst_clock(summary.sync)
    note = clocks.short_note(summary.sync, summary.labels)
    return [
        Number("trials committed", str(quality.committed), f"of {quality.planned} planned"),
        *slip_tiles(summary, "".join(f"; {text}" for text in _choice(summary))),
        Number("clock uncertainty", uncertain, f"worst trial, {device}; {note}"),
    ]


def _choice(summary: Summary) -> list[str]:
    """Return a warning where the rule was chosen on the trials that it is judged by."""
    if any(rule.choose == "test" for rule in summary.detection.values()):
        return ["smoothing and margin chosen on test trials"]
    return []


def make_sections(sources: Sources, summary: Summary) -> list[Content | Rendered]:
    """Make all sections, in order.

    Raises:
        StoreError: another program's result is of another shape.
    """
    store, campaigns, evaluation = sources.store, list(sources.campaigns), sources.evaluation
    simulated, kinematic = summary.simulated, summary.kinematic
    model = choose_model(wanted_models(store, campaigns, evaluation.reviewed is not None))
    trial, outputs, seen = None, None, None
    if (example := choose_example(campaigns, evaluation.trials)) is not None:
        seen, rule = example.recording, evaluation.detection[example.item.name]
        counts = trial_counts(store, example.item.name, seen.trial_id, rule)
        trial = trial_section(store, example, simulated=simulated)
        outputs = output_section(example, counts, rule, simulated=simulated)
    holdout = None
    data = ReportData(store, campaigns, simulated, summary)
    if simulated and data.collected_here:
        holdout = holdout_section(summary.holdout, kinematic, HOLDOUT.command(store), HOLDOUT.file)
    page = (store.folder / "report" / clocks.PAGE).exists()
    sections: list[Content | Rendered | None] = [
        latency_section("kinematic", campaigns, evaluation.trials, summary),
        latency_section("gravity", campaigns, evaluation.trials, summary),
        latency_section("disturbance", campaigns, evaluation.trials, summary),
        failure_section(store.folder, summary.trials),
        windows.network_section(kinematic, model_file.load(model.path), simulated=simulated),
        windows.where_section(kinematic, simulated=simulated),
        holdout,
        collected_section(campaigns, summary),
        registration_section(store, campaigns),
        *plugin_sections(data),
        quality_section(campaigns, summary.references, simulated=simulated),
        skin_section(campaigns, evaluation.trials),
        trial,
        outputs,
        force_section(store, campaigns, seen, simulated=simulated),
        label_section(store, campaigns, summary),
        clocks.clock_section(campaigns, summary.sync, page=page, simulated=simulated),
        windows.lead_section(kinematic, simulated=simulated),
        windows.work_section(kinematic),
        detector_section(summary.detectors, kinematic.first_slip_ms, simulated=simulated),
        onset_section(summary),
        *plugin_sections(data, last=True),
        paper_section(summary),
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
