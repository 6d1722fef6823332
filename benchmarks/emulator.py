"""v2e's own emulator on frames: what the analytic event camera is held against.

The events are those of `EventEmulator` of v2e (Hu, Liu and Delbruck 2021; SensorsINI/v2e), from the
installed package `v2ecore` or from a checkout (`python -m benchmarks scene --v2e FOLDER`, or the
variable SLIPLAB_V2E). It is no dependency of the project, and where it is not found its rows are
left out. The frames are ours: the discs of the analytic way, every millisecond, as floats without
the rounding of a video, white at 255. v2e gets the thresholds of our pixels and the dead time, and
neither noise nor a low pass. All simulated.
"""

from __future__ import annotations

import os
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from sliplab.plugins.simulation.scene.edges import CUT, level_at
from sliplab.plugins.simulation.scene.events import EventOptics, Events
from sliplab.storage.kernels import njit
from sliplab.storage.streams import F64

FRAME_NS = 1_000_000
SOURCE = "SLIPLAB_V2E"
"""Variable that names the folder in which v2e's package `v2ecore` is."""
_WHITE = 255.0


def find_emulator() -> Any | None:
    """v2e's class; None, and a line on standard error, where it is not to be had.

    Raises:
        ValueError: a folder is named, and v2e cannot be loaded from it.
    """
    folder = os.environ.get(SOURCE)
    if folder is not None and not (Path(folder) / "v2ecore" / "emulator.py").is_file():
        raise ValueError(f"{SOURCE}: {folder}: must be a folder with v2ecore/emulator.py in it")
    if folder is not None and folder not in sys.path:
        sys.path.insert(0, folder)
    try:
        return import_module("v2ecore.emulator").EventEmulator
    except ImportError as error:
        if folder is not None:
            raise ValueError(
                f"{SOURCE}: {folder}: v2e cannot be loaded: {error}; install what it needs"
            ) from error
    print(
        f"v2e was not found, its rows are left out: --v2e FOLDER or {SOURCE} names a checkout of "
        "SensorsINI/v2e",
        file=sys.stderr,
    )
    return None


def emulate(emulator: Any, path: F64, optics: EventOptics, threshold: F64) -> Events:
    """Events of v2e for discs that are drawn every millisecond.

    Args:
        emulator: the class of `find_emulator`.
        path: column, row and radius of every disc in every frame, px, (m, n, 3).
        optics: picture, edges, contrast and dead time.
        threshold: of every pixel for both polarities, (height, width).

    Returns:
        time (ns from the first frame), column, row, polarity, (k,) each, in order of time.
    """
    import torch

    # as many threads as cores of the comparison: others would wait for each other on the one core
    torch.set_num_threads(1)
    device = emulator(
        pos_thres=optics.threshold,
        neg_thres=optics.threshold,
        sigma_thres=0.0,
        cutoff_hz=0.0,
        leak_rate_hz=0.0,
        shot_noise_rate_hz=0.0,
        refractory_period_s=optics.refractory_us * 1e-6,
        output_width=optics.width,
        output_height=optics.height,
        device="cpu",
    )
    device.pos_thres = device.neg_thres = torch.tensor(threshold, dtype=torch.float32)
    picture = np.empty(threshold.shape)
    found = [np.empty((0, 4))]
    for index in range(path.shape[0]):
        draw(path[index], optics.contrast, optics.edge_px, picture)
        events = device.generate_events(picture, index * FRAME_NS * 1e-9)
        if events is not None:
            found.append(np.asarray(events, np.float64))
    t_s, x, y, p = np.concatenate(found).T
    order = np.argsort(t_s, kind="stable")
    return (
        np.rint(t_s[order] * 1e9).astype(np.int64),
        x[order].astype(np.uint16),
        y[order].astype(np.uint16),
        (p[order] > 0).astype(np.uint8),
    )


@njit(cache=True, nogil=True, error_model="numpy")
def draw(discs: F64, contrast: float, edge: float, picture: F64) -> None:
    """Intensity of discs on their ground, 255 at most, into `picture` (height, width).

    Args:
        discs: column, row and radius, px, (n, 3).
    """
    height, width = picture.shape
    picture[:] = _WHITE * np.exp(-contrast)
    for i in range(discs.shape[0]):
        column, row, radius = discs[i, 0], discs[i, 1], discs[i, 2]
        reach = radius + CUT * edge
        for y in range(max(int(row - reach), 0), min(int(row + reach) + 2, height)):
            for x in range(max(int(column - reach), 0), min(int(column + reach) + 2, width)):
                dx, dy = x - column, y - row
                level = level_at(np.sqrt(dx * dx + dy * dy) - radius, contrast, edge)
                if level > 0.0:
                    picture[y, x] = _WHITE * np.exp(level - contrast)
