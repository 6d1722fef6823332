"""Slips that were recorded elsewhere: what an adapter brings in is analysed as what was collected.

The foreign data set is a store of this program as it would be handed on: event files, and a table
with onsets on the event camera's clock. Nothing else of the store is used.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
import pytest
import yaml

from sliplab.analysis.campaigns import Collected, collected
from sliplab.analysis.labels.reviewed import StoreLabels
from sliplab.analysis.metrics.classification import GROSS, NO_SLIP
from sliplab.analysis.windows.sample_sets import load_samples
from sliplab.storage.schema.label import LABELS, TrialLabel
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import TrialStore
from tests.command_line import answer
from tests.flows.older import older_store
from tests.flows.test_levels import kinematic, label, take

ADAPTER = """adapter: 1
name: slides
title: Four slides of another lab
simulated: true
experiment: kinematic
trials:
  table: trials.csv
  files: "{file}"
  id: "{trial}"
factors:
  direction: {field: direction, unit: deg}
streams:
  events: {format: aedat4}
labels:
  onsets: {incipient: incipient_us, gross: gross_us, unit: us, uncertainty_ms: 2}
motion: {start: "{start_us}", end: "{end_us}", unit: us}
split: {given: part}
analysis:
  samples: {per_class: 10}
"""


def other_labs_folder(store: TrialStore, item: Collected, folder: Path) -> None:
    """Write the data set: events as AEDAT4, and a table with what belongs to each trial."""
    files = answer("export", store.folder, item.name, "--output", folder)["files"]
    (folder / "sliplab-export.json").unlink()
    rows = []
    for (trial, recording), file in zip(
        sorted(item.trials, key=lambda t: t[0].id), files, strict=True
    ):
        label = Derived.of(store, LABELS, item.name).load(trial.id, TrialLabel)
        clock = recording.clock("events")

        def camera_us(time_ns: int | None, clock: Any = clock) -> str:
            return "" if time_ns is None else f"{int(clock.to_device(time_ns)) / 1000:.3f}"

        start, end = recording.motion_ns
        times = {
            "incipient": label.incipient_ns,
            "gross": label.gross_ns,
            "start": start,
            "end": end,
        }
        direction = item.describe(trial)["direction"].split()[0]
        about = {"trial": f"slide {len(rows) + 1}", "file": Path(file).name, "part": trial.split}
        known = {f"{name}_us": camera_us(time) for name, time in times.items()}
        rows.append({**about, "direction": direction, **known})
    pd.DataFrame(rows).to_csv(folder / "trials.csv", index=False)


@pytest.mark.long
def test_slides_of_another_lab_go_through_every_step(tmp_path: Path) -> None:
    here = TrialStore.open(older_store(tmp_path / "here"))
    (item,) = collected(here)
    other_labs_folder(here, item, tmp_path / "theirs")
    (tmp_path / "adapter.yaml").write_text(ADAPTER)
    there = tmp_path / "there"
    taken = answer(
        "import", "--adapter", tmp_path / "adapter.yaml", tmp_path / "theirs", "--store", there
    )
    assert len(taken["imported"]) == 4
    for step in ("label", "train", "evaluate", "report"):
        assert answer(step, there)["done"] > 0
        assert answer(step, there)["done"] == 0

    store = TrialStore.open(there)
    (foreign,) = collected(store)
    assert [trial.split for trial, _ in foreign.trials] == [
        trial.split for trial, _ in sorted(item.trials, key=lambda t: t[0].id)
    ]
    # the same windows: those of the two stores begin within the rounding of both clocks
    ours, theirs = (
        load_samples(StoreLabels(each), collected(each), "train") for each in (here, store)
    )
    # an event file goes on for some windows after the slide, where a collected trial has ended
    counts = [np.bincount(part.y, minlength=3) for part in (ours, theirs)]
    np.testing.assert_array_equal(counts[0][:GROSS], counts[1][:GROSS])
    assert counts[0][GROSS] <= counts[1][GROSS] <= counts[0][NO_SLIP]
    before, other = (np.sort(part.windows.totals[part.y == NO_SLIP]) for part in (ours, theirs))
    assert np.abs(before - other).max() <= 2
    summary = json.loads((there / "report" / "summary.json").read_text())
    assert summary["simulated"] is True
    assert summary["labels"]["given_within_ms"] == 2.0
    page = (there / "report" / "index.html").read_text()
    assert "onsets of the data set, within 2.0 ms" in page
    assert "sliplab holdout" not in page


VIDEO = """adapter: 1
name: filmed
simulated: true
experiment: kinematic
trials: {files: "{who}/events.csv", id: "{who}"}
streams:
  events:
    {format: csv, columns: {t: t_us, x: x, y: y, p: p}, unit: us, size_px: [640, 480]}
  frames:
    files: "{who}/frames/*.png"
    format: images
    times: {files: "{who}/times.csv", column: t_ns, unit: ns}
    clock: {offset_ms: 0, uncertainty_ms: 0.1}
"""


def filmed(recording: Recording, folder: Path) -> dict[str, Any]:
    """Write a trial as files of another lab, all times on one clock; return its adapter."""
    (folder / "a" / "frames").mkdir(parents=True)
    events = recording.events()
    line_ns = np.asarray(recording.clock("events").to_reference(events.t_us * 1000))
    table = {"t_us": line_ns // 1000, "x": events.x, "y": events.y, "p": events.p}
    pd.DataFrame(table).to_csv(folder / "a" / "events.csv", index=False)
    for number, image in enumerate(recording.frames()):
        assert cv2.imwrite(str(folder / "a" / "frames" / f"{number}.png"), image)
    pd.DataFrame({"t_ns": recording.frame_times()}).to_csv(folder / "a" / "times.csv", index=False)
    geometry = recording.record.geometry
    start, end = (str(time) for time in recording.motion_ns)
    return {
        **yaml.safe_load(VIDEO),
        "markers": {
            "places_mm": [list(place) for place in geometry.skin_mm],
            "centre": geometry.centre,
            "px_per_mm": geometry.px_per_mm,
        },
        "motion": {"start": start, "end": end, "unit": "ns"},
        "analysis": {"labelling": {"rule": "paper"}},
    }


@pytest.mark.long
def test_our_own_rules_label_the_frames_of_another_lab(tmp_path: Path) -> None:
    data = kinematic()
    recording, _ = take(tmp_path / "here", data, level="video")
    mine = label(recording, data)
    made = filmed(recording, tmp_path / "theirs")
    (tmp_path / "adapter.yaml").write_text(yaml.safe_dump(made))
    there = tmp_path / "there"
    answer("import", "--adapter", tmp_path / "adapter.yaml", tmp_path / "theirs", "--store", there)
    assert answer("label", there)["done"] == 1
    (foreign,) = collected(TrialStore.open(there))
    found = Derived.of(TrialStore.open(there), LABELS, foreign.name).load("a", TrialLabel)
    assert (found.rule, found.source) == ("paper", "video")
    assert found.incipient_ns == mine.onsets.incipient_ns
    assert found.gross_ns == mine.onsets.gross_ns
    assert found.incipient_ns is not None
