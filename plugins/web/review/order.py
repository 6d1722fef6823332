"""Trials in the order of what a review of their label would change, and what reviews would gain.

A trial's score is the largest expected change of any figure, as a share of the width of that
figure's own 95 % interval over trials.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.evaluation.evaluation import evaluation_of
from sliplab.analysis.evaluation.windows import kept_counts
from sliplab.analysis.windows.dataset import SampleSet
from sliplab.analysis.windows.sample_sets import STEP as SAMPLES
from sliplab.plugins.web.review.doubt import (
    LabelDoubt,
    ReviewedTrial,
    doubts_of,
    labelled_trials,
    unusable_shares,
)
from sliplab.plugins.web.review.influence import (
    Name,
    ReviewDraws,
    ReviewStatistic,
    accuracy_figure,
    time_figures,
    trained_shares,
)
from sliplab.protocols.shown import plural
from sliplab.storage.errors import StoreError
from sliplab.storage.schema.evaluation import Evaluation
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.store import TrialStore

TRAINING = "training windows"
"""Windows that train or choose the network."""
_ALONE = "ordered by doubt alone"
_NORMAL_95 = 3.92
"""Width of the central 95 % of a normal distribution, in standard deviations."""


@dataclass(frozen=True)
class ExpectedChange:
    """The expected change of one figure by the review of one trial.

    Attributes:
        figure: its name; experiment: of its trials. unit: ``ms`` or ``share``.
        change: mean absolute change; signed: mean change, of training windows None.
        of_interval: the first over the width of the figure's interval; None without one.
    """

    figure: str
    experiment: str
    unit: str
    change: float
    signed: float | None
    of_interval: float | None


@dataclass(frozen=True)
class Waiting:
    """A trial that is to be reviewed, and the figures that this may move, the most first."""

    campaign: str
    trial: str
    split: str
    doubt: LabelDoubt
    moves: tuple[ExpectedChange, ...]

    @property
    def name(self) -> Name:
        """Campaign and trial."""
        return self.campaign, self.trial

    @property
    def score(self) -> float:
        """The largest change as a share of a figure's interval."""
        return max((move.of_interval or 0.0 for move in self.moves), default=0.0)


@dataclass(frozen=True)
class Gain:
    """Effect of the reviews on one figure.

    Attributes:
        value: now. width: of its 95 % interval over trials.
        label_width: width of the 95 % that the labels alone leave open; left: after the reviews.
    """

    figure: str
    experiment: str
    unit: str
    value: float
    width: float
    label_width: float
    left: float


@dataclass(frozen=True)
class ReviewOrder:
    """The trials of a store that a review may change, the ones to begin with first.

    Attributes:
        trials: those without a present decision that have any doubt.
        figures: of the evaluation; empty without one.
        notes: what limits this, as text.
    """

    trials: Sequence[Waiting]
    figures: Sequence[ReviewStatistic]
    notes: Sequence[str]

    def gains(self, count: int) -> list[Gain]:
        """Return what reviews of the first `count` trials do for each figure that labels blur.

        The figure that labels blur most, for its interval, first.
        """
        first = [found.name for found in self.trials[:count]]
        gains = [
            Gain(
                figure.name,
                figure.experiment,
                figure.unit,
                figure.value,
                figure.width,
                _NORMAL_95 * before,
                _NORMAL_95 * figure.label_deviation(first),
            )
            for figure in self.figures
            if figure.width and (before := figure.label_deviation(()))
        ]
        return sorted(gains, key=lambda gain: -gain.label_width / gain.width)


def review_order(store: TrialStore, campaigns: Sequence[Collected]) -> ReviewOrder:
    """Order the labelled trials of some campaigns that have no decision yet.

    Raises:
        StoreError: a label or a decision is damaged.
    """
    every = {item.name: labelled_trials(store, item) for item in campaigns}
    unusable = unusable_shares([case for cases in every.values() for case in cases])
    doubts: dict[Name, LabelDoubt] = {}
    waiting: list[ReviewedTrial] = []
    for cases in every.values():
        for case, doubt in zip(cases, doubts_of(store, cases, unusable), strict=True):
            if case.state in {"open", "stale"}:
                waiting.append(case)
                if doubt.there:
                    doubts[case.name] = doubt
    evaluation, notes = _evaluation(store, waiting)
    unlabelled = sum(len(item.trials) - len(every[item.name]) for item in campaigns)
    if unlabelled:
        notes.append(
            f"{plural(unlabelled, 'trial')} without a label of the present state: `sliplab label`"
        )
    decided = sum(len(cases) for cases in every.values()) - len(waiting)
    if evaluation is not None and evaluation.reviewed is None and decided:
        notes.append(
            f"the evaluation does not use the {decided} decisions that there are: "
            "`sliplab evaluate --reviewed` does"
        )
    figures: list[ReviewStatistic] = []
    shares: dict[Name, float] = {}
    if evaluation is not None:
        drawn = {name: ReviewDraws.of(name, doubt) for name, doubt in doubts.items()}
        figures = time_figures(evaluation, doubts, drawn)
        windows, shares = _windows(store, campaigns, evaluation, drawn)
        figures += windows
        if not any(figure.width for figure in figures):
            notes.append(f"so few test trials bound no figure; {_ALONE}")
    error = _network_error(evaluation)
    trials = [
        Waiting(
            *case.name,
            str(case.trial.split),
            doubts[case.name],
            _moves(case.name, figures, shares.get(case.name, 0.0), error),
        )
        for case in waiting
        if case.name in doubts
    ]
    trials.sort(
        key=lambda found: (
            -found.score,
            -found.doubt.severity,
            -max(found.doubt.spread_ms.values()),
        )
    )
    return ReviewOrder(trials, figures, notes)


def _evaluation(
    store: TrialStore, waiting: Sequence[ReviewedTrial]
) -> tuple[Evaluation | None, list[str]]:
    """Return the evaluation, if it is of the labels as they are, and else why there is none."""
    try:
        found = evaluation_of(store)
    except StoreError as error:
        return None, [f"{error}; {_ALONE}"]
    labels = {case.name: case.label for case in waiting}
    other = [
        row.trial
        for row in found.trials
        if (label := labels.get((row.campaign, row.trial))) is not None
        and (row.incipient_ns, row.gross_ns) != (label.incipient_ns, label.gross_ns)
    ]
    if other:
        return None, [
            f"the evaluation is of other labels, as of {other[0]}; run `sliplab evaluate`; {_ALONE}"
        ]
    return found, []


def _windows(
    store: TrialStore,
    campaigns: Sequence[Collected],
    evaluation: Evaluation,
    drawn: dict[Name, ReviewDraws],
) -> tuple[list[ReviewStatistic], dict[Name, float]]:
    """Return the accuracy of the test windows, if they were stored, and shares of training windows.

    Each is the fraction of a trial's training windows whose label the review changes.
    """
    item = next((item for item in campaigns if item.experiment == "kinematic"), None)
    if item is None:
        return [], {}
    length_ns = item.settings.windows.length_ms * 1_000_000
    parts = [part for split in ("train", "validation") if (part := _samples(store, split))]
    shares = trained_shares(parts, length_ns, item.settings.samples.per_class, drawn)
    retained, test = kept_counts(store, evaluation.key), _samples(store, "test")
    if retained is None or test is None or not np.array_equal(retained["y"], test.y):
        return [], shares
    return [accuracy_figure(evaluation, test, retained["counts"], length_ns, drawn)], shares


def _samples(store: TrialStore, split: str) -> SampleSet | None:
    """Return the windows of a part of the split as they were last used; None if none are stored."""
    try:
        return SampleSet.load(Derived.of(store, SAMPLES).folder / f"{split}.arrays")
    except (OSError, ValueError):
        return None


def _network_error(evaluation: Evaluation | None) -> float | None:
    """Return the error of the network as a share of its accuracy's interval; None without one.

    A share of the training windows is taken to change at most this share of the network's error.
    """
    known = None if evaluation is None else evaluation.windows.interval
    if known is None or known.share is None or known.low is None or known.high is None:
        return None
    return (1 - known.share) / (known.high - known.low) if known.high > known.low else None


def _moves(
    name: Name, figures: Sequence[ReviewStatistic], trained: float, error: float | None
) -> tuple[ExpectedChange, ...]:
    """Return the figures that a review of a trial may move, the most of its interval first."""
    found = []
    for figure in figures:
        changes = figure.changes(name)
        known = changes[np.isfinite(changes)]
        if (known != 0).any():
            change = float(np.abs(known).mean())
            found.append(
                ExpectedChange(
                    figure.name,
                    figure.experiment,
                    figure.unit,
                    change,
                    float(known.mean()),
                    None if figure.width is None else change / figure.width,
                )
            )
    if trained:
        of_interval = None if error is None else trained * error
        found.append(ExpectedChange(TRAINING, "kinematic", "share", trained, None, of_interval))
    return tuple(sorted(found, key=lambda move: -(move.of_interval or 0.0)))
