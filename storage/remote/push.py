"""Pushing committed trials to shared or object storage: each is visible there whole, or not at all.

Files go first, each read back and held against its checksum; the trial's manifest goes last. Only
what is committed is read, so a campaign may run meanwhile. What is there already is not sent again.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from sliplab.storage.errors import StoreError
from sliplab.storage.fetching import objects_folder
from sliplab.storage.objects import OnBytes, Remote, RemoteError, RemoteMissing
from sliplab.storage.remote import manifest as manifests
from sliplab.storage.remote.manifest import Kind, Manifest, read_manifests
from sliplab.storage.streams import Json
from sliplab.storage.trials.checksums import byte_problem
from sliplab.storage.trials.store import AGAIN, INFO, Campaign, Store

OnTrial = Callable[[str], None]
_TRIES = 2
_SAME = ("name", "protocol", "experiment", "rig", "simulated")
"""What a campaign keeps for all its life; where these differ it is another one of that name."""


@dataclass
class PushResult:
    """What a push did.

    Attributes:
        trials: committed ones; pushed and replaced: of these, sent now, for the first time or
            because they were taken again; there: they had been sent before.
        withdrawn: no longer visible, because a person wants them again; set_aside: sent of
            quarantine; files and bytes: sent.
        problems: what was not sent, and why.
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
        """Count what another round did; `trials` and `there` are those of the later one."""
        for name in ("pushed", "replaced", "withdrawn", "set_aside", "files", "bytes"):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        self.trials, self.there, self.problems = other.trials, other.there, other.problems


@dataclass(frozen=True)
class PushOptions:
    """How a push is to be done.

    Attributes:
        quarantine: what was set aside, too.
        replace: also a trial of which another take is there that this store knows nothing of.
        read_back: read every object that was sent; without it, only its size is looked at.
        check: read back what was there before, too, and send anew what is damaged.
    """

    quarantine: bool = False
    replace: bool = False
    read_back: bool = True
    check: bool = False


def push(
    store: Store,
    remote: Remote,
    campaigns: Sequence[Campaign] | None = None,
    wishes: PushOptions | None = None,
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
        _Push(remote, campaign, wishes or PushOptions(), done, on_bytes).run(on_trial)
    return done


class _Push:
    """One campaign on its way."""

    def __init__(
        self,
        remote: Remote,
        campaign: Campaign,
        wishes: PushOptions,
        done: PushResult,
        on_bytes: OnBytes | None,
    ) -> None:
        self._remote, self._campaign, self._options = remote, campaign, wishes
        self._done, self._on_bytes = done, on_bytes
        self._there: dict[str, int] = {}
        self._trusted: set[str] = set()
        """Objects that a manifest names: they were read back before it was put."""

    def run(self, on_trial: OnTrial | None) -> None:
        name = self._campaign.name
        try:
            about = manifests.of_campaign(self._campaign)
            self._same_campaign()
        except (OSError, ValueError, StoreError) as error:
            if isinstance(error, RemoteError) and not isinstance(error, _Conflict):
                raise
            self._problem(f"{name}: {error}")
            return
        self._there = self._remote.sizes(objects_folder(name))
        theirs = self._manifests("trials")
        self._send(about, self._campaign.folder, self._manifests("about").get(""))
        ours = set()
        for recording in self._campaign.recordings():
            trial = recording.folder.name
            ours.add(trial)
            self._done.trials += 1
            self._one(trial, theirs.get(trial))
            if on_trial is not None:
                on_trial(trial)
        for trial, pushed in theirs.items():
            if trial not in ours and pushed.take in self._takes(trial, AGAIN):
                self._remote.remove(pushed.key)
                self._done.withdrawn += 1
        if self._options.quarantine:
            self._push_quarantine()

    def _one(self, trial: str, existing: Manifest | None) -> None:
        folder = self._campaign.folder / "trials" / trial
        try:
            made = manifests.of_trial(self._campaign, trial)
        except (OSError, ValueError, StoreError) as error:
            self._problem(f"{self._campaign.name}: {trial}: {error}")
            return
        if existing is not None and existing.files == made.files:
            self._done.there += not self._options.check or self._send(made, folder, existing)
            return
        foreign = existing is not None and existing.take not in {made.take, *self._takes(trial, "")}
        if foreign and not self._options.replace:
            self._problem(
                f"{self._campaign.name}: {trial}: another take of it is there that is not of "
                "this store; push to another place, or replace it with --replace"
            )
            return
        if self._send(made, folder, existing):
            if existing is None:
                self._done.pushed += 1
            else:
                self._done.replaced += 1

    def _push_quarantine(self) -> None:
        existing = self._manifests("quarantine")
        for known in self._campaign.quarantined():
            name = known["folder"]
            try:
                made = manifests.of_quarantined(self._campaign, name)
            except (OSError, StoreError) as error:
                self._problem(f"{self._campaign.name}: quarantine/{name}: {error}")
                continue
            if name in existing and existing[name].files == made.files and not self._options.check:
                continue
            if self._send(made, self._campaign.folder / "quarantine" / name, existing.get(name)):
                self._done.set_aside += 1

    def _send(self, made: Manifest, folder: Path, existing: Manifest | None) -> bool:
        """Objects, then the manifest. False where the files are not what they should be."""
        for name, said in made.files.items():
            problem = self._object(made.object_key(name), folder / name, said)
            if problem is not None:
                self._problem(f"{self._campaign.name}: {folder / name}: {problem}")
                return False
        if made != existing:
            self._remote.put_bytes(made.key, made.dump())
        return True

    def _object(self, key: str, path: Path, said: Json) -> str | None:
        """Have a file's bytes under its checksum; what is wrong with the file, if it is."""
        sha, size = said["sha256"], said["bytes"]
        if self._there.get(sha) == size and (sha in self._trusted or self._right(key, said)):
            self._trusted.add(sha)
            return None
        if (problem := byte_problem(path, said)) is not None:
            return problem
        for _ in range(_TRIES):
            try:
                self._remote.put_file(key, path)
            except RemoteError:
                if not path.exists():
                    return "went away meanwhile"
                raise
            self._count(size)
            if self._right(key, said):
                break
        else:
            raise RemoteError(
                f"{self._remote.where(key)}: came back with other bytes than were sent; see to "
                "the storage, then run the same command to go on"
            )
        self._there[sha] = size
        self._trusted.add(sha)
        self._done.files += 1
        self._done.bytes += size
        return None

    def _right(self, key: str, said: Json) -> bool:
        try:
            if self._options.read_back:
                return self._remote.matches(key, said, self._on_bytes)
            return bool(self._remote.size(key) == said["bytes"])
        except RemoteMissing:
            return False

    def _count(self, size: int) -> None:
        if self._on_bytes is not None:
            self._on_bytes(size)

    def _manifests(self, kind: Kind) -> dict[str, Manifest]:
        """Read the visible manifests; what cannot be read is sent anew."""
        found = {}
        for name, known in read_manifests(self._remote, self._campaign.name, kind).items():
            if isinstance(known, Manifest):
                found[name] = known
                if not self._options.check:
                    self._trusted |= {str(said["sha256"]) for said in known.files.values()}
        return found

    def _same_campaign(self) -> None:
        """
        Raises:
            StoreError: the place has another campaign of this name.
        """
        known = read_manifests(self._remote, self._campaign.name, "about").get("")
        if not isinstance(known, Manifest):
            return
        try:
            theirs = json.loads(self._remote.read(known.object_key(INFO)))
            ours = self._campaign.info
            differ = [name for name in _SAME if ours.get(name) != theirs.get(name)]
        except (RemoteMissing, ValueError, AttributeError):
            return  # it is sent anew
        if differ:
            raise _Conflict(
                f"another campaign of this name is there: it differs in {', '.join(differ)}; "
                "push to another place"
            )

    def _takes(self, trial: str, cause: str) -> set[str]:
        """Earlier takes of a trial that this store set aside for a cause that begins like this."""
        return {
            manifests.take_of(self._campaign.folder / "quarantine" / known["folder"])
            for known in self._campaign.quarantined()
            if known["trial"] == trial and str(known["cause"]).startswith(cause)
        } - {""}

    def _problem(self, text: str) -> None:
        self._done.problems.append(text)


class _Conflict(RemoteError):
    """Two stores have campaigns of one name."""
