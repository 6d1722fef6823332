"""A pushed store opened by its URL: a store in a cache folder whose big files come when read.

Records, checksums and protocols of all visible trials are downloaded at once, events and videos of
a trial when something reads them first, each held against its checksum. So whatever works on a
store works on a URL, and a machine that labels a tenth of the trials fetches that tenth. Analysis
writes into the cache folder as into any store. It may be deleted at any time.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from pathlib import Path

from sliplab.protocols.hashing import hash_text
from sliplab.storage.errors import translated_disk_errors
from sliplab.storage.fetching import ORIGIN, origin_of, remote_at
from sliplab.storage.files import make_folder, write_json
from sliplab.storage.objects import Remote, RemoteError, RemoteMissing
from sliplab.storage.remote.download import download_folder
from sliplab.storage.remote.manifest import Manifest, read_manifests
from sliplab.storage.remote.pull import PullResult, pull
from sliplab.storage.trials.checksums import partial
from sliplab.storage.trials.store import FORMAT, STORE, Store
from sliplab.storage.urls import check_url, is_url

CACHE = "SLIPLAB_CACHE"
"""Names the folder that mirrors stand in."""


def mirror_folder(url: str) -> Path:
    """Where the mirror of `url` stands on this machine."""
    url = check_url(url)
    configured = os.environ.get(CACHE)
    cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    base = Path(configured) if configured else Path(cache) / "sliplab"
    name = re.sub(r"[^A-Za-z0-9]+", "-", url.rpartition("/")[2]).strip("-") or "store"
    return base.absolute() / f"{name[:40]}-{hash_text(url)[:12]}"


def open_mirror(
    url: str, on_trial: Callable[[str], None] | None = None
) -> tuple[Store, PullResult]:
    """Update and return the mirror of `url`, without the big files.

    Raises:
        RemoteError: nothing was pushed there, or the storage cannot be reached.
        StoreError: the cache folder cannot be used.
        Locked: another program brings it up to date just now.
    """
    folder = mirror_folder(url)
    with translated_disk_errors(folder):
        make_folder(folder)
    done = pull(Remote(url), folder, small=True, on_trial=on_trial)
    return Store.open(folder), done


def place_of(store: Store) -> str:
    """By what another process, perhaps on another machine, finds the same store: path or URL."""
    url = origin_of(store.folder)
    if url is not None and store.folder.absolute() == mirror_folder(url):
        return url
    return str(store.folder.resolve())


def reach(place: str, campaign: str, trial: str) -> Store:
    """The store at a path or URL with one of its trials, for a process that works on just that.

    Raises:
        StoreError: there is no such store here, or no such trial in it.
    """
    if not is_url(place):
        return Store.open(Path(place))
    store = _bare_mirror(place)
    target = store.campaign(campaign).folder / "trials" / trial
    if partial(target) is not None:
        _bring_one(remote_at(place), campaign, trial, target)
    return store


def _bare_mirror(url: str) -> Store:
    """The mirror's folder with whatever it holds so far; several processes may do this at once."""
    folder = mirror_folder(url)
    if not (folder / STORE).is_file() or origin_of(folder) is None:
        with translated_disk_errors(folder):
            make_folder(folder)
            write_json(folder / ORIGIN, {"url": check_url(url)})
            write_json(folder / STORE, {"format": FORMAT})
    return Store.open(folder)


def _bring_one(remote: Remote, campaign: str, trial: str, target: Path) -> None:
    found: Manifest | RemoteError | None = read_manifests(
        remote, campaign, "trials", only=trial
    ).get(trial)
    if found is None:
        raise RemoteMissing(f"{remote.url}: has no trial {trial} of campaign {campaign}")
    if isinstance(found, RemoteError):
        raise found
    folder = target.parent.parent
    with translated_disk_errors(target):
        for name in ("trials", "incoming"):
            make_folder(folder / name)
        download_folder(
            remote, found, folder / "incoming" / f"{trial}.{os.getpid()}", target, small=True
        )
