"""Rig files are checked as carefully as protocols."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from sliplab.protocols import InputError, load_plan
from sliplab.rigs.rig_file import check_plan, load_rig_file, same_rig
from tests.conftest import ROOT

Change = Callable[[dict[str, Any]], None]
MOCK: str = (ROOT / "rigs" / "mock.yaml").read_text()


def _set(*path: str, to: Any) -> Change:
    def change(data: dict[str, Any]) -> None:
        for part in path[:-1]:
            data = data[part]
        data[path[-1]] = to

    return change


def _both(*changes: Change) -> Change:
    def change(data: dict[str, Any]) -> None:
        for each in changes:
            each(data)

    return change


CASES: dict[str, tuple[Change, str, str]] = {
    "unknown key": (_set("frame_camera", "scael", to=3), "frame_camera.scael", "unknown key"),
    "unknown driver": (_set("driver", to="abacus"), "driver", "'mock'"),
    "wrong unit": (_set("limits", "speed", to="5 kg"), "limits.speed", "mm/s"),
    "slow poll": (_set("poll", to="2 s"), "poll", "at most 1 s"),
    "no number": (
        _set("calibration", "contact_plane", "centre", to=["a", "0 mm", "0 mm"]),
        "calibration.contact_plane.centre[0]",
        "number with a unit",
    ),
    "points on a line": (
        _set("calibration", "contact_plane", "above", to=["399 mm", "120 mm", "300 mm"]),
        "calibration.contact_plane",
        "one line",
    ),
    "negative noise": (
        _set("mock", to={"event_camera": {"noise_hz": -1}}),
        "mock.event_camera.noise_hz",
        "greater than or equal to 0",
    ),
    "scans that are too few": (
        _set("mock", to={"event_camera": {"readout_hz": 5}}),
        "mock.event_camera.readout_hz",
        "must be 0 (no scans), or 1000 to 10000",
    ),
    "scale that is not drawn": (
        _set("frame_camera", "scale_px_per_mm", to=12),
        "frame_camera.scale_px_per_mm",
        "must be mock.frame_camera.px_per_mm = 20",
    ),
    "a clock that drifts more than promised": (
        _set("mock", to={"clocks": {"arm_ppm": 4000}}),
        "mock.clocks.arm_ppm",
        "must be at most timing.arm_controller.drift_ppm = 200",
    ),
    "a clock better promised than it is": (
        _set("timing", to={"sync_box": {"drift_ppm": 5}}),
        "mock.clocks.sync_box_ppm",
        "must be at most timing.sync_box.drift_ppm = 5",
    ),
    "stamps that scatter more than promised": (
        _set("mock", to={"clocks": {"pulse_jitter_us": 30}}),
        "mock.clocks.pulse_jitter_us",
        "must be at most timing.event_camera.jitter_us = 20",
    ),
    "edges that scatter more than promised": (
        _both(
            _set("timing", to={"frames": "exposure line"}),
            _set("mock", to={"clocks": {"exposure_jitter_us": 30}}),
        ),
        "mock.clocks.exposure_jitter_us",
        "must be at most timing.sync_box.jitter_us = 20",
    ),
    "frames that come too late": (
        _both(
            _set("timing", to={"frames": "host arrival"}),
            _set("mock", to={"frame_camera": {"arrival_jitter_us": 46_001}}),
        ),
        "mock.frame_camera.arrival_jitter_us",
        "must be at most 46000: with latency_us, timing.frame_delay.longest_us = 50000",
    ),
    "poses that come too soon": (
        _set(
            "timing",
            to={"arm": "host time", "pose_delay": {"shortest_us": 1500, "longest_us": 9000}},
        ),
        "mock.arm.latency_us",
        "must be at least timing.pose_delay.shortest_us = 1500",
    ),
    "answers that take less than questions": (
        _set("mock", to={"clocks": {"read_longest_us": 100}}),
        "mock.clocks.read_longest_us",
        "must be at least read_shortest_us = 200",
    ),
    "a code that is none": (_set("timing", to={"code": "morse"}), "timing.code", "'irregular'"),
    "infinite scale": (
        _set("frame_camera", "scale_px_per_mm", to=float("inf")),
        "frame_camera.scale_px_per_mm",
        "",
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_the_message_names_key_and_cure(case: str, tmp_path: Path) -> None:
    change, key, says = CASES[case]
    data = yaml.safe_load(MOCK)
    change(data)
    path = tmp_path / "rig.yaml"
    path.write_text(yaml.safe_dump(data))
    with pytest.raises(InputError) as caught:
        load_rig_file(path)
    assert caught.value.key.startswith(key)
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
    path = tmp_path / "rig.yaml"
    path.write_text(yaml.safe_dump(data))
    assert load_rig_file(path)[0].mock.clocks.arm_ppm == 19_000


def test_a_region_larger_than_the_sensor_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text(MOCK.replace("spool: false", "spool: false, height_px: 400"))
    rig, _ = load_rig_file(path)
    plan = load_plan(ROOT / "protocols" / "pilot.yaml")
    with pytest.raises(InputError, match=r"frame_camera.height_px = 400: .* needs 720 px"):
        check_plan(rig, plan, str(path))


@pytest.mark.parametrize(("name", "driver"), [("mock", "mock"), ("ur5", "devices")])
def test_an_exposure_longer_than_a_tick_is_refused(name: str, driver: str, tmp_path: Path) -> None:
    data = yaml.safe_load((ROOT / "rigs" / f"{name}.yaml").read_text())
    camera = data[driver].setdefault("frame_camera", {})
    camera |= {"exposure_us": 20_000} | ({"rate_hz": 50} if driver == "devices" else {})
    path = tmp_path / "rig.yaml"
    path.write_text(yaml.safe_dump(data))
    rig, _ = load_rig_file(path)
    plan = load_plan(ROOT / "protocols" / "pilot.yaml")
    with pytest.raises(
        InputError,
        match=rf"{driver}.frame_camera.exposure_us = 20000: must be at most 10000, the period of",
    ):
        check_plan(rig, plan, str(path))


def test_a_plan_beyond_the_rig_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text(MOCK.replace("depth: 4 mm", "depth: 3 mm"))
    rig, _ = load_rig_file(path)
    plan = load_plan(ROOT / "protocols" / "pilot.yaml")
    with pytest.raises(InputError, match=r"needs 3.4 mm in its phase 'press'"):
        check_plan(rig, plan, str(path))


@pytest.mark.parametrize(
    ("section", "key", "value", "says"),
    [
        ("warm_up", "depth", "3.5 mm", "limits.depth = 3.4 mm: .* needs 3.5 mm in .*warm_up"),
        ("warm_up", "speed", "21 mm/s", "limits.speed = 20 mm/s: .* needs 21 mm/s in .*warm_up"),
        ("rezero", "search", "3.5 mm", "limits.depth = 3.4 mm: .* needs 3.5 mm in .*rezero"),
        ("rezero", "speed", "21 mm/s", "limits.speed = 20 mm/s: .* needs 21 mm/s in .*rezero"),
    ],
)
def test_maintenance_beyond_the_rig_is_refused(
    section: str, key: str, value: str, says: str, small: dict[str, Any], tmp_path: Path
) -> None:
    rig_path, path = tmp_path / "rig.yaml", tmp_path / "protocol.yaml"
    text = MOCK.replace("depth: 4 mm", "depth: 3.4 mm")
    data = yaml.safe_load(text)
    data["limits"]["speed"] = "20 mm/s"
    rig_path.write_text(yaml.safe_dump(data))
    rig, _ = load_rig_file(rig_path)
    path.write_text(yaml.safe_dump(small))
    check_plan(rig, load_plan(path), str(rig_path))
    small["collection"]["maintenance"][section][key] = value
    path.write_text(yaml.safe_dump(small))
    with pytest.raises(InputError, match=says):
        check_plan(rig, load_plan(path), str(rig_path))


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
