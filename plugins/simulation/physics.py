"""The skin on the plate through one trial: springs, plate, and their history row by row.

Rows are on a global grid: every `step_ms` while the plate is held, every millisecond while it may
fall, plus one where the plate meets its stop. Nothing is computed beyond the present. The rows
depend only on the plate's commands and their times, never on how often the state is read.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from sliplab.plugins.simulation.fault_book import NEVER
from sliplab.plugins.simulation.history import GrowingTable
from sliplab.plugins.simulation.scene.contact import advance
from sliplab.plugins.simulation.scene.friction import friction_knots
from sliplab.plugins.simulation.scene.plate import advance_free
from sliplab.plugins.simulation.scene.skin import Skin
from sliplab.plugins.simulation.scene.springs import (
    GAP,
    Springs,
    Tips,
    make_springs,
    new_tips,
    track_width,
)
from sliplab.plugins.simulation.settings import MockSettings
from sliplab.protocols.program import PlateAction
from sliplab.rigs.core.finger_motion import FingerMotion

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]

FINE_NS = 1_000_000
"""Step while the plate may fall, ns."""
KEPT_NS = 300_000_000_000
"""Minimum stored history, at most twice as much; a trial takes a few tens of seconds."""
_CHUNK = 4096
OUT_OF_REACH_MM = 1e6
"""Gap of a torn papilla, which never touches."""


class Physics:
    """State and history of one trial.

    Attributes:
        step_ns: largest lag of the last row behind the present.
        track: rows of `scene.contact.record` since the trial began.
        loads: forces of every row since `keep_loads`, or None; more_loads: the same for each
            further event camera, by its name.
        wrench: sum of the contact's forces on the plate, and their torque about its centre, of
            every row since `keep_wrench`, (k, 6) in N and N m; or None, at no cost. more_wrenches:
            the same for each further force sensor, by its name.
    """

    def __init__(
        self,
        settings: MockSettings,
        skin: Skin,
        seed: int,
        sensor_at: Callable[[I64], F64],
        torn: Callable[[], Sequence[tuple[int, int]]] = tuple,
        spots: F64 | None = None,
        fingers: FingerMotion | None = None,
        *,
        fine: bool = False,
    ) -> None:
        """Put the skin at rest on the plate.

        Args:
            sensor_at: maps times (k,) to x, y, depth (mm) and slopes of depth, (k, 5).
            torn: papillae that tear off, with known true times, ns.
            spots: of `scene.springs.Springs`; left out, the plate is clean.
            fingers: of a gripper, which stall where the normal force reaches their limit.
            fine: a row every millisecond at all times, since the sensor is shaken.
        """
        self._settings, self._sensor_at, self._torn = settings, sensor_at, torn
        self._fingers = fingers
        self._off: set[int] = set()
        self.step_ns = FINE_NS if fine else settings.scene.step_ms * 1_000_000
        self.springs = springs_of(settings, skin, seed)
        if spots is not None:
            self.springs = replace(self.springs, spots=spots)
        self.tips: Tips = new_tips(len(skin))
        self.track = GrowingTable(track_width(len(skin)))
        self.loads: GrowingTable | None = None
        self.more_loads: dict[str, GrowingTable] = {}
        self.wrench: GrowingTable | None = None
        self.more_wrenches: dict[str, GrowingTable] = {}
        self.plate_free = False
        self._plate_ramp: tuple[int, int, float, float] = (0, 0, 0.0, 0.0)
        self._plate_motion = np.zeros(2)
        self._release: tuple[int, int, float] = (0, 0, 0.0)
        self._advance_over(np.array([-self.step_ns, 0], np.int64))

    def advance(self, now_ns: int) -> int:
        """Compute the rows up to a time; return the time of the last one, ns."""
        while True:
            step = FINE_NS if self.plate_free else self.step_ns
            first = (self.track.end_ns // step + 1) * step
            last = now_ns // step * step
            if last < first:
                break
            last = min(last, first + (_CHUNK - 1) * step, self._tear_off(first, step))
            times = np.arange(first, last + 1, step, dtype=np.int64)
            self._advance_by(np.concatenate([[self.track.end_ns], times]))
        if self.track.end_ns - self.track.begin_ns > 2 * KEPT_NS:
            self.track.forget(self.track.end_ns - KEPT_NS)
        return self.track.end_ns

    def _tear_off(self, first_ns: int, step_ns: int) -> int:
        """Remove papillae torn before `first_ns`; return the last row before the next tear."""
        last = NEVER
        for papilla, due_ns in self._torn():
            if due_ns >= first_ns:
                last = min(last, due_ns // step_ns * step_ns)
            elif papilla not in self._off:
                self._off.add(papilla)
                table = self.springs.table.copy()
                table[papilla, GAP] = OUT_OF_REACH_MM
                self.springs = replace(self.springs, table=table)
        return last

    def _catch_up(self, now_ns: int) -> None:
        """Compute rows up to the last millisecond at any step, because a change begins here."""
        self.advance(now_ns)
        behind = np.arange(self.track.end_ns, now_ns + 1, FINE_NS, dtype=np.int64)
        if len(behind) > 1:
            self._advance_by(behind)

    def _advance_by(self, t_ns: I64) -> None:
        """Compute the rows after the last one, which is the first of `t_ns`."""
        while len(t_ns) > 1 and self._stalls(int(t_ns[0]), int(t_ns[1]), int(t_ns[-1])):
            self._advance_over(t_ns[:2])
            t_ns = t_ns[1:]
            if self.track.end_ns != t_ns[0]:  # the plate met its stop on the way
                return
        if len(t_ns) > 1:
            self._advance_over(t_ns)

    def _stalls(self, now_ns: int, next_ns: int, last_ns: int) -> bool:
        """Stall fingers that would pass their force by `next_ns`; return whether they may later.

        The force rises with depth by the stiffness of all tips, unrelaxed, at most.
        """
        fingers = self._fingers
        force_n = None if fingers is None else fingers.closing_force_n(now_ns, last_ns)
        if fingers is None or force_n is None:
            return False
        if fingers.closing_force_n(now_ns, next_ns) is not None:
            depth = self._sensor_at(np.array([now_ns, next_ns], np.int64))[:, 2]
            stiffness = float(self.springs.normal.sum()) * (1.0 + self.springs.law.maxwell)
            rise_n = stiffness * float(depth[1] - depth[0])
            left_n = max(force_n - float(self.tips.normal.sum()), 0.0)
            if rise_n > left_n:
                fingers.stall(now_ns + int(left_n / rise_n * (next_ns - now_ns)))
        return True

    def _advance_over(self, t_ns: I64) -> None:
        count = len(t_ns) - 1
        sensor = np.ascontiguousarray(self._sensor_at(t_ns[1:]))
        track = self.track.grow(t_ns[1:])
        if self.loads is not None:
            load = self.loads.grow(t_ns[1:])
        else:
            unseen = self.wrench is None and not self.more_loads and not self.more_wrenches
            load = np.empty((count, 0 if unseen else 3 * len(self.tips.state)))
        springs, state = self.springs, self.tips.state
        if not self.plate_free:
            height = np.empty(count + 1)
            height[0] = self._plate_motion[0]
            height[1:] = self._prescribed(t_ns[1:])
            advance(
                springs.table,
                springs.friction,
                springs.law,
                state,
                t_ns,
                sensor,
                height,
                track,
                load,
                springs.spots,
            )
            self._plate_motion[:] = height[-1], 0.0
            self._sum_up(t_ns[1:], track, load, count)
            return
        plate, mass_kg = self._settings.scene.plate, self._release[2]
        done, landed = advance_free(
            springs.table,
            springs.friction,
            springs.law,
            state,
            t_ns,
            sensor,
            self._plate_motion,
            mass_kg,
            self._weight(t_ns),
            plate.stiction_n,
            -plate.stroke_mm,
            track,
            load,
            springs.spots,
        )
        self._sum_up(t_ns[1:], track, load, done)
        if landed:
            self._hold_plate(-plate.stroke_mm)
            more = *self.more_loads.values(), *self.more_wrenches.values()
            for rows in (self.track, self.loads, self.wrench, *more):
                if rows is not None:
                    rows.shrink(count - done, int(t_ns[done]))

    def _sum_up(self, t_ns: I64, track: F64, load: F64, done: int) -> None:
        """Keep the tips' forces for further cameras, and their sum for a force sensor.

        Args:
            done: rows that were computed; the others are removed where the plate has landed.
        """
        for rows in self.more_loads.values():
            rows.grow(t_ns)[:] = load
        if self.wrench is not None or self.more_wrenches:
            found = plate_wrench(track[:done], load[:done])
            for sums in (self.wrench, *self.more_wrenches.values()):
                if sums is not None:
                    sums.grow(t_ns)[:done] = found

    # -- the plate -------------------------------------------------------------------------

    def act(self, action: PlateAction, seconds: float, now_ns: int, mass_kg: float) -> None:
        """Raise the plate and hold it, release it over a ramp, or catch it where it is."""
        self._catch_up(now_ns)
        length = round(seconds * 1e9)
        height = float(self._plate_motion[0])
        if action == "release":
            self.springs = self.springs.damped(self._settings.scene.plate.damping_s)
            self.plate_free = True
            self._release = (now_ns, length, mass_kg)
            return
        self._hold_plate(height)
        if action == "raise":
            self._plate_ramp = (now_ns, length, height, 0.0)

    def _hold_plate(self, height: float) -> None:
        self.plate_free = False
        self._plate_ramp = (0, 0, height, height)
        self._plate_motion[:] = height, 0.0
        self.springs = self.springs.damped(0.0)

    def _prescribed(self, t_ns: I64) -> F64:
        start, length, low, high = self._plate_ramp
        share = np.clip((t_ns - start) / max(length, 1), 0.0, 1.0)
        result: F64 = low + share * (high - low)
        return result

    def _weight(self, t_ns: I64) -> F64:
        start, length, mass_kg = self._release
        share = np.clip((t_ns - start) / max(length, 1), 0.0, 1.0)
        result: F64 = share * (mass_kg * self._settings.scene.plate.gravity_m_s2)
        return result

    # -- state for devices -----------------------------------------------------------------

    def keep_loads(self, now_ns: int, camera: str = "") -> GrowingTable:
        """Record the forces of every row from now on, until `loads` is reset.

        Args:
            camera: name of a further event camera: its record is among `more_loads`.
        """
        self._catch_up(now_ns)
        tips = self.tips
        loads = GrowingTable(3 * len(tips.state))
        row = loads.grow(np.array([self.track.end_ns], np.int64))[0]
        row[:] = np.column_stack([tips.force, tips.normal]).ravel()
        if camera:
            self.more_loads[camera] = loads
        else:
            self.loads = loads
        return loads

    def keep_wrench(self, now_ns: int, sensor: str = "") -> GrowingTable:
        """Keep the sum of the forces of every row from the present on.

        Args:
            sensor: name of a further force sensor: its record is among `more_wrenches`.
        """
        self._catch_up(now_ns)
        wrench = GrowingTable(6)
        last_ns = np.array([self.track.end_ns], np.int64)
        load = np.column_stack([self.tips.force, self.tips.normal]).reshape(1, -1)
        wrench.grow(last_ns)[:] = plate_wrench(self.track.at(last_ns), load)
        if sensor:
            self.more_wrenches[sensor] = wrench
        else:
            self.wrench = wrench
        return wrench

    def tips_at(self, t_ns: I64) -> tuple[F64, F64]:
        """Return positions of the tips and heights of the plate, mm: (k, n, 2) and (k,).

        `t_ns` are increasing true times up to the last row; rows are interpolated linearly.
        """
        n = len(self.tips.state)
        here = self.track.at(t_ns)
        tips = here[:, : 2 * n].reshape(-1, n, 2).copy()
        height = here[:, 4 * n]
        tips[:, :, 1] += height[:, None]
        return tips, height


def plate_wrench(track: F64, load: F64) -> F64:
    """Return force on the plate and torque about its centre, (k, 6), N and N m.

    Axes: x right, y up, z into the plate.

    Args:
        track: rows that begin with the tips' places on the plate, mm, (k, 2 n and more).
        load: friction on the plate x, y and normal force of every tip, N, (k, 3 n).
    """
    n = load.shape[1] // 3
    place = track[:, : 2 * n].reshape(-1, n, 2) * 1e-3
    x, y = place[:, :, 0], place[:, :, 1]
    along_x, along_y, normal = np.moveaxis(load.reshape(-1, n, 3), 2, 0)
    parts = along_x, along_y, normal, y * normal, -x * normal, x * along_y - y * along_x
    return np.stack([part.sum(axis=1) for part in parts], axis=1)


def springs_of(settings: MockSettings, skin: Skin, seed: int) -> Springs:
    """Build the springs of one trial at the scene's physics level."""
    scene, friction = settings.scene, settings.scene.friction
    return make_springs(
        skin,
        friction_knots(
            skin, friction.kinetic, friction.path_variation, friction.correlation_mm, seed
        ),
        level=3 if scene.level == "auto" else int(scene.level[1]),
        static_excess=friction.static_excess,
        strengthening=friction.strengthening,
        weak_mm_s=friction.weak_mm_s,
        creep_mm_s=friction.creep_mm_s,
        creep_share=friction.creep_share,
        least_mm_s=friction.least_mm_s,
        curvature=0.0 if scene.plate_radius_mm is None else 1.0 / scene.plate_radius_mm,
        relaxation_share=scene.skin.relaxation_share,
        relaxation_s=scene.skin.relaxation_s,
    )
