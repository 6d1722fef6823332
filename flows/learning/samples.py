"""The samples of a part of the split: made once, kept in a file that maps into memory.

Training, evaluation and every other seed read the same file; it is made again when a label, a
recording or a setting changed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from analysis.nets import dataset
from analysis.nets.dataset import SampleSet
from flows.labelling.reviewed import Labels
from flows.running.campaigns import Collected, training_campaigns
from flows.running.trial_work import TrialWork, each_trial
from protocols.hashing import hash_integer
from protocols.settings import Samples, Windows
from storage.derived import Derived, make_key
from storage.recording import Recording

if TYPE_CHECKING:
    from flows.running.cluster import Cluster

STEP = "samples"


@dataclass(frozen=True)
class _Wanted:
    """What a trial's samples depend on besides the trial: see `dataset.trial_samples`."""

    label: dict[str, Any]
    number: int
    windows: Windows
    samples: Samples
    seed: int


def load_samples(
    labels: Labels, campaigns: list[Collected], split: str, cluster: Cluster | None = None
) -> SampleSet:
    """The samples of all trials of one split of the kinematic campaigns, mapped from their file.

    Without a cluster they are made in this process: a trial takes 10 ms. With one it stands in a
    flow.
    """
    used = training_campaigns(campaigns)
    windows = used[0].settings.windows
    inputs = [
        [item.name, trial.id, trial.index, recording.checksum, labels.key(item, recording)]
        for item in used
        for trial, recording in item.of_split(split)
    ]
    settings = [item.settings.samples.model_dump(mode="json") for item in used]
    key = make_key(STEP, dataset.VERSION, inputs, [windows.model_dump(mode="json"), settings])
    kept = Derived.of(labels.store, STEP)
    path = kept.folder / f"{split}.arrays"
    if not (kept.fresh(split, key) and path.exists()):
        made = _make(labels, used, split, windows, cluster)
        kept.folder.mkdir(parents=True, exist_ok=True)
        made.save(path)
        kept.write(split, key, {"samples": len(made), "cells": len(made.windows.cell)})
    return SampleSet.load(path)


def _make(
    labels: Labels,
    used: list[Collected],
    split: str,
    windows: Windows,
    cluster: Cluster | None,
) -> SampleSet:
    work = [
        TrialWork(
            recording, item.name, "",
            _Wanted(
                labels.read(item, recording), trial.index, windows,
                item.settings.samples, hash_integer("samples", trial.id),
            ),
        )
        for item in used
        for trial, recording in item.of_split(split)
    ]  # fmt: skip
    parts: dict[int, SampleSet] = {}
    each_trial(
        labels.store,
        f"samples to {split}",
        work,
        _samples,
        parts.__setitem__,
        cluster,
        processes=False,
    )
    return SampleSet.join([parts[number] for number in range(len(work))], windows)


def _samples(recording: Recording, wanted: _Wanted) -> SampleSet:
    return dataset.trial_samples(
        recording, wanted.label, wanted.number, wanted.windows, wanted.samples, wanted.seed
    )
