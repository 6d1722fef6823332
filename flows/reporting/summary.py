"""The numbers of a report as one JSON: keys that other programs may rely on (docs/summary.md)."""

from __future__ import annotations

from collections import Counter
from importlib.metadata import version
from typing import Any

from sliplab.analysis.campaigns import Collected, training_campaigns
from sliplab.flows.labelling.label_errors import holds_compared, read_check
from sliplab.flows.learning import other_networks
from sliplab.flows.learning.train import training_settings
from sliplab.flows.learning.window_baselines import EVALUATION, baselines
from sliplab.flows.learning.window_scores import window_intervals
from sliplab.flows.planning.estimate import plan_bytes
from sliplab.flows.reporting import holdout_section
from sliplab.flows.reporting.campaign_section import reference_rows, wear
from sliplab.flows.reporting.report_trials import accounted, intervals, trial_summary
from sliplab.flows.running.run_records import step_seconds
from sliplab.protocols.phases import Press
from sliplab.protocols.presets import PAPER, at
from sliplab.rigs.rig_file import load_rig_file
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.store import Store

_PACKAGES = (
    "sliplab",
    "numpy",
    "numba",
    "scipy",
    "torch",
    "sinabs",
    "prefect",
    "pandas",
    "h5py",
    "opencv-contrib-python-headless",
    "scikit-learn",
)
_WINDOWS = (
    "interval",
    "seeds",
    "reliability",
    "calibration",
    "by_factor",
    "by_tenth",
    "no_slip",
    "by_trial",
    "work",
    "beside",
)
"""What the summary takes over from the evaluation's windows as it is; docs/metrics.md."""


def make_summary(
    store: Store,
    campaigns: list[Collected],
    evaluation: dict[str, Any],
    held_out: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """Everything `summary.json` says; only `timing_s` differs between equal runs.

    Args:
        held_out: what `flows.holdout` kept.
    """
    windows, experiments = evaluation["windows"], evaluation["experiments"]
    reviewed = evaluation.get("reviewed") is not None
    kinematic = {
        "accuracy": windows["accuracy"],
        "confusion": windows["confusion"],
        "precision": windows["precision"],
        "recall": windows["recall"],
        "baselines": windows["baselines"],
        "samples": windows["samples"],
        "trained_baselines": baselines(store),
        **{name: windows[name] for name in _WINDOWS},
        "window_intervals": window_intervals(store, Derived.of(store, EVALUATION).key(EVALUATION)),
        **experiments["kinematic"],
    }
    return {
        "simulated": store.simulated,
        "kinematic": {**kinematic, **_judged(campaigns, evaluation, "kinematic")},
        "gravity": {**experiments["gravity"], **_judged(campaigns, evaluation, "gravity")},
        "disturbance": {
            **experiments["disturbance"],
            **_judged(campaigns, evaluation, "disturbance"),
        },
        "networks": {
            name: _network(campaigns, found)
            for name, found in other_networks.kept(store, campaigns, reviewed).items()
        },
        "paper": _paper(campaigns),
        "trials": [trial_summary(row) for row in evaluation["trials"]],
        "references": _references(store, campaigns),
        "labels": {
            "error_ms": evaluation["label_error_ms"],
            "rules_ms": evaluation["label_rules_ms"],
            "source": _sources(campaigns),
            "reviewed": evaluation.get("reviewed"),
            "check": read_check(store),
            "holds": holds_compared(store, campaigns),
        },
        "detection": evaluation["detection"],
        "choices": evaluation["choices"],
        "detectors": evaluation["detectors"],
        "holdout": None if held_out is None else holdout_section.part(held_out),
        "sync": _sync(campaigns),
        "quality": _quality(campaigns),
        "planned": {item.name: _planned(item) for item in campaigns},
        "timing_s": step_seconds(store),
        "versions": {name: version(name) for name in _PACKAGES},
        "protocols": {
            item.name: {
                "collection": item.plan.collection_hash,
                "analysis": item.plan.analysis_hash,
            }
            for item in campaigns
        },
        "seeds": {
            "network": list(training_campaigns(campaigns)[0].settings.training.seeds),
            "chosen": evaluation["seed"],
            "collection": {item.name: item.plan.protocol.collection.seed for item in campaigns},
        },
    }


def _judged(
    campaigns: list[Collected], evaluation: dict[str, Any], experiment: str
) -> dict[str, Any]:
    """What became of an experiment's trials, and how sure its figures are."""
    rows = evaluation["trials"]
    return {
        "accounted": accounted(campaigns, rows, experiment),
        "intervals": intervals(
            [trial_summary(row) for row in rows if row["experiment"] == experiment]
        ),
    }


def _network(campaigns: list[Collected], found: dict[str, Any]) -> dict[str, Any]:
    """Another network's figures, under the keys that the store's own have."""
    kinematic = {**found["windows"], **found["experiments"]["kinematic"]}
    experiments = {**found["experiments"], "kinematic": kinematic}
    return {
        **{key: found[key] for key in ("title", "preset", "seed", "engine", "exact", "detection")},
        **{
            name: {**figures, **_judged(campaigns, found, name)}
            for name, figures in experiments.items()
        },
    }


def _paper(campaigns: list[Collected]) -> dict[str, Any]:
    """In which settings this differs from the paper, and which of them it does not say."""
    settings = training_settings(campaigns)
    depths = {
        f"{phase.depth} mm"
        for item in campaigns
        if item.experiment != "kinematic"
        for phase in item.plan.protocol.collection.motion
        if isinstance(phase, Press)
    }
    rows = [
        {"setting": each.words, "key": each.key, "paper": _said(each.value), "here": _said(here),
         "source": each.source}
        for each, here in settings.overrides
    ]  # fmt: skip
    assumed = [f"{each.words}: {_said(at(settings, each.key))}" for each in PAPER
               if each.source == "assumed"]  # fmt: skip
    if depths:
        assumed.append(
            f"press depth of gravity and disturbance trials: {', '.join(sorted(depths))}"
        )
    return {"preset": settings.preset, "differences": rows, "assumed": assumed}


def _said(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, tuple):
        return ", ".join(map(_said, value))
    return "the window's length" if value is None else f"{value:g}" if _real(value) else str(value)


def _real(value: Any) -> bool:
    return isinstance(value, int | float)


def _references(store: Store, campaigns: list[Collected]) -> dict[str, Any]:
    """Wear by campaign, of those that take reference trials."""
    found = {item.name: reference_rows(store, item) for item in campaigns}
    return {name: {"trials": rows, "wear": wear(rows)} for name, rows in found.items() if rows}


def _sources(campaigns: list[Collected]) -> dict[str, int]:
    """How many trials there are with a video, and with tracks in its place."""
    found = Counter(recording.frame_source for item in campaigns for _, recording in item.trials)
    return {name: found[name] for name in ("video", "tracks")}


def _sync(campaigns: list[Collected]) -> dict[str, Any]:
    """How the trials' devices were timed, and the worst uncertainty of events against each."""
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
    return {
        "grade": named.get("frames", named.get("arm")),
        "grades": named,
        "worst_uncertainty_us": max(worst.values(), default=None),
        "worst_against_events_us": worst,
    }


def _quality(campaigns: list[Collected]) -> dict[str, Any]:
    aside = [known for item in campaigns for known in item.campaign.quarantined()]
    broken_off = sum(known["cause"] == "interrupted" for known in aside)
    return {
        "planned": sum(len(item.plan) for item in campaigns),
        "committed": sum(len(item.trials) for item in campaigns),
        "retaken": sum(str(known["cause"]).startswith("gate") for known in aside),
        "quarantined": len(aside) - broken_off,
        "interrupted": broken_off,
    }


def _planned(item: Collected) -> dict[str, Any]:
    """The plan's seconds and bytes beside what the committed trials really took."""
    rig, _ = load_rig_file(item.campaign.folder / "rig.yaml", stored=True)
    done = {trial.id for trial, _ in item.trials}
    missing = {trial.id for trial in item.plan} - done
    return {
        "seconds": sum(item.plan.seconds(trial) for trial, _ in item.trials),
        "seconds_collected": sum(r.record.motion_s or 0.0 for _, r in item.trials),
        "bytes": round(plan_bytes(rig, item.plan, missing)),
        "bytes_collected": sum(
            path.stat().st_size
            for _, r in item.trials
            for path in r.folder.iterdir()
            if path.name != "provenance.json"
        ),
    }
