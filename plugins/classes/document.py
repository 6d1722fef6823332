"""The evaluation of recordings that show one of several classes, and the numbers of its report.

Shares and accuracies run from 0 to 1. Intervals are 95 % over trials. A figure that cannot be
computed is null.
"""

from __future__ import annotations

from pydantic import Field

from sliplab.storage.schema.document import Bool, Document, Int, Number, Part
from sliplab.storage.schema.evaluation import (
    Accuracy,
    Baseline,
    PartTrials,
    Seeds,
    Share,
    TrainedBaseline,
    WindowWork,
)
from sliplab.storage.schema.summary import Hashes


class ClassScore(Part):
    """One class among the test windows."""

    name: str
    recall: Share
    """Right among all windows that truly are of the class; undecided windows are not right."""
    precision: Number | None
    """Right among all windows decided for the class."""
    windows: PartTrials
    """Windows of the class in each part of the split."""


class LengthShare(Share):
    """Accuracy where only the beginning of each window is seen."""

    ms: Int
    """Length of what is seen."""


class TrialAccuracy(Part):
    """Accuracy of whole recordings: the counts of a recording's windows are added up.

    A recording that shows several classes counts once for each of them.
    """

    argmax: Share
    strict: Share


class WrongTrial(Part):
    """A test recording whose added counts do not have the true class as their only winner."""

    campaign: str
    trial: str
    condition: dict[str, str]
    """Levels by factor, with their units."""
    true: str
    called: str | None
    """Null: undecided."""
    windows: Int
    right: Int
    """Windows that were classified rightly."""


class ClassScores(Part):
    """All figures of the test windows of recordings of classes."""

    classes: tuple[str, ...]
    """Names in the order of the confusion matrix."""
    accuracy: Accuracy
    """Of windows. A silent network scores one over the number of classes in argmax."""
    interval: Share
    """Strict accuracy of windows."""
    trials: TrialAccuracy
    confusion: tuple[tuple[Int, ...], ...]
    """Rows are true classes; columns predicted ones, the last undecided windows."""
    by_class: tuple[ClassScore, ...]
    by_factor: dict[str, dict[str, Share]]
    """Strict accuracy of windows by factor and level."""
    by_length: tuple[LengthShare, ...]
    """Argmax accuracy of windows by how much of each is seen, the shortest first."""
    wrong: tuple[WrongTrial, ...]
    seeds: Seeds
    work: WindowWork | None
    """Null without windows."""
    beside: dict[str, Baseline]
    """Simple methods on the same windows, compared with the network."""
    windows: PartTrials
    """Windows of each part of the split."""
    recordings: PartTrials
    """Trials of each part of the split."""


class ClassEvaluation(Document):
    """Results that `evaluate` keeps of the network on recordings of classes."""

    key: str = ""
    """Of what made it."""
    version: Int
    """Of the step."""
    seed: Int
    """Of the chosen network."""
    reviewed: dict[str, Int] | None = None
    """Trials by the state of people's decisions; null where they are not applied."""
    scores: ClassScores


class DataOrigin(Part):
    """Origin of a campaign's recordings, as its adapter states it."""

    title: str
    about: dict[str, str]
    """Who made the data, where they are, under what licence."""
    trials: Int
    seconds: Number
    """Recorded, over all trials."""
    unknown: dict[str, Int] = Field(default_factory=dict)
    """Facts that are not known, each with the number of trials that lack it."""


class ClassSeeds(Part):
    """Seeds of networks."""

    network: tuple[Int, ...]
    chosen: Int


class JudgedClasses(ClassScores):
    """The store's network, and all that it is compared with."""

    trained_baselines: dict[str, TrainedBaseline] = Field(default_factory=dict)
    """Stronger methods, where `evaluate --baselines` trained them."""


class ClassSummary(Document):
    """The numbers of a report on recordings of classes."""

    simulated: Bool
    classes: JudgedClasses
    data: dict[str, DataOrigin]
    """By campaign."""
    reviewed: dict[str, Int] | None = None
    timing_s: dict[str, Number] = Field(default_factory=dict)
    """The one entry that differs between equal runs."""
    versions: dict[str, str]
    protocols: dict[str, Hashes]
    """Of the adapters, by campaign."""
    seeds: ClassSeeds
