"""Download of pushed campaigns: files are verified on arrival, trials appear by one rename.

Remote content can only write files of known names inside the store's own folders.
"""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence, Set
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from threading import Event

from sliplab.protocols.shown import plural
from sliplab.storage.errors import StoreError, translated_disk_errors
from sliplab.storage.files import (
    inside,
    make_folder,
    read_json,
    safe_name,
    sweep_temporary,
    sync_folder,
    write_bytes,
    write_json,
)
from sliplab.storage.interrupts import uninterrupted
from sliplab.storage.remote.manifest import (
    Manifest,
    check_against_sums,
    listing_problem,
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
from sliplab.storage.trials.store import INFO, REGISTRATIONS, Campaign, TrialStore

ORIGIN = "origin.json"
"""In a store that was pulled: its URL."""
PULLED = "pulled"
"""Folder of a store that was pulled: for each of its campaigns a folder that has, by trial, the
take that came from the URL. What is not in it is the store's own."""
LACKS_NOTES = "lacks_notes"
"""Key of `ORIGIN`: an older version pulled the store, and not all of that is noted yet."""
BIG = frozenset({DATA, FRAMES})
"""Files of a trial that a mirror fetches when they are first read."""
_FOLDERS = ("trials", "incoming", "quarantine", "bench")
_AT_ONCE = 4
"""Files of a trial that are fetched side by side."""
_ASIDE = ".aside"
"""End of the name of a quarantined folder while it is downloaded."""


@dataclass
class PullResult:
    """Counts of a pull.

    Attributes:
        trials: visible at the URL; pulled and replaced: of these, downloaded now; there: they had
            been before; withdrawn: pulled before, marked as withdrawn at the URL, and quarantined
            here.
        set_aside: of quarantine; files and bytes: fetched.
        problems: failed downloads, with reasons.
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


def _lacks_notes(folder: Path) -> bool:
    """Return whether notes of what an older version pulled are incomplete."""
    return bool(read_json(folder / ORIGIN).get(LACKS_NOTES))


def _note(store: Path, campaign: str, trial: str) -> Path:
    """Return the path of the note that a trial was pulled."""
    return inside(store / PULLED / campaign / f"{trial}.json", store)


def note_pulled(target: Path, take: str) -> None:
    """Note that the trial at `target` comes from the URL of its store, before it does."""
    path = _note(target.parents[3], target.parents[1].name, target.name)
    make_folder(path.parent)
    write_json(path, {"take": take})


def was_pulled(target: Path) -> bool:
    """Return whether the trial at `target` is as it was pulled from the URL of its store."""
    path = _note(target.parents[3], target.parents[1].name, target.name)
    try:
        return bool(read_json(path)["take"] == take_of(target))
    except (OSError, ValueError, KeyError):
        return False


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

    A store that was pulled from here before follows: descriptions of pulled campaigns are updated,
    and pulled trials that were retaken, or are marked as withdrawn, go to quarantine. Its own
    trials and any other store's are not changed, nor is a trial that is merely not listed.

    Args:
        campaigns: only these.
        quarantine: pushed quarantine, too.
        small: leave out events and videos until they are read, as a mirror does.
        on_trial: called with each trial's id once it is done with.

    Raises:
        RemoteError: nothing was pushed there, no campaign is listed, or the storage fails; what was
            downloaded stays.
        StoreError: the folder holds something else, or cannot be written.
        Locked: another program writes into the store.
    """
    remote.check()
    listed = remote.campaigns()
    store = TrialStore.create(folder)
    # or an earlier pull was killed before it stored its origin
    fresh = origin_of(folder) is None and not any((folder / "campaigns").glob("*"))
    done = PullResult()
    with (
        translated_disk_errors(folder),
        exclusive(folder / STORE_LOCK, f"the store {folder}", brief=small),
    ):
        if fresh:
            write_json(folder / ORIGIN, {"url": remote.url})
        follows = origin_of(folder) == remote.url
        notes = inside(folder / PULLED, folder)
        older = follows and not fresh and (not notes.is_dir() or _lacks_notes(folder))
        pulled = {path.name for path in notes.glob("*/")}
        if older:  # until a pull of all of it has ended, whatever ends this one
            write_json(folder / ORIGIN, {"url": remote.url, LACKS_NOTES: True})
        if follows:
            make_folder(notes)
        wanted = {*listed, *pulled} if campaigns is None else set(campaigns)
        for name in sorted(wanted - {*listed}):
            done.problems.append(
                f"{remote.url}: campaign '{name}' is not listed; nothing of it was changed"
            )
        for name in listed:
            if name not in wanted:
                continue
            try:
                campaign = store.campaign(safe_name(name))
            except StoreError as error:
                done.problems.append(f"{remote.url}: {error}")
                continue
            ours = campaign.begun and name not in pulled and not older
            one = _Pull(remote, campaign, follows and not ours, older, small, done, on_bytes)
            one.run(quarantine, on_trial)
        if older and campaigns is None:
            write_json(folder / ORIGIN, {"url": remote.url})
    return done


class _Differs(StoreError):
    """This store has something else under that name."""


@dataclass
class _Pull:
    """Pull of one campaign.

    Attributes:
        follows: the campaign was pulled from this remote, and is changed as the remote is.
        older: by a version that did not note which trials; those that agree count as pulled.
        marked: takes that are marked as withdrawn at the URL.
    """

    remote: Remote
    campaign: Campaign
    follows: bool
    older: bool
    small: bool
    done: PullResult
    on_bytes: OnBytes | None
    marked: Set[str] = frozenset()

    def run(self, quarantine: bool, on_trial: Callable[[str], None] | None) -> None:
        name = self.campaign.name
        about = read_manifests(self.remote, name, "about").get("")
        pushed = read_manifests(self.remote, name, "trials")
        if (lost := listing_problem(self.remote, name, about, pushed)) is not None:
            self.done.problems.append(lost)
        if about is None:  # its first push has not ended
            return
        if isinstance(about, RemoteError):
            self.done.problems.append(str(about))
            return
        if self.follows:  # first: a campaign without notes is the store's own
            make_folder(_note(self.campaign.folder.parents[1], name, "").parent)
        try:
            self._describe(about)
        except (_Differs, RemoteError) as error:
            self.done.problems.append(str(error))
            return
        if self.follows:
            found = read_manifests(self.remote, name, "withdrawn")
            self.marked = {take for take, mark in found.items() if isinstance(mark, Manifest)}
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
        self._delete_partial({*pushed}, quarantine)
        if self.follows:
            self._withdraw(self.campaign.committed() - pushed.keys())
        if quarantine:
            self._pull_quarantine()

    def _delete_partial(self, trials: Set[str], quarantine: bool) -> None:
        """Delete what an interrupted pull left and this one does not continue."""
        incoming = self.campaign.folder / "incoming"
        sweep_temporary(incoming)
        for path in sorted(incoming.iterdir()):
            wanted = path.name in trials or (quarantine and path.suffix == _ASIDE)
            if not wanted and not path.name.startswith(".") and (path / ELSEWHERE).is_file():
                shutil.rmtree(path)

    def _withdraw(self, unlisted: Set[str]) -> None:
        """Quarantine trials that were pulled and are marked as withdrawn; keep all others."""
        lost = []
        for trial in sorted(unlisted):
            path = self.campaign.folder / "trials" / trial
            if not self._from_there(path):
                continue
            if take_of(path) not in self.marked:
                lost.append(trial)
                continue
            self.campaign.quarantine(path, f"withdrawn: is no longer at {self.remote.url}")
            self.done.withdrawn += 1
        if lost:
            self.done.problems.append(
                f"{self.remote.url}: campaign '{self.campaign.name}': "
                f"{plural(len(lost), 'pulled trial')} "
                f"neither listed nor marked as withdrawn, left unchanged: "
                f"{', '.join(lost[:3])}{' ...' if len(lost) > 3 else ''}"
            )

    def _describe(self, about: Manifest) -> None:
        """Download the campaign's own files: all of them, then their checksums."""
        folder = self.campaign.folder
        for name in _FOLDERS:
            make_folder(self.campaign.inside(folder / name))
        lacks = [name for name, known in about.files.items() if known.problem(folder / name)]
        numbered = tuple(f"{below}/" for below in ("bench", REGISTRATIONS))
        for name in [name for name in lacks if name.startswith(numbered) and self.follows]:
            if (folder / name).exists():  # such a file is never changed: it is our own
                self.done.problems.append(
                    f"{folder / name}: differs from that at {self.remote.url}, and is left as it is"
                )
                lacks.remove(name)
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
        # a campaign that has no description yet has not begun
        for name in sorted(files, key=lambda name: (name == CHECKSUMS, name == INFO)):
            make_folder(self.campaign.inside(folder / name).parent)
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
                known = self.older or (target / ELSEWHERE).is_file()
                if self.follows and known and not was_pulled(target):
                    note_pulled(target, manifest.take)
                self._complete(target, manifest)
                self.done.there += 1
                return
            if cause is None and not (self.follows and self._from_there(target)):
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
        if self.follows:
            note_pulled(target, manifest.take)
        download(self.remote, manifest, staging, target, small=self.small, on_file=self._count)
        if replaced:
            self.done.replaced += 1
        else:
            self.done.pulled += 1

    def _complete(self, target: Path, manifest: Manifest) -> None:
        """Fetch the big files that a mirror left out."""
        if self.small or not (target / ELSEWHERE).exists():
            return
        names = [name for name in filter(_big, manifest.files) if to_fetch(target / name)]
        for size in _fetched(self.remote, manifest, names, target):
            self._count(size)
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
                staging = self.campaign.folder / "incoming" / f"{name}{_ASIDE}"
                download(self.remote, known, staging, target, on_file=self._count)
                self.done.set_aside += 1
            except RemoteError as error:
                self.done.problems.append(str(error))

    def _from_there(self, target: Path) -> bool:
        """Return whether a trial was pulled; that of a mirror shows it itself, of any version."""
        if was_pulled(target) or (target / ELSEWHERE).is_file():
            return True
        return self.older and take_of(target) in self.marked

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
    sweep_temporary(staging)
    marker = staging / ELSEWHERE
    write_json(marker, {"take": manifest.take})
    wanted = {name: known for name, known in manifest.files.items() if not (small and _big(name))}
    names = [name for name, known in wanted.items() if known.problem(staging / name) is not None]
    for size in _fetched(remote, manifest, names, staging):
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


def _fetched(
    remote: Remote, manifest: Manifest, names: Iterable[str], folder: Path
) -> Iterator[int]:
    """Fetch files of a manifest, a few at once; yield the bytes of each, in the names' order.

    An error or an interruption ends the others at their next block.
    """
    stop = Event()
    with ThreadPoolExecutor(_AT_ONCE, "fetch") as pool:
        try:
            parts = [
                pool.submit(_get, remote, manifest, name, folder, stop) for name in sorted(names)
            ]
            for part in parts:
                yield part.result()
        except BaseException:
            stop.set()
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _get(remote: Remote, manifest: Manifest, name: str, folder: Path, stop: Event) -> int:
    """Fetch one file of a manifest; return its size in bytes."""
    try:
        remote.get(manifest.object_key(name), folder / name, manifest.files[name], stop)
    except RemoteError as error:
        raise RemoteError(f"{remote.where(manifest.key)}: {name}: {error}") from None
    return manifest.files[name].bytes
