"""A whole simulated rig, put together: what a rig file of the kind `mock` stands for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from rigs.mock.arm import MockArm
from rigs.mock.event_camera import MockEventCamera
from rigs.mock.frame_camera import MockFrameCamera
from rigs.mock.guard import on_cable, on_disk
from rigs.mock.people import MockPlate, SimulatedOperator, VirtualClock
from rigs.mock.settings import MockSettings
from rigs.mock.sync import MockSyncBox
from rigs.mock.truth import truth_of
from rigs.mock.world import World
from storage.streams import Sink


@dataclass(frozen=True)
class MockDevices:
    """All devices of one simulated rig; they share one world and its virtual clock."""

    clock: VirtualClock
    arm: MockArm
    events: MockEventCamera
    frames: MockFrameCamera
    sync: MockSyncBox
    plate: MockPlate
    operator: SimulatedOperator
    world: World

    def begin_trial(self, seed: int) -> None:
        """Make what follows depend on `seed` and the program alone; see `World.begin_trial`."""
        self.world.begin_trial(seed)

    def sink(self, sink: Sink) -> Sink:
        """Where streams go in this world, whose disk may be full."""
        return on_disk(sink, self.world)

    def truth(self, reference_true_ns: int, threshold_px: float = 2.0) -> dict[str, Any]:
        """What really happened since `reference_true_ns`; see `rigs.mock.truth.truth_of`."""
        return truth_of(self.world, self.sync.clock, reference_true_ns, threshold_px)


def build_mock(settings: MockSettings) -> MockDevices:
    """The devices of a simulated rig. The same settings give the same rig."""
    world = World(settings)
    sync = MockSyncBox(world)
    return MockDevices(
        clock=VirtualClock(world),
        arm=on_cable(MockArm(world, sync), "arm", world),
        events=on_cable(MockEventCamera(world, sync), "event_camera", world),
        frames=on_cable(MockFrameCamera(world, sync), "frame_camera", world),
        sync=on_cable(sync, "sync_box", world),
        plate=MockPlate(world),
        operator=SimulatedOperator(world),
        world=world,
    )


__all__ = [
    "MockArm",
    "MockDevices",
    "MockEventCamera",
    "MockFrameCamera",
    "MockPlate",
    "MockSyncBox",
    "SimulatedOperator",
    "VirtualClock",
    "World",
    "build_mock",
]
