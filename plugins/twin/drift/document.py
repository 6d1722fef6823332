"""Numbers of the drift of a campaign's reference trials."""

from __future__ import annotations

from sliplab.storage.schema.document import Bool, Document, Int, Number, Part

FRICTION = "scene.friction.kinetic"
"""The parameter that a limit is for."""


class ReferenceFit(Part):
    """A parameter as one reference trial shows it, over its value at the line's begin.

    Attributes:
        place: of the trial in the plan, from 1. low, high: central 95 %.
    """

    trial: str
    place: Int
    factor: Number
    low: Number
    high: Number


class ParameterDrift(Part):
    """Change of one parameter of the scene along a campaign.

    Attributes:
        key: in the section `mock:` of a rig file. start: value at the first reference, by the line.
        identified: single references tell of it.
        percent_per_100_trials: slope; low, high: its 95 % interval.
        change_percent: from the first reference to the last; change_low, change_high: likewise.
        changed: so much that all parameters together show it in 5 % of campaigns without change.
    """

    key: str
    title: str
    unit: str
    identified: Bool
    start: Number
    percent_per_100_trials: Number
    low: Number
    high: Number
    change_percent: Number
    change_low: Number
    change_high: Number
    changed: Bool
    references: tuple[ReferenceFit, ...]


class DriftFit(Document):
    """Reference trials of a campaign, each fitted by a simulated rig.

    Attributes:
        simulated: the campaign itself was. checksum: of the references.
        condition: that they repeat. worlds: simulated for the fits.
        with_forces: stiffnesses were fitted; without, they are the rig file's, and friction stands
            for friction over stiffness.
        limit_percent: largest change of friction; beyond: it changed by more, its whole interval.
    """

    simulated: Bool
    campaign: str
    rig: str
    checksum: str
    condition: dict[str, str]
    worlds: Int
    seconds: Number
    with_forces: Bool
    parameters: tuple[ParameterDrift, ...]
    limit_percent: Number | None
    beyond: Bool

    @property
    def friction(self) -> ParameterDrift:
        """The parameter that a limit is for."""
        return next(it for it in self.parameters if it.key == FRICTION)

    @property
    def identified(self) -> list[ParameterDrift]:
        """Parameters that single references tell of."""
        return [it for it in self.parameters if it.identified]
