"""`sliplab calibrate drift`: wear of a simulated skin is found, a steady one is called steady.

Where the method's own figures matter, worlds are simulated (long); the rest replaces what slides
show by simple functions, whose answer is known.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from subprocess import CompletedProcess
from typing import Any

import numpy as np
import pytest
import yaml
from jsonschema import Draft7Validator

import sliplab
from sliplab.analysis.campaigns import Collected, collected
from sliplab.flows.planning.json_schemas import file_schema
from sliplab.plugins.simulation.settings import scene_of
from sliplab.plugins.twin import worlds
from sliplab.plugins.twin.calibrate import fitted_rig
from sliplab.plugins.twin.drift import flow as drift
from sliplab.plugins.twin.drift.document import FRICTION, DriftFit
from sliplab.plugins.twin.parameters import value_of
from sliplab.plugins.twin.pilot import PilotTrial
from sliplab.plugins.twin.statistics import SlideStatistics
from sliplab.protocols import InputError
from sliplab.rigs.rig_file import load_rig_file
from sliplab.storage.files import read_json
from sliplab.storage.trials.store import IMPORTED, StoreError, TrialStore
from tests.command_line import here
from tests.conftest import ROOT
from tests.flows.conftest import tiny, write
from tests.plugins.twin.test_calibrate import everywhere
from tests.storage.formats.files import lab_hdf5


def with_references(every: int, distance: str) -> dict[str, Any]:
    """Six slides, and references between them."""
    data = tiny()
    data["name"] = "worn"
    data["collection"]["motion"][3]["distance"] = distance
    condition = {"depth": 2.4, "speed": 1.6, "direction": 0}
    data["collection"]["references"] = {"every": every, "condition": condition}
    return data


def rig_file(path: Path, **mock: Any) -> Path:
    scene = {"level": "L3"}
    path.write_text(
        yaml.safe_dump({"extends": "rehearsal", "name": "some", "mock": {"scene": scene, **mock}})
    )
    return path


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> TrialStore:
    """Twelve trials, half of them references, labelled."""
    folder = tmp_path_factory.mktemp("drift")
    protocol = write(folder / "p.yaml", with_references(1, "1 mm"))
    rig = rig_file(folder / "rig.yaml")
    sliplab.collect(str(protocol), rig=rig, store=folder / "store").label()
    return TrialStore(folder / "store")


@pytest.fixture
def worn(store: TrialStore, monkeypatch: pytest.MonkeyPatch) -> dict[str, float]:
    """Worlds show their parameters; references show friction that falls from one to the next.

    Returns:
        friction over the first reference's, by trial.
    """
    (item,) = collected(store, None)
    trials = [trial for trial, _ in item.trials if trial.role == "reference"]
    friction = {t.id: float(np.exp(-0.01 * (t.index - trials[0].index))) for t in trials}
    rig, _ = load_rig_file(Path("rehearsal"))
    prior = drift.OneSpecimen(rig, 0.5, 1, False)

    def of(values: dict[str, float], rng: np.random.Generator) -> SlideStatistics:
        noise = np.exp(1e-3 * rng.normal(size=len(values)))
        return SlideStatistics(
            dict(zip(values, np.array([*values.values()]) * noise, strict=True)), {}
        )

    def world(self: worlds.DrawnWorld) -> SlideStatistics:
        values = {it.key: value_of(scene_of(self.rig), it) for it in prior.parameters}
        return of(values, np.random.default_rng(self.seed))

    def reference(slides: Sequence[PilotTrial], *_: Any) -> SlideStatistics:
        values = {it.key: value_of(scene_of(rig), it) for it in prior.parameters}
        values[FRICTION] *= friction[slides[0].trial]
        return of(values, np.random.default_rng(int(1e6 * friction[slides[0].trial])))

    monkeypatch.setattr(worlds, "everywhere", everywhere)
    monkeypatch.setattr(worlds.DrawnWorld, "statistics", world)
    monkeypatch.setattr(drift, "statistics", reference)
    return friction


def calibrated(store: TrialStore, out: Path, *more: object) -> CompletedProcess[str]:
    """Run the command."""
    words = ("calibrate", "drift", store.folder, "--rig", "rehearsal", "--worlds", 100)
    return here(*words, "--out", out, *more)


def test_friction_that_falls_is_found_and_nothing_else(
    store: TrialStore, worn: dict[str, float], tmp_path: Path
) -> None:
    done = calibrated(store, tmp_path / "out", "--json", "--limit", 20)
    assert done.returncode == 0, done.stderr
    fit = DriftFit.load(tmp_path / "out" / "drift.json")
    assert [it.key for it in fit.parameters if it.changed] == [FRICTION]
    friction = fit.friction
    expected = 100.0 * (min(worn.values()) - 1.0)
    assert friction.change_low < expected < friction.change_high
    assert friction.change_percent == pytest.approx(expected, abs=0.5)
    assert friction.percent_per_100_trials == pytest.approx(100.0 * np.expm1(-1.0), abs=4.0)
    assert [one.trial for one in friction.references] == list(worn)
    assert "changed by" in done.stderr
    assert "at most 20 % is allowed: within" in done.stderr
    Draft7Validator(file_schema("drift")).validate(read_json(tmp_path / "out" / "drift.json"))
    page = (tmp_path / "out" / "drift.html").read_text()
    assert "kinetic friction" in page
    assert "simulated" in page
    assert "friction stands for friction over the stiffness" in " ".join(page.split())


@pytest.mark.long
def test_a_limit_that_is_exceeded_is_exit_1(
    store: TrialStore, worn: dict[str, float], tmp_path: Path
) -> None:
    done = calibrated(store, tmp_path, "--limit", 5)
    assert done.returncode == 1
    said = " ".join((done.stdout + done.stderr).split())
    assert "6 simulated reference trials; at most 5 % is allowed. The skin wears" in said
    assert "kinetic friction" in said
    assert "more than 5" in (tmp_path / "drift.html").read_text()


def fitted(folder: Path) -> None:
    rig, _ = load_rig_file(Path("rehearsal"))
    store = TrialStore(folder)
    (item,) = collected(store, None)
    drift.calibrate_drift(store, item, rig, worlds=100, spread=0.5, seed=1)


@pytest.mark.long
def test_a_campaign_without_references_to_fit_is_refused(tmp_path: Path) -> None:
    rig = rig_file(tmp_path / "rig.yaml")
    without = tiny()
    without["collection"]["motion"][3]["distance"] = "1 mm"
    sliplab.collect(
        str(write(tmp_path / "a.yaml", without)), rig=rig, store=tmp_path / "a", trials=1
    )
    with pytest.raises(StoreError, match="has 0 reference trials, and a trend takes 3"):
        fitted(tmp_path / "a")
    protocol = write(tmp_path / "b.yaml", with_references(2, "1 mm"))
    sliplab.collect(str(protocol), rig=rig, store=tmp_path / "b", trials=1)
    with pytest.raises(StoreError, match="has no label yet; run `sliplab label` first"):
        fitted(tmp_path / "b")
    with pytest.raises(InputError, match="must be a simulated rig with driver: mock"):
        fitted_rig(Path("ur5"))


def test_imported_campaigns_and_other_motions_have_no_drift(
    store: TrialStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lab_hdf5(tmp_path / "slide.h5")
    words = ["import", tmp_path / "slide.h5", "--store", tmp_path / "s", "--name", "theirs"]
    assert here(*words).returncode == 0
    with pytest.raises(StoreError, match="imported without an adapter"):
        fitted(tmp_path / "s")
    (item,) = collected(store, None)
    monkeypatch.setattr(drift, "read_slide", lambda *_: None)
    with pytest.raises(StoreError, match="is no straight slide"):
        drift.read_references(store, item)
    monkeypatch.setattr(Collected, "info", {IMPORTED: {}})
    with pytest.raises(InputError, match="was imported: it has no protocol"):
        drift.read_references(store, Collected(item.campaign))


def change(tmp_path: Path, seed: int, per_m: float, limit: float | None = None) -> DriftFit:
    """Drift of a simulated campaign of 54 slides of another skin than the one that is assumed."""
    data = yaml.safe_load((ROOT / "protocols" / "pilot.yaml").read_text())
    data["collection"]["references"] = {
        "every": 4,
        "condition": {"depth": 2.8, "speed": 1.6, "direction": 0},
    }
    faults = [{"kind": "skin_wear", "per_m": per_m}] if per_m else []
    tracks = {"scene": {"level": "L3"}, "frame_camera": {"level": "tracks"}}
    rig, base_file = tmp_path / "rig.yaml", tmp_path / "base.yaml"
    for path, more in ((rig, {"seed": seed, "faults": faults}), (base_file, {})):
        made = {"extends": "mock-force", "name": "some", "mock": {**tracks, **more}}
        path.write_text(yaml.safe_dump(made))
    store = tmp_path / "store"
    sliplab.collect(str(write(tmp_path / "p.yaml", data)), rig=rig, store=store).label()
    base, _ = load_rig_file(base_file)
    (item,) = collected(TrialStore(store), None)
    return drift.calibrate_drift(
        TrialStore(store), item, base, worlds=150, spread=0.5, seed=1, limit_percent=limit
    )


@pytest.mark.long
def test_wear_of_a_skin_is_found_in_its_size(tmp_path: Path) -> None:
    fit = change(tmp_path, 7, -0.5, 5.0)
    friction = fit.friction
    # 44 slides of 9 mm, in which a tip lags behind by some 3 mm: 0.26 m, and 0.24 m by the last
    # reference
    assert friction.identified
    assert friction.changed
    assert -16.0 < friction.change_percent < -8.0
    assert fit.beyond


@pytest.mark.long
def test_a_steady_skin_is_called_steady(tmp_path: Path) -> None:
    alarms = []
    for seed in (11, 12, 13):
        folder = tmp_path / str(seed)
        folder.mkdir()
        fit = change(folder, seed, 0.0)
        alarms += [it.key for it in fit.parameters if it.changed]
    # one of all parameters in 5 % of campaigns
    assert len(alarms) <= 1
