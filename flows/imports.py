"""Import of other programs' recordings, for the command and the Python interface."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from sliplab.flows.collecting.requests import store_lock
from sliplab.flows.running import console
from sliplab.protocols.errors import InputError
from sliplab.protocols.plugin import plugins
from sliplab.protocols.shown import one_of
from sliplab.storage.files import safe_name
from sliplab.storage.formats.foreign import FormatError, refusal
from sliplab.storage.formats.import_trials import import_trials
from sliplab.storage.formats.known import format_names
from sliplab.storage.formats.recognition import kind_of, skipped_in, trials_in
from sliplab.storage.streams import Json
from sliplab.storage.trials.store import StoreError, TrialStore, refuse_url


def import_data(
    path: Path,
    store: Path,
    *,
    kind: str | None = None,
    name: str | None = None,
    adapter: Path | None = None,
    dry_run: bool = False,
    simulated: bool = False,
    salvage: bool = False,
) -> Json:
    """Import recordings into a campaign of a store, which is made if there is none.

    Args:
        path: a file, or a folder of files; with an adapter also a ``.zip``.
        kind: name of the format; by default the content decides, for each file of a folder.
        name: the new campaign's; by default the adapter's.
        adapter: of a data set with labels and factors (docs/adapters.md).
        dry_run: with an adapter: return what would be imported.
        simulated: mark the trials as simulated; an adapter says it itself.
        salvage: import the undamaged beginning of a damaged file.

    Returns:
        what ``sliplab import --json`` prints: ids in ``imported``, faults in ``failed``, and so on.

    Raises:
        InputError: an argument, or data that cannot be right; nothing is written if no trial can be
            imported, and those before a wrong one stay.
        Locked: another program writes into the store.
    """
    refuse_url(path)
    if adapter is not None:
        for option, given in (("KIND", kind is not None), ("--simulated", simulated)):
            if given:
                raise InputError(option, "", None, "cannot be given with --adapter")
        made: Json = plugins().hook("import_adapted")(adapter, path, store, name, dry_run, salvage)
        return made
    if dry_run:
        raise InputError("--dry-run", "", None, "is for an import with --adapter")
    if name is None:
        raise InputError("--name", "", None, "is missing: the name of the new campaign")
    if kind is not None and kind not in format_names():
        raise InputError("KIND", "", kind, one_of(kind, format_names()))
    try:
        found_kind = kind_of(path) if kind is None else kind
        check_name(name)
        skipped = skipped_in(path, found_kind)
        found = trials_in(path, found_kind, salvage=salvage)
        if simulated:
            found = (replace(trial, simulated=True) for trial in found)
        with new_store(store) as opened, store_lock(opened):
            result = import_trials(
                opened, name, found, path, found_kind, lambda it: console.say(it), salvage=salvage
            )
    except FormatError as error:  # of a whole folder
        raise refusal(error.file or path, error) from None
    say_faults(result)
    for item in skipped:
        console.say(f"skipped: {item.file}: {item.reason}")
    if skipped:
        result["skipped"] = [vars(item) for item in skipped]
    return result


def check_name(name: str) -> None:
    """Raise InputError if no campaign can have this name."""
    try:
        safe_name(name)
    except StoreError as error:
        raise InputError("--name", "", name, str(error)) from None


def say_faults(result: Json) -> None:
    """Print the warnings of an import, and the trials that could not be imported."""
    for text in result.get("warnings", ()):
        console.say(f"warning: {text}")
    for item in result.get("failed", ()):
        console.say(f"not imported: {item['trial']}: {item['reason']}")


@contextmanager
def new_store(place: Path) -> Iterator[TrialStore]:
    """Yield the store at `place`; one that is made here is removed again if it stays empty."""
    there = place.is_dir() and any(place.iterdir())
    existed = place.exists()
    store = TrialStore.create(place)
    try:
        yield store
    except BaseException:
        if not there and not store.campaigns():
            shutil.rmtree(place)
            if existed:
                place.mkdir()
        raise
