"""Common parts of fake controllers: an asyncio server in its own thread, and named faults.

A fake speaks a device's own protocol, so that the real driver can be tested without the device.
Fakes reproduce a device's replies and its failures, not its timing.
"""

from __future__ import annotations

import asyncio
import math
import os
import socket
import threading
import tty
from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable, Coroutine, Sequence
from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from typing import Any, Self, TypeVar

from sliplab.rigs.core.capabilities import Pose
from sliplab.rigs.core.fake_motion import ControllerClock, StraightMotion, running_clock

T = TypeVar("T")
Handler = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]
LOOPBACK = "127.0.0.1"
MOST_WAITING = 64 << 20
"""Bytes of a fake stream that may wait for a client; then the connection breaks, as a device's."""
START_S = 5.0
"""Time limit for a fake to open its ports, or to close them, s."""
HOME = Pose((400.0, 0.0, 300.0), (180.0, 0.0, 0.0))
"""First position of a fake's tool centre point."""


class LoopThread:
    """An event loop in a background thread; `call` runs a function in it from any other thread."""

    def __init__(self, name: str) -> None:
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        self._loop.run_forever()
        self._loop.run_until_complete(_one_turn())  # a task that has not begun cannot clean up
        tasks = asyncio.all_tasks(self._loop)
        for task in tasks:
            task.cancel()
        self._loop.run_until_complete(asyncio.gather(*tasks, return_exceptions=True))
        self._loop.run_until_complete(_one_turn())  # sockets close one iteration later
        self._loop.close()

    def run(self, work: Coroutine[Any, Any, T]) -> T:
        """Run a coroutine and return its result. Raises TimeoutError after `START_S`."""
        return asyncio.run_coroutine_threadsafe(work, self._loop).result(START_S)

    def call(self, function: Callable[[], T]) -> T:
        """Run a plain function in the loop's thread and return its result."""

        async def work() -> T:
            return function()

        return self.run(work())

    def post(self, function: Callable[[], object]) -> None:
        """Let a plain function run in the loop's thread, and return at once; in order of calls."""
        if self.alive:
            self._loop.call_soon_threadsafe(function)

    @property
    def alive(self) -> bool:
        """True until it is closed."""
        return self._thread.is_alive()

    def close(self) -> None:
        """End every coroutine; safe to call more than once."""
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._loop.stop)
            self._thread.join(START_S)


async def _one_turn() -> None:
    """Run every callback that is ready, once."""
    loop = asyncio.get_running_loop()
    turn = loop.create_future()
    loop.call_soon(turn.set_result, None)
    await turn


class Connections:
    """Listening TCP ports and their open connections, which can all be closed at once.

    asyncio's own server loses a connection that is being accepted while it closes (Python 3.11), so
    connections are accepted here.
    """

    def __init__(self) -> None:
        self._listeners: list[socket.socket] = []
        self._tasks: dict[asyncio.Task[None], socket.socket] = {}
        self._waiting: set[socket.socket] = set()

    def listen(self, host: str, port: int, handler: Handler) -> int:
        """Accept connections on a port; `handler` serves each, and may end with a lost connection.

        Args:
            port: 0 for a free one.

        Returns:
            the port.

        Raises:
            OSError: the port is taken.
        """
        listener = socket.create_server((host, port), backlog=16)
        listener.setblocking(False)
        self._listeners.append(listener)
        asyncio.get_running_loop().add_reader(listener, self._accept, listener, handler)
        found: int = listener.getsockname()[1]
        return found

    def cut(self) -> None:
        """Close every connection and accept no new one."""
        for listener in self._listeners:
            asyncio.get_running_loop().remove_reader(listener)
            listener.close()
        self._listeners.clear()
        for task in list(self._tasks):
            task.cancel()

    def _accept(self, listener: socket.socket, handler: Handler) -> None:
        try:
            connection, _ = listener.accept()
        except OSError:
            return  # the client has disconnected already
        connection.setblocking(False)
        task = asyncio.get_running_loop().create_task(self._serve(connection, handler))
        self._tasks[task] = connection
        self._waiting.add(connection)
        task.add_done_callback(self._forget)

    async def _serve(self, connection: socket.socket, handler: Handler) -> None:
        self._waiting.discard(connection)
        reader, writer = await asyncio.open_connection(sock=connection)
        try:
            await handler(reader, writer)
        except (OSError, asyncio.IncompleteReadError):
            pass  # the client disconnected
        except asyncio.CancelledError:
            writer.transport.abort()  # the connection was cut
        finally:
            writer.close()

    def _forget(self, task: asyncio.Task[None]) -> None:
        connection = self._tasks.pop(task)
        if connection in self._waiting:  # cut before it began
            self._waiting.discard(connection)
            connection.close()


class FakeStream(ABC):
    """Base class of fake devices that stream to one client, on a free port of this computer.

    A subclass takes commands in `_serve`, and sends by `write`.

    Attributes:
        address: host and port, for `reach` of the driver.
    """

    def __init__(self, name: str) -> None:
        self._silent = False
        self._client: asyncio.StreamWriter | None = None
        self._connections = Connections()
        self._thread = LoopThread(name)
        self.address: Any = self._thread.call(self._open)

    def _open(self) -> Any:
        """Open the port, in the loop; return its address."""
        return LOOPBACK, self._connections.listen(LOOPBACK, 0, self._accept)

    def _cut(self) -> None:
        """Close the port, in the loop."""
        self._connections.cut()

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._client = writer
        try:
            await self._serve(reader)
        finally:
            if self._client is writer:
                self._client = None

    @abstractmethod
    async def _serve(self, reader: asyncio.StreamReader) -> None:
        """Serve a client until it leaves, in the loop."""

    def write(self, data: bytes) -> None:
        """Send data to the client, from any thread; nothing while silent, or without one."""
        self._thread.post(lambda: self._write(data))

    def _write(self, data: bytes) -> None:
        """Send data to the client, in the loop."""
        if self._client is None or self._silent:
            return
        self._client.write(data)
        if self._client.transport.get_write_buffer_size() > MOST_WAITING:
            self._client.transport.abort()

    def silence(self, silent: bool = True) -> None:
        """Send and answer nothing from now on; the connection stays."""
        self._silent = silent

    def close(self) -> None:
        """Unplug it: the connection breaks. Safe to call more than once."""
        if self._thread.alive:
            self._thread.call(self._cut)
            self._thread.close()


class FakeSerial(FakeStream):
    """Base class of fake devices on a serial line, which is a pseudo terminal.

    What nobody reads is lost, as on a real line, and so is what a silent device is sent.

    Attributes:
        address: name of the port. lost: times that the line was full.
    """

    lost = 0

    def _open(self) -> str:
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        loop, self._reader = asyncio.get_running_loop(), asyncio.StreamReader()
        loop.add_reader(self._master, self._receive)
        self._serving = loop.create_task(self._serve(self._reader))
        return os.ttyname(self._slave)

    def _receive(self) -> None:
        data = os.read(self._master, 4096)
        if not self._silent:
            self._reader.feed_data(data)

    def _write(self, data: bytes) -> None:
        if self._silent or self._master < 0:
            return
        try:
            os.write(self._master, data)
        except BlockingIOError:
            self.lost += 1

    def _cut(self) -> None:
        asyncio.get_running_loop().remove_reader(self._master)
        os.close(self._master)
        os.close(self._slave)
        self._master = -1
        self._serving.cancel()


CLOCK_BACK_S = 5.0
"""By which `Kind.CLOCK_BACK` sets the controller's clock back."""
PACKETS_LOST = 25
"""Packets of poses that `Kind.PACKETS_LOST` keeps back."""


class Kind(Enum):
    """Faults of a fake arm controller, by their names in the table (`rigs.core.faults`)."""

    PROTECTIVE_STOP = "arm_protective_stop"
    EMERGENCY_STOP = "arm_emergency_stop"
    LINK_CUT = "device_gone"
    SILENCE = "device_silent"
    REMOTE_OFF = "arm_remote_off"
    PROGRAM_END = "arm_program_end"
    PROGRAM_PAUSED = "arm_program_paused"
    SAFEGUARD_STOP = "arm_safeguard_stop"
    POWER_OFF = "arm_power_off"
    CLOCK_BACK = "clock_jump"
    PACKETS_LOST = "poses_lost"
    LATE_ANSWER = "answer_late"


class Stage(Enum):
    """The stage at which a fault happens."""

    CONNECTING = "connecting"
    """With the first request of any client."""
    CONTROL = "control"
    """A client requests to write registers, by which it takes control."""
    UPLOADING = "uploading"
    """With the first byte of a control script or motion program."""
    MOVING = "moving"
    """Once the tool centre point has travelled `after_mm` in one move."""
    IDLE = "idle"
    """At once, if the arm is ready and not moving."""


@dataclass(frozen=True)
class Fault:
    """One fault, injected once."""

    kind: Kind
    stage: Stage
    after_mm: float = 0.0


class FaultPlan:
    """The pending faults of one fake, each tied to a stage.

    Args:
        inject: causes a fault of a given kind now.
    """

    def __init__(self, faults: Sequence[Fault], inject: Callable[[Kind], None]) -> None:
        self._waiting, self._inject = list(faults), inject

    def __bool__(self) -> bool:
        return bool(self._waiting)

    def add(self, fault: Fault) -> None:
        """Plan one more fault."""
        self._waiting.append(fault)

    def reach(self, stage: Stage, gone_mm: float = math.inf) -> None:
        """Inject the faults that are planned for a stage, now that it is reached.

        Args:
            gone_mm: how far the tool centre point has travelled in this move.
        """
        for fault in [f for f in self._waiting if f.stage is stage and gone_mm >= f.after_mm]:
            self._waiting.remove(fault)
            self._inject(fault.kind)


class FakeController(ABC):
    """Base class of fake arm controllers: `start` opens the ports, `close` releases them.

    Args:
        host: the loopback address that this fake has for itself.
        motion: where the tool centre point is; a straight-line motion from `HOME` if left out.
        clock: the controller's clock; a new one that runs at `rate` if left out.
        rate: controller seconds per host second.
    """

    def __init__(
        self,
        host: str,
        motion: StraightMotion | None = None,
        clock: ControllerClock | None = None,
        rate: float = 1.0,
    ) -> None:
        self.host = host
        self.motion = motion or StraightMotion(HOME)
        self.clock = clock or running_clock(rate)

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    @abstractmethod
    def start(self) -> None:
        """Open the ports and run. Raises OSError if one of them is taken."""

    @abstractmethod
    def close(self) -> None:
        """Close every connection and release the ports."""

    @abstractmethod
    def inject(self, kind: Kind) -> None:
        """Inject a fault now."""

    @abstractmethod
    def restore(self) -> None:
        """Clear every fault, as an operator would at the pendant."""

    def pose(self) -> Pose:
        """Return where the tool centre point is now."""
        return self.motion.pose(self.clock.now_s())

    def moving(self) -> bool:
        """Return whether the tool centre point is moving now."""
        return self.motion.moving(self.clock.now_s())


class ServedController(FakeController):
    """A fake controller whose connections are served in one background loop.

    A subclass opens its ports in `_listen`, which may be called again after a cut, and makes a
    fault happen in `_inject`; both run in the loop.
    """

    _thread: LoopThread | None = None

    @cached_property
    def _connections(self) -> Connections:
        return Connections()

    def start(self) -> None:
        """Open the ports and run. Raises OSError if one of them is taken."""
        self._thread = LoopThread(f"fake {self.host}")
        try:
            self._thread.call(self._listen)
        except OSError:
            self._thread.close()
            raise

    def close(self) -> None:
        """Close every connection and release the ports."""
        if self._thread is not None:
            self._thread.call(self._connections.cut)
            self._thread.close()
            self._thread = None

    def inject(self, kind: Kind) -> None:
        """Inject a fault now. Raises ValueError: this controller does not simulate it."""
        self._inside(lambda: self._inject(kind))

    @abstractmethod
    def _listen(self) -> None:
        """Accept connections at every port."""

    @abstractmethod
    def _inject(self, kind: Kind) -> None:
        """Inject a fault, in the loop. Raises ValueError for one that is not simulated."""

    def _inside(self, function: Callable[[], None]) -> None:
        """Run a function between two of the loop's own steps."""
        assert self._thread is not None
        self._thread.call(function)
