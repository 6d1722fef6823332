"""Driver of the example arm.

The controller takes one client. It answers each line with `OK` and its time in microseconds, or
with `ERROR` and a reason:

    MOVE 400.0 5.0 300.0 180.0 0.0 0.0 1.6      (x y z in mm, rotation vector in deg, mm/s;
                                                 deg/s where the tool turns on the spot)
    STOP

Unasked it sends 500 times a second its time, its pose, its state and the level of its sync input:

    POSE 1000123456 400.000 0.000 300.000 180.000 0.000 0.000 MOVING 0
"""

from __future__ import annotations

import queue
import socket
import threading
import time
from collections.abc import Sequence
from contextlib import suppress

from sliplab.plugins.driver_kit.examples.arm import ExampleArmSettings
from sliplab.rigs.core.capabilities import ArmFault, ArmState, Pose, Segment
from sliplab.rigs.core.pose import angle_deg, distance_mm
from sliplab.rigs.core.pose_stream import Sample
from sliplab.rigs.core.threaded_arm import Run, ThreadedArm, is_at

ANSWER_S = 1.0
"""Time limit of connecting and of every answer, s."""
SILENCE_S = 0.5
"""A controller that has sent nothing for this long is lost, s."""
STILL_S = 1.0
"""Time limit from a stop to the arm at rest, s."""
OVERTIME_S = 2.0
"""Time beyond twice its duration after which a move is given up, s."""
TURN_DEG_S = 20.0
STATES = {
    "READY": ArmState.READY,
    "MOVING": ArmState.MOVING,
    "PROTECTIVE": ArmState.PROTECTIVE_STOP,
    "EMERGENCY": ArmState.EMERGENCY_STOP,
    "OFF": ArmState.NOT_RUNNING,
}
"""The controller's words for its state."""


class ExampleArm(ThreadedArm):
    """A `sliplab.rigs.core.capabilities.Arm`."""

    def __init__(self, settings: ExampleArmSettings) -> None:
        super().__init__(settings.limits)
        self._settings = settings
        self._socket: socket.socket | None = None
        self._reader: threading.Thread | None = None
        self._asking = threading.Lock()
        self._answers = queue.SimpleQueue[str]()
        self._says = ArmState.DISCONNECTED
        self._poses = self._t_ns = 0
        self._may_move = False
        """True from the start of a path until the arm was seen at rest."""

    def connect(self) -> None:
        """Open the connection, and see that poses come; at most 2 `ANSWER_S`. Raises ArmFault."""
        if self._lost is None:
            return
        self._release()
        address = self._settings.host, self._settings.port
        try:
            link = socket.create_connection(address, ANSWER_S)
        except OSError as error:
            raise ArmFault("arm", f"{address}: {error}; check its power and network") from None
        link.settimeout(SILENCE_S)
        self._socket, self._lost, self._poses, self._t_ns = link, None, 0, 0
        self._may_move, self._answers = False, queue.SimpleQueue()
        self._reader = threading.Thread(target=self._read, args=(link,), daemon=True)
        self._reader.start()
        self._stream.wait_for(lambda: self._poses > 0 or self._lost is not None, ANSWER_S)
        if not self._poses:
            self._lose("it sends no poses")
            self._release()
            raise self._fault(ArmState.DISCONNECTED, "cannot connect")

    def state(self) -> ArmState:
        """Return the state in the last pose; a path that is followed counts as moving."""
        if self._lost is not None:
            return ArmState.DISCONNECTED
        if self._says is ArmState.READY and not self._run.done:
            return ArmState.MOVING
        return self._says

    def pose(self) -> Pose:
        """Return the last pose. Raises ArmFault: no connection."""
        return self._last().pose

    def now_ns(self) -> int:
        """Return the controller's time in the last pose, ns. Raises ArmFault: no connection."""
        return self._last().t_ns

    def start(self, path: Sequence[Segment]) -> None:
        """Begin to follow `path` and return at once. Raises ArmFault, GuardError or RigError."""
        state = self.state()
        self._refuse(path, moving=state is ArmState.MOVING)
        if not state.healthy:
            raise self._fault(state, "cannot move")
        self._guard.check(self.pose(), path)
        self._run, self._may_move = Run(path), True
        self._begin(self._run)

    def stop(self) -> None:
        """Stop, and see the arm at rest; at most 2 `ANSWER_S` + `STILL_S`.

        Raises:
            ArmFault: it may still move.
        """
        self._run.cancelled = True
        self._stream.wake()
        if not self._may_move and (self._lost is not None or self._says is not ArmState.MOVING):
            return
        try:
            self._halt()
        finally:
            self._run.join(ANSWER_S)

    def close(self) -> None:
        """Stop, and give the connection back. Raises ArmFault as `stop`."""
        try:
            self.stop()
        finally:
            self._lose("closed")
            self._release()
            self._may_move = False

    # -- the path's thread -------------------------------------------------------------------

    def _follow_path(self, run: Run) -> None:
        for segment in run.path:
            if run.cancelled:
                return
            here = self.pose()
            seconds = distance_mm(here, segment.to) / segment.speed_mm_s
            seconds += angle_deg(here, segment.to) / (segment.turn_deg_s or TURN_DEG_S)
            speed = segment.turn_deg_s or segment.speed_mm_s
            numbers = (*segment.to.xyz_mm, *segment.to.rotvec_deg, speed)
            begin_ns = self._ask("MOVE " + " ".join(f"{number:.6f}" for number in numbers))
            if not self._rest(2 * seconds + OVERTIME_S, run):
                raise ArmFault("arm", f"did not end a move of {seconds:.1f} s; it was stopped")
            if run.cancelled or self._lost is not None or not is_at(self.pose(), segment.to):
                return  # stopped: the arm's state says why
            run.finished.append((begin_ns, self._t_ns))
        self._may_move = False

    def _rest(self, within_s: float, run: Run | None = None) -> bool:
        """Wait for a new pose at rest, the end of the connection, or of the run."""
        seen = self._poses

        def over() -> bool:
            rest = self._poses > seen and self._says is not ArmState.MOVING
            return rest or self._lost is not None or (run is not None and run.cancelled)

        return self._stream.wait_for(over, within_s)

    def _abort(self) -> None:
        with suppress(ArmFault):
            self._halt()

    def _halt(self) -> None:
        self._ask("STOP")
        if not self._rest(STILL_S) or self._lost is not None:
            raise ArmFault("arm", "was not seen at rest: press its emergency stop")
        self._may_move = False

    # -- the wire ----------------------------------------------------------------------------

    def _ask(self, request: str) -> int:
        """Send a request; return the controller's time in its answer, ns. Raises ArmFault."""
        with self._asking:
            if self._socket is None or self._lost is not None:
                raise self._fault(ArmState.DISCONNECTED, f"cannot be sent {request}")
            try:
                self._socket.sendall(f"{request}\n".encode())
                answer = self._answers.get(timeout=ANSWER_S)
            except (OSError, queue.Empty):
                self._lose(f"no answer to {request}")  # one that comes late is not the next one's
                raise self._fault(ArmState.DISCONNECTED, "may move: press its stop") from None
        word, _, rest = answer.partition(" ")
        if word != "OK":
            raise ArmFault("arm", f"refused {request}: {rest}")
        return int(rest) * 1000

    def _read(self, link: socket.socket) -> None:
        """The reading thread: it ends with the connection."""
        unread = b""
        try:
            while part := link.recv(65536):
                *lines, unread = (unread + part).split(b"\n")
                for line in lines:
                    self._take(line.decode("ascii"))
            self._lose("the controller closed the connection")
        except (OSError, ValueError, KeyError) as error:  # a timeout is an OSError
            self._lose(str(error))

    def _take(self, line: str) -> None:
        if not line.startswith("POSE "):
            self._answers.put(line)
            return
        _, t_us, x, y, z, a, b, c, state, sync = line.split(" ")
        t_ns = int(t_us) * 1000
        if t_ns < self._t_ns:
            raise ValueError(f"its clock fell back by {(self._t_ns - t_ns) / 1e9:.3f} s")
        xyz, turn = (float(x), float(y), float(z)), (float(a), float(b), float(c))
        self._says, self._t_ns = STATES[state], t_ns
        self._poses += 1
        self._stream.add(Sample(t_ns, time.monotonic_ns(), xyz, turn, sync == "1"))

    def _last(self) -> Sample:
        last = self._stream.last
        if self._lost is not None or last is None:
            raise self._fault(ArmState.DISCONNECTED, "has no pose")
        return last

    def _lose(self, why: str) -> None:
        self._lost = self._lost or why  # the first reason; those after it follow from it
        self._stream.wake()

    def _release(self) -> None:
        """Close the connection, and wait for the reading thread."""
        link, self._socket = self._socket, None
        if link is not None:
            with suppress(OSError):
                link.shutdown(socket.SHUT_RDWR)
            link.close()
        if self._reader is not None:
            self._reader.join(ANSWER_S)
