"""The load on the tool: the reaction of the plate's, by the arm controller's clock."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import pytest

from sliplab.plugins.devices.ur.fake import Client
from sliplab.plugins.devices.ur.fake_program import UrProgram
from sliplab.plugins.loopback.tool_load import ToolLoad
from sliplab.plugins.simulation.devices import build_mock
from sliplab.plugins.simulation.force import MockForceSensor
from sliplab.plugins.simulation.settings import MockSettings
from sliplab.rigs.core.capabilities import Mounting, Pose
from sliplab.rigs.core.fake_motion import StraightMotion
from sliplab.rigs.core.plate_frame import PlateFrame
from sliplab.storage.clockmap import ClockMap
from tests.patching import loose
from tests.plugins.simulation.test_force import QUIET, go_to, move

OFFSET_S = 400.0
CONTROLLER = ClockMap.line(0, round(OFFSET_S * 1e9), 0)


@pytest.fixture
def pressed() -> tuple[Any, ToolLoad]:
    """A mock in contact, its load followed through a slide."""
    devices = build_mock(MockSettings(force={**QUIET, "latency_us": 0, "arrival_jitter_us": 0.0}))
    assert isinstance(devices.force, MockForceSensor)
    load = ToolLoad(devices.world, devices.force, CONTROLLER, 50.0)
    go_to(devices, 2.4)
    devices.force.start()
    move(devices, 2.0, 2.4, 2.0)
    load.follow()
    return devices, load


def controller_s(devices: Any, true_ns: int) -> float:
    return (true_ns + devices.world.past_ns) * 1e-9 + OFFSET_S


def test_the_tool_feels_the_plates_reaction(pressed: tuple[Any, ToolLoad]) -> None:
    devices, load = pressed
    world = devices.world
    wrench = world.physics.wrench
    at_ns = world.now_ns - 40_000_000
    felt = load.at(controller_s(devices, at_ns))
    assert felt is not None
    on_plate = wrench.at(np.array([at_ns]))[0]
    plane = world.plane
    taught = [plane.pose(*place).xyz_mm for place in ((0, 0, 0), (60, 0, 0), (0, 60, 0))]
    frame = PlateFrame.taught(taught)
    to_plate = np.array(frame.force_matrix(Mounting(axes="base", feels="arm")))
    assert to_plate @ felt[:3] == pytest.approx(on_plate[:3], abs=1e-3)
    # about the tip, 1 mm or more from the plate's centre: r x F less
    tip_m = world.path.states(np.array([at_ns]))[0, 6:9] * 1e-3
    assert tip_m[0] > 1e-3
    assert to_plate @ felt[3:] == pytest.approx(
        on_plate[3:] - np.cross(tip_m, on_plate[:3]), abs=1e-5
    )


def test_a_load_is_known_as_far_as_the_scene_has_come(pressed: tuple[Any, ToolLoad]) -> None:
    devices, load = pressed
    now_s = controller_s(devices, devices.world.now_ns)
    assert load.at(now_s + 0.02) is None
    before = load.at(now_s - 0.1)
    devices.clock.wait(0.05)
    load.follow()
    assert load.at(now_s + 0.02) is not None
    assert load.at(now_s - 0.1) == before
    assert load.at(now_s - 60.0) is not None  # older than what is kept: the oldest


def test_before_any_load_nothing_is_known() -> None:
    devices = build_mock(MockSettings(force={}))
    load = loose(ToolLoad)(devices.world, devices.force, CONTROLLER, 50.0)
    assert load.at(OFFSET_S) is None


def test_a_load_beyond_the_range_is_reported_once() -> None:
    devices = build_mock(MockSettings(force=QUIET))
    load = loose(ToolLoad)(devices.world, devices.force, CONTROLLER, 1.0)
    assert devices.force is not None
    devices.force.start()
    go_to(devices, 2.4)
    assert load.follow()
    devices.clock.wait(0.1)
    assert not load.follow()


# -- in the packets of a UR controller -----------------------------------------------------


class Later:
    """A load that is known up to a time: as many newtons as seconds."""

    def __init__(self) -> None:
        self.known_s = 0.0

    def __call__(self, t_s: float) -> list[float] | None:
        return None if t_s > self.known_s else [t_s, 0.0, 0.0, 0.0, 0.0, 0.0]


def controller(load: Later) -> tuple[UrProgram, Client]:
    still = StraightMotion(Pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))
    program = UrProgram(still, 800.0, [0.0] * 6, lambda t_s: 0, lambda kind: None)
    program.tool_load = load
    client = loose(Client)(None)
    names = b"timestamp,actual_TCP_force,output_int_register_2"
    assert client.ask_outputs(struct.pack(">d", 500.0) + names, 500) == (
        b"\x01DOUBLE,VECTOR6D,INT32"
    )
    return program, client


def sent(program: UrProgram, client: Client) -> list[tuple[float, float, int]]:
    """Time, first force and register of each packet that goes out."""
    found = [struct.unpack(">d6di", body[1:]) for body in client.packets(program)]
    return [(values[0], values[1], values[7]) for values in found]


def test_packets_wait_for_their_load_and_keep_their_cycle() -> None:
    load = Later()
    program, client = controller(load)
    for cycle in range(1, 6):
        program.ints_out[2] = cycle
        client.cycle(program, float(cycle))
    assert sent(program, client) == []
    load.known_s = 3.5
    assert sent(program, client) == [(1.0, 1.0, 1), (2.0, 2.0, 2), (3.0, 3.0, 3)]
    load.known_s = 9.0
    assert sent(program, client) == [(4.0, 4.0, 4), (5.0, 5.0, 5)]


def test_a_load_is_taken_for_zero_from_the_time_of_the_request_on() -> None:
    load = Later()
    program, client = controller(load)
    program.cycle(2.0)
    program._execute(8)
    for cycle in (1, 2, 3):
        client.cycle(program, float(cycle))
    assert sent(program, client) == []
    load.known_s = 3.0
    assert [force for _, force, _ in sent(program, client)] == [1.0, 0.0, 1.0]


def test_a_packet_without_the_load_waits_for_nothing() -> None:
    program, _ = controller(Later())
    client = loose(Client)(None)
    client.ask_outputs(struct.pack(">d", 500.0) + b"timestamp", 500)
    client.cycle(program, 7.0)
    (body,) = client.packets(program)
    assert struct.unpack(">d", body[1:]) == (7.0,)
