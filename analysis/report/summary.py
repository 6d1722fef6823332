"""The report's numbers, `report/summary.json`, assembled from the results of earlier steps."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from statistics import median
from typing import Any

from pydantic_core import to_jsonable_python

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.detectors.latency import summarise_latency, summarise_lead
from sliplab.analysis.detectors.onset_references import (
    References,
    decisions_of,
    judge_by_reference,
)
from sliplab.analysis.evaluation import networks as other_networks
from sliplab.analysis.evaluation.evaluation import evaluation_of
from sliplab.analysis.evaluation.windows import window_intervals
from sliplab.analysis.report.alarms import OWN, false_alarms
from sliplab.analysis.report.campaign import references_of
from sliplab.analysis.report.holdout import holdout_part
from sliplab.analysis.report.outcomes import account, trial_intervals, trial_outcome
from sliplab.analysis.report.programs import HOLDOUT
from sliplab.analysis.report.sources import Sources
from sliplab.protocols.detection import Detection
from sliplab.protocols.phases import Press
from sliplab.protocols.presets import PAPER, at
from sliplab.protocols.settings import AnalysisSettings
from sliplab.storage.schema.evaluation import (
    Evaluation,
    OtherEvaluation,
    TrainedBaseline,
    TrialScore,
    WindowIntervals,
)
from sliplab.storage.schema.holdout import HoldoutResult
from sliplab.storage.schema.summary import (
    Hashes,
    Kinematic,
    PaperSettings,
    Planned,
    QualitySummary,
    SettingDifference,
    Summary,
    Sync,
)
from sliplab.storage.streams import Json
from sliplab.storage.trials.store import TrialStore
from sliplab.storage.versions import FIGURES, installed_versions

Slips = Mapping[tuple[str, str], References]
"""Slips of trials by each onset, by campaign and trial."""


def package_versions() -> dict[str, str]:
    """Return the versions of the packages that figures depend on."""
    return installed_versions(FIGURES)


def protocol_hashes(campaigns: Sequence[Collected]) -> dict[str, Hashes]:
    """Return the hashes of the campaigns' protocols."""
    return {
        item.name: Hashes(
            collection=item.planned.collection_hash, analysis=item.planned.analysis_hash
        )
        for item in campaigns
    }


def make_summary(sources: Sources) -> Summary:
    """Make the summary; only `timing_s` differs between equal runs.

    Raises:
        StoreError: another program's result is of another shape.
    """
    campaigns, evaluation = sources.campaigns, sources.evaluation
    judged = judged_part(
        campaigns,
        evaluation,
        sources.window_intervals,
        sources.baselines,
        sources.references,
        sources.programs,
    )
    holdout = None
    if "holdout" in sources.programs:
        retained = HOLDOUT.parse(HoldoutResult, sources.programs["holdout"])
        holdout = holdout_part(retained)
    return Summary.model_validate(
        {
            "simulated": sources.store.simulated,
            **judged,
            "networks": {
                name: _network(campaigns, of, sources.references, sources.programs)
                for name, of in sources.networks.items()
            },
            "paper": _paper(sources.settings, campaigns),
            "references": references_of(sources.store, campaigns),
            "labels": {
                "error_ms": evaluation.label_error_ms,
                "rules_ms": evaluation.label_rules_ms,
                "source": label_sources(campaigns),
                "reviewed": evaluation.reviewed,
                "check": sources.label_check,
                "holds": sources.holds,
                **_given(campaigns),
            },
            "detection": plain_rules(evaluation.detection),
            "choices": evaluation.choices,
            "detectors": evaluation.detectors,
            "holdout": holdout,
            "sync": sync_part(campaigns),
            "quality": quality_part(campaigns),
            "planned": {
                item.name: planned_part(item, sources.planned_bytes[item.name])
                for item in campaigns
            },
            "timing_s": sources.step_seconds,
            "versions": package_versions(),
            "protocols": protocol_hashes(campaigns),
            "seeds": {
                "network": sources.settings.training.seeds,
                "chosen": evaluation.seed,
                "collection": {
                    item.name: item.planned.seed
                    for item in campaigns
                    if item.planned.seed is not None
                },
            },
        }
    )


def evaluation_numbers(store: TrialStore, campaigns: list[Collected]) -> Json:
    """Return the numbers of the evaluation under the report's keys, without a report.

    Raises:
        StoreError: there is no evaluation of this version yet.
    """
    evaluation = evaluation_of(store)
    spans = window_intervals(store, evaluation.key)
    others = other_networks.retained(store, campaigns, evaluation.reviewed is not None)
    numbers: Json = to_jsonable_python(
        {
            "simulated": store.simulated,
            **judged_part(campaigns, evaluation, spans, {}, {}, {}),
            "networks": {name: _network(campaigns, of, {}, {}) for name, of in others.items()},
        }
    )
    return numbers


def judged_part(
    campaigns: Sequence[Collected],
    evaluation: Evaluation,
    spans: WindowIntervals | None,
    baselines: Mapping[str, TrainedBaseline],
    references: Slips,
    programs: Mapping[str, Json],
) -> dict[str, Any]:
    """Return `kinematic`, `gravity`, `disturbance` and `trials` of an evaluation."""
    judged = _judged(campaigns, evaluation, references)
    windows = evaluation.windows.to_json()
    kinematic = {
        **{name: value for name, value in windows.items() if name in Kinematic.model_fields},
        "trained_baselines": baselines,
        "window_intervals": {} if spans is None else spans.to_json(),
        "false_alarms": false_alarms(campaigns, evaluation.trials, programs, OWN),
        **judged["kinematic"],
    }
    trials = tuple(trial_outcome(row) for row in evaluation.trials)
    return {**judged, "kinematic": kinematic, "trials": trials}


def _judged(
    campaigns: Sequence[Collected], evaluation: Evaluation | OtherEvaluation, references: Slips
) -> dict[str, Json]:
    """Return each experiment's figures with its trials' outcomes, and how sure they are."""
    found = {}
    for name, figures in evaluation.experiments.items():
        rows = [row for row in evaluation.trials if row.experiment == name]
        ours = [trial_outcome(row) for row in rows]
        decided = decisions_of(rows, references, evaluation.detection)
        scored = [row.latency for row in rows if row.latency is not None]
        found[name] = {
            **figures.to_json(),
            # evaluations of older versions have medians without missed and late detections
            "latency_ms": summarise_latency(scored).to_json(),
            "lead_ms": summarise_lead(scored).to_json(),
            "accounted": account(campaigns, ours, name),
            "intervals": trial_intervals(ours, evaluation.detection.values()),
            "by_reference": judge_by_reference(decided),
            "first_slip_ms": first_slip_ms(rows, references),
        }
    return found


def first_slip_ms(rows: Sequence[TrialScore], references: Slips) -> float | None:
    """Return the median time from the labelled onset to the true one, which nothing comes before.

    Only simulated trials have it.
    """
    found = []
    for row in rows:
        true = references.get((row.campaign, row.trial), {}).get("true")
        if true is not None and row.incipient_ns is not None:
            found.append((true.slip.incipient_ns - row.incipient_ns) / 1e6)
    return median(found) if found else None


def _network(
    campaigns: Sequence[Collected],
    found: OtherEvaluation,
    references: Slips,
    programs: Mapping[str, Json],
) -> Json:
    """Return another network's figures, under the keys that the store's own have."""
    judged = _judged(campaigns, found, references)
    return {
        **{key: getattr(found, key) for key in ("title", "preset", "seed", "engine", "exact")},
        "detection": plain_rules(found.detection),
        **judged,
        "kinematic": {
            **found.windows.to_json(),
            "false_alarms": false_alarms(
                campaigns, found.trials, programs, f"preset: {found.preset}"
            ),
            **judged["kinematic"],
        },
    }


def plain_rules(rules: Mapping[str, Detection]) -> dict[str, Json]:
    """Return the rules of detection as plain data."""
    return {name: rule.model_dump(mode="json") for name, rule in rules.items()}


def _paper(settings: AnalysisSettings, campaigns: Sequence[Collected]) -> PaperSettings:
    """Find in which settings this differs from the paper, and which of them it does not say."""
    depths = {
        text
        for item in campaigns
        if item.experiment != "kinematic" and item.recorded is None
        for phase in item.plan.protocol.collection.motion
        if isinstance(phase, Press)
        for field, unit in ((phase.depth, "mm"), (phase.force, "N"))
        if field is not None
        for text in item.plan.level_texts(field, unit)
    }
    differences = tuple(
        SettingDifference(
            setting=each.words,
            key=each.key,
            paper=_in_words(each.value),
            here=_in_words(here),
            source=each.source,
        )
        for each, here in settings.overrides
    )
    assumed = [
        f"{each.words}: {_in_words(at(settings, each.key))}"
        for each in PAPER
        if each.source == "assumed"
    ]
    if depths:
        assumed.append(
            f"press depth of gravity and disturbance trials: {', '.join(sorted(depths))}"
        )
    return PaperSettings(preset=settings.preset, differences=differences, assumed=tuple(assumed))


def _in_words(value: Any) -> str:
    """Return a setting's value as text."""
    match value:
        case bool():
            return "yes" if value else "no"
        case tuple():
            return ", ".join(map(_in_words, value))
        case None:
            return "the window's length"
        case int() | float():
            return f"{value:g}"
        case _:
            return str(value)


def _given(campaigns: Sequence[Collected]) -> dict[str, float | None]:
    """Return the largest uncertainty of onsets that came with recordings, as part of a document."""
    found = [
        given.uncertainty_ns
        for item in campaigns
        if item.settings.labelling.rule == "given"
        for _, recording in item.trials
        if (origin := recording.record.imported) is not None and (given := origin.given) is not None
    ]
    if not found:
        return {}
    known = [value for value in found if value is not None]
    return {"given_within_ms": max(known) / 1e6 if len(known) == len(found) else None}


def label_sources(campaigns: Sequence[Collected]) -> dict[str, int]:
    """Count trials with a video, with tracks in its place, and, if there are, with neither."""
    found = Counter(recording.frame_source for item in campaigns for _, recording in item.trials)
    sources = {name: found[name] for name in ("video", "tracks")}
    return sources | ({"events": found["none"]} if found["none"] else {})


def sync_part(campaigns: Sequence[Collected]) -> Sync:
    """Find how devices were timed, and the worst uncertainty of events against each."""
    grades: dict[str, set[str]] = {}
    worst: dict[str, float] = {}
    for item in campaigns:
        for _, recording in item.trials:
            clocks = recording.clocks
            for device, known in clocks.devices().items():
                grades.setdefault(device, set()).add(known.grade)
                if (both := clocks.against_events_ns(device)) is not None:
                    worst[device] = max(worst.get(device, 0.0), both / 1e3)
    named = {device: " or ".join(sorted(found)) for device, found in grades.items()}
    return Sync(
        grade=named.get("frames", named.get("arm")),
        grades=named,
        worst_uncertainty_us=max(worst.values(), default=None),
        worst_against_events_us=worst,
    )


def quality_part(campaigns: Sequence[Collected]) -> QualitySummary:
    """Count trials and attempts of all campaigns."""
    quarantined = [known for item in campaigns for known in item.campaign.quarantined()]
    broken_off = sum(known["cause"] == "interrupted" for known in quarantined)
    return QualitySummary(
        planned=sum(len(item.planned) for item in campaigns),
        committed=sum(len(item.trials) for item in campaigns),
        retaken=sum(str(known["cause"]).startswith("gate") for known in quarantined),
        quarantined=len(quarantined) - broken_off,
        interrupted=broken_off,
    )


def planned_part(item: Collected, planned_bytes: int) -> Planned:
    """Compare the plan's seconds and bytes with what the committed trials really took.

    Of an imported campaign nothing was planned beyond what is there.
    """
    seconds = sum(item.planned.seconds(trial) for trial, _ in item.trials)
    taken = sum(
        path.stat().st_size
        for _, r in item.trials
        for path in r.folder.iterdir()
        if path.name != "provenance.json"
    )
    if item.recorded is not None:
        return Planned(
            seconds=seconds, seconds_collected=seconds, bytes=taken, bytes_collected=taken
        )
    return Planned(
        seconds=seconds,
        seconds_collected=sum(r.record.motion_s or 0.0 for _, r in item.trials),
        bytes=planned_bytes,
        bytes_collected=taken,
    )
