"""`sliplab calibrate detector`: a hold, an unload and three short rubs on the rig."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from sliplab.analysis.detectors.alarms import needed_hours
from sliplab.analysis.detectors.live import ClockFellBack
from sliplab.analysis.detectors.papillae import VERSION
from sliplab.analysis.detectors.skin import NAME, SUFFIX
from sliplab.analysis.detectors.skin_measurement import (
    HOLD,
    NOISE,
    RUB,
    UNLOAD,
    SkinError,
    SkinMeasurement,
)
from sliplab.flows.calibrating.measurement import CalibrationSession, PlannedMove
from sliplab.flows.running import console
from sliplab.protocols.errors import InputError
from sliplab.protocols.program import Dwell, Move, Position, Program, Step
from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.core.rig import RETRACT_SPEED_MM_S
from sliplab.rigs.rig_file import RigFile
from sliplab.storage.schema.detector import DetectorCalibration

DIRECTIONS_DEG = (0.0, 120.0, 240.0)
CLEAR_MM, LIFTED_MM = -5.0, -1.0
PRESS_MM_S, UNLOAD_MM_S = 2.0, 0.5
NOISE_S, SETTLE_S = 5.0, 1.0
SYNC_HZ = 100
POLL_S = 0.02
"""Longest period of reading the streams: it blurs where a step's events begin."""
SEED = 4000
"""Of a simulated rig's randomness."""


@dataclass(frozen=True)
class SkinMotion:
    """The motion of a calibration.

    Attributes:
        hold_s: how long the sensor is pressed and still.
        rub_mm: length of a rub.
    """

    depth_mm: float
    hold_s: float
    rub_mm: float
    speed_mm_s: float

    def check(self, file: RigFile) -> None:
        """Raise InputError where a limit of the rig forbids it, or it has no event camera."""
        if "events" not in file.cameras:
            right = f"needs an event camera, and the rig {file.name} has none"
            raise InputError("--rig", "", file.name, right)
        for option, value, limit, unit in (
            ("--depth", self.depth_mm, file.limits.depth, "depth"),
            ("--rub", self.rub_mm, file.limits.reach, "reach"),
            ("--speed", self.speed_mm_s, file.limits.speed, "speed"),
        ):
            if value > float(limit):
                text = f"is more than the rig may: limits.{unit} = {float(limit):g}"
                raise InputError(option, "", f"{value:g}", text)

    @property
    def moves(self) -> list[PlannedMove]:
        """What is announced."""
        depth = self.depth_mm
        found = [
            PlannedMove("press", 0.0, 0.0, CLEAR_MM, depth, PRESS_MM_S),
            PlannedMove("unload", 0.0, 0.0, depth, depth / 2, UNLOAD_MM_S),
        ]
        for number, end in enumerate(self._ends(), 1):
            what = f"rub {number}"
            found.append(PlannedMove(what, end.x_mm, end.y_mm, depth, depth, self.speed_mm_s))
        return found

    def program(self, most_mm_s: float) -> Program:
        """Return the motion.

        Args:
            most_mm_s: speed that no step exceeds.
        """

        def move(phase: str, to: Position, speed_mm_s: float) -> Move:
            return Move(phase, to, min(speed_mm_s, most_mm_s), recorded=True)

        home = Position(0.0, 0.0, CLEAR_MM)
        middle = Position(0.0, 0.0, self.depth_mm)
        settle = Dwell("settle", SETTLE_S, recorded=True)
        steps: list[Step] = [
            Move("press", middle, min(PRESS_MM_S, most_mm_s)),
            Dwell("settle", SETTLE_S),
            Dwell(NOISE, NOISE_S, recorded=True),
            Dwell(HOLD, self.hold_s, recorded=True),
            move(UNLOAD, Position(0.0, 0.0, self.depth_mm / 2), UNLOAD_MM_S),
        ]
        x_mm, y_mm = 0.0, 0.0
        for end in self._ends():
            # lifted between rubs, so that each begins with all tips at rest on the plate
            steps.append(move("lift", Position(x_mm, y_mm, LIFTED_MM), RETRACT_SPEED_MM_S))
            if (x_mm, y_mm) != (0.0, 0.0):
                steps.append(move("return", Position(0.0, 0.0, LIFTED_MM), RETRACT_SPEED_MM_S))
            steps += [move("press", middle, PRESS_MM_S), settle]
            steps.append(move(RUB, end, self.speed_mm_s))
            x_mm, y_mm = end.x_mm, end.y_mm
        steps.append(Move("release", home, min(RETRACT_SPEED_MM_S, most_mm_s)))
        return Program(home, tuple(steps))

    def _ends(self) -> list[Position]:
        return [
            Position(
                self.rub_mm * math.cos(math.radians(angle)),
                self.rub_mm * math.sin(math.radians(angle)),
                self.depth_mm,
            )
            for angle in DIRECTIONS_DEG
        ]


def calibrate_detector(session: CalibrationSession, motion: SkinMotion) -> DetectorCalibration:
    """Make the motion, and find places, rates and level of the skin.

    Raises:
        StopRequested: the user requested a stop; the arm is at rest.
        RigError: a device failed, or the events do not show the skin.
    """
    rig, file = session.rig, session.file
    width, height = rig.events.width, rig.events.height
    measured = SkinMeasurement(width, height, sum(file.skin.ring_counts))
    program = motion.program(rig.at_most(math.inf))
    with console.bar(f"{session.simulated}steps", len(program.steps)) as bar:

        def on_step(step: Step) -> None:
            measured.step(step.phase)
            bar.advance(1, step.phase)

        try:
            rig.run_trial(program, measured, SEED, None, SYNC_HZ, on_step=on_step)
            found = measured.result(DIRECTIONS_DEG)
        except (SkinError, ClockFellBack) as error:
            raise RigError("event camera", f"{error}; nothing was written") from None
    return DetectorCalibration(
        format=DetectorCalibration.FORMAT,
        detector=NAME,
        version=VERSION,
        rig=file.name,
        skin=file.skin.serial,
        camera=rig.event_serial,
        simulated=file.simulated,
        measured=session.today.isoformat(),
        width_px=width,
        height_px=height,
        cell_px=found.cell_px,
        noise_hz=found.noise_hz,
        hot=found.settings.hot,
        fewest_places=found.settings.fewest_places,
        places=found.places,
        level=found.level,
        hold=found.hold,
        hold_largest=found.hold_largest,
        unload_largest=found.unload_largest,
        depth_mm=motion.depth_mm,
        speed_mm_s=motion.speed_mm_s,
        rubs=found.rubs,
    )


def shown(found: DetectorCalibration) -> dict[str, object]:
    """Format a calibration in a few lines."""
    late = [rub.alarm_ms for rub in found.rubs if rub.alarm_ms is not None]
    seconds = 3600 * found.hold.hours
    return {
        "skin": found.skin,
        "places": f"{len(found.places)}, at least {found.fewest_places} must move at once",
        "noise": f"{found.noise_hz:.3g} events/s a cell, {len(found.hot)} hot cells left out",
        "level": f"{found.level:.3g} (hold {found.hold_largest:.3g}, unload "
        f"{found.unload_largest:.3g})",
        "rubs with an alarm": f"{len(late)} of {len(found.rubs)}"
        + (f", {min(late):.0f} to {max(late):.0f} ms after the rub began" if late else ""),
        "promise": f"at most {found.hold.high:.3g} false alarms an hour of holding: {seconds:.3g} "
        f"s without one show no less; 1 an hour takes {needed_hours(1.0):.3g} h (--hold)",
    }


def document_target(file: RigFile, out: Path | None) -> Path:
    """Return the file to write: `out`, or one of the rig's name in the current folder.

    Raises:
        InputError: it is no JSON file, or its folder does not exist.
    """
    from sliplab.storage.trials.catalogue import refuse_store_file

    target = out or Path(f"{file.name}.detector{SUFFIX}")
    if target.suffix.lower() != SUFFIX:
        raise InputError("--out", "", str(target), f"must end in {SUFFIX}")
    if not target.parent.is_dir():
        raise InputError("--out", "", str(target), "its folder does not exist")
    refuse_store_file(target, "--out")
    return target.resolve()
