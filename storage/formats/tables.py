"""Tables as CSV, Parquet or JSON: the catalogue, and labels."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pandas as pd

from sliplab.protocols.errors import InputError
from sliplab.storage.files import write_bytes
from sliplab.storage.schema.label import LABELS
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.store import Store


def write_table(table: pd.DataFrame, path: Path) -> None:
    """Write a table atomically in the format that its name ends in.

    Raises:
        InputError: it ends in something else than .csv, .parquet or .json.
    """
    kinds: dict[str, Callable[[], bytes]] = {
        ".csv": lambda: table.to_csv(index=False).encode(),
        ".parquet": lambda: _parquet(table),
        ".json": lambda: table.to_json(orient="records").encode(),
    }
    if path.suffix not in kinds:
        raise InputError("--output", "", str(path), "must end in .csv, .parquet or .json")
    write_bytes(path, kinds[path.suffix]())


def label_table(store: Store, campaign: str, trials: list[str]) -> pd.DataFrame:
    """One row a labelled trial: what its label says in single values, times in integer ns.

    Nested values become columns with a dot in their names; lists are left out. Values that are not
    in every label are missing, and integers stay integers.
    """
    kept = Derived.of(store, LABELS, campaign)
    rows: list[dict[str, Any]] = []
    for trial in trials:
        try:
            found = kept.read(trial)
        except FileNotFoundError:
            continue
        rows.append({"campaign": campaign, "trial": trial, **_flat(found, "")})
    return pd.DataFrame(rows).convert_dtypes()


def _flat(data: dict[str, Any], before: str) -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in data.items():
        if isinstance(value, dict):
            flat |= _flat(value, f"{before}{key}.")
        elif not isinstance(value, list):
            flat[f"{before}{key}"] = value
    return flat


def _parquet(table: pd.DataFrame) -> bytes:
    made = io.BytesIO()
    table.to_parquet(made, index=False, engine="pyarrow")
    return made.getvalue()
