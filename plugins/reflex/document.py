"""The study of reflexes: every trial's outcome, and their summary."""

from __future__ import annotations

from sliplab.storage.schema.document import Bool, Document, Int, Number, Part


class ReactionParts(Part):
    """Parts of the time from the first tip's slip to the end of the reflex, ms."""

    window: Number
    """From the first tip's slip, the simulation's own, to the end of the window that decided."""
    sensor: Number
    """From there until its events had been read: blocks, transport, poll."""
    network: Number
    """From there to the decision, in real time."""
    command: Number
    """From there until the drivers of arm and gripper had the command."""
    actuator: Number
    """From there until arm and fingers were at rest, with the drivers' way to them."""

    @property
    def total(self) -> float:
        """Sum of the parts."""
        return self.window + self.sensor + self.network + self.command + self.actuator


class ReflexTrial(Part):
    """One trial with a detector and a reflex. Times in ms from the start of the retraction."""

    key: str = ""
    trial: str
    mass_kg: Number
    speed_mm_s: Number
    detector: str | None
    """Null where there is no reflex, and nothing detects for it."""
    reflex: str | None
    slip_ms: Number | None
    """First slip of a tip, the simulation's own; null: none slipped."""
    detected_ms: Number | None
    """End of the window that triggered the reflex; null: none was triggered."""
    gross_ms: Number | None
    """Gross slip, the simulation's own; null: none before the sensor left."""
    dropped: Bool
    """The plate came to its stop, or was still sliding when the sensor left."""
    fallen_mm: Number
    """Way that the plate fell from the start of the retraction until the sensor left."""
    extra_n: Number | None
    """Largest normal force after the trigger, over that at the trigger."""
    parts: ReactionParts | None
    heights_mm: tuple[Number, ...]
    """Of the plate, from the start of the retraction, every `step_ms`."""
    step_ms: Number

    @property
    def early(self) -> bool:
        """True where the reflex was triggered before any tip slipped."""
        if self.detected_ms is None:
            return False
        return self.slip_ms is None or self.detected_ms < self.slip_ms


class ReflexRow(Part):
    """The trials of one detector and reflex."""

    detector: str | None
    reflex: str | None
    trials: Int
    dropped: Int
    early: Int
    """Reflexes before any tip slipped."""
    missed: Int
    """Trials without a reflex."""
    would_drop: Int
    """Trials that drop without a reflex."""
    prevented: Int
    """Those of them that were held by a reflex that was not early; share and its exact 95 %:"""
    share: Number | None
    low: Number | None
    high: Number | None
    fallen_mm: Number
    """Median over the trials; of the largest part:"""
    fallen_p95_mm: Number
    extra_n: Number | None
    """Median over the reflexes; null: there was none; the largest:"""
    most_extra_n: Number | None
    reaction: ReactionParts | None
    """Medians of the parts over reflexes that were not early."""
    total_ms: Number | None
    """Median of their sums."""
    computer_p99_ms: Number | None
    """99th percentile of network and command together."""


def title_of(it: ReflexRow | ReflexTrial) -> str:
    """Return detector and reflex for people."""
    return "no reflex" if it.reflex is None else f"{it.reflex} ({it.detector})"


class ReflexStudy(Document):
    """Results of `sliplab reflex`."""

    simulated: Bool
    rig: str
    protocol: str
    virtual_time: Bool
    """Sensor, command and actuator are of the rig's virtual clock; the network's share is real."""
    detectors: dict[str, str]
    """SHA-256 of each detector's model file, by its name."""
    rows: tuple[ReflexRow, ...] = ()
    trials: dict[str, ReflexTrial]
    """By trial, detector and reflex."""
