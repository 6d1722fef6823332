"""One simulated scene in real time, behind fakes that speak the devices' protocols.

The fakes send the data that the simulated devices of `simulation` would return: the same world,
the same noise, the same named faults. Only the path to the host differs, so a trial is the same
through either. The world lags slightly behind the host's monotonic clock, so that a controller's
move never lies in the world's past.
"""

from __future__ import annotations

import math
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from sliplab.plugins.loopback.arm_path import FakeArmPath
from sliplab.plugins.loopback.device import STREAMS
from sliplab.plugins.loopback.tool_load import ToolLoad
from sliplab.plugins.simulation.clocks import trial_clocks
from sliplab.plugins.simulation.devices import build_mock
from sliplab.plugins.simulation.event_camera import MockEventCamera
from sliplab.plugins.simulation.force import MockForceSensor
from sliplab.plugins.simulation.frame_camera import MockFrameCamera
from sliplab.plugins.simulation.further_settings import FurtherEventCamera
from sliplab.plugins.simulation.identity import Identity
from sliplab.plugins.simulation.operator import MockPlate, SimulatedOperator
from sliplab.plugins.simulation.path import TrueSurface
from sliplab.plugins.simulation.settings import MockEventCameraSettings, MockSettings
from sliplab.plugins.simulation.sync import FreeRun, MockSyncBox
from sliplab.plugins.simulation.truth import plate_course, truth_of, watch_plate
from sliplab.plugins.simulation.world import SimulatedWorld, start_pose
from sliplab.protocols.nuisances import TrialNuisances
from sliplab.protocols.program import PlateAction
from sliplab.protocols.timing import Timing
from sliplab.rigs.core.capabilities import ArmState, PlateCourse, Pose, RigError, Segment, Truth
from sliplab.rigs.core.driver import (
    ArmScene,
    EventCameraDriver,
    FakeForceSensor,
    GripperScene,
    PulseTrain,
)
from sliplab.rigs.core.fake_motion import ControllerClock
from sliplab.rigs.core.fakes import Kind
from sliplab.rigs.core.faults import wired
from sliplab.rigs.core.pulse_code import PULSE_NS, CodeBits
from sliplab.rigs.core.registry import find_driver
from sliplab.rigs.device_section import DeviceSettings
from sliplab.storage.clockmap import ClockMap
from sliplab.storage.streams import FrameChunk

CAMERA = "event_camera"
REACH_MM = 2_000.0
"""Reach of the fake arm; the driver enforces the rig file's limits."""
I64 = npt.NDArray[np.int64]
LAG_NS = 20_000_000
"""Delay of the world behind the host's clock: longer than a controller's cycle."""
REST_S = 2.0
"""Timeout for the arm to come to rest when a trial begins, s."""
CLEAR_MM = 5.0
PENDANT_MM_S, PENDANT_MM_S2 = 20.0, 500.0
"""Speed and acceleration at which the operator moves a stopped arm clear of the plate."""
_NONE = np.empty(0, np.int64)
NO_FRAMES = FrameChunk(np.empty((0, 0, 0), np.uint8), _NONE, _NONE, _NONE, _NONE.astype(np.uint8))
"""Message that ends the frames."""


class SimulationServer:
    """The scene and its fakes; call `turn` from one thread to let it follow the clock.

    Args:
        settings: the simulated scene and devices, with their faults.
        timing: signals that reach each device; frames by hardware trigger or host arrival.
        devices: the rig's drivers: fakes of their kinds listen where they will look.
        on_frames: called with the frames of each turn.
        further: driver and simulated camera of each further event camera, by its stream's name.
    """

    def __init__(
        self,
        settings: MockSettings,
        timing: Timing,
        devices: DeviceSettings,
        on_frames: Callable[[FrameChunk], None],
        further: Mapping[str, tuple[str, FurtherEventCamera]] | None = None,
    ) -> None:
        _warm_up(settings, timing)
        self._origin_ns = time.monotonic_ns() - LAG_NS
        clocks = trial_clocks(settings.clocks, settings.seed, settings.seed)
        plane = TrueSurface.from_settings(settings.scene.contact, settings.arm.tip_offset_mm)
        self._arm_clock = clocks.arm
        self._arm_by_host = devices.arm.host_clock
        self._path = FakeArmPath(plane, start_pose(settings), clocks.arm)
        self.world = SimulatedWorld(settings, self._path, run_on=True)
        self._box_clock = ClockMap.line(0, 0, clocks.sync_box_ppb)
        self._box = MockSyncBox(self.world)
        self._events = MockEventCamera(self.world, self._box)
        wired = timing.frames == "hardware trigger"
        trigger = self._box if wired else FreeRun(self.world)
        self._frames = MockFrameCamera(self.world, trigger, timing.frames)
        self._plate = MockPlate(self.world)
        self._operator = SimulatedOperator(self.world)
        self._on_frames, self._grabbing = on_frames, False
        self._trains: deque[tuple[PulseTrain | None, int]] = deque()
        self._train: PulseTrain | None = None
        self._level = SyncLevel(self._box_clock)
        self._sent: Counter[str] = Counter()
        self._stamps_us: list[I64] = []
        fake_box = devices.sync_box_driver.fake
        assert fake_box is not None  # the rig file was held against it
        self._make: dict[str, Callable[[], Any]] = {
            "sync_box": partial(fake_box, self._box_now_ns, self._on_train)
        }
        fake_arm, fake_camera = devices.arm_driver.fake, devices.event_camera_driver.fake
        assert fake_arm is not None  # the rig file was held against it
        assert fake_camera is not None
        size = settings.event_camera.width, settings.event_camera.height
        self._make[CAMERA] = partial(fake_camera, size)
        self._force: MockForceSensor | None = None
        self._tool_load: ToolLoad | None = None
        if (driver := devices.force_sensor_driver) is not None:
            assert settings.force is not None  # the rig file was held against it
            # the sensor on the wire takes its load for zero itself
            alone = settings.force.model_copy(update={"bias": "never"})
            if driver.of_arm:
                self._force = MockForceSensor(
                    self.world, alone.model_copy(update={"range_n": math.inf})
                )
                self._tool_load = ToolLoad(
                    self.world, self._force, clocks.arm, settings.force.range_n
                )
            else:
                assert driver.fake is not None
                self._force = MockForceSensor(self.world, alone)
                self._make["force_sensor"] = partial(driver.fake, devices.force_sensor)
            self._force.start()
        if (gripper := devices.gripper_driver) is not None:
            assert self.world.fingers is not None  # the rig file was held against it
            assert gripper.fake is not None
            fingers = GripperScene(self.world.fingers, self._trial_now_ns)
            self._make["gripper"] = partial(gripper.fake, devices.gripper, fingers)
        scene = ArmScene(
            self._path.motion,
            ControllerClock(self._arm_now_s),
            self._arm_input,
            REACH_MM,
            None if self._tool_load is None else self._tool_load.at,
        )
        self.arm = fake_arm(devices.arm, scene)
        self._cameras = {CAMERA: self._events}
        for name, (kind, made) in (further or {}).items():
            own = Identity[MockEventCameraSettings](name, made, made.clock_ppm, made.seed)
            self._cameras[STREAMS + name] = MockEventCamera(self.world, self._box, own)
            fake = find_driver(kind, EventCameraDriver).fake
            assert fake is not None  # the rig file was checked against it
            self._make[STREAMS + name] = partial(fake, (made.width, made.height))
        self._fakes = {name: make() for name, make in self._make.items()}
        self.arm.start()
        self._start_events()

    @property
    def addresses(self) -> dict[str, Any]:
        """The address of each fake but the arm's; see `Loopback`."""
        return {name: fake.address for name, fake in self._fakes.items()}

    def close(self) -> None:
        """Close every fake."""
        for fake in (self.arm, *self._fakes.values()):
            fake.close()

    # -- time ------------------------------------------------------------------------------

    def _total_ns(self) -> int:
        """Return the total true time across all trials, by the host's clock."""
        return time.monotonic_ns() - self._origin_ns

    def _trial_now_ns(self) -> int:
        """Return the true time of the trial; the scene follows `LAG_NS` behind."""
        return self._total_ns() - self.world.past_ns

    def _box_now_ns(self) -> int:
        return self._box_clock.to_reference(self._total_ns())

    def _arm_now_s(self) -> float:
        return self._arm_clock.to_reference(self._total_ns()) / 1e9

    def _arm_input(self, t_s: float) -> bool:
        return self._level.high(self._arm_clock.to_device(round(t_s * 1e9)))

    def turn(self) -> None:
        """Advance the world to the clock, and send its devices' data."""
        world = self.world
        passed = self._total_ns() - LAG_NS - world.past_ns - world.now_ns
        while self._trains:
            self._tick(*self._trains.popleft())
        if passed > 0:
            world.pass_time(passed)
        if self._path.cut_ns is not None:
            self._path.cut_ns = None
            protective = world.arm_state is ArmState.PROTECTIVE_STOP
            self.arm.inject(Kind.PROTECTIVE_STOP if protective else Kind.PROGRAM_END)
        for name, seen in self._cameras.items():
            chunk, pulses = seen.read(), seen.read_pulses()
            if not len(chunk) and not len(pulses):
                continue
            self._fakes[name].send(chunk, pulses)
            if seen is self._events:
                self._sent.update({"events": len(chunk), "event_pulses": len(pulses)})
                self._stamps_us.append(chunk.t_us)
            else:
                self._sent[name.removeprefix(STREAMS)] += len(chunk)
        if self._force is not None and "force_sensor" in self._fakes:
            self._send_forces(self._force, self._fakes["force_sensor"])
        if self._tool_load is not None and self._tool_load.follow():
            self.arm.inject(Kind.PROTECTIVE_STOP)
        if self._grabbing:
            self._send_frames()

    def _start_events(self) -> None:
        for camera in self._cameras.values():
            camera.start()

    def _send_forces(self, seen: MockForceSensor, wire: FakeForceSensor) -> None:
        try:
            wire.send(seen.read())
        except RigError:  # beyond its range
            wire.overload()

    def _send_frames(self) -> None:
        frames = self._frames.read()
        if len(frames.number):
            self._on_frames(frames)
            self._sent["frames"] += len(frames.number)

    # -- the sync box ----------------------------------------------------------------------

    def _on_train(self, train: PulseTrain | None, sent: int) -> None:
        """Receive a train; called in the box's thread."""
        self._level.follow(train, sent)
        self._trains.append((train, sent))

    def _tick(self, train: PulseTrain | None, sent: int) -> None:
        if train is not None:
            self._train = train
            first = self._box_clock.to_device(train.first_ns) - self.world.past_ns
            self._box.start(train.rate_hz, train.seed, train.code, first)
        elif self._train is not None:
            # half a tick after the last one
            end = self._train.first_ns + round((sent - 0.5) * 1e9 / self._train.rate_hz)
            self._box.stop(self._box_clock.to_device(end) - self.world.past_ns)

    # -- Simulation ------------------------------------------------------------------------

    def begin_trial(self, seed: int, nuisances: TrialNuisances | None = None) -> None:
        """Draw everything that varies by trial from `seed`, with the skin at rest.

        Raises:
            RigError: the arm is moving.
        """
        end = time.monotonic() + REST_S
        while True:
            self.turn()
            if not self._path.moving(self.world.now_ns) or time.monotonic() > end:
                break
        self.world.begin_trial(seed, nuisances)
        self._path.begin(self.world.past_ns)
        self._start_events()
        if self._force is not None:
            self._force.start()
        self._sent.clear()
        self._stamps_us.clear()

    def truth(self, reference_arm_ns: int, hold_arm_ns: int | None = None) -> Truth:
        """Return the ground truth of a trial, counted from these arm controller times.

        See `truth.truth_of`.
        """
        self.turn()
        hold_ns = None if hold_arm_ns is None else self._true_ns(hold_arm_ns)
        reference_ns = self._true_ns(reference_arm_ns)
        return truth_of(self.world, self._box.clock, reference_ns, hold_true_ns=hold_ns)

    def watch_plate(self) -> None:
        """Keep the forces on the plate from now on."""
        self.turn()
        watch_plate(self.world)

    def plate_course(self, since_arm_ns: int) -> PlateCourse:
        """Return the plate's course since an arm controller time."""
        self.turn()
        return plate_course(self.world, self._true_ns(since_arm_ns))

    def _true_ns(self, arm_ns: int) -> int:
        """Return the true time of the trial at an arm controller time."""
        if self._arm_by_host:
            total_ns = arm_ns - self._origin_ns
        else:
            total_ns = int(self._arm_clock.to_device(arm_ns))
        return total_ns - self.world.past_ns

    def sent(self) -> Counter[str]:
        """Return the counts of data sent since the trial began; pulses since the last ARM."""
        return self._sent + Counter({"box_pulses": self._fakes["sync_box"].pulses})

    def events_between(self, first_us: int, last_us: int) -> int:
        """Return the number of sent events with time stamps from first to last, us, inclusive."""
        return sum(
            int(np.count_nonzero((stamps >= first_us) & (stamps <= last_us)))
            for stamps in self._stamps_us
        )

    def act(self, action: PlateAction, seconds: float) -> None:
        """Move the plate."""
        self.turn()
        self._plate.act(action, seconds)

    def mass_kg(self) -> float:
        """Mass mounted now."""
        return self._plate.mass_kg()

    def ask(self, task: str, prompt: str, expected: str) -> bool:
        """Let the simulated operator do a task."""
        if task == "protective_stop":
            self.arm.restore()
        return self._operator.ask(task, prompt, expected)

    def grab(self, width_px: int, height_px: int) -> None:
        """Start the frame camera on a region, with its counter at 0."""
        self.turn()
        self._frames.stop()
        self._frames.set_region(width_px, height_px)
        self._frames.start()
        self._grabbing = True

    def stop_grabbing(self) -> None:
        """Stop the frame camera; send the frames exposed before, and an empty chunk."""
        if self._grabbing:
            self.turn()
            self._frames.stop()
            self._grabbing = False
        self._on_frames(NO_FRAMES)

    # -- for tests: true state, faults and repairs -----------------------------------------

    def arm_place(self) -> tuple[float, float, float]:
        """Return the true position of the sensor: right and up on the plate, and depth, mm."""
        x, y, depth = self.world.plane.sensor(self.arm.pose())[:3]
        return float(x), float(y), float(depth)

    def at_rest(self) -> bool:
        """Return whether the arm is truly at rest."""
        return not self.arm.moving()

    def inject(self, device: str, kind: str) -> None:
        """Inject a fault of a device now.

        Args:
            device: ``arm``, ``sync_box``, ``event_camera``, ``force_sensor``, ``gripper``, or the
                name of a further event camera's stream.
            kind: of the table of faults (`rigs.core.faults`).

        Raises:
            RigError: no such fault.
        """
        known: dict[str, Callable[[], None]] = {}
        if device == "arm":
            known = {found: partial(self.arm.inject, Kind(found)) for found in wired(device)}
        elif (fake := self._fakes.get(name := self._name(device))) is not None:
            faults = wired(CAMERA if name.startswith(STREAMS) else device)
            known = {found: getattr(fake, method) for found, method in faults.items()}
        if kind not in known:
            raise RigError(device, f"its fake cannot simulate '{kind}'")
        known[kind]()

    def _name(self, device: str) -> str:
        return device if device in self._fakes else STREAMS + device

    def restore(self, device: str) -> dict[str, Any]:
        """Recover a device from any fault, as an operator would.

        A stopped arm is unlocked and moved clear of the plate; other devices are reconnected.

        Returns:
            `addresses`, which may be new ones.

        Raises:
            RigError: no such device.
        """
        if device == "arm":
            self.arm.restore()
            x, y, depth = self.arm_place()
            if depth > -CLEAR_MM:
                clear = self.world.plane.pose(x, y, -CLEAR_MM)
                now_s = self._arm_now_s()
                self._path.motion.move(clear, PENDANT_MM_S, PENDANT_MM_S2, now_s)
        elif (name := self._name(device)) in self._fakes:
            self._fakes[name].close()
            self._fakes[name] = self._make[name]()
        else:
            raise RigError(device, "has no fake")
        return self.addresses


class SyncLevel:
    """The sync line's level at any time, from the running train; read in the arm's thread.

    Args:
        box: total true time to the box's clock, ns.
    """

    def __init__(self, box: ClockMap) -> None:
        self._box = box
        self._train: PulseTrain | None = None
        self._bits = CodeBits(1)
        self._ticks: int | None = None

    def follow(self, train: PulseTrain | None, sent: int) -> None:
        """Record the start of a train, or with None its end after `sent` ticks."""
        if train is None:
            self._ticks = sent
        else:
            self._bits = CodeBits(train.seed, train.code)
            self._ticks, self._train = None, train

    def high(self, total_ns: int) -> bool:
        """Return whether the line is high at a total true time."""
        train, ticks = self._train, self._ticks
        if train is None:
            return False
        passed = self._box.to_reference(total_ns) - train.first_ns
        period = 1e9 / train.rate_hz
        tick = int(passed // period)
        if tick < 0 or (ticks is not None and tick >= ticks):
            return False
        bit = bool(self._bits.upto(tick + 1)[tick])
        return bit and passed - tick * period < min(PULSE_NS, period / 2)


def _warm_up(settings: MockSettings, timing: Timing) -> None:
    """Run a similar world briefly, so that everything is compiled and loaded.

    Compiling holds Python's interpreter lock for seconds, in which no fake could answer.
    """
    devices = build_mock(settings, timing)
    devices.arm.connect()
    devices.begin_trial(1)
    devices.frames.set_region(64, 64)
    devices.events.start()
    devices.frames.start()
    devices.sync.start(100.0, 1)
    home = devices.arm.pose()
    devices.arm.start([Segment(Pose((home.xyz_mm[0] + 1.0, *home.xyz_mm[1:]), home.rotvec_deg), 5)])
    for _ in range(10):
        devices.clock.wait(0.05)
        for read in (devices.events.read, devices.events.read_pulses, devices.frames.read):
            read()
    devices.truth(devices.clock.now_ns() - 100_000_000)
