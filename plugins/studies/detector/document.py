"""Speed of detectors against their errors: `detector_tradeoff.json`.

Units are those of an evaluation.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pydantic import Field

from sliplab.plugins.studies.detector.grid import NetworkSetting
from sliplab.storage.schema.document import Bool, Document, Int, Number, Part

BySeed = dict[str, tuple[Number | None, ...]]
"""Figures by name, a value for each seed; None where a seed has no such figure."""


class TriedSetting(Part):
    """Windows and size of a network."""

    length_ms: Int
    """Of a window."""
    step_ms: Int
    """Of the network's time steps."""
    pool_px: Int
    """Side of a cell."""
    width: Number
    """Factor on the channels of the convolutions and on the hidden neurons."""


class DetectorRow(TriedSetting):
    """One detector: a network's setting, a precision, a stride and a rule."""

    precision: str
    stride_ms: Int
    rule: str = ""
    """Whose pair of smoothing and margin it is."""
    smoothing: Int
    """Windows."""
    margin: Number
    """Spikes."""
    paper: Bool
    """It is the paper's detector."""
    seeds: tuple[Int, ...] = ()
    validation: BySeed = Field(default_factory=dict)
    """Figures of validation trials by name, a value for each seed; null where it has none."""
    test: BySeed
    """The same of test trials."""
    falling: BySeed | None = None
    """The same of gravity and disturbance trials; null without such trials."""
    work: BySeed
    """Microseconds and synaptic operations, a window and a second."""
    front: Bool = False
    """It is on the Pareto front of test trials."""
    front_validation: Bool = False
    """It is on the Pareto front of validation trials."""

    @property
    def setting(self) -> NetworkSetting:
        """Windows and size of its network."""
        return NetworkSetting(self.length_ms, self.step_ms, self.pool_px, self.width)

    @property
    def detector(self) -> tuple[Any, ...]:
        """All but the rule's name: two rules may have chosen the same pair."""
        return (self.setting, self.precision, self.stride_ms, self.smoothing, self.margin)

    def objective(self, name: str, part: str = "test") -> float | None:
        """Return the mean over seeds of a figure of work or of a part of the trials."""
        return mean((self.work if name in self.work else getattr(self, part))[name])


def mean(values: Sequence[float | None]) -> float | None:
    """Return the mean over seeds; None where a seed has no such figure."""
    there = [value for value in values if value is not None]
    return sum(there) / len(there) if len(there) == len(values) and there else None


class SeedDifference(Part):
    """Mean difference from the paper's value, with Student's 95 % interval over seeds."""

    mean: Number | None
    low: Number | None
    high: Number | None
    seeds: Int
    """That have both."""
    told: Bool | None
    """The interval excludes zero; null without an interval."""


class FactorValue(Part):
    """A value of one factor, with the others at the paper's values."""

    factor: str
    value: Number | str
    paper: Bool
    """It is the paper's value."""
    row: Int
    """Its place among the rows."""
    difference: dict[str, SeedDifference] | None
    """From the paper's value, by figure; null where that was not tried."""


class RulePair(Part):
    """A pair of smoothing and margin at the paper's setting and stride, on test trials."""

    smoothing: Int
    """Windows."""
    margin: Number
    """Spikes."""
    mean_ms: Number | None
    """Incipient latency of counted detections; null without one."""
    p95_ms: Number | None
    lost_either: Number | None
    """Share of trials missed or late, for either onset."""
    false_early_either: Number | None
    """Share of trials that are false early, for either onset."""


class SizeOfSearch(Part):
    """Size of a search: what its options requested."""

    samples: Int
    """Training windows of each network."""
    epochs: Int
    """Of each training at most."""
    trials: Int
    """Validation and test trials each, at most."""
    seeds: Int
    """Trainings of each setting."""
    stride_ms: Int
    """The finest stride."""


class TrialCounts(Part):
    """Trials of each part."""

    train: Int = 0
    validation: Int = 0
    test: Int = 0
    falling: Int = 0
    """Test trials of gravity and disturbance."""


class DetectorTradeoff(Document):
    """Speed of a store's detectors against their errors; a plan has no rows."""

    step: str = "tradeoff"
    simulated: Bool
    settings: tuple[TriedSetting, ...] = ()
    left_out: dict[str, str] = Field(default_factory=dict)
    """Settings and runs that were not tried, with the reason."""
    runs: Int = 0
    """Trainings of all settings and seeds."""
    kept: Int = 0
    """Of these, how many are finished."""
    pending: Int = 0
    estimated_s: Number | None = None
    """Time of the pending trainings; of `--dry-run` alone."""
    full: Bool = False
    """Every value of the factors was tried with every other."""
    ask: SizeOfSearch | None = None
    trials: TrialCounts = TrialCounts()
    windows: dict[str, Any] = Field(default_factory=dict)
    """Windows of the store's protocol."""
    false_early_ms: Number | None = None
    """A detection this much before the onset or earlier is false."""
    false_early_rate: Number | None = None
    """Share of validation trials that the chosen rule may leave false early."""
    objectives: dict[str, str] = Field(default_factory=dict)
    """Figures of the front, each to be `low` or `high`."""
    rows: tuple[DetectorRow, ...] = ()
    comparisons: tuple[FactorValue, ...] = ()
    pairs: tuple[RulePair, ...] = ()
    warnings: dict[str, tuple[str, ...]] = Field(default_factory=dict)
    """Of trainings, by run."""
