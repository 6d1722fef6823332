"""`sliplab teach WHAT` and `sliplab calibrate WHAT`: what is measured goes into the rig file."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sliplab.flows.running import console
from sliplab.protocols.errors import InputError

if TYPE_CHECKING:
    from sliplab.flows.calibrating.measuring import CalibrationSession, Finding
    from sliplab.rigs.core.teaching import Creep

_SETTINGS = {"no_args_is_help": True, "context_settings": {"help_option_names": ["-h", "--help"]}}
teach_app = typer.Typer(help="Teach a rig where its plate and its tip are.", **_SETTINGS)  # type: ignore[arg-type]
calibrate_app = typer.Typer(help="Calibrate a rig's cameras.", **_SETTINGS)  # type: ignore[arg-type]

RigOption = Annotated[
    Path, typer.Option("--rig", help="A rig file (YAML), or the name of one that ships: mock.")
]
OutOption = Annotated[
    Path | None,
    typer.Option("--out", help="Write to this new file; by default to the rig file itself."),
]
YesOption = Annotated[bool, typer.Option("--yes", help="Do not ask before the arm moves.")]
DryOption = Annotated[
    bool, typer.Option("--dry-run", help="Say what would move where, and move nothing.")
]
JsonOption = Annotated[
    bool, typer.Option("--json", help="One JSON object on standard output, the rest on error.")
]
SpeedOption = Annotated[
    float, typer.Option("--speed", min=0.01, max=1.0, help="Creeping speed, mm/s.")
]
SearchOption = Annotated[
    float,
    typer.Option("--search", min=0.1, max=50, help="Hard limit beyond the assumed plane, mm."),
]
ClearanceOption = Annotated[
    float, typer.Option("--clearance", min=0.5, max=50, help="Where creeping begins, mm before it.")
]
SquareOption = Annotated[
    float, typer.Option("--square", min=0.5, max=50, help="Side of a printed square, mm: measure.")
]
ColumnsOption = Annotated[int, typer.Option("--columns", min=0, max=1000, help="Squares across.")]
RowsOption = Annotated[int, typer.Option("--rows", min=0, max=1000, help="Squares down.")]


class By(StrEnum):
    """How a touch is noticed."""

    EVENTS = "events"
    HAND = "hand"


class ZeroBy(StrEnum):
    """What depth zero is found by."""

    BOTH = "both"
    EVENTS = "events"


@teach_app.command("plane")
def teach_plane(
    rig: RigOption,
    by: Annotated[By, typer.Option("--by", help="Touch off, or jog by hand.")] = By.EVENTS,
    span: Annotated[
        float,
        typer.Option("--span", min=0, max=1000, help="From the centre to each other point, mm."),
    ] = 12.0,
    repeats: Annotated[int, typer.Option("--repeats", min=1, max=20, help="Touches a point.")] = 2,
    speed: SpeedOption = 0.5,
    search: SearchOption = 2.0,
    clearance: ClearanceOption = 3.0,
    out: OutOption = None,
    yes: YesOption = False,
    dry_run: DryOption = False,
    as_json: JsonOption = False,
) -> None:
    """The contact plane: touches at the centre, to the right, above, and one that checks them."""
    from sliplab.flows.calibrating import teach as steps
    from sliplab.flows.calibrating.measuring import Measurement

    command = Measurement(rig, out, "plane", as_json)
    if by is By.HAND:
        command.run([], yes, dry_run, steps.teach_plane_by_hand, "a person jogs the arm")
        return
    creep = _creep(speed, search, clearance)
    steps.check_touches(command.file, "plane", span, creep)
    places = list(steps.plane_places(span).items())
    moves = steps.planned_touches(places, creep)
    command.run(
        moves, yes, dry_run, lambda session: steps.teach_plane(session, span, creep, repeats)
    )


@teach_app.command("zero")
def teach_zero(
    rig: RigOption,
    by: Annotated[ZeroBy, typer.Option("--by", help="Events and markers, or events alone.")] = (
        ZeroBy.BOTH
    ),
    repeats: Annotated[int, typer.Option("--repeats", min=1, max=50, help="Touches.")] = 3,
    speed: SpeedOption = 0.5,
    search: SearchOption = 2.0,
    clearance: ClearanceOption = 3.0,
    out: OutOption = None,
    yes: YesOption = False,
    dry_run: DryOption = False,
    as_json: JsonOption = False,
) -> None:
    """Depth zero: touches at the centre, seen by both cameras."""
    from sliplab.flows.calibrating import teach as steps
    from sliplab.flows.calibrating.measuring import Measurement

    command = Measurement(rig, out, "zero", as_json)
    creep = _creep(speed, search, clearance)
    steps.check_touches(command.file, "zero", 0.0, creep)
    both = by is ZeroBy.BOTH
    moves = steps.planned_zero(creep, both)
    command.run(
        moves, yes, dry_run, lambda session: steps.teach_zero(session, creep, repeats, both)
    )


@teach_app.command("tool")
def teach_tool(
    rig: RigOption,
    poses: Annotated[int, typer.Option("--poses", min=4, max=50, help="How many.")] = 8,
    tool: Annotated[
        str | None,
        typer.Option(
            "--tool", help="Tool that the controller has now, x,y,z in mm and rotation vector in "
            "degrees, from the flange; the rig file's if left out."
        ),
    ] = None,
    out: OutOption = None,
    yes: YesOption = False,
    dry_run: DryOption = False,
    as_json: JsonOption = False,
) -> None:  # fmt: skip
    """The tool centre point: a person brings the tip onto one point, leaning in many ways."""
    from sliplab.flows.calibrating import teach as steps
    from sliplab.flows.calibrating.measuring import Measurement
    from sliplab.rigs.build import tool_of

    command = Measurement(rig, out, "tool", as_json)
    set_now = None if tool is None else _tool(tool)
    command.run(
        [], yes, dry_run,
        lambda session: steps.teach_tool(session, poses, set_now or tool_of(session.file)),
        "a person jogs the arm",
    )  # fmt: skip


@calibrate_app.command("lens")
def calibrate_lens(
    rig: RigOption,
    views: Annotated[int, typer.Option("--views", min=4, max=60, help="Pictures to take.")] = 8,
    images: Annotated[
        Path | None,
        typer.Option("--images", help="A folder of pictures instead; the first one is flat."),
    ] = None,
    square: SquareOption = 6.0,
    columns: ColumnsOption = 11,
    rows: RowsOption = 7,
    out: OutOption = None,
    dry_run: DryOption = False,
    as_json: JsonOption = False,
) -> None:
    """Lens and scale of the outside camera, from a printed ChArUco board. Nothing moves."""
    from sliplab.flows.calibrating import calibrate as steps
    from sliplab.flows.calibrating.measuring import Measurement

    board = _board(columns, rows, square)
    command = Measurement(rig, out, "lens", as_json)

    def measure(session: CalibrationSession) -> Finding:
        if images is not None:
            pictures = steps.read_pictures(images)
        else:
            pictures = steps.see_boards(session, views)
        return steps.calibrate_lens(pictures, board, session.today)

    command.run([], True, dry_run, measure, "nothing moves", with_arm=False)


@calibrate_app.command("crop")
def calibrate_crop(
    rig: RigOption,
    depth: Annotated[float, typer.Option("--depth", min=0.2, max=20, help="How deep, mm.")] = 2.4,
    radius: Annotated[
        float, typer.Option("--radius", min=0.1, max=3, help="Of the circle, mm.")
    ] = 1.0,
    out: OutOption = None,
    yes: YesOption = False,
    dry_run: DryOption = False,
    as_json: JsonOption = False,
) -> None:
    """Where the skin is in the event camera's picture: press, and move in a circle."""
    from sliplab.flows.calibrating import calibrate as steps
    from sliplab.flows.calibrating.measuring import Measurement, Planned

    command = Measurement(rig, out, "crop", as_json)
    limit = float(command.file.limits.depth)
    if depth > limit:
        text = f"is deeper than the rig may go: limits.depth = {limit:g} mm"
        raise InputError("--depth", "", f"{depth:g} mm", text)
    moves = [
        Planned("press", 0.0, 0.0, -5.0, depth, 2.0),
        Planned(f"circle of {radius:g} mm", 0.0, 0.0, depth, depth, steps.STIR_MM_S),
    ]
    command.run(moves, yes, dry_run, lambda session: steps.calibrate_crop(session, depth, radius))


@calibrate_app.command("board")
def calibrate_board(
    out: Annotated[Path, typer.Option("--out", help="A .pdf or .png file.")] = Path(
        "sliplab-board.pdf"
    ),
    square: SquareOption = 6.0,
    columns: ColumnsOption = 11,
    rows: RowsOption = 7,
    as_json: JsonOption = False,
) -> None:
    """Make the board to print, with its true size on it."""
    from sliplab.flows.calibrating.board_print import print_board

    board = _board(columns, rows, square)
    sizes = print_board(board, out)
    if as_json:
        console.print_json({"board": str(out), **sizes})
        return
    console.print_pairs(f"board {out}", sizes)
    console.say("print at 100 %, measure the ruler, and fix the sheet to something flat")


def _creep(speed: float, search: float, clearance: float) -> Creep:
    from sliplab.rigs.core.teaching import Creep

    return Creep(speed, search, clearance)


def _tool(text: str) -> Any:
    from sliplab.rigs.core.capabilities import Pose

    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in {3, 6} or not all(abs(number) < 1e4 for number in numbers):
        raise InputError("--tool", "", text, "must be x,y,z or x,y,z,rx,ry,rz (mm, degrees)")
    x, y, z, a, b, c = (*numbers, 0.0, 0.0, 0.0)[:6]
    return Pose((x, y, z), (a, b, c))


def _board(columns: int, rows: int, square: float) -> Any:
    from sliplab.analysis.calibration.charuco import Board, BoardError

    try:
        return Board(columns, rows, square, 0.75 * square)
    except BoardError as error:
        raise InputError("--columns", "", f"{columns} x {rows}", str(error)) from None
