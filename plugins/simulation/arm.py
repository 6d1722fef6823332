"""The simulated arm: follows straight lines exactly and reports its poses on its own clock."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sliplab.plugins.simulation.clocks import FaultyClock, Lateness, Noise, undisturbed
from sliplab.plugins.simulation.path import TOOL, Leg
from sliplab.plugins.simulation.sync import MockSyncBox, SyncInput
from sliplab.plugins.simulation.world import SimulatedWorld
from sliplab.rigs.core.capabilities import ArmFault, ArmState, Pose, Progress, Segment
from sliplab.storage.streams import PoseChunk, PulseChunk

BACKLOG_NS = 120_000_000_000
"""Age above which unread poses are dropped."""


class MockArm:
    """A simulated arm: each segment has its full speed from the start, but for `arm_ramp`.

    Args:
        wired: True if the sync line reaches its digital input.
    """

    def __init__(self, world: SimulatedWorld, box: MockSyncBox, *, wired: bool = True) -> None:
        self._world, self._wired = world, wired
        self._input = SyncInput(world, box, "arm")
        self._connected = False
        self._period_ns = round(1e9 / world.settings.arm.pose_rate_hz)
        self._legs: list[Leg] = []
        self._begin()
        world.at_begin(self._begin)

    def _begin(self) -> None:
        world = self._world
        self._legs = []
        self._cycles = undisturbed(world.clocks.arm)
        self._first = -(-self._cycles.to_reference(world.now_ns) // self._period_ns)
        self._read = self._first
        self._noise = Noise(world.seed, "pose noise", 3)
        late_us = world.settings.arm.arrival_jitter_us
        self._late = Lateness(world.seed, "arm reception", late_us)
        self._arrived_ns = 0

    def connect(self) -> None:
        """Open the connection."""
        self._connected = True
        self._input.skip()

    def state(self) -> ArmState:
        """The arm's state now."""
        if not self._connected:
            return ArmState.DISCONNECTED
        if not self._world.arm_state.healthy:
            return self._world.arm_state
        moving = self._world.path.moving(self._world.now_ns)
        return ArmState.MOVING if moving else ArmState.READY

    def pose(self) -> Pose:
        """Return the current tool centre point."""
        state = self._world.path.states(np.array([self._world.now_ns], np.int64))[0].tolist()
        return Pose((state[0], state[1], state[2]), (state[3], state[4], state[5]))

    def now_ns(self) -> int:
        """The controller's clock now."""
        return self._world.clocks.arm.to_reference(self._world.now_ns)

    def start(self, path: Sequence[Segment]) -> None:
        """Begin to follow `path`. Raises ArmFault, or RigError if moving."""
        state = self.state()
        if not state.healthy:
            raise ArmFault("arm", f"cannot move: {state.value}; {state.advice}")
        self._legs = self._world.start_arm(path)

    def progress(self) -> Progress:
        """Return the progress of the last path; `done` once it ended or was stopped."""
        world, clock = self._world, self._world.clocks.arm
        finished = tuple(
            (clock.to_reference(leg.start_ns), clock.to_reference(leg.end_ns))
            for leg in self._legs
            if leg.end_ns <= world.now_ns and leg in world.path.legs
        )
        return Progress(self.state(), finished, not world.path.moving(world.now_ns))

    def read_poses(self) -> PoseChunk:
        """Return the poses since the last call, one per controller cycle.

        A faulty clock stamps them wrongly; the cycles themselves continue.
        """
        world, settings = self._world, self._world.settings.arm
        clock, latency = self._cycles, settings.latency_us * 1000
        oldest = clock.to_reference(max(world.now_ns - BACKLOG_NS, 0))
        first = max(self._read, -(-oldest // self._period_ns))
        end = clock.to_reference(world.now_ns) // self._period_ns + 1
        cycles = np.arange(first, max(end, first), dtype=np.int64)
        true = clock.to_device(cycles * self._period_ns)
        host = true + latency + self._late.ns(cycles - self._first)
        # in order: a late pose delays the next one
        host = np.maximum(np.maximum.accumulate(host), self._arrived_ns)
        here = int(np.searchsorted(host, world.now_ns, side="right"))
        self._read = first + here
        cycles, true, host = cycles[:here], true[:here], host[:here]
        self._arrived_ns = max(self._arrived_ns, int(host.max(initial=0)))
        state = world.path.states(true, TOOL)
        xyz = state[:, :3] + self._noise.of(cycles - self._first) * (settings.pose_noise_um * 1e-3)
        stamps = cycles * self._period_ns
        if isinstance(world.clocks.arm, FaultyClock):
            stamps = world.clocks.arm.to_reference(true)
        return PoseChunk(stamps, host, xyz, state[:, 3:].copy())

    def read_pulses(self) -> PulseChunk:
        """Sync pulses seen by the digital input, controller clock; none where it is not wired."""
        if not self._wired:
            return PulseChunk(np.empty(0, np.int64))
        stamp = self._world.clocks.arm.to_reference(self._input.edges_ns())
        grid = self._world.settings.arm.input_sampling_us * 1000
        return PulseChunk(-(-stamp // grid) * grid if grid else stamp)

    def stop(self) -> None:
        """Stop now."""
        self._world.halt_arm(self._world.now_ns, self._world.arm_state)

    def close(self) -> None:
        """Close the connection."""
        self._connected = False
