"""Bringing the files of one manifest into a folder, which appears once all of them are right."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

from sliplab.storage.files import make_folder, sync_folder, write_json
from sliplab.storage.manifest import Manifest, check_against_sums
from sliplab.storage.remote import Remote, RemoteError
from sliplab.storage.streams import Json
from sliplab.storage.whole import ELSEWHERE, byte_problem, read_sums
from sliplab.storage.writer import DATA, FRAMES

BIG = frozenset({DATA, FRAMES})
"""Files of a trial that a mirror fetches when they are first read."""


def bring(
    remote: Remote,
    there: Manifest,
    aside: Path,
    target: Path,
    *,
    small: bool = False,
    on_file: Callable[[int], None] | None = None,
) -> None:
    """Make the folder `target` of a manifest: all files aside, each checked, then one rename.

    What an interrupted one left in `aside` is used. If somebody else made `target` meanwhile,
    theirs stays.

    Raises:
        RemoteError: a file is not what its manifest says, or cannot be fetched.
    """
    make_folder(aside)
    marker = aside / ELSEWHERE
    write_json(marker, {"take": there.take})
    for name, said in sorted(there.files.items()):
        if small and name in BIG:
            continue
        if not holds(aside / name, said):
            size = get(remote, there, name, aside / name)
            if on_file is not None:
                on_file(size)
    if there.kind == "trials":
        try:
            check_against_sums(there, read_sums(aside), remote.where(there.key))
        except ValueError as error:
            raise RemoteError(f"{remote.where(there.key)}: {error}") from None
    if not small:
        marker.unlink()
    sync_folder(aside)
    try:
        os.rename(aside, target)
    except OSError:
        if not target.is_dir():
            raise
        shutil.rmtree(aside)  # another process was first
        return
    sync_folder(target.parent)


def get(remote: Remote, there: Manifest, name: str, path: Path) -> int:
    """Fetch one file of a manifest; its bytes."""
    said = there.files[name]
    try:
        remote.get_file(there.object_key(name), path, said)
    except RemoteError as error:
        raise RemoteError(f"{remote.where(there.key)}: {name}: {error}") from None
    return int(said["bytes"])


def holds(path: Path, said: Json) -> bool:
    """Whether a file is there as a manifest says."""
    return byte_problem(path, said) is None
