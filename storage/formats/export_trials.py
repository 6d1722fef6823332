"""Export of committed trials to files of other formats, and of tables; the store is only read."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path

import pandas as pd

from sliplab.protocols.errors import InputError
from sliplab.storage.errors import StoreError
from sliplab.storage.files import make_folder, replacing, sweep_marked, sync_folder, write_json
from sliplab.storage.formats.foreign import EXPORT_FORMAT, EXPORT_MANIFEST, EXPORT_UNFINISHED
from sliplab.storage.formats.known import known_format
from sliplab.storage.formats.recognition import read_manifest
from sliplab.storage.schema.label import LABELS
from sliplab.storage.streams import EVENTS_KIND, Json
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import TrialStore


def export_trials(
    recordings: list[Recording],
    folder: Path,
    kind: str,
    campaign: str,
    on_trial: Callable[[str], None] = lambda name: None,
    stream: str = EVENTS_KIND,
) -> Json:
    """Export trials to `folder`, each file atomically, and a manifest last.

    Args:
        stream: name of a further event camera's stream, whose events, pulses and clock are
            exported in place of the first one's.

    Returns:
        ``trials``, ``events``, ``frames`` and ``triggers`` written, and ``files``.

    Raises:
        InputError: a trial does not fit the format, or a file of its name is not of an export.
        StoreError: a trial is damaged.
    """
    how = known_format(kind)
    assert how.export is not None
    earlier = read_manifest(folder) or {}
    ours = {item["file"]: item for item in earlier.get("trials", ())}
    begun = set(earlier.get(EXPORT_UNFINISHED, ()))  # by an export that was killed
    paths = [folder / f"{recording.trial_id}{how.suffixes[0]}" for recording in recordings]
    for path in paths:
        if path.name not in {*ours, *begun} and os.path.lexists(path):  # maybe the only original
            text = f"is not in {EXPORT_MANIFEST} and is not replaced; name a new folder"
            raise InputError("--output", "", str(path), text)
    make_folder(folder)
    if begun:
        sweep_marked(folder)
    about: Json = {
        "sliplab_export": EXPORT_FORMAT,
        "campaign": campaign,
        "format": kind,
        "simulated": any(recording.simulated for recording in recordings),
    }
    if stream != EVENTS_KIND:
        about["stream"] = stream
    listed: list[Json] = []
    begun |= {path.name for path in paths}
    unfinished = {EXPORT_UNFINISHED: sorted(begun)}
    write_json(folder / EXPORT_MANIFEST, about | {"trials": []} | earlier | unfinished)
    try:
        for recording, path in zip(recordings, paths, strict=True):
            on_trial(recording.trial_id)
            try:
                with replacing(path) as temporary:
                    counts = how.export(recording, temporary, stream)
            except StoreError:  # a damaged trial, some of which are ValueErrors, too
                raise
            except ValueError as error:
                raise InputError("--as", "", kind, f"trial {recording.trial_id} {error}") from None
            listed.append(_listed(recording, path.name, counts))
    except BaseException:
        with suppress(OSError):
            if listed:  # the next export may replace what is there by now
                about["simulated"] |= earlier.get("simulated", False)
                about["trials"] = [*(ours | {item["file"]: item for item in listed}).values()]
                write_json(folder / EXPORT_MANIFEST, about | unfinished)
            elif not earlier:
                (folder / EXPORT_MANIFEST).unlink()
        raise
    sync_folder(folder)
    write_json(folder / EXPORT_MANIFEST, about | {"trials": listed})
    totals = {name: sum(item[name] for item in listed) for name in ("events", "frames", "triggers")}
    return {"trials": len(listed), **totals, "files": [item["file"] for item in listed]}


def _listed(recording: Recording, name: str, counts: dict[str, int]) -> Json:
    record = recording.record
    stored = record.model_dump(
        mode="json", include={"experiment", "role", "clocks", "steps"}, exclude_unset=True
    )
    if record.context:
        stored["context"] = recording.context
    return {
        "trial": recording.trial_id,
        "file": name,
        "condition": record.condition,
        "repetition": record.repetition,
        "record": stored,
        **counts,
    }


def label_table(store: TrialStore, campaign: str, trials: list[str]) -> pd.DataFrame:
    """Return one row a labelled trial: the single values of its label, times in integer ns.

    Nested values become columns with a dot in their names; lists are left out. Values that are not
    in every label are missing, and integers stay integers. `simulated` is a column of every row.
    """
    stored = Derived.of(store, LABELS, campaign)
    simulated = any(item.info["simulated"] for item in store.campaigns() if item.name == campaign)
    rows: list[Json] = []
    for trial in trials:
        try:
            found = stored.read(trial)
        except FileNotFoundError:
            continue
        flat = {**_flat(found, ""), "simulated": simulated}
        rows.append({"campaign": campaign, "trial": trial, **flat})
    return pd.DataFrame(rows).convert_dtypes()


def sample_table(recordings: Iterable[Recording], stream: str) -> pd.DataFrame:
    """Return one row a sample of a stream: its trial, its time on the time line (ns), its values.

    Values with several components become columns with a number in their names. The last column is
    `simulated`.

    Raises:
        StoreError: a trial has no such stream.
    """
    tables = []
    for recording in recordings:
        samples = recording.samples(stream)
        times = samples.pop("t")
        columns: Json = {"trial": recording.trial_id, "t_ns": times}
        for part, values in samples.items():
            for index, component in enumerate(values.reshape(len(times), -1).T):
                columns[part if values.ndim == 1 else f"{part}_{index}"] = component
        tables.append(pd.DataFrame({**columns, "simulated": recording.simulated}))
    return pd.concat(tables, ignore_index=True)


def _flat(data: Json, before: str) -> Json:
    flat: Json = {}
    for key, value in data.items():
        if isinstance(value, dict):
            flat |= _flat(value, f"{before}{key}.")
        elif not isinstance(value, list):
            flat[f"{before}{key}"] = value
    return flat
