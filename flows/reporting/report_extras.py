"""Results of other programs that the report takes up where they stand in the store.

    STORE/derived/generalisation/results.json   sliplab generalise
    STORE/derived/guesses/results.json          sliplab guesses
    STORE/holdout/results.json                  sliplab holdout
    STORE/derived/tradeoff/tradeoff.json        sliplab tradeoff --scene
    STORE/derived/tradeoff/labels.json          python -m benchmarks labels --json
    STORE/derived/tradeoff/labels_truth.json    python -m benchmarks labels_truth --json
    STORE/report/detector_tradeoff.json         sliplab tradeoff --detector

They take minutes to hours, so the report never makes them: it shows what is there, and says how to
make what is not. None of them is checked for being fresh; what they were made of is theirs to say.
"""

from __future__ import annotations

from typing import Any

from sliplab.storage.errors import StoreError
from sliplab.storage.files import read_json
from sliplab.storage.trials.store import Store

Json = dict[str, Any]

FILES = {
    "generalisation": "derived/generalisation/results.json",
    "guesses": "derived/guesses/results.json",
    "holdout": "holdout/results.json",
    "scene": "derived/tradeoff/tradeoff.json",
    "labels": "derived/tradeoff/labels.json",
    "labels_truth": "derived/tradeoff/labels_truth.json",
    "detector": "report/detector_tradeoff.json",
}
"""By name, where each stands in the store."""

COMMANDS = {
    "generalisation": "sliplab generalise {store}",
    "guesses": "sliplab guesses {store}",
    "holdout": "sliplab holdout {store}",
    "scene": "sliplab tradeoff --scene PROTOCOL --out {folder}",
    "labels": "python -m benchmarks labels --json > {file}",
    "labels_truth": "python -m benchmarks labels_truth --json > {file}",
    "detector": "sliplab tradeoff --detector {store}",
}
"""How each is made."""


def extras(store: Store) -> dict[str, Json]:
    """What there is, by name.

    Raises:
        StoreError: a file is there and cannot be read.
    """
    found = {}
    for name, place in FILES.items():
        path = store.folder / place
        try:
            found[name] = read_json(path)
        except FileNotFoundError:
            continue
        except (OSError, ValueError) as error:
            raise StoreError(f"{error}; delete {path}, or make it again") from None
    return found


def command(store: Store, name: str) -> str:
    """The command that makes one of `FILES`, for this store."""
    path = store.folder.resolve() / FILES[name]
    return COMMANDS[name].format(store=store.folder.resolve(), folder=path.parent, file=path)


def odd_shape(name: str, error: Exception) -> StoreError:
    """The error of one of `FILES` that is not of the shape that its section reads."""
    return StoreError(
        f"{FILES[name]}: is not of the shape that this version reads ({error!r}); delete it, or "
        "make it again"
    )
