"""Detectors under nuisances: `stress.json`."""

from __future__ import annotations

from sliplab.storage.schema.document import Bool, Document, Int, Number, Part
from sliplab.storage.schema.evaluation import Rate

ALL = "all"
"""In place of a nuisance: every trial."""


class HourlyRate(Part):
    """A rate per hour with its 95 % interval over trials, null with one trial."""

    value: Number
    low: Number | None
    high: Number | None


class StressFigures(Part):
    """A detector on the trials of one nuisance at one strength."""

    nuisance: str
    """`all`: every trial."""
    strength: Number | None
    """Percent of the protocol's sizes; null: of all strengths."""
    trials: Int
    hold_h: Number
    """Time in which the sensor held without slip, h."""
    false_alarms: Int
    per_hour: HourlyRate
    """False alarms per hour of holding; trials of the same nuisance and strength are compared."""
    clean: Rate
    """Share of the trials with no false alarm, and a slip that was detected before it was gross."""
    missed: Int
    """Slips that were not detected before they were gross."""
    latency_ms: Number | None
    """Median from the label's onset to the detection, a missed one infinite; null if so."""
    latency_true_ms: Number | None
    """The same from the physical onset; null where none is known."""


class StressDetector(Part):
    """A detector; `figures` begin with those of all trials."""

    network: str
    rule: str
    stride_ms: Int
    figures: tuple[StressFigures, ...]

    @property
    def title(self) -> str:
        """Name for people."""
        return f"{self.network}: {self.rule}, {self.stride_ms} ms"

    @property
    def is_rule(self) -> bool:
        """True for a network with its rule of detection."""
        from sliplab.analysis.detectors.detectors import RULE  # slow to import

        return self.rule.startswith(RULE)

    def under(self, nuisance: str) -> StressFigures:
        """Return the figures under one nuisance, all strengths together.

        Raises:
            StopIteration: there are none.
        """
        wanted = (nuisance, None)
        return next(it for it in self.figures if (it.nuisance, it.strength) == wanted)


class StressAccuracy(Part):
    """Strict accuracy of a network on the sample windows of one nuisance at one strength."""

    network: str
    nuisance: str
    strength: Number | None
    windows: Int
    trials: Int = 0
    """Of the windows, over which the interval is; 0 in older results."""
    strict: Rate | None
    """With an interval over trials; null without windows."""


class StressRecord(Document):
    """All detectors of a store under nuisances, the best first."""

    simulated: Bool
    campaign: str
    rig: str
    protocol: str
    trials: Int
    without_onsets: Int
    """Trials besides that have no incipient onset in their label; nothing is judged by them."""
    hold_h: Number
    detectors: tuple[StressDetector, ...]
    accuracy: tuple[StressAccuracy, ...]

    @property
    def nuisances(self) -> list[str]:
        """Names in the order of the figures."""
        found = dict.fromkeys(it.nuisance for it in self.detectors[0].figures)
        return [name for name in found if name != ALL]
