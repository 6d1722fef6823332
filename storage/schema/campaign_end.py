"""How the claims of a campaign were decided to end it: `stopping.json`."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, Self

from sliplab.storage.schema.document import Bool, Document

STOPPING, CHOICES = "stopping.json", "choices.json"
"""Files in the folder of a campaign with claims: looks at them, and trials that were chosen."""
Verdict = Literal["open", "settled", "most", "all", "overruled"]
"""`most`: as many trials as the protocol takes at most; `all`: nothing is left to take."""


class CampaignEnd(Document):
    """Whether a campaign has ended by its claims."""

    simulated: Bool
    section: str
    """Hash of the protocol's section `collection.stopping`."""
    model: str | None
    """Hash of the network's file; null where no claim needs one."""
    verdict: Verdict

    @classmethod
    def of(cls, campaign: Path) -> Self | None:
        """Return what is in a campaign's folder; None where its claims were never looked at.

        Raises:
            DocumentError, NewerFormat: the file cannot be read.
        """
        try:
            return cls.load(campaign / STOPPING)
        except FileNotFoundError:
            return None

    @property
    def ended(self) -> bool:
        """Whether the campaign ended before all its trials were taken."""
        return self.verdict in ("settled", "most")
