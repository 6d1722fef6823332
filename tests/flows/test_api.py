"""`import sliplab`: what it gives is what the store holds, and what it refuses it names."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import sliplab
from sliplab.flows.collecting.requests import CampaignStopped
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.store import Store as TrialStore
from tests.flows.older import older_store

FIRST = "depth=2.4mm,direction=0deg,speed=1.6mmps,r=1"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four labelled slides and a network; nothing here changes them."""
    return older_store(tmp_path_factory.mktemp("api") / "store")


@pytest.fixture(scope="module")
def store(folder: Path) -> sliplab.Store:
    return sliplab.open_store(folder)


def test_importing_it_loads_no_library() -> None:
    code = (
        "import sys, sliplab; "
        "heavy = {'numpy', 'pandas', 'torch', 'prefect', 'pydantic', 'cv2', 'h5py', 'typer'}; "
        "print(sorted(heavy & set(sys.modules)), sliplab.__version__)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["[]", "0.1.0"]


def test_every_name_is_there_and_others_are_not() -> None:
    assert {name for name in sliplab.__all__ if getattr(sliplab, name, None) is None} == set()
    assert dir(sliplab) == sorted(sliplab.__all__)
    assert sliplab.CampaignStopped is CampaignStopped
    with pytest.raises(AttributeError, match="has no attribute 'opne_store'"):
        sliplab.opne_store  # type: ignore[attr-defined]  # noqa: B018


def test_the_table_has_units_and_is_filtered(store: sliplab.Store) -> None:
    assert store.campaigns == ["small"]
    table = store.trials("direction_deg >= 180")
    assert sorted(table["direction_deg"]) == [180.0, 270.0]
    assert [trial.id for trial in store] == sorted(store.trials()["trial"])
    with pytest.raises(ValueError, match="the columns are campaign, trial"):
        store.trials("depht > 1")


def test_a_trials_arrays_share_one_time_line(store: sliplab.Store, folder: Path) -> None:
    trial = store.trial(FIRST)
    stored = TrialStore.open(folder).campaign("small").recording(FIRST)
    events, poses = trial.events(), trial.poses()
    raw = stored.events()
    assert len(events) == len(events.t_ns) == stored.record.counts.events
    assert (events.t_ns == stored.clock("events").to_reference(raw.t_us * 1000)).all()
    assert (np.diff(events.t_ns) >= 0).all()
    assert set(np.unique(events.p)) == {0, 1}
    assert poses.xyz_mm.shape == poses.rotvec_deg.shape == (len(poses), 3)
    assert (np.diff(trial.pulses()) > 0).all()
    # the arm slides while frames are taken: 5 mm along x at 1.6 mm/s
    start, end = trial.step("slide")
    assert (end - start) / 1e9 == pytest.approx(5 / 1.6, abs=0.05)
    moving = (poses.t_ns >= start) & (poses.t_ns <= end)
    travelled = np.ptp(poses.xyz_mm[moving], axis=0)
    assert travelled.max() == pytest.approx(5, abs=0.05)
    times = trial.frame_times()
    assert ((times > start) & (times < end)).sum() == pytest.approx((end - start) / 1e7, abs=2)


def test_a_stretch_of_events_is_cut_from_them(store: sliplab.Store) -> None:
    trial = store.trial(FIRST)
    whole = trial.events()
    start, end = 1_000_000_000, 1_030_000_000
    part = trial.events(start, end)
    inside = (whole.t_ns >= start) & (whole.t_ns < end)
    assert 0 < len(part) < len(whole)
    for name in ("t_ns", "x", "y", "p"):
        assert (getattr(part, name) == getattr(whole, name)[inside]).all()


def test_onsets_are_those_of_the_label(store: sliplab.Store) -> None:
    trial = store.trial(FIRST)
    assert trial.simulated
    onsets = trial.onsets()
    assert (onsets.incipient_ns, onsets.gross_ns) == (651002014, 3410998537)
    times, displacement = trial.displacements()
    assert displacement.shape == (len(times), 19)
    # 2 px is slip: the first frame in which any marker is that far is the onset's
    slipped = (displacement > 2).any(axis=1)
    assert times[slipped.argmax()] == onsets.incipient_ns


def test_a_network_counts_as_the_evaluation_did(store: sliplab.Store, folder: Path) -> None:
    (path,) = store.models()
    model = sliplab.load_model(path)
    kept = Derived.of(TrialStore.open(folder), "counts", "small")
    judged = [trial for trial in store if kept.key(trial.id) is not None]
    assert judged
    for trial in judged:
        found, before = model.counts(trial), kept.arrays(trial.id)
        assert (found.counts == before["counts"]).all()
        assert (found.end_ns == before["end_ns"]).all()
        # clocks differ by microseconds, so an event may fall into the window beside
        again = model.counts_of(trial.events(), found.end_ns - 30_000_000)
        assert again.shape == found.counts.shape
        assert np.abs(again - found.counts).sum() <= 0.01 * found.counts.sum()
    events = judged[0].events()
    backwards = sliplab.Events(events.t_ns[::-1], events.x, events.y, events.p)
    with pytest.raises(ValueError, match="not sorted"):
        model.counts_of(backwards, np.array([0]))


def test_a_step_runs_what_is_missing_only(folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder, tmp_path / "store")
    mine = sliplab.open_store(tmp_path / "store")
    assert mine.label()["done"] == 0
    shutil.rmtree(mine.folder / "derived" / "labels")
    with pytest.raises(sliplab.StoreError, match="has no label yet"):
        mine.trial(FIRST).onsets()
    with pytest.raises(sliplab.StoreError, match="has no label yet"):
        mine.trial(FIRST).displacements()
    assert mine.label(["small"])["done"] == 4
    assert mine.summary()["simulated"] is True


def test_what_is_not_there_is_named(store: sliplab.Store, tmp_path: Path) -> None:
    with pytest.raises(sliplab.StoreError, match="nothing: is no committed trial of"):
        store.trial("nothing")
    with pytest.raises(sliplab.StoreError, match="has no video; its camera provided tracks"):
        store.trial(FIRST).frame(0)
    with pytest.raises(sliplab.StoreError, match="is not a store"):
        sliplab.open_store(tmp_path)
    with pytest.raises(sliplab.InputError, match="no built-in protocol"):
        sliplab.plan("nothing")
    with pytest.raises(sliplab.InputError, match="must be 1 or more"):
        sliplab.collect("pilot", "rehearsal", tmp_path / "new", trials=0)
    assert not (tmp_path / "new").exists()


def test_a_plan_as_a_table(store: sliplab.Store) -> None:
    plan = sliplab.plan("pilot")
    assert repr(plan) == "<Plan pilot: 36 trials, 0.18 h of motion>"
    table = plan.table()
    assert list(table["trial"]) == [trial.id for trial in plan]
    assert sorted(table["depth_mm"].unique()) == [2.4, 2.8, 3.4]
    assert table["motion_s"].sum() == pytest.approx(plan.total_seconds)
