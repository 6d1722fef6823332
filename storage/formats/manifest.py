"""What stands beside exported trials, so that they can be imported again as what they were."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from sliplab.protocols.errors import InputError
from sliplab.storage.errors import StoreError
from sliplab.storage.files import read_json, safe_name
from sliplab.storage.formats.foreign import ForeignTrial
from sliplab.storage.streams import Json

MANIFEST = "sliplab-export.json"
FORMAT = 1


def read_manifest(folder: Path) -> Json | None:
    """The description of an exported campaign, checked; None where there is none.

    Raises:
        InputError: it is damaged, or names a file outside of its folder.
    """
    path = folder / MANIFEST
    if not path.is_file() or path.is_symlink():
        return None
    try:
        found = read_json(path)
        if found.get("sliplab_export") != FORMAT:
            raise ValueError(f"{path}: sliplab_export must be {FORMAT}")
        if not isinstance(found.get("simulated"), bool):
            raise ValueError(f"{path}: simulated must be true or false")
        for item in found["trials"]:
            safe_name(item["trial"])
            safe_name(item["file"])
            _check(item, path)
    except OSError as error:
        raise InputError(path, "", None, f"cannot be read: {error.strerror}") from None
    except (ValueError, KeyError, TypeError, StoreError) as error:
        text = str(error).removeprefix(f"{path}: ")
        raise InputError(path, "", None, f"is damaged: {text}") from None
    return found


def _check(item: Json, path: Path) -> None:
    texts = item["condition"]
    if not isinstance(texts, dict) or not all(isinstance(t, str) for t in texts.values()):
        raise ValueError(f"{path}: a condition that is no text")
    for name in ("events", "frames", "triggers", "repetition"):
        if type(item[name]) is not int:
            raise ValueError(f"{path}: {name} must be an integer")


def as_it_was(trial: ForeignTrial, item: Json, simulated: bool) -> ForeignTrial:
    """A trial with what the manifest says of it."""
    about: dict[str, Any] = {**trial.about, "exported": item.get("record", {})}
    return replace(
        trial,
        condition=dict(item["condition"]),
        repetition=item["repetition"],
        simulated=simulated or trial.simulated,
        about=about,
        unknown=tuple(what for what in trial.unknown if what != "condition"),
    )
