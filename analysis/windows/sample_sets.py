"""Cached samples of a part of the split, in a memory-mapped file.

Training, evaluation and every other seed read the same file; it is rebuilt when a label, a
recording or a setting changes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from sliplab.analysis.campaigns import Collected, agreeing, training_campaigns
from sliplab.analysis.labels.reviewed import StoreLabels
from sliplab.analysis.trial_work import EachTrial, TrialWork, in_order
from sliplab.analysis.windows import dataset
from sliplab.analysis.windows.dataset import SampleSet, TrialId
from sliplab.protocols import PlannedTrial
from sliplab.protocols.hashing import hash_integer
from sliplab.protocols.windows import SampleSettings, Windows
from sliplab.storage.schema.label import TrialLabel
from sliplab.storage.trials.derived import Derived, make_key
from sliplab.storage.trials.recording import Recording

STEP = "samples"
CLASS_PREFIX = "classes-"
"""Begins the names of samples of recordings of classes, and of what is made of them."""
_FORMAT = "trials by name"
_BY_PLACE = "numbered by place"
"""Part of keys over several campaigns, since windows are identified by their trial."""
TrialRef = tuple[Collected, PlannedTrial, Recording]
"""A trial with its campaign and its recording."""


@dataclass(frozen=True)
class _SampleInputs:
    """Inputs of a trial's samples besides the trial; see `dataset.trial_samples`."""

    label: TrialLabel
    trial: TrialId
    windows: Windows
    samples: SampleSettings
    seed: int
    classes: tuple[str, ...] = ()
    """Of recordings that show classes of their own."""


def split_trials(campaigns: list[Collected], split: str) -> list[TrialRef]:
    """Return the trials of a split, whose samples `load_samples` returns."""
    return [
        (item, trial, found)
        for item in training_campaigns(campaigns)
        for trial, found in item.of_split(split)
    ]


def by_id(trials: list[TrialRef]) -> dict[TrialId, TrialRef]:
    """Return trials by what their samples carry."""
    return {TrialId(item.name, trial.id): (item, trial, found) for item, trial, found in trials}


def several(campaigns: list[Collected]) -> list[str]:
    """Return an extra input for the key of a result that distinguishes windows by their trial.

    Empty for one campaign: only with several was a window ever given to the wrong trial.
    """
    return [_BY_PLACE] if len(training_campaigns(campaigns)) > 1 else []


def load_samples(
    labels: StoreLabels,
    campaigns: list[Collected],
    split: str,
    each: EachTrial = in_order,
    classes: tuple[str, ...] = (),
) -> SampleSet:
    """Load the samples of all trials of one split, memory-mapped.

    Args:
        each: makes what is missing; in this process a trial takes 10 ms.
        classes: that the recordings show; by default slip, in the kinematic campaigns.
    """
    used = agreeing(campaigns) if classes else training_campaigns(campaigns)
    windows = used[0].settings.windows
    trials = [(item, trial, found) for item in used for trial, found in item.of_split(split)]
    inputs = [
        [_FORMAT],
        *(
            [item.name, trial.id, trial.index, recording.checksum, labels.key(item, recording)]
            for item, trial, recording in trials
        ),
    ]
    settings = [item.settings.samples.model_dump(mode="json") for item in used]
    parameters: list[Any] = [windows.model_dump(mode="json"), settings]
    key = make_key(STEP, dataset.VERSION, inputs, [*parameters, classes] if classes else parameters)
    stored = Derived.of(labels.store, STEP)
    name = f"{CLASS_PREFIX}{split}" if classes else split
    path = stored.folder / f"{name}.arrays"
    if not (stored.fresh(name, key) and path.exists()):
        made = _make(labels, trials, windows, each, classes)
        stored.folder.mkdir(parents=True, exist_ok=True)
        made.save(path)
        stored.write(name, key, {"samples": len(made), "cells": len(made.windows.cell)})
    return SampleSet.load(path)


def _make(
    labels: StoreLabels,
    trials: list[TrialRef],
    windows: Windows,
    each: EachTrial,
    classes: tuple[str, ...],
) -> SampleSet:
    work = [
        TrialWork(
            recording,
            item.name,
            "",
            _SampleInputs(
                labels.read(item, recording),
                TrialId(item.name, trial.id),
                windows,
                item.settings.samples,
                hash_integer("samples", trial.id),
                classes,
            ),
        )
        for item, trial, recording in trials
    ]
    parts: dict[int, SampleSet] = {}
    each(work, _samples, parts.__setitem__)
    return SampleSet.join([parts[number] for number in range(len(work))], windows)


def _samples(recording: Recording, inputs: _SampleInputs) -> SampleSet:
    return dataset.trial_samples(recording, **vars(inputs))
