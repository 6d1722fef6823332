"""The fakes of a loopback rig: a process of their own, and what the rig may ask of it.

Drivers and fakes in one process would wait for each other, and would share one Python; a real
rig does neither. Frames come back through a pipe of their own, for pylon's emulated camera lives in
the drivers' process: `rigs.devices.basler.fake` puts them in place of its pictures.
"""

from __future__ import annotations

import os
import pickle
import sys
import threading
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Any

from sliplab.protocols.program import PlateAction
from sliplab.protocols.timing import Timing
from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.devices.settings import DeviceSettings
from sliplab.rigs.mock.settings import MockSettings
from sliplab.storage.streams import FrameChunk, Sink

READY_S = 180.0
"""The longest that the fakes take to begin: kernels may have to be compiled, s."""
ANSWER_S = 20.0
"""The longest that they take to answer, s."""
TURN_S = 0.004
"""Period at which the scene follows the clock, s."""
END_S = 5.0


class Loopback:
    """Fakes that run until `close`.

    Also the `rigs.core.capabilities.Simulation`, `Plate` and `Operator` of the rig.

    Args:
        on_frames: is given the frames that the outside camera sees, in a thread.

    Attributes:
        sync_port: name of the sync box's serial port.
        event_address: where the event camera's driver finds its fake.

    Raises:
        RigError: they do not begin.
    """

    def __init__(self, settings: MockSettings, timing: Timing, devices: DeviceSettings) -> None:
        context = get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._frames, their_frames = context.Pipe(duplex=False)
        self._asking = threading.Lock()
        self.on_frames: Callable[[FrameChunk], None] = _forget
        self._process = context.Process(
            target=_serve, args=(theirs, their_frames, settings, timing, devices), name="stand-ins"
        )
        self._process.start()
        theirs.close()
        their_frames.close()
        try:
            self.sync_port, self.event_address = self._answer(READY_S)
        except BaseException:
            self.close()
            raise
        self._reader = threading.Thread(target=self._read_frames, name="frames", daemon=True)
        self._reader.start()

    def close(self) -> None:
        """End the fakes, whatever they do; any number of times."""
        self._pipe.close()
        self._process.join(END_S)
        if self._process.is_alive():
            self._process.kill()
            self._process.join(END_S)
        self._frames.close()

    def reached_by(self, devices: DeviceSettings) -> DeviceSettings:
        """Settings of drivers that reach these fakes."""
        camera, box = devices.event_camera_driver.reach, devices.sync_box_driver.reach
        assert camera is not None  # the rig file was held against it
        assert box is not None
        return devices.model_copy(
            update={
                "event_camera": camera(devices.event_camera, self.event_address),
                "sync_box": box(devices.sync_box, self.sync_port),
            }
        )

    # -- Simulation ------------------------------------------------------------------------

    def begin_trial(self, seed: int) -> None:
        """Draw everything that varies by trial from `seed`. Raises RigError."""
        self._ask("begin_trial", seed)

    def sink(self, sink: Sink) -> Sink:
        """`sink` itself: the disk is a real one."""
        return sink

    def truth(self, reference_arm_ns: int, hold_arm_ns: int | None = None) -> dict[str, Any]:
        """The truth of a trial after these moments of the arm controller's clock."""
        found: dict[str, Any] = self._ask("truth", reference_arm_ns, hold_arm_ns)
        return found

    # -- Plate and Operator ----------------------------------------------------------------

    def act(self, action: PlateAction, seconds: float) -> None:
        """Raise the plate and hold it, release or catch it."""
        self._ask("act", action, seconds)

    def mass_kg(self) -> float:
        """Mass mounted now."""
        mass: float = self._ask("mass_kg")
        return mass

    def ask(self, task: str, prompt: str, expected: str) -> bool:
        """Ask the simulated person, who does it at once."""
        done: bool = self._ask("ask", task, prompt, expected)
        return done

    # -- the frame camera ------------------------------------------------------------------

    def grab(self, width_px: int, height_px: int) -> None:
        """The frame camera begins to grab; frames arrive by `on_frames`."""
        self._ask("grab", width_px, height_px)

    def stop_grabbing(self) -> None:
        """The frame camera stops."""
        self._ask("stop_grabbing")

    # -- tests -----------------------------------------------------------------------------

    def happen(self, device: str, kind: str) -> None:
        """Make something go wrong now; see `SimulationServer.happen`."""
        self._ask("happen", device, kind)

    def restore(self, device: str) -> None:
        """A person puts it right; see `SimulationServer.restore`. Drivers have to be built anew."""
        self.sync_port, self.event_address = self._ask("restore", device)

    def arm_place(self) -> tuple[float, float, float]:
        """Return where the sensor truly is: right and up on the plate, and depth into it, mm."""
        place: tuple[float, float, float] = self._ask("arm_place")
        return place

    def at_rest(self) -> bool:
        """Return whether the arm truly stands still."""
        rest: bool = self._ask("at_rest")
        return rest

    def sent(self) -> Counter[str]:
        """Return the counts of what was sent since the trial began, by stream."""
        found: Counter[str] = self._ask("sent")
        return found

    def events_between(self, first_us: int, last_us: int) -> int:
        """Return how many events with stamps from the first to the last of these were sent, us."""
        found: int = self._ask("events_between", first_us, last_us)
        return found

    # --------------------------------------------------------------------------------------

    def _ask(self, what: str, *arguments: Any) -> Any:
        with self._asking:
            with suppress(OSError, ValueError):  # what they said last may still be there
                self._pipe.send((what, arguments))
            return self._answer(ANSWER_S)

    def _answer(self, within_s: float) -> Any:
        try:
            if not self._pipe.poll(within_s):
                raise RigError("stand-ins", f"no answer within {within_s:g} s")
            good, value = self._pipe.recv()
        except (EOFError, OSError):
            raise RigError("stand-ins", "have ended") from None
        if not good:
            raise RigError(*value)
        return value

    def _read_frames(self) -> None:
        with suppress(EOFError, OSError):
            while True:
                frames = self._frames.recv()
                self.on_frames(frames)  # whoever listens now, not when the wait began


def _forget(frames: FrameChunk) -> None:
    """Nobody looks at the frames."""


def _serve(
    pipe: Connection,
    frames: Connection,
    settings: MockSettings,
    timing: Timing,
    devices: DeviceSettings,
) -> None:
    """The process: it ends with its parent, and never waits for a library to be taken down."""
    from sliplab.rigs.loopback.simulation_server import SimulationServer

    sys.setswitchinterval(0.0005)  # the fakes' threads answer while the scene computes
    status, server = 1, None
    try:
        server = SimulationServer(settings, timing, devices, frames.send)
        pipe.send((True, (server.sync_box.port, server.camera.address)))
        while True:
            if pipe.poll(TURN_S):
                what, arguments = pipe.recv()
                pipe.send(_do(server, what, arguments))
            server.turn()
    except (EOFError, BrokenPipeError, ConnectionError, pickle.UnpicklingError):
        status = 0
    except Exception as error:
        with suppress(OSError):
            pipe.send((False, ("stand-ins", f"failed: {error!r}")))
    with suppress(Exception):
        if server is not None:
            server.close()
    os._exit(status)


def _do(server: Any, what: str, arguments: tuple[Any, ...]) -> tuple[bool, Any]:
    try:
        found = getattr(server, what)
        return True, found(*arguments) if callable(found) else found
    except RigError as error:
        return False, (error.device, str(error).removeprefix(f"{error.device}: "))
