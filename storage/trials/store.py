"""The store: a folder with campaigns, each of which is one protocol run on one rig.

    STORE/store.json
    STORE/campaigns/NAME/campaign.json protocol.yaml rig.yaml checksums.json
    STORE/campaigns/NAME/trials/ID/      committed trials
    STORE/campaigns/NAME/incoming/ID/    the trial being written
    STORE/campaigns/NAME/quarantine/     rejected attempts, each with its cause
    STORE/campaigns/NAME/bench/          operator and equipment, one file a session
    STORE/campaigns/NAME/registrations/  what was registered before the first trial, one file a time
    STORE/campaigns/NAME/skipped.json    trials that a person skipped (`storage.trials.control`)
    STORE/control/                       requests of people (`storage.trials.control`)
    STORE/log/                           notes of people (`flows.log`)
    STORE/review/                        decisions about labels (`storage.trials.review`)
    STORE/derived/ models/ report/       results of analysis; may be deleted at any time
    STORE/before/                        copies of what a migration changed

A single rename commits a trial. A folder among the committed trials that is incomplete nevertheless
(a file was deleted or truncated) does not count as a trial: readers skip it, and
the next collection quarantines it and takes the trial again. docs/store.md has all of it.
"""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, NotRequired, TypedDict, cast

from sliplab.storage.errors import NoStore, NoTrial, StoreError, masked, translated_disk_errors
from sliplab.storage.files import (
    inside,
    json_text,
    make_folder,
    read_json,
    safe_name,
    sweep_temporary,
    sync_folder,
    write_bytes,
    write_json,
)
from sliplab.storage.interrupts import uninterrupted
from sliplab.storage.schema.trial import Provenance
from sliplab.storage.streams import Chunk, Json
from sliplab.storage.trials.checksums import CHECKSUMS, PROVENANCE, Fetch, incomplete, write_sums
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.writer import TrialWriter

__all__ = ["FORMAT", "SYNC", "Campaign", "StoreError", "TrialStore"]

FORMAT = 2
"""Format that this version writes; `storage.trials.migrate` brings older ones forward."""
SYNC = "sync"
"""Step whose results hold refitted clocks; recordings read them there."""
INFO, PROTOCOL, RIG, STORE, CAUSE = (
    "campaign.json",
    "protocol.yaml",
    "rig.yaml",
    "store.json",
    "cause.json",
)
REGISTRATIONS = "registrations"
"""Folder of a campaign's registrations (`storage.trials.registration`)."""
IMPORTED: Final = "imported"
"""Key of a campaign's description: where its trials come from, if they were imported."""
ADAPTER = "adapter"
"""Key of that part, and format, of a campaign that came by an adapter, which it keeps."""
AGAIN, FORGIVEN = "again", "forgiven"
"""Cause of a committed trial that is to be retaken; mark of a failed attempt that is no longer
counted."""
_FOLDERS = ("campaigns", "control", "log", "derived", "models", "report", "before")
_URL = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+):/+")
"""Beginning of a URL that was taken for a path, which has one of its two slashes."""


def refuse_url(path: Path) -> None:
    """Check that a path was not given as a URL. Raises NoStore."""
    if found := _URL.match(str(path)):
        slashes = "///" if found[1] == "file" else "//"  # a path has lost all but one
        url = f"{found[1]}:{slashes}{str(path)[found.end() :]}"
        text = "give a folder, then `sliplab push FOLDER URL`, or first `sliplab pull URL FOLDER`"
        raise NoStore(url, f"is a URL, not a folder; {text}")


def known_cause(folder: Path) -> Json | None:
    """Return why a folder is, or is to be, in quarantine; None if that is not known."""
    try:
        return read_json(folder / CAUSE)
    except (OSError, ValueError):
        return None


def _holds(path: Path, data: bytes) -> bool:
    return path.is_file() and not path.is_symlink() and path.read_bytes() == data


class CampaignInfo(TypedDict):
    """Description of a campaign, `campaign.json`.

    A collected campaign has all keys but `imported`; an imported one has that, and neither
    protocol nor rig.

    Attributes:
        protocol: name of it; experiment: its kind.
        collection_hash: of the protocol's `collection:` section; rig_hash: of the rig file.
        enabled: optional levels that are switched on, as ``factor=level``.
        scene_level: of physics; None on a real rig.
        imported: where the trials come from.
    """

    name: str
    simulated: bool
    protocol: NotRequired[str]
    experiment: NotRequired[str]
    collection_hash: NotRequired[str]
    rig: NotRequired[str]
    rig_hash: NotRequired[str]
    enabled: NotRequired[list[str]]
    scene_level: NotRequired[str | None]
    imported: NotRequired[Json]


class QuarantineEntry(TypedDict):
    """An attempt in quarantine.

    Attributes:
        cause: ``interrupted``, or its fault.
        folder: its name in the quarantine.
        attempt: number of the attempt at the trial, of a complete one.
        forgiven: who reset the attempt; asked: who requested the retake.
    """

    cause: str
    trial: str
    folder: str
    attempt: NotRequired[int]
    forgiven: NotRequired[Json]
    asked: NotRequired[Json]


class SessionRecord(TypedDict):
    """Operator, devices and versions of one session.

    Attributes:
        registration: SHA-256 of the campaign's last registration, if there was one.
        no_stopping: the protocol's claims were not to end the campaign.
    """

    began: str
    operator: str
    temperature_c: float | None
    humidity_percent: float | None
    note: str
    rig: str
    sensor: str
    skin: str
    calibration: Json
    skin_age_days: int | None
    simulated: bool
    registration: NotRequired[str]
    no_stopping: NotRequired[bool]


@dataclass(frozen=True)
class Campaign:
    """One protocol on one rig inside a store.

    Attributes:
        fetch: brings files that a mirror lacks when they are read; None in any other store.
    """

    folder: Path
    fetch: Fetch | None = field(default=None, compare=False, repr=False)

    @property
    def name(self) -> str:
        """The campaign's name."""
        return self.folder.name

    @property
    def info(self) -> CampaignInfo:
        """The content of `campaign.json`.

        Raises:
            StoreError: it is damaged.
        """
        path = self.folder / INFO
        try:
            found = read_json(path)
            if not {"name", "simulated"} <= found.keys():
                raise ValueError(f"{path}: lacks 'name' or 'simulated'")
        except (OSError, ValueError) as error:
            raise StoreError(
                f"{error}; it is damaged: restore it from a copy, or move {self.folder} away "
                "and collect again"
            ) from None
        return cast("CampaignInfo", found)

    @property
    def begun(self) -> bool:
        """True once something was collected into it, or could have been."""
        return (self.folder / INFO).exists() or any(self.folders("trials"))

    @property
    def protocol_file(self) -> Path:
        """The copy of the protocol this campaign runs by."""
        return self.folder / PROTOCOL

    @uninterrupted
    def update(self, info: CampaignInfo, protocol_text: str, rig_text: str) -> None:
        """Write the campaign's description and its copies of protocol and rig file.

        Only what changed is written. While it is, there are no checksums: a description without
        them was interrupted, one that does not match them is damaged.
        """
        for name in ("trials", "incoming", "quarantine", "bench"):
            make_folder(self.inside(self.folder / name))
        # who made them may have been killed before their entries were on the disk
        for folder in (self.folder.parent.parent, self.folder.parent, self.folder):
            sync_folder(folder)
        texts = {PROTOCOL: protocol_text, RIG: rig_text, INFO: json_text(info)}
        changed = [
            (self.folder / name, text.encode())
            for name, text in texts.items()
            if not _holds(self.folder / name, text.encode())
        ]
        if changed:
            (self.folder / CHECKSUMS).unlink(missing_ok=True)
            sync_folder(self.folder)
        for path, data in changed:
            write_bytes(path, data)
        write_sums(self.folder, tuple(texts))

    def finish_description(self) -> None:
        """Write the checksums of a description that was written but for them, before a kill."""
        if self.begun and not (self.folder / CHECKSUMS).exists():
            texts = (path.read_text("utf-8") for path in (self.protocol_file, self.folder / RIG))
            self.update(self.info, *texts)

    def committed(self) -> set[str]:
        """Return the ids of the committed trials, as far as they are complete."""
        return {path.name for path in self._complete()}

    def damaged(self) -> dict[str, str]:
        """Return folders among the committed trials that are incomplete, and why."""
        found = {path.name: incomplete(path) for path in self.folders("trials")}
        return {name: cause for name, cause in found.items() if cause is not None}

    def recordings(self) -> Iterator[Recording]:
        """Yield the committed trials by id, as far as they are complete."""
        for path in self._complete():
            yield Recording(path, self.sync_file(path.name), self.fetch)

    def recording(self, trial_id: str) -> Recording:
        """Return one committed trial.

        Raises:
            StoreError: no such trial.
        """
        path = self.folder / "trials" / safe_name(trial_id)
        if not path.is_dir():
            raise StoreError(f"{path}: no such trial in campaign '{self.name}'")
        return Recording(path, self.sync_file(trial_id), self.fetch)

    def begin(
        self,
        trial_id: str,
        frame_px: tuple[int, int] | None,
        rate_hz: int,
        *,
        spool: bool = False,
        expected: Mapping[str, Sequence[Chunk]] | None = None,
    ) -> TrialWriter:
        """Begin to write a trial; an interrupted attempt under its id is quarantined first.

        Call it in a function that is `interrupts.uninterrupted` until the writer has ended.
        """
        incoming, target = self.places(trial_id)
        return TrialWriter(incoming, target, frame_px, rate_hz, spool=spool, expected=expected)

    def places(self, trial_id: str) -> tuple[Path, Path]:
        """Return a trial's folder while it is written, and once it is committed; both are free.

        An interrupted attempt under its id is quarantined first.
        """
        incoming = self.inside(self.folder / "incoming" / safe_name(trial_id))
        target = self.inside(self.folder / "trials" / trial_id)
        if incoming.exists():
            self.quarantine(incoming, "interrupted")
        if target.is_dir() and (cause := incomplete(target)) is not None:
            self.quarantine(target, f"damaged: {cause}")
        return incoming, target

    def sweep(self) -> int:
        """Clean up after a killed program or a failing disk, before trials are taken.

        Unfinished trials, and committed ones that are incomplete, go to quarantine; temporary files
        are deleted. The caller holds the store's lock.

        Returns:
            The number of folders that went to quarantine.
        """
        for folder in (self.folder, self.folder / "bench", self.folder / REGISTRATIONS):
            sweep_temporary(folder)
        left = dict.fromkeys(self.folders("incoming"), "interrupted")
        for name, cause in self.damaged().items():
            left[self.folder / "trials" / name] = f"damaged: {cause}"
        moving = [path for path in self.folders("trials") if (path / CAUSE).exists()]
        left |= dict.fromkeys(moving, "interrupted")
        for path, cause in left.items():
            if known_cause(path) is None:
                self.quarantine(path, cause)
            else:  # a killed program was about to move it
                self._move_to_quarantine(path)
        for path in (*self.folders("quarantine"), *self.folders("trials")):
            sweep_temporary(path)
        return len(left)

    @uninterrupted
    def quarantine(self, folder: Path, cause: str, **more: object) -> Path:
        """Move a folder that is not a trial, or no longer one, to quarantine, with its cause."""
        sweep_temporary(folder)
        write_json(folder / CAUSE, {"cause": masked(cause), "trial": folder.name, **more})
        return self._move_to_quarantine(folder)

    def _move_to_quarantine(self, folder: Path) -> Path:
        target = self.quarantine_path(folder.name)
        os.rename(folder, target)
        sync_folder(target.parent)
        return target

    def quarantine_path(self, trial_id: str) -> Path:
        """Return a free folder in quarantine for a trial."""
        self.inside(self.folder / "quarantine")
        number = 1
        while (path := self.folder / "quarantine" / f"{trial_id}.{number}").exists():
            number += 1
        return path

    def quarantined(self) -> list[QuarantineEntry]:
        """Return cause, trial and folder of everything in quarantine."""
        causes: list[QuarantineEntry] = []
        for path in self.folders("quarantine"):
            known = {"cause": "unknown", **(known_cause(path) or {})}
            trial_id = path.name.rpartition(".")[0]
            entry = {**known, "trial": trial_id, "folder": path.name}
            causes.append(cast("QuarantineEntry", entry))
        return causes

    def failed_attempts(self) -> dict[str, int]:
        """Count the attempts at each trial that failed a gate since it was last requested again."""
        return self._count(
            lambda item: str(item["cause"]).startswith("gate") and FORGIVEN not in item
        )

    def attempts(self) -> dict[str, int]:
        """Count the complete attempts at each trial that were rejected: each has its own seed."""
        return self._count(lambda item: str(item["cause"]).startswith(("gate", AGAIN)))

    def _count(self, wanted: Callable[[QuarantineEntry], bool]) -> dict[str, int]:
        return Counter(item["trial"] for item in self.quarantined() if wanted(item))

    def add_bench_record(self, data: SessionRecord) -> None:
        """Store the operator and equipment of one session."""
        folder = self.folder / "bench"
        make_folder(self.inside(folder))
        there = [int(path.stem) for path in folder.glob("*.json") if path.stem.isdecimal()]
        number = max(there, default=0) + 1
        write_json(folder / f"{number:04d}.json", data)

    def provenance(self, recording: Recording) -> Provenance:
        """Return when, where and with which versions a trial was taken."""
        return Provenance.load(recording.folder / PROVENANCE)

    @property
    def sync_folder(self) -> Path:
        """Folder of the clocks that were fitted again, if there are any."""
        return self.folder.parent.parent / "derived" / SYNC / self.name

    def sync_file(self, trial_id: str) -> Path:
        """Return the path of a trial's clocks that were fitted again, if there are any."""
        return self.sync_folder / f"{trial_id}.json"

    def folders(self, name: str) -> Iterator[Path]:
        """Yield the folders in one of the campaign's own, by name; links are left out."""
        folder = self.folder / name
        if folder.is_dir():
            for path in sorted(folder.iterdir()):
                if path.is_dir() and not path.is_symlink():
                    yield path

    def _complete(self) -> Iterator[Path]:
        return (path for path in self.folders("trials") if incomplete(path) is None)

    def inside(self, path: Path) -> Path:
        """Return `path`; raise `StoreError` if a link on the way leads out of the store."""
        return inside(path, self.folder.parent.parent)


@dataclass(frozen=True)
class TrialStore:
    """A store on disk.

    Attributes:
        fetch: brings files that a mirror lacks when they are read (`storage.remote.mirror`); None
            for any other store.
    """

    folder: Path
    fetch: Fetch | None = field(default=None, compare=False, repr=False)

    @staticmethod
    def open(folder: Path, fetch: Fetch | None = None) -> TrialStore:
        """Open an existing store.

        Raises:
            NoStore: no store there.
            StoreError: one of another format, or a damaged one.
        """
        refuse_url(folder)
        path = folder / STORE
        if not path.is_file():
            text = "is not a store (no store.json); `sliplab collect`, `record`, `import` make one"
            raise NoStore(folder, text)
        try:
            found = read_json(path).get("format")
        except (OSError, ValueError) as error:
            raise StoreError(
                f"{error}; it is damaged: restore it from a copy; in this version it contains "
                f'{{"format": {FORMAT}}}'
            ) from None
        if isinstance(found, int) and found > FORMAT:
            raise StoreError(
                f"{path}: format = {found}: was written by a newer version of SlipLab; this one "
                f"reads formats up to {FORMAT}: update it"
            )
        if isinstance(found, bool) or not isinstance(found, int) or found < 1:
            raise StoreError(f"{path}: format = {found!r}: must be a number from 1 to {FORMAT}")
        for name in _FOLDERS:
            if (folder / name).is_symlink():
                inside(folder / name, folder)
        return TrialStore(folder, fetch)

    @property
    def format(self) -> int:
        """Format of the store; `storage.trials.migrate` brings older ones to `FORMAT`."""
        return int(read_json(self.folder / STORE)["format"])

    @staticmethod
    def exists(folder: Path) -> bool:
        """Return whether a folder holds a store; False for one that could hold one.

        Raises:
            NoStore: it is a URL, a file, a folder that holds something else, or among campaigns.
        """
        refuse_url(folder)
        if (folder / STORE).exists():
            return True
        if folder.exists() and not folder.is_dir():
            raise NoStore(folder, "is a file; give a folder for the store")
        if folder.is_dir() and any(not p.name.startswith(".") for p in folder.iterdir()):
            raise NoStore(folder, "holds other files; give an empty folder or a store")
        for place in (there := folder.resolve()).parents:
            if there.is_relative_to(place / "campaigns") and (place / STORE).is_file():
                text = f"lies among the campaigns of the store {place}; give a folder outside of it"
                raise NoStore(folder, text)
        return False

    @staticmethod
    @uninterrupted
    def create(folder: Path) -> TrialStore:
        """Open the store in `folder`; make it if there is none.

        Raises:
            NoStore: as `exists`.
            StoreError: nothing can be written there.
        """
        if not TrialStore.exists(folder):
            with translated_disk_errors(folder):
                make_folder(folder)
                write_json(folder / STORE, {"format": FORMAT})
        return TrialStore.open(folder)

    def campaign(self, name: str) -> Campaign:
        """Return the campaign `name`, which may not exist yet."""
        return Campaign(self.folder / "campaigns" / safe_name(name), self.fetch)

    def campaigns(self) -> list[Campaign]:
        """Return all campaigns by name."""
        folder = self.folder / "campaigns"
        if not folder.is_dir():
            return []
        return [
            Campaign(path, self.fetch)
            for path in sorted(folder.iterdir())
            if not path.is_symlink() and (path / INFO).is_file()
        ]

    def holders(self, trial: str, campaign: str | None = None) -> list[Campaign]:
        """Return the campaigns, or that of the name, that have a committed trial of this id."""
        named = (item for item in self.campaigns() if campaign in (None, item.name))
        return [item for item in named if trial in item.committed()]

    def holder(self, trial: str, campaign: str | None = None) -> Campaign:
        """Return the campaign of a committed trial.

        Args:
            campaign: its name; needed where several have a trial of this id.

        Raises:
            NoTrial: there is no such trial, or more than one.
        """
        found = self.holders(trial, campaign)
        if len(found) > 1:
            names = ", ".join(item.name for item in found)
            raise NoTrial(trial, f"is in {names}; name one with --campaign")
        if not found:
            where = str(self.folder) if campaign is None else f"campaign '{campaign}'"
            listed = f"`sliplab trials {self.folder}` lists them"
            raise NoTrial(trial, f"is no committed trial of {where}; {listed}")
        return found[0]

    @property
    def simulated(self) -> bool:
        """True if any of it came from a mock rig."""
        return any(bool(campaign.info["simulated"]) for campaign in self.campaigns())


Store = TrialStore
"""Its former name, which plug-ins import."""
