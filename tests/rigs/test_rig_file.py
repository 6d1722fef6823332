"""Rig files are checked as carefully as protocols."""

import re
from pathlib import Path
from typing import Any

import pytest
import yaml

from sliplab.flows.planning.run_request import make_request
from sliplab.protocols import InputError, load_plan
from sliplab.rigs.rig_file import check_plan, load_rig_file, same_rig
from tests.conftest import ROOT
from tests.protocols.planning import plan_of, put_all, rows

MOCK: str = (ROOT / "rigs" / "mock.yaml").read_text()
# changes of the mock rig | the key that is named, if it is another | what is said
CASES = """
    frame_camera.scael: 3 | | unknown key
    driver: abacus | | 'mock'
    limits.speed: 5 kg | | mm/s
    poll: 2 s | | at most 1 s
    poll: 0.000000001 s | | at least 1 ms
    limits.depth: 4 m | | write millimetres, such as 4 mm
    calibration.touch_depth: -3 mm | | must be from 0 mm to limits.depth = 4 mm
    calibration.touch_depth: 50 mm | | must be from 0 mm to limits.depth = 4 mm
    calibration.depth_zero: {zero: 6 mm, taught: 2026-11-29, residual: 0.01 mm, method: typed} \
| .zero | is farther from the taught plane than limits.depth = 4 mm: teach both
    calibration.depth_zero: {zero: -6 mm, taught: 2026-11-29, residual: 0.01 mm, method: typed} \
| .zero | is farther from the taught plane than limits.depth = 4 mm: teach both
    calibration.contact_plane.centre: [a, 0 mm, 0 mm] | [0] | number with a unit
    calibration.contact_plane.above: [399 mm, 120 mm, 300 mm] | ^calibration | one line
    mock: {event_camera: {noise_hz: -1}} | .event_camera.noise_hz | greater than or equal to 0
    mock: {event_camera: {readout_hz: 5}} | .event_camera.readout_hz | must be 0 (no scans), \
or 1000 to 10000
    frame_camera.scale_px_per_mm: 12 | | must be mock.frame_camera.px_per_mm = 20
    mock: {clocks: {arm_ppm: 4000}} | .clocks.arm_ppm | must be at most \
timing.arm_controller.drift_ppm = 200
    timing: {sync_box: {drift_ppm: 5}} | ^mock.clocks.sync_box_ppm | must be at most \
timing.sync_box.drift_ppm = 5
    mock: {clocks: {pulse_jitter_us: 30}} | .clocks.pulse_jitter_us | must be at most \
timing.event_camera.jitter_us = 20
    timing: {frames: exposure line}; mock: {clocks: {exposure_jitter_us: 30}} \
| ^mock.clocks.exposure_jitter_us | must be at most timing.sync_box.jitter_us = 20
    timing: {frames: host arrival}; mock: {frame_camera: {arrival_jitter_us: 46001}} \
| ^mock.frame_camera.arrival_jitter_us | must be at most 46000: with latency_us, \
timing.frame_delay.longest_us = 50000
    timing: {arm: host time, pose_delay: {shortest_us: 1500, longest_us: 9000}} \
| ^mock.arm.latency_us | must be at least timing.pose_delay.shortest_us = 1500
    mock: {clocks: {read_longest_us: 100}} | .clocks.read_longest_us | must be at least \
read_shortest_us = 200
    timing: {code: morse} | .code | 'irregular'
    frame_camera.scale_px_per_mm: .inf | |
"""


def written(path: Path, data: Any) -> Path:
    path.write_text(data if isinstance(data, str) else yaml.safe_dump(data))
    return path


@pytest.mark.parametrize(("changes", "key", "says"), rows(CASES))
def test_the_message_names_key_and_cure(changes: str, key: str, says: str, tmp_path: Path) -> None:
    data = yaml.safe_load(MOCK)
    put_all(data, changes)
    path = written(tmp_path / "rig.yaml", data)
    with pytest.raises(InputError) as caught:
        load_rig_file(path)
    at = key[1:] if key.startswith("^") else changes.partition(":")[0] + key
    assert caught.value.key.startswith(at)
    assert str(path) in caught.value.message
    assert says in caught.value.message


def test_what_a_rig_does_not_use_is_not_held_against_it(tmp_path: Path) -> None:
    data = yaml.safe_load(MOCK)
    data["mock"] = {
        "clocks": {"exposure_jitter_us": 900, "arm_ppm": 19_000},
        "frame_camera": {"arrival_jitter_us": 900_000},
        "arm": {"latency_us": 100_000},
    }
    data["timing"] = {"arm_controller": {"drift_ppm": 20_000}}
    path = written(tmp_path / "rig.yaml", data)
    assert load_rig_file(path)[0].mock.clocks.arm_ppm == 19_000


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("spool: false", "spool: false, height_px: 400", "frame_camera.height_px = 400: .* 720 px"),
        ("depth: 4 mm", "depth: 3 mm", "needs 3.4 mm in its phase 'press'"),
    ],
)
def test_a_plan_beyond_the_rig_is_refused(old: str, new: str, says: str, tmp_path: Path) -> None:
    path = written(tmp_path / "rig.yaml", MOCK.replace(old, new))
    with pytest.raises(InputError, match=says):
        check_plan(load_rig_file(path)[0], load_plan(Path("pilot")), str(path))


@pytest.mark.parametrize(
    ("key", "value", "says"),
    [
        ("depth_mm", 3.2, "= 3.2: trial depth=3.4mm,.*pilot.yaml needs 3.4 mm .*phase 'press'"),
        ("high_mm", [4, 20, 3.8], "trial .* needs 4.5 mm in x of the plate frame"),
        ("low_mm", [-20, -20, -4], "trial .* needs -5 mm in z of the plate frame where it begins"),
        ("speed_mm_s", 9, "= 9.0: trial .* needs 20 mm/s in its phase 'approach'"),
        ("frame", "base", "needs 395 mm in x of the base frame where it begins"),
        (
            "plate",
            {"centre_mm": [0, 0, 0], "right_mm": [9, 0, 0], "above_mm": [8, 0, 0]},
            "one line",
        ),
    ],
)
def test_a_plan_beyond_the_arms_own_limits_is_refused(
    key: str, value: Any, says: str, tmp_path: Path
) -> None:
    data = yaml.safe_load((ROOT / "rigs" / "ur5.yaml").read_text())
    data["devices"]["arm"]["limits"][key] = value
    path = written(tmp_path / "rig.yaml", data)
    with pytest.raises(InputError) as caught:
        make_request(Path("pilot"), path, tmp_path / "store")
    assert re.search(f"rig.yaml: devices.arm.limits.*{says}", caught.value.message)


def test_a_turn_beyond_the_arms_own_limit_is_refused() -> None:
    says = r"limits.tilt_deg = 30.0: trial angle=-40deg,.* needs 40 deg in its phase 'twist'"
    with pytest.raises(InputError, match=says):
        check_plan(load_rig_file(Path("ur5"))[0], load_plan(Path("press_twist")), "ur5")


@pytest.mark.parametrize(("name", "driver"), [("mock", "mock"), ("ur5", "devices")])
def test_an_exposure_longer_than_a_tick_is_refused(name: str, driver: str, tmp_path: Path) -> None:
    data = yaml.safe_load((ROOT / "rigs" / f"{name}.yaml").read_text())
    camera = data[driver].setdefault("frame_camera", {})
    camera |= {"exposure_us": 20_000} | ({"rate_hz": 50} if driver == "devices" else {})
    path = written(tmp_path / "rig.yaml", data)
    says = rf"{driver}.frame_camera.exposure_us = 20000: must be at most 10000, the period of"
    with pytest.raises(InputError, match=says):
        check_plan(load_rig_file(path)[0], load_plan(Path("pilot")), str(path))


@pytest.mark.parametrize(
    ("section", "key", "value", "says"),
    [
        ("warm_up", "depth", "3.5 mm", "limits.depth = 3.4 mm: .* needs 3.5 mm in .*warm_up"),
        ("warm_up", "speed", "21 mm/s", "limits.speed = 20 mm/s: .* needs 21 mm/s in .*warm_up"),
        ("rezero", "search", "3.5 mm", "limits.depth = 3.4 mm: .* needs 3.5 mm in .*rezero"),
        ("rezero", "speed", "21 mm/s", "must be at most 1 mm/s"),
    ],
)
def test_maintenance_beyond_the_rig_is_refused(
    section: str, key: str, value: str, says: str, small: dict[str, Any], tmp_path: Path
) -> None:
    data = yaml.safe_load(MOCK.replace("depth: 4 mm", "depth: 3.4 mm"))
    data["limits"]["speed"] = "20 mm/s"
    path = written(tmp_path / "rig.yaml", data)
    rig, _ = load_rig_file(path)
    check_plan(rig, plan_of(small, tmp_path), str(path))
    small["collection"]["maintenance"][section][key] = value
    with pytest.raises(InputError, match=says):
        check_plan(rig, plan_of(small, tmp_path), str(path))


def test_a_default_that_is_written_out_is_the_same_rig() -> None:
    """A newer version has more keys: their defaults change no campaign, null elsewhere does."""
    data = yaml.safe_load(MOCK)
    data["mock"] = {**data.get("mock", {}), "gripper": None}
    assert same_rig(MOCK, yaml.safe_dump(data))
    stiff = {"base_normal_n_per_m": None}
    data["mock"]["scene"] = {**data["mock"].get("scene", {}), "skin": stiff}
    assert not same_rig(MOCK, yaml.safe_dump(data))


def test_a_skin_of_too_many_papillae_to_simulate_is_refused(tmp_path: Path) -> None:
    rings = ", ".join(["1"] + ["48"] * 416)
    path = tmp_path / "big.yaml"
    path.write_text(f"extends: mock\nmock: {{scene: {{skin: {{ring_counts: [{rings}]}}}}}}\n")
    with pytest.raises(InputError, match=r"ring_counts.*19,969 papillae; at most 1,000"):
        load_rig_file(path)
