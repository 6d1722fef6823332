"""Results of levels left out and of other skins; units are those of an evaluation."""

from __future__ import annotations

from pydantic import Field

from sliplab.storage.schema.document import Bool, Document, Int, Number, Part
from sliplab.storage.schema.evaluation import ByClass, Share


class UnseenScores(Share):
    """Strict accuracy on a level or a skin that the network was not trained on."""

    key: str = ""
    argmax: Number | None
    recall: ByClass
    seen: Number | None = None
    """Strict accuracy on validation windows of the other levels; not written for a skin."""
    trained_on: Int | None = None
    """Trials of the training; not written for a skin."""


class NotTrained(Part):
    """A level that no network could be trained without."""

    key: str = ""
    why: str = Field(validation_alias="left out", serialization_alias="left out")


class GeneralisationResults(Document):
    """Results that `sliplab generalise` keeps.

    Every point has the key of what it was made of, so that only what is missing or stale is
    measured.
    """

    simulated: Bool
    results: dict[str, UnseenScores | NotTrained]
    """By factor and level, such as `speed 4 mm/s`, or by skin, such as `skin 101`."""

    @property
    def skins_last(self) -> dict[str, UnseenScores | NotTrained]:
        """The results, other skins after the levels."""
        return dict(sorted(self.results.items(), key=lambda each: each[0].startswith("skin ")))
