"""Mirror of a pushed store: a store in a cache folder whose large files are downloaded on demand.

Records, checksums and protocols of all visible trials are downloaded at once, events and videos of
a trial on first access, each verified by its checksum. So every command for a store works on a URL,
and a machine that labels a tenth of the trials downloads only that tenth. Analysis writes into the
cache folder as into any store. The folder may be deleted at any time.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

from sliplab.protocols.hashing import hash_text
from sliplab.storage.errors import StoreError, translated_disk_errors
from sliplab.storage.files import make_folder, temporary_path, write_json
from sliplab.storage.remote.manifest import objects_folder, read_manifests
from sliplab.storage.remote.objects import Remote, RemoteError, RemoteMissing, check_url, is_url
from sliplab.storage.remote.pull import ORIGIN, PullResult, download, origin_of, pull
from sliplab.storage.trials.checksums import Checksum, incomplete
from sliplab.storage.trials.store import FORMAT, STORE, TrialStore

CACHE = "SLIPLAB_CACHE"
"""Environment variable of the folder with all mirrors."""


def mirror_folder(url: str) -> Path:
    """Return the folder of the mirror of `url` on this machine."""
    url = check_url(url)
    configured = os.environ.get(CACHE)
    cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    base = Path(configured) if configured else Path(cache) / "sliplab"
    name = re.sub(r"[^A-Za-z0-9]+", "-", url.rpartition("/")[2]).strip("-") or "store"
    return base.absolute() / f"{name[:40]}-{hash_text(url)[:12]}"


def open_store(folder: Path) -> TrialStore:
    """Open the store in `folder`; in a mirror, files are fetched when they are read.

    Raises:
        StoreError: as `TrialStore.open`.
    """
    return TrialStore.open(folder, None if origin_of(folder) is None else fetch)


def open_mirror(
    url: str, on_trial: Callable[[str], None] | None = None
) -> tuple[TrialStore, PullResult]:
    """Update and return the mirror of `url`, without the big files.

    Raises:
        RemoteError: nothing was pushed there, or the storage cannot be reached.
        StoreError: the cache folder cannot be used.
        Locked: another program updates it just now.
    """
    folder = mirror_folder(url)
    with translated_disk_errors(folder):
        make_folder(folder)
    done = pull(Remote(url), folder, small=True, on_trial=on_trial)
    return open_store(folder), done


def place_of(store: TrialStore) -> str:
    """Return the path or URL by which another process, perhaps elsewhere, finds the store."""
    url = origin_of(store.folder)
    if url is not None and store.folder.absolute() == mirror_folder(url):
        return url
    return str(store.folder.resolve())


def open_for_trial(place: str, campaign: str, trial: str) -> TrialStore:
    """Open the store at a path or URL for a process that works on one of its trials.

    Raises:
        StoreError: there is no such store here, or no such trial in it.
    """
    if not is_url(place):
        return open_store(Path(place))
    folder = mirror_folder(place)
    if not (folder / STORE).is_file() or origin_of(folder) is None:
        with translated_disk_errors(folder):  # several processes may do this at once
            make_folder(folder)
            write_json(folder / ORIGIN, {"url": check_url(place)})
            write_json(folder / STORE, {"format": FORMAT})
    store = open_store(folder)
    target = store.campaign(campaign).folder / "trials" / trial
    if incomplete(target) is not None:
        _download_trial(remote_at(place), campaign, trial, target)
    return store


def _download_trial(remote: Remote, campaign: str, trial: str, target: Path) -> None:
    found = read_manifests(remote, campaign, "trials", only=trial).get(trial)
    if found is None:
        raise RemoteMissing(f"{remote.url}: has no trial {trial} of campaign {campaign}")
    if isinstance(found, RemoteError):
        raise found
    folder = target.parent.parent
    with translated_disk_errors(target):
        for name in ("trials", "incoming"):
            make_folder(folder / name)
        staging = temporary_path(folder / "incoming" / trial)
        download(remote, found, staging, target, small=True)


def fetch(path: Path, known: Checksum) -> None:
    """Fetch a file of a trial that the mirror has left out until now.

    Raises:
        StoreError: it is not at the URL any more, damaged there, or the storage cannot be reached.
    """
    campaign, store = path.parents[2].name, path.parents[4]
    url = origin_of(store)
    if url is None:
        raise StoreError(f"{path}: is missing, and {store / ORIGIN} does not say where it is")
    try:
        with translated_disk_errors(store):
            remote_at(url).get(f"{objects_folder(campaign)}/{known.sha256}", path, known)
    except RemoteError as error:
        raise RemoteError(f"{path}: {error}") from None


@lru_cache(maxsize=4)
def remote_at(url: str) -> Remote:
    """Return the storage at `url`, cached: many files of one trial come from there."""
    return Remote(url)
