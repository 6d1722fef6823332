"""A fake ABB IRC5 controller: Robot Web Services, motion programs, poses by EGM.

HTTP with digest authentication and JSON on one port, as abb-robot-client 0.4.0 and
abb-motion-program-exec 0.7.4 expect it; EGM packets are sent to a UDP port from the first motion
program on, as by the RAPID module on the controller. There is one mechanical unit, ROB_1. The
module `docs/rapid/sliplab_watchdog.mod` is loaded, unless it is left out. Requests that are not
simulated are refused.
"""

from __future__ import annotations

import argparse
import contextlib
import socket
import struct
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any
from urllib.parse import parse_qsl

from abb_robot_client._egm_protobuf import egm_pb2

from sliplab.plugins.devices.abb.fake_http import HttpServer, Reply
from sliplab.plugins.devices.abb.watchdog import BEAT, ECHO, LIMIT
from sliplab.rigs.core.capabilities import Pose
from sliplab.rigs.core.fake_motion import ON_THE_SPOT_MM, ControllerClock, StraightMotion
from sliplab.rigs.core.fakes import (
    CLOCK_BACK_S,
    PACKETS_LOST,
    START_S,
    FakeController,
    Fault,
    FaultPlan,
    Kind,
    Stage,
)
from sliplab.rigs.core.pose import (
    angle_deg,
    compose,
    distance_mm,
    from_quaternion,
    inverse,
    quaternion,
)

FILE_VERSION = 10011
_MOVE_L, _WAIT = 3, 5
_WORK_OBJECT_BEFORE, _WORK_OBJECT_AFTER = 2, 14
_LOAD = 11


class ProgramError(ValueError):
    """Not a motion program, or one with commands that are not simulated."""


@dataclass(frozen=True)
class MoveL:
    """One straight move, or a turn on the spot."""

    to: Pose
    speed_mm_s: float
    turn_deg_s: float


@dataclass(frozen=True)
class Wait:
    """A pause of some seconds."""

    seconds: float


@dataclass(frozen=True)
class MotionProgram:
    """A motion program without EGM commands."""

    tool: Pose
    tool_mass_kg: float
    commands: tuple[MoveL | Wait, ...]


class _Reader:
    def __init__(self, data: bytes) -> None:
        self._data, self._at = data, 0

    @property
    def ended(self) -> bool:
        return self._at >= len(self._data)

    def numbers(self, count: int) -> tuple[float, ...]:
        try:
            values = struct.unpack_from(f"<{count}f", self._data, self._at)
        except struct.error:
            raise ProgramError("the file is truncated") from None
        self._at += 4 * count
        return values

    def number(self) -> float:
        return self.numbers(1)[0]

    def skip_text(self) -> None:
        self.number()
        self._at += 32

    def pose(self) -> Pose:
        values = self.numbers(7)
        return from_quaternion(values[:3], values[3:])


def read_program(data: bytes) -> MotionProgram:
    """Parse a motion program file. Raises ProgramError."""
    reader = _Reader(data)
    if reader.number() != FILE_VERSION:
        raise ProgramError("unsupported file version")
    reader.number()  # the robot holds the tool
    tool = reader.pose()
    mass_kg = reader.numbers(_LOAD)[0]
    reader.numbers(_WORK_OBJECT_BEFORE)
    reader.skip_text()
    reader.numbers(_WORK_OBJECT_AFTER + _LOAD)
    reader.skip_text()
    reader.number()  # sequence number
    if reader.number() != 0:
        raise ProgramError("EGM commands are not simulated")
    commands: list[MoveL | Wait] = []
    while not reader.ended:
        _, operation = reader.numbers(2)
        if operation == _MOVE_L:
            to = reader.pose()
            reader.numbers(4 + 6)  # configuration, external axes
            speed, turn = reader.numbers(4)[:2]
            reader.numbers(7)  # zone: every point is a fine point here
            commands.append(MoveL(to, speed, turn))
        elif operation == _WAIT:
            commands.append(Wait(reader.number()))
        else:
            raise ProgramError(f"the command {operation:g} is not simulated")
    return MotionProgram(tool, mass_kg, tuple(commands))


JOINTS_DEG = (0.0, 10.0, 20.0, 0.0, 60.0, 0.0)
ACCELERATION_MM_S2 = 500.0
STOP_MM_S2 = 2000.0
_ORIGIN = Pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
_TICK_S = 0.002
LATE_S = 0.02
"""Delay after which a packet is dropped: a controller is never late, but networks lose packets."""
WATCH_S = 0.02
"""Cycle of the watchdog module, s."""
_SIGNALS = "rw/iosystem/signals/Local/DRV_1/"
_NO_AXIS = "9E+09"
"""RAPID's value for an external axis that does not exist."""


class FakeAbb(FakeController):
    """One fake controller.

    Args:
        host, motion, rate, clock: as in `FakeController`.
        port: port of the web services.
        egm: address and UDP port to which poses are sent.
        cycle_hz: EGM packets per controller second; 250 on the real controller.
        egm_point: the point that EGM reports: tool centre point or flange.
        faults: faults to inject.
        watchdog: True to load the watchdog module. It counts the host's seconds at any rate,
            because it watches the host.
        answer_s: delay of each answer.
        egm_time: True if packets carry the time, as from RobotWare 6.07 on.

    Attributes:
        speed_percent: the pendant's speed ratio, for subsequent moves.
        egm_on: True while poses are sent.
        web_on: True while the web services answer.
        entry: entry routine of the task.
        pointer: module of the program pointer.
        mute_after_start: True to switch `egm_on` and `web_on` off when the next program starts.
        watchdog_stops: number of stops by the watchdog module.
    """

    def __init__(
        self,
        host: str,
        port: int,
        egm: tuple[str, int],
        motion: StraightMotion | None = None,
        rate: float = 1.0,
        cycle_hz: int = 250,
        egm_point: str = "tool",
        faults: Sequence[Fault] = (),
        joints_deg: Sequence[float] = JOINTS_DEG,
        clock: ControllerClock | None = None,
        watchdog: bool = True,
        answer_s: float = 0.0,
        egm_time: bool = True,
    ) -> None:
        super().__init__(host, motion, clock, rate)
        self.port, self._egm = port, egm
        self._faults = FaultPlan(faults, self._inject)
        self.controller, self.mode = "motoron", "AUTO"
        self.running = False
        self.speed_percent = 100.0
        self.egm_on = self.web_on = True
        self.mute_after_start = False
        self.entry, self.pointer = "motion_program_main", "motion_program_exec"
        self._egm_time, self._answer_s = egm_time, answer_s
        self.watchdog_stops = 0
        self._signals = dict.fromkeys((BEAT, ECHO, LIMIT), 0.0) if watchdog else {}
        self._beat_s = 0.0
        self._number = self._to_lose = 0
        self._egm_back_s = 0.0
        self.tool, self.tool_mass_kg = _ORIGIN, 0.0
        self._egm_point, self._joints_deg = egm_point, list(joints_deg)
        self._cycle_hz, self._cycle = cycle_hz, int(self.clock.now_s() * cycle_hz)
        self._files: dict[str, bytes] = {}
        self._todo: list[MoveL | Wait] = []
        self._wait_until_s = 0.0
        self._left_from: Pose | None = None
        self._streaming = False
        self._silent = False
        self._log = 1
        self._lock = threading.RLock()
        self._closing = threading.Event()
        self._http: HttpServer | None = None
        self._udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._unplugging: threading.Thread | None = None

    def start(self) -> None:
        """Open the port and run. Raises OSError if it is taken."""
        self._udp.bind((self.host, 0))
        self._http = HttpServer(self.host, self.port, self._answer)
        self._thread.start()

    def close(self) -> None:
        """Close every connection and release the port."""
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join(START_S)
        self._unplug()
        if self._unplugging is not None:
            self._unplugging.join(START_S)
        self._udp.close()

    def inject(self, kind: Kind) -> None:
        """Inject a fault now."""
        with self._lock:
            self._inject(kind)

    def drop_connections(self) -> None:
        """Close the open connections; new ones are accepted."""
        if self._http is not None:
            self._http.cut()

    def slow(self, answer_s: float) -> None:
        """Take this time for every answer from now on."""
        self._answer_s = answer_s

    def restore(self) -> None:
        """Clear every fault of connection, motors and mode, as an operator would."""
        self._unplug()
        if self._unplugging is not None:
            self._unplugging.join(START_S)
        with self._lock:
            self._silent = False
            self.controller, self.mode = "motoron", "AUTO"
        self._http = HttpServer(self.host, self.port, self._answer)

    @property
    def sessions(self) -> int:
        """Number of logged-in clients."""
        return 0 if self._http is None else self._http.sessions

    def _unplug(self) -> None:
        """Close the connections in another thread, since a handler cannot wait for its own end."""
        http, self._http = self._http, None
        if http is not None:
            self._unplugging = threading.Thread(target=http.close, daemon=True)
            self._unplugging.start()

    def _inject(self, kind: Kind) -> None:
        if kind in {Kind.LINK_CUT, Kind.SILENCE}:
            self._silent = True
            if kind is Kind.LINK_CUT:
                self._unplug()
            return
        if kind is Kind.CLOCK_BACK:
            self._egm_back_s += CLOCK_BACK_S
            return
        if kind is Kind.PACKETS_LOST:
            self._to_lose = PACKETS_LOST
            return
        states = {
            Kind.PROTECTIVE_STOP: ("guardstop", self.mode),
            Kind.SAFEGUARD_STOP: ("guardstop", self.mode),
            Kind.EMERGENCY_STOP: ("emergencystop", self.mode),
            Kind.REMOTE_OFF: ("motoroff", "MANR"),
            Kind.POWER_OFF: ("motoroff", self.mode),
            Kind.PROGRAM_PAUSED: (self.controller, self.mode),  # a stopped program may continue
            Kind.PROGRAM_END: (self.controller, self.mode),
        }
        if kind not in states:
            raise ValueError(f"{kind.value} is not simulated on this controller")
        self._halt()
        self.controller, self.mode = states[kind]

    def _halt(self) -> None:
        self.running = False
        self._todo.clear()
        self.motion.stop(STOP_MM_S2, self.clock.now_s())

    def _work(self) -> None:
        while not self._closing.wait(_TICK_S):
            with self._lock:
                self._watch(time.monotonic())
            due = int(self.clock.now_s() * self._cycle_hz)
            while self._cycle < due:
                self._cycle += 1
                with self._lock:
                    self._step(self._cycle / self._cycle_hz)

    def _watch(self, now_s: float) -> None:
        """Run one cycle of the watchdog module."""
        signals = self._signals
        if not signals:
            return
        if signals[BEAT] != signals[ECHO] or signals[LIMIT] <= 0:
            signals[ECHO] = signals[BEAT]
            self._beat_s = now_s
        elif now_s - self._beat_s > signals[LIMIT] + WATCH_S:
            signals[LIMIT] = 0.0
            self.watchdog_stops += 1
            self._halt()

    def _step(self, t_s: float) -> None:
        moving = self.motion.moving(t_s)
        if moving and self._left_from is not None:
            gone_mm = distance_mm(self._left_from, self.motion.pose(t_s))
            self._faults.reach(Stage.MOVING, gone_mm)
        elif not moving and not self.running:
            self._faults.reach(Stage.IDLE)
        if self.running and not moving and t_s >= self._wait_until_s:
            self._next(t_s)
        late = self.clock.now_s() - t_s > LATE_S * self.clock.rate
        if not self._streaming or not self.egm_on:
            return
        self._number += 1
        if self._to_lose > 0:
            self._to_lose -= 1
        elif not self._silent and not late:
            with contextlib.suppress(OSError):
                self._udp.sendto(self._packet(t_s), self._egm)

    def _next(self, t_s: float) -> None:
        if not self._todo:
            self.running = False
            return
        command = self._todo.pop(0)
        if isinstance(command, Wait):
            self._wait_until_s = t_s + command.seconds
            return
        self._left_from = self.motion.pose(t_s)
        way_mm = distance_mm(self._left_from, command.to)
        on_the_spot = way_mm < ON_THE_SPOT_MM
        speed = command.turn_deg_s if on_the_spot else command.speed_mm_s
        if not on_the_spot and (angle := angle_deg(self._left_from, command.to)):
            speed = min(speed, way_mm * command.turn_deg_s / angle)  # the longer time counts
        speed *= self.speed_percent / 100  # of a turn in deg/s, as the motion counts it
        self.motion.move(command.to, speed, ACCELERATION_MM_S2, t_s)

    def _packet(self, t_s: float) -> bytes:
        pose = self.motion.pose(t_s)
        if self._egm_point == "flange":
            pose = compose(pose, inverse(self.tool))
        t_s -= self._egm_back_s
        message = egm_pb2.EgmRobot()
        message.header.seqno = self._number & 0xFFFFFFFF
        message.header.tm = int(t_s * 1000) & 0xFFFFFFFF
        message.header.mtype = egm_pb2.EgmHeader.MSGTYPE_DATA
        for part in (message.feedBack, message.planned):
            part.joints.joints.extend(self._joints_deg)
            part.cartesian.pos.x, part.cartesian.pos.y, part.cartesian.pos.z = pose.xyz_mm
            orient = part.cartesian.orient
            orient.u0, orient.u1, orient.u2, orient.u3 = quaternion(pose)
            if self._egm_time:
                part.time.sec, part.time.usec = divmod(round(t_s * 1e6), 1_000_000)
        data: bytes = message.SerializeToString()
        return data

    def _answer(self, method: str, path: str, query: dict[str, str], body: bytes) -> Reply | None:
        """Answer one request; None leaves it unanswered."""
        if self._answer_s:
            self._closing.wait(self._answer_s)
        with self._lock:
            self._faults.reach(Stage.CONNECTING)
            if method == "PUT":
                self._faults.reach(Stage.UPLOADING)
            if self._silent or not self.web_on:
                return None
            if path.startswith("fileservice/"):
                return self._file(method, path, body)
            if method == "POST":
                reply = self._post(path, query, dict(parse_qsl(body.decode())))
                if self.running and self.mute_after_start:
                    self.web_on = self.egm_on = False
                return reply if self.web_on else None
            states = self._get(path, query)
            return Reply(404, None) if states is None else Reply(200, states)

    def _file(self, method: str, path: str, body: bytes) -> Reply:
        name = path.rsplit("/", 1)[1]
        if method == "PUT":
            self._files[name] = body
            return Reply(201, None)
        return Reply(200 if self._files.pop(name, None) is not None else 404, None)

    def _post(self, path: str, query: dict[str, str], values: dict[str, str]) -> Reply:
        if path.startswith(_SIGNALS) and query.get("action") == "set":
            return self._set_signal(path.removeprefix(_SIGNALS), values)
        if path != "rw/rapid/execution":
            return Reply(404, None)  # the driver uses no other resource
        action = query.get("action")
        if action == "stop":
            self._halt()
            return Reply(204, None)
        if action not in {"start", "resetpp"}:
            return Reply(400, None)
        if self.running or self.controller != "motoron" or self.mode != "AUTO":
            return Reply(403, None)
        if action == "start":
            try:
                program = read_program(self._files["motion_program.bin"])
            except (KeyError, ProgramError):
                return Reply(400, None)
            self.tool, self.tool_mass_kg = program.tool, program.tool_mass_kg
            self._todo, self.running, self._streaming = list(program.commands), True, True
            self._wait_until_s, self._number = 0.0, 0
        return Reply(204, None)

    def _set_signal(self, name: str, values: dict[str, str]) -> Reply:
        if name not in self._signals or name == ECHO:
            return Reply(404 if name not in self._signals else 403, None)
        self._signals[name] = float(values["lvalue"])
        return Reply(204, None)

    def _get(self, path: str, query: dict[str, str]) -> list[dict[str, Any]] | None:
        frame = (query.get("tool"), query.get("wobj"), query.get("coordinate"))
        if path.endswith("robtarget") and frame != ("tool0", "wobj0", "Base"):
            return None
        signal = self._signals.get(path.removeprefix(_SIGNALS))
        if path.startswith(_SIGNALS):
            return None if signal is None else [{"_type": "ios-signal", "lvalue": f"{signal:g}"}]
        flange = compose(self.pose(), inverse(self.tool))
        states: dict[str, Callable[[], dict[str, Any]]] = {
            "ctrl/$RAMDISK": lambda: {"_value": "/hd0a/ramdisk"},
            "rw/rapid/execution": lambda: {
                "ctrlexecstate": "running" if self.running else "stopped",
                "cycle": "once",
            },
            "rw/panel/ctrlstate": lambda: {"ctrlstate": self.controller},
            "rw/system": lambda: {"name": "IRB120 stand-in", "rwversion": "6.08.00.01"},
            "ctrl/identity": lambda: {"ctrl-name": "IRB120 stand-in", "ctrl-id": "120-000000"},
            "rw/panel/opmode": lambda: {"opmode": self.mode},
            "rw/panel/speedratio": lambda: {
                "_type": "pnl-speedratio",
                "speedratio": f"{self.speed_percent:g}",
            },
            "logout": dict,
            "rw/elog/0/": self._log_entry,
            "rw/rapid/tasks": lambda: {
                "name": "T_ROB1",
                "type": "normal",
                "taskstate": "linked",
                "excstate": "ready",
                "active": "On",
                "motiontask": "TRUE",
            },
            "rw/rapid/tasks/T_ROB1": lambda: {"name": "T_ROB1", "prodentrypt": self.entry},
            "rw/rapid/tasks/T_ROB1/pcp": lambda: {
                "_title": "progpointer",
                "modulemame": self.pointer,
                "routinename": "main",
            },
            "rw/motionsystem/mechunits/ROB_1/robtarget": lambda: {
                "_type": "ms-robtargets",
                **dict(zip("xyz", flange.xyz_mm, strict=True)),
                **dict(zip(("q1", "q2", "q3", "q4"), quaternion(flange), strict=True)),
                **dict.fromkeys(("cf1", "cf4", "cf6", "cfx"), "0"),
                **dict.fromkeys((f"eax{name}" for name in "abcdef"), _NO_AXIS),
            },
            "rw/motionsystem/mechunits/ROB_1/jointtarget": lambda: {
                "_type": "ms-jointtarget",
                **{f"rax_{i + 1}": value for i, value in enumerate(self._joints_deg)},
                **dict.fromkeys((f"eax_{name}" for name in "abcdef"), _NO_AXIS),
            },
        }
        return [states[path]()] if path in states else None

    def _log_entry(self) -> dict[str, Any]:
        self._log += 1
        return {
            "_title": f"/rw/elog/0/{self._log}",
            "msgtype": "1",
            "code": "80003",
            "tstamp": "2024-01-01 T  12:00:00",
            "title": "",
            "desc": "",
            "conseqs": "",
            "causes": "",
            "actions": "",
            "argc": "0",
        }


def main() -> None:
    """Run one fake until the process is terminated."""
    parser = argparse.ArgumentParser(description="A fake ABB IRC5 controller.")
    parser.add_argument("host", help="loopback address to listen on, such as 127.0.0.2")
    parser.add_argument("--port", type=int, default=8080, help="port of the web services")
    parser.add_argument("--egm", type=int, default=6510, help="UDP port for poses")
    arguments = parser.parse_args()
    with FakeAbb(arguments.host, arguments.port, ("127.0.0.1", arguments.egm)):
        threading.Event().wait()


if __name__ == "__main__":
    main()
