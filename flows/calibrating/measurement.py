"""One measurement of a rig: announce the motion, ask, measure, write the rig file, report."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import date
from pathlib import Path
from typing import TypeVar

import typer

from sliplab.flows.running import console, stopping
from sliplab.protocols.errors import InputError
from sliplab.protocols.program import Position
from sliplab.rigs import build
from sliplab.rigs.core.plate_frame import PlateFrame
from sliplab.rigs.core.rig import RETRACT_SPEED_MM_S, Rig, StopRequested
from sliplab.rigs.core.teaching import APPROACH_MM_S
from sliplab.rigs.rig_edit import keep_old, writable_target, write_entries
from sliplab.rigs.rig_file import RigFile, load_rig_file
from sliplab.rigs.rig_inheritance import rig_path
from sliplab.rigs.rig_lock import held
from sliplab.storage.files import write_json
from sliplab.storage.schema.document import Document

T = TypeVar("T")
D = TypeVar("D", bound=Document)
ANNOUNCEMENT = (
    f"the arm goes out along the plate's normal and across at {RETRACT_SPEED_MM_S:g} mm/s, in at "
    f"{APPROACH_MM_S:g} mm/s, and then as listed"
)


@dataclass(frozen=True)
class MeasurementResult:
    """The result of a measurement: keys of the rig file to set and to remove, and figures."""

    changes: Mapping[str, object]
    figures: Mapping[str, object]
    remove: tuple[str, ...] = ()


@dataclass(frozen=True)
class PlannedMove:
    """A motion that a command will make, in plate coordinates of the rig's present plane."""

    what: str
    x_mm: float
    y_mm: float
    from_mm: float
    to_mm: float
    speed_mm_s: float


@dataclass(frozen=True)
class AnnouncedMove(PlannedMove):
    """A planned motion with its deepest point in the arm's base frame, mm."""

    base_mm: list[float]


@dataclass
class CalibrationSession:
    """The connected rig of a measurement.

    Attributes:
        today: the date of new entries.
    """

    file: RigFile
    rig: Rig
    today: date = field(default_factory=date.today)

    @property
    def simulated(self) -> str:
        """``simulated `` before a number of a simulated rig."""
        return "simulated " if self.file.simulated else ""


def mm(value: float) -> str:
    """Format a length as rig files have it."""
    return f"{value:.4f} mm"


def px(value: float) -> str:
    """Format a length in an image as rig files have it."""
    return f"{value:.3f} px"


class Measurement:
    """One measurement for one rig file, from the announcement to the written entry.

    Args:
        out: the file to write; None for the rig file itself.
        what: name of the measurement: ``plane``, ``zero``, ``tool``, ``lens``, ``crop`` or
            ``detector``.

        poll_s: longest period of reading the streams; None: the rig's.

    Raises:
        InputError: the rig file cannot be read, or not be written to.
    """

    def __init__(
        self, rig: Path, out: Path | None, what: str, as_json: bool, poll_s: float | None = None
    ) -> None:
        self.path, self.what, self.as_json = rig_path(rig), what, as_json
        self.file, self.text = load_rig_file(rig)
        if poll_s is not None:
            self.file = self.file.read_at_least(poll_s)
        self._target: Callable[[], Path] = lambda: writable_target(self.path, out)

    def run(
        self,
        moves: Sequence[PlannedMove],
        yes: bool,
        dry_run: bool,
        measure: Callable[[CalibrationSession], MeasurementResult],
        who: str = "",
        *,
        with_arm: bool = True,
    ) -> None:
        """Run the measurement; a dry run only announces the motion.

        Args:
            moves: motions to announce; without any, nothing is asked.
            yes: do not ask before the arm moves.
            who: text in place of the general announcement.
            with_arm: connect the arm.

        Raises:
            InputError: there is no terminal to ask on.
            KeyboardInterrupt: the user requested a stop.
            RigError: the measurement failed; nothing was written.
        """
        if dry_run:
            self._print_moves(moves, who)
            return
        target = self._target()
        finding, today = self.measured(moves, yes, measure, who, with_arm=with_arm)
        written = write_entries(
            self.path,
            target,
            finding.changes,
            today=today,
            remove=finding.remove,
            expected=self.text,
        )
        self._report(finding, written.path, written.retained)

    def write_document(
        self,
        target: Path,
        moves: Sequence[PlannedMove],
        yes: bool,
        dry_run: bool,
        measure: Callable[[CalibrationSession], D],
    ) -> tuple[D, Path | None] | None:
        """Run a measurement whose result is a document beside the rig file, as `run`.

        Returns:
            the document, which was written to `target`, and the copy of the file that was there;
            None in a dry run.
        """
        if dry_run:
            self._print_moves(moves, "")
            return None
        made, today = self.measured(moves, yes, measure)
        retained = keep_old(target, today)
        write_json(target, made.to_json())
        return made, retained

    def measured(
        self,
        moves: Sequence[PlannedMove],
        yes: bool,
        measure: Callable[[CalibrationSession], T],
        who: str = "",
        *,
        with_arm: bool = True,
    ) -> tuple[T, date]:
        """Announce, ask, and measure; return the result and the day. For the rest see `run`."""
        self._announce(moves, who)
        if moves and not yes:
            _confirm()
        today = date.today()
        with held(self.file):
            rig = build.build_rig(self.file, stopping.requested)
            try:
                if with_arm:
                    rig.connect()
                return measure(CalibrationSession(self.file, rig, today)), today
            except StopRequested:
                console.say("stopped: the arm is at rest, nothing was written")
                raise KeyboardInterrupt from None
            finally:
                rig.close()

    def _rows(self, moves: Sequence[PlannedMove]) -> list[AnnouncedMove]:
        plane = self.file.calibration.contact_plane
        frame = PlateFrame.taught((plane.centre, plane.right, plane.above))
        if self.what in ("crop", "detector"):
            frame = frame.with_zero(self.file.calibration.zero_mm)
        rows = []
        for move in moves:
            base = frame.pose(Position(move.x_mm, move.y_mm, move.to_mm)).xyz_mm
            rows.append(AnnouncedMove(**vars(move), base_mm=[round(v, 3) for v in base]))
        return rows

    def _announce(self, moves: Sequence[PlannedMove], who: str) -> None:
        simulated = " (simulated)" if self.file.simulated else ""
        console.say(f"{self.what} of rig {self.file.name}{simulated}: {who or ANNOUNCEMENT}")
        for row in self._rows(moves):
            console.say(
                f"  {row.what}: at ({row.x_mm:.1f}, {row.y_mm:.1f}) mm of the plate, "
                f"depth {row.from_mm:+.2f} to at most {row.to_mm:+.2f} mm at "
                f"{row.speed_mm_s:g} mm/s; the deepest point is {row.base_mm} mm in the "
                "arm's base frame"
            )

    def _print_moves(self, moves: Sequence[PlannedMove], who: str) -> None:
        rows = self._rows(moves)
        if self.as_json:
            console.print_json(
                {
                    "what": self.what,
                    "rig": self.file.name,
                    "simulated": self.file.simulated,
                    "dry_run": True,
                    "how": who or ANNOUNCEMENT,
                    "moves": rows,
                }
            )
            return
        columns = [
            "what",
            "x, mm",
            "y, mm",
            "from depth, mm",
            "to at most, mm",
            "speed, mm/s",
            "deepest in base, mm",
        ]
        table = [[*list(vars(row).values())[:-1], _cell(row.base_mm)] for row in rows]
        title = f"{self.what} of rig {self.file.name}: nothing moved (dry run)"
        console.print_table(title, columns, table)
        console.say(who or ANNOUNCEMENT)

    def _report(self, finding: MeasurementResult, path: Path, stored: Path | None) -> None:
        removed = [key for key in finding.remove if self._had(key)]
        if self.as_json:
            console.print_json(
                {
                    "what": self.what,
                    "rig": self.file.name,
                    "simulated": self.file.simulated,
                    **finding.figures,
                    "written": str(path),
                    "kept": stored and str(stored),
                    "keys": list(finding.changes),
                    "removed": removed,
                }
            )
            return
        simulated = " (simulated)" if self.file.simulated else ""
        shown = {name: _cell(value) for name, value in finding.figures.items()}
        console.print_pairs(f"{self.what} of rig {self.file.name}{simulated}", shown)
        console.say(f"written to {path}: {', '.join(finding.changes)}")
        for key in removed:
            console.say(f"removed {key}: it belonged to the previous calibration")
        if stored is not None:
            console.say(f"the old file is kept as {stored}")

    def _had(self, key: str) -> bool:
        return getattr(self.file.calibration, key.rpartition(".")[2], None) is not None


def _confirm() -> None:
    if not sys.stdin.isatty():
        raise InputError("--yes", "", None, "is required without a terminal")
    typer.confirm(
        "Is the path clear, and a hand on the stop button? Move the arm?", abort=True, err=True
    )


def _cell(value: object) -> object:
    if isinstance(value, list):
        return ", ".join(_number_text(item) for item in value)
    if isinstance(value, dict):
        return "; ".join(f"{key} {_cell(item)}" for key, item in value.items())
    return _number_text(value) if isinstance(value, float) else value


def _number_text(value: object) -> str:
    return (
        f"{value:.6g}"
        if isinstance(value, float) and abs(value) < 100
        else (f"{value:.2f}" if isinstance(value, float) else str(value))
    )
