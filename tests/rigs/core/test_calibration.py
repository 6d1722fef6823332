"""Entries of a rig file's calibration, and when they cannot be relied on."""

from __future__ import annotations

import copy
from datetime import date
from typing import Any

import pytest
import yaml

from sliplab.protocols import InputError
from sliplab.protocols.yaml_file import parse_yaml, validate
from sliplab.rigs.build import build_rig
from sliplab.rigs.core.calibration import COMMANDS, Calibration, MaxAge, find_faults, measured_on
from sliplab.rigs.rig_file import RigFile, same_rig
from tests.conftest import ROOT

MOCK = (ROOT / "rigs" / "mock.yaml").read_text()
TODAY = date(2026, 12, 1)
WHOLE: dict[str, Any] = yaml.safe_load("""
contact_plane: {centre: [400 mm, 0 mm, 300 mm], right: [400 mm, 12 mm, 300 mm],
  above: [400 mm, 0 mm, 312 mm], taught: '2026-11-30', residual: 0.02 mm, method: touches}
depth_zero: {zero: 0.01 mm, taught: '2026-11-30', residual: 0.02 mm, method: touches}
tool_centre_point: {offset: [0 mm, 0 mm, 90 mm], pivot: [300 mm, 0 mm, 200 mm], poses: 8,
  taught: '2026-11-01', residual: 0.1 mm, method: pivoting}
lens: {scale_px_per_mm: 20.01, focal: [6000 px, 6000 px], centre: [960 px, 600 px],
  distortion: [0, 0, 0, 0, 0], tilt: 0 deg, size: [1920 px, 1200 px], views: 8,
  measured: '2026-11-01', residual: 0.1 px, method: ChArUco}
event_crop: {centre: [318 px, 241 px], size: 360 px, measured: '2026-11-01', residual: 1 px,
  method: circle}
""")


def calibration(**changes: Any) -> Calibration:
    data = copy.deepcopy(WHOLE)
    for key, value in changes.items():
        if value is None:
            del data[key]
        elif isinstance(value, dict):
            data[key] = {**data.get(key, {}), **value}
    return validate(Calibration, parse_yaml(yaml.safe_dump(data), "test"), "test")


def faults(found: Calibration, *, simulated: bool = False, scale: float = 20.01) -> list[str]:
    how = {"simulated": simulated, "needed": COMMANDS, "scale_px_per_mm": scale, "today": TODAY}
    return [f"{f.key} = {f.value}: {f.expected}: {f.command}" for f in find_faults(found, **how)]


def test_a_whole_and_recent_calibration_has_no_faults() -> None:
    assert faults(calibration()) == []


@pytest.mark.parametrize("name", COMMANDS)
def test_an_entry_that_is_missing_or_old_names_its_command(name: str) -> None:
    if name != "contact_plane":
        missing = faults(calibration(**{name: None}))
        assert missing == [f"calibration.{name} = None: is missing: {COMMANDS[name]}"]
    key = "taught" if "taught" in WHOLE[name] else "measured"
    old = calibration(**{name: {key: "2025-01-01"}})
    said, *_ = (text for text in faults(old) if f"calibration.{name}." in text)
    limit = getattr(MaxAge(), name)
    assert said.startswith(f"calibration.{name}.{key} = 2025-01-01: is ")
    assert f"max_age.{name} allows {limit} d" in said
    assert said.endswith(COMMANDS[name])
    assert measured_on(old, name) == date(2025, 1, 1)


def test_the_last_day_still_counts() -> None:
    for day, count in (("2026-11-01", 0), ("2026-10-31", 1)):
        plane, ages = {"taught": day}, {"depth_zero": None}
        found = calibration(contact_plane=plane, depth_zero=None, max_age=ages)
        assert len(faults(found)) == count


def test_a_day_to_come_is_refused() -> None:
    assert "is in the future" in faults(calibration(lens={"measured": "2026-12-24"}))[0]
    # it is tomorrow already somewhere
    assert faults(calibration(lens={"measured": "2026-12-02"})) == []


def test_a_simulated_rig_has_no_age_unless_its_file_says_so() -> None:
    old = {"contact_plane": {"taught": "2020-01-01"}, "depth_zero": None, "lens": None}
    bare = calibration(**old, tool_centre_point=None, event_crop=None)
    assert faults(bare, simulated=True) == []
    reported = calibration(**old, max_age={"contact_plane": "30 d", "lens": "90 d"})
    said = faults(reported, simulated=True)
    assert len(said) == 2
    assert "2020-01-01" in said[0]
    assert "calibration.lens = None: is missing" in said[1]


def test_null_is_no_limit() -> None:
    free = calibration(lens=None, max_age={"lens": None})
    assert faults(free) == []


def test_a_zero_from_before_the_plane_is_refused() -> None:
    found = calibration(depth_zero={"taught": "2026-11-29"}, max_age={"depth_zero": "9 d"})
    (said,) = faults(found)
    assert "was found before the plane was taught again on 2026-11-30" in said


def test_scale_and_lens_have_to_agree() -> None:
    (said,) = faults(calibration(), scale=20.1)
    assert said.startswith("frame_camera.scale_px_per_mm = 20.1: must be calibration.lens")


@pytest.mark.parametrize(
    ("age", "says"),
    [
        ("30 days", "whole number of days"),
        (30, "whole number of days"),
        ("-1 d", "whole number"),
        ("0.5 d", "whole number"),
    ],
)
def test_an_age_is_a_number_of_days(age: object, says: str) -> None:
    data = parse_yaml(MOCK, "mock")
    data["calibration"]["max_age"] = {"lens": age}
    with pytest.raises(InputError, match=says) as caught:
        validate(RigFile, data, "mock")
    assert caught.value.key == "calibration.max_age.lens"


def test_a_rig_begins_with_what_was_found() -> None:
    data = parse_yaml(MOCK, "mock")
    plain = build_rig(validate(RigFile, data, "mock"))
    assert plain.plate_frame.zero_mm == 0.0
    assert plain.centre_px is None
    data["calibration"] |= {k: WHOLE[k] for k in ("depth_zero", "event_crop")}
    data = parse_yaml(yaml.safe_dump(yaml.safe_load(yaml.safe_dump(_plain(data)))), "mock")
    rig = build_rig(validate(RigFile, data, "mock"))
    assert rig.plate_frame.zero_mm == 0.01
    assert rig.centre_px == (318.0, 241.0)


def test_a_plane_taught_anew_is_the_same_rig_and_a_new_lens_is_not() -> None:
    other = MOCK.replace("400.35 mm, 0 mm", "400.31 mm, 0 mm")
    other = other.replace("taught: 2026-11-21", "taught: 2026-11-25")
    assert other != MOCK
    assert same_rig(MOCK, other)
    assert not same_rig(MOCK, MOCK.replace("touch_depth: 0.34", "touch_depth: 0.30"))
    assert not same_rig(MOCK, MOCK.replace("scale_px_per_mm: 20,", "scale_px_per_mm: 20.02,"))


def _plain(data: Any) -> Any:
    if isinstance(data, dict):
        return {key: _plain(value) for key, value in data.items()}
    if isinstance(data, list):
        return [_plain(value) for value in data]
    return data if isinstance(data, (str, int, bool, date)) or data is None else float(data)
