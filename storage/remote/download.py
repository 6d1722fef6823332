"""Download of one manifest's files into a folder that appears once all of them are right."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

from sliplab.storage.files import make_folder, sync_folder, write_json
from sliplab.storage.objects import Remote, RemoteError
from sliplab.storage.remote.manifest import Manifest, check_against_sums
from sliplab.storage.streams import Json
from sliplab.storage.trials.checksums import ELSEWHERE, byte_problem, read_sums
from sliplab.storage.trials.writer import DATA, FRAMES

BIG = frozenset({DATA, FRAMES})
"""Files of a trial that a mirror fetches when they are first read."""


def download_folder(
    remote: Remote,
    manifest: Manifest,
    staging: Path,
    target: Path,
    *,
    small: bool = False,
    on_file: Callable[[int], None] | None = None,
) -> None:
    """Download a manifest's folder: all files into `staging`, each checked, then one rename.

    Files that an interrupted download left in `staging` are used. If somebody else made
    `target` meanwhile, theirs stays.

    Raises:
        RemoteError: a file is not what its manifest says, or cannot be fetched.
    """
    make_folder(staging)
    marker = staging / ELSEWHERE
    write_json(marker, {"take": manifest.take})
    for name, described in sorted(manifest.files.items()):
        if small and name in BIG:
            continue
        if not holds(staging / name, described):
            size = get(remote, manifest, name, staging / name)
            if on_file is not None:
                on_file(size)
    if manifest.kind == "trials":
        try:
            check_against_sums(manifest, read_sums(staging), remote.where(manifest.key))
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


def get(remote: Remote, manifest: Manifest, name: str, path: Path) -> int:
    """Fetch one file of a manifest; return its size in bytes."""
    described = manifest.files[name]
    try:
        remote.get_file(manifest.object_key(name), path, described)
    except RemoteError as error:
        raise RemoteError(f"{remote.where(manifest.key)}: {name}: {error}") from None
    return int(described["bytes"])


def holds(path: Path, described: Json) -> bool:
    """Check that a file exists as its manifest describes it."""
    return byte_problem(path, described) is None
