"""The world that all simulated devices look at: one arm, one plate, one skin, one true time.

Time moves only when the virtual clock waits, and the physics follow when a device looks: the
state then advances on a fixed grid of steps up to the present. A trial's data depend on the rig's
settings, the trial's seed and what the devices were told, never on what ran before: `begin_trial`
puts the skin at rest, sets the true time to 0 and draws everything that varies from trial to
trial from the seed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from protocols.program import PlateAction
from rigs.capabilities import ArmFault, ArmState, RigError, Segment
from rigs.mock.clocks import TrialClocks, trial_clocks
from rigs.mock.faults import FaultBook
from rigs.mock.geometry import ContactPlane
from rigs.mock.history import History
from rigs.mock.path import ArmPath, Leg
from rigs.mock.settings import MockSettings
from rigs.scene.contact import (
    Springs,
    Tips,
    advance,
    friction_field,
    make_springs,
    new_scratch,
    new_tips,
    record,
    track_width,
)
from rigs.scene.plate import advance_free
from rigs.scene.skin import Skin, SkinGeometry, make_skin

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]

CLEARANCE_MM = 60.0
MOST_TURNED_DEG = 20.0
NEAR_MM = 5.0
TRACK_LIMIT_STEPS = 300_000
"""Steps of history kept at least, twice as many at most; a trial is a few tens of thousands."""
_CHUNK = 8192


class World:
    """What is really there. Devices ask it; nothing outside the mock rig does.

    Attributes:
        now_ns: true time since the trial began, which is also the host's monotonic clock.
        past_ns: true time spent in earlier trials.
        trials: how often `begin_trial` was called.
        plate_marked: whether the sliding plate with its ArUco marker stands there.
    """

    def __init__(self, settings: MockSettings) -> None:
        self.settings = settings
        self.skin: Skin = _skin(settings)
        self.plane = ContactPlane.from_settings(settings.scene.contact)
        self.step_ns = settings.scene.step_us * 1000
        self.mass_kg = settings.scene.plate.mass_kg
        self.now_ns = self.past_ns = 0
        self.trials = 0
        start = self.plane.pose(0.0, 0.0, -CLEARANCE_MM)
        if settings.arm.start_xyz_mm is not None:
            start = type(start)(settings.arm.start_xyz_mm, start.rotvec_deg)
        self.path = ArmPath(self.plane, start)
        self.arm_state = ArmState.READY
        self.on_begin: list[Callable[[], None]] = []
        self._prepare(settings.seed)

    def begin_trial(self, seed: int) -> None:
        """Start over with the randomness of `seed`: skin at rest, true time 0, devices stopped.

        The arm stays where it is and keeps a protective stop; the mounted mass stays too.

        Raises:
            RigError: the arm is moving.
        """
        self.advance()
        if self.path.moving(self.now_ns):
            raise RigError("arm", "is still moving: a trial begins with the arm at rest")
        self.path.restart(self.now_ns)
        self.past_ns += self.now_ns
        self.now_ns = 0
        self.trials += 1
        self._prepare(seed)
        for callback in self.on_begin:
            callback()

    def _prepare(self, seed: int) -> None:
        scene = self.settings.scene
        self.seed = seed
        self.clocks: TrialClocks = trial_clocks(self.settings.clocks, self.settings.seed, seed)
        self.faults = FaultBook(self.settings.faults, self.trials)
        self.springs: Springs = make_springs(
            self.skin,
            friction=friction_field(
                self.skin, scene.friction.kinetic, scene.friction.path_variation,
                scene.friction.correlation_mm, seed,
            ),
            static_excess=scene.friction.static_excess,
            relaxation_share=scene.skin.relaxation_share,
            relaxation_s=scene.skin.relaxation_s,
        )  # fmt: skip
        n = len(self.skin)
        self.tips: Tips = new_tips(n)
        self._scratch = new_scratch(n)
        self.track = History(track_width(n), 0)
        self.loads: History | None = None
        self.plate_marked = False
        self.plate_free = False
        self.recording_ns: int | None = None
        """When the sync box first started in this trial."""
        self._plate_ramp: tuple[int, int, float, float] = (0, 0, 0.0, 0.0)
        self._plate_motion = np.zeros(2)
        self._release = (0, 0)

    # -- time ------------------------------------------------------------------------------

    def pass_time(self, ns: int) -> None:
        """Let true time pass; faults that fall due in it happen."""
        due = self.faults.arm_stop_due(self.now_ns, self.now_ns + ns, self.recording_ns)
        if due is not None:
            self.halt_arm(due, ArmState.PROTECTIVE_STOP)
        self.now_ns += ns

    def advance(self) -> int:
        """Bring the scene up to the present; returns the steps done, the last of them included."""
        target = self.now_ns // self.step_ns + 1
        while self.track.end < target:
            self._advance(min(target - self.track.end, _CHUNK))
        if target - self.track.base > 2 * TRACK_LIMIT_STEPS:
            self.track.forget(target - TRACK_LIMIT_STEPS)
        return target

    def _advance(self, count: int) -> None:
        first = self.track.end
        steps = np.arange(first, first + count, dtype=np.int64) * self.step_ns
        sensor = np.ascontiguousarray(self.path.states(steps)[:, 6:])
        track = self.track.grow(count)
        load = np.empty((count, 0)) if self.loads is None else self.loads.grow(count)
        h = self.step_ns * 1e-9
        if not self.plate_free:
            height = np.empty(count + 1)
            height[0] = self._plate_motion[0]
            height[1:] = self._prescribed(steps)
            advance(self.springs, self.tips, self._scratch, h, sensor, height, track, load)
            self._plate_motion[:] = height[-1], 0.0
            return
        plate = self.settings.scene.plate
        done = advance_free(
            self.springs, self.tips, self._scratch, h, sensor, self._plate_motion, self.mass_kg,
            self._weight(steps), plate.stiction_n, -plate.stroke_mm, track, load,
        )  # fmt: skip
        if done < count or self._plate_motion[0] <= -plate.stroke_mm:
            self._hold_plate(-plate.stroke_mm)
        if done < count:
            self.track.shrink(count - done)
            if self.loads is not None:
                self.loads.shrink(count - done)

    # -- the arm ---------------------------------------------------------------------------

    def start_arm(self, segments: Sequence[Segment]) -> list[Leg]:
        """Follow `segments` from now on; returns the legs."""
        self.advance()
        if self.path.moving(self.now_ns):
            raise RigError("arm", "is moving already; wait for its path to end, or stop it")
        for segment in segments:
            if segment.speed_mm_s <= 0.0:
                raise RigError("arm", f"speed {segment.speed_mm_s} mm/s: must be more than 0")
            near = self.plane.sensor(segment.to)[2] > -NEAR_MM
            turned = self.plane.turned_deg(segment.to)
            if near and turned > MOST_TURNED_DEG:
                raise ArmFault(
                    "arm",
                    f"the tool would meet the plate turned by {turned:.0f} degrees; its axes "
                    "must be the plate's: x right, y up, z into the plate",
                )
        return self.path.follow(segments, self.now_ns)

    def halt_arm(self, at_ns: int, state: ArmState) -> None:
        """The arm stands still from `at_ns` on, not before the present, and is in `state`."""
        self.advance()
        self.path.cut(at_ns)
        self.arm_state = state

    # -- the plate -------------------------------------------------------------------------

    def act(self, action: PlateAction, seconds: float) -> None:
        """Raise the plate and hold it, release it over a ramp, or catch it where it is."""
        self.advance()
        self.plate_marked = True
        length = round(seconds * 1e9)
        height = float(self._plate_motion[0])
        if action == "release":
            self.springs = self.springs._replace(damping_s=self.settings.scene.plate.damping_s)
            self.plate_free = True
            self._release = (self.now_ns, length)
            return
        self._hold_plate(height)
        if action == "raise":
            self._plate_ramp = (self.now_ns, length, height, 0.0)

    def _hold_plate(self, height: float) -> None:
        self.plate_free = False
        self._plate_ramp = (0, 0, height, height)
        self._plate_motion[:] = height, 0.0
        self.springs = self.springs._replace(damping_s=0.0)

    def _prescribed(self, t_ns: I64) -> F64:
        start, length, low, high = self._plate_ramp
        share = np.clip((t_ns - start) / max(length, 1), 0.0, 1.0)
        result: F64 = low + share * (high - low)
        return result

    def _weight(self, t_ns: I64) -> F64:
        start, length = self._release
        share = np.clip((t_ns - start) / max(length, 1), 0.0, 1.0)
        result: F64 = share * (self.mass_kg * self.settings.scene.plate.gravity_m_s2)
        return result

    # -- what devices look at --------------------------------------------------------------

    def keep_loads(self) -> History:
        """Keep the forces of every step from the present one on, until `loads` is let go."""
        done, n = self.advance(), len(self.skin)
        self.loads = History(3 * n, done - 1)
        record(self.tips, 0.0, np.empty(track_width(n)), self.loads.grow(1)[0])
        return self.loads

    def tips_at(self, t_ns: I64) -> tuple[F64, F64]:
        """Places of the tips in the world and heights of the plate, mm: (k, n, 2) and (k,).

        `t_ns` are rising true times not after the last step; between steps the line is straight.
        """
        n = len(self.skin)
        step = t_ns // self.step_ns
        share = ((t_ns - step * self.step_ns) / self.step_ns)[:, None]
        if not len(t_ns):
            return np.empty((0, n, 2)), np.empty(0)
        rows = self.track.rows(int(step[0]), min(int(step[-1]) + 2, self.track.end))
        before = rows[step - step[0]]
        after = rows[np.minimum(step - step[0] + 1, len(rows) - 1)]
        here = before + share * (after - before)
        tips = here[:, : 2 * n].reshape(-1, n, 2).copy()
        height = here[:, 3 * n]
        tips[:, :, 1] += height[:, None]
        return tips, height


def _skin(settings: MockSettings) -> Skin:
    made, friction = settings.scene.skin, settings.scene.friction
    seed = settings.seed if made.seed is None else made.seed
    geometry = SkinGeometry(
        **made.model_dump(exclude={"seed", "relaxation_share", "relaxation_s"}),
        friction_scatter=friction.papilla_scatter,
    )
    return make_skin(geometry, seed)
