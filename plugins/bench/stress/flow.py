"""`sliplab stress`: a store's detectors under nuisances.

The trials of a protocol with nuisances are taken and labelled in a folder of their own, on the rig
of the store's slides or another. The store's networks and the detectors that its training and
validation trials set are then judged by them; nothing is chosen by these trials.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sliplab.analysis.campaigns import Collected, training_campaigns
from sliplab.analysis.detectors.detectors import Predictions
from sliplab.analysis.detectors.latency import slip_of
from sliplab.analysis.detectors.onset_references import references_of
from sliplab.analysis.detectors.predictions import (
    PredictionRequest,
    predict_trials,
    prediction_request,
)
from sliplab.analysis.labels.reviewed import StoreLabels
from sliplab.analysis.metrics import window_groups
from sliplab.analysis.networks import model_file, training
from sliplab.analysis.networks.models import ModelOnDisk, choose_model, wanted_models
from sliplab.analysis.windows.dataset import recorded_span
from sliplab.analysis.windows.sample_sets import load_samples
from sliplab.flows.judge_network import spike_keeper
from sliplab.flows.other_rig import retake
from sliplab.flows.planning.run_request import RunRequest, make_request
from sliplab.flows.store_detectors import store_detectors
from sliplab.plugins.bench.stress import judging as stress
from sliplab.plugins.bench.stress.document import StressAccuracy, StressDetector, StressRecord
from sliplab.plugins.bench.stress.judging import StressTrial
from sliplab.protocols import InputError, Plan, PlannedTrial
from sliplab.storage.files import make_folder
from sliplab.storage.schema.evaluation import Rate
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import StoreError, TrialStore

NAME = "stress"


@dataclass(frozen=True)
class StressRequest:
    """Request of a stress test, checked before anything moves.

    Attributes:
        store, campaigns: that trained the networks. taken: request of the trials with nuisances.
        out: folder of the page and its numbers.
    """

    store: TrialStore
    campaigns: list[Collected]
    taken: RunRequest
    out: Path


def request(
    store: TrialStore,
    campaigns: list[Collected],
    protocol: Path,
    rig: Path | None,
    out: Path | None,
) -> StressRequest:
    """Check a request.

    Args:
        rig: left out, that of the store's slides, if it is simulated.
        out: left out, a folder of the store.

    Raises:
        InputError: the protocol has no nuisances or other windows, or a real rig is not named.
        StoreError: nothing was trained yet.
    """
    item = training_campaigns(campaigns)[0]
    choose_model(wanted_models(store, campaigns))
    if rig is None:
        if not item.info.get("simulated"):
            text = f"is needed: the slides of '{item.name}' were collected on a real rig"
            raise InputError("--rig", "", None, text)
        rig = item.campaign.folder / "rig.yaml"
    out = store.folder / NAME if out is None else out
    taken = make_request(protocol, rig, out / "store", campaign=NAME, claims="ignore")
    collection = taken.plan.protocol.collection
    if collection.nuisances is None:
        text = f"has none in {protocol}; a protocol with nuisances is needed (docs/stress.md)"
        raise InputError("--protocol", "collection.nuisances", None, text)
    if collection.experiment != "kinematic":
        raise InputError(
            "--protocol",
            "collection.experiment",
            collection.experiment,
            "must be kinematic: slips are judged by slides",
        )
    if taken.plan.protocol.analysis.windows != item.settings.windows:
        text = f"must be those of the campaign '{item.name}', on which the networks were trained"
        raise InputError("--protocol", "analysis.windows", str(protocol), text)
    return StressRequest(store, campaigns, taken, out)


def measure_stress(asked: StressRequest) -> StressRecord:
    """Take and label the trials that are missing, and judge the detectors.

    Raises:
        StoreError: no trial has an onset.
    """
    make_folder(asked.out)
    disturbed, (campaign,) = retake([asked.taken])
    labels = StoreLabels(disturbed)
    trials = [
        (trial, recording, found)
        for trial, recording in campaign.of_split("test")
        if (found := _stress_trial(asked.taken.plan, trial, recording, labels, campaign))
    ]
    if not trials:
        raise StoreError(f"{disturbed.folder}: no test trial has an onset of slip")
    detectors: list[StressDetector] = []
    accuracy: list[StressAccuracy] = []
    tolerance = round(campaign.settings.detection.false_early_ms * 1e6)
    for judged in store_detectors(asked.store, asked.campaigns):
        known: dict[int, Predicted] = {}
        for stride, tuned in judged.detectors:
            if stride not in known:
                known[stride] = _predicted(disturbed, campaign, trials, judged.model, stride)
            rows = [
                (
                    it,
                    stress.outcome(
                        stress.alarms(tuned.detector, tuned.levels.incipient, p), it.slip, tolerance
                    ),
                )
                for it, p in known[stride]
            ]
            detectors.append(stress.stressed(judged.title, tuned.name, stride, rows))
        accuracy += _accuracy(judged.title, judged.model, labels, campaign, trials)
    first = trials[0][1].record
    return StressRecord(
        simulated=first.simulated,
        campaign=training_campaigns(asked.campaigns)[0].name,
        rig=campaign.info["rig"],
        protocol=asked.taken.plan.protocol.name,
        trials=len(trials),
        without_onsets=sum(1 for _ in campaign.of_split("test")) - len(trials),
        hold_h=detectors[0].figures[0].hold_h,
        detectors=stress.ordered(detectors),
        accuracy=tuple(accuracy),
    )


def _stress_trial(
    plan: Plan, trial: PlannedTrial, recording: Recording, labels: StoreLabels, campaign: Collected
) -> StressTrial | None:
    """A trial with its nuisance and onsets; None where the label lacks the incipient one.

    Knocks often leave the gross onset in doubt; the end of the slip is the bound then.
    """
    label = labels.read(campaign, recording)
    slip = slip_of(label.incipient_ns, label.gross_ns or label.end_ns, label.end_ns)
    section = plan.protocol.collection.nuisances
    if slip is None or section is None:
        return None
    name, strength = section.applied(dict(trial.condition))
    true = references_of(recording, label).get("true")
    return StressTrial(
        name,
        float(strength),
        recorded_span(recording)[0],
        slip,
        None if true is None else true.slip.incipient_ns,
    )


Trials = list[tuple[PlannedTrial, Recording, StressTrial]]
Predicted = list[tuple[StressTrial, Predictions]]


def _predicted(
    disturbed: TrialStore, campaign: Collected, trials: Trials, model: ModelOnDisk, stride_ms: int
) -> Predicted:
    """Spikes of a network in all windows of the trials."""
    windows = model.settings.windows
    wanted: list[tuple[StressTrial, PredictionRequest]] = [
        (it, prediction_request(campaign.name, recording, model.key, windows, stride_ms))
        for _, recording, it in trials
    ]
    keep = spike_keeper(disturbed, None)
    predict_trials(disturbed, model.path, [each for _, each in wanted], keep)
    found = []
    for it, each in wanted:
        arrays = Derived.of(disturbed, each.step, each.campaign).arrays(each.recording.folder.name)
        found.append((it, Predictions(arrays["counts"], arrays["events"], arrays["end_ns"])))
    return found


def _accuracy(
    title: str, model: ModelOnDisk, labels: StoreLabels, campaign: Collected, trials: Trials
) -> Iterator[StressAccuracy]:
    """Strict accuracy of a network by nuisance and strength, with intervals over trials."""
    samples = load_samples(labels, [campaign], "test")
    counts = training.predict_counts(model_file.load(model.path), samples.windows)
    hits = window_groups.strict_hits(counts, samples.y)
    place = {name: k for k, (_, name) in enumerate(samples.trials)}
    for name, strength, belongs in stress.groups(it for _, _, it in trials):
        ours = [place[trial.id] for trial, _, it in trials if belongs(it)]
        there = np.isin(samples.trial, ours)
        found = window_groups.share(hits[there], samples.trial[there])
        strict = None
        if found.share is not None and found.low is not None and found.high is not None:
            strict = Rate(value=found.share, low=found.low, high=found.high)
        yield StressAccuracy(
            network=title,
            nuisance=name,
            strength=strength,
            windows=int(there.sum()),
            trials=found.trials,
            strict=strict,
        )
