"""Verification of a pushed store: everything is read and checked, nothing is changed."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator

from sliplab.storage.files import safe_name
from sliplab.storage.remote.manifest import (
    Kind,
    Manifest,
    check_against_sums,
    listing_problem,
    objects_folder,
    read_manifests,
)
from sliplab.storage.remote.objects import OnBytes, Remote, RemoteError, RemoteMissing
from sliplab.storage.trials.checksums import CHECKSUMS
from sliplab.storage.trials.store import StoreError
from sliplab.storage.trials.verify import StoreProblem

KINDS: tuple[Kind, ...] = ("about", "trials", "quarantine", "withdrawn")


def verify_remote(
    remote: Remote,
    on_trial: Callable[[str], None] | None = None,
    on_bytes: OnBytes | None = None,
) -> tuple[int, list[StoreProblem]]:
    """Hold every visible file against its checksum.

    Returns:
        The number of visible trials, and the problems; an empty list means all is well.

    Raises:
        RemoteError: nothing was pushed there, no campaign or trial is listed, or the storage cannot
            be reached.
    """
    remote.check()
    trials, problems, unlisted = 0, [], ""
    for name in remote.campaigns():
        try:
            safe_name(name)
        except StoreError as error:
            problems.append(StoreProblem(f"{remote.url}/campaigns", str(error)))
            continue
        sizes = remote.sizes(objects_folder(name))
        known: dict[str, bool] = {}
        listed = {kind: read_manifests(remote, name, kind) for kind in KINDS}
        lost = listing_problem(remote, name, listed["about"].get(""), listed["trials"])
        if lost is not None:
            unlisted = lost
            problems.append(StoreProblem(f"{remote.url}/campaigns/{name}", lost, campaign=name))
        for kind in KINDS:
            for item, found in listed[kind].items():
                trial = item if kind == "trials" else ""
                trials += bool(trial)
                if isinstance(found, RemoteError):
                    problems.append(
                        StoreProblem(remote.url, str(found), campaign=name, trial=trial)
                    )
                else:
                    problems += [
                        StoreProblem(remote.where(key), what, campaign=name, trial=trial)
                        for key, what in _problems(remote, found, sizes, known, on_bytes)
                    ]
                if trial and on_trial is not None:
                    on_trial(trial)
    if unlisted and not trials:
        raise RemoteMissing(unlisted)
    return trials, problems


def _problems(
    remote: Remote,
    found: Manifest,
    sizes: dict[str, int],
    matching: dict[str, bool],
    on_bytes: OnBytes | None,
) -> Iterator[tuple[str, str]]:
    """Yield key and problem of every bad file of a manifest.

    Args:
        matching: by SHA-256, whether an object matches it; those that are read are added.
    """
    owner = f"{found.kind}/{found.name}".rstrip("/")
    fine = True
    for name, known in sorted(found.files.items()):
        sha, key, what = known.sha256, found.object_key(name), ""
        if sha not in sizes:
            what = "is missing"
        elif sizes[sha] != known.bytes:
            what = f"has {sizes[sha]} bytes, not {known.bytes}"
        else:
            if sha not in matching:
                matching[sha] = remote.matches(key, known, on_bytes)
            if not matching[sha]:
                what = "does not match its checksum"
        if what:
            fine = False
            yield key, f"{owner}: {name} {what}"
    if fine and found.kind == "trials":
        try:
            sums = json.loads(remote.read(found.object_key(CHECKSUMS)))
            check_against_sums(found, sums, found.key)
        except (ValueError, RemoteError) as error:
            yield found.key, str(error)
