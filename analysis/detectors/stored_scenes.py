"""Labelled trials of a store as scenes, which train a detector and set its level."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import islice

import numpy as np

from sliplab.analysis.campaigns import Collected, collected, training_campaigns
from sliplab.analysis.detectors.alarms import SceneEvidence, promised_levels
from sliplab.analysis.detectors.at_level import AtLevel
from sliplab.analysis.detectors.detector import Detector, Evidence, Scene, Slip
from sliplab.analysis.detectors.detector_comparison import allowed_early
from sliplab.analysis.detectors.feeding import feed
from sliplab.analysis.detectors.latency import TrueSlip, true_slip
from sliplab.analysis.detectors.onset_references import references_of, still_until_ns
from sliplab.analysis.labels.reviewed import StoreLabels
from sliplab.analysis.windows.dataset import recorded_span
from sliplab.protocols.detection import ComparisonSettings
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import StoreError, TrialStore


def fitted_to(store: TrialStore, detector: Detector, promise: float | None = None) -> AtLevel:
    """Return a detector that the store's training trials trained, at the level of its validation.

    The level is the lowest at which at most the middle one of `compare.rates` of the validation
    trials have an alarm while surely nothing slips (`still_until_ns`), or that which promises a
    rate. An alarm between the physical slip and the label's onset is not false.

    Args:
        promise: false alarms an hour without slip, at most.

    Raises:
        StoreError: no training or validation trial has both onsets, or one has no events.
        DetectorError: the evidence is invalid.
    """
    campaigns, labels = training_campaigns(collected(store, None)), StoreLabels(store)
    rule = campaigns[0].settings.detection
    asked = rule.compare or ComparisonSettings()
    train = scenes(labels, campaigns, "train", asked.train_trials)
    validation = scenes(labels, campaigns, "validation")
    detector.train(train, validation)
    judged = [judged_scene(it, feed(detector, it)) for it in validation]
    if promise is not None:
        (level,) = promised_levels(judged, [promise])
        return AtLevel(detector, level.value, level)
    rate = asked.rates[len(asked.rates) // 2]
    highest = sorted((_highest_when_still(it) for it in judged), reverse=True)
    return AtLevel(detector, highest[allowed_early(rate, len(judged))])


def _highest_when_still(judged: SceneEvidence) -> float:
    evidence = judged.evidence
    still = evidence.t_us < judged.slip.physical_us
    return float(evidence.value[still].max(initial=-np.inf))


def scenes(
    labels: StoreLabels, campaigns: Sequence[Collected], split: str, most: int | None = None
) -> list[Scene]:
    """Return the trials of a part of the split that have both onsets; at most so many.

    Raises:
        StoreError: there is none, or one has no events.
    """
    found = list(islice(each_scene(labels, campaigns, split), most))
    if not found:
        raise StoreError(f"{labels.store.folder}: no {split} trial has both onsets")
    return found


def each_scene(labels: StoreLabels, campaigns: Sequence[Collected], split: str) -> Iterator[Scene]:
    """Yield the trials of a part of the split that have both onsets, one at a time.

    Raises:
        StoreError: one has no events.
    """
    for item in campaigns:
        for _, recording in item.of_split(split):
            label = labels.read(item, recording)
            slip = true_slip(label)
            if slip is None:
                continue
            early_ns = round(item.settings.detection.false_early_ms * 1e6)
            still_ns = still_until_ns(slip, references_of(recording, label), early_ns)
            yield scene(recording, f"{item.name}/{recording.folder.name}", slip, still_ns)


def judged_scene(given: Scene, evidence: Evidence) -> SceneEvidence:
    """Return evidence on a stored trial, in which nothing slips up to `still_us`."""
    slip = given.slip
    still_us = slip.physical_us if given.still_us is None else given.still_us
    return SceneEvidence(evidence, replace(slip, physical_us=still_us))


def scene(recording: Recording, name: str, slip: TrueSlip, still_ns: int | None = None) -> Scene:
    """Return a trial's events from the start of its recording, with the slip that its label gives.

    Args:
        still_ns: moment up to which surely nothing slips.

    Raises:
        StoreError: it has no events.
    """
    clock = recording.clock("events")
    span_ns = recorded_span(recording)

    def us(time_ns: int) -> int:
        return int(clock.to_device(time_ns)) // 1000

    begin_us = us(span_ns[0])
    events = recording.events()
    first, last = np.searchsorted(events.t_us, [begin_us, us(span_ns[1])]).tolist()
    part = events[first:last]
    incipient_us = us(slip.incipient_ns) - begin_us
    return Scene(
        name,
        replace(part, t_us=part.t_us - begin_us),
        *recording.event_px,
        us(span_ns[1]) - begin_us,
        Slip(incipient_us, incipient_us, us(slip.gross_ns) - begin_us),
        still_us=None if still_ns is None else max(us(still_ns) - begin_us, 0),
    )
