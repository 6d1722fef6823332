"""The store: a folder with campaigns, each of which is one protocol run on one rig.

    STORE/store.json
    STORE/campaigns/NAME/campaign.json protocol.yaml rig.yaml checksums.json
    STORE/campaigns/NAME/trials/ID/      committed trials
    STORE/campaigns/NAME/incoming/ID/    the trial being written
    STORE/campaigns/NAME/quarantine/     what did not become a trial, each with its cause
    STORE/campaigns/NAME/bench/          who stood at the rig, one file a stretch of work
    STORE/campaigns/NAME/skipped.json    trials that a person set aside (`storage.trials.decisions`)
    STORE/control/                       what people asked for meanwhile (`storage.trials.control`)
    STORE/review/                        what people decided about labels (`storage.trials.review`)
    STORE/derived/ models/ report/       what analysis made of it; may be deleted at any time
    STORE/before/                        copies of what a migration changed

What is committed is decided by one rename and by nothing else. A folder among the committed ones
that is not whole all the same (a file was deleted or cut short) is no trial: it is passed over when
reading, and quarantined and taken again by the next collection. docs/store.md has all of it.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from sliplab.storage.errors import NoStore, StoreError, masked, translated_disk_errors
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
from sliplab.storage.schema.trial import Provenance
from sliplab.storage.streams import Json
from sliplab.storage.trials.checksums import partial, write_sums
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.writer import CHECKSUMS, PROVENANCE, TrialWriter

__all__ = ["FORMAT", "SYNC", "Campaign", "Store", "StoreError"]

FORMAT = 2
"""Format that this version writes; `storage.trials.migrate` brings older ones forward."""
SYNC = "sync"
"""The step whose results hold clocks that were fitted again; recordings read them there."""
INFO, PROTOCOL, RIG, STORE, CAUSE = (
    "campaign.json", "protocol.yaml", "rig.yaml", "store.json", "cause.json"
)  # fmt: skip
IMPORTED = "imported"
"""In a campaign's description: where its trials come from, if nobody collected them here."""
AGAIN, FORGIVEN = "again", "forgiven"
"""A committed trial that a person wants anew; a failed attempt that counts no longer."""
_FOLDERS = ("campaigns", "control", "derived", "models", "report", "before")


def _holds(path: Path, data: bytes) -> bool:
    return path.is_file() and not path.is_symlink() and path.read_bytes() == data


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
        """What `campaign.json` says.

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
                f"{error}; it is damaged: put it back from a copy, or move {self.folder} away "
                "and collect anew"
            ) from None
        return found

    @property
    def begun(self) -> bool:
        """Whether something was ever collected into it, or could have been."""
        return (self.folder / INFO).exists() or any(self._folders("trials"))

    @property
    def protocol_file(self) -> Path:
        """The copy of the protocol this campaign runs by."""
        return self.folder / PROTOCOL

    def update(self, info: Json, protocol_text: str, rig_text: str) -> None:
        """Write the campaign's description and its copies of protocol and rig file.

        Only what changed is written. While it is, there are no checksums: a description without
        them was interrupted, one that does not match them is damaged.
        """
        for name in ("trials", "incoming", "quarantine", "bench"):
            make_folder(self._inside(self.folder / name))
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

    def committed(self) -> set[str]:
        """Ids of the committed trials, as far as they are whole."""
        return {path.name for path in self._whole()}

    def damaged(self) -> dict[str, str]:
        """Folders among the committed trials that are not whole, and why."""
        found = {path.name: partial(path) for path in self._folders("trials")}
        return {name: cause for name, cause in found.items() if cause is not None}

    def recordings(self) -> Iterator[Recording]:
        """The committed trials by id, as far as they are whole."""
        for path in self._whole():
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
        aside = self._inside(self.folder / "incoming" / safe_name(trial_id))
        target = self._inside(self.folder / "trials" / trial_id)
        if aside.exists():
            self.quarantine(aside, "interrupted")
        if target.is_dir() and (cause := partial(target)) is not None:
            self.quarantine(target, f"damaged: {cause}")
        return TrialWriter(aside, target, frame_px, rate_hz, spool=spool)

    def sweep(self) -> int:
        """Clear up after a killed program or a failing disk, before trials are taken.

        Trials that stand aside, and committed ones that are not whole, go to quarantine; temporary
        files are deleted. Whoever calls this holds the store's lock.

        Returns:
            how many folders went to quarantine.
        """
        for folder in (self.folder, self.folder / "bench"):
            sweep_temporary(folder)
        left = dict.fromkeys(self._folders("incoming"), "interrupted")
        for name, cause in self.damaged().items():
            left[self.folder / "trials" / name] = f"damaged: {cause}"
        for path, cause in left.items():
            self.quarantine(path, cause)
        for path in self._folders("quarantine"):
            sweep_temporary(path)
        return len(left)

    def quarantine(self, folder: Path, cause: str, **more: object) -> Path:
        """Move a folder that is no trial, or no longer, out of the way, with its cause."""
        sweep_temporary(folder)
        write_json(folder / CAUSE, {"cause": masked(cause), "trial": folder.name, **more})
        target = self.quarantine_path(folder.name)
        os.rename(folder, target)
        sync_folder(target.parent)
        return target

    def quarantine_path(self, trial_id: str) -> Path:
        """A free folder in quarantine for this trial."""
        self._inside(self.folder / "quarantine")
        number = 1
        while (path := self.folder / "quarantine" / f"{trial_id}.{number}").exists():
            number += 1
        return path

    def quarantined(self) -> list[Json]:
        """Cause and trial of everything in quarantine."""
        causes = []
        for path in self._folders("quarantine"):
            try:
                known = read_json(path / CAUSE)
            except (OSError, ValueError):
                known = {}
            known.setdefault("cause", "unknown")
            trial_id = path.name.rpartition(".")[0]
            causes.append({**known, "trial": trial_id, "folder": path.name})
        return causes

    def failed_attempts(self) -> dict[str, int]:
        """How often each trial was taken and failed a gate, since it was last asked for again."""
        return self._count(
            lambda item: str(item["cause"]).startswith("gate") and FORGIVEN not in item
        )

    def attempts(self) -> dict[str, int]:
        """How often each trial was taken to its end and not kept: each take has its own seed."""
        return self._count(lambda item: str(item["cause"]).startswith(("gate", AGAIN)))

    def _count(self, wanted: Callable[[Json], bool]) -> dict[str, int]:
        counts: dict[str, int] = {}
        for item in self.quarantined():
            if wanted(item):
                counts[item["trial"]] = counts.get(item["trial"], 0) + 1
        return counts

    def add_bench_record(self, data: Json) -> None:
        """Keep who stood at the rig, with what, for one stretch of work."""
        folder = self.folder / "bench"
        make_folder(self._inside(folder))
        there = [int(path.stem) for path in folder.glob("*.json") if path.stem.isdecimal()]
        number = max(there, default=0) + 1
        write_json(folder / f"{number:04d}.json", data)

    def provenance(self, recording: Recording) -> Provenance:
        """When, where and with which versions a trial was taken."""
        return Provenance.load(recording.folder / PROVENANCE)

    def _sync_file(self, trial_id: str) -> Path:
        """Where the sync step keeps what it found of a trial."""
        return self.folder.parent.parent / "derived" / SYNC / self.name / f"{trial_id}.json"

    def _folders(self, name: str) -> Iterator[Path]:
        folder = self.folder / name
        if folder.is_dir():
            for path in sorted(folder.iterdir()):
                if path.is_dir() and not path.is_symlink():
                    yield path

    def _whole(self) -> Iterator[Path]:
        return (path for path in self._folders("trials") if partial(path) is None)

    def _inside(self, path: Path) -> Path:
        """`path`, if no link on the way to it leads out of the store.

        Raises:
            StoreError: one does.
        """
        return inside(path, self.folder.parent.parent)


@dataclass(frozen=True)
class Store:
    """A store on disk."""

    folder: Path

    @staticmethod
    def open(folder: Path) -> Store:
        """An existing store.

        Raises:
            NoStore: no store there.
            StoreError: one of another format, or a damaged one.
        """
        path = folder / STORE
        if not path.is_file():
            raise NoStore(folder, "is not a store (no store.json); `sliplab collect` makes one")
        try:
            found = read_json(path).get("format")
        except (OSError, ValueError) as error:
            raise StoreError(
                f"{error}; it is damaged: put it back from a copy; in this version it says "
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
        return Store(folder)

    @property
    def format(self) -> int:
        """The format that the store has; `storage.trials.migrate` brings older ones to `FORMAT`."""
        return int(read_json(self.folder / STORE)["format"])

    @staticmethod
    def exists(folder: Path) -> bool:
        """Return whether a store is there already, in a folder that could hold one.

        Raises:
            NoStore: it is a file, or a folder that holds something else.
        """
        if (folder / STORE).exists():
            return True
        if folder.exists() and not folder.is_dir():
            raise NoStore(folder, "is a file; give a folder for the store")
        if folder.is_dir() and any(not p.name.startswith(".") for p in folder.iterdir()):
            raise NoStore(folder, "holds other files; give an empty folder or a store")
        return False

    @staticmethod
    def create(folder: Path) -> Store:
        """The store in `folder`, made if there is none.

        Raises:
            NoStore: the folder holds something else.
            StoreError: nothing can be written there.
        """
        if not Store.exists(folder):
            with translated_disk_errors(folder):
                make_folder(folder)
                write_json(folder / STORE, {"format": FORMAT})
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
            Campaign(path)
            for path in sorted(folder.iterdir())
            if not path.is_symlink() and (path / INFO).is_file()
        ]

    @property
    def simulated(self) -> bool:
        """Whether any of it came from a mock rig."""
        return any(bool(campaign.info["simulated"]) for campaign in self.campaigns())
