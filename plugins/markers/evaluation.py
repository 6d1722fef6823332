"""Training and evaluation of the classifier on marker displacements, for rigs without events.

The result is the same document that the spiking network's evaluation is, under the same name. Its
counts are points of probability. It has no synaptic operations, and no other detectors.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from sliplab.analysis.campaigns import Collected, kinematic_campaigns
from sliplab.analysis.detectors.latency import true_slip
from sliplab.analysis.detectors.rule_sweep import SpikeCounts, choose_smoothing, settled
from sliplab.analysis.evaluation.evaluation import BY_SEED_VERSION, FORMAT, NAME, STEP
from sliplab.analysis.evaluation.trials import score_row, summaries
from sliplab.analysis.evaluation.windows import NAME as WINDOWS_NAME
from sliplab.analysis.evaluation.windows import STEP as WINDOWS
from sliplab.analysis.evaluation.windows import compared, named, phases, seed_scores
from sliplab.analysis.labels.label_errors import label_errors, rules_compared
from sliplab.analysis.labels.reviewed import StoreLabels
from sliplab.analysis.metrics import classification as metrics
from sliplab.analysis.metrics import reliability, window_groups
from sliplab.analysis.networks.baselines import fit_rate_thresholds
from sliplab.analysis.networks.models import ModelOnDisk, choose_model
from sliplab.analysis.windows.sample_sets import TrialRef, by_id
from sliplab.plugins.markers import displacement, marker_net
from sliplab.plugins.markers.displacement import (
    FRAMES,
    MarkerSamples,
    all_frames,
    load_marker_samples,
    marker_displacements,
)
from sliplab.plugins.markers.marker_net import BATCH, EPOCHS, HIDDEN, POINTS, MarkerNet
from sliplab.protocols.detection import Detection
from sliplab.storage.files import write_json
from sliplab.storage.schema.evaluation import (
    Evaluation,
    MarkerClassifier,
    SampleCounts,
    TrialScore,
    WindowScores,
)
from sliplab.storage.schema.model import ModelSamples, TrainedModel, ValidationAccuracy
from sliplab.storage.trials.derived import Derived, make_key
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import StoreError

F32 = npt.NDArray[np.float32]
I64 = npt.NDArray[np.int64]

VERSION = 1
SMOOTHINGS = (1, 2, 3, 4, 6, 8)
MARGINS = (0.0, 10.0, 20.0, 40.0, 60.0, 80.0)
"""Grid of the rule: frames, and points of `marker_net.POINTS`."""
SMOOTHING, MARGIN = 3, 40.0
"""The rule where no trial can choose it."""


def wanted_marker_models(labels: StoreLabels, campaigns: list[Collected]) -> list[ModelOnDisk]:
    """The models that the settings ask for, one a seed, with the keys they must have.

    Raises:
        StoreError: a trial has no fresh label yet or no frames, or there is no kinematic campaign.
    """
    used = kinematic_campaigns(campaigns)
    inputs = []
    for item in used:
        item.need("frames", "the classifier is trained on the markers in them")
        for trial, recording in item.trials:
            if not labels.fresh(item, recording):
                raise StoreError(f"{item.name}: {trial.id} has no label yet; run `sliplab label`")
            if trial.split in {"train", "validation"}:
                inputs.append([item.name, trial.id, trial.split, labels.key(item, recording)])
    settings = used[0].settings
    fixed = [
        marker_net.KIND,
        displacement.VERSION,
        FRAMES,
        HIDDEN,
        EPOCHS,
        BATCH,
        marker_net.LEARNING_RATE,
        marker_net.RIDGE,
        [item.settings.samples.per_class for item in used],
    ]
    return [
        ModelOnDisk(
            seed,
            labels.store.folder / "models" / f"markers-seed{seed}.model",
            make_key("train markers", marker_net.VERSION, inputs, [*fixed, seed]),
            settings,
        )
        for seed in settings.training.seeds
    ]


def train_marker_model(
    model: ModelOnDisk, train: MarkerSamples, validation: MarkerSamples, *, simulated: bool
) -> MarkerNet:
    """Train one seed and keep it; the document is written last and marks it as complete.

    Raises:
        StoreError: there are too few samples.
    """
    try:
        net = marker_net.fit(train, validation, model.seed)
    except ValueError as error:
        raise StoreError(str(error)) from None
    model.path.parent.mkdir(parents=True, exist_ok=True)
    marker_net.save(model.path, net)
    points = net.points(validation.x)
    found = metrics.accuracy(points, validation.y, MARGIN)
    info = TrainedModel(
        key=model.key,
        seed=model.seed,
        samples=ModelSamples(train=len(train), validation=len(validation)),
        chosen_epoch=net.chosen_epoch,
        validation=ValidationAccuracy(
            argmax=found.argmax, strict=found.strict, margin=found.margin
        ),
        simulated=simulated,
    )
    write_json(model.info_path, info.to_json())
    return net


@dataclass(frozen=True)
class MarkerJob:
    """Everything that an evaluation depends on, found before anything is computed."""

    labels: StoreLabels
    campaigns: list[Collected]
    models: list[ModelOnDisk]
    model: ModelOnDisk
    detection: dict[str, Detection]
    key: str


def make_marker_job(
    labels: StoreLabels,
    campaigns: list[Collected],
    margin: float | None = None,
    smoothing: int | None = None,
) -> MarkerJob:
    """Find the inputs of the evaluation, and its rule.

    Args:
        margin: points; smoothing: frames. With either nothing is chosen by validation trials.

    Raises:
        StoreError: a model or a label is missing or stale.
    """
    models = wanted_marker_models(labels, campaigns)
    model = choose_model(models)
    chosen = margin is None and smoothing is None
    detection, inputs = {}, []
    for item in campaigns:
        stated = item.settings.detection
        by = "test" if stated.choose == "test" else "validation"
        change = {
            "smoothing": SMOOTHING if smoothing is None else smoothing,
            "margin": MARGIN if margin is None else margin,
            "choose": by if chosen else "protocol",
            "stride_ms": None,
            "compare": None,
            "smoothing_grid": SMOOTHINGS,
            "margin_grid": MARGINS,
        }
        detection[item.name] = Detection.model_validate({**stated.model_dump(), **change})
        for trial, recording in item.trials:
            if not labels.fresh(item, recording):
                raise StoreError(f"{item.name}: {trial.id} has no label yet; run `sliplab label`")
            inputs.append([item.name, trial.id, trial.split, labels.key(item, recording)])
    used = {name: value.model_dump(mode="json") for name, value in detection.items()}
    states = labels.states(campaigns)
    of_review = [] if states is None else [states]
    keys = [each.key for each in models]
    # evaluations of one seed, of before, are fresh all the same
    of_seeds = [BY_SEED_VERSION] if len(models) > 1 else []
    made_of = [keys, model.key, inputs, *of_review, *of_seeds]
    key = make_key("evaluate markers", VERSION, made_of, used)
    return MarkerJob(labels, campaigns, models, model, detection, key)


def evaluate_markers(job: MarkerJob) -> None:
    """Score windows, detections and labels of the test trials, and keep them as one result."""
    labels, campaigns = job.labels, job.campaigns
    nets = {model.seed: marker_net.load(model.path) for model in job.models}
    net = nets[job.model.seed]
    kinematic = kinematic_campaigns(campaigns)
    by = job.detection[kinematic[0].name].choose
    choosing = [] if by == "protocol" else _counted(job, net, by)
    detection, choices = {}, {}
    for item in campaigns:
        rule = job.detection[item.name]
        choice = choose_smoothing(choosing, rule, by) if choosing else None
        choices[item.name] = choice
        detection[item.name] = settled(rule, choice)
        if choice is None:
            detection[item.name] = rule.model_copy(update={"choose": "protocol"})
    of_seeds = _rows(job, nets, detection)
    rows = of_seeds[job.model.seed]
    states = labels.states(campaigns)
    result = Evaluation(
        format=FORMAT,
        seed=job.model.seed,
        windows=_score_windows(job, net, detection[kinematic[0].name].margin),
        trials=tuple(rows),
        experiments=summaries(rows, of_seeds, job.model.seed),
        label_error_ms=label_errors(labels.store, campaigns),
        label_rules_ms=rules_compared(labels.store, campaigns),
        reviewed=None if states is None else {str(name): n for name, n in states.items()},
        detection=detection,
        choices=choices,
        detectors=None,
        classifier=MarkerClassifier(
            title=net.title,
            frames=FRAMES,
            markers=net.markers,
            points=POINTS,
            weights=net.size,
            multiply_adds=net.multiply_adds,
        ),
    )
    Derived.of(labels.store, STEP).write(NAME, job.key, result)


def _frames(labels: StoreLabels, item: Collected, recording: Recording) -> tuple[F32, I64]:
    """Return every window of a trial, and the times of their newest frames."""
    frame_ns, moved = marker_displacements(labels, item, recording)
    x, newest = all_frames(moved)
    return x, frame_ns[newest]


def _counted(job: MarkerJob, net: MarkerNet, split: str) -> list[SpikeCounts]:
    """Return the kinematic trials of a split that have both onsets."""
    found = []
    for item in kinematic_campaigns(job.campaigns):
        for _, recording in item.of_split(split):
            slip = true_slip(job.labels.read(item, recording))
            if slip is not None:
                x, end_ns = _frames(job.labels, item, recording)
                found.append(SpikeCounts(net.points(x), end_ns, slip))
    return found


def _rows(
    job: MarkerJob, nets: Mapping[int, MarkerNet], rules: Mapping[str, Detection]
) -> dict[int, list[TrialScore]]:
    """Return a row for each test trial, by the network's seed; rules are those of campaigns."""
    found: dict[int, list[TrialScore]] = {seed: [] for seed in nets}
    for item in job.campaigns:
        for trial, recording in item.of_split("test"):
            x, end_ns = _frames(job.labels, item, recording)
            label = job.labels.read(item, recording)
            for seed, net in nets.items():
                row = score_row(item, trial, label, net.points(x), end_ns, rules[item.name])
                found[seed].append(row)
    return found


def _score_windows(job: MarkerJob, net: MarkerNet, margin: float) -> WindowScores:
    """Score the windows of the kinematic test trials; see `windows.score_windows`."""
    labels, campaigns = job.labels, job.campaigns
    train, validation, test = (
        load_marker_samples(labels, campaigns, split) for split in ("train", "validation", "test")
    )
    if not len(test):
        raise StoreError("there are no test samples; collect more trials")
    trials: list[TrialRef] = [
        (item, trial, recording)
        for item in kinematic_campaigns(campaigns)
        for trial, recording in item.of_split("test")
    ]
    found, trial = by_id(trials), test.trial
    known = [found[name] for name in test.trials]
    points = net.points(test.x)
    hits = window_groups.strict_hits(points, test.y)
    by_tenth, no_slip = phases(labels, known, test.newest_ns, test.y, trial, hits)
    stored = Derived.of(labels.store, WINDOWS)
    stored.write(
        WINDOWS_NAME,
        job.key,
        {},
        {
            "counts": points,
            "y": test.y,
            "trial": trial,
            "trials": np.array(test.trials, np.str_).reshape(-1, 2),
        },
    )
    cheap = _cheap(train, test)
    return WindowScores(
        **dict(metrics.score(points, test.y, margin)),
        interval=window_groups.share(hits, trial),
        reliability=tuple(reliability.by_lead(points, test.y, trial)),
        calibration=reliability.calibration(points, test.y, net.points(validation.x), validation.y),
        by_factor=window_groups.by_factor(
            hits, trial, {k: item.describe(of) for k, (item, of, _) in enumerate(known)}
        ),
        by_tenth=by_tenth,
        no_slip=no_slip,
        by_trial=tuple(window_groups.by_trial(points, test.y, trial, lambda k: named(known[k]))),
        seeds=seed_scores(
            job.models,
            job.model,
            test.y,
            margin,
            lambda model: marker_net.load(model.path).points(test.x),
        ),
        work=None,
        baselines={name: metrics.accuracy(votes, test.y).argmax for name, votes in cheap.items()},
        beside={name: compared(votes, points, test.y, trial) for name, votes in cheap.items()},
        samples=SampleCounts(train=len(train), test=len(test)),
    )


def _cheap(train: MarkerSamples, test: MarkerSamples) -> dict[str, npt.NDArray[Any]]:
    """Return votes (n, 3) of simple methods, fitted on training samples.

    Two thresholds on one number each: the mean, and the largest, displacement of the newest frame.
    """
    each = np.bincount(train.y, minlength=len(metrics.CLASSES))
    found: dict[str, npt.NDArray[Any]] = {"majority": np.tile(each, (len(test), 1))}
    for name, over in (("mean_displacement", np.mean), ("largest_displacement", np.max)):
        one, other = (
            np.asarray(over(np.hypot(*np.moveaxis(part.x[:, -1].astype(np.float64), 2, 0)), axis=1))
            for part in (train, test)
        )
        low, high, table = fit_rate_thresholds(one, train.y)
        found[name] = table[np.searchsorted([low, high], other)]
    return found
