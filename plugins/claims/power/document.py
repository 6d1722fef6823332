"""Trials that the claims of a protocol need, predicted from a pilot: `power.json`."""

from __future__ import annotations

from sliplab.storage.schema.document import Bool, Document, Int, Number, Part

MOST_OPEN = 0.5
"""A claim that is open at the end of more campaigns than this share is out of the plan's reach."""


class TrialSpread(Part):
    """A number of trials over the drawn campaigns; null: more than the plan has."""

    low: Int | None
    """Not reached by a tenth of the campaigns."""
    median: Int | None
    high: Int | None
    """Not reached by nine tenths."""


class WidthLine(Part):
    """Half the width of a claim's interval along one drawn campaign."""

    trials: tuple[Int, ...]
    half: tuple[Number | None, ...]
    """In the claim's unit; null: no bound yet."""


class ClaimPower(Part):
    """One claim over the drawn campaigns."""

    claim: str
    unit: str
    width: Number | None
    """Half the width that is claimed; null for other claims."""
    known: Int
    """Trials of the pilot with this figure."""
    trials: TrialSpread
    """After which it is called."""
    called: tuple[Int | None, ...]
    """The same of each campaign; null: never."""
    holds: Number
    """Share of the campaigns; likewise:"""
    refuted: Number
    never: Number
    repetitions: Int | None
    """Of each condition that would call it, where most campaigns of the plan do not: by widths that
    fall with the root of the number of trials, an estimate; null: not needed, or unknown."""
    widths: tuple[WidthLine, ...]

    @property
    def out_of_reach(self) -> bool:
        """True where most campaigns of the plan do not call it."""
        return self.never > MOST_OPEN


class LearningPoint(Part):
    """Accuracy of a classifier that some of the training trials trained."""

    trials: Int
    accuracy: Number
    """Share of windows of test trials, mean over trials and orders; likewise 95 %:"""
    low: Number
    high: Number


class Learning(Part):
    """Accuracy over the number of training trials: the error is floor + scale n^-exponent."""

    classifier: str
    test_trials: Int
    points: tuple[LearningPoint, ...]
    floor: Number
    scale: Number
    exponent: Number
    planned: Int
    """Training trials of the whole plan."""
    expected: Number
    """Accuracy with so many; 95 % between:"""
    low: Number
    high: Number
    line: tuple[LearningPoint, ...]
    """Of the fit."""


class PowerRecord(Document):
    """Campaigns drawn from a pilot, and after how many trials claims were called in them."""

    simulated: Bool
    """The pilot was."""
    protocol: str
    order: str
    pilots: tuple[str, ...]
    """Campaigns."""
    pilot_trials: Int
    """Whose figures were used."""
    model: str | None
    """Hash of the file of the network that judged them; null where no claim needs one."""
    campaigns: Int
    """Drawn."""
    planned: Int
    """Measured trials of the whole plan, at most `most` of its claims."""
    repetitions: Int
    sessions: Int = 1
    """That each campaign was drawn with."""
    drift: Number = 0.0
    """From the first trial to the last, as a share of the scatter between trials."""
    hours: Number
    """Of motion of the whole plan; maintenance and people's work are left out."""
    notes: tuple[str, ...]
    claims: tuple[ClaimPower, ...]
    together: TrialSpread
    """Trials after which all claims end a campaign."""
    ended: tuple[Int | None, ...]
    """The same of each campaign; null: never."""
    never: Number
    """Share of campaigns that take all trials."""
    expected_hours: tuple[Number, ...]
    """Of motion of a campaign that ends by its claims: low, median and high."""
    learning: Learning | None
