"""Rig files of drivers and of fakes: each kind has its own sections, and says what lacks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from sliplab.plugins.devices.basler.frame_time import FrameStamping
from sliplab.protocols import InputError
from sliplab.protocols.plan import load_plan
from sliplab.protocols.program import Move
from sliplab.rigs.build import _check_grade
from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.rig_file import load_rig_file
from sliplab.rigs.rig_inheritance import read_rig
from tests.conftest import ROOT
from tests.protocols.planning import put, put_all, rows


def loopback() -> dict[str, Any]:
    """The shipped loopback rig with what it extends, as plain data."""
    merged = read_rig(ROOT / "rigs" / "loopback.yaml").text
    data: dict[str, Any] = yaml.safe_load(merged)
    return data


# changes of the loopback | the key that is named | what is said
CASES = """
    driver: mock | devices | no meaning with driver: mock
    driver: devices | mock | no meaning with driver: devices
    mock: | mock | is needed by driver: loopback
    devices: | devices | is needed by driver: loopback
    driver: devices; mock: ; devices: | devices | is needed by driver: devices
    driver: devices; mock: | devices.sync_box.port | name its serial port
    devices.frame_camera.exposure_us: 1000 | devices.frame_camera.exposure_us | must be 2000
    devices.frame_camera.rate_hz: 1000 | devices.frame_camera.exposure_us | = 2000: must be at \
most 1000, the period of rate_hz = 1000
    devices.frame_camera.exposure_line: Line1 | devices.frame_camera.exposure_line | is already \
used as an input: trigger_line
    devices.frame_camera.sync_line: 1 | devices.frame_camera.sync_line | must differ from \
trigger_line
    timing.frames: exposure line | timing.frames | must be hardware trigger
    mock.frame_camera.level: tracks | mock.frame_camera.level | must be video
    devices.arm.driver: kuka | devices.arm.driver | one of abb, abb_socket, ur
    devices.arm.egm_port: 6510 | devices.arm.egm_port | known here: driver, host
    devices.arm.limits: | devices.arm.limits | is missing
    devices.arm.limits.low_mm: [-20, 30, -70] | devices.arm.limits.low_mm | y is not below high_mm
    devices.frame_camera.sync_line: 9 | devices.frame_camera.sync_line | less than or equal to 8
"""


def load(data: dict[str, Any], path: Path) -> Any:
    path.write_text(yaml.safe_dump(data))
    return load_rig_file(path)[0]


@pytest.mark.parametrize(("changes", "key", "says"), rows(CASES))
def test_the_message_names_key_and_cure(changes: str, key: str, says: str, tmp_path: Path) -> None:
    data = loopback()
    put_all(data, changes)
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

    def __init__(self, stamping: FrameStamping) -> None:
        self.stamping = stamping


def test_a_camera_whose_times_are_worse_than_promised_is_refused(tmp_path: Path) -> None:
    file = load(loopback(), tmp_path / "rig.yaml")
    fine: Any = _Camera(FrameStamping("chunk", "hardware trigger"))
    _check_grade(file.timing.frames, fine, "timing.frames")
    poor: Any = _Camera(FrameStamping("host arrival", "host arrival"))
    with pytest.raises(RigError, match=r"'host arrival'.*write timing.frames: host arrival"):
        _check_grade(file.timing.frames, poor, "timing.frames")
    simulated: Any = object()
    _check_grade(file.timing.frames, simulated, "timing.frames")  # knows of no stamps


HOSTS = """192.168.1 | 192.168.1. | 10 | 192.168..10 | 192.168.1.256 | 192.168.1.10.5 | 1.2.3.04
 | 192.168.1.x | 192.168.1.10:30004 | 0.0.0.0 | 255.255.255.255 | 224.0.0.1 | ur5- | -ur5
 | ur5..lab | . | ur5 lab | | \u0661\u0669\u0662.168.1.10"""
PLATE = "{centre_mm: [0.4, 0, 0.3], right_mm: [0.4, 0.06, 0.3], above_mm: [0.4, 0, 0.36]}"
UNITS = f"""
    tool.tcp_mm: [0, 0, 0.12] | tool.tcp_mm | write millimetres, such as [0, 0, 120]
    tool.centre_of_mass_mm: [0, 0.01, 0.05] | tool.centre_of_mass_mm | write millimetres
    tool.tcp_rotvec_deg: [0, 3.1416, 0] | tool.tcp_rotvec_deg | write degrees
    limits.low_mm: [-0.4, -0.6, 0]; limits.high_mm: [0.4, -0.2, 0.5] | limits.low_mm | write millim
    limits.plate: {PLATE} | limits.plate.right_mm | write millimetres
"""


def _real(tmp_path: Path, place: str, value: Any) -> Path:
    """The UR5's rig file with a change."""
    data = yaml.safe_load((ROOT / "rigs" / "ur5.yaml").read_text())
    if place == "changes":
        put_all(data, value, "devices.arm")
    else:
        put(data, place, value)
    path = tmp_path / "rig.yaml"
    path.write_text(yaml.safe_dump(data))
    return path


@pytest.mark.parametrize("host", [host.strip() for host in HOSTS.split("|")])
def test_an_address_is_whole(host: str, tmp_path: Path) -> None:
    source = {"kind": "network", "host": host, "events_port": 1, "triggers_port": 2}
    for place, value, key in (
        ("devices.arm.host", host, ""),
        ("devices.event_camera", {"source": source}, ".source.host"),
    ):
        with pytest.raises(InputError) as caught:
            load_rig_file(_real(tmp_path, place, value))
        assert caught.value.key == place + key
        if not key:
            assert "192.168.1.10" in caught.value.expected


@pytest.mark.parametrize(
    "host", ["192.168.1.10", "ur5", "ur5.lab.example.org", "localhost", "3com"]
)
def test_whole_addresses_are_taken(host: str, tmp_path: Path) -> None:
    rig, _ = load_rig_file(_real(tmp_path, "devices.arm.host", host))
    assert rig.devices.arm.host == host


@pytest.mark.parametrize(("changes", "key", "says"), rows(UNITS))
def test_lengths_in_metres_are_noticed(changes: str, key: str, says: str, tmp_path: Path) -> None:
    path = _real(tmp_path, "changes", changes)
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
