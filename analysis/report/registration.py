"""Registrations in the report: when each campaign was registered, and what deviates from it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import ClassVar

from sliplab.analysis.campaigns import Collected, missing_stream
from sliplab.analysis.evaluation.evaluation import evaluation_of
from sliplab.analysis.networks.models import rules_of, training_settings
from sliplab.analysis.registration import RegistrationDeviation, campaign_deviations
from sliplab.analysis.report.page import Content, Table
from sliplab.protocols.errors import InputError
from sliplab.protocols.hashing import hash_data
from sliplab.protocols.shown import plural
from sliplab.storage.errors import StoreError
from sliplab.storage.files import sha256
from sliplab.storage.trials.registration import (
    registration_files,
    registration_problems,
    registrations,
    stamps,
)
from sliplab.storage.trials.store import IMPORTED, Campaign, TrialStore


@dataclass(frozen=True)
class Registered:
    """A campaign that was collected.

    Attributes:
        after: when the first registration was made, before or after how many trials; empty where
            there is none.
        deviations: from the first registration.
    """

    name: str
    after: str
    rig: bool
    files: Table
    deviations: Table


@dataclass(frozen=True)
class RegistrationSection(Content):
    """Collected campaigns with their registrations.

    Attributes:
        absent: registered campaigns of the store that are not in the report.
    """

    template: ClassVar[str] = "registration.html"
    folded: ClassVar[bool] = True
    campaigns: Sequence[Registered]
    absent: Sequence[str]

    @property
    def notices(self) -> list[str]:
        """How far each campaign deviates from its registration."""
        counts = {it.name: len(it.deviations.rows) for it in self.campaigns}
        return [
            f"{name}: {plural(count, 'deviation')} from its registration"
            for name, count in counts.items()
            if count
        ]


def registration_key(store: TrialStore, campaigns: list[Collected]) -> list[str]:
    """Return what a report with registrations depends on besides; empty without any."""
    section = registration_section(store, campaigns)
    if section is None or not (section.absent or any(it.after for it in section.campaigns)):
        return []
    tables = [[it.name, it.after, it.files.rows, it.deviations.rows] for it in section.campaigns]
    return [hash_data([tables, section.absent])]


def registration_section(
    store: TrialStore, campaigns: list[Collected]
) -> RegistrationSection | None:
    """Show registrations of collected campaigns; None where all were imported."""
    collected = [item for item in campaigns if IMPORTED not in item.info]
    shown = {item.name for item in collected}
    absent = [
        folder.name
        for folder in sorted((store.folder / "campaigns").glob("*"))
        if folder.name not in shown and registration_files(Campaign(folder))
    ]
    if not collected and not absent:
        return None
    return RegistrationSection([_registered(store, campaigns, it) for it in collected], absent)


def _registered(store: TrialStore, campaigns: list[Collected], item: Collected) -> Registered:
    files: list[list[str]] = []
    found: list[RegistrationDeviation] = []
    after, rig = "", False
    try:
        for path, each in registrations(item.campaign):
            stamped = ", ".join(stamp.name for stamp in stamps(path)) or "–"
            files.append([path.name, each.registered[:19], each.after, stamped, sha256(path)])
            if not after:
                after, rig = each.after, each.rig is not None
                found += campaign_deviations(item, each, path)
                found += _evaluation_deviations(store, campaigns, item)
        problems = [
            RegistrationDeviation("damaged registration", "–", f"{path.name}: {what}")
            for path, what in registration_problems(item.campaign)
        ]
        if problems:  # what the files state of their time proves nothing
            found = [*problems, *found]
            after = "but its registrations are damaged, missing or changed"
    except (InputError, StoreError) as error:
        after = after or "but cannot be read"
        found.append(RegistrationDeviation("a file cannot be read", "–", str(error)))
    return Registered(
        item.name,
        after,
        rig,
        Table(("file", "registered (UTC)", "when", "stamps", "SHA-256 of the file"), files),
        Table(("deviation", "registered", "found"), found),
    )


def _evaluation_deviations(
    store: TrialStore, campaigns: list[Collected], item: Collected
) -> Iterator[RegistrationDeviation]:
    """Yield options of `sliplab evaluate` that took the place of the protocol's settings."""
    try:
        evaluation = evaluation_of(store)
    except StoreError:  # nothing evaluated is shown
        return
    if evaluation.reviewed is not None:
        states = ", ".join(f"{n} {state}" for state, n in evaluation.reviewed.items())
        yield RegistrationDeviation(
            "evaluate --reviewed", "–", f"review decisions are applied: {states}"
        )
    rule = evaluation.detection.get(item.name)
    if rule is None or rule.choose != "protocol":
        return
    planned = rules_of(campaigns, training_settings(campaigns).network.outputs_per_class)[item.name]
    # without events they are chosen by validation trials unless they are given
    chosen = planned.choose != "protocol" or missing_stream(campaigns) == "events"
    values = [f"smoothing {each.smoothing}, margin {each.margin:g}" for each in (planned, rule)]
    if chosen or values[0] != values[1]:
        settings = "chosen by trials" if chosen else values[0]
        yield RegistrationDeviation("evaluate --smoothing, --margin", settings, values[1])
