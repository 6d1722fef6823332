"""Small foreign data sets and their adapters."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from sliplab.plugins.adapters.importing import import_adapted
from sliplab.plugins.adapters.trials import find_trials
from sliplab.protocols.adapter import load_adapter
from sliplab.protocols.errors import InputError
from sliplab.storage.formats.data_folder import DataFolder
from sliplab.storage.trials.store import Campaign, TrialStore
from sliplab.storage.trials.verify import verify

COUNTS: dict[str, Any] = yaml.safe_load("""
adapter: 1
name: touch
experiment: classes
trials: {files: '**/{part:train|test}/*{object:number}*.npy', id: '{part}-{stem}'}
streams: {events: {format: counts, axes: [taxel, polarity, step], step_ms: 20}}
labels: {class: '{object}'}
split: {given: part}
""")
SLIDES: dict[str, Any] = yaml.safe_load(
    """
adapter: 1
name: slides
experiment: kinematic
trials: {files: 'rec/{person}_{speed:number}_{number:number}/events.csv', id: '{folder}'}
fields: {side: {from: '{number}', values: {'0': left, '1': right}}}
factors: {speed: {field: speed, unit: mm/s}, side: {field: side}}
streams:
  events: {format: csv, columns: {t: time, x: x, y: y, p: polarity}, unit: s, size_px: [16, 12]}
  frames:
    files: rec/{folder}/img/*.png
    format: images
    times: {files: 'rec/{folder}/img/t.npy', unit: ms}
    clock: {offset_ms: 5, uncertainty_ms: 0.5}
  poses:
    {files: 'rec/{folder}/arm.csv', format: csv, unit: ms, length: m,
     columns: {t: 0, x: 1, y: 2, z: 3}}
  wrenches:
    force:
      {files: 'rec/{folder}/force.npz', format: numpy, unit: us,
       columns: {t: t, fx: x, fy: y, fz: z}, clock: {uncertainty_ms: 1}}
labels:
  onsets:
    {file: onsets.csv, match: {trial: '{id}'}, incipient: first, gross: full, unit: ms,
     clock: frames, uncertainty_ms: 2}
motion: {start: 0.1, end: 0.9, unit: s}
split: {together: person}
"""
)


def bring(adapter: dict[str, Any], path: Path, store: Path, text: str | None = None) -> Campaign:
    """Import `path` by an adapter into `store`, and return the campaign.

    Raises:
        InputError: a trial could not be imported.
    """
    file = store.parent / "adapter.yaml"
    file.write_text(yaml.safe_dump(adapter) if text is None else text)
    read = load_adapter(file)
    found = find_trials(read, file, DataFolder(path))
    opened = TrialStore.create(store)
    done = import_adapted(opened, read.name, found, file.read_text())
    for item in done.get("failed", ()):
        raise InputError(item["file"], "", None, item["reason"])
    assert not verify(opened)
    return opened.campaign(read.name)


def touches(folder: Path, name: Callable[[int], str], classes: int = 3) -> dict[str, Any]:
    """Write a small data set of counts; return the arrays by the ids of their trials."""
    rng = np.random.default_rng(4)
    made = {}
    for number in range(2 * classes):
        part = "train" if number < classes else "test"
        counts = rng.poisson(0.4, (5, 2, 8)).astype(np.float32)
        counts[:, :, -1] = 0
        path = folder / part / name(number)
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, counts)
        made[f"{part}-{path.stem}"] = counts
    return made


def slides(folder: Path) -> list[str]:
    """Write a small data set of slides with events, frames, poses, forces and onsets."""
    names = ["ann_0.6_0", "ann_2_1", "bob_0.6_1", "cid_2_0"]
    for name in names:
        trial = folder / "rec" / name
        (trial / "img").mkdir(parents=True)
        rows = [f"{k * 0.01:.6f},{k % 16},{k % 12},{-1 if k % 2 else 1}" for k in range(101)]
        (trial / "events.csv").write_text("\n".join(["time,x,y,polarity", *rows]) + "\n")
        for k in range(4):
            cv2.imwrite(str(trial / "img" / f"{8 + k}.png"), np.full((6, 8), 10 * k, np.uint8))
        np.save(trial / "img" / "t.npy", np.arange(4) * 250.0)
        (trial / "arm.csv").write_text("".join(f"{k * 100} 0.1 {k} 0\n" for k in range(10)))
        t = np.arange(5) * 200_000
        np.savez(trial / "force.npz", t=t, x=t * 0.0, y=t * 1e-6, z=t * 0 + 2.0)
    onsets = ["trial,first,full", "ann_0.6_0,300,400.5", "ann_2_1,200,", "cid_2_0,,"]
    (folder / "onsets.csv").write_text("\n".join(onsets) + "\n")
    return names
