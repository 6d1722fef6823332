"""Upload of committed trials to shared or object storage: each one atomically.

Files are sent first, each read back and checked against its checksum, and the trial's manifest
last. Only committed trials are read, so a campaign may run in the meantime. Files that exist at the
URL are not sent again.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence, Set
from dataclasses import dataclass, field
from pathlib import Path

from sliplab.storage.errors import StoreError
from sliplab.storage.remote.manifest import (
    Kind,
    Manifest,
    campaign_manifest,
    manifest_key,
    objects_folder,
    quarantine_manifest,
    read_manifests,
    take_of,
    trial_manifest,
)
from sliplab.storage.remote.objects import OnBytes, Remote, RemoteError, RemoteMissing
from sliplab.storage.remote.pull import was_pulled
from sliplab.storage.trials.checksums import Checksum
from sliplab.storage.trials.store import AGAIN, INFO, Campaign, TrialStore

OnTrial = Callable[[str], None]
_TRIES = 2
"""Attempts to send an object that comes back with other bytes."""
_SAME = ("name", "protocol", "experiment", "rig", "simulated")
"""Keys that a campaign keeps for all its life; where these differ it is another campaign."""


@dataclass
class PushResult:
    """Counts of a push.

    Attributes:
        trials: committed ones; pushed and replaced: of these, sent now, for the first time or
            because they were retaken; there: they had been sent before.
        withdrawn: no longer visible, because a person wants them again; set_aside: sent of
            quarantine; files and bytes: sent.
        problems: failed uploads, with reasons.
    """

    trials: int = 0
    pushed: int = 0
    replaced: int = 0
    there: int = 0
    withdrawn: int = 0
    set_aside: int = 0
    files: int = 0
    bytes: int = 0
    problems: list[str] = field(default_factory=list)

    def add(self, other: PushResult) -> None:
        """Add another round; `trials`, `there` and `problems` are those of the later one."""
        for name in ("pushed", "replaced", "withdrawn", "set_aside", "files", "bytes"):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        self.trials, self.there, self.problems = other.trials, other.there, other.problems


@dataclass(frozen=True)
class PushOptions:
    """Options of a push.

    Attributes:
        quarantine: push quarantine, too.
        replace: also trials of which the target has another take, unknown to this store.
        read_back: read every object that was sent; without it, only its size is compared.
        check: read back existing objects, too, and upload damaged ones again.
    """

    quarantine: bool = False
    replace: bool = False
    read_back: bool = True
    check: bool = False


def push(
    store: TrialStore,
    remote: Remote,
    campaigns: Sequence[Campaign] | None = None,
    options: PushOptions | None = None,
    on_trial: OnTrial | None = None,
    on_bytes: OnBytes | None = None,
) -> PushResult:
    """Send what `remote` lacks of some campaigns, of all by default.

    Args:
        on_trial: called with each committed trial's id once it is done with.
        on_bytes: called with the bytes sent or read back.

    Raises:
        RemoteError: the storage cannot be reached or written to; what was sent by then counts.
        StoreError: the store is of an older format.
    """
    if store.format < 2:
        raise StoreError(f"{store.folder}: has an older format; run `sliplab migrate` first")
    remote.begin()
    done = PushResult()
    for campaign in store.campaigns() if campaigns is None else campaigns:
        _Push(remote, campaign, options or PushOptions(), done, on_bytes).run(on_trial)
    return done


class _Conflict(RemoteError):
    """Two stores have campaigns of one name."""


@dataclass
class _Push:
    """Push of one campaign.

    Attributes:
        sizes: bytes of the objects that exist, by SHA-256.
        trusted: SHA-256 of objects that were read back, now or before a manifest was written.
    """

    remote: Remote
    campaign: Campaign
    options: PushOptions
    done: PushResult
    on_bytes: OnBytes | None
    sizes: dict[str, int] = field(default_factory=dict)
    trusted: set[str] = field(default_factory=set)

    def run(self, on_trial: OnTrial | None) -> None:
        name = self.campaign.name
        try:
            about = campaign_manifest(self.campaign)
            self._check_same_campaign()
        except (OSError, ValueError, StoreError) as error:
            if isinstance(error, RemoteError) and not isinstance(error, _Conflict):
                raise
            self._problem(f"{error}")
            return
        kinds: tuple[Kind, ...] = ("trials", "quarantine", "withdrawn")
        folders = [manifest_key(kind, name).removesuffix(".json") for kind in kinds]
        self.remote.sweep("", f"campaigns/{name}", objects_folder(name), *folders)
        self.sizes = self.remote.sizes(objects_folder(name))
        theirs = self._manifests("trials")
        self._send(about, self.campaign.folder, self._manifests("about").get(""))
        marked = self._manifests("withdrawn").keys()
        ours = set()
        for recording in self.campaign.recordings():
            trial = recording.folder.name
            self.done.trials += 1
            if trial not in theirs and self._is_withdrawn_elsewhere(recording.folder, marked):
                self._problem(
                    f"{trial}: was pulled, and is withdrawn there since; `sliplab pull` sets it "
                    "aside here"
                )
            else:
                ours.add(trial)
                self._push_trial(trial, theirs.get(trial))
            if on_trial is not None:
                on_trial(trial)
        self._mark_withdrawn(ours, marked)
        for trial, pushed in theirs.items():
            if trial not in ours and pushed.take in self._takes(trial, AGAIN):
                self.remote.remove(pushed.key)
                self.done.withdrawn += 1
        if self.options.quarantine:
            self._push_quarantine()

    def _push_trial(self, trial: str, existing: Manifest | None) -> None:
        folder = self.campaign.folder / "trials" / trial
        try:
            made = trial_manifest(self.campaign, trial)
        except (OSError, ValueError, StoreError) as error:
            self._problem(f"{trial}: {error}")
            return
        if existing is not None and existing.files == made.files:
            self.done.there += not self.options.check or self._send(made, folder, existing)
            return
        foreign = existing is not None and existing.take not in {made.take, *self._takes(trial, "")}
        if foreign and not self.options.replace:
            self._problem(
                f"{trial}: an attempt pushed from another store is there; push to another "
                "location, or replace it with --replace"
            )
        elif self._send(made, folder, existing):
            if existing is None:
                self.done.pushed += 1
            else:
                self.done.replaced += 1

    @staticmethod
    def _is_withdrawn_elsewhere(trial: Path, marked: Set[str]) -> bool:
        """Return whether a trial was pulled, and its take is marked by another store."""
        return bool(marked) and was_pulled(trial) and take_of(trial) in marked

    def _mark_withdrawn(self, ours: Set[str], marked: Set[str]) -> None:
        """Mark each take that is to be retaken: other stores withdraw marked takes only.

        A take that is wanted after all loses its mark.
        """
        current = {take_of(self.campaign.folder / "trials" / trial) for trial in ours}
        for take in sorted(current & marked):
            self.remote.remove(manifest_key("withdrawn", self.campaign.name, take))
        for take in sorted(self._takes(None, AGAIN) - current - marked):
            mark = Manifest("withdrawn", self.campaign.name, take, {}, take)
            self.remote.put(mark.key, mark.dump())

    def _push_quarantine(self) -> None:
        existing = self._manifests("quarantine")
        for item in self.campaign.quarantined():
            name = item["folder"]
            try:
                made = quarantine_manifest(self.campaign, name)
            except (OSError, StoreError) as error:
                self._problem(f"quarantine/{name}: {error}")
                continue
            if name in existing and existing[name].files == made.files and not self.options.check:
                continue
            if self._send(made, self.campaign.folder / "quarantine" / name, existing.get(name)):
                self.done.set_aside += 1

    def _send(self, made: Manifest, folder: Path, existing: Manifest | None) -> bool:
        """Write the objects, then the manifest; False where a file is not what it should be."""
        for name, known in made.files.items():
            problem = self._send_object(made.object_key(name), folder / name, known)
            if problem is not None:
                self._problem(f"{folder / name}: {problem}")
                return False
        if made != existing:
            self.remote.put(made.key, made.dump())
        return True

    def _send_object(self, key: str, path: Path, known: Checksum) -> str | None:
        """Write a file under its checksum unless it exists; return the file's problem, if any."""
        sha, size = known.sha256, known.bytes
        if self.sizes.get(sha) == size and (sha in self.trusted or self._arrived(key, known)):
            self.trusted.add(sha)
            return None
        if (problem := known.problem(path)) is not None:
            return problem
        for _ in range(_TRIES):
            try:
                self.remote.put(key, path)
            except RemoteError:
                if not path.exists():
                    return "disappeared in the meantime"
                raise
            if self.on_bytes is not None:
                self.on_bytes(size)
            if self._arrived(key, known):
                break
        else:
            raise RemoteError(
                f"{self.remote.where(key)}: reads back different from what was sent; see to "
                "the storage, then run the same command to resume"
            )
        self.sizes[sha] = size
        self.trusted.add(sha)
        self.done.files += 1
        self.done.bytes += size
        return None

    def _arrived(self, key: str, known: Checksum) -> bool:
        try:
            if self.options.read_back:
                return self.remote.matches(key, known, self.on_bytes)
            return self.remote.size(key) == known.bytes
        except RemoteMissing:
            return False

    def _manifests(self, kind: Kind) -> dict[str, Manifest]:
        """Read the visible manifests; one that cannot be read is sent again."""
        found = read_manifests(self.remote, self.campaign.name, kind)
        good = {name: item for name, item in found.items() if isinstance(item, Manifest)}
        if not self.options.check:
            self.trusted |= {known.sha256 for m in good.values() for known in m.files.values()}
        return good

    def _check_same_campaign(self) -> None:
        """
        Raises:
            _Conflict: the remote store has another campaign of this name.
        """
        theirs = read_manifests(self.remote, self.campaign.name, "about").get("")
        if not isinstance(theirs, Manifest):
            return
        try:
            info = json.loads(self.remote.read(theirs.object_key(INFO)))
            differ = [name for name in _SAME if self.campaign.info.get(name) != info.get(name)]
        except (RemoteMissing, ValueError, AttributeError):
            return  # it is sent again
        if differ:
            raise _Conflict(
                f"another campaign of this name is there: it differs in {', '.join(differ)}; "
                "push to another location"
            )

    def _takes(self, trial: str | None, cause: str) -> set[str]:
        """Return earlier takes of a trial that were quarantined for a cause that begins so.

        Args:
            trial: None for any.
        """
        return {
            take_of(self.campaign.folder / "quarantine" / item["folder"])
            for item in self.campaign.quarantined()
            if trial in {None, item["trial"]} and str(item["cause"]).startswith(cause)
        } - {""}

    def _problem(self, text: str) -> None:
        self.done.problems.append(f"{self.campaign.name}: {text}")
