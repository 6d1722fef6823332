"""Marks of a recording are onsets: the whole analysis runs on them."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

import sliplab
from sliplab.plugins.record.recorder import RecordedTrial

EVENTS_PX = (480, 400)
SECONDS, SLIP_S, GROSS_S = 1.2, 0.6, 0.9
ANALYSIS = """
analysis: {training: {epochs: 1}}
split: {train: 0.5, validation: 0.25, test: 0.25}
"""


def push_slip(trial: RecordedTrial, seed: int) -> None:
    """Push events that grow more with each phase of a slip, as they come."""
    rng = np.random.default_rng(seed)
    phases = ((0.0, SLIP_S, 5e3), (SLIP_S, GROSS_S, 4e4), (GROSS_S, SECONDS, 2e5))
    t_s = np.sort(np.concatenate([rng.uniform(a, b, int(r * (b - a))) for a, b, r in phases]))
    t_us = trial.begin_ns // 1000 + (t_s * 1e6).astype(np.int64)
    pixels = [rng.integers(0, n, len(t_us)) for n in (*EVENTS_PX, 2)]
    trial.mark("slip", trial.begin_ns + round(SLIP_S * 1e9), uncertainty_ms=5)
    trial.mark("gross", trial.begin_ns + round(GROSS_S * 1e9), uncertainty_ms=5)
    done = 0
    while done < len(t_us):
        time.sleep(0.02)  # the camera's packets
        part = slice(done, int(np.searchsorted(t_us, time.monotonic_ns() // 1000)))
        trial.push("events", t_us[part], *(each[part] for each in pixels))
        done = part.stop


@pytest.mark.programs
def test_label_train_evaluate_and_report_run_on_marked_trials(tmp_path: Path) -> None:
    (tmp_path / "analysis.yaml").write_text(ANALYSIS)
    streams = [sliplab.push("events", events_px=EVENTS_PX)]
    with sliplab.record(
        streams, tmp_path / "store", "marked", analysis=tmp_path / "analysis.yaml"
    ) as recording:
        for seed in range(8):
            with recording.trial(object=("mug", "can")[seed % 2]) as trial:
                push_slip(trial, seed)
    store = sliplab.open_store(tmp_path / "store")
    assert store.label()["done"] == 8
    begin_ns = store.trial(trial.id).recording.record.imported.span_ns[0]
    assert store.trial(trial.id).onsets().incipient_ns == begin_ns + round(SLIP_S * 1e9)
    assert store.train()["done"] == 1
    found = store.evaluate()
    assert found
    page = store.report()
    assert "marked" in page.read_text()
