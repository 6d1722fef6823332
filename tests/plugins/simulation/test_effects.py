"""Whole-trial effects that a fitted scene lacks, on a simulated rig: against closed forms."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import yaml

from sliplab.plugins.simulation.devices import MockDevices, build_mock
from sliplab.plugins.simulation.path import TOOL, TrueSurface
from sliplab.plugins.simulation.settings import MockSettings, skin_of
from sliplab.protocols import InputError
from sliplab.protocols.yaml_file import parse_yaml, validate
from sliplab.rigs.core.capabilities import Segment
from sliplab.rigs.rig_file import RigFile
from tests.conftest import ROOT
from tests.plugins.simulation.driving import SMALL, Trial, go, gravity, same, slide, with_faults
from tests.protocols.planning import rows

EFFECTS: list[dict[str, Any]] = [
    {"kind": "papilla_sticky", "papilla": 9},
    {"kind": "papilla_torn", "papilla": 9, "since": "trial", "at_s": 0},
    {"kind": "plate_spot", "centre_mm": (9.0, 4.0), "radius_mm": 4.0},
    {"kind": "mains_light", "share": 0.08},
    {"kind": "arm_ramp", "mm_s2": 20.0},
]
MU, DEPTH, SPEED = 0.85, 2.6, 2.0


def plain(*faults: dict[str, Any]) -> MockDevices:
    """A rig whose tips obey u = mu N / k to the letter, and whose devices are exact."""
    data = SMALL.model_dump()
    data["scene"]["level"] = "L1"
    data["scene"]["friction"] |= {"path_variation": 0.0, "papilla_scatter": 0.0}
    data["arm"] |= {"vibration_um": 0.0, "pose_noise_um": 0.0}
    data["clocks"] |= {"sync_box_ppm": 0.0, "arm_ppm": 0.0}
    data["frame_camera"]["level"] = "tracks"
    return build_mock(MockSettings.model_validate({**data, "faults": list(faults)}))


def slip_mm(trial: Trial) -> np.ndarray:
    """How far the sensor had moved when each tip began to slip; NaN: it did not."""
    slips = np.array(trial.truth["slip_per_papilla_ns"], float)  # None becomes NaN
    return SPEED * (slips - trial.truth["reference_ns"]) * 1e-9


def hooke_mm(devices: MockDevices, friction: float = MU) -> np.ndarray:
    """u = mu N / k of each tip."""
    skin = devices.world.skin
    normal = skin.normal_n_per_mm * np.maximum(DEPTH - skin.gap_mm, 0.0)
    result: np.ndarray = friction * normal / skin.tangential_n_per_mm
    return result


@pytest.fixture(scope="module")
def sound() -> Trial:
    return slide(build_mock(SMALL), seed=11)


@pytest.mark.quick(2)
@pytest.mark.parametrize("fault", EFFECTS, ids=lambda fault: str(fault["kind"]))
def test_an_effect_is_the_same_in_any_pieces_and_in_its_trial_only(
    fault: dict[str, Any], sound: Trial
) -> None:
    devices = with_faults({**fault, "trial": 1})
    whole = slide(devices, seed=11)
    same(slide(devices, seed=11), sound)
    devices = with_faults(fault)
    slide(devices, seed=12)
    same(slide(devices, seed=11, chunk_s=0.0331), whole)
    with pytest.raises(AssertionError):
        same(whole, sound)


# -- papillae ------------------------------------------------------------------------------


def test_a_sticky_papilla_slips_later_by_its_factor_and_no_other_does() -> None:
    devices = plain({"kind": "papilla_sticky", "papilla": 9})
    expected = hooke_mm(devices)
    expected[9] *= 1.6
    found = slip_mm(slide(devices, seed=11))
    slipped = expected < 3.9
    assert slipped.sum() > 12
    assert found[slipped] == pytest.approx(expected[slipped], rel=1e-6)


def test_a_tip_wears_by_the_path_that_it_slid_before() -> None:
    devices = plain({"kind": "skin_wear", "per_m": -50.0})
    new = hooke_mm(devices)
    slipped = new < 3.9
    first = slip_mm(slide(devices, seed=11))  # worn by nothing yet
    assert first[slipped] == pytest.approx(new[slipped], rel=1e-6)
    second = slip_mm(slide(devices, seed=12))
    slid_mm = devices.world.slid_mm
    # a tip lags behind by u, so it slid the rest of the 4 mm; and a little as it was lifted
    assert np.all(slid_mm[slipped] > 4.0 - new[slipped] - 1e-3)
    worn = new * np.exp(-50.0 * 1e-3 * slid_mm)
    assert second[slipped] == pytest.approx(worn[slipped], rel=1e-6)


def test_sticky_papillae_multiply() -> None:
    sticky = {"kind": "papilla_sticky", "papilla": 9}
    devices = plain({**sticky, "factor": 0.5}, {**sticky, "factor": 3.0})
    expected = 1.5 * hooke_mm(devices)[9]
    assert slip_mm(slide(devices, seed=11))[9] == pytest.approx(expected, rel=1e-6)


def test_a_papilla_torn_from_the_begin_of_every_trial() -> None:
    devices = plain({"kind": "papilla_torn", "papilla": 9, "since": "trial", "at_s": 0})
    clean = plain()
    for seed in (11, 12):
        torn, whole = slide(devices, seed=seed), slide(clean, seed=seed)
        # also in the hold, before anything slides
        loads = devices.world.physics.tips.normal
        assert loads[9] == 0.0
        assert np.count_nonzero(loads) == 18
        assert np.all(np.isnan(torn.frames["markers_px"][:, 9]))
        others = [i for i in range(19) if i != 9]
        markers = [trial.frames["markers_px"][:, others] for trial in (torn, whole)]
        assert np.array_equal(*markers)
        for key in ("per_papilla_ns", "slip_per_papilla_ns"):
            assert torn.truth[key][9] is None
            assert [torn.truth[key][i] for i in others] == [whole.truth[key][i] for i in others]


# -- the plate -----------------------------------------------------------------------------


def test_tips_on_a_spot_slip_earlier_by_its_factor() -> None:
    devices = plain({"kind": "plate_spot", "centre_mm": (11.2, 0.0), "radius_mm": 3.0})
    on = np.hypot(*(devices.world.skin.layout_mm - [11.2, 0.0]).T) < 3.0
    assert np.flatnonzero(on).tolist() == [7]
    expected = np.where(on, 0.6, 1.0) * hooke_mm(devices)
    found = slip_mm(slide(devices, seed=11))
    # the others of the outer ring slip where they stand, beside the spot
    outer = devices.world.skin.ring == 2
    assert found[outer] == pytest.approx(expected[outer], rel=1e-6)


def test_a_falling_plate_has_a_spot() -> None:
    spot = {"kind": "plate_spot", "centre_mm": (0.0, 0.0), "radius_mm": 40.0, "factor": 0.9}
    data = SMALL.model_dump()
    data["scene"]["friction"]["kinetic"] *= 0.9
    found = gravity(with_faults(spot), 5)
    expected = gravity(build_mock(MockSettings.model_validate(data)), 5)
    assert found["gross_ns"] == pytest.approx(expected["gross_ns"], abs=1000)
    assert found["gross_ns"] < gravity(build_mock(SMALL), 5)["gross_ns"] - 50_000_000


def test_a_plate_tilted_against_what_was_taught_presses_one_side_deeper() -> None:
    """As docs/faults.md says how to make one: 1 degree more than `calibration.contact_plane`."""
    settings = MockSettings.model_validate({"scene": {"contact": {"tilt_deg": 1.4}}})
    taught = TrueSurface.from_settings(MockSettings().scene.contact)
    plane = TrueSurface.from_settings(settings.scene.contact)
    sensor = plane.sensor(taught.pose(0.0, 0.0, 2.6))
    assert math.hypot(sensor[3], sensor[4]) == pytest.approx(math.sin(math.radians(1.0)), rel=1e-9)
    layout = skin_of(settings).layout_mm
    deeper = layout @ sensor[3:5]
    # 11.2 mm from the middle on either side
    assert np.ptp(deeper) == pytest.approx(2 * 11.2 * math.sin(math.radians(1.0)), rel=0.05)


# -- the light -----------------------------------------------------------------------------


@pytest.mark.long
def test_a_light_on_the_mains_is_seen_by_pixels_with_low_thresholds() -> None:
    share = 0.08
    swing = math.log((1 + share) / (1 - share))
    devices = with_faults({"kind": "mains_light", "share": share})
    trial, steady = slide(devices, seed=11), slide(build_mock(SMALL), seed=11)
    seconds = (trial.events["t_us"][-1] - trial.events["t_us"][0]) * 1e-6
    threshold = devices.events._sensor.threshold
    expected = np.sum(np.maximum(swing / threshold - 1.0, 0.0)) * 2 * 100.0 * seconds
    more = len(trial.events["t_us"]) - len(steady.events["t_us"])
    assert more == pytest.approx(expected, rel=0.05)
    # nothing but the events knows of it
    for stream in ("frames", "poses"):
        for name, column in getattr(steady, stream).items():
            assert np.array_equal(getattr(trial, stream)[name], column)
    assert trial.truth == steady.truth
    later = slide(with_faults({"kind": "mains_light", "share": share, "at_s": 1.0}), seed=11)
    before = np.searchsorted(steady.events["t_us"], steady.events["t_us"][0] + 990_000)
    assert np.array_equal(later.events["t_us"][:before], steady.events["t_us"][:before])
    assert len(steady.events["t_us"]) + 0.4 * more < len(later.events["t_us"])


# -- the arm -------------------------------------------------------------------------------


def test_an_arm_with_a_ramp_moves_and_reports_as_it_accelerates() -> None:
    acceleration, length = 1.0, 6.0
    devices = plain({"kind": "arm_ramp"})
    arm, world = devices.arm, devices.world
    arm.connect()
    devices.begin_trial(1)
    go(devices, 0, 0, -2, 50.0, 0.05, lambda: None)
    # clear of the plate it starts and stops at once
    assert world.path.legs[-1].end_ns == pytest.approx(58.0 / 50.0 * 1e9, abs=2)
    pressed_ns = world.now_ns
    go(devices, 0, 0, 2.6, 2.0, 0.05, lambda: None)
    begin_ns, end_ns = world.path.legs[-1].start_ns, world.path.legs[-1].end_ns
    assert begin_ns == pressed_ns
    assert (end_ns - begin_ns) * 1e-9 == pytest.approx(4.6 / 2.0 + 2.0, abs=1e-8)
    arm.read_poses()
    begin_ns = world.now_ns
    (leg,) = world.start_arm([Segment(world.plane.pose(length, 0, 2.6), SPEED)])
    devices.clock.wait(5.5)
    # v^2 / 2 a on either side, and full speed in between: D / v + v / a
    assert (leg.end_ns - leg.start_ns) * 1e-9 == pytest.approx(length / SPEED + SPEED, abs=1e-8)
    poses = arm.read_poses()
    seconds = (poses.t_ns - world.clocks.arm.to_reference(begin_ns)) * 1e-9
    place = (poses.xyz_mm - world.plane.pose(0, 0, 2.6).xyz_mm) @ world.plane.rotation[:, 0]

    def expected(t: float) -> float:
        ramp_s, ramp_mm = SPEED / acceleration, SPEED**2 / (2 * acceleration)
        whole_s = length / SPEED + ramp_s
        if t < ramp_s:
            return 0.5 * acceleration * max(t, 0.0) ** 2
        if t > whole_s - ramp_s:
            return length - 0.5 * acceleration * max(whole_s - t, 0.0) ** 2
        return ramp_mm + SPEED * (t - ramp_s)

    assert len(place) > 2700
    assert place == pytest.approx([expected(t) for t in seconds.tolist()], abs=1e-6)
    # the skin is where the poses say
    t_ns = np.arange(begin_ns, begin_ns + 5_500_000_000, 7_000_000)
    true_mm = world.path.states(t_ns, TOOL)[:, :3] - world.plane.pose(0, 0, 2.6).xyz_mm
    along = (true_mm @ world.plane.rotation)[:, 0]
    ways = [expected(t) for t in ((t_ns - begin_ns) * 1e-9).tolist()]
    assert along == pytest.approx(ways, abs=1e-6)


def test_a_short_move_never_gets_to_its_speed() -> None:
    devices = plain({"kind": "arm_ramp", "mm_s2": 4.0})
    devices.arm.connect()
    devices.begin_trial(1)
    go(devices, 0, 0, 2.6, 50.0, 0.05, lambda: None)
    (leg,) = devices.world.start_arm([Segment(devices.world.plane.pose(1.0, 0, 2.6), 50.0)])
    assert (leg.end_ns - leg.start_ns) * 1e-9 == pytest.approx(2 * math.sqrt(1.0 / 4.0), abs=1e-8)
    devices.clock.wait(0.3)
    devices.arm.stop()
    here = devices.world.plane.sensor(devices.arm.pose())[0]
    # it was still speeding up, and stops at once where it is
    assert here == pytest.approx(0.5 * 4.0 * 0.3**2, abs=1e-6)
    devices.clock.wait(1.0)
    assert devices.world.plane.sensor(devices.arm.pose())[0] == here


# -- how they are written ------------------------------------------------------------------


# faults | settings of the event camera | its key | what is said
WRONG = """
    kind: papilla_sticky | | [0].papilla | is missing
    kind: papilla_sticky, papilla: 19 | | [0].papilla | from 0 (the centre)
    kind: papilla_sticky, papilla: 1, factor: 0 | | [0].factor | than 0
    kind: papilla_sticky, papilla: 1, at_s: 1 | | [0].at_s | unknown key
    kind: plate_spot, radius_mm: 1 | | [0].centre_mm | is missing
    kind: plate_spot, centre_mm: [0, 0], radius_mm: 0 | | [0].radius_mm | than 0
    kind: mains_light, share: 0.6 | | [0].share | 0.5
    kind: mains_light, hz: 0 | | [0].hz | 10
    kind: mains_light}, {kind: mains_light, trial: 3 | | [1].kind | once only for a trial
    kind: mains_light | cutoff_hz: 200 | [0].kind | cutoff_hz = 0
    kind: arm_ramp, mm_s2: 0 | | [0].mm_s2 | 0.01
    kind: arm_ramp}, {kind: arm_ramp | | [1].kind | once only for a trial
"""


@pytest.mark.parametrize(("faults", "camera", "key", "said"), rows(WRONG))
def test_an_impossible_effect_is_said_as_any_wrong_input(
    faults: str, camera: str, key: str, said: str
) -> None:
    data = parse_yaml((ROOT / "rigs" / "mock.yaml").read_text(), "mock.yaml")
    data["mock"] |= yaml.safe_load(f"{{faults: [{{{faults}}}], event_camera: {{{camera}}}}}")
    with pytest.raises(InputError) as caught:
        validate(RigFile, data, "mock.yaml")
    assert caught.value.key == f"mock.faults{key}"
    assert said in caught.value.expected


def test_effects_of_different_trials_may_differ() -> None:
    light = {"kind": "mains_light", "since": "trial"}
    lights = [{**light, "trial": n, "share": 0.05 * n} for n in (1, 2)]
    devices = with_faults(*lights, {"kind": "arm_ramp"})
    assert devices.world.faults.flicker() is None
    for n in (1, 2):
        devices.begin_trial(5)
        assert devices.world.faults.flicker() == (0.05 * n, 100.0, 0)
        assert devices.world.path.ramp_mm_s2 == 1.0
