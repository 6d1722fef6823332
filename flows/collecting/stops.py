"""Why a campaign ends before its time without anything being broken."""

from __future__ import annotations


class CampaignStopped(RuntimeError):
    """A campaign ended between two trials; the message says why, and how it goes on."""


class WindowOver(CampaignStopped):
    """The time that the collection was given is over: the next one goes on."""
