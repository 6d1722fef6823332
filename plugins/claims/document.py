"""A campaign's claims at each look, and the trials that were chosen by them."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Literal

from sliplab.protocols import Plan
from sliplab.protocols.claims import Kind
from sliplab.storage.schema.campaign_end import CHOICES, CampaignEnd
from sliplab.storage.schema.document import Bool, Document, Int, Number, Part

TARGET = "conditions repeated for ever, each counted alike"
"""Population that the claims are about, in whichever order trials come; not only the grid."""


class ClaimState(Part):
    """One claim at one look; numbers are in its unit."""

    claim: str
    """In words."""
    kind: Kind
    value: Number
    """That is claimed; of kind `apart` the least size of a difference of either sign."""
    unit: str
    trials: Int
    """With a figure that is a number."""
    undetected: Int = 0
    """Trials in which nothing was detected: they count as the worst."""
    missing: Int = 0
    """Trials without a figure, or left out: the verdict holds whatever they would have shown."""
    blocks: Int = 0
    """Groups of trials that count as independent."""
    least_blocks: Int = 0
    """Blocks before which the claim is not called."""
    block_share: Number | None = None
    """Share of blocks in the variance of the figure (intra-block correlation)."""
    estimate: Number | None
    low: Number | None
    """Ends of the interval, which holds at all looks together; null: no bound."""
    high: Number | None
    holds: Bool
    refuted: Bool
    alike: Literal["holds", "refuted"] | None = None
    """The verdict if missing trials were like the others, where it is open without that."""
    trend: Literal["holds", "refuted"] | None = None
    """The verdict if the trend so far did not continue, where it is open without that."""


class Look(Part):
    """All claims after a round."""

    round: Int
    taken: Int
    """Committed measured trials."""
    evidence: str = ""
    """Hash of these trials and their figures."""
    claims: tuple[ClaimState, ...]


class StoppingRecord(CampaignEnd):
    """Looks at a campaign's claims, in order; the last decides."""

    target: str = TARGET
    looks: tuple[Look, ...] = ()


class ChosenTrial(Part):
    """A trial that was chosen."""

    trial: str
    chance: Number | None
    """With which it was drawn from what was left; null: by its place in the grid."""


class TrialBatch(Part):
    """Trials that were chosen at once."""

    known: Int
    """Trials whose figures were used."""
    least: Number | None
    """The smallest chance that any trial left had; null: no chance was used."""
    trials: tuple[ChosenTrial, ...]


class ChoiceRecord(Document):
    """The order of an adaptive campaign, written before it is taken: `choices.json`."""

    simulated: Bool
    batches: tuple[TrialBatch, ...] = ()

    @staticmethod
    def of(campaign: Path) -> ChoiceRecord:
        """Return the choices in a campaign's folder; none where nothing was chosen.

        Raises:
            DocumentError, NewerFormat: the file cannot be read.
        """
        try:
            return ChoiceRecord.load(campaign / CHOICES)
        except FileNotFoundError:
            return ChoiceRecord(simulated=False)


def begun_trials(plan: Plan, campaign: Path) -> set[str]:
    """Return the trials that a campaign with claims has begun, by the files in its folder.

    Raises:
        DocumentError, NewerFormat: a file cannot be read.
    """
    collection = plan.protocol.collection
    if collection.adaptive is not None:
        batches = ChoiceRecord.of(campaign).batches
        return {item.trial for batch in batches for item in batch.trials}
    record = StoppingRecord.of(campaign)
    if record is None or collection.stopping is None:
        return set()
    repetitions = len(record.looks) * collection.stopping.repetitions
    return {it.id for it in plan if it.role == "measured" and it.repetition <= repetitions}


class TrialFigures(Part):
    """Figures of one trial that claims are about."""

    values: dict[str, Number | None]
    """By figure, percent or ms; null where the trial's label lacks an onset."""
    undetected: tuple[str, ...] = ()
    """Figures of detections that were missed, late or false."""

    def of(self, name: str) -> float:
        """Return a figure; NaN where it has none, infinite where nothing was detected."""
        if name in self.undetected:
            return -math.inf if name == "lead" else math.inf
        value = self.values.get(name)
        return math.nan if value is None else float(value)
