"""The chosen windows of test trials: what the network says of them, from every side.

The chosen network's figures by class, condition, phase and trial, all trained seeds beside it, what
its leads are worth, and what it computes. Everything that is fitted here is fitted on training or
validation trials.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.metrics import classification as metrics
from sliplab.analysis.metrics import reliability, window_groups
from sliplab.analysis.networks import model_file, synaptic, training
from sliplab.analysis.networks.baselines import evaluate_baselines
from sliplab.analysis.windows.dataset import SampleSet, recorded_span
from sliplab.flows.learning.samples import (
    TrialRef,
    by_id,
    load_samples,
    several,
    split_trials,
)
from sliplab.flows.learning.train import Model, training_settings
from sliplab.storage.files import read_json
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.store import Store

if TYPE_CHECKING:
    from sliplab.flows.labelling.reviewed import Labels
    from sliplab.flows.learning.evaluation_job import Job

VERSION = 4
STEP = "windows"
"""The network's counts of the test windows are kept under it, for what is compared later."""
NAME = "test"


def score_windows(job: Job, train: SampleSet, test: SampleSet, margin: float) -> dict[str, Any]:
    """All figures of the test windows; see docs/metrics.md.

    Args:
        margin: the lead in spikes by which windows and trials are judged alike.
    """
    settings = training_settings(job.campaigns)
    fitted = model_file.load(job.model.path)
    validation = load_samples(job.labels, job.campaigns, "validation")
    counts = training.predict_counts(fitted, test.windows)
    found, trial = by_id(split_trials(job.campaigns, "test")), test.trial
    known = [found[name] for name in test.trials]
    hits = window_groups.strict_hits(counts, test.y)
    Derived.of(job.store, STEP).write(
        NAME, job.key, {},
        {
            "counts": counts, "y": test.y, "trial": trial,
            "trials": np.array(test.trials, np.str_).reshape(-1, 2),
        },
    )  # fmt: skip
    cheap = evaluate_baselines(train.windows, train.y, test.windows, test.y)
    work = synaptic.count_work(fitted, test.windows)
    return {
        **metrics.score(counts, test.y, margin).as_dict(),
        "interval": window_groups.share(hits, trial),
        "reliability": reliability.by_lead(counts, test.y, trial),
        "calibration": reliability.calibration(
            counts,
            test.y,
            training.predict_counts(fitted, validation.windows),
            validation.y,
        ),
        "by_factor": window_groups.by_factor(
            hits, trial, {k: item.plan.describe(of) for k, (item, of, _) in enumerate(known)}
        ),
        **_phases(job.labels, known, test, trial, hits, settings.windows.length_ms),
        "by_trial": window_groups.by_trial(counts, test.y, trial, lambda k: _named(known[k])),
        "seeds": _seeds(job, test, margin),
        "work": None if work is None else work.as_dict(),
        "baselines": {name: score.argmax for name, score in cheap.items()},
        "beside": {
            name: compared(score.votes, counts, test.y, trial) for name, score in cheap.items()
        },
        "samples": {"train": len(train), "test": len(test)},
    }


def _named(of: TrialRef) -> dict[str, Any]:
    item, trial, _ = of
    return {"campaign": item.name, "trial": trial.id, "condition": item.plan.describe(trial)}


def _phases(
    labels: Labels,
    known: Sequence[TrialRef],
    test: SampleSet,
    trial: npt.NDArray[np.int64],
    hits: npt.NDArray[np.float64],
    length_ms: int,
) -> dict[str, Any]:
    """Recall by tenths of each class's phase, and of no slip before and during motion.

    A phase ends with the recording or where the next begins; a window belongs where its middle is.
    """
    middle = test.start_ns + length_ms * 500_000
    fraction = np.full(len(test), np.nan)
    moving = np.zeros(len(test), bool)
    for k in np.unique(trial).tolist():
        item, _, recording = known[k]
        label = labels.read(item, recording)
        start, end = recorded_span(recording)
        edges = [start, label.incipient_ns, label.gross_ns, end]
        there = trial == k
        moving |= there & (middle >= recording.step(recording.motion_phase)[0])
        for phase, (begin, over) in enumerate(itertools.pairwise(edges)):
            if begin is not None and over is not None and over > begin:
                ours = there & (test.y == phase)
                fraction[ours] = (middle[ours] - begin) / (over - begin)
    still = test.y == metrics.NO_SLIP
    hold, loading = still & ~moving, still & moving
    return {
        "by_tenth": window_groups.by_tenth(hits, test.y, trial, fraction),
        "no_slip": {
            "hold": window_groups.share(hits[hold], trial[hold]),
            "loading": window_groups.share(hits[loading], trial[loading]),
        },
    }


def _seeds(job: Job, test: SampleSet, margin: float) -> dict[str, Any]:
    """Every trained seed on the same windows: each, and mean, lowest and highest."""
    rows = []
    for model in job.models:
        counts = training.predict_counts(model_file.load(model.path), test.windows)
        found = asdict(metrics.accuracy(counts, test.y, margin))
        rows.append(
            {
                "seed": model.seed,
                "chosen": model.seed == job.model.seed,
                "validation_strict": read_json(model.info_path)["validation"]["strict"],
                **{kind: found[kind] for kind in _KINDS},
            }
        )
    spread = {}
    for kind in _KINDS:
        values = [row[kind] for row in rows if row[kind] is not None]
        spread[kind] = {
            "mean": float(np.mean(values)) if values else None,
            "min": min(values, default=None),
            "max": max(values, default=None),
        }
    return {"each": rows, "spread": spread}


_KINDS = ("argmax", "strict", "margin")


def key_inputs(models: Sequence[Model], campaigns: list[Collected]) -> list[Any]:
    """What the figures here depend on, beside the chosen model and the test trials."""
    return [VERSION, *several(campaigns), *(model.key for model in models)]


def compared(
    votes: npt.NDArray[Any],
    counts: npt.NDArray[np.int64],
    y: npt.NDArray[np.int64],
    trial: npt.NDArray[np.int64],
) -> dict[str, Any]:
    """Another method's votes (n, 3) beside the network's counts, on the same windows.

    Returns:
        ``argmax`` accuracy of the method with its interval over trials, and ``network_ahead``: the
        network's less the method's, of the same windows, with the interval of the difference.
    """
    ours, theirs = window_groups.credit(counts, y), window_groups.credit(votes, y)
    found = window_groups.share(theirs, trial)
    return {
        "argmax": found["share"],
        "low": found["low"],
        "high": found["high"],
        "network_ahead": window_groups.mean(ours - theirs, trial),
    }


def kept_counts(store: Store, evaluated: str | None) -> dict[str, npt.NDArray[Any]] | None:
    """``counts`` (n, 3), ``y`` (n,) and ``trial`` (n,) of an evaluation's test windows.

    None where they are not of the evaluation with this key.
    """
    kept = Derived.of(store, STEP)
    return kept.arrays(NAME) if evaluated is not None and kept.fresh(NAME, evaluated) else None


def window_intervals(store: Store, evaluated: str | None) -> dict[str, Any]:
    """Accuracy, and incipient precision and recall, of the test windows with intervals over trials.

    Args:
        evaluated: the evaluation's key.

    Returns:
        what `analysis.metrics.window_groups.share` gives, by name; empty where the evaluation
        kept none.
    """
    found = kept_counts(store, evaluated)
    if found is None:
        return {}
    return intervals_of(found["counts"], found["y"], found["trial"])


def intervals_of(
    counts: npt.NDArray[np.int64], y: npt.NDArray[np.int64], trial: npt.NDArray[np.int64]
) -> dict[str, Any]:
    """The same of counts (n, 3) with their classes (n,) and trials (n,)."""
    said = metrics.winners(counts)
    true, called = y == metrics.INCIPIENT, said == metrics.INCIPIENT
    both = (true & called).astype(np.float64)
    return {
        "accuracy": window_groups.share(window_groups.credit(counts, y), trial),
        "incipient_precision": window_groups.share(both[called], trial[called]),
        "incipient_recall": window_groups.share(both[true], trial[true]),
    }
