"""The fakes of a loopback rig in a separate process, and the rig's interface to it.

In one process, drivers and fakes would wait for each other and share one interpreter, unlike on a
real rig. Frames return through a second pipe, because pylon's emulated camera is in the drivers'
process: `plugins.devices.basler.fake_live` substitutes them for its images.
"""

from __future__ import annotations

import os
import pickle
import signal
import sys
import threading
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any

from sliplab.plugins.loopback.device import STREAMS
from sliplab.plugins.simulation.further_settings import FurtherEventCamera
from sliplab.plugins.simulation.settings import MockSettings
from sliplab.protocols.nuisances import TrialNuisances
from sliplab.protocols.program import PlateAction
from sliplab.protocols.timing import Timing
from sliplab.rigs.core.capabilities import PlateCourse, RigError, Truth
from sliplab.rigs.core.driver import EventCameraDriver
from sliplab.rigs.core.host_clock import STEP_S, StallTimer
from sliplab.rigs.core.library_process import PipeCalls
from sliplab.rigs.device_section import DeviceSettings
from sliplab.rigs.rig_file import RigFile
from sliplab.rigs.stream_settings import EventStream, Stream
from sliplab.storage.process import leave_to_parent, out_of_reach, used_s
from sliplab.storage.spawn_context import WORKERS
from sliplab.storage.streams import FrameChunk, Sink

READY_S = 180.0
"""Timeout for the fakes to start, in which kernels may be compiled: s of their own processor time,
or without any, since a busy computer delays them at will."""
ANSWER_S = 20.0
"""Timeout of an answer, s."""
TURN_S = 0.004
"""Period at which the scene follows the clock, s."""
END_S = 5.0


class Loopback:
    """The fakes of a loopback rig, running until `close`.

    It is also the `Simulation`, `Plate` and `Operator` of the rig (`rigs.core.capabilities`).

    Attributes:
        addresses: where the driver of each device finds its fake: by `event_camera`, `sync_box`,
            `force_sensor`, `gripper`, or `STREAMS` and the name of a further event camera's stream.

    Raises:
        RigError: they do not start.
    """

    def __init__(
        self,
        settings: MockSettings,
        timing: Timing,
        devices: DeviceSettings,
        streams: Mapping[str, Stream] | None = None,
    ) -> None:
        further = {
            name: (stream.device.driver, stream.mock)
            for name, stream in (streams or {}).items()
            if isinstance(stream, EventStream) and stream.device and stream.mock
        }
        ours, theirs = WORKERS.Pipe()
        self._frames, their_frames = WORKERS.Pipe(duplex=False)
        self._on_frames: Callable[[FrameChunk], None] = _forget
        self._process = WORKERS.Process(
            target=_serve,
            args=(theirs, their_frames, settings, timing, devices, further),
            name="simulation server",
            daemon=True,  # ended with this process, where nothing closed it
        )
        with out_of_reach():
            self._process.start()
        theirs.close()
        their_frames.close()
        self._calls = PipeCalls(ours, self._process.kill, pending=1)
        try:
            self.addresses: Mapping[str, Any] = self._result(self._ready)
        except BaseException:
            self.close()
            raise
        self._reader = threading.Thread(target=self._read_frames, name="frames", daemon=True)
        self._reader.start()

    def close(self) -> None:
        """End the fakes; safe to call more than once."""
        self._calls.close()
        with suppress(ValueError):  # it has been closed before, or does not end
            self._process.join(END_S)
            if self._process.is_alive():
                self._process.kill()
                self._process.join(END_S)
            self._process.close()  # its pipes would stay open until the garbage is collected
        self._frames.close()

    def reached_by(self, file: RigFile) -> RigFile:
        """Return a rig file whose drivers reach these fakes."""
        devices = file.devices
        assert devices is not None
        reached = {}
        for name in ("event_camera", "sync_box", "force_sensor", "gripper"):
            driver = getattr(devices, f"{name}_driver")
            if driver is not None and driver.reach is not None:
                reached[name] = driver.reach(getattr(devices, name), self.addresses[name])
        streams = dict(file.streams)
        for name, stream in file.streams.items():
            if not isinstance(stream.driver, EventCameraDriver):
                continue  # its driver simulates it
            assert stream.driver.reach is not None  # the file was held against it
            device = stream.driver.reach(stream.device, self.addresses[STREAMS + name])
            streams[name] = stream.model_copy(update={"device": device})
        changes = {"devices": devices.model_copy(update=reached), "streams": streams}
        return file.model_copy(update=changes)

    # -- Simulation ------------------------------------------------------------------------

    def begin_trial(self, seed: int, nuisances: TrialNuisances | None = None) -> None:
        """Draw everything that varies by trial from `seed`. Raises RigError."""
        self._ask("begin_trial", seed, nuisances)

    def sink(self, sink: Sink) -> Sink:
        """Return `sink` itself, because the disk is real."""
        return sink

    def truth(self, reference_arm_ns: int, hold_arm_ns: int | None = None) -> Truth:
        """Return the ground truth of a trial, counted from these arm controller times."""
        found: Truth = self._ask("truth", reference_arm_ns, hold_arm_ns)
        return found

    def watch_plate(self) -> None:
        """Keep the forces on the plate from now on."""
        self._ask("watch_plate")

    def plate_course(self, since_arm_ns: int) -> PlateCourse:
        """Return the plate's course since an arm controller time."""
        found: PlateCourse = self._ask("plate_course", since_arm_ns)
        return found

    # -- Plate and Operator ----------------------------------------------------------------

    def act(self, action: PlateAction, seconds: float) -> None:
        """Raise and hold, release or catch the plate."""
        self._ask("act", action, seconds)

    def mass_kg(self) -> float:
        """Mass mounted now."""
        mass: float = self._ask("mass_kg")
        return mass

    def ask(self, task: str, prompt: str, expected: str) -> bool:
        """Ask the simulated operator, who does it at once."""
        done: bool = self._ask("ask", task, prompt, expected)
        return done

    # -- the frame camera ------------------------------------------------------------------

    def grab(self, width_px: int, height_px: int, on_frames: Callable[[FrameChunk], None]) -> None:
        """Start the frame camera; see `rigs.core.driver.SceneFrames`."""
        self._on_frames = on_frames
        self._ask("grab", width_px, height_px)

    def stop_grabbing(self) -> None:
        """Stop the frame camera."""
        self._ask("stop_grabbing")

    # -- tests -----------------------------------------------------------------------------

    def inject(self, device: str, kind: str) -> None:
        """Inject a fault now; see `SimulationServer.inject`."""
        self._ask("inject", device, kind)

    def restore(self, device: str) -> None:
        """Clear a device's faults; see `SimulationServer.restore`. Drivers must be rebuilt."""
        self.addresses = self._ask("restore", device)

    def arm_place(self) -> tuple[float, float, float]:
        """Return the true position of the sensor: right and up on the plate, and depth, mm."""
        place: tuple[float, float, float] = self._ask("arm_place")
        return place

    def at_rest(self) -> bool:
        """Return whether the arm is truly at rest."""
        rest: bool = self._ask("at_rest")
        return rest

    def sent(self) -> Counter[str]:
        """Return the counts of data sent since the trial began, by stream."""
        found: Counter[str] = self._ask("sent")
        return found

    def events_between(self, first_us: int, last_us: int) -> int:
        """Return the number of sent events with time stamps from first to last, us, inclusive."""
        found: int = self._ask("events_between", first_us, last_us)
        return found

    # --------------------------------------------------------------------------------------

    def _ask(self, what: str, *arguments: Any) -> Any:
        return self._result(lambda: self._calls.call((what, arguments), ANSWER_S))

    def _result(self, answer: Callable[[], tuple[bool, Any]]) -> Any:
        try:
            good, value = answer()
        except TimeoutError as error:
            raise RigError("fakes", str(error)) from None
        except (EOFError, OSError):
            raise RigError("fakes", "their process has ended") from None
        if not good:
            raise RigError(*value)
        return value

    def _ready(self) -> tuple[bool, Any]:
        """Return the answer that the fakes send once they have started."""
        idle, pid = StallTimer(), self._process.pid or 0
        while not self._calls.pipe.poll(STEP_S):
            used = used_s(pid)
            if used > READY_S or idle.waited_s(used) > READY_S:
                raise TimeoutError(f"did not start in {READY_S:g} s of processor time")
        return self._calls.answer(ANSWER_S)

    def _read_frames(self) -> None:
        with suppress(EOFError, OSError):
            while True:
                frames = self._frames.recv()
                self._on_frames(frames)  # of the last grab


def _forget(frames: FrameChunk) -> None:
    """Discard frames."""


def _serve(
    pipe: Connection,
    frames: Connection,
    settings: MockSettings,
    timing: Timing,
    devices: DeviceSettings,
    further: Mapping[str, tuple[str, FurtherEventCamera]],
) -> None:
    """Run the process; it ends with its parent, without waiting for libraries to shut down."""
    leave_to_parent()
    signal.signal(signal.SIGTSTP, signal.SIG_IGN)  # Ctrl-Z, which stops the arm in the parent
    from sliplab.plugins.loopback.simulation_server import SimulationServer

    sys.setswitchinterval(0.0005)  # the fakes' threads answer while the scene computes
    status, server = 1, None
    try:
        server = SimulationServer(settings, timing, devices, frames.send, further)
        pipe.send((True, server.addresses))
        while True:
            if pipe.poll(TURN_S):
                what, arguments = pipe.recv()
                pipe.send(_do(server, what, arguments))
            server.turn()
    except (EOFError, BrokenPipeError, ConnectionError, pickle.UnpicklingError):
        status = 0
    except Exception as error:
        with suppress(OSError):
            pipe.send((False, ("fakes", f"failed: {error!r}")))
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
