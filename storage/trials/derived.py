"""Derived results, stored by step and name with the key of their inputs.

A key is the hash of a result's inputs, its parameters and its step's own version constant. A
result whose key is still the wanted one is fresh and is not made again; anything else is stale.
Raw data are never touched, and the whole folder may be deleted at any time.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from sliplab.protocols.hashing import hash_data
from sliplab.storage.errors import StoreError
from sliplab.storage.files import inside, read_json, safe_name, write_bytes, write_json
from sliplab.storage.interrupts import uninterrupted
from sliplab.storage.schema.document import Document, DocumentError, NewerFormat, Part
from sliplab.storage.streams import Json
from sliplab.storage.trials.store import TrialStore

Arrays = dict[str, npt.NDArray[Any]]
"""Arrays of a result by name."""
DocumentT = TypeVar("DocumentT", bound=Document)


def make_key(step: str, version: int, inputs: Any, parameters: Any) -> str:
    """Return the key of a result."""
    return hash_data([step, version, inputs, parameters])


def load_document(path: Path, kind: type[DocumentT]) -> DocumentT:
    """Read a document that a step makes again where it lacks.

    Raises:
        FileNotFoundError: it was never made.
        StoreError: it is damaged, or was written by a newer version.
    """
    try:
        return kind.load(path)
    except NewerFormat as error:
        raise StoreError(str(error)) from None
    except DocumentError as error:
        raise StoreError(f"{error}; it is damaged: delete it, and its step recomputes it") from None


def _any_simulated(store: TrialStore, campaign: str | None) -> bool:
    of = (item for item in store.campaigns() if campaign in (None, item.name))
    return any(bool(item.info["simulated"]) for item in of)


@dataclass(frozen=True)
class Derived:
    """The results of one step.

    Attributes:
        of_simulated: whether what they are made of is simulated, as of now; None where unknown.
    """

    folder: Path
    of_simulated: Callable[[], bool] | None = field(default=None, compare=False, repr=False)

    @staticmethod
    def of(store: TrialStore, step: str, campaign: str | None = None) -> Derived:
        """Return the results of `step`; those about single trials are under their campaign."""
        folder = store.folder / "derived" / safe_name(step)
        folder = folder if campaign is None else folder / safe_name(campaign)
        simulated = partial(_any_simulated, store, campaign)
        return Derived(inside(folder, store.folder), simulated)

    def key(self, name: str) -> str | None:
        """Return the key that the result `name` was made with; None if there is none."""
        try:
            return str(read_json(self.folder / f"{safe_name(name)}.json")["key"])
        except (OSError, ValueError, KeyError):
            return None

    def fresh(self, name: str, key: str) -> bool:
        """Return whether `name` was made with `key`."""
        return self.key(name) == key

    @uninterrupted
    def write(self, name: str, key: str, data: Json | Part, arrays: Arrays | None = None) -> None:
        """Keep a result; the JSON with its key is written last and decides.

        It also says if it is of simulated trials.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        if arrays is not None:
            buffer = io.BytesIO()
            np.savez_compressed(buffer, **arrays)  # type: ignore[arg-type]  # no array is numpy's option
            write_bytes(self.arrays_path(name), buffer.getvalue())
        plain = data.to_json() if isinstance(data, Part) else data
        mark = {} if self.of_simulated is None else {"simulated": self.of_simulated()}
        write_json(self.folder / f"{safe_name(name)}.json", {**mark, **plain, "key": key})

    def read(self, name: str) -> Json:
        """Return a result's JSON.

        Raises:
            FileNotFoundError: it was never made.
        """
        return read_json(self.folder / f"{safe_name(name)}.json")

    def load(self, name: str, kind: type[DocumentT]) -> DocumentT:
        """Read a result's JSON as a document.

        Raises:
            FileNotFoundError: it was never made.
            StoreError: it is damaged, or was written by a newer version.
        """
        return load_document(self.folder / f"{safe_name(name)}.json", kind)

    def arrays_path(self, name: str) -> Path:
        """Return the path of a result's arrays."""
        return self.folder / f"{safe_name(name)}.npz"

    def arrays(self, name: str, *only: str) -> Arrays:
        """Return a result's arrays.

        Args:
            only: these, as far as they are there; all if none is named.
        """
        with np.load(self.arrays_path(name), allow_pickle=False) as file:
            return {key: file[key] for key in file.files if not only or key in only}
