"""The level of physics that a plan is given, and the slip that it is told to expect."""

from pathlib import Path

import numpy as np
import pytest

from sliplab import protocols
from sliplab.plugins.simulation.levels import (
    choose_level,
    expected_onsets,
    slides_of,
    slip_expected,
)
from sliplab.plugins.simulation.scene.onsets import Material
from sliplab.protocols.plan import Plan, load_plan
from sliplab.rigs.physics_levels import with_level
from sliplab.rigs.rig_file import RigFile, load_rig_file

FOLDER = Path(protocols.__file__).parent


def plan_of(name: str) -> Plan:
    return load_plan(FOLDER / f"{name}.yaml", ())


@pytest.fixture(scope="module")
def rig() -> RigFile:
    return load_rig_file(FOLDER.parent / "rigs" / "mock.yaml")[0]


def changed(rig: RigFile, **parts: dict) -> RigFile:
    """The rig with another scene."""
    scene = rig.mock.scene
    updates = {
        name: getattr(scene, name).model_copy(update=values) if isinstance(values, dict) else values
        for name, values in parts.items()
    }
    mock = rig.mock.model_copy(update={"scene": scene.model_copy(update=updates)})
    return rig.model_copy(update={"mock": mock})


def test_the_full_grid_has_36_slides(rig: RigFile) -> None:
    slides = slides_of(plan_of("kinematic"))
    assert len(slides) == 36
    assert {slide.settled_s for slide in slides} == {slides[0].settled_s}
    assert slides_of(plan_of("gravity")) == []


def test_the_default_scene_needs_everything(rig: RigFile) -> None:
    choice = choose_level(rig, plan_of("pilot"))
    assert choice.level == 3
    assert "two seeds" in choice.reason
    assert "simulated" in choice.reason
    assert choose_level(rig, plan_of("gravity")).level == 3


def test_a_scene_without_relaxation_needs_less(rig: RigFile) -> None:
    plain = changed(rig, skin={"relaxation_share": 0.0}, friction={"static_excess": 0.0})
    assert choose_level(plain, plan_of("pilot")).level == 2


def test_a_rough_scene_hides_even_large_deflection(rig: RigFile) -> None:
    rough = changed(
        rig,
        skin={"relaxation_share": 0.0, "base_normal_n_per_m": 40.0},
        friction={"static_excess": 0.0, "path_variation": 0.3},
    )
    assert choose_level(rough, plan_of("pilot")).level == 1


@pytest.mark.parametrize("friction", [{"creep_mm_s": 0.1}, {"least_mm_s": 1.0}])
def test_what_no_lower_level_has_is_not_left_out(rig: RigFile, friction: dict) -> None:
    rough = changed(
        rig,
        skin={"relaxation_share": 0.0, "base_normal_n_per_m": 40.0},
        friction={"static_excess": 0.0, "path_variation": 0.3, **friction},
    )
    assert choose_level(rough, plan_of("pilot")).level == 3


def test_what_the_rig_file_says_is_done(rig: RigFile) -> None:
    stated = changed(rig, level="L1")
    choice = choose_level(stated, plan_of("pilot"))
    assert (choice.level, "set by the rig file (mock.scene.level)" in choice.reason) == (1, True)
    assert with_level(rig, plan_of("pilot")).mock.scene.level == "L3"
    assert with_level(stated, plan_of("pilot")).mock.scene.level == "L1"


def test_the_expected_slip_is_that_of_the_closed_forms(rig: RigFile) -> None:
    plan = plan_of("kinematic")
    expected = slip_expected(rig, plan)
    onsets = expected_onsets(rig.mock, slides_of(plan), 3)
    assert expected["simulated"] is True
    assert expected["first_slip_s"] == [onsets[:, 0].min(), onsets[:, 0].max()]
    # long enough for 50 windows of 30 ms in every trial
    assert expected["incipient_s"][0] > 1.5
    assert slip_expected(rig, plan_of("gravity")) is None
    assert np.all(onsets[:, 1] > onsets[:, 0])
    assert Material(0.85).static_excess == 0.0
