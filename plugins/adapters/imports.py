"""`sliplab import --adapter`: a data set with labels and factors."""

from __future__ import annotations

from collections import Counter
from contextlib import closing
from pathlib import Path

from sliplab.flows.collecting.requests import store_lock
from sliplab.flows.imports import check_name, new_store, say_faults
from sliplab.flows.running import console
from sliplab.plugins.adapters import importing
from sliplab.plugins.adapters.trials import AdaptedSet, find_trials
from sliplab.protocols.adapter import load_adapter
from sliplab.protocols.yaml_file import read_text
from sliplab.storage.formats.data_folder import DataFolder
from sliplab.storage.streams import Json
from sliplab.storage.trials.store import TrialStore


def import_adapted(
    file: Path, path: Path, place: Path, name: str | None, dry_run: bool, salvage: bool
) -> Json:
    """Import a data set as `flows.imports.import_data` describes it.

    Args:
        file: the adapter. path: the data. place: the store's folder.
    """
    text = read_text(file, "adapter")
    adapter = load_adapter(file)
    name = adapter.name if name is None else name
    check_name(name)
    with closing(DataFolder(path)) as folder:
        found = find_trials(adapter, file, folder)
        parts = found.parts()
        for warning in found.warnings:
            console.say(f"warning: {warning}")
        warnings = list(found.warnings)
        if dry_run:
            result: Json = {"campaign": name, "trials": _planned(found, parts, place, name)}
        else:
            bar = console.bar("import (trials)", len(found.trials))
            with new_store(place) as store, store_lock(store), bar as progress:
                result = importing.import_adapted(
                    store,
                    name,
                    found,
                    text,
                    lambda trial: progress.advance(1, trial),
                    salvage=salvage,
                )
            say_faults(result)
            warnings += result.get("warnings", ())
            parts = {trial: parts[trial] for trial in (*result["imported"], *result["there"])}
        return result | {
            "split": dict(Counter(parts.values())),
            "warnings": warnings,
            "skipped": [vars(item) for item in found.skipped],
        }


def _planned(found: AdaptedSet, parts: dict[str, str], place: Path, name: str) -> list[Json]:
    """Return what would be imported, a row a trial."""
    existing = (
        TrialStore.open(place).campaign(name).committed() if TrialStore.exists(place) else set()
    )
    return [
        {
            "trial": trial.id,
            "condition": trial.condition,
            "label": None if trial.label is None else str(trial.label),
            "part": parts[trial.id],
            "there": trial.id in existing,
        }
        for trial in found.trials
    ]
