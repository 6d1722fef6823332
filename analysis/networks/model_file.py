"""Model file of a trained network: atomic, byte for byte reproducible, without code."""

from __future__ import annotations

import io
import pickle
import sys
import zipfile
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from pydantic import ValidationError

from sliplab.analysis.metrics.classification import CLASSES
from sliplab.analysis.networks.training import EpochRecord, Fitted, check_classes, restore
from sliplab.protocols.network_settings import NetworkSettings
from sliplab.protocols.training import Training
from sliplab.protocols.windows import Windows
from sliplab.storage.files import MOST_BYTES, read_plain, write_bytes

FORMAT = "sliplab-model-1"


def save(path: Path, fitted: Fitted) -> None:
    """Write a model file: whole or not at all, and the same bytes for the same model."""
    content = {
        "format": FORMAT,
        "state_dict": fitted.state_dict,
        "network": fitted.network.model_dump(mode="json"),
        "windows": fitted.windows.model_dump(mode="json"),
        "training": fitted.training.model_dump(mode="json"),
        "seed": fitted.seed,
        "history": [asdict(record) for record in fitted.history],
        "chosen_epoch": fitted.chosen_epoch,
        "warnings": list(fitted.warnings),
    }
    if fitted.classes != CLASSES:
        content["classes"] = list(fitted.classes)
    buffer = io.BytesIO()  # torch writes a file's name into it; a buffer has none
    torch.save(_canonical(content), buffer)
    write_bytes(path, buffer.getvalue())


def _canonical(value: Any) -> Any:
    """Return the same content with strings interned: a pickle depends on their identity."""
    if isinstance(value, str):
        return sys.intern(value)
    if isinstance(value, dict):
        return {_canonical(key): _canonical(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_canonical(item) for item in value]
    return value


def load(path: Path) -> Fitted:
    """Read a model file that `save` wrote. Nothing in it is executed.

    Raises:
        OSError: it does not exist, or it cannot be read.
        ValueError: it is not a model file, is damaged, or its weights do not fit its settings.
    """
    return parse(read_plain(path), str(path))


def parse(data: bytes, name: str) -> Fitted:
    """A model from a file's bytes.

    Args:
        name: what the message calls it.

    Raises:
        ValueError: as `load`.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            if sum(entry.file_size for entry in archive.infolist()) > MOST_BYTES:
                raise ValueError(f"it unpacks to over {MOST_BYTES >> 20} MiB")
            spoilt = archive.testzip()  # torch does not check the checksums
        if spoilt is not None:
            raise ValueError(f"{spoilt} in it is damaged")
        content = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
        if not isinstance(content, dict) or content.get("format") != FORMAT:
            raise ValueError(f"its format is not {FORMAT}")
        fitted = Fitted(
            state_dict=content["state_dict"],
            network=NetworkSettings.model_validate(content["network"]),
            windows=Windows.model_validate(content["windows"]),
            training=Training.model_validate(content["training"]),
            seed=content["seed"],
            history=tuple(EpochRecord(**record) for record in content["history"]),
            chosen_epoch=content["chosen_epoch"],
            warnings=tuple(content["warnings"]),
            classes=check_classes(content.get("classes", CLASSES)),
        )
        restore(fitted)
    except (
        ValueError,
        KeyError,
        TypeError,
        EOFError,
        RuntimeError,
        ValidationError,
        pickle.UnpicklingError,
        zipfile.BadZipFile,
    ) as error:
        reason = "PyTorch did not write it" if isinstance(error, zipfile.BadZipFile) else error
        raise ValueError(f"{name}: not a model file of this program: {reason}") from error
    return fitted
