"""A store with its model and rig file that SlipLab 0.1.0 made stays readable, with its figures."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from sliplab.rigs.rig_file import load_rig_file
from sliplab.storage.files import read_json
from sliplab.storage.trials.store import TrialStore
from tests.command_line import answer
from tests.flows.older import older_store


@pytest.fixture
def older(tmp_path: Path) -> Path:
    return older_store(tmp_path / "store")


def test_everything_in_it_is_sound(older: Path) -> None:
    assert answer("verify", older)["problems"] == []
    assert len(answer("trials", older)["trials"]) == 4


@pytest.mark.long
def test_what_is_derived_anew_is_what_it_was(older: Path) -> None:
    before = read_json(older / "report" / "summary.json")
    labels = {path.name: read_json(path) for path in older.glob("derived/labels/small/*.json")}
    assert len(labels) == 4
    shutil.rmtree(older / "derived")
    made = {step: answer(step, older)["done"] for step in ("sync", "label")}
    assert made == {"sync": 4, "label": 4}
    for name, label in labels.items():
        again = read_json(older / "derived" / "labels" / "small" / name)
        for onset in ("incipient_ns", "gross_ns"):
            # clock fits have changed since by less than they state
            assert again[onset] == pytest.approx(label[onset], abs=10_000)
        assert again["first_marker"] == label["first_marker"]
    for step in ("train", "evaluate", "report"):
        answer(step, older)
    after = read_json(older / "report" / "summary.json")
    assert after["kinematic"]["accuracy"] == before["kinematic"]["accuracy"]
    # onsets that move by microseconds may give one window of a phase to another event's count
    matrices = [np.array(each["kinematic"]["confusion"]) for each in (after, before)]
    assert (matrices[0].sum(axis=1) == matrices[1].sum(axis=1)).all()
    assert np.abs(matrices[0] - matrices[1]).sum() <= 2
    assert after["quality"] == before["quality"]
    assert after["simulated"] is True


def test_its_rig_file_describes_the_same_rig(older: Path) -> None:
    (campaign,) = TrialStore.open(older).campaigns()
    rig, _ = load_rig_file(campaign.folder / "rig.yaml")
    assert (rig.name, rig.simulated) == (campaign.info["rig"], True)
