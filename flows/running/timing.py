"""How long each step took when it last really ran: kept beside the results, never in them."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sliplab.storage.files import read_json, write_json
from sliplab.storage.trials.store import Store


def _file(store: Store) -> Path:
    return store.folder / "derived" / "timing.json"


def read(store: Store) -> dict[str, float]:
    """Wall seconds by step, of the last run that had something to do."""
    path = _file(store)
    return {key: float(value) for key, value in read_json(path).items()} if path.exists() else {}


@contextmanager
def timed(store: Store, step: str) -> Iterator[None]:
    """Keep the wall seconds of the block under `step` if it ends well."""
    start = time.perf_counter()
    yield
    path = _file(store)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, {**read(store), step: round(time.perf_counter() - start, 2)})
