"""Results of the hold-out campaign, and every time that it was evaluated.

Units are those of an evaluation.
"""

from __future__ import annotations

from sliplab.storage.schema.document import Bool, Document, Int, Number, Part
from sliplab.storage.schema.evaluation import (
    AlarmRate,
    Classification,
    ExperimentScores,
    Share,
    TrialScore,
)


class HoldoutScores(Classification):
    """Windows of the hold-out campaign, with two accuracies over trials."""

    strict: Share
    argmax: Share


class HoldoutLook(Part):
    """One time that the hold-out campaign was evaluated."""

    version: str
    """Of the program."""
    at: str
    """UTC, ISO 8601."""
    model: str
    """Key of the network."""
    strict: Number | None


class HoldoutResult(Document):
    """Results that `sliplab holdout` keeps."""

    key: str = ""
    simulated: Bool
    trials: Int
    protocol_seed: Int
    skin_seed: Int
    model: str
    """Key of the network."""
    windows: HoldoutScores
    rows: tuple[TrialScore, ...]
    kinematic: ExperimentScores
    false_alarms: AlarmRate | None = None
    """False early detections an hour of quiet holding; null in older results."""
    evaluations: tuple[HoldoutLook, ...]
    """Every time that the campaign was evaluated; the others are of the last time."""
