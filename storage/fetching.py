"""A file of a mirrored trial that stays at the URL until something reads it."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

from sliplab.storage.errors import StoreError, translated_disk_errors
from sliplab.storage.files import read_json, safe_name
from sliplab.storage.objects import Remote, RemoteError
from sliplab.storage.streams import Json

ORIGIN = "origin.json"
"""In a store that was pulled: from where."""


def origin_of(folder: Path) -> str | None:
    """The URL that the store in `folder` was pulled from; None for one that was collected."""
    try:
        return str(read_json(folder / ORIGIN)["url"])
    except (OSError, ValueError, KeyError):
        return None


def objects_folder(campaign: str) -> str:
    """Where a campaign's files stand below the URL."""
    return f"campaigns/{safe_name(campaign)}/objects"


def fetch(path: Path, said: Json) -> None:
    """Bring a file of a trial that a mirror has left out until now.

    Raises:
        StoreError: it is not at the URL any more, damaged there, or the storage cannot be reached.
    """
    campaign, store = path.parents[2].name, path.parents[4]
    url = origin_of(store)
    if url is None:
        raise StoreError(f"{path}: is missing, and {store / ORIGIN} does not say where it is")
    try:
        with translated_disk_errors(store):
            remote_at(url).get_file(f"{objects_folder(campaign)}/{said['sha256']}", path, said)
    except RemoteError as error:
        raise RemoteError(f"{path}: {error}") from None


@lru_cache(maxsize=4)
def remote_at(url: str) -> Remote:
    """The storage at `url`; kept open, because many files of one trial come from there."""
    return Remote(url)
