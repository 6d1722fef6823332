"""Each fault at the level where it happens: what the device then says, in any pieces."""

from __future__ import annotations

import errno
import functools
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
import yaml

from sliplab.plugins.simulation.devices import MockDevices, build_mock
from sliplab.protocols import InputError
from sliplab.protocols.yaml_file import parse_yaml, validate
from sliplab.rigs.core.capabilities import ArmFault, ArmState, RigError
from sliplab.rigs.core.faults import KINDS, AnyFault
from sliplab.rigs.rig_file import RigFile
from tests.conftest import ROOT
from tests.patching import loose
from tests.plugins.simulation.driving import SMALL, Trial, go, gravity, same, slide, with_faults
from tests.protocols.planning import rows

MOMENTS = """
    kind: frames_lost, count: 3
    kind: frame_late, count: 2, seconds: 0.13
    kind: event_gap, seconds: 0.1
    kind: event_stall, seconds: 60.0
    kind: event_burst, seconds: 0.02, million_per_s: 5
    kind: clock_drift, device: arm, ppm: 500
    kind: clock_drift, device: sync_box, ppm: -500
    kind: clock_jump, device: event_camera, seconds: -0.25
    kind: clock_jump, device: sync_box, seconds: 0.5
    kind: clock_restart, device: arm
    kind: clock_restart, device: event_camera
    kind: clock_restart, device: frame_camera
    kind: pulses_lost, count: 4, device: sync_box
    kind: pulses_duplicated, count: 4, device: arm, seconds: 0.0137
    kind: pulses_late, count: 4, device: event_camera, seconds: 0.031
    kind: papilla_torn, papilla: 9
    kind: marker_occluded, papilla: 0, seconds: 0.2
    kind: arm_off_path, mm: 0.5, seconds: 0.4
    kind: arm_protective_stop
"""


def fault_of(text: str) -> dict[str, Any]:
    """A fault as it stands in a rig file."""
    found: dict[str, Any] = yaml.safe_load(f"{{{text}}}")
    return found


@pytest.fixture(scope="module")
def sound() -> Trial:
    return slide(build_mock(SMALL), seed=11)


@pytest.mark.quick(5)
@pytest.mark.parametrize("fault", MOMENTS.strip().splitlines())
def test_a_fault_is_the_same_in_any_pieces(fault: str, sound: Trial) -> None:
    devices = with_faults({**fault_of(fault), "at_s": 0.7213})
    whole = slide(devices, seed=11)
    devices.operator.ask("protective_stop", "Clear it.", "")
    same(slide(devices, seed=11, chunk_s=0.0331), whole)
    with pytest.raises(AssertionError):
        same(whole, sound)


# -- the arm -------------------------------------------------------------------------------


def test_a_protective_stop_holds_the_arm_until_a_person_clears_it() -> None:
    devices = with_faults({"kind": "arm_protective_stop", "trial": 1, "at_s": 0.7})
    trial = slide(devices, seed=11)
    assert devices.arm.state() is ArmState.PROTECTIVE_STOP
    # 0.3 s of sliding at 2 mm/s after 0.4 s of rest
    assert devices.world.plane.sensor(devices.arm.pose())[0] == pytest.approx(0.6, abs=1e-6)
    assert len(trial.frames["number"]) > 250
    devices.arm.stop()
    with pytest.raises(ArmFault, match="protective stop"):
        go(devices, 0, 0, -5, 5.0, 0.5, lambda: None)
    devices.operator.ask("protective_stop", "Clear it.", "")
    go(devices, 0, 0, -5, 5.0, 0.5, lambda: None)
    slide(devices, seed=11)
    assert devices.arm.state() is ArmState.READY


@pytest.mark.parametrize("chunk_s", [0.0331, 0.5])
@pytest.mark.parametrize(
    ("since", "at_mm", "place"),
    [("recording", 1.2345, (1.2345, 2.6)), ("trial", 3.1, (0.0, 1.1)), ("trial", 5.0, (0.4, 2.6))],
)
def test_a_stop_at_a_point_of_the_way(since: str, at_mm: float, place: Any, chunk_s: float) -> None:
    devices = with_faults({"kind": "arm_protective_stop", "since": since, "at_mm": at_mm})
    if place[1] < 2.6:  # while it presses, so that it cannot slide
        with pytest.raises(ArmFault):
            slide(devices, seed=11, chunk_s=chunk_s)
    else:
        slide(devices, seed=11, chunk_s=chunk_s)
    where = devices.world.plane.sensor(devices.arm.pose())
    # to the microsecond in which it got there, at 2 mm/s along the plate and 4 into it
    assert (where[0], where[2]) == pytest.approx(place, abs=1e-5)


@pytest.mark.parametrize(("direction", "turned"), [(None, 90.0), (0.0, 0.0), (-30.0, -30.0)])
def test_an_arm_off_its_path_says_so(direction: Any, turned: float, sound: Trial) -> None:
    fault = {"kind": "arm_off_path", "mm": 0.8, "seconds": 1.0, "at_s": 0.9}
    devices = with_faults(fault | ({} if direction is None else {"direction_deg": direction}))
    off = slide(devices, seed=11)
    aside = (off.poses["xyz_mm"] - sound.poses["xyz_mm"]) @ devices.world.plane.rotation
    angle = np.radians(turned)
    seconds = np.arange(len(aside)) * 0.002  # poses begin with the recording
    way = 0.8 * np.clip(seconds - 0.9, 0.0, 1.0)
    expected = way[:, None] * np.array([np.cos(angle), np.sin(angle), 0.0])
    assert aside == pytest.approx(expected, abs=0.8 * 0.004)  # a cycle or two
    # the skin feels it: it is where the arm really is
    assert off.truth["per_papilla_ns"] != sound.truth["per_papilla_ns"]


def test_an_arm_off_its_path_is_set_right_between_trials(sound: Trial) -> None:
    devices = with_faults({"kind": "arm_off_path", "mm": 0.5, "trial": 1})
    slide(devices, seed=12)
    same(slide(devices, seed=11), sound)


# -- what stands still ---------------------------------------------------------------------


def test_a_stuck_plate_does_not_fall() -> None:
    devices = with_faults({"kind": "plate_stuck"})
    stuck = gravity(devices, 5)
    track = devices.world.physics.track
    assert np.all(track.between(1_500_000_000, track.end_ns)[1][:, -1] == 0.0)
    assert stuck["gross_ns"] is None


# -- devices that go -----------------------------------------------------------------------


CALLS = {
    "arm": "state pose now_ns progress read_poses read_pulses stop close connect start:[]",
    "event_camera": "start read read_pulses stop close",
    "frame_camera": "start read stop close set_region:64,64 read_clock",
    "sync_box": "read_pulses read_exposures read_clock stop close start:100.0,1",
}


def calls(devices: MockDevices, device: str) -> list[Any]:
    names = {"event_camera": "events", "frame_camera": "frames", "sync_box": "sync"}
    found: Any = getattr(devices, names.get(device, device))
    made = (call.partition(":") for call in CALLS[device].split())
    return [
        functools.partial(getattr(found, name), *yaml.safe_load(f"[{words}]"))
        for name, _, words in made
    ]


@pytest.mark.parametrize("device", CALLS)
def test_a_device_that_is_gone_fails_every_call_and_no_other(device: str) -> None:
    fault = fault_of("kind: device_gone, since: trial, at_s: 1.0, seconds: 2.0")
    devices = with_faults({**fault, "device": device})
    devices.arm.connect()
    devices.begin_trial(1)
    devices.clock.wait(1.0)
    words = device.replace("_", " ")
    for call in calls(devices, device):
        with pytest.raises(RigError, match=f"{words}: does not answer") as caught:
            call()
        assert isinstance(caught.value, ArmFault) == (device == "arm")
    for other in CALLS.keys() - {device}:
        for call in calls(devices, other):
            call()
    devices.clock.wait(2.0)
    for call in calls(devices, device):
        call()


def test_an_arm_without_its_cable_stands_still() -> None:
    fault = fault_of("kind: device_gone, device: arm, since: trial, at_s: 1.0, seconds: 0.5")
    devices = with_faults(fault)
    devices.arm.connect()
    devices.begin_trial(1)
    with pytest.raises(ArmFault, match="does not answer"):
        go(devices, 0, 0, -50, 5.0, 0.3, lambda: None)
    devices.clock.wait(1.0)
    assert devices.world.plane.sensor(devices.arm.pose())[2] == pytest.approx(-55.0)
    assert devices.arm.state() is ArmState.READY


def test_a_box_without_power_does_not_tick() -> None:
    devices = with_faults(fault_of("kind: device_gone, device: sync_box, at_s: 1.0, seconds: 0.5"))
    devices.begin_trial(1)
    devices.frames.start()
    devices.sync.start(100.0, 1)
    devices.clock.wait(2.0)
    assert len(devices.frames.read().number) == 100
    assert devices.sync.read_pulses().t_ns.max() < 1_000_000_000
    devices.sync.start(100.0, 1)
    devices.clock.wait(1.0)
    assert len(devices.frames.read().number) > 95


def test_a_full_disk_stays_full_for_the_trial() -> None:
    class Sink:
        written = 0

        def add(self, device: str, chunk: Any) -> None:
            self.written += 1

    devices = with_faults({"kind": "disk_full", "since": "trial", "at_s": 1.0, "trial": 1})
    devices.begin_trial(1)
    bare = Sink()
    sink: Any = devices.sink(loose(bare))
    sink.add("frames", None)
    devices.clock.wait(1.0)
    for _ in range(2):
        with pytest.raises(OSError, match="No space left") as caught:
            sink.add("frames", None)
        assert caught.value.errno == errno.ENOSPC
    assert bare.written == 1
    devices.begin_trial(2)
    assert devices.sink(loose(bare)) is bare


# -- how they are written ------------------------------------------------------------------


def test_faults_belong_to_their_trial() -> None:
    devices = with_faults({"kind": "frames_lost", "trial": 2, "at_s": 1.0, "count": 3})
    first, second, third = (slide(devices, seed=3, distance=1.5) for _ in range(3))
    assert len(second.frames["number"]) == len(first.frames["number"]) - 3
    assert len(third.frames["number"]) == len(first.frames["number"])


WRONG = """
    kind: frames_lots | .kind | must be one of
    count: 3 | .kind | must be one of
    kind: frames_lost, seconds: 3 | .seconds | known here: trial
    kind: frames_lost, cuont: 3 | .cuont | did you mean 'count'
    kind: pulses_late, device: frame_camera | .device | 'sync_box'
    kind: clock_drift, device: arm | .ppm | is missing
    kind: clock_restart, device: sync_box | .device | 'arm'
    kind: event_gap, seconds: 0 | .seconds | greater than 0
    kind: papilla_torn, papilla: 19 | .papilla | from 0 (the centre)
    kind: marker_occluded | | needs either a papilla
    kind: arm_protective_stop, at_s: 1, at_mm: 2 | | needs a time (at_s) or a point (at_mm)
    kind: plate_stuck, at_s: 1 | .at_s | unknown key
"""


@pytest.mark.parametrize(("fault", "key", "said"), rows(WRONG))
def test_a_wrong_fault_is_said_as_any_wrong_input(fault: str, key: str, said: str) -> None:
    data = parse_yaml((ROOT / "rigs" / "mock.yaml").read_text(), "mock.yaml")
    data["mock"]["faults"] = [{"kind": "event_gap"}, fault_of(fault)]
    with pytest.raises(InputError) as caught:
        validate(RigFile, data, "mock.yaml")
    assert caught.value.file == "mock.yaml"
    assert caught.value.key == f"mock.faults[1]{key}"
    assert said in caught.value.expected


def test_every_kind_is_documented_with_its_parameters() -> None:
    text = Path(ROOT / "docs" / "faults.md").read_text().split("## Outcome of each fault")[0]
    rows = {line.split("`")[1]: line for line in text.splitlines() if line.startswith("| `")}
    assert set(rows) == set(KINDS)
    common = {"kind", "trial", "at_s", "since"}
    for model in get_args(AnyFault):
        kind = get_args(model.model_fields["kind"].annotation)[0]
        for name in set(model.model_fields) - common:
            assert f"`{name}`" in rows[kind], f"{kind}: {name}"
