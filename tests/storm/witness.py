"""Watches the simulated arm from inside its world, which knows where it truly is."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from sliplab.flows.collecting.supervisor import CollectionSupervisor
from sliplab.flows.planning.disk_space import RESERVE
from sliplab.protocols import Plan, Trial
from sliplab.rigs.core.capabilities import ArmState, Segment
from sliplab.rigs.core.rig import Rig
from sliplab.rigs.mock.arm import MockArm
from sliplab.rigs.mock.world import SimulatedWorld
from sliplab.rigs.rig_file import RigFile
from sliplab.storage.trials import control
from tests.storm.virtual import Host, Notes

PLATE_MM = 1.0
"""How far the true plate may lie from the taught one, with its tilt over the reach."""
SLACK_S = 0.3
"""Beyond one poll, until a fault that the poses show has stopped the arm."""


class Witness:
    """Notes each thing that the arm must not do.

    Args:
        file: whose limits hold.

    Attributes:
        resumed: a pause has ended, and depth zero was not found since.
    """

    def __init__(self, file: RigFile, host: Host, notes: Notes) -> None:
        limits = file.limits
        self._depth_mm, self._reach_mm = float(limits.depth), float(limits.reach)
        self._speed_mm_s, self._poll_s = float(limits.speed), float(file.poll)
        self._host, self._notes = host, notes
        self._asked_s: float | None = None
        self._starts = 0
        self._outside: tuple[float, float] | None = None
        self.resumed = False
        self._rezeroes = False

    def wrong(self, invariant: str, what: str) -> None:
        """Note a fault."""
        self._notes.add(wrong=invariant, what=what)

    def stop_asked(self) -> None:
        """Take note that a person asked for a stop, now."""
        if self._asked_s is None:
            self._asked_s, self._starts = self._host.passed_s, 0

    def install(self) -> None:
        """Watch every arm of this process."""
        start, pass_time = MockArm.start, SimulatedWorld.pass_time
        run_trial: Any = Rig.run_trial
        rezero: Any = Rig.rezero

        def starting(arm: MockArm, path: Sequence[Segment]) -> None:
            self._look_at_path(arm._world, path)
            start(arm, path)

        def passing(world: SimulatedWorld, ns: int) -> None:
            pass_time(world, ns)
            self._look(world)

        def rezeroing(rig: Rig, *given: Any) -> Any:
            self.resumed = False
            return rezero(rig, *given)

        def running(rig: Rig, program: Any, sink: Any, *more: Any, **named: Any) -> Any:
            if self.resumed and self._rezeroes:
                self.wrong("a pause may change the rig", "depth zero is not found again after one")
            self.resumed = False
            done = run_trial(rig, program, sink, *more, **named)
            self._notes.add(recorded=getattr(sink, "_sink", sink).folder.name)
            return done

        MockArm.start = starting  # type: ignore[method-assign]
        SimulatedWorld.pass_time = passing  # type: ignore[method-assign]
        Rig.run_trial = running  # type: ignore[method-assign]
        Rig.rezero = rezeroing  # type: ignore[method-assign]

    def watch(self, supervisor: CollectionSupervisor, plan: Plan) -> None:
        """Watch what a collection is allowed between its trials."""
        self._rezeroes = plan.protocol.collection.maintenance.rezero is not None
        may_take = supervisor.may_take

        def asked(trial: Trial) -> bool:
            may = may_take(trial)
            if may and (pause := control.paused(supervisor._store)) is not None:
                self.wrong("requests are carried out", f"goes on in spite of a {pause.kind}")
            if may and self._host.free < RESERVE:
                self.wrong("no trial begins on a full disk", f"{self._host.free} bytes are free")
            return may

        supervisor.may_take = asked  # type: ignore[method-assign]

    def _look_at_path(self, world: SimulatedWorld, path: Sequence[Segment]) -> None:
        here = world.path.states(np.array([world.now_ns], np.int64))[0][6:9]
        if world.arm_state is ArmState.PROTECTIVE_STOP:
            self.wrong("no motion after a stop", f"it is sent on in {world.arm_state.value}")
        for segment in path:
            there = world.plane.sensor(segment.to)
            if self._asked_s is not None:
                self._starts += 1
                aside = math.dist(here[:2], there[:2])
                if self._starts > 1 or aside > 0.5 or there[2] > here[2] + 0.01:
                    self.wrong(
                        "no motion after a stop",
                        f"move {self._starts} goes {aside:.2f} mm aside to {there[2]:.2f} mm deep",
                    )
            if not 0 < segment.speed_mm_s <= self._speed_mm_s + 1e-6:
                self.wrong("within limits", f"is sent at {segment.speed_mm_s} mm/s")
            self._check_place(there, here, "is sent")

    def _excess(self, place: Any) -> float:
        """Return how far a place on the true plate is beyond the limits, mm."""
        return max(float(place[2]) - self._depth_mm, math.hypot(*place[:2]) - self._reach_mm)

    def _check_place(self, place: Any, before: Any, how: str) -> None:
        over = self._excess(place)
        if not over <= max(self._excess(before), 0.0) + PLATE_MM:
            self.wrong("within limits", f"{how} {over:.2f} mm beyond them")

    def _look(self, world: SimulatedWorld) -> None:
        """Look at the arm where it truly is now."""
        now_s, moving = self._host.passed_s, world.path.moving(world.now_ns)
        place = world.path.states(np.array([world.now_ns], np.int64))[0][6:9]
        if self._asked_s is not None and moving and self._starts == 0:
            late = now_s - self._asked_s
            if late > self._poll_s + 1e-3:
                self.wrong("stops in time", f"still moves {late:.3f} s after it was asked to stop")
        over = self._excess(place)
        if not (moving and over > PLATE_MM):
            self._outside = None
        elif self._outside is None or over <= self._outside[1]:  # it may come back
            self._outside = now_s, over
        elif now_s - self._outside[0] > self._poll_s + SLACK_S:
            self.wrong("within limits", f"moves on {over:.2f} mm outside")
