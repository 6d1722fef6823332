"""Migration of a store to the newest format, with copies of all changed files.

| from | to | what changes |
| --- | --- | --- |
| 1 | 2 | every campaign gets `checksums.json` for its description, protocol and rig file; trials
            may hold columns that format 1 did not know how to read |

Committed trials are never rewritten: this version reads the files of every format. A migration
that is interrupted is restarted: copies that are complete stay unchanged, each step gives
the same result however often it runs, and the store's format is written last.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

from sliplab.storage.files import make_folder, write_bytes, write_json
from sliplab.storage.trials.checksums import CHECKSUMS, write_sums
from sliplab.storage.trials.store import INFO, PROTOCOL, RIG, STORE, StoreError, TrialStore

Step = Callable[[TrialStore], None]


def _describe_with_sums(store: TrialStore) -> None:
    for campaign in store.campaigns():
        names = (PROTOCOL, RIG, INFO)
        missing = [name for name in names if not (campaign.folder / name).is_file()]
        if missing:
            raise StoreError(
                f"{campaign.folder / missing[0]}: is missing: restore it from a copy, or move "
                f"{campaign.folder} away; nothing was changed"
            )
        write_sums(campaign.folder, names)


STEPS: dict[int, Step] = {1: _describe_with_sums}
"""By the format that each begins with."""


def migrate(store: TrialStore, steps: dict[int, Step] | None = None) -> list[int]:
    """Bring a store to the newest format; the caller holds the store's lock.

    Args:
        steps: by the format that each begins with; all that there are by default.

    Returns:
        The formats that it had until now, oldest first; empty when it is the current one already.

    Raises:
        StoreError: a campaign's description is damaged.
    """
    steps = STEPS if steps is None else steps
    passed = []
    while (found := store.format) in steps:
        _keep(store, found)
        steps[found](store)
        write_json(store.folder / STORE, {"format": found + 1})
        passed.append(found)
    return passed


def retained(store: TrialStore, number: int) -> Path:
    """Return the folder with copies of what the migration from a format changed."""
    return store.folder / "before" / f"format-{number}"


def _keep(store: TrialStore, number: int) -> None:
    folder = retained(store, number)
    if (folder / STORE).exists():
        return  # complete: it is copied last
    for path in _changeable(store):
        copy = folder / path.relative_to(store.folder)
        if path.is_file():
            make_folder(copy.parent)
            write_bytes(copy, path.read_bytes())


def _changeable(store: TrialStore) -> Iterable[Path]:
    """Yield the files that are neither of a committed trial nor made by analysis."""
    for campaign in store.campaigns():
        for name in (PROTOCOL, RIG, INFO, CHECKSUMS):
            yield campaign.folder / name
    yield store.folder / STORE
