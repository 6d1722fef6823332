"""Rigs drawn from the posterior of a twin, whose samples are stored next to it (`twin.npz`).

A sample is one world that the pilot leaves likely. All parameters are drawn, those too that are not
identified and that the twin keeps as they were assumed; what is only known of them together, such
as a ratio, holds in each sample.
"""

from __future__ import annotations

import io
import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from sliplab.plugins.simulation.scene_runs import changed
from sliplab.plugins.simulation.settings import scene_of
from sliplab.plugins.twin.parameters import settings_of
from sliplab.plugins.twin.posterior import Posterior
from sliplab.plugins.twin.worlds import touch_section
from sliplab.protocols.errors import InputError
from sliplab.rigs.rig_file import load_rig_file
from sliplab.rigs.rig_inheritance import rig_yaml
from sliplab.storage.files import write_bytes, write_text

SEED = 1
"""Of the choice of samples."""


def samples_file(twin: Path) -> Path:
    """Return the path of a twin's posterior samples, next to its rig file."""
    return twin.with_suffix(".npz")


def write_samples(path: Path, found: Posterior) -> None:
    """Write samples: `keys` (p,), and `values` (k, p) in the units of the section `mock:`."""
    buffer = io.BytesIO()
    keys = np.array([it.parameter for it in found.estimates])
    np.savez_compressed(buffer, keys=keys, values=np.exp(found.samples))
    write_bytes(path, buffer.getvalue())


def read_samples(path: Path, count: int) -> list[dict[str, float]]:
    """Return parameters by key of so many samples; fewer where there are not as many.

    Raises:
        InputError: the file does not exist, or is damaged.
    """
    try:
        with np.load(path) as arrays:
            keys, values = arrays["keys"].tolist(), arrays["values"]
    except FileNotFoundError:
        text = "no such file: `sliplab calibrate scene` writes it next to the twin; fit it again"
        raise InputError(path, "", None, text) from None
    except (OSError, ValueError, KeyError) as error:
        raise InputError(path, "", None, f"cannot be read: {error}") from None
    rows = np.random.default_rng(SEED).permutation(len(values))[:count]
    return [dict(zip(keys, values[row].tolist(), strict=True)) for row in rows]


def write_drawn(twin: Path, values: Mapping[str, float], out: Path) -> None:
    """Write the rig file of one sample, which extends the twin's."""
    rig, _ = load_rig_file(twin)
    mock = settings_of(scene_of(rig), values)
    data = {
        "extends": os.path.relpath(twin.resolve(), out.parent.resolve()),
        "name": out.stem,
        **touch_section(changed(rig, mock)),
        "mock": mock,
    }
    write_text(out, rig_yaml(data))
