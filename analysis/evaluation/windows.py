"""The chosen windows of test trials: figures of the network, by class, condition, phase and trial.

All trained seeds are scored like the chosen one, with the reliability of its leads and what it
computes. Everything that is fitted here is fitted on training or validation trials.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.labels.reviewed import StoreLabels
from sliplab.analysis.metrics import classification as metrics
from sliplab.analysis.metrics import reliability, window_groups
from sliplab.analysis.networks import model_file, synaptic, training
from sliplab.analysis.networks.baselines import cheap_votes
from sliplab.analysis.networks.models import ModelOnDisk, training_settings
from sliplab.analysis.windows.dataset import SampleSet, recorded_span
from sliplab.analysis.windows.sample_sets import (
    TrialRef,
    by_id,
    load_samples,
    several,
    split_trials,
)
from sliplab.storage.schema.evaluation import (
    Baseline,
    NoSlip,
    SampleCounts,
    Seeds,
    SeedScores,
    SeedSpread,
    Tenth,
    WindowIntervals,
    WindowScores,
)
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.store import TrialStore

VERSION = 4
STEP = "windows"
"""Step that stores the network's counts of the test windows, for later comparisons."""
NAME = "test"


def score_windows(
    labels: StoreLabels,
    campaigns: list[Collected],
    models: Sequence[ModelOnDisk],
    chosen: ModelOnDisk,
    key: str,
    train: SampleSet,
    test: SampleSet,
    margin: float,
) -> WindowScores:
    """Score the test windows (docs/metrics.md), and keep the network's counts of them.

    Args:
        models: of all seeds, the chosen one among them.
        key: the evaluation's, under which the counts are stored.
        margin: the lead in spikes by which windows and trials are evaluated alike.
    """
    settings = training_settings(campaigns)
    fitted = model_file.load(chosen.path)
    validation = load_samples(labels, campaigns, "validation")
    counts = training.predict_counts(fitted, test.windows)
    found, trial = by_id(split_trials(campaigns, "test")), test.trial
    known = [found[name] for name in test.trials]
    hits = window_groups.strict_hits(counts, test.y)
    Derived.of(labels.store, STEP).write(
        NAME,
        key,
        {},
        {
            "counts": counts,
            "y": test.y,
            "trial": trial,
            "trials": np.array(test.trials, np.str_).reshape(-1, 2),
        },
    )
    cheap = cheap_votes(train.windows, train.y, test.windows)
    middle = test.start_ns + settings.windows.length_ms * 500_000
    by_tenth, no_slip = phases(labels, known, middle, test.y, trial, hits)
    return WindowScores(
        **dict(metrics.score(counts, test.y, margin)),
        interval=window_groups.share(hits, trial),
        reliability=tuple(reliability.by_lead(counts, test.y, trial)),
        calibration=reliability.calibration(
            counts,
            test.y,
            training.predict_counts(fitted, validation.windows),
            validation.y,
        ),
        by_factor=window_groups.by_factor(
            hits, trial, {k: item.describe(of) for k, (item, of, _) in enumerate(known)}
        ),
        by_tenth=by_tenth,
        no_slip=no_slip,
        by_trial=tuple(window_groups.by_trial(counts, test.y, trial, lambda k: named(known[k]))),
        seeds=seed_scores(
            models,
            chosen,
            test.y,
            margin,
            lambda model: training.predict_counts(model_file.load(model.path), test.windows),
        ),
        work=synaptic.count_work(fitted, test.windows),
        baselines={name: metrics.accuracy(votes, test.y).argmax for name, votes in cheap.items()},
        beside={name: compared(votes, counts, test.y, trial) for name, votes in cheap.items()},
        samples=SampleCounts(train=len(train), test=len(test)),
    )


def named(of: TrialRef) -> tuple[str, str, dict[str, str]]:
    """Return campaign, id and condition of a trial."""
    item, trial, _ = of
    return item.name, trial.id, item.describe(trial)


def phases(
    labels: StoreLabels,
    known: Sequence[TrialRef],
    place_ns: npt.NDArray[np.int64],
    y: npt.NDArray[np.int64],
    trial: npt.NDArray[np.int64],
    hits: npt.NDArray[np.float64],
) -> tuple[dict[str, tuple[Tenth, ...]], NoSlip]:
    """Recall by tenths of each class's phase, and of no slip before and during motion.

    A phase ends with the recording or where the next begins.

    Args:
        place_ns: (n,) where each window belongs, such as its middle.
    """
    fraction = np.full(len(y), np.nan)
    moving = np.zeros(len(y), bool)
    for k in np.unique(trial).tolist():
        item, _, recording = known[k]
        label = labels.read(item, recording)
        start, end = recorded_span(recording)
        edges = [start, label.incipient_ns, label.gross_ns, end]
        there = trial == k
        moving |= there & (place_ns >= recording.motion_ns[0])
        for phase, (begin, over) in enumerate(itertools.pairwise(edges)):
            if begin is not None and over is not None and over > begin:
                ours = there & (y == phase)
                fraction[ours] = (place_ns[ours] - begin) / (over - begin)
    still = y == metrics.NO_SLIP
    hold, loading = still & ~moving, still & moving
    return (
        window_groups.by_tenth(hits, y, trial, fraction),
        NoSlip(
            hold=window_groups.share(hits[hold], trial[hold]),
            loading=window_groups.share(hits[loading], trial[loading]),
        ),
    )


def seed_scores(
    models: Sequence[ModelOnDisk],
    chosen: ModelOnDisk,
    y: npt.NDArray[np.int64],
    margin: float,
    counts_of: Callable[[ModelOnDisk], npt.NDArray[np.int64]],
) -> Seeds:
    """Every trained seed on the same windows: each, and mean, lowest and highest."""
    rows = []
    for model in models:
        found = metrics.accuracy(counts_of(model), y, margin)
        rows.append(
            SeedScores(
                seed=model.seed,
                chosen=model.seed == chosen.seed,
                validation_strict=model.info.validation.strict,
                **found.model_dump(exclude={"n"}),
            )
        )
    spread = {}
    for kind in _KINDS:
        values = [value for row in rows if (value := getattr(row, kind)) is not None]
        spread[kind] = SeedSpread(
            mean=float(np.mean(values)) if values else None,
            min=min(values, default=None),
            max=max(values, default=None),
        )
    return Seeds(each=tuple(rows), spread=spread)


_KINDS = ("argmax", "strict", "margin")


def key_inputs(models: Sequence[ModelOnDisk], campaigns: list[Collected]) -> list[Any]:
    """Return the inputs of these figures besides the chosen model and the test trials."""
    return [VERSION, *several(campaigns), *(model.key for model in models)]


def compared(
    votes: npt.NDArray[Any],
    counts: npt.NDArray[np.int64],
    y: npt.NDArray[np.int64],
    trial: npt.NDArray[np.int64],
) -> Baseline:
    """Compare another method's votes (n, 3) with the network's counts, on the same windows."""
    ours, theirs = metrics.credit(counts, y), metrics.credit(votes, y)
    found = window_groups.share(theirs, trial)
    return Baseline(
        argmax=found.share,
        low=found.low,
        high=found.high,
        network_ahead=window_groups.mean(ours - theirs, trial),
    )


def kept_counts(
    store: TrialStore, evaluated: str | None, of: str = ""
) -> dict[str, npt.NDArray[Any]] | None:
    """``counts`` (n, classes), ``y`` (n,) and ``trial`` (n,) of an evaluation's test windows.

    None where they are not of the evaluation with this key.

    Args:
        of: prefix of the name that they are stored under.
    """
    saved, name = Derived.of(store, STEP), f"{of}{NAME}"
    return saved.arrays(name) if evaluated is not None and saved.fresh(name, evaluated) else None


def window_intervals(store: TrialStore, evaluated: str | None) -> WindowIntervals | None:
    """Return intervals over trials of the test windows' figures; None without stored counts.

    Args:
        evaluated: the evaluation's key.
    """
    found = kept_counts(store, evaluated)
    if found is None:
        return None
    return intervals_of(found["counts"], found["y"], found["trial"])


def intervals_of(
    counts: npt.NDArray[np.int64], y: npt.NDArray[np.int64], trial: npt.NDArray[np.int64]
) -> WindowIntervals:
    """The same of counts (n, 3) with their classes (n,) and trials (n,)."""
    stated = metrics.winners(counts)
    true, called = y == metrics.INCIPIENT, stated == metrics.INCIPIENT
    both = (true & called).astype(np.float64)
    return WindowIntervals(
        accuracy=window_groups.share(metrics.credit(counts, y), trial),
        incipient_precision=window_groups.share(both[called], trial[called]),
        incipient_recall=window_groups.share(both[true], trial[true]),
    )
