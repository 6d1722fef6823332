"""`sliplab import --adapter`: a foreign data set with its labels, by an adapter."""

from __future__ import annotations

from collections import Counter
from contextlib import closing
from pathlib import Path

import typer

from sliplab.flows.cli.common import FAULTS, finish, new_store, say_faults
from sliplab.flows.collecting.requests import store_lock
from sliplab.flows.running import console, exit_codes
from sliplab.protocols.adapter import Adapter, load_adapter
from sliplab.protocols.errors import InputError
from sliplab.protocols.yaml_file import read_text
from sliplab.storage.files import safe_name
from sliplab.storage.formats.adapted import import_adapted
from sliplab.storage.formats.adapted_trials import AdaptedSet, find_trials
from sliplab.storage.formats.data_folder import DataFolder
from sliplab.storage.streams import Json
from sliplab.storage.trials.store import Store, StoreError

_SHOWN = 10


def import_by_adapter(
    file: Path,
    path: Path,
    place: Path,
    name: str | None,
    *,
    salvage: bool,
    dry_run: bool,
    as_json: bool,
) -> None:
    """Import the data set at `path` by the adapter `file`, or list what would be imported.

    Raises:
        InputError: adapter or data cannot be right. Nothing is written if no trial can be imported;
            those before a wrong one stay.
    """
    text = read_text(file, "adapter")
    adapter = load_adapter(file)
    name = adapter.name if name is None else name
    try:
        safe_name(name)
    except StoreError as error:
        raise InputError("--name", "", name, str(error)) from None
    with closing(DataFolder(path)) as folder:
        found = find_trials(adapter, file, folder)
        parts = found.parts()
        for warning in found.warnings:
            console.say(f"warning: {warning}")
        if dry_run:
            _list(found, parts, place, name, as_json)
            return
        bar = console.bar("import (trials)", len(found.trials))
        with new_store(place) as store, store_lock(store), bar as progress:
            result = import_adapted(
                store,
                name,
                found,
                text,
                lambda trial: progress.advance(1, trial),
                salvage=salvage,
            )
        say_faults(result)
        warnings = [*found.warnings, *result.get("warnings", ())]
        result |= {"split": dict(Counter(parts.values())), "warnings": warnings}
        failed = "failed" in result
        _finish(result, found, f"imported into {place}", as_json)
        if failed:
            raise typer.Exit(exit_codes.FAILED)


def _list(found: AdaptedSet, parts: dict[str, str], place: Path, name: str, as_json: bool) -> None:
    """Print what would be imported."""
    existing = Store.open(place).campaign(name).committed() if Store.exists(place) else set()
    rows = [
        {
            "trial": trial.id,
            "condition": trial.condition,
            "label": None if trial.label is None else str(trial.label),
            "part": parts[trial.id],
            "there": trial.id in existing,
        }
        for trial in found.trials
    ]
    if not as_json:
        console.print_table(
            f"trials of {found.folder.path}",
            ("trial", "condition", "label", "part", "there"),
            [
                (
                    row["trial"],
                    _condition(found.adapter, row["condition"]),
                    row["label"] or "-",
                    row["part"],
                    "yes" if row["there"] else "no",
                )
                for row in rows
            ],
            limit=4 * _SHOWN,
        )
    result: Json = {
        "campaign": name,
        "trials": rows if as_json else len(rows),
        "split": dict(Counter(parts.values())),
        "warnings": list(found.warnings),
    }
    _finish(result, found, f"{name}: nothing was written", as_json)


def _condition(adapter: Adapter, condition: object) -> str:
    assert isinstance(condition, dict)
    return ", ".join(f"{factor} {level}" for factor, level in condition.items()) or "-"


def _finish(result: Json, found: AdaptedSet, title: str, as_json: bool) -> None:
    skipped = found.skipped
    if as_json:
        finish({**result, "skipped": [vars(item) for item in skipped]}, title, True)
        return
    for item in skipped[:_SHOWN]:
        console.say(f"skipped: {item.file}: {item.reason}")
    if len(skipped) > _SHOWN:
        console.say(f"skipped: {len(skipped) - _SHOWN} more; --json lists all")
    for key in ("imported", "there"):
        if key in result:
            result[key] = len(result[key])
    split = ", ".join(f"{count} {part}" for part, count in result.pop("split").items())
    for key in FAULTS:
        result.pop(key, None)
    finish({**result, "split": split, "skipped": len(skipped)}, title, False)
