"""Bringing pushed campaigns back: files are checked on their way, trials appear by one rename.

What comes from elsewhere writes nothing but files of known names inside the store's own folders.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from sliplab.storage.errors import StoreError, translated_disk_errors
from sliplab.storage.fetching import ORIGIN, origin_of
from sliplab.storage.files import make_folder, safe_name, sync_folder, write_bytes, write_json
from sliplab.storage.objects import OnBytes, Remote, RemoteError
from sliplab.storage.remote.download import BIG, download_folder, get, holds
from sliplab.storage.remote.manifest import Manifest, read_manifests, take_of
from sliplab.storage.trials.checksums import ELSEWHERE, partial, to_fetch
from sliplab.storage.trials.lock import STORE_LOCK, exclusive
from sliplab.storage.trials.store import Campaign, Store
from sliplab.storage.trials.writer import CHECKSUMS

_FOLDERS = ("trials", "incoming", "quarantine", "bench")


@dataclass
class PullResult:
    """Result of a pull.

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
    trials that were taken again, or withdrawn, go to quarantine. In any other store nothing that
    is there is changed.

    Args:
        campaigns: only these.
        quarantine: what was set aside and pushed, too.
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


class _Pull:
    """One campaign on its way."""

    def __init__(
        self,
        remote: Remote,
        campaign: Campaign,
        follows: bool,
        small: bool,
        done: PullResult,
        on_bytes: OnBytes | None,
    ) -> None:
        self._remote, self._campaign, self._done = remote, campaign, done
        self._follows, self._small, self._on_bytes = follows, small, on_bytes

    def run(self, quarantine: bool, on_trial: Callable[[str], None] | None) -> None:
        name = self._campaign.name
        about = read_manifests(self._remote, name, "about").get("")
        if about is None:  # its first push is still on its way
            return
        if isinstance(about, RemoteError):
            self._done.problems.append(str(about))
            return
        try:
            self._describe(about)
        except (_Differs, RemoteError) as error:
            self._done.problems.append(str(error))
            return
        pushed = read_manifests(self._remote, name, "trials")
        for trial, known in pushed.items():
            self._done.trials += 1
            try:
                if isinstance(known, RemoteError):
                    raise known
                self._one(known)
            except (_Differs, RemoteError) as error:
                self._done.problems.append(str(error))
            if on_trial is not None:
                on_trial(trial)
        if self._follows:
            for trial in sorted(self._campaign.committed() - pushed.keys()):
                path = self._campaign.folder / "trials" / trial
                self._campaign.quarantine(path, f"withdrawn: is no longer at {self._remote.url}")
                self._done.withdrawn += 1
        if quarantine:
            self._pull_quarantine()

    def _describe(self, about: Manifest) -> None:
        """The campaign's own files: all of them, then their checksums."""
        folder = self._campaign.folder
        for name in _FOLDERS:
            make_folder(self._campaign._inside(folder / name))
        lacks = [name for name, said in about.files.items() if not holds(folder / name, said)]
        if not lacks:
            return
        if not self._follows:
            for name in lacks:
                if (folder / name).exists():
                    raise _Differs(
                        f"{folder / name}: differs from that at {self._remote.url}; pull into "
                        "another store"
                    )
        files = {name: self._small_object(about, name) for name in lacks}
        if CHECKSUMS in files:
            (folder / CHECKSUMS).unlink(missing_ok=True)
            sync_folder(folder)
        for name in sorted(files, key=lambda name: name == CHECKSUMS):
            write_bytes(folder / name, files[name])
            self._fetched(len(files[name]))

    def _small_object(self, about: Manifest, name: str) -> bytes:
        key = about.object_key(name)
        data = self._remote.read(key)
        if hashlib.sha256(data).hexdigest() != about.files[name]["sha256"]:
            raise RemoteError(f"{self._remote.where(key)}: {name} does not match its checksum")
        return data

    def _one(self, manifest: Manifest) -> None:
        target = self._campaign._inside(self._campaign.folder / "trials" / manifest.name)
        replaced = False
        if target.exists():
            cause = partial(target) if target.is_dir() else "is no folder"
            if cause is None and take_of(target) == manifest.take:
                self._complete(target, manifest)
                self._done.there += 1
                return
            if cause is None and not self._follows:
                raise _Differs(
                    f"{target}: is another take than that at {self._remote.url}; pull into "
                    "another store"
                )
            reason = f"damaged: {cause}" if cause else f"replaced: another is at {self._remote.url}"
            self._campaign.quarantine(target, reason)
            replaced = cause is None
        staging = self._campaign._inside(self._campaign.folder / "incoming" / manifest.name)
        if staging.exists() and not (staging / ELSEWHERE).exists():
            self._campaign.quarantine(staging, "interrupted")
        download_folder(
            self._remote, manifest, staging, target, small=self._small, on_file=self._counted
        )
        if replaced:
            self._done.replaced += 1
        else:
            self._done.pulled += 1

    def _complete(self, target: Path, manifest: Manifest) -> None:
        """Fetch the big files that a mirror left out."""
        if self._small or not (target / ELSEWHERE).exists():
            return
        for name in sorted(BIG & manifest.files.keys()):
            if to_fetch(target / name):
                self._counted(get(self._remote, manifest, name, target / name))
        (target / ELSEWHERE).unlink()
        sync_folder(target)

    def _pull_quarantine(self) -> None:
        for name, known in read_manifests(self._remote, self._campaign.name, "quarantine").items():
            target = self._campaign._inside(self._campaign.folder / "quarantine" / name)
            if target.exists():
                continue
            try:
                if isinstance(known, RemoteError):
                    raise known
                staging = self._campaign.folder / "incoming" / f"{name}.aside"
                download_folder(self._remote, known, staging, target, on_file=self._counted)
                self._done.set_aside += 1
            except RemoteError as error:
                self._done.problems.append(str(error))

    def _counted(self, size: int) -> None:
        self._fetched(size)
        if self._on_bytes is not None:
            self._on_bytes(size)

    def _fetched(self, size: int) -> None:
        self._done.files += 1
        self._done.bytes += size


class _Differs(StoreError):
    """This store has something else under that name."""
