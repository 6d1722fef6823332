"""Driver of the lab stage.

The controller takes one client. A request is a number, a word and its values; the answer begins
with the same number, so that one that comes late is not taken for the next one's:

    7 HELLO                     7 OK stage-3 S0042 1.2
    8 MOVE 400.0 5.0 300.0 1.6  8 OK 1000123456
    9 STOP                      9 OK

Values are mm and mm/s in the base frame, times microseconds of the controller's clock. 500 times a
second it says, unasked, where it is, its state and the level of its input:

    POSE 1000123456 400.000 0.000 300.000 MOVING 0

It stops by itself when its client leaves.
"""

from __future__ import annotations

import math
import socket
import threading
import time
from collections.abc import Sequence
from contextlib import suppress

from lab_stage import LabStageSettings
from sliplab.rigs.core.capabilities import (
    ArmFault,
    ArmState,
    DeviceHealth,
    Pose,
    RigError,
    Segment,
)
from sliplab.rigs.core.pose import angle_deg, distance_mm
from sliplab.rigs.core.pose_stream import Sample
from sliplab.rigs.core.threaded_arm import LEFT_MM, NEAR_MM, Run, ThreadedArm

ANSWER_S = 1.0
"""Time limit of connecting, and of every answer, s."""
SILENCE_S = 1.0
"""A controller that has said nothing for this long is lost, s."""
LONGEST_LINE = 1000
STILL_S = 2.0
"""Time limit from a stop to the stage standing still, s."""
OVERTIME_S = 3.0
"""Time beyond twice its duration after which a move is given up, s."""
STATES = {
    "READY": ArmState.READY,
    "MOVING": ArmState.MOVING,
    "PROTECTIVE": ArmState.PROTECTIVE_STOP,
    "EMERGENCY": ArmState.EMERGENCY_STOP,
    "OFF": ArmState.NOT_RUNNING,
}
"""The controller's words for its state."""


class LabStage(ThreadedArm):
    """A `sliplab.rigs.core.capabilities.Arm`."""

    def __init__(self, settings: LabStageSettings) -> None:
        super().__init__(settings.limits)
        self._settings = settings
        self._socket: socket.socket | None = None
        self._reader: threading.Thread | None = None
        self._sending = threading.Lock()
        self._asked = 0
        self._answers: dict[int, str] = {}
        self._about = ""
        self._forget()

    def _forget(self) -> None:
        """Nothing is known of a controller that has just been connected."""
        self._count = 0
        """Poses since the connection."""
        self._t_ns = 0
        self._advanced_ns = time.monotonic_ns()
        """Arrival of the newest pose."""
        self._says = ArmState.DISCONNECTED
        self._may_move = False
        """A path was begun, and nobody has seen the stage at rest since."""

    def connect(self) -> None:
        """Open the connection, and see that poses come. Takes at most 3 `ANSWER_S`.

        Raises:
            ArmFault: no connection, no answer, or another client has it.
        """
        if self._lost is None:
            return
        self._release()
        self._forget()
        try:
            link = socket.create_connection(self._address, ANSWER_S)
        except OSError as error:
            raise ArmFault("arm", f"{self._where}: {error}; check its power and network") from None
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        link.settimeout(SILENCE_S)
        self._socket, self._lost = link, None
        self._reader = threading.Thread(target=self._read, args=(link,), daemon=True)
        self._reader.start()
        try:
            self._about = self._ask("HELLO")
            if not self._stream.wait_for(lambda: self._count > 0, ANSWER_S):
                raise ArmFault("arm", f"{self._where} sends no poses; restart the controller")
        except ArmFault:
            self._lose("it did not answer")
            self._release()
            raise

    def state(self) -> ArmState:
        """Return the state that the controller reports; a path that runs counts as moving."""
        if self._lost is not None:
            return ArmState.DISCONNECTED
        if self._says is ArmState.READY and not self._run.done:
            return ArmState.MOVING
        return self._says

    def pose(self) -> Pose:
        """Return the newest pose. Raises ArmFault: no connection."""
        last = self._stream.last
        if self._lost is not None or last is None:
            raise self._fault(self.state(), "has no pose")
        return last.pose

    def now_ns(self) -> int:
        """Return the controller's time in the newest pose, ns. Raises ArmFault: no connection."""
        last = self._stream.last
        if self._lost is not None or last is None:
            raise self._fault(self.state(), "tells no time")
        return last.t_ns

    def health(self) -> DeviceHealth:
        """Return the controller's own description. Raises ArmFault: no connection, no answer."""
        model, serial, firmware = (*self._ask("HELLO").split(), "", "", "")[:3]
        return DeviceHealth(
            device="arm",
            model=model,
            serial=serial,
            firmware=firmware,
            temperature_c=None,
            clock="its own, 1 us",
        )

    def start(self, path: Sequence[Segment]) -> None:
        """Begin to follow `path` and return at once.

        Raises:
            GuardError: a limit forbids the path; nothing was sent.
            ArmFault: no connection, or stopped.
            RigError: it is still moving, the path is empty, or turns the tool.
        """
        self._refuse(path, moving=self.state() is ArmState.MOVING)
        if not self.state().healthy:
            raise self._fault(self.state(), "cannot move")
        begin = self.pose()
        self._guard.check(begin, path)
        for number, segment in enumerate(path, 1):
            if (turn := angle_deg(begin, segment.to)) > self._settings.turn_deg:
                text = f"segment {number} turns the tool by {turn:.1f} deg, which a stage cannot"
                raise RigError("arm", text)
        self._run, self._may_move = Run(path), True
        self._begin(self._run)

    def stop(self) -> None:
        """Stop now, and see the stage at rest. Takes at most 2 `ANSWER_S` + `STILL_S`.

        Raises:
            ArmFault: it may still move: press its emergency stop.
        """
        run = self._run
        run.cancelled = True
        self._stream.wake()
        if not self._may_move and (self._lost is not None or self._says is not ArmState.MOVING):
            return
        try:
            self._halt()
        except ArmFault as error:
            text = f"{error}; it was not seen at rest: press its emergency stop"
            raise ArmFault("arm", text.removeprefix("arm: ")) from None
        finally:
            run.join(ANSWER_S)

    def close(self) -> None:
        """Stop, and give the connection back; any number of times. Raises ArmFault as `stop`."""
        try:
            self.stop()
        finally:
            self._lose("closed")
            self._release()

    # -- the path's thread -------------------------------------------------------------------

    def _follow_path(self, run: Run) -> None:
        for segment in run.path:
            span = None if run.cancelled else self._segment(run, segment)
            if span is None:
                return
            run.finished.append(span)
        self._may_move = False

    def _segment(self, run: Run, segment: Segment) -> tuple[int, int] | None:
        """Make one segment; its begin and end on the controller's clock, None if it was stopped.

        Raises:
            ArmFault: refused, or not ended in time.
        """
        begin = self.pose()
        length = distance_mm(begin, Pose(segment.to.xyz_mm, begin.rotvec_deg))
        x, y, z = segment.to.xyz_mm
        answer = self._ask(f"MOVE {x:.4f} {y:.4f} {z:.4f} {segment.speed_mm_s:.4f}")
        seen = self._count
        if length < LEFT_MM:
            return int(answer) * 1000, int(answer) * 1000

        def over() -> bool:
            rest = self._count > seen and self._says is not ArmState.MOVING
            return rest or run.cancelled or self._lost is not None

        if not self._stream.wait_for(over, 2 * length / segment.speed_mm_s + OVERTIME_S):
            raise ArmFault("arm", f"did not end a move of {length:.1f} mm in time; it was stopped")
        end, here = self._t_ns, self._stream.last
        if run.cancelled or self._lost is not None or here is None:
            return None
        if distance_mm(here.pose, segment.to) > NEAR_MM:
            return None  # somebody stopped it: its state says who
        return int(answer) * 1000, end

    def _abort(self) -> None:
        with suppress(ArmFault):
            self._halt()

    def _halt(self) -> None:
        """Ask for a stop and wait until it stands. Raises ArmFault: no answer, or no rest."""
        if self._lost is not None:
            raise self._fault(ArmState.DISCONNECTED, "cannot be stopped")
        self._ask("STOP")
        seen = self._count

        def still() -> bool:
            return self._count > seen and self._says is not ArmState.MOVING

        if not self._stream.wait_for(lambda: still() or self._lost is not None, STILL_S):
            raise ArmFault("arm", f"does not come to rest within {STILL_S:g} s")
        if self._lost is not None:
            raise self._fault(ArmState.DISCONNECTED, "was lost while it stopped")
        self._may_move = False

    # -- the wire ----------------------------------------------------------------------------

    @property
    def _address(self) -> tuple[str, int]:
        return self._settings.host, self._settings.port

    @property
    def _where(self) -> str:
        return f"{self._settings.host}:{self._settings.port}"

    def _ask(self, request: str) -> str:
        """Return what comes behind the OK of a request. Raises ArmFault."""
        with self._sending:
            self._asked += 1
            number, link = self._asked, self._socket
            if link is None or self._lost is not None:
                raise self._fault(ArmState.DISCONNECTED, "cannot be asked")
            try:
                link.sendall(f"{number} {request}\n".encode())
            except OSError as error:
                self._lose(str(error))
                raise self._fault(ArmState.DISCONNECTED, "cannot be asked") from None
        word = request.partition(" ")[0]

        def ready() -> bool:
            return number in self._answers or self._lost is not None

        if not self._stream.wait_for(ready, ANSWER_S):
            raise ArmFault("arm", f"no answer to {word} within {ANSWER_S:g} s; look at it")
        answer = self._answers.pop(number, None)
        if answer is None:
            raise self._fault(ArmState.DISCONNECTED, f"gave no answer to {word}")
        said, _, rest = answer.partition(" ")
        if said != "OK":
            raise ArmFault("arm", f"refused {word}: {rest or answer}")
        return rest

    def _read(self, link: socket.socket) -> None:
        """The reading thread: it ends with the connection."""
        waiting = b""
        try:
            while part := link.recv(65536):
                *lines, waiting = (waiting + part).split(b"\n")
                for line in lines:
                    self._take(line.decode("ascii"))
                # other lines, half ones and a clock that has stopped are silence, too
                if time.monotonic_ns() - self._advanced_ns > SILENCE_S * 1e9:
                    raise TimeoutError
                if len(waiting) > LONGEST_LINE:
                    raise ValueError("it sent a line without an end")
            self._lose("the controller closed the connection")
        except TimeoutError:
            self._lose(f"no new pose came for {SILENCE_S:g} s")
        except (OSError, ValueError) as error:
            self._lose(str(error))

    def _take(self, line: str) -> None:
        """Take one line. Raises ValueError: it is none of this controller's."""
        word, _, rest = line.partition(" ")
        if word.isdecimal():
            if self._asked - int(word) < 100:  # answers that nobody waits for are not kept for ever
                self._answers[int(word)] = rest
                self._answers.pop(int(word) - 100, None)
            self._stream.wake()
            return
        try:
            t_us, x, y, z, state, level = rest.split(" ")
            sample = Sample(
                int(t_us) * 1000,
                time.monotonic_ns(),
                (float(x), float(y), float(z)),
                self._settings.tool_rotvec_deg,
                level == "1",
            )
            says = STATES[state]
        except (ValueError, KeyError):
            raise ValueError(f"it sent '{line}', which is no pose") from None
        if word != "POSE" or not all(map(math.isfinite, sample.xyz_mm)):
            raise ValueError(f"it sent '{line}', which is no pose")
        if sample.t_ns < self._t_ns:
            raise ValueError(f"its clock fell back by {(self._t_ns - sample.t_ns) / 1e9:.3f} s")
        if sample.t_ns == self._t_ns:
            return
        self._says, self._t_ns, self._advanced_ns = says, sample.t_ns, sample.host_ns
        self._count += 1
        self._stream.add(sample)

    def _lose(self, why: str) -> None:
        """The first reason is kept: those after it follow from it."""
        if self._lost is None:
            self._lost = why
        self._stream.wake()

    def _release(self) -> None:
        """Give the connection back, and wait for the reading thread."""
        link, self._socket = self._socket, None
        if link is not None:
            with suppress(OSError):
                link.shutdown(socket.SHUT_RDWR)
            link.close()
        if self._reader is not None and self._reader is not threading.current_thread():
            self._reader.join(ANSWER_S)
