"""Evaluation of the network on recordings that show one of several classes each.

Windows are scored as those of slip are; besides, whole recordings, each class by itself, and the
beginnings of windows: how early a class is known.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from sliplab.analysis.campaigns import Collected, agreeing
from sliplab.analysis.evaluation.evaluation import STEP
from sliplab.analysis.evaluation.windows import NAME as WINDOWS_NAME
from sliplab.analysis.evaluation.windows import STEP as WINDOWS
from sliplab.analysis.evaluation.windows import compared, seed_scores
from sliplab.analysis.labels.reviewed import StoreLabels
from sliplab.analysis.metrics import classification as metrics
from sliplab.analysis.metrics import window_groups
from sliplab.analysis.networks import model_file, synaptic, training
from sliplab.analysis.networks.baselines import (
    cheap_votes,
    logistic_cells,
    logistic_slices,
)
from sliplab.analysis.networks.models import ModelOnDisk, choose_model
from sliplab.analysis.networks.training import Fitted
from sliplab.analysis.windows.dataset import SampleSet
from sliplab.analysis.windows.sample_sets import CLASS_PREFIX, TrialRef, by_id
from sliplab.plugins.classes.document import (
    ClassEvaluation,
    ClassScore,
    ClassScores,
    LengthShare,
    TrialAccuracy,
    WrongTrial,
)
from sliplab.storage.schema.evaluation import Baseline, PartTrials
from sliplab.storage.trials.derived import Derived, make_key
from sliplab.storage.trials.store import StoreError, TrialStore

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]
VERSION = 1
NAME = "classes"
"""Of the evaluation among the results of its step."""
SPLITS = ("train", "validation", "test")
LENGTHS = (0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
"""Beginnings of windows that are scored, as shares of their steps."""


@dataclass(frozen=True)
class ClassJob:
    """Everything that an evaluation depends on, found before anything is computed."""

    labels: StoreLabels
    campaigns: list[Collected]
    classes: tuple[str, ...]
    models: list[ModelOnDisk]
    model: ModelOnDisk
    """The chosen one."""
    key: str


def make_class_job(
    labels: StoreLabels,
    campaigns: list[Collected],
    classes: tuple[str, ...],
    models: list[ModelOnDisk],
) -> ClassJob:
    """Find the inputs of the evaluation.

    Raises:
        StoreError: a model or a label is missing or stale.
    """
    model = choose_model(models)
    inputs = [
        [item.name, trial.id, labels.key(item, recording)]
        for item in agreeing(campaigns)
        for trial, recording in item.of_split("test")
    ]
    states = labels.states(campaigns)
    of_review = [] if states is None else [states]
    keys = [each.key for each in models]
    key = make_key("evaluate classes", VERSION, [keys, model.key, inputs, *of_review], None)
    return ClassJob(labels, campaigns, classes, models, model, key)


def class_evaluation_of(store: TrialStore) -> ClassEvaluation:
    """Return the store's evaluation of classes.

    Raises:
        StoreError: it does not exist, or another version of the program made it.
    """
    stored = Derived.of(store, STEP)
    if stored.key(NAME) is None:
        raise StoreError(f"{store.folder}: nothing evaluated yet; run `sliplab evaluate` first")
    if stored.read(NAME).get("version") != VERSION:
        raise StoreError(
            f"{store.folder}: evaluated by another version of this program; run `sliplab evaluate`"
        )
    return stored.load(NAME, ClassEvaluation)


def evaluate_classes(job: ClassJob, parts: Mapping[str, SampleSet]) -> None:
    """Score the test windows, and keep all figures as one result.

    Args:
        parts: samples by part of the split.

    Raises:
        StoreError: there are no test samples.
    """
    if not len(parts["test"]):
        raise StoreError("there are no test samples; import more trials, or change the split")
    states = job.labels.states(job.campaigns)
    result = ClassEvaluation(
        version=VERSION,
        seed=job.model.seed,
        reviewed=None if states is None else {str(name): n for name, n in states.items()},
        scores=_scores(job, parts),
    )
    Derived.of(job.labels.store, STEP).write(NAME, job.key, result)


def _scores(job: ClassJob, parts: Mapping[str, SampleSet]) -> ClassScores:
    fitted = model_file.load(job.model.path)
    test = parts["test"]
    trials: list[TrialRef] = [
        (item, trial, found)
        for item in agreeing(job.campaigns)
        for trial, found in item.of_split("test")
    ]
    found, trial, y = by_id(trials), test.trial, test.y
    known = [found[name] for name in test.trials]
    counts = training.predict_counts(fitted, test.windows)
    Derived.of(job.labels.store, WINDOWS).write(
        f"{CLASS_PREFIX}{WINDOWS_NAME}", job.key, {}, {"counts": counts, "y": y, "trial": trial}
    )
    hits = window_groups.strict_hits(counts, y)
    confusion = metrics.confusion(counts, y)
    margin = fitted.network.margin
    return ClassScores(
        classes=job.classes,
        accuracy=metrics.accuracy(counts, y, margin),
        interval=window_groups.share(hits, trial),
        trials=_whole(counts, y, trial),
        confusion=tuple(map(tuple, confusion.tolist())),
        by_class=_by_class(job.classes, parts, confusion, hits),
        by_factor=window_groups.by_factor(
            hits, trial, {k: item.describe(of) for k, (item, of, _) in enumerate(known)}
        ),
        by_length=by_length(fitted, test),
        wrong=_wrong(job.classes, counts, y, trial, known, hits),
        seeds=seed_scores(
            job.models,
            job.model,
            y,
            margin,
            lambda model: training.predict_counts(model_file.load(model.path), test.windows),
        ),
        work=synaptic.count_work(fitted, test.windows),
        beside=_beside(job.classes, parts, counts),
        windows=_part_numbers({name: len(part) for name, part in parts.items()}),
        recordings=_part_numbers(
            {
                split: sum(1 for item in job.campaigns for _ in item.of_split(split))
                for split in SPLITS
            }
        ),
    )


def _part_numbers(numbers: Mapping[str, int]) -> PartTrials:
    return PartTrials(**{split: numbers[split] for split in SPLITS})


def whole_recordings(counts: I64, y: I64, trial: I64) -> tuple[I64, I64, I64]:
    """Add up the counts of the windows of each trial and class.

    Args:
        counts: (n, classes). y, trial: (n,).

    Returns:
        counts (m, classes), true classes (m,) and trials (m,) of the recordings.
    """
    each, place = np.unique(np.stack([trial, y], axis=1), axis=0, return_inverse=True)
    sums = np.zeros((len(each), counts.shape[1]), np.int64)
    np.add.at(sums, place.reshape(-1), counts)
    return sums, each[:, 1], each[:, 0]


def _whole(counts: I64, y: I64, trial: I64) -> TrialAccuracy:
    sums, true, of = whole_recordings(counts, y, trial)
    return TrialAccuracy(
        argmax=window_groups.share(metrics.credit(sums, true), of),
        strict=window_groups.share(window_groups.strict_hits(sums, true), of),
    )


def _wrong(
    classes: Sequence[str], counts: I64, y: I64, trial: I64, known: Sequence[TrialRef], hits: F64
) -> tuple[WrongTrial, ...]:
    """List the recordings that were not classified rightly, by their true class."""
    sums, true, of = whole_recordings(counts, y, trial)
    called = metrics.winners(sums).astype(np.int64)
    rows = []
    for k in np.flatnonzero(called != true).tolist():
        item, planned, _ = known[of[k]]
        there = (trial == of[k]) & (y == true[k])
        rows.append(
            (
                (int(true[k]), int(of[k])),
                WrongTrial(
                    campaign=item.name,
                    trial=planned.id,
                    condition=item.describe(planned),
                    true=classes[true[k]],
                    called=None if called[k] < 0 else classes[called[k]],
                    windows=int(there.sum()),
                    right=int(hits[there].sum()),
                ),
            )
        )
    return tuple(row for _, row in sorted(rows, key=lambda pair: pair[0]))


def _by_class(
    classes: Sequence[str], parts: Mapping[str, SampleSet], confusion: I64, hits: F64
) -> tuple[ClassScore, ...]:
    test = parts["test"]
    each = {name: np.bincount(part.y, minlength=len(classes)) for name, part in parts.items()}
    stated = confusion.sum(axis=0)
    rows = []
    for k, name in enumerate(classes):
        there = test.y == k
        rows.append(
            ClassScore(
                name=name,
                recall=window_groups.share(hits[there], test.trial[there]),
                precision=int(confusion[k, k]) / int(stated[k]) if stated[k] else None,
                windows=_part_numbers({split: int(each[split][k]) for split in SPLITS}),
            )
        )
    return tuple(rows)


def by_length(fitted: Fitted, test: SampleSet) -> tuple[LengthShare, ...]:
    """Return argmax accuracy after the first steps of each window, the fewest first.

    The network spikes step by step and looks at nothing ahead, so its counts after some steps are
    those of the same network on a window of so many.
    """
    windows = fitted.windows
    steps = sorted({max(1, round(share * windows.steps)) for share in LENGTHS})
    rows = []
    for n in steps:
        seen = windows.model_copy(update={"length_ms": n * windows.step_ms})
        counts = training.predict_counts(replace(fitted, windows=seen), test.windows.first_steps(n))
        found = window_groups.share(metrics.credit(counts, test.y), test.trial)
        rows.append(LengthShare(ms=seen.length_ms, **dict(found)))
    return tuple(rows)


def _beside(
    classes: Sequence[str], parts: Mapping[str, SampleSet], counts: I64
) -> dict[str, Baseline]:
    train, test = parts["train"], parts["test"]
    votes = cheap_votes(train.windows, train.y, test.windows, len(classes))
    for name, fit in (("logistic_cells", logistic_cells), ("logistic_slices", logistic_slices)):
        votes[name], _ = fit(train.windows, train.y, test.windows, len(classes))
    return {name: compared(each, counts, test.y, test.trial) for name, each in votes.items()}
