"""What a campaign was registered with: `registrations/0001.json` in its folder."""

from __future__ import annotations

from typing import Any

from sliplab.protocols.shown import plural
from sliplab.storage.schema.document import Document, Int, Part


class RegisteredProtocol(Part):
    """The protocol as it was registered."""

    name: str
    file_sha256: str
    """Of the file that was given."""
    text: str
    """The file's text, with the phases of a motion template in the template's place."""
    enabled: tuple[str, ...]
    """Optional levels that are switched on, as ``factor=level``."""
    collection_hash: str
    analysis_hash: str


class RegisteredRig(Part):
    """The rig file as it was registered, with its passwords masked."""

    name: str
    sha256: str
    text: str


class TakenTrials(Part):
    """Trials of the campaign when it was registered."""

    committed: Int
    attempts: Int
    """Unfinished ones, and those in quarantine."""


class Registration(Document):
    """A protocol, its claims and analysis settings at a time; never changed once it is written."""

    format: Int
    campaign: str
    number: Int
    """Of the campaign's registrations, from 1."""
    registered: str
    """UTC, ISO 8601."""
    previous: str | None
    """SHA-256 of the file of the registration before; null of the first."""
    protocol: RegisteredProtocol
    analysis: dict[str, Any]
    """Analysis settings, defaults written out."""
    stopping: dict[str, Any] | None
    """Claims, error level and limits, defaults written out; null without claims."""
    judging_model: str | None
    """SHA-256 of the network's file that judges the claims; null where there is none."""
    planned: Int
    """Trials of the plan, reference trials included."""
    rig: RegisteredRig | None
    """Null where no rig was given."""
    versions: dict[str, str]
    """Of packages that figures depend on."""
    taken: TakenTrials
    sum: str
    """SHA-256 of all other keys as JSON without spaces, keys sorted."""

    @property
    def after(self) -> str:
        """When it was registered, in words: before or after how many trials."""
        taken = self.taken
        if not taken.committed and not taken.attempts:
            return "before the first trial"
        more = f" and {plural(taken.attempts, 'other attempt')}" if taken.attempts else ""
        return f"after {plural(taken.committed, 'trial')}{more}"
