"""Collected campaigns of a store: recordings, plan and settings, read from the store alone."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

from sliplab.protocols import InputError, Plan, Trial, load_plan
from sliplab.protocols.settings import AnalysisSettings
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import IMPORTED, Campaign, CampaignInfo, Store, StoreError


@dataclass(frozen=True)
class Collected:
    """A campaign with its plan, which is read from the store's own copy of the protocol."""

    campaign: Campaign

    @property
    def name(self) -> str:
        """The campaign's name."""
        return self.campaign.name

    @cached_property
    def info(self) -> CampaignInfo:
        """The campaign's own document, `campaign.json`."""
        return self.campaign.info

    @cached_property
    def plan(self) -> Plan:
        """The plan of the campaign.

        Raises:
            InputError: it was imported, or its protocol is damaged.
        """
        if IMPORTED in self.campaign.info:
            raise InputError("CAMPAIGN", "", self.name, "was imported: it has no protocol")
        enabled = self.campaign.info.get("enabled", ())
        return load_plan(self.campaign.protocol_file, enabled, stored=True)

    @property
    def experiment(self) -> str:
        """``kinematic``, ``gravity`` or ``disturbance``."""
        return self.plan.protocol.collection.experiment

    @property
    def settings(self) -> AnalysisSettings:
        """The `analysis:` section."""
        return self.plan.protocol.analysis

    @cached_property
    def trials(self) -> list[tuple[Trial, Recording]]:
        """Committed trials of the plan, in the plan's order."""
        there = self.campaign.committed()
        return [(t, self.campaign.recording(t.id)) for t in self.plan if t.id in there]

    def need(self, stream: str, use: str) -> None:
        """See that trials were recorded with a stream.

        Args:
            stream: ``events`` or ``frames``.
            use: what it is needed for, such as ``labels are made of them``.

        Raises:
            StoreError: the first trial has none, so its rig has no such camera.
        """
        for _, recording in self.trials[:1]:
            if getattr(recording.record.counts, stream) == 0:
                raise StoreError(f"campaign '{self.name}' was recorded without {stream}; {use}")

    @property
    def missing_stream(self) -> str | None:
        """``events`` or ``frames``, whichever its trials were recorded without; else None."""
        for _, recording in self.trials[:1]:
            counts = recording.record.counts
            if not counts.events or not counts.frames:
                return "frames" if counts.events else "events"
        return None

    def of_split(self, split: str) -> Iterator[tuple[Trial, Recording]]:
        """Committed trials of one part of the split."""
        return ((trial, recording) for trial, recording in self.trials if trial.split == split)


def collected(store: Store, names: list[str] | None = None) -> list[Collected]:
    """The campaigns of a store, or those named.

    Raises:
        StoreError: the store holds no campaign.
        InputError: a name that the store does not have.
    """
    campaigns = {campaign.name: campaign for campaign in store.campaigns()}
    if not campaigns:
        raise StoreError(f"{store.folder}: holds no campaign yet; run `sliplab collect` first")
    imported = {name for name, campaign in campaigns.items() if IMPORTED in campaign.info}
    if imported >= campaigns.keys():
        raise StoreError(f"{store.folder}: holds imported campaigns only, which have no protocol")
    for name in names or ():
        if name in imported:
            raise InputError("--campaign", "", name, "was imported: it has no protocol")
        if name not in campaigns:
            raise InputError(
                "--campaign",
                "",
                name,
                f"is not in {store.folder}; there are {', '.join(campaigns)}",
            )
    names = names or [name for name in campaigns if name not in imported]
    return [Collected(campaigns[name]) for name in names]


def missing_stream(campaigns: list[Collected]) -> str | None:
    """Return ``events`` or ``frames``, whichever some campaign was recorded without; else None."""
    return next((item.missing_stream for item in campaigns if item.missing_stream), None)


def kinematic_campaigns(campaigns: list[Collected]) -> list[Collected]:
    """The kinematic campaigns, with any streams.

    Raises:
        StoreError: there is none.
    """
    found = [item for item in campaigns if item.experiment == "kinematic"]
    if not found:
        raise StoreError("no kinematic campaign to train on; collect one first")
    return found


def training_campaigns(campaigns: list[Collected]) -> list[Collected]:
    """The kinematic campaigns, whose trials train, choose and test the network.

    Raises:
        StoreError: there is none.
        InputError: they disagree on how windows are made.
    """
    found = kinematic_campaigns(campaigns)
    for item in found:
        item.need("events", "the network is trained on windows of them")
    for other in found[1:]:
        if other.settings.windows != found[0].settings.windows:
            raise InputError(
                other.campaign.protocol_file,
                "analysis.windows",
                None,
                f"differ from those of campaign '{found[0].name}'; name one with --campaign",
            )
    return found
