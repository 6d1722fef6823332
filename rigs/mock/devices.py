"""A whole simulated rig, put together: what a rig file of the kind `mock` stands for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from sliplab.protocols.timing import Timing
from sliplab.rigs.mock.arm import MockArm
from sliplab.rigs.mock.event_camera import MockEventCamera
from sliplab.rigs.mock.frame_camera import MockFrameCamera
from sliplab.rigs.mock.free_run import ExposureLine, FreeRun
from sliplab.rigs.mock.guard import on_cable, on_disk
from sliplab.rigs.mock.people import MockPlate, SimulatedOperator, VirtualClock
from sliplab.rigs.mock.settings import MockSettings
from sliplab.rigs.mock.sync import MockSyncBox
from sliplab.rigs.mock.truth import clocks_of, truth_of
from sliplab.rigs.mock.world import World
from sliplab.storage.streams import Sink


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
    timing: Timing

    def begin_trial(self, seed: int) -> None:
        """Make what follows depend on `seed` and the program alone; see `World.begin_trial`."""
        self.world.begin_trial(seed)

    def sink(self, sink: Sink) -> Sink:
        """Where streams go in this world, whose disk may be full."""
        return on_disk(sink, self.world)

    def truth(
        self, reference_true_ns: int, hold_true_ns: int | None = None, threshold_px: float = 2.0
    ) -> dict[str, Any]:
        """What really happened since `reference_true_ns`, and what the clocks truly showed.

        See `truth_of` and `clocks_of` in `rigs.mock.truth`.
        """
        stopped_ns = self.sync.stopped_ns
        recorded_ns = (
            self.sync.started_ns,
            (self.world.now_ns if stopped_ns is None else stopped_ns),
        )
        return {
            **truth_of(self.world, self.sync.clock, reference_true_ns, threshold_px, hold_true_ns),
            "clocks": clocks_of(self.world, self.sync.clock, recorded_ns, self.timing.frames),
        }


def build_mock(settings: MockSettings, timing: Timing | None = None) -> MockDevices:
    """The devices of a simulated rig. The same settings give the same rig.

    Args:
        timing: which signals reach which device; left out, all that there are.
    """
    timing = timing or Timing()
    world = World(settings)
    free_run = None if timing.frames == "hardware trigger" else FreeRun(world)
    line = None
    if free_run is not None and timing.frames == "exposure line":
        line = ExposureLine(world, free_run)
    sync = MockSyncBox(world, line)
    arm = MockArm(world, sync, wired=timing.arm == "digital input")
    frames = MockFrameCamera(world, free_run or sync, timing.frames)
    return MockDevices(
        clock=VirtualClock(world),
        arm=on_cable(arm, "arm", world),
        events=on_cable(MockEventCamera(world, sync), "event_camera", world),
        frames=on_cable(frames, "frame_camera", world),
        sync=on_cable(sync, "sync_box", world),
        plate=MockPlate(world),
        operator=SimulatedOperator(world),
        world=world,
        timing=timing,
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
