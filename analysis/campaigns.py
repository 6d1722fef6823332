"""Collected campaigns of a store: recordings, plan and settings, read from the store alone."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

from sliplab.protocols import InputError, Plan, PlannedTrial, load_plan
from sliplab.protocols.adapter import CLASSES, load_adapter
from sliplab.protocols.recorded import RecordedPlan, TrialProperties, natural
from sliplab.protocols.settings import AnalysisSettings
from sliplab.protocols.split import held_out_part
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import (
    ADAPTER,
    IMPORTED,
    Campaign,
    CampaignInfo,
    StoreError,
    TrialStore,
)

_NO_PLAN = "was imported without an adapter: it has neither labels nor a split (docs/adapters.md)"


def has_plan(info: CampaignInfo) -> bool:
    """Return True for a campaign that was collected, or imported by an adapter."""
    return IMPORTED not in info or ADAPTER in info[IMPORTED]


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
        """The plan of a collected campaign.

        Raises:
            InputError: it was imported, or its protocol is damaged.
        """
        if IMPORTED in self.info:
            raise InputError("CAMPAIGN", "", self.name, "was imported: it has no protocol")
        enabled = self.info.get("enabled", ())
        return load_plan(self.campaign.protocol_file, enabled, stored=True)

    @cached_property
    def recorded(self) -> RecordedPlan | None:
        """The plan of a campaign that was imported by an adapter; None of a collected one.

        Raises:
            InputError: it was imported without an adapter, or its adapter is damaged.
        """
        if IMPORTED not in self.info:
            return None
        if not has_plan(self.info):
            raise InputError("CAMPAIGN", "", self.name, _NO_PLAN)
        file = self.campaign.protocol_file
        recordings = (item for item in self.campaign.recordings() if item.record.quality.passed)
        trials = tuple(map(_recorded_trial, recordings))
        return RecordedPlan(load_adapter(file), str(file), trials)

    @property
    def planned(self) -> Plan | RecordedPlan:
        """The plan of the campaign, whichever it has."""
        return self.recorded or self.plan

    @property
    def experiment(self) -> str:
        """``kinematic``, ``gravity``, ``disturbance``, or ``classes`` of other classes than slip's.

        Raises:
            InputError: see `planned`.
        """
        if self.recorded is not None:
            return self.recorded.adapter.experiment
        return self.plan.protocol.collection.experiment

    @property
    def title(self) -> str:
        """The protocol's or data set's title; the name of a campaign without one."""
        source = self.plan.protocol if self.recorded is None else self.recorded.adapter
        return source.title or self.name

    @property
    def question(self) -> str:
        """The protocol's question; empty without one."""
        return self.plan.protocol.question if self.recorded is None else ""

    @property
    def settings(self) -> AnalysisSettings:
        """The `analysis:` section."""
        if self.recorded is not None:
            return self.recorded.adapter.analysis
        return self.plan.protocol.analysis

    @property
    def disturbed(self) -> bool:
        """True for a campaign with nuisances."""
        if IMPORTED in self.info:
            return False
        # most protocols have none, and need not be read to know it
        try:
            text = self.campaign.protocol_file.read_text(errors="replace")
        except OSError:
            return False
        return "nuisances" in text and self.plan.protocol.collection.nuisances is not None

    def describe(self, trial: PlannedTrial) -> dict[str, str]:
        """Return a trial's condition as text with units, by factor."""
        return self.planned.describe(trial)

    @cached_property
    def trials(self) -> list[tuple[PlannedTrial, Recording]]:
        """Committed trials of the plan, in the plan's order; the split holds out logged values."""
        there = self.campaign.committed()
        found = [(t, self.campaign.recording(t.id)) for t in self.planned if t.id in there]
        split = self.settings.split
        if not split.held_out:
            return found
        return [
            (replace(t, split=held_out_part(split, recording.context, t.split)), recording)
            for t, recording in found
        ]

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

    def of_split(self, split: str) -> Iterator[tuple[PlannedTrial, Recording]]:
        """Committed trials of one part of the split."""
        return ((trial, recording) for trial, recording in self.trials if trial.split == split)


def _recorded_trial(recording: Recording) -> TrialProperties:
    record = recording.record
    origin = record.imported
    given = None if origin is None else origin.given
    names = [] if given is None else [span.name for span in given.spans]
    return TrialProperties(
        record.trial,
        record.condition,
        {} if origin is None else origin.fields,
        # a recording of several classes is spread over the split by the one that it begins with
        names[0] if names else None,
        record.recorded_s,
        tuple(dict.fromkeys(names)),
    )


def collected(store: TrialStore, names: list[str] | None = None) -> list[Collected]:
    """The campaigns of a store, or those named.

    Campaigns with nuisances are left out unless they are named, or another one trains with them.

    Raises:
        StoreError: the store holds no campaign.
        InputError: a name that the store does not have.
    """
    campaigns = {campaign.name: campaign for campaign in store.campaigns()}
    if not campaigns:
        raise StoreError(f"{store.folder}: holds no campaign yet; run `sliplab collect` first")
    imported = {name for name, campaign in campaigns.items() if not has_plan(campaign.info)}
    if imported >= campaigns.keys():
        raise StoreError(
            f"{store.folder}: holds only campaigns that were imported without an adapter: they "
            "have neither labels nor a split (docs/adapters.md)"
        )
    for name in names or ():
        if name in imported:
            raise InputError("--campaign", "", name, _NO_PLAN)
        if name not in campaigns:
            raise InputError(
                "--campaign",
                "",
                name,
                f"is not in {store.folder}; there are {', '.join(campaigns)}",
            )
    found = [Collected(campaigns[name]) for name in names or campaigns if name not in imported]
    if names:
        return found
    plain = [item for item in found if not item.disturbed]
    if len(plain) == len(found):
        return found
    if not plain or any(item.settings.training.nuisances for item in plain):
        return sorted(found, key=lambda item: item.disturbed)  # the others' settings count
    return plain


def missing_stream(campaigns: list[Collected]) -> str | None:
    """Return ``events`` or ``frames``, whichever some campaign was recorded without; else None."""
    return next((item.missing_stream for item in campaigns if item.missing_stream), None)


def of_classes(campaigns: list[Collected]) -> bool:
    """Return True where the recordings show classes of their own instead of a slip.

    Raises:
        InputError: some do and some do not.
    """
    found = {item.experiment == CLASSES: item.name for item in campaigns}
    if len(found) > 1:
        raise InputError(
            "--campaign",
            "",
            None,
            f"'{found[True]}' is of classes and '{found[False]}' of slip: they are analysed apart, "
            "so name one of them with --campaign",
        )
    return True in found


def class_names(campaigns: list[Collected]) -> tuple[str, ...]:
    """Return the names of all classes that recordings show, by the numbers that samples carry.

    Raises:
        InputError: the adapters list other classes.
        StoreError: there are not two.
    """
    listed = {item.name: item.recorded.classes for item in campaigns if item.recorded is not None}
    names = tuple(dict.fromkeys(name for found in listed.values() for name in found))
    if not any(item.recorded and item.recorded.adapter.classes for item in campaigns):
        names = tuple(sorted(names, key=natural))
    if len(names) < 2:
        raise StoreError(f"{len(names)} class in the recordings; at least two are needed to train")
    return names


def refuse_classes(campaigns: list[Collected]) -> None:
    """See that recordings show a slip.

    Raises:
        StoreError: they show classes of their own.
    """
    if of_classes(campaigns):
        raise StoreError(
            f"campaign '{campaigns[0].name}': its recordings show classes, and this is about slip; "
            "for classes there are `sliplab label`, `train`, `evaluate` and `report`"
        )


def kinematic_campaigns(campaigns: list[Collected]) -> list[Collected]:
    """The kinematic campaigns, with any streams.

    Raises:
        StoreError: there is none.
    """
    found = [item for item in campaigns if item.experiment == "kinematic"]
    if not found:
        refuse_classes(campaigns)
        raise StoreError("no kinematic campaign to train on; collect one first")
    return found


def training_campaigns(campaigns: list[Collected]) -> list[Collected]:
    """The kinematic campaigns, whose trials train, choose and test the network.

    Raises:
        StoreError: there is none.
        InputError: they disagree on how windows are made.
    """
    return agreeing(kinematic_campaigns(campaigns))


def agreeing(found: list[Collected]) -> list[Collected]:
    """Return campaigns whose windows of events are made alike.

    Raises:
        StoreError: one was recorded without events.
        InputError: they are not made alike.
    """
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
