"""Driver of ABB arms behind the small RAPID socket server, for labs that already run it.

The server's limits shape this driver. It has no stop command, so a path is sent in pieces of at
most `segment_s` seconds, and a stop waits for the current piece. It answers nothing during a move,
so poses are known only between pieces. It reports no time, so times are the host's. It reports no
safety state, so a protective stop appears as a move without an answer. `plugins.devices.abb.driver`
has none of these limits.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import TypeVar

from sliplab.plugins.abb_socket.settings import AbbSocketSettings
from sliplab.plugins.abb_socket.wire import RapidError, RapidSocket, ServerCommand, socket_health
from sliplab.rigs.core.capabilities import (
    ArmFault,
    ArmState,
    DeviceHealth,
    Pose,
    RigError,
    Segment,
)
from sliplab.rigs.core.pose import angle_deg, between, distance_mm, from_quaternion, quaternion
from sliplab.rigs.core.pose_stream import PoseCheck, PoseJumpError, Sample
from sliplab.rigs.core.threaded_arm import Run, ThreadedArm
from sliplab.storage.streams import PoseChunk

T = TypeVar("T")
ANSWER_S = 2.0
"""Timeout to connect, and of every request except a move, s."""
OVERTIME_S = 3.0
"""Time beyond twice its duration after which a move counts as lost, s."""
TURN_DEG_S = 20.0
"""Reorientation speed during a move."""
ZONE = (0, 0.3, 0.3, 0.03)
"""Zone between the pieces of one segment: a fly-by point, RAPID's z0."""
FINE = (1, 0.0, 0.0, 0.0)
"""Zone at the end of a segment: a fine point, at rest."""
STILL_MM, STILL_S = 0.001, 0.02
"""Largest motion within a time for which the arm counts as at rest, mm and s."""
ARRIVED_MM = 0.1
"""A segment that ends farther than this from its target was stopped from outside."""


class AbbSocketArm(ThreadedArm):
    """An ABB arm driven by the RAPID socket server; an `Arm` of `rigs.core.capabilities`."""

    def __init__(self, settings: AbbSocketSettings) -> None:
        super().__init__(settings.limits)
        self._settings = settings
        self._link: RapidSocket | None = None
        self._info = ""
        self._check_pose = PoseCheck(settings.limits.speed_mm_s)
        self._start_pose = Pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
        self._one = threading.Lock()
        self._may_move = False
        """True from the start of a path until the arm is confirmed at rest."""

    def connect(self) -> None:
        """Connect, set the tool, and check that the arm is at rest. Takes at most 7 `ANSWER_S`.

        Raises:
            ArmFault: no connection, no answer (another client may hold it), or the arm moves.
        """
        if self._lost is None:
            return
        tool, settings = self._settings.tool, self._settings
        frame = Pose(tool.tcp_mm, tool.tcp_rotvec_deg)
        try:
            self._link = RapidSocket(settings.host, settings.port, ANSWER_S)
            self._info = self._link.info(ANSWER_S)
            self._check_pose = PoseCheck(settings.limits.speed_mm_s)
            self._ask(ServerCommand.SET_TCP, frame.xyz_mm, quaternion(frame))
            self._ask(ServerCommand.SET_WORK_OBJECT, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
            self._settle(self._link)
        except RapidError as error:
            self._release()
            raise ArmFault(
                "arm",
                f"{error}; the server accepts one client: end the other, or check the power",
            ) from None
        self._lost, self._may_move = None, False

    def state(self) -> ArmState:
        """Return ready, moving or disconnected; the server reports no more."""
        if self._lost is not None:
            return ArmState.DISCONNECTED
        return ArmState.READY if self._run.done else ArmState.MOVING

    def pose(self) -> Pose:
        """Return the current pose if the arm is at rest, else the pose before this piece."""
        if self._run.done and self._lost is None:
            with self._one:
                self._watched(self._read_pose)
        last = self._stream.last
        if last is None:
            raise self._fault(self.state(), "has no pose")
        return last.pose

    def now_ns(self) -> int:
        """Return the host's monotonic clock, which is this arm's clock, ns."""
        return time.monotonic_ns()

    def health(self) -> DeviceHealth:
        """Return the server's description as read on connecting."""
        return socket_health(self._info)

    def start(self, path: Sequence[Segment]) -> None:
        """Start to follow `path` in pieces of at most `segment_s` each.

        Takes at most 2 `ANSWER_S`.

        Raises:
            GuardError: a limit forbids the path; nothing was sent.
            ArmFault: no connection, or no answer.
            RigError: it is still moving, the path is empty, or it has a turn on the spot.
        """
        self._refuse(path, moving=not self._run.done)
        if any(segment.turn_deg_s is not None for segment in path):
            raise RigError("arm", "rests between pieces and cannot twist evenly: use driver 'abb'")
        if self._lost is not None:
            raise self._fault(self.state(), "cannot move")
        begin = self.pose()
        self._guard.check(begin, path)
        with self._one:
            self._guard.check_joints(self._watched(lambda: self._ask(ServerCommand.JOINTS)))
        self._start_pose = begin
        self._run, self._may_move = Run(path), True
        self._begin(self._run)

    def read_poses(self) -> PoseChunk:
        """Return poses since the last call, host's clock: one per piece, and one now if at rest.

        Takes at most `ANSWER_S`. Raises ArmFault if an arm at rest does not answer.
        """
        if self._run.done and self._lost is None:
            with self._one:
                self._watched(self._read_pose)
        return self._stream.read()

    def stop(self) -> None:
        """Send no further piece and wait for the current one: the protocol has no stop command.

        If the connection was lost, a new one is opened to check that the arm is at rest. Takes at
        most 2 `segment_s` + `OVERTIME_S` + 4 `ANSWER_S`.

        Raises:
            ArmFault: the current piece did not end in time, or the arm is not confirmed at rest.
        """
        run = self._run
        run.cancelled = True
        if run.thread is not None and run.thread is not threading.current_thread():
            run.join(self._bound_s(self._settings.segment_s) + ANSWER_S)
            if not run.done:
                raise ArmFault("arm", "does not finish its move: press its emergency stop")
        if self._may_move:
            self._confirm_rest()

    def stopping_s(self, speed_mm_s: float) -> float:
        """Return the longest time at full speed after a stop: one segment."""
        return self._settings.segment_s

    def close(self) -> None:
        """Send no further piece, and close the connection for the next client.

        Raises:
            ArmFault: the arm is not confirmed at rest; the connection is closed all the same.
        """
        try:
            self.stop()
        finally:
            self._release()

    def _confirm_rest(self) -> None:
        """Confirm that the arm is at rest, over a new connection if the old one is lost.

        Raises:
            ArmFault: this was not confirmed.
        """
        settings = self._settings
        try:
            with self._one:
                if self._lost is None:
                    self._settle(self._link)
                else:
                    self._hang_up()  # the server accepts one client at a time
                    link = RapidSocket(settings.host, settings.port, ANSWER_S)
                    try:
                        self._settle(link)
                    finally:
                        link.close()
        except RapidError as error:
            raise ArmFault(
                "arm",
                f"is not confirmed at rest ({error}); it may have moved on for at most "
                f"{settings.segment_s:g} s, and no further move follows: check it, and press its "
                "emergency stop if it moves",
            ) from None
        self._may_move = False

    def _release(self) -> None:
        """Close the connection."""
        self._lost = self._lost or "closed"
        self._hang_up()
        self._run.done = True

    def _hang_up(self) -> None:
        link, self._link = self._link, None
        if link is not None:
            link.close()

    def _abort(self) -> None:
        """Send nothing more: the arm stops at the end of the current piece."""

    def _follow_path(self, run: Run) -> None:
        """Send the path piece by piece."""
        at = self._start_pose
        for segment in run.path:
            start_ns = time.monotonic_ns()
            make = partial(self._segment, run, at, segment)
            with self._one:
                arrived = self._watched(make)
            if not arrived:
                return
            run.finished.append((start_ns, time.monotonic_ns()))
            at = segment.to
        self._may_move = False

    def _segment(self, run: Run, begin: Pose, segment: Segment) -> bool:
        """Run one segment; return whether its end was reached. Raises RapidError."""
        seconds = distance_mm(begin, segment.to) / segment.speed_mm_s
        seconds = max(seconds, angle_deg(begin, segment.to) / TURN_DEG_S)
        pieces = max(1, math.ceil(seconds / self._settings.segment_s))
        self._ask(ServerCommand.SET_SPEED, segment.speed_mm_s, TURN_DEG_S)
        self._ask(ServerCommand.SET_ZONE, ZONE if pieces > 1 else FINE)
        for piece in range(1, pieces + 1):
            if run.cancelled:
                self._settle(self._link)
                self._may_move = False
                return False
            if piece == pieces > 1:
                self._ask(ServerCommand.SET_ZONE, FINE)
            target = between(begin, segment.to, piece / pieces)
            bound_s = self._bound_s(seconds / pieces)
            self._ask(
                ServerCommand.MOVE_LINEAR, target.xyz_mm, quaternion(target), within_s=bound_s
            )
            self._read_pose()
        last = self._stream.last
        return last is not None and distance_mm(last.pose, segment.to) <= ARRIVED_MM

    def _settle(self, link: RapidSocket | None) -> None:
        """Wait until the arm is at rest: a fly-by move is answered early. Raises RapidError."""
        deadline, poll = time.monotonic() + ANSWER_S, threading.Event()
        before = None
        while time.monotonic() < deadline:
            self._read_pose(link)
            here = self._stream.last
            if before is not None and here and distance_mm(before.pose, here.pose) < STILL_MM:
                return
            before = here
            poll.wait(STILL_S)
        raise RapidError("the arm does not come to rest")

    def _read_pose(self, link: RapidSocket | None = None) -> None:
        """Read the pose; its time is the middle of the request. Raises RapidError."""
        asked = time.monotonic_ns()
        link = self._link if link is None else link
        if link is None:
            raise RapidError("there is no connection")
        values = link.ask(ServerCommand.POSE, within_s=ANSWER_S)
        answered = time.monotonic_ns()
        pose = from_quaternion(values[:3], values[3:])
        try:
            believed = self._check_pose.believes(asked, answered, pose)
        except PoseJumpError as error:
            raise RapidError(str(error)) from None
        if not believed:
            raise RapidError("the answer to POSE is one that the arm cannot have reached")
        self._stream.add(Sample((asked + answered) // 2, answered, pose.xyz_mm, pose.rotvec_deg))

    def _ask(
        self,
        command: ServerCommand,
        *arguments: float | Sequence[float],
        within_s: float = ANSWER_S,
    ) -> tuple[float, ...]:
        if self._link is None:
            raise RapidError("there is no connection")
        return self._link.ask(command, *arguments, within_s=within_s)

    def _watched(self, work: Callable[[], T]) -> T:
        """Run requests and return their result; without an answer the connection is lost.

        Raises:
            ArmFault: no answer, or a refusal.
        """
        try:
            return work()
        except RapidError as error:
            self._lost = str(error)
            raise ArmFault(
                "arm",
                f"{error}; it may be in a protective or emergency stop, which this server does "
                "not report: check it, then connect again",
            ) from None

    def _bound_s(self, seconds: float) -> float:
        return 2 * seconds + OVERTIME_S
