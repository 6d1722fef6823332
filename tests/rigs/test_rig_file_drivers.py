"""Rig files of drivers and of fakes: each kind has its own sections, and says what lacks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from sliplab.protocols import InputError
from sliplab.protocols.plan import load_plan
from sliplab.protocols.program import Move
from sliplab.rigs.build import _check_grade
from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.devices.basler.frame_time import Stamping
from sliplab.rigs.rig_file import load_rig_file
from sliplab.rigs.rig_inheritance import read_rig
from tests.conftest import ROOT
from tests.rigs.test_rig_file import Change, _both, _set


def loopback() -> dict[str, Any]:
    """The shipped loopback rig with what it extends, as plain data."""
    merged = read_rig(ROOT / "rigs" / "loopback.yaml").text
    data: dict[str, Any] = yaml.safe_load(merged)
    return data


def _without(*path: str) -> Change:
    def change(data: dict[str, Any]) -> None:
        for part in path[:-1]:
            data = data[part]
        del data[path[-1]]

    return change


CASES: dict[str, tuple[Change, str, str]] = {
    "devices on a mock": (_set("driver", to="mock"), "devices", "no meaning with driver: mock"),
    "a scene on a real rig": (
        _set("driver", to="devices"),
        "mock",
        "no meaning with driver: devices",
    ),
    "a loopback without a scene": (_without("mock"), "mock", "is needed by driver: loopback"),
    "a loopback without drivers": (
        _without("devices"),
        "devices",
        "is needed by driver: loopback",
    ),
    "a real rig without drivers": (
        _both(_set("driver", to="devices"), _without("mock"), _without("devices")),
        "devices",
        "is needed by driver: devices",
    ),
    "a real rig without a sync box": (
        _both(_set("driver", to="devices"), _without("mock")),
        "devices.sync_box.port",
        "name its serial port",
    ),
    "another exposure than the scene's": (
        _set("devices", "frame_camera", "exposure_us", to=1000),
        "devices.frame_camera.exposure_us",
        "must be 2000",
    ),
    "an exposure longer than the camera's period": (
        _set("devices", "frame_camera", "rate_hz", to=1000),
        "devices.frame_camera.exposure_us",
        "= 2000: must be at most 1000, the period of rate_hz = 1000",
    ),
    "an output that is an input": (
        _set("devices", "frame_camera", "exposure_line", to="Line1"),
        "devices.frame_camera.exposure_line",
        "is already used as an input: trigger_line",
    ),
    "ticks on the line of the code": (
        _set("devices", "frame_camera", "sync_line", to=1),
        "devices.frame_camera.sync_line",
        "must differ from trigger_line",
    ),
    "frames that no fake times so": (
        _set("timing", "frames", to="exposure line"),
        "timing.frames",
        "must be hardware trigger",
    ),
    "tracks in place of pictures": (
        _set("mock", "frame_camera", "level", to="tracks"),
        "mock.frame_camera.level",
        "must be video",
    ),
    "an arm that is none": (
        _set("devices", "arm", "driver", to="kuka"),
        "devices.arm.driver",
        "one of ur, abb",
    ),
    "a setting of another make": (
        _set("devices", "arm", "egm_port", to=6510),
        "devices.arm.egm_port",
        "known here: driver, host",
    ),
    "an arm without limits": (
        _without("devices", "arm", "limits"),
        "devices.arm.limits",
        "is missing",
    ),
    "limits the wrong way round": (
        _set("devices", "arm", "limits", "low_mm", to=[-20, 30, -70]),
        "devices.arm.limits.low_mm",
        "y is not below high_mm",
    ),
    "a line that no camera has": (
        _set("devices", "frame_camera", "sync_line", to=9),
        "devices.frame_camera.sync_line",
        "less than or equal to 8",
    ),
}


def load(data: dict[str, Any], path: Path) -> Any:
    path.write_text(yaml.safe_dump(data))
    return load_rig_file(path)[0]


@pytest.mark.parametrize("case", CASES)
def test_the_message_names_key_and_cure(case: str, tmp_path: Path) -> None:
    change, key, says = CASES[case]
    data = loopback()
    change(data)
    with pytest.raises(InputError) as caught:
        load(data, tmp_path / "rig.yaml")
    assert caught.value.key.startswith(key)
    assert says in caught.value.message


def test_a_real_rig_is_not_simulated_and_a_loopback_is(tmp_path: Path) -> None:
    stand_ins = load(loopback(), tmp_path / "a.yaml")
    assert stand_ins.simulated
    assert not stand_ins.in_virtual_time
    data = loopback()
    data["driver"] = "devices"
    del data["mock"]
    data["devices"]["sync_box"] = {"port": "/dev/serial/by-id/box"}
    real = load(data, tmp_path / "b.yaml")
    assert not real.simulated
    assert not real.has_plate
    data["devices"]["plate"] = {"mass_kg": 0.165}
    assert load(data, tmp_path / "c.yaml").has_plate


class _Camera:
    """A frame camera of which only its stamps matter."""

    def __init__(self, stamping: Stamping) -> None:
        self.stamping = stamping


def test_a_camera_whose_times_are_worse_than_promised_is_refused(tmp_path: Path) -> None:
    file = load(loopback(), tmp_path / "rig.yaml")
    fine: Any = _Camera(Stamping("chunk", "hardware trigger"))
    _check_grade(file.timing.frames, fine, "timing.frames")
    poor: Any = _Camera(Stamping("host arrival", "host arrival"))
    with pytest.raises(RigError, match=r"'host arrival'.*write timing.frames: host arrival"):
        _check_grade(file.timing.frames, poor, "timing.frames")
    simulated: Any = object()
    _check_grade(file.timing.frames, simulated, "timing.frames")  # knows of no stamps


def _arm(**change: Any) -> Change:
    def apply(data: dict[str, Any]) -> None:
        for path, value in change.items():
            part = data["devices"]["arm"]
            *parents, last = path.split("__")
            for name in parents:
                part = part.setdefault(name, {})
            part[last] = value

    return apply


HOSTS = [
    "192.168.1",
    "192.168.1.",
    "10",
    "192.168..10",
    "192.168.1.256",
    "192.168.1.10.5",
    "1.2.3.04",
    "192.168.1.x",
    "192.168.1.10:30004",
    "0.0.0.0",
    "255.255.255.255",
    "224.0.0.1",
    "ur5-",
    "-ur5",
    "ur5..lab",
    ".",
    "ur5 lab",
    "",
    "\u0661\u0669\u0662.168.1.10",
]
MILLIMETRES = "write millimetres"
UNITS: dict[str, tuple[Change, str, str]] = {
    "a tool centre in metres": (
        _arm(tool__tcp_mm=[0, 0, 0.12]),
        "tool.tcp_mm",
        f"{MILLIMETRES}, such as [0, 0, 120]",
    ),
    "a centre of mass in metres": (
        _arm(tool__centre_of_mass_mm=[0, 0.01, 0.05]),
        "tool.centre_of_mass_mm",
        MILLIMETRES,
    ),
    "a turn in radians": (
        _arm(tool__tcp_rotvec_deg=[0, 3.1416, 0]),
        "tool.tcp_rotvec_deg",
        "write degrees",
    ),
    "a box in metres": (
        _arm(limits__low_mm=[-0.4, -0.6, 0], limits__high_mm=[0.4, -0.2, 0.5]),
        "limits.low_mm",
        MILLIMETRES,
    ),
    "a plate in metres": (
        _arm(
            limits__plate={
                "centre_mm": [0.4, 0, 0.3],
                "right_mm": [0.4, 0.06, 0.3],
                "above_mm": [0.4, 0, 0.36],
            }
        ),
        "limits.plate.right_mm",
        MILLIMETRES,
    ),
}


def _real(tmp_path: Path, change: Change) -> Path:
    """The UR5's rig file with a change."""
    data = yaml.safe_load((ROOT / "rigs" / "ur5.yaml").read_text())
    change(data)
    path = tmp_path / "rig.yaml"
    path.write_text(yaml.safe_dump(data))
    return path


@pytest.mark.parametrize("host", HOSTS)
def test_an_address_is_whole(host: str, tmp_path: Path) -> None:
    path = _real(tmp_path, _arm(host=host))
    with pytest.raises(InputError) as caught:
        load_rig_file(path)
    assert caught.value.key == "devices.arm.host"
    assert "192.168.1.10" in caught.value.expected
    source = {"kind": "network", "host": host, "events_port": 1, "triggers_port": 2}
    path = _real(tmp_path, _set("devices", "event_camera", to={"source": source}))
    with pytest.raises(InputError) as caught:
        load_rig_file(path)
    assert caught.value.key == "devices.event_camera.source.host"


@pytest.mark.parametrize(
    "host", ["192.168.1.10", "ur5", "ur5.lab.example.org", "localhost", "3com"]
)
def test_whole_addresses_are_taken(host: str, tmp_path: Path) -> None:
    rig, _ = load_rig_file(_real(tmp_path, _arm(host=host)))
    assert rig.devices.arm.host == host


@pytest.mark.parametrize("case", UNITS)
def test_lengths_in_metres_are_noticed(case: str, tmp_path: Path) -> None:
    change, key, says = UNITS[case]
    path = _real(tmp_path, change)
    with pytest.raises(InputError) as caught:
        load_rig_file(path)
    assert caught.value.key == f"devices.arm.{key}"
    assert says in caught.value.expected
    assert str(path) in caught.value.message
    rig, _ = load_rig_file(path, stored=True)  # trials were taken with it, and stay usable
    assert rig.name == "ur5"


@pytest.mark.parametrize("name", ["ur5", "irb120", "loopback"])
def test_shipped_rigs_are_in_millimetres(name: str) -> None:
    load_rig_file(Path(name))


def test_the_loopback_arm_has_room_for_every_shipped_press() -> None:
    """Its own limits count from the taught plane, and depth zero may be found behind it."""
    rig = load_rig_file(ROOT / "rigs" / "loopback.yaml")[0]
    limits = rig.devices.arm.limits
    for path in sorted((ROOT / "protocols").glob("*.yaml")):
        plan = load_plan(path)
        moves = [step for trial in plan for step in plan.program(trial).steps]
        deepest = max(step.to.depth_mm for step in moves if isinstance(step, Move))
        assert deepest + 0.2 <= limits.depth_mm
        assert deepest + 0.2 <= limits.high_mm[2]
