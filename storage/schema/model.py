"""The document of a model file: training data, settings and accuracy."""

from __future__ import annotations

from sliplab.storage.schema.document import Bool, Document, Int, Number, Part


class ModelSamples(Part):
    """Windows of each part of the split."""

    train: Int
    validation: Int


class ValidationAccuracy(Part):
    """Accuracies on validation windows at the chosen epoch; null if there are none."""

    argmax: Number | None
    strict: Number | None
    margin: Number | None


class TrainedModel(Document):
    """Record that `train` keeps of one seed."""

    key: str
    """Of what the network was trained on, and by which settings."""
    seed: Int
    samples: ModelSamples
    chosen_epoch: Int
    validation: ValidationAccuracy
    warnings: tuple[str, ...] = ()
    simulated: Bool | None = None
    """Some of its windows are of simulated trials; null in older models."""
