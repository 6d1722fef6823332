"""Download of pushed campaigns: files are verified on arrival, trials appear by one rename.

Remote content can only write files of known names inside the store's own folders.
"""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from sliplab.storage.errors import StoreError, translated_disk_errors
from sliplab.storage.files import (
    make_folder,
    read_json,
    safe_name,
    sync_folder,
    write_bytes,
    write_json,
)
from sliplab.storage.interrupts import uninterrupted
from sliplab.storage.remote.manifest import (
    Manifest,
    check_against_sums,
    read_manifests,
    take_of,
)
from sliplab.storage.remote.objects import OnBytes, Remote, RemoteError
from sliplab.storage.trials.checksums import (
    CHECKSUMS,
    DATA,
    ELSEWHERE,
    FRAMES,
    incomplete,
    is_stream_file,
    read_sums,
    to_fetch,
)
from sliplab.storage.trials.lock import STORE_LOCK, exclusive
from sliplab.storage.trials.store import Campaign, Store

ORIGIN = "origin.json"
"""In a store that was pulled: its URL."""
BIG = frozenset({DATA, FRAMES})
"""Files of a trial that a mirror fetches when they are first read."""
_FOLDERS = ("trials", "incoming", "quarantine", "bench")


@dataclass
class PullResult:
    """Counts of a pull.

    Attributes:
        trials: visible at the URL; pulled and replaced: of these, downloaded now; there: they had
            been before; withdrawn: no longer visible at the URL, and quarantined here.
        set_aside: of quarantine; files and bytes: fetched.
        problems: what was not downloaded, and why.
    """

    trials: int = 0
    pulled: int = 0
    replaced: int = 0
    there: int = 0
    withdrawn: int = 0
    set_aside: int = 0
    files: int = 0
    bytes: int = 0
    problems: list[str] = field(default_factory=list)


def origin_of(folder: Path) -> str | None:
    """Return the URL that the store in `folder` was pulled from; None for any other store."""
    try:
        return str(read_json(folder / ORIGIN)["url"])
    except (OSError, ValueError, KeyError):
        return None


def pull(
    remote: Remote,
    folder: Path,
    *,
    campaigns: Sequence[str] | None = None,
    quarantine: bool = False,
    small: bool = False,
    on_trial: Callable[[str], None] | None = None,
    on_bytes: OnBytes | None = None,
) -> PullResult:
    """Download what the store in `folder` lacks; it is made if there is none.

    A store that was pulled from here before follows: its descriptions are updated, and
    trials that were retaken, or withdrawn, go to quarantine. In any other store nothing that
    exists is changed.

    Args:
        campaigns: only these.
        quarantine: pushed quarantine, too.
        small: leave out events and videos until they are read, as a mirror does.
        on_trial: called with each trial's id once it is done with.

    Raises:
        RemoteError: nothing was pushed there, or the storage fails; what was downloaded stays.
        StoreError: the folder holds something else, or cannot be written.
        Locked: another program writes into the store.
    """
    remote.check()
    fresh = not folder.exists() or not any(folder.iterdir())
    store = Store.create(folder)
    done = PullResult()
    with (
        translated_disk_errors(folder),
        exclusive(folder / STORE_LOCK, f"the store {folder}", brief=small),
    ):
        if fresh:
            write_json(folder / ORIGIN, {"url": remote.url})
        follows = origin_of(folder) == remote.url
        for name in remote.folders("campaigns"):
            if campaigns is not None and name not in campaigns:
                continue
            try:
                campaign = store.campaign(safe_name(name))
            except StoreError as error:
                done.problems.append(f"{remote.url}: {error}")
                continue
            _Pull(remote, campaign, follows, small, done, on_bytes).run(quarantine, on_trial)
    return done


class _Differs(StoreError):
    """This store has something else under that name."""


@dataclass
class _Pull:
    """Pull of one campaign.

    Attributes:
        follows: the store was pulled from this remote before, and is changed as the remote is.
    """

    remote: Remote
    campaign: Campaign
    follows: bool
    small: bool
    done: PullResult
    on_bytes: OnBytes | None

    def run(self, quarantine: bool, on_trial: Callable[[str], None] | None) -> None:
        name = self.campaign.name
        about = read_manifests(self.remote, name, "about").get("")
        if about is None:  # its first push has not ended
            return
        if isinstance(about, RemoteError):
            self.done.problems.append(str(about))
            return
        try:
            self._describe(about)
        except (_Differs, RemoteError) as error:
            self.done.problems.append(str(error))
            return
        pushed = read_manifests(self.remote, name, "trials")
        for trial, known in pushed.items():
            self.done.trials += 1
            try:
                if isinstance(known, RemoteError):
                    raise known
                self._pull_trial(known)
            except (_Differs, RemoteError) as error:
                self.done.problems.append(str(error))
            if on_trial is not None:
                on_trial(trial)
        if self.follows:
            for trial in sorted(self.campaign.committed() - pushed.keys()):
                path = self.campaign.folder / "trials" / trial
                self.campaign.quarantine(path, f"withdrawn: is no longer at {self.remote.url}")
                self.done.withdrawn += 1
        if quarantine:
            self._pull_quarantine()

    def _describe(self, about: Manifest) -> None:
        """Download the campaign's own files: all of them, then their checksums."""
        folder = self.campaign.folder
        for name in _FOLDERS:
            make_folder(self.campaign.inside(folder / name))
        lacks = [name for name, known in about.files.items() if known.problem(folder / name)]
        if not lacks:
            return
        if not self.follows:
            for name in lacks:
                if (folder / name).exists():
                    raise _Differs(
                        f"{folder / name}: differs from that at {self.remote.url}; pull into "
                        "another store"
                    )
        self._write({name: self._read_object(about, name) for name in lacks})

    @uninterrupted
    def _write(self, files: dict[str, bytes]) -> None:
        """Write the campaign's own files."""
        folder = self.campaign.folder
        if CHECKSUMS in files:
            (folder / CHECKSUMS).unlink(missing_ok=True)
            sync_folder(folder)
        for name in sorted(files, key=lambda name: name == CHECKSUMS):
            write_bytes(folder / name, files[name])
            self._count(len(files[name]))

    def _read_object(self, about: Manifest, name: str) -> bytes:
        key = about.object_key(name)
        data = self.remote.read(key)
        if hashlib.sha256(data).hexdigest() != about.files[name].sha256:
            raise RemoteError(f"{self.remote.where(key)}: {name} does not match its checksum")
        return data

    def _pull_trial(self, manifest: Manifest) -> None:
        target = self.campaign.inside(self.campaign.folder / "trials" / manifest.name)
        replaced = False
        if target.exists():
            cause = incomplete(target) if target.is_dir() else "is no folder"
            if cause is None and take_of(target) == manifest.take:
                self._complete(target, manifest)
                self.done.there += 1
                return
            if cause is None and not self.follows:
                raise _Differs(
                    f"{target}: is another attempt than that at {self.remote.url}; pull into "
                    "another store"
                )
            reason = f"damaged: {cause}" if cause else f"replaced: another is at {self.remote.url}"
            self.campaign.quarantine(target, reason)
            replaced = cause is None
        staging = self.campaign.inside(self.campaign.folder / "incoming" / manifest.name)
        if staging.exists() and not (staging / ELSEWHERE).exists():
            self.campaign.quarantine(staging, "interrupted")
        download(self.remote, manifest, staging, target, small=self.small, on_file=self._count)
        if replaced:
            self.done.replaced += 1
        else:
            self.done.pulled += 1

    def _complete(self, target: Path, manifest: Manifest) -> None:
        """Fetch the big files that a mirror left out."""
        if self.small or not (target / ELSEWHERE).exists():
            return
        for name in sorted(filter(_big, manifest.files)):
            if to_fetch(target / name):
                self._count(_get(self.remote, manifest, name, target))
        (target / ELSEWHERE).unlink()
        sync_folder(target)

    def _pull_quarantine(self) -> None:
        for name, known in read_manifests(self.remote, self.campaign.name, "quarantine").items():
            target = self.campaign.inside(self.campaign.folder / "quarantine" / name)
            if target.exists():
                continue
            try:
                if isinstance(known, RemoteError):
                    raise known
                staging = self.campaign.folder / "incoming" / f"{name}.aside"
                download(self.remote, known, staging, target, on_file=self._count)
                self.done.set_aside += 1
            except RemoteError as error:
                self.done.problems.append(str(error))

    def _count(self, size: int) -> None:
        self.done.files += 1
        self.done.bytes += size
        if self.on_bytes is not None:
            self.on_bytes(size)


def _big(name: str) -> bool:
    """Return whether a mirror leaves out a file of this name until it is read."""
    return name in BIG or is_stream_file(name)


def download(
    remote: Remote,
    manifest: Manifest,
    staging: Path,
    target: Path,
    *,
    small: bool = False,
    on_file: Callable[[int], None] | None = None,
) -> None:
    """Download a manifest's folder: all files into `staging`, each checked, then one rename.

    Files that an interrupted download left in `staging` are used. If another process made
    `target` in the meantime, that one stays.

    Args:
        on_file: called with the bytes of each file that was fetched.

    Raises:
        RemoteError: a file does not match its manifest, or cannot be fetched.
    """
    make_folder(staging)
    marker = staging / ELSEWHERE
    write_json(marker, {"take": manifest.take})
    for name, known in sorted(manifest.files.items()):
        if small and _big(name):
            continue
        if known.problem(staging / name) is not None:
            size = _get(remote, manifest, name, staging)
            if on_file is not None:
                on_file(size)
    if manifest.kind == "trials":
        try:
            read_sums(staging)
            check_against_sums(manifest, read_json(staging / CHECKSUMS), remote.where(manifest.key))
        except ValueError as error:
            raise RemoteError(f"{remote.where(manifest.key)}: {error}") from None
    if not small:
        marker.unlink()
    sync_folder(staging)
    try:
        os.rename(staging, target)
    except OSError:
        if not target.is_dir():
            raise
        shutil.rmtree(staging)  # another process was first
        return
    sync_folder(target.parent)


def _get(remote: Remote, manifest: Manifest, name: str, folder: Path) -> int:
    """Fetch one file of a manifest; return its size in bytes."""
    try:
        remote.get(manifest.object_key(name), folder / name, manifest.files[name])
    except RemoteError as error:
        raise RemoteError(f"{remote.where(manifest.key)}: {name}: {error}") from None
    return manifest.files[name].bytes
