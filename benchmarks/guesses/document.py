"""Results of the sweep of assumed parameters, in `derived/guesses/results.json` of a store."""

from __future__ import annotations

from sliplab.storage.schema.document import Bool, Document, Int, Number, Part
from sliplab.storage.schema.evaluation import Experiments, TrialScore


class TrialAtSetting(TrialScore):
    """One trial at a setting of the scene."""

    depth_zero_mm: Number | None
    """The plate's position as the rig measured it."""


class SettingScores(Part):
    """A study's test trials, repeated with one assumed parameter of the scene changed."""

    key: str = ""
    parameter: str | None
    """Its dotted name; null for the scene as it is."""
    factor: Number
    value: Number | None
    windows: dict[str, tuple[Int, Int]]
    """By trial, windows that were classified correctly, and all of its windows."""
    trials: tuple[TrialAtSetting, ...]
    experiments: Experiments


class SensitivityResults(Document):
    """Results that `benchmarks.guesses` keeps."""

    simulated: Bool
    change: Number
    """Share by which each parameter is lowered and raised."""
    settings: dict[str, SettingScores]
    """By the setting's name."""
