"""`sliplab calibrate gap`: networks of simulated rigs on the test trials of a labelled store."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from jsonschema import Draft7Validator

from sliplab.analysis.campaigns import collected
from sliplab.analysis.study import Finding
from sliplab.flows.judge_network import judge_model
from sliplab.flows.planning.json_schemas import file_schema
from sliplab.flows.planning.run_request import RunRequest
from sliplab.flows.study import StudyOutcome
from sliplab.plugins.simulation.settings import scene_of
from sliplab.plugins.twin.document import TwinGap
from sliplab.plugins.twin.drawn_rigs import read_samples, samples_file, write_samples
from sliplab.plugins.twin.gap import flow as gap
from sliplab.plugins.twin.gap.study import STUDY
from sliplab.plugins.twin.posterior import ParameterPosterior, Posterior
from sliplab.plugins.twin.worlds import touch_depth_mm
from sliplab.protocols import InputError
from sliplab.rigs.rig_file import load_rig_file
from sliplab.storage.errors import StoreError
from sliplab.storage.files import read_json
from sliplab.storage.trials.store import TrialStore
from tests.command_line import here
from tests.flows.conftest import tiny, tiny_gravity, write

pytestmark = pytest.mark.long

FRICTION, NOISE = "scene.friction.kinetic", "event_camera.noise_hz"
SAMPLES = np.array([[0.7, 0.02], [0.8, 0.03]])
DRAWN = len(SAMPLES)


def twin_file(path: Path, extends: str = "rehearsal") -> Path:
    """A twin of another friction, and two samples of its posterior."""
    low, high = 2.4, 3.4
    record = {
        "campaign": "pilot",
        "checksum": "c",
        "trials": 30,
        "simulated": True,
        "fitted": "2026-11-26",
        "method": "by hand",
        "depth_mm": {"least": low, "most": high},
        "speed_mm_s": {"least": low, "most": high},
        "parameters": {},
    }
    data = {
        "extends": extends,
        "name": path.stem,
        "twin": record,
        "mock": {"scene": {"friction": {"kinetic": 0.75}}},
    }
    names = tuple(
        ParameterPosterior(key, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, False, ())
        for key in (FRICTION, NOISE)
    )
    write_samples(samples_file(path), Posterior(names, np.log(SAMPLES)))
    return write(path, data)


@pytest.fixture(scope="module")
def store(
    ran: tuple[list[RunRequest], StudyOutcome], tmp_path_factory: pytest.TempPathFactory
) -> TrialStore:
    """A copy of the small study, which has a network of its own."""
    folder = tmp_path_factory.mktemp("gap") / "store"
    shutil.copytree(ran[0][0].store, folder)
    return TrialStore.open(folder)


@pytest.fixture(scope="module")
def wanted(store: TrialStore) -> gap.Gap:
    """What is asked for."""
    folder = store.folder.parent
    twin, protocol = twin_file(folder / "twin.yaml"), write(folder / "tiny.yaml", tiny())
    return gap.request(store, collected(store), twin, protocol, folder / "gap", DRAWN)


@pytest.fixture(scope="module")
def found(wanted: gap.Gap) -> TwinGap:
    """Measured after it had been stopped when the first network was trained."""
    train = gap.train

    def stopped(*arguments: Any) -> None:
        train(*arguments)
        raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gap, "train", stopped)
        with pytest.raises(KeyboardInterrupt):
            gap.measure_gap(wanted)
        before = made(wanted.out)
        assert {path.relative_to(wanted.out).parts[0] for path in before} == {"twin"}
        patch.setattr(gap, "train", train)
        measured = gap.measure_gap(wanted)
    STUDY.write(Finding(measured, wanted.out))
    assert before.items() <= made(wanted.out).items()
    return measured


def made(folder: Path) -> dict[Path, int]:
    """Networks and trials, and when they were written."""
    files = [*folder.glob("*/models/*.pt"), *folder.glob("*/campaigns/*/trials/*/*")]
    return {path: path.stat().st_mtime_ns for path in files}


def test_each_network_has_the_scores_of_its_evaluation(
    found: TwinGap, wanted: gap.Gap, store: TrialStore
) -> None:
    assert [it.trained_on for it in found.networks] == ["own", "twin", "drawn", "assumed"]
    own = found.networks[0]
    assert (own.behind, own.trials, own.rig) == (None, 4, "rehearsal")
    for it in found.networks:
        of = store.folder if it is own else wanted.out / it.trained_on
        said = judge_model(store, collected(store), of / "models/seed0.pt")
        assert it.windows.accuracy == said["accuracy"]
        assert it.windows.strict == said["interval"]
        assert it.experiments["kinematic"].latency_ms == said["latency_ms"]
        assert it.experiments["gravity"].lead_ms == said["lead_ms"]["gravity"]
        assert it.simulated
        if it.behind is not None:
            assert own.windows.accuracy.strict is not None
            assert it.windows.accuracy.strict is not None
            less = own.windows.accuracy.strict - it.windows.accuracy.strict
            assert it.behind.share == pytest.approx(less)


def test_trials_are_taken_on_the_rig_that_is_named(found: TwinGap, wanted: gap.Gap) -> None:
    training = {trial.id for trial in wanted.plan if trial.split != "test"}
    frictions, taken, touched = {}, {}, {}
    for it in found.networks[1:]:
        campaigns = collected(TrialStore.open(wanted.out / it.trained_on))
        assert it.rigs == len(campaigns)
        taken[it.trained_on] = [{trial.id for trial, _ in item.trials} for item in campaigns]
        rigs = [
            load_rig_file(item.campaign.folder / "rig.yaml", stored=True)[0] for item in campaigns
        ]
        frictions[it.trained_on] = [scene_of(rig).scene.friction for rig in rigs]
        touched[it.trained_on] = [rig.calibration.touch_depth for rig in rigs]
    assumed = scene_of(load_rig_file(Path("rehearsal"))[0]).scene.friction
    assert frictions["assumed"] == [assumed]
    assert [it.kinetic for it in frictions["twin"]] == [0.75]
    assert sorted(it.kinetic for it in frictions["drawn"]) == pytest.approx([0.7, 0.8])
    for number, depth in enumerate(touched["drawn"], 1):  # the surface is known here
        file = wanted.out / f"drawn-{number}.yaml"
        assert depth == pytest.approx(touch_depth_mm(load_rig_file(file)[0]), abs=0.001)
    assert taken["twin"] == taken["assumed"] == [training]
    assert set.union(*taken["drawn"]) == training
    assert sum(map(len, taken["drawn"])) == len(training)
    for values in read_samples(samples_file(wanted.fitted), 5):
        assert [values[FRICTION], values[NOISE]] in [pytest.approx(row) for row in SAMPLES]


def test_numbers_and_page_are_kept_and_nothing_is_made_again(
    found: TwinGap, wanted: gap.Gap, store: TrialStore
) -> None:
    written = read_json(wanted.out / "gap.json")
    assert TwinGap.load(wanted.out / "gap.json") == found
    Draft7Validator(file_schema("gap")).validate(written)
    before = made(wanted.out)
    done = here(
        "calibrate",
        "gap",
        store.folder,
        "--rig",
        wanted.rig,
        "--protocol",
        wanted.plan.file,
        "--out",
        wanted.out,
        "--worlds",
        DRAWN,
    )
    assert done.returncode == 0, done.stderr
    assert made(wanted.out) == before
    assert read_json(wanted.out / "gap.json") == written
    for text in (done.stdout, (wanted.out / "gap.html").read_text().replace("&#39;", "'")):
        assert "simulated test trials" in text or "tested on simulated trials" in text
        for word in ("rigs", "drawn", "twin's", "posterior", "(simulated)"):
            assert word in text  # cells of a table may be folded


def test_a_twin_that_was_fitted_again_is_asked_for_another_folder(
    found: TwinGap, wanted: gap.Gap, store: TrialStore, tmp_path: Path
) -> None:
    again = twin_file(tmp_path / "twin.yaml")
    again.write_text(again.read_text().replace("0.75", "0.76"))
    before = made(wanted.out)
    asked = gap.request(store, collected(store), again, Path(wanted.plan.file), wanted.out, DRAWN)
    with pytest.raises(StoreError, match=f"{wanted.out}: holds trials of another twin.*--out"):
        gap.requests(asked)
    assert made(wanted.out) == before


def test_what_cannot_be_compared_is_refused_before_anything_is_simulated(
    store: TrialStore, tmp_path: Path
) -> None:
    twin, out, campaigns = twin_file(tmp_path / "twin.yaml"), tmp_path / "gap", collected(store)
    protocol = write(tmp_path / "tiny.yaml", tiny())

    def refused(reason: str, rig: Path = twin, protocol: Path = protocol) -> None:
        with pytest.raises(InputError, match=reason):
            gap.request(store, campaigns, rig, protocol, out, DRAWN)

    refused("must be a twin", rig=Path("rehearsal"))
    bare = tmp_path / "bare.yaml"
    bare.write_text(twin.read_text())
    refused(r"bare\.npz.*fit it again", rig=bare)
    samples_file(bare).write_text("no array")
    refused(r"bare\.npz.*cannot be read", rig=bare)
    refused("must be kinematic", protocol=write(tmp_path / "gravity.yaml", tiny_gravity()))
    data = tiny()
    data["analysis"]["windows"]["length_ms"] = 40
    refused("must have the windows of the campaign 'tiny'", protocol=write(tmp_path / "w", data))
    data = tiny()
    data["analysis"]["split"] = {"method": "ranked", "train": 0.5, "validation": 0.0, "test": 0.5}
    refused("has no validation trials", protocol=write(tmp_path / "v", data))
    with pytest.raises(StoreError, match="no kinematic campaign"):
        gap.request(store, campaigns[1:], twin, protocol, out, DRAWN)
    assert not out.exists()
    # a file that extends a twin is one, and is compared with what the twin extends
    mine = write(tmp_path / "mine.yaml", {"extends": "twin.yaml", "name": "mine"})
    asked = gap.request(store, campaigns, mine, protocol, out, DRAWN)
    assert asked.fitted.name == "twin.yaml"
    assert asked.assumed.name == "rehearsal.yaml"
    assert yaml.safe_load(mine.read_text())["extends"] == "twin.yaml"
