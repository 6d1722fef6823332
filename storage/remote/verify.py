"""Is everything that was pushed still what it was? Reads it all, and changes nothing."""

from __future__ import annotations

import json
from collections.abc import Callable

from sliplab.storage.fetching import objects_folder
from sliplab.storage.files import safe_name
from sliplab.storage.objects import OnBytes, Remote, RemoteError, RemoteMissing
from sliplab.storage.remote.manifest import Kind, Manifest, check_against_sums, read_manifests
from sliplab.storage.trials.store import StoreError
from sliplab.storage.trials.verify import Problem
from sliplab.storage.trials.writer import CHECKSUMS

KINDS: tuple[Kind, ...] = ("about", "trials", "quarantine")


def verify_remote(
    remote: Remote,
    on_trial: Callable[[str], None] | None = None,
    on_bytes: OnBytes | None = None,
) -> tuple[int, list[Problem]]:
    """Hold every visible file against its checksum.

    Returns:
        How many trials are visible, and what is wrong; an empty list means all is well.

    Raises:
        RemoteError: nothing was pushed there, or the storage cannot be reached.
    """
    remote.check()
    trials, problems = 0, []
    for name in remote.folders("campaigns"):
        try:
            safe_name(name)
        except StoreError as error:
            problems.append(Problem(f"{remote.url}/campaigns", str(error)))
            continue
        sizes = remote.sizes(objects_folder(name))
        known: dict[str, bool] = {}
        for kind in KINDS:
            for item, found in read_manifests(remote, name, kind).items():
                trial = item if kind == "trials" else ""
                trials += bool(trial)
                if isinstance(found, RemoteError):
                    problems.append(Problem(remote.url, str(found), campaign=name, trial=trial))
                else:
                    problems += [
                        Problem(remote.where(key), what, campaign=name, trial=trial)
                        for key, what in _look(remote, found, sizes, known, on_bytes)
                    ]
                if trial and on_trial is not None:
                    on_trial(trial)
    return trials, problems


def _look(
    remote: Remote,
    found: Manifest,
    sizes: dict[str, int],
    known: dict[str, bool],
    on_bytes: OnBytes | None,
) -> list[tuple[str, str]]:
    problems = []
    owner = f"{found.kind}/{found.name}".rstrip("/")
    for name, said in sorted(found.files.items()):
        sha, key = said["sha256"], found.object_key(name)
        if sha not in sizes:
            problems.append((key, f"{owner}: {name} is missing"))
        elif sizes[sha] != said["bytes"]:
            problems.append((key, f"{owner}: {name} has {sizes[sha]} bytes, not {said['bytes']}"))
        else:
            if sha not in known:
                known[sha] = remote.matches(key, said, on_bytes)
            if not known[sha]:
                problems.append((key, f"{owner}: {name} does not match its checksum"))
    if not problems and found.kind == "trials":
        try:
            sums = json.loads(remote.read(found.object_key(CHECKSUMS)))
            check_against_sums(found, sums, found.key)
        except (ValueError, RemoteMissing, RemoteError) as error:
            problems.append((found.key, str(error)))
    return problems
