"""The example gripper on its fake: motion by speed, stall by force, and late answers."""

from __future__ import annotations

import socket
from collections.abc import Iterator

import pytest

from sliplab.plugins.driver_kit.examples.gripper import DRIVER, ExampleGripperSettings
from sliplab.plugins.driver_kit.examples.gripper.driver import ExampleGripper
from sliplab.plugins.driver_kit.examples.gripper.fake import FakeExampleGripper
from sliplab.plugins.reflex.robotiq_2f.fake import ElasticObject
from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.core.driver import GripperScene
from sliplab.rigs.core.finger_motion import FingerMotion

MS = 1_000_000
SETTINGS = ExampleGripperSettings(opening_mm=40)


class Bench:
    """A gripper that is half open, on a clock that the test turns; an object of 30 mm, 50 N/mm."""

    def __init__(self) -> None:
        self.now_ns = 0
        fingers = FingerMotion(40.0, 0, 1e6)
        self.held = ElasticObject(fingers, 30.0, 50.0)
        self.fake = FakeExampleGripper(GripperScene(fingers, lambda: self.now_ns))
        assert DRIVER.reach is not None
        self.gripper = ExampleGripper(DRIVER.reach(SETTINGS, self.fake.address))
        self.gripper.connect()

    def wait(self, ms: float) -> None:
        """Let time pass, after what was sent has come."""
        self.gripper.state()
        self.held.feel(self.now_ns)
        self.now_ns += round(ms * MS)
        self.held.feel(self.now_ns)


@pytest.fixture
def bench() -> Iterator[Bench]:
    made = Bench()
    yield made
    made.gripper.close()
    made.fake.close()


def test_fingers_go_at_their_speed_and_stall_at_an_object_by_their_force(bench: Bench) -> None:
    bench.gripper.move(20.0, 50.0, 25.0)
    bench.wait(100)
    state = bench.gripper.state()
    assert (state.moving, state.stalled) == (True, False)
    assert state.opening_mm == pytest.approx(35.0)
    bench.wait(1000)
    state = bench.gripper.state()
    assert (state.moving, state.stalled) == (False, True)
    assert state.opening_mm == pytest.approx(30.0 - 25.0 / 50.0, abs=0.051)  # steps of 0.1 mm


def test_an_opening_between_two_steps_is_the_wider_one(bench: Bench) -> None:
    for wanted, reached in ((33.31, 33.4), (33.3, 33.3), (80.0, 80.0)):
        bench.gripper.move(wanted, 100.0, 5.0)
        bench.wait(1000)
        assert bench.gripper.state().opening_mm == pytest.approx(reached)


def test_a_late_answer_is_not_that_of_the_next_question() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        gripper = ExampleGripper(SETTINGS)
        gripper._socket = socket.create_connection(server.getsockname())
        device, _ = server.accept()
        with device:
            device.sendall(b"STATE 0 400 READY\nSTATE 1 300 MOVING\n")
            assert gripper.state().opening_mm == pytest.approx(30.0)
            device.sendall(b"STATE 2 mm\n")
            with pytest.raises(RigError, match="gripper: no valid answer"):
                gripper.state()
        gripper.close()
