"""Names of folders in a store, and paths that lead nowhere out of it."""

from __future__ import annotations

import re
from pathlib import Path

from sliplab.storage.errors import StoreError

_SAFE = re.compile(r"[A-Za-z0-9][A-Za-z0-9=,._+-]{0,250}")


def safe_name(name: str) -> str:
    """`name` if it is a plain file name.

    Raises:
        StoreError: it could lead out of its folder.
    """
    if not _SAFE.fullmatch(name) or ".." in name:
        raise StoreError(f"'{name}' cannot be the name of a folder in a store")
    return name


def inside(path: Path, store: Path) -> Path:
    """`path`, if no link on the way to it leads out of the store's folder.

    Raises:
        StoreError: one does.
    """
    if not path.resolve().is_relative_to(store.resolve()):
        raise StoreError(
            f"{path}: a link leads out of the store; put a folder of its own in its place"
        )
    return path
