"""The example of a slip archive: simulated campaigns, and a data set in the layout of others."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import mlcroissant
import numpy as np
import pandas as pd
import pytest

from sliplab.storage.trials.store import TrialStore
from tests.command_line import here
from tests.conftest import ROOT


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:ConjunctiveGraph is deprecated")
@pytest.mark.filterwarnings("ignore:The inplace keyword in DataFrame.reset_index")
def test_simulated_campaigns_and_a_downloaded_set_become_one_archive(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    script = ROOT / "examples" / "slip_archive" / "make.py"
    spec = importlib.util.spec_from_file_location("slip_archive_example", script)
    assert spec is not None
    assert spec.loader is not None
    made = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(made)

    def run(*words: object) -> None:
        done = here(*words)
        assert done.returncode == 0, done.stderr

    monkeypatch.setattr(made, "run", run)
    downloaded, archive = tmp_path / "downloaded", tmp_path / "slips"
    counts = np.random.default_rng(1).poisson(0.2, (39, 2, 250)).astype(np.uint8)
    for name in ("train/sample_0_label_0", "train/sample_1_label_1", "test/sample_2_label_0"):
        path = downloaded / "Ev-Objects" / f"{name}.npy"
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, counts)
    monkeypatch.setattr(sys, "argv", [str(script), str(archive), str(downloaded), "--trials", "1"])
    made.main()

    onsets = pd.read_parquet(archive / "onsets.parquet")
    streams = pd.read_parquet(archive / "streams.parquet")
    trials = {c.name: len(c.committed()) for c in TrialStore.open(archive).campaigns()}
    assert trials == {"pilot": 1, "gravity": 1, "ev-objects": 3}
    # the downloaded set has classes, and no onsets
    assert set(onsets["campaign"]) == {"pilot", "gravity"}
    assert onsets["simulated"].all()
    assert set(streams["campaign"]) == set(trials)
    mlcroissant.Dataset(archive / "croissant.json")  # raises where the manifest is wrong
