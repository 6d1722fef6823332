"""The world that all simulated devices share: one arm, one plate, one skin, one true time.

Time passes only when the virtual clock waits. The physics are evaluated lazily: when a device reads
the state, it advances on a fixed grid of steps up to the present. A trial's data depend on the
rig's settings, the trial's seed and the commands to the devices, never on earlier trials (but
for a skin that wears, a fault):
`begin_trial` puts the skin at rest, sets the true time to 0 and draws everything that varies by
trial from the seed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from weakref import WeakMethod

import numpy as np
import numpy.typing as npt

from sliplab.plugins.simulation.clocks import (
    ClockMaps,
    own_clock,
    shifted,
    trial_clocks,
    with_faults,
)
from sliplab.plugins.simulation.fault_book import FaultBook
from sliplab.plugins.simulation.history import GrowingTable
from sliplab.plugins.simulation.nuisances import Shake, faults_of
from sliplab.plugins.simulation.path import SENSOR, ArmPath, Leg, ToolDeviation, TrueSurface
from sliplab.plugins.simulation.physics import Physics
from sliplab.plugins.simulation.scene.lens import BoardPlace
from sliplab.plugins.simulation.scene.skin import Skin
from sliplab.plugins.simulation.scene.vibration import ArmVibration
from sliplab.plugins.simulation.settings import MockSettings, skin_of
from sliplab.protocols.nuisances import TrialNuisances
from sliplab.protocols.program import PlateAction
from sliplab.rigs.core.capabilities import ArmFault, ArmState, Pose, RigError, Segment
from sliplab.rigs.core.faults import PlateStuck
from sliplab.rigs.core.finger_motion import FingerMotion
from sliplab.storage.clockmap import ClockMap

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]

CLEARANCE_MM = 60.0
MOST_TURNED_DEG = 20.0
NEAR_MM = 5.0


def start_pose(settings: MockSettings) -> Pose:
    """Return the arm's pose at power-on."""
    plane = TrueSurface.from_settings(settings.scene.contact, settings.arm.tip_offset_mm)
    start = plane.pose(0.0, 0.0, -CLEARANCE_MM)
    if settings.arm.start_xyz_mm is not None:
        return Pose(settings.arm.start_xyz_mm, start.rotvec_deg)
    return start


def fingers_of(settings: MockSettings) -> FingerMotion | None:
    """Return the fingers of a simulated rig at rest, if it has a gripper."""
    made = settings.gripper
    if made is None:
        return None
    return FingerMotion(made.opening_mm, made.reaction_us * 1000, made.acceleration_mm_s2)


class SimulatedWorld:
    """The simulated world, which only simulated devices access.

    Attributes:
        now_ns: true time since the trial began, which is also the host's monotonic clock.
        past_ns: true time spent in earlier trials.
        trials: number of calls of `begin_trial`.
        slid_mm: path that each tip slid in earlier trials, (n,).
        board: position of a printed board in front of the outside camera; None if there is none.
        fingers: opening of the gripper that holds the sensor; None without one.
        plate_marked: True once the sliding plate with its ArUco marker is used.

    Args:
        path: path of an arm that is driven from outside; if left out, the arm follows `start_arm`.
        run_on: True if the devices' clocks continue from trial to trial, as real ones do; else
            each trial draws its own offsets.
    """

    def __init__(
        self, settings: MockSettings, path: ArmPath | None = None, *, run_on: bool = False
    ) -> None:
        self.settings, self._run_on = settings, run_on
        self.skin: Skin = skin_of(settings)
        self.plane = TrueSurface.from_settings(settings.scene.contact, settings.arm.tip_offset_mm)
        self.mass_kg = settings.scene.plate.mass_kg
        self.now_ns = self.past_ns = 0
        self.trials = 0
        self.board: BoardPlace | None = None
        self.path = path or ArmPath(self.plane, start_pose(settings))
        self.fingers = fingers_of(settings)
        self.arm_state = ArmState.READY
        self._at_begin: list[WeakMethod[Callable[[], None]]] = []
        self.slid_mm = np.zeros(len(self.skin))
        self._prepare(settings.seed)

    def begin_trial(self, seed: int, nuisances: TrialNuisances | None = None) -> None:
        """Reset with the randomness of `seed`: skin at rest, true time 0, devices stopped.

        The arm stays where it is and keeps a protective stop; the mounted mass stays too.

        Args:
            nuisances: what disturbs the trial.

        Raises:
            RigError: the arm is moving.
        """
        self.advance()
        if self.path.moving(self.now_ns):
            raise RigError("arm", "is still moving: a trial begins with the arm at rest")
        if self.fingers is not None:
            self.fingers.restart(self.now_ns)
        self.slid_mm += self.physics.tips.path
        self.path.restart(self.now_ns)
        self.past_ns += self.now_ns
        self.now_ns = 0
        self.trials += 1
        self._prepare(seed, nuisances)
        for device in self._at_begin:
            begin = device()
            if begin is not None:
                begin()

    def at_begin(self, method: Callable[[], None]) -> None:
        """Call a device's method whenever a trial begins, after everything else is reset.

        Only a weak reference to the device is held, since the device refers to the world: an unused
        rig frees its memory at once.
        """
        self._at_begin.append(WeakMethod(method))

    def _prepare(self, seed: int, nuisances: TrialNuisances | None = None) -> None:
        settings = self.settings
        self.seed = seed
        faults = settings.faults
        if nuisances is not None:
            faults += tuple(faults_of(nuisances, settings.event_camera, seed))
        self.faults = FaultBook(faults, self.trials)
        clocks = trial_clocks(
            settings.clocks, settings.seed, settings.seed if self._run_on else seed
        )
        if self._run_on:
            clocks = clocks.after(self.past_ns)
        self.clocks: ClockMaps = with_faults(clocks, self.faults)
        self.path.ramp_mm_s2 = self.faults.ramp_mm_s2()
        self.path.deviation = ToolDeviation(self.faults, self.plane, self.path.commanded)
        here = self.path.commanded(np.array([self.now_ns], np.int64), SENSOR)[0]
        self._straight_rad = float(here[5])
        self._vibration = ArmVibration(
            settings.arm.vibration_um, settings.arm.vibration_hz, settings.seed, seed
        )
        self._shake = Shake(self.faults, seed)
        self.physics = Physics(
            settings,
            self.faults.grips(self.skin, self.slid_mm),
            seed,
            self._weak_sensor_at(),
            self.faults.torn,
            self.faults.spots(),
            self.fingers,
            fine=bool(self._shake),
        )
        self.plate_marked = False

    def _weak_sensor_at(self) -> Callable[[I64], F64]:
        """Return `_sensor_at` for the physics, which this world has, without a cycle of them."""
        method = WeakMethod(self._sensor_at)

        def sensor_at(t_ns: I64) -> F64:
            found = method()
            assert found is not None, "physics are used through their world"
            return found(t_ns)

        return sensor_at

    def _sensor_at(self, t_ns: I64) -> F64:
        """Return x, y and depth (mm) of the sensor and slopes of depth at times, (k, 5).

        Where it is turned from its angle at the trial's start, the difference (rad) is a sixth
        column.
        """
        sensor = self.path.states(t_ns, SENSOR)
        sensor[:, 5] -= self._straight_rad
        if not sensor[:, 5].any():
            sensor = np.ascontiguousarray(sensor[:, :5])
        if self.fingers is not None:
            sensor[:, 2] += self.closed_mm(t_ns)
        if self._vibration:
            strength = self.path.tremor(t_ns)[:, None]
            sensor[:, :3] += strength * self._vibration.at(t_ns)
        if self._shake:
            sensor[:, :3] += self._shake.at(t_ns)
        return sensor

    def depth_mm(self, t_ns: I64) -> F64:
        """Depth of the sensor at increasing times, mm, (n,)."""
        return self._sensor_at(t_ns)[:, 2]

    def closed_mm(self, t_ns: I64) -> F64:
        """By how much the fingers add to the arm's depth at increasing times, mm, (n,)."""
        gripper = self.settings.gripper
        if self.fingers is None or gripper is None:
            return np.zeros(len(t_ns))
        return gripper.opening_mm - self.fingers.opening_mm(t_ns)

    def turn_at(self, t_ns: I64) -> F64:
        """Angle of the sensor about the plate's normal since the trial began, rad, (k,)."""
        return self.path.states(t_ns, SENSOR)[:, 5] - self._straight_rad

    # -- time ------------------------------------------------------------------------------

    def pass_time(self, ns: int) -> None:
        """Let true time pass, with the faults that are due in it."""
        end_ns = self.now_ns + ns
        halt = self.faults.arm_halt(self.now_ns, end_ns, lambda t_ns: self.path.states(t_ns)[:, :3])
        if halt is not None:
            at_ns, protective = halt
            self.halt_arm(at_ns, ArmState.PROTECTIVE_STOP if protective else self.arm_state)
        self.now_ns = end_ns

    def advance(self) -> int:
        """Advance the physics to the present; return the time of the last row, ns."""
        return self.physics.advance(self.now_ns)

    @property
    def step_ns(self) -> int:
        """Largest lag of the last row behind the present."""
        return self.physics.step_ns

    def further_clock(self, name: str, ppm: float) -> ClockMap:
        """Return the map from true time to the clock of a further device in this trial.

        Args:
            name: of its stream.
            ppm: its largest drift, either way.
        """
        settings = self.settings
        clock = own_clock(
            settings.clocks, ppm, name, settings.seed, settings.seed if self._run_on else self.seed
        )
        return shifted(clock, self.past_ns) if self._run_on else clock

    # -- the arm ---------------------------------------------------------------------------

    def start_arm(self, segments: Sequence[Segment]) -> list[Leg]:
        """Start to follow `segments`; return the legs."""
        self.advance()
        if self.path.moving(self.now_ns):
            raise RigError("arm", "is already moving; wait for its path to end, or stop it")
        for segment in segments:
            if segment.speed_mm_s <= 0.0:
                raise RigError("arm", f"speed {segment.speed_mm_s} mm/s: must be more than 0")
            sensor = self.plane.sensor(segment.to)
            near = sensor[2] > -NEAR_MM
            turned = self.plane.turned_deg(segment.to, float(sensor[5]) - self._straight_rad)
            if near and turned > MOST_TURNED_DEG:
                raise ArmFault(
                    "arm",
                    f"the tool would touch the plate rotated by {turned:.0f} degrees; its axes "
                    "must be parallel to the plate's: x right, y up, z into the plate",
                )
        return self.path.follow(segments, self.now_ns)

    def halt_arm(self, at_ns: int, state: ArmState) -> None:
        """Stop the arm at `at_ns`, not before the present, and set its state."""
        self.advance()
        self.path.cut(at_ns)
        self.arm_state = state

    # -- the plate -------------------------------------------------------------------------

    def act(self, action: PlateAction, seconds: float) -> None:
        """Raise the plate and hold it, release it over a ramp, or catch it where it is."""
        self.plate_marked = True
        if action == "release" and self.faults.of(PlateStuck):
            return
        self.physics.act(action, seconds, self.now_ns, self.mass_kg)

    # -- state for devices -----------------------------------------------------------------

    def keep_loads(self, camera: str = "") -> GrowingTable:
        """Record the forces of every row from the last one on, until `drop_loads`.

        Args:
            camera: name of a further event camera, which has a separate record.
        """
        return self.physics.keep_loads(self.now_ns, camera)

    def keep_wrench(self, sensor: str = "") -> GrowingTable:
        """Keep the sum of the forces of every row from the last one on, until the trial ends.

        Args:
            sensor: name of a further force sensor, which has a separate record.
        """
        return self.physics.keep_wrench(self.now_ns, sensor)

    def drop_wrench(self, sensor: str = "") -> None:
        """Stop keeping the sum of the forces for the first force sensor, or for a further one."""
        if sensor:
            self.physics.more_wrenches.pop(sensor, None)
        else:
            self.physics.wrench = None

    def drop_loads(self, camera: str = "") -> None:
        """Stop recording forces for the first event camera, or for a further one."""
        if camera:
            self.physics.more_loads.pop(camera, None)
        else:
            self.physics.loads = None

    def tips_at(self, t_ns: I64) -> tuple[F64, F64]:
        """Return positions of the tips and heights of the plate, mm: (k, n, 2) and (k,).

        `t_ns` are increasing true times up to the last row; rows are interpolated linearly.
        """
        return self.physics.tips_at(t_ns)
