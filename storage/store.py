"""The store: a folder with campaigns, each of which is one protocol run on one rig.

    STORE/store.json
    STORE/campaigns/NAME/campaign.json protocol.yaml rig.yaml
    STORE/campaigns/NAME/trials/ID/      committed trials
    STORE/campaigns/NAME/incoming/ID/    the trial being written
    STORE/campaigns/NAME/quarantine/     what did not become a trial, each with its cause
    STORE/campaigns/NAME/bench/          who stood at the rig, one file a stretch of work
    STORE/derived/ models/ report/       what analysis made of it; may be deleted at any time

What is committed is decided by one rename and by nothing else.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from storage.files import read_json, sync_folder, write_json, write_text
from storage.recording import Recording
from storage.streams import Json
from storage.writer import PROVENANCE, TrialWriter

FORMAT = 1
SYNC = "sync"
"""The step whose results hold clocks that were fitted again; recordings read them there."""
_SAFE = re.compile(r"[A-Za-z0-9][A-Za-z0-9=,._+-]{0,250}")


class StoreError(RuntimeError):
    """A store that cannot be used as asked; the message names the path and what to do."""


def safe_name(name: str) -> str:
    """`name` if it is a plain file name.

    Raises:
        StoreError: it could lead out of its folder.
    """
    if not _SAFE.fullmatch(name) or ".." in name:
        raise StoreError(f"'{name}' cannot be the name of a folder in a store")
    return name


@dataclass(frozen=True)
class Campaign:
    """One protocol on one rig inside a store."""

    folder: Path

    @property
    def name(self) -> str:
        """The campaign's name."""
        return self.folder.name

    @property
    def info(self) -> Json:
        """What `campaign.json` says."""
        return read_json(self.folder / "campaign.json")

    @property
    def protocol_file(self) -> Path:
        """The copy of the protocol this campaign runs by."""
        return self.folder / "protocol.yaml"

    def update(self, info: Json, protocol_text: str, rig_text: str) -> None:
        """Write the campaign's description and its copies of protocol and rig file."""
        for name in ("trials", "incoming", "quarantine", "bench"):
            (self.folder / name).mkdir(parents=True, exist_ok=True)
        write_text(self.protocol_file, protocol_text)
        write_text(self.folder / "rig.yaml", rig_text)
        write_json(self.folder / "campaign.json", info)

    def committed(self) -> set[str]:
        """Ids of the committed trials."""
        return {path.name for path in self._folders("trials")}

    def recordings(self) -> Iterator[Recording]:
        """The committed trials by id."""
        for path in self._folders("trials"):
            yield Recording(path, self._sync_file(path.name))

    def recording(self, trial_id: str) -> Recording:
        """One committed trial.

        Raises:
            StoreError: there is none of this id.
        """
        path = self.folder / "trials" / safe_name(trial_id)
        if not path.is_dir():
            raise StoreError(f"{path}: no such trial in campaign '{self.name}'")
        return Recording(path, self._sync_file(trial_id))

    def begin(
        self, trial_id: str, frame_px: tuple[int, int] | None, rate_hz: int, *, spool: bool = False
    ) -> TrialWriter:
        """Begin to write a trial; what stood aside under its id is quarantined first."""
        aside = self.folder / "incoming" / safe_name(trial_id)
        if aside.exists():
            self.quarantine(aside, "interrupted")
        return TrialWriter(aside, self.folder / "trials" / trial_id, frame_px, rate_hz, spool=spool)

    def sweep(self) -> int:
        """Quarantine what a killed program left aside; returns how many folders."""
        left = list(self._folders("incoming"))
        for path in left:
            self.quarantine(path, "interrupted")
        return len(left)

    def quarantine(self, folder: Path, cause: str) -> Path:
        """Move a folder that did not become a trial out of the way, with its cause."""
        write_json(folder / "cause.json", {"cause": cause, "trial": folder.name})
        target = self.quarantine_path(folder.name)
        os.rename(folder, target)
        sync_folder(target.parent)
        return target

    def quarantine_path(self, trial_id: str) -> Path:
        """A free folder in quarantine for this trial."""
        number = 1
        while (path := self.folder / "quarantine" / f"{trial_id}.{number}").exists():
            number += 1
        return path

    def quarantined(self) -> list[Json]:
        """Cause and trial of everything in quarantine."""
        causes = []
        for path in self._folders("quarantine"):
            file = path / "cause.json"
            known = read_json(file) if file.exists() else {"cause": "unknown"}
            trial_id = path.name.rpartition(".")[0]
            causes.append({**known, "trial": trial_id, "folder": path.name})
        return causes

    def failed_attempts(self) -> dict[str, int]:
        """How often each trial was taken and failed a gate."""
        counts: dict[str, int] = {}
        for item in self.quarantined():
            if str(item["cause"]).startswith("gate"):
                counts[item["trial"]] = counts.get(item["trial"], 0) + 1
        return counts

    def add_bench_record(self, data: Json) -> None:
        """Keep who stood at the rig, with what, for one stretch of work."""
        folder = self.folder / "bench"
        number = len(list(folder.glob("*.json"))) + 1
        write_json(folder / f"{number:04d}.json", data)

    def provenance(self, recording: Recording) -> Json:
        """When, where and with which versions a trial was taken."""
        return read_json(recording.folder / PROVENANCE)

    def _sync_file(self, trial_id: str) -> Path:
        """Where the sync step keeps what it found of a trial."""
        return self.folder.parent.parent / "derived" / SYNC / self.name / f"{trial_id}.json"

    def _folders(self, name: str) -> Iterator[Path]:
        folder = self.folder / name
        if folder.is_dir():
            for path in sorted(folder.iterdir()):
                if path.is_dir():
                    yield path


@dataclass(frozen=True)
class Store:
    """A store on disk."""

    folder: Path

    @staticmethod
    def open(folder: Path) -> Store:
        """An existing store.

        Raises:
            StoreError: no store there, or one of another format.
        """
        path = folder / "store.json"
        if not path.is_file():
            raise StoreError(
                f"{folder}: is not a store (no store.json); `sliplab collect` makes one"
            )
        try:
            found = read_json(path).get("format")
        except ValueError as error:
            raise StoreError(str(error)) from None
        if found != FORMAT:
            raise StoreError(
                f"{path}: format = {found}; this version of SlipLab reads format {FORMAT}"
            )
        return Store(folder)

    @staticmethod
    def create(folder: Path) -> Store:
        """The store in `folder`, made if there is none.

        Raises:
            StoreError: the folder holds something else.
        """
        if not (folder / "store.json").exists():
            if folder.exists() and not folder.is_dir():
                raise StoreError(f"{folder}: is a file; give a folder for the store")
            if folder.is_dir() and any(not p.name.startswith(".") for p in folder.iterdir()):
                raise StoreError(f"{folder}: holds other files; give an empty folder or a store")
            folder.mkdir(parents=True, exist_ok=True)
            write_json(folder / "store.json", {"format": FORMAT})
        return Store.open(folder)

    def campaign(self, name: str) -> Campaign:
        """The campaign `name`, which may not exist yet."""
        return Campaign(self.folder / "campaigns" / safe_name(name))

    def campaigns(self) -> list[Campaign]:
        """All campaigns by name."""
        folder = self.folder / "campaigns"
        if not folder.is_dir():
            return []
        return [
            Campaign(path) for path in sorted(folder.iterdir()) if (path / "campaign.json").exists()
        ]

    @property
    def simulated(self) -> bool:
        """Whether any of it came from a mock rig."""
        return any(bool(campaign.info["simulated"]) for campaign in self.campaigns())
