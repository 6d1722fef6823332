"""Publication of trials in one folder: the store's own files, MCAP, or a LeRobot data set.

In addition to the trials there are tables, a data card, checksums, and descriptions as Croissant
and as RO-Crate. The folder of the store's own files reads as a store as well.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from sliplab.plugins.publish.card import data_card
from sliplab.plugins.publish.croissant import croissant
from sliplab.plugins.publish.lerobot import write_lerobot
from sliplab.plugins.publish.publication import (
    PERSONAL,
    Publication,
    TrialPath,
    campaign_folder,
    staged,
    trial_folder,
)
from sliplab.plugins.publish.ro_crate import ro_crate
from sliplab.plugins.publish.tables import LABELLED, write_tables
from sliplab.protocols.errors import InputError
from sliplab.storage.files import inside, sha256, write_json_aside
from sliplab.storage.formats.foreign import FormatError
from sliplab.storage.formats.format import Format
from sliplab.storage.formats.known import known_formats
from sliplab.storage.schema.label import LABELS
from sliplab.storage.streams import Json
from sliplab.storage.trials.checksums import CHECKSUMS, DATA, PROVENANCE
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.registration import copy_registrations
from sliplab.storage.trials.store import (
    INFO,
    PROTOCOL,
    REGISTRATIONS,
    RIG,
    STORE,
    SYNC,
    Campaign,
)

CROISSANT, RO_CRATE, CARD, SUMS = (
    "croissant.json",
    "ro-crate-metadata.json",
    "README.md",
    "checksums.sha256",
)


@dataclass(frozen=True)
class Form:
    """A form that trials are published in.

    Attributes:
        path: gives a trial's folder or file in the publication.
        data: what follows in the path of the trial's data.
        write: writes one trial into the publication's folder.
        finish: writes what is of all trials, and reports each of them.
        card: a section of the data card about the data.
        archive: with the slip archive's tables.
    """

    path: TrialPath
    data: str
    write: Callable[[Publication, Campaign, Recording, Path], None]
    finish: Callable[[Publication, Path, Callable[[str], None]], None] | None = None
    card: str = ""
    archive: bool = False


def publish(
    publication: Publication,
    output: Path,
    form: str,
    on_trial: Callable[[str], None] = lambda name: None,
) -> Json:
    """Write a publication into the new folder `output`.

    Args:
        form: one of `forms`.

    Returns:
        ``trials``, ``labels``, ``files`` and ``bytes`` written, and ``simulated``.

    Raises:
        InputError: `output` exists, or a trial is damaged or does not fit the format.
    """
    how = forms()[form]
    with staged(output.absolute()) as folder:
        for campaign in publication.campaigns:
            _copy_campaign(campaign, folder)
        for campaign, recording in publication.recordings:
            if how.finish is None:
                on_trial(recording.folder.name)
            how.write(publication, campaign, recording, folder)
        if how.finish is not None:
            how.finish(publication, folder, on_trial)
        tables = write_tables(publication, folder, how.path, archive=how.archive)
        (folder / CARD).write_text(data_card(publication, tables, form, how.card), "utf-8")
        write_json_aside(folder / CROISSANT, croissant(publication, tables, folder))
        files = sorted(path for path in folder.rglob("*") if path.is_file())
        sums = {path.relative_to(folder).as_posix(): sha256(path) for path in files}
        sizes = {path.relative_to(folder).as_posix(): path.stat().st_size for path in files}
        crate = ro_crate(publication, sums, sizes, lambda *trial: how.path(*trial) + how.data)
        write_json_aside(folder / RO_CRATE, crate)
        sums[RO_CRATE] = sha256(folder / RO_CRATE)
        lines = "".join(f"{digest}  {name}\n" for name, digest in sorted(sums.items()))
        (folder / SUMS).write_text(lines, "utf-8")
    return {
        "trials": publication.count,
        "labels": len(tables[LABELLED]) if LABELLED in tables else 0,
        "files": len(sums) + 1,
        "bytes": sum(sizes.values()),
        "simulated": publication.simulated,
    }


def _copy_campaign(campaign: Campaign, folder: Path) -> None:
    target = folder / campaign_folder(campaign.name)
    target.mkdir(parents=True)
    for name in (INFO, PROTOCOL, RIG, CHECKSUMS):
        if (campaign.folder / name).is_file():
            shutil.copyfile(campaign.folder / name, target / name)
    copy_registrations(campaign, target / REGISTRATIONS)


def _copy_trial(
    publication: Publication, campaign: Campaign, recording: Recording, folder: Path
) -> None:
    """Copy a trial's files, its label and its refitted clocks, into a store."""
    store, trial = publication.store, recording.folder.name
    if not (folder / STORE).exists():
        shutil.copyfile(store.folder / STORE, folder / STORE)
    target = folder / trial_folder(campaign.name, trial)
    target.mkdir(parents=True)
    for name, path in publication.files(campaign, recording).items():
        shutil.copyfile(path, target / name)
    shutil.copyfile(recording.folder / CHECKSUMS, target / CHECKSUMS)
    made = campaign.provenance(recording).to_json()
    retained = {key: value for key, value in made.items() if key not in PERSONAL}
    write_json_aside(target / PROVENANCE, retained)
    labels = Derived.of(store, LABELS, campaign.name)
    results = {LABELS: [labels.folder / f"{trial}.json", labels.arrays_path(trial)]}
    if recording.refitted:
        results[SYNC] = [campaign.sync_file(trial)]
    for step, paths in results.items():
        copied = folder / "derived" / step / campaign.name
        for path in paths:
            if path.is_file():
                copied.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(inside(path, store.folder), copied / path.name)


def forms() -> dict[str, Form]:
    """Return the forms of a publication by name: a store's files, or files of a format."""
    files = {name: _form(name, each) for name, each in known_formats() if each.publish is not None}
    return {
        "croissant": Form(trial_folder, f"/{DATA}", _copy_trial),
        **files,
        "archive": Form(trial_folder, f"/{DATA}", _copy_trial, archive=True),
        "lerobot": Form(trial_folder, f"/{DATA}", _copy_trial, write_lerobot),
    }


def _form(name: str, how: Format) -> Form:
    """Return the form in which each trial is one file of a format."""

    def path(campaign: str, trial: str) -> str:
        return f"{campaign_folder(campaign)}/{trial}{how.suffixes[0]}"

    def write(
        publication: Publication, campaign: Campaign, recording: Recording, folder: Path
    ) -> None:
        publication.files(campaign, recording)  # each is checked
        file = folder / path(campaign.name, recording.folder.name)
        assert how.publish is not None
        try:
            how.publish(file, publication.store, campaign, recording, PERSONAL)
        except FormatError as error:
            raise InputError(
                "--as", "", name, f"trial {recording.folder.name} {error}; it fits croissant"
            ) from None

    return Form(path, "", write, card=how.card)
