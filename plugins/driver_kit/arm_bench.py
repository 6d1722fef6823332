"""Bench of an arm: its driver on its fake controller, whose true motion is known."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from sliplab.plugins.driver_kit.bench import DeviceBench, wraps_s
from sliplab.plugins.driver_kit.rule import Bounds, NotTried, RuleViolation
from sliplab.rigs.core.arm_settings import ArmLimits, BaseArmSettings
from sliplab.rigs.core.capabilities import (
    Arm,
    ArmFault,
    ArmState,
    Pose,
    Progress,
    RigError,
    Segment,
)
from sliplab.rigs.core.driver import ArmDriver, ArmScene
from sliplab.rigs.core.fake_motion import (
    ControllerClock,
    StraightMotion,
    StraightMove,
    running_clock,
)
from sliplab.rigs.core.fakes import HOME, FakeController, Kind
from sliplab.rigs.core.pose import distance_mm

REACH_MM = 5_000.0
SPEED_MM_S = 40.0
"""Speed of the bench's moves, where the limits allow it."""
SHORT_MM = 3.0
LONG_SHARE = 0.8
"""Length of a long move, as a share of the distance from the workspace's centre to its side."""
BEGUN_MM = 0.5
"""A motion has begun after this distance."""
CLOCK_S = 1000.0
"""Time of the fake controller's clock when it is made, s."""
PULSE_S, PULSE_EVERY_S = 0.14, 0.4
"""Length of a pulse on the fake's sync input, and mean time from one to the next, s."""
_JITTER_S = (0.0, 0.08, 0.03, 0.11, 0.05)


def pulse_s(number: int) -> float:
    """Return the time of a rising edge on the fake's sync input, s; intervals are irregular."""
    return number * PULSE_EVERY_S + _JITTER_S[number % len(_JITTER_S)]


def sync_level(t_s: float) -> bool:
    """Return the level of the fake's sync input at a time of the controller's clock, s."""
    number = int(t_s / PULSE_EVERY_S)
    return any(0.0 <= t_s - pulse_s(near) < PULSE_S for near in (number - 1, number))


Load = Callable[[float], Sequence[float]]
"""Force (N) and torque (N m) on the tool, base axes, by the controller's time in s."""


class ArmBench(DeviceBench):
    """An arm in the centre of its workspace, which is at rest and not connected yet.

    Args:
        settings: settings of a rig file, with limits in the base frame; the fake listens at its
            address.
        load: on the tool of an arm that measures it; None: a tool that touches nothing.

    Attributes:
        axis: unit vector of turns, none of the base frame's axes.
        twists: True if the driver declares that the arm turns its tool on the spot.
        wraps_s: times of the fake's clock at which counters wrap, s.
        host_clock: True if the controller has no clock: it reports poses when it is asked.
        sync_read: True once the fake has read the level of its sync input.
    """

    axis = 0.48, 0.6, 0.64
    twists = True
    host_clock = False
    sync_read = False
    clock: ControllerClock | None = None
    wraps_s: tuple[float, ...] = ()

    def __init__(
        self,
        driver: ArmDriver[Any],
        settings: BaseArmSettings,
        bounds: Bounds,
        load: Load | None = None,
    ) -> None:
        super().__init__(bounds)
        self._build = driver.builder(load is not None)
        self._load = load or (lambda t_s: (0.0,) * 6)
        if driver.fake is None:
            raise NotTried(f"{driver.name} declares no `fake`, on which rules are tried")
        self.driver, self._fake, self.twists = driver, driver.fake, driver.twists
        if settings.limits.frame != "base":
            raise ValueError("limits.frame: must be base for a conformance test, not plate")
        self.home = Pose(_centre(settings.limits), HOME.rotvec_deg)
        self._make(settings, CLOCK_S)

    def _make(self, settings: BaseArmSettings, clock_s: float) -> None:
        self.settings, self.limits = settings, settings.limits
        self.host_clock = settings.host_clock
        self._lines: list[tuple[float, StraightMove]] = []
        motion = StraightMotion(self.home, lambda line, t_s: self._lines.append((t_s, line)))
        self.clock = running_clock(offset_s=clock_s)
        self.sync_read = False
        scene = ArmScene(motion, self.clock, self._sync, REACH_MM, self._load)
        self.fake: FakeController = self._fake(settings, scene)
        self.wraps_s = wraps_s(self.fake)
        self.fake.start()
        self.arm: Arm = self._build(settings)

    def restart(self, clock_s: float = CLOCK_S, limits: ArmLimits | None = None) -> None:
        """Close device and fake, and make others, whose clock shows another time.

        Args:
            limits: for both; those of the rig file's settings if left out.

        Raises:
            NotTried: this bench cannot.
        """
        if self.clock is None:
            raise NotTried("the clock of this bench cannot be set")
        with suppress(RigError):
            self.call("close", self.close_device)
        self.close_fake()
        settings = self.settings
        if limits is not None:
            settings = settings.model_copy(update={"limits": limits})
        self._make(settings, clock_s)

    # -- the truth -------------------------------------------------------------------------

    def host_ns(self) -> int:
        """Return the host's monotonic clock, ns."""
        return time.monotonic_ns()

    def clock_s(self) -> float:
        """Return the true time of the controller's clock, s. Raises NotTried: it is unknown."""
        if self.clock is None:
            raise NotTried("this bench does not know the controller's clock")
        return self.clock.now_s()

    def _sync(self, t_s: float) -> bool:
        self.sync_read = True
        return sync_level(t_s)

    def true_pose(self, t_s: float) -> Pose:
        """Return the true pose at a time of the controller's clock, s. Raises NotTried."""
        if self.clock is None:
            raise NotTried("this bench does not know the true motion")
        if not self._lines and distance_mm(self.place(), self.home) > BEGUN_MM:
            raise NotTried("the fake moves by another motion than that of its scene")
        for since_s, line in reversed(self._lines):
            if since_s <= t_s:
                return line.pose(t_s)
        return self.home

    def open(self) -> None:
        """Connect the arm. Raises ArmFault."""
        self.arm.connect()

    def close_device(self) -> None:
        """Close the arm; one that is lost while it may move says so, which is right."""
        self.arm.close()

    def close_fake(self) -> None:
        """Close the fake controller."""
        self.fake.close()

    def connect(self) -> None:
        """Connect within the bound. Raises Seen or RigError."""
        self.call("connect", self.open, self.bounds.connect_s)

    def inject(self, kind: Kind) -> None:
        """Inject a fault now. Raises NotTried: the fake does not simulate it."""
        try:
            self.fake.inject(kind)
        except ValueError as error:
            raise NotTried(f"the fake cannot simulate '{kind.value}': {error}") from None

    def restore(self) -> None:
        """Clear every fault, as a person would at the pendant."""
        self.fake.restore()

    def place(self) -> Pose:
        """Return where the tool centre point truly is."""
        return self.fake.pose()

    def moving(self) -> bool:
        """Return whether the arm truly moves."""
        return self.fake.moving()

    # -- paths -----------------------------------------------------------------------------

    @property
    def speed_mm_s(self) -> float:
        """Speed of the moves."""
        return min(SPEED_MM_S, self.limits.speed_mm_s)

    def to(self, y_mm: float) -> Segment:
        """Return a move to a place off the centre of the workspace, without turning."""
        x, y, z = self.home.xyz_mm
        turn = self.arm.pose().rotvec_deg
        return Segment(Pose((x, y + y_mm, z), turn), self.speed_mm_s)

    @property
    def long_mm(self) -> float:
        """Return the length of a long move from the centre."""
        return LONG_SHARE * (self.limits.high_mm[1] - self.limits.low_mm[1]) / 2

    def start(self, *path: Segment) -> None:
        """Start a path. Raises Seen or RigError."""
        self.call("start", lambda: self.arm.start(path))

    def start_long(self) -> Segment:
        """Start a long move, and wait until the arm moves. Raises Seen or RigError."""
        segment = self.to(self.long_mm)
        self.start(segment)
        begun = self.until(
            lambda: distance_mm(self.place(), self.home) > BEGUN_MM, self.bounds.call_s
        )
        if not begun:
            raise RuleViolation(f"the arm had not moved {self.bounds.call_s:g} s after start")
        return segment

    def end(self, within_s: float) -> Progress:
        """Wait for the end of a path. Raises Seen: it takes longer; RigError: it was aborted."""
        last: list[Progress] = []

        def done() -> bool:
            last[:] = [self.call("progress", self.arm.progress)]
            return last[0].done

        if not self.until(done, within_s):
            raise RuleViolation(
                f"progress was not done {within_s:g} s later, its state {last[0].state}"
            )
        return last[0]

    def arrive(self, segment: Segment) -> Progress:
        """Make a move to its end. Raises Seen or RigError."""
        seconds = distance_mm(self.place(), segment.to) / segment.speed_mm_s
        self.start(segment)
        return self.end(seconds + self.bounds.news_s)

    # -- faults ----------------------------------------------------------------------------

    def state(self) -> ArmState:
        """Return the state that the driver reports."""
        return self.call("state", self.arm.state)

    def now_ns(self) -> int:
        """Return the controller's clock that the driver reports, ns."""
        return self.call("now_ns", self.arm.now_ns)

    def healthy(self) -> bool:
        """Return whether the driver still takes the arm for one that can move."""
        return self.state().healthy

    def fault_noticed(self) -> bool:
        """Return whether state, progress or pose report a fault now."""

        def seen(work: Callable[[], object], name: str) -> bool:
            return self.refusal(name, work) is not None

        return (
            not self.healthy()
            or seen(self.arm.progress, "progress")
            or seen(self.arm.pose, "pose")
            or seen(self.arm.read_poses, "read_poses")
        )

    def check_at_rest(self, quiet_s: float) -> None:
        """Raise Seen if the arm moves now, or within a time."""
        if self.moving():
            raise RuleViolation("the arm was still moving when the call returned")
        before = self.place()
        self.wait(quiet_s)
        moved = distance_mm(before, self.place())
        if moved > 0.05 or self.moving():
            raise RuleViolation(f"the arm moved on by {moved:.2f} mm within {quiet_s:g} s")

    def stop(self) -> ArmFault | None:
        """Stop the arm; return the ArmFault of a stop that cannot be confirmed."""
        error = self.refusal("stop", self.arm.stop)
        if error is not None and not isinstance(error, ArmFault):
            raise RuleViolation(f"stop raised {error!r}, which is no ArmFault") from error
        return error

    def read_times(self) -> tuple[list[int], list[int]]:
        """Return times of the poses since the last call, and of their arrival, ns."""
        poses = self.call("read_poses", self.arm.read_poses)
        return poses.t_ns.tolist(), poses.host_ns.tolist()


def _centre(limits: ArmLimits) -> tuple[float, float, float]:
    """Return the centre of the box, in steps of 1/4 mm, which every number format has."""
    middle = (np.array(limits.low_mm) + np.array(limits.high_mm)) / 2
    x, y, z = (np.round(4.0 * middle) / 4.0).tolist()
    return float(x), float(y), float(z)
