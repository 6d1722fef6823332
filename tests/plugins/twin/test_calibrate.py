"""`sliplab calibrate scene` from a labelled store to a rig file, a page and its numbers.

Where the method's own figures matter, worlds are simulated (long); the rest replaces a world's
statistics by simple functions of its parameters, whose answer is known.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from jsonschema import Draft7Validator
from typer.testing import CliRunner

import sliplab
from sliplab.analysis.campaigns import Collected, collected
from sliplab.flows.cli.app import command_line
from sliplab.flows.planning.json_schemas import file_schema
from sliplab.flows.planning.preflight import check
from sliplab.plugins.simulation.scene_runs import changed
from sliplab.plugins.simulation.settings import scene_of
from sliplab.plugins.twin import calibrate, worlds
from sliplab.plugins.twin.camera_estimates import NOISE_TREND
from sliplab.plugins.twin.document import MisfitCheck, ParameterFit, TwinFit
from sliplab.plugins.twin.drawn_rigs import read_samples, samples_file
from sliplab.plugins.twin.misfits import CHECKS
from sliplab.plugins.twin.parameters import PARAMETERS, value_of
from sliplab.plugins.twin.pilot import pilot_trial, slide_of
from sliplab.plugins.twin.pilots import PilotSlides, read_pilot, simulate_pilot
from sliplab.plugins.twin.shown import SameTrials
from sliplab.plugins.twin.statistics import SlideStatistics
from sliplab.plugins.twin.study import STUDY, finding
from sliplab.protocols import InputError
from sliplab.rigs.rig_file import load_rig_file
from sliplab.storage.files import read_json
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.store import TrialStore

TRIALS = 12
EFFECTS = {check.key: 100.0 for check in CHECKS}
"""Numbers of the checks that no pilot of a clean rig reaches."""


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> TrialStore:
    """Some slides of the pilot, labelled."""
    folder = tmp_path_factory.mktemp("twin") / "store"
    rig = folder.with_name("rig.yaml")
    rig.write_text("extends: rehearsal\nname: full\nmock: {scene: {level: L3}}\n")
    sliplab.collect("pilot", rig=rig, store=folder, trials=TRIALS).label()
    return TrialStore(folder)


def requested(tmp_path: Path, **changes: Any) -> calibrate.FitRequest:
    wanted = {"worlds": 100, "spread": 0.5, "seed": 1} | changes
    return calibrate.request(Path("rehearsal"), tmp_path / "twin.yaml", **wanted)


def fitted(store: TrialStore, item: Collected, wanted: calibrate.FitRequest) -> TwinFit:
    """Fit a twin, and write all its files."""
    fit, trials = calibrate.calibrate_scene(store, item, wanted)
    STUDY.write(finding(wanted.out, fit, trials))
    return fit


def answering(
    wanted: calibrate.FitRequest, observed: dict[str, float], effects: Mapping[str, float]
) -> Callable[[worlds.DrawnWorld], SlideStatistics]:
    """Stand in for what a world shows: each statistic is the pilot's times one parameter's factor.

    Args:
        effects: numbers of the checks, of every world.
    """

    def shown(world: worlds.DrawnWorld) -> SlideStatistics:
        factors = [
            value_of(scene_of(world.rig), it) / value_of(scene_of(wanted.rig), it)
            for it in wanted.prior.parameters
        ]
        found = {
            name: value * factors[k % len(factors)]
            for k, (name, value) in enumerate(observed.items())
        }
        return SlideStatistics(found, dict(effects))

    return shown


def everywhere(title: str, work: Any, jobs: Sequence[Any], done: Any = None) -> list[Any]:
    """Do the work of several processes in this one."""
    found = [work(job) for job in jobs]
    for number, one in enumerate(found):
        if done is not None:
            done(number, one)
    return found


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Worlds are made in this process."""
    monkeypatch.setattr(worlds, "everywhere", everywhere)
    monkeypatch.setattr(calibrate, "everywhere", everywhere)
    monkeypatch.setattr(calibrate, "PREDICTED", 2)


def test_a_recorded_slide_and_a_simulated_one_are_the_same_arrays(store: TrialStore) -> None:
    (item,) = collected(store, None)
    trial, recording = item.trials[0]
    slide = slide_of(item.plan.program(trial))
    assert slide is not None
    places = Derived.of(store, "labels", item.name).arrays(trial.id)
    seen = pilot_trial(slide, recording, places)
    rig, _ = load_rig_file(item.campaign.folder / "rig.yaml", stored=True)
    made = simulate_pilot(rig, item.plan, [trial], 1)[0]
    assert seen.slide.depth_mm == made.slide.depth_mm == float(dict(trial.condition)["depth"])
    assert seen.hold_s == pytest.approx(made.hold_s, abs=2e-3)
    assert seen.slide_s == pytest.approx(made.slide_s, abs=2e-3)
    assert seen.tips_mm.shape[1:] == made.tips_mm.shape[1:] == (19, 2)
    held = [found.tips_mm[found.frame_s < 0.0].mean(axis=0) for found in (seen, made)]
    assert held[0] == pytest.approx(held[1], abs=0.04)  # each was pressed with its own tremor
    ends = [found.base_mm[-1] @ slide.direction for found in (seen, made)]
    assert ends == pytest.approx([9.0, 9.0], abs=0.05)
    assert seen.camera is not None
    assert made.camera is not None
    assert len(seen.camera.events) == pytest.approx(len(made.camera.events), rel=0.2)


@pytest.mark.long
def test_a_pilot_that_is_the_rigs_own_gives_the_rigs_own_values(
    store: TrialStore, tmp_path: Path, here: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    (item,) = collected(store, None)
    wanted = requested(tmp_path)
    pilot = read_pilot(store, item)
    assert len(pilot.fitted) + len(pilot.judged) == TRIALS
    assert all(trial.split == "test" for trial in pilot.judged)
    observed = pilot.statistics(worlds.guess_of(wanted.rig))
    finite = {name: value for name, value in observed.fitted.items() if value > 0.0}
    # what may be off either way is as in the pilot
    signed = {it.key: observed.effects[it.key] for it in CHECKS if it.signed}
    shown = answering(wanted, finite, EFFECTS | signed)
    monkeypatch.setattr(worlds.DrawnWorld, "statistics", shown)
    fit = fitted(store, item, wanted)
    known = [it for it in fit.parameters if it.identified]
    assert len(known) == len(wanted.prior.parameters)
    for it in known:
        # where a statistic is the parameter itself, the interval has no width
        assert it.low * 0.999 < it.assumed < it.high * 1.001, it.key
        assert it.value == pytest.approx(it.assumed, rel=0.05), it.key

    assert {check.stream for check in fit.checks} == {"frames", "events", "poses"}
    # and all that frames and events show; without forces
    assert len(fit.checks) == sum(it.stream != "force" for it in CHECKS) + 2
    assert not any(check.found for check in fit.checks)

    Draft7Validator(file_schema("twin")).validate(read_json(tmp_path / "twin.json"))
    page = (tmp_path / "twin.html").read_text()
    assert "of a simulated pilot" in page
    assert "kinetic friction" in page
    rig, _ = load_rig_file(tmp_path / "twin.yaml")
    assert rig.twin is not None
    assert rig.twin.checksum == fit.checksum
    assert rig.twin.trials == len(pilot.fitted)
    papillae = scene_of(rig).scene.skin.papillae
    assert papillae is not None
    assert len(papillae) == 19
    heights = np.array([it.height_mm for it in papillae])
    assert heights[0] == pytest.approx(10.1, abs=0.2)
    assert heights[1:7].mean() == pytest.approx(9.0, abs=0.1)
    samples = read_samples(samples_file(tmp_path / "twin.yaml"), 100)
    assert len(samples) == 100
    friction = next(it for it in fit.parameters if it.key == "scene.friction.kinetic")
    drawn = [one[friction.key] for one in samples]
    assert np.quantile(drawn, [0.025, 0.975]) == pytest.approx([friction.low, friction.high], 0.01)
    assert scene_of(rig).scene.friction.kinetic == pytest.approx(friction.value, rel=1e-4)
    said = {
        it.name: it.finding
        for it in check(Path("kinematic"), tmp_path / "twin.yaml", tmp_path / "other", ())
    }
    assert "the twin was fitted on" in said["twin"] or "within what" in said["twin"]


@pytest.mark.long
def test_no_interval_where_a_misfit_touches_its_parameter(
    store: TrialStore, tmp_path: Path, here: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    (item,) = collected(store, None)
    wanted = requested(tmp_path, seed=3)  # the store keeps the worlds of other tests' seeds
    pilot = read_pilot(store, item)
    observed = pilot.statistics(worlds.guess_of(wanted.rig))
    finite = {name: value for name, value in observed.fitted.items() if value > 0.0}
    signed = {it.key: observed.effects[it.key] for it in CHECKS if it.signed}
    # worlds in which noise hardly drifts, and the pilot's does
    shown = answering(wanted, finite, EFFECTS | signed | {NOISE_TREND: 0.1})
    monkeypatch.setattr(worlds.DrawnWorld, "statistics", shown)
    drifting = replace(observed, effects=observed.effects | {NOISE_TREND: 30.0})
    monkeypatch.setattr(PilotSlides, "statistics", lambda *_: drifting)
    fit = fitted(store, item, replace(wanted, needs=False))
    title = "noise of the event camera drifts during the pilot"
    assert [check.title for check in fit.checks if check.found] == [title]
    withheld = {it.key for it in fit.parameters if it.withheld}
    assert withheld == {
        "event_camera.noise_hz",
        "event_camera.leak_share",
        "event_camera.hot_pixels",
        "event_camera.hot_hz",
    }
    for it in fit.parameters:
        assert ((it.low, it.high) == (None, None)) == bool(it.withheld)
        assert it.withheld in ((), (title,))
    Draft7Validator(file_schema("twin")).validate(read_json(tmp_path / "twin.json"))
    assert f"withheld: {title}" in (tmp_path / "twin.html").read_text()
    rig, _ = load_rig_file(tmp_path / "twin.yaml")
    assert rig.twin is not None
    assert rig.twin.parameters["event_camera.noise_hz"].low is None
    assert rig.twin.parameters["event_camera.edge_px"].low is not None
    assert fit.gain_error is None  # without a force sensor


@pytest.mark.long
def test_what_is_not_told_keeps_the_rigs_value(
    store: TrialStore, tmp_path: Path, here: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    (item,) = collected(store, None)
    wanted = requested(tmp_path, seed=2)  # the store keeps the worlds of other tests' seed
    # one statistic, of the first parameter alone
    shown = answering(wanted, {"only": 2.0}, EFFECTS)
    monkeypatch.setattr(worlds.DrawnWorld, "statistics", shown)
    monkeypatch.setattr(
        PilotSlides,
        "statistics",
        lambda *_: SlideStatistics({"only": 2.0}, dict.fromkeys(EFFECTS, 100.0)),
    )
    fit = fitted(store, item, wanted)
    assert [it.key for it in fit.parameters if it.identified] == [PARAMETERS[0].key]
    for it in fit.parameters[1:]:
        assert it.value == it.assumed
        assert it.low < it.assumed < it.high
    rig, _ = load_rig_file(tmp_path / "twin.yaml")
    assert scene_of(rig).event_camera == scene_of(wanted.rig).event_camera
    assert "a force sensor" in (tmp_path / "twin.html").read_text()


def test_noise_of_tracking_is_the_pilots_own(store: TrialStore) -> None:
    (item,) = collected(store, None)
    pilot = read_pilot(store, item)
    own, _ = load_rig_file(Path("rehearsal"))
    assert calibrate.with_tracking_noise(own, pilot) == own
    quieter = changed(own, {"frame_camera": {"centroid_noise_px": 0.001}})
    found = scene_of(calibrate.with_tracking_noise(quieter, pilot)).frame_camera.centroid_noise_px
    assert found == pytest.approx(scene_of(own).frame_camera.centroid_noise_px, rel=0.15)


def test_a_misfit_ends_with_exit_code_1(
    store: TrialStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    line = MisfitCheck(
        title="light that flickers",
        stream="events",
        unit="times noise",
        pilot=40.0,
        limit=2.0,
        share=1e-6,
        found=True,
    )
    friction = ParameterFit(
        key="scene.friction.kinetic",
        title="kinetic friction",
        unit="",
        assumed=0.8,
        value=0.7,
        low=None,
        high=None,
        least=0.5,
        most=1.2,
        identified=True,
        withheld=(line.title,),
    )
    fit = TwinFit(
        simulated=True,
        campaign="pilot",
        rig="rehearsal",
        checksum="00",
        trials=9,
        judged=3,
        worlds=100,
        predicted=2,
        seconds=1.0,
        parameters=(friction,) * 9,
        statistics={},
        checks=(line,),
    )
    trials = SameTrials((), (), (), np.zeros(19), frozenset())
    monkeypatch.setattr(calibrate, "calibrate_scene", lambda *_: (fit, trials))
    asked = ["calibrate", "scene", str(store.folder), "--rig", "rehearsal"]
    asked += ["--out", str(tmp_path / "twin.yaml")]
    for json in ([], ["--json"]):
        done = CliRunner().invoke(command_line(), [*asked, *json])
        assert done.exit_code == 1
        assert "light that flickers" in done.stdout + done.stderr
    assert "light that flickers" in (tmp_path / "twin.html").read_text()
    assert TwinFit.load(tmp_path / "twin.json") == fit


@pytest.mark.long
def test_what_cannot_be_fitted_is_refused_before_anything_is_simulated(
    store: TrialStore, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match="must be a simulated rig with driver: mock"):
        calibrate.request(Path("ur5"), tmp_path / "twin.yaml", 100, 0.5, 1)
    with pytest.raises(InputError, match=r"must end in \.yaml"):
        calibrate.request(Path("rehearsal"), tmp_path / "twin.txt", 100, 0.5, 1)
    with pytest.raises(InputError, match="its folder does not exist"):
        calibrate.request(Path("rehearsal"), tmp_path / "no" / "twin.yaml", 100, 0.5, 1)
    other = tmp_path / "mine.yaml"
    other.write_text("extends: rehearsal\nname: mine\n")
    with pytest.raises(InputError, match="exists and is no twin"):
        calibrate.request(Path("rehearsal"), other, 100, 0.5, 1)
    with pytest.raises(InputError, match="is the rig file that is fitted"):
        calibrate.request(other, other, 100, 0.5, 1)
    for level, reason in (("L3", "has no label yet"), ("L1", "was simulated at level L1")):
        rig = tmp_path / f"{level}.yaml"
        rig.write_text(f"extends: rehearsal\nname: some\nmock: {{scene: {{level: {level}}}}}\n")
        folder = tmp_path / level
        sliplab.collect("pilot", rig=rig, store=folder, trials=1)
        said = CliRunner().invoke(
            command_line(),
            [
                "calibrate",
                "scene",
                str(folder),
                "--rig",
                "rehearsal",
                "--out",
                str(tmp_path / "twin.yaml"),
            ],
        )
        assert said.exit_code == 1
        assert reason in str(said.exception)
    assert not (tmp_path / "twin.yaml").exists()


@pytest.mark.long
def test_a_hidden_rig_is_found(tmp_path: Path) -> None:
    """Worlds are simulated: friction, relaxation and noise lie within their intervals."""
    hidden = tmp_path / "hidden.yaml"
    values = {
        "scene.friction.path_variation": 0.06,
        "scene.skin.relaxation_share": 0.24,
        "event_camera.noise_hz": 0.013,
        "event_camera.readout_hz": 4500.0,
    }
    hidden.write_text(
        "extends: rehearsal\nname: hidden\nmock:\n  seed: 77\n"
        "  scene: {level: L3, friction: {path_variation: 0.06}, skin: {relaxation_share: 0.24}}\n"
        "  event_camera: {noise_hz: 0.013, readout_hz: 4500}\n"
    )
    sliplab.collect("pilot", rig=hidden, store=tmp_path / "store").label()
    store = TrialStore(tmp_path / "store")
    (item,) = collected(store, None)
    fit = fitted(store, item, requested(tmp_path))
    found = {it.key: it for it in fit.parameters}
    for key, value in values.items():
        assert found[key].identified, key
        assert found[key].low * 0.98 < value < found[key].high * 1.02, key
