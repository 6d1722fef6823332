"""`sliplab rigs`, `teach`, `calibrate`: rig files, their devices and their calibration."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NotRequired, TypedDict

import typer
from pydantic import Field

from sliplab.flows.cli.common import RIG, JsonOption, RigOption
from sliplab.flows.cli.model_options import model_options
from sliplab.flows.running import console, exit_codes
from sliplab.protocols.errors import InputError
from sliplab.protocols.yaml_file import StrictModel

if TYPE_CHECKING:
    from sliplab.flows.calibrating.measurement import CalibrationSession, MeasurementResult
    from sliplab.rigs.rig_file import RigFile

app = typer.Typer()
_SETTINGS: dict[str, Any] = {
    "no_args_is_help": True,
    "context_settings": {"help_option_names": ["-h", "--help"]},
}
teach_app = typer.Typer(help="Teach plane, depth zero and tool of a rig.", **_SETTINGS)
calibrate_app = typer.Typer(help="Calibrate cameras, or a simulated scene.", **_SETTINGS)
app.add_typer(teach_app, name="teach", rich_help_panel=RIG)
app.add_typer(calibrate_app, name="calibrate", rich_help_panel=RIG)

OutOption = Annotated[
    Path | None,
    typer.Option("--out", help="Write to this new file; default: the rig file itself."),
]
YesOption = Annotated[bool, typer.Option("--yes", help="Do not ask before the arm moves.")]
DryOption = Annotated[
    bool, typer.Option("--dry-run", help="Print the planned motions without moving anything.")
]


class CreepOptions(StrictModel):
    """The search for a touch."""

    speed_mm_s: float = Field(
        default=0.5, ge=0.01, le=1.0, description="Approach speed near contact, mm/s."
    )
    search_mm: float = Field(
        default=2.0,
        ge=0.1,
        le=50,
        description="Hard limit of travel beyond the assumed plane, mm.",
    )
    clearance_mm: float = Field(
        default=3.0,
        ge=0.5,
        le=50,
        description="Distance before the plane at which the slow approach begins, mm.",
    )


class BoardOptions(StrictModel):
    """A ChArUco board."""

    square_mm: float = Field(
        default=6.0, ge=0.5, le=50, description="Measured side of a printed square, mm."
    )
    columns: int = Field(default=11, ge=0, le=1000, description="Board squares across.")
    rows: int = Field(default=7, ge=0, le=1000, description="Board squares down.")


COLUMNS = {"name": "name", "driver": "driver", "arm": "arm", "cameras": "cameras", "answer": "says"}


@app.command(rich_help_panel=RIG, epilog="Example: sliplab rigs my-rig.yaml --ask")
def rigs(
    files: Annotated[
        list[Path] | None,
        typer.Argument(help="Rig files (YAML); default: the built-in ones."),
    ] = None,
    ask: Annotated[
        bool, typer.Option("--ask", help="Check whether each device responds; nothing moves.")
    ] = False,
    drivers: Annotated[
        bool, typer.Option("--drivers", help="List the installed drivers of devices instead.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """List rig files and their devices; with --ask check whether each device responds."""
    from sliplab.rigs.rig_inheritance import shipped_rigs

    if drivers:
        _list_drivers(as_json)
        return
    found = [_about(path, ask) for path in (files or shipped_rigs().values())]
    if as_json:
        console.print_json({"rigs": found})
    else:
        rows = [[str(cell) for name, cell in item.items() if name in COLUMNS] for item in found]
        console.print_table("rigs", [*COLUMNS.values()], rows)
    if files and not all(item["driver"] for item in found):
        raise typer.Exit(exit_codes.WRONG_INPUT)
    if any(item["wrong"] for item in found):
        raise typer.Exit(exit_codes.FAILED)


DRIVER_COLUMNS = {"name": "driver", "kind": "kind", "title": "device", "package": "package"}


def _list_drivers(as_json: bool) -> None:
    """Print every installed driver, and in a line each what is wrong with one."""
    from sliplab.rigs.core.registry import DriverError, listed, load_driver, taken

    found, wrong = [], taken()
    for item in sorted(listed().values(), key=lambda item: item.name):
        try:
            driver = load_driver(item)
        except DriverError as error:
            wrong.append(str(error))
            continue
        found.append(
            {
                "name": item.name,
                "kind": driver.kind,
                "title": driver.title,
                "package": item.package,
                "simulated_on_loopback": getattr(driver, "fake", None) is not None
                or getattr(driver, "reach", None) is not None,
            }
        )
    if as_json:
        console.print_json({"drivers": found, "wrong": wrong})
    else:
        rows = [[str(item[name]) for name in DRIVER_COLUMNS] for item in found]
        console.print_table("drivers", [*DRIVER_COLUMNS.values()], rows)
        for line in wrong:
            console.say(line)
    if wrong:
        raise typer.Exit(exit_codes.FAILED)


class RigRow(TypedDict):
    """A rig file as `sliplab rigs --json` lists it.

    Attributes:
        answer: whether the devices respond, in words, or why the file cannot be read.
        silent: by device, why it does not respond.
    """

    name: str
    driver: str
    arm: str
    cameras: str
    answer: str
    wrong: bool
    simulated: NotRequired[bool]
    silent: NotRequired[dict[str, str]]
    file: str


def _about(path: Path, ask: bool) -> RigRow:
    """Describe one rig file."""
    from sliplab.rigs.rig_file import load_rig_file
    from sliplab.storage.errors import masked

    try:
        file, _ = load_rig_file(path)
    except InputError as error:
        text = masked(str(error))
        return {
            "name": path.name,
            "driver": "",
            "arm": "",
            "cameras": "",
            "answer": text,
            "wrong": True,
            "file": str(path),
        }
    answers = _ask(file) if ask and file.driver == "devices" else {}
    silent = {name: masked(why) for name, why in answers.items() if why is not None}
    return {
        "name": file.name,
        "driver": file.driver,
        "arm": _arm(file),
        "cameras": _cameras(file),
        "answer": _answer(file, ask, silent),
        "wrong": bool(silent),
        "simulated": file.simulated,
        "silent": silent,
        "file": str(path),
    }


def _ask(file: RigFile) -> dict[str, str | None]:
    """Return for each device why it does not respond, None if it does; skip a rig in use."""
    from sliplab.rigs.core.capabilities import RigError
    from sliplab.rigs.discovery import ping_devices
    from sliplab.rigs.rig_lock import held
    from sliplab.storage.trials.lock import Locked

    assert file.devices is not None
    try:
        with held(file):
            return ping_devices(file.devices, file.streams)
    except (Locked, RigError) as error:
        return {"rig": str(error)}


def _answer(file: RigFile, ask: bool, silent: dict[str, str]) -> str:
    if file.simulated:
        return "simulated: always there"
    if not ask:
        return "not asked (--ask)"
    return "; ".join(f"{name}: {why}" for name, why in silent.items()) or "every device answers"


def _arm(file: RigFile) -> str:
    if file.devices is None:
        return "simulated"
    driver, arm = file.devices.arm_driver, file.devices.arm
    return f"{driver.title}, {'fake' if file.simulated else driver.address(arm)}"


def _cameras(file: RigFile) -> str:
    if file.devices is None:
        words = {"events": "events", "frames": file.frame_source}
        return ", ".join(["simulated", *(words[name] for name in file.cameras), *file.streams])
    suffix = " (fakes)" if file.simulated else ""
    cameras = [driver.title for driver, _ in file.devices.drivers() if "camera" in driver.kind]
    return f"{', '.join([*cameras, *file.streams])}{suffix}"


class By(StrEnum):
    """Ways to detect a touch."""

    EVENTS = "events"
    HAND = "hand"


class ZeroBy(StrEnum):
    """Methods to find depth zero."""

    BOTH = "both"
    EVENTS = "events"


@teach_app.command("plane", epilog="Example: sliplab teach plane --rig my-rig.yaml")
@model_options
def teach_plane(
    rig: RigOption,
    by: Annotated[
        By, typer.Option("--by", help="Touch off by event rate, or jog by hand.")
    ] = By.EVENTS,
    span: Annotated[
        float,
        typer.Option(
            "--span", min=0, max=1000, help="Distance of the other points from the centre, mm."
        ),
    ] = 12.0,
    repeats: Annotated[
        int, typer.Option("--repeats", min=1, max=20, help="Touches per point.")
    ] = 2,
    options: CreepOptions = CreepOptions(),
    out: OutOption = None,
    yes: YesOption = False,
    dry_run: DryOption = False,
    as_json: JsonOption = False,
) -> None:
    """Find the contact plane from three touches, and check it with a fourth."""
    from sliplab.flows.calibrating import teach as steps
    from sliplab.flows.calibrating.measurement import Measurement
    from sliplab.rigs.core.teaching import Creep

    command = Measurement(rig, out, "plane", as_json)
    if by is By.HAND:
        command.run([], yes, dry_run, steps.teach_plane_by_hand, "a person jogs the arm")
        return
    creep = Creep(**options.model_dump())
    steps.check_touches(command.file, "plane", span, creep)
    places = list(steps.plane_places(span).items())
    moves = steps.planned_touches(places, creep)
    command.run(
        moves, yes, dry_run, lambda session: steps.teach_plane(session, span, creep, repeats)
    )


@teach_app.command("zero", epilog="Example: sliplab teach zero --rig my-rig.yaml")
@model_options
def teach_zero(
    rig: RigOption,
    by: Annotated[ZeroBy, typer.Option("--by", help="Events and markers, or events alone.")] = (
        ZeroBy.BOTH
    ),
    repeats: Annotated[
        int, typer.Option("--repeats", min=1, max=50, help="Number of touches.")
    ] = 3,
    options: CreepOptions = CreepOptions(),
    out: OutOption = None,
    yes: YesOption = False,
    dry_run: DryOption = False,
    as_json: JsonOption = False,
) -> None:
    """Find depth zero from touches at the centre, observed by both cameras."""
    from sliplab.flows.calibrating import teach as steps
    from sliplab.flows.calibrating.measurement import Measurement
    from sliplab.rigs.core.teaching import Creep

    command = Measurement(rig, out, "zero", as_json)
    creep = Creep(**options.model_dump())
    steps.check_touches(command.file, "zero", 0.0, creep)
    both = by is ZeroBy.BOTH
    moves = steps.planned_zero(creep, both)
    command.run(
        moves, yes, dry_run, lambda session: steps.teach_zero(session, creep, repeats, both)
    )


@teach_app.command("tool", epilog="Example: sliplab teach tool --rig my-rig.yaml")
def teach_tool(
    rig: RigOption,
    poses: Annotated[int, typer.Option("--poses", min=4, max=50, help="Number of poses.")] = 8,
    tool: Annotated[
        str | None,
        typer.Option(
            "--tool",
            help="Current tool of the controller, x,y,z in mm and rotation vector in "
            "degrees, from the flange; the rig file's if left out.",
        ),
    ] = None,
    out: OutOption = None,
    yes: YesOption = False,
    dry_run: DryOption = False,
    as_json: JsonOption = False,
) -> None:
    """Find the tool centre point by jogging the tip onto one point at different tilts."""
    from sliplab.flows.calibrating import teach as steps
    from sliplab.flows.calibrating.measurement import Measurement
    from sliplab.rigs.build import tool_of

    command = Measurement(rig, out, "tool", as_json)
    set_now = None if tool is None else _tool(tool)
    command.run(
        [],
        yes,
        dry_run,
        lambda session: steps.teach_tool(session, poses, set_now or tool_of(session.file)),
        "a person jogs the arm",
    )


@calibrate_app.command("lens", epilog="Example: sliplab calibrate lens --rig my-rig.yaml")
@model_options
def calibrate_lens(
    rig: RigOption,
    views: Annotated[int, typer.Option("--views", min=4, max=60, help="Images to take.")] = 8,
    images: Annotated[
        Path | None,
        typer.Option(
            "--images", help="Use the images of this folder; the first shows the board flat."
        ),
    ] = None,
    options: BoardOptions = BoardOptions(),
    out: OutOption = None,
    dry_run: DryOption = False,
    as_json: JsonOption = False,
) -> None:
    """Calibrate lens and scale of the outside camera with a ChArUco board. Nothing moves."""
    from sliplab.flows.calibrating import calibrate as steps
    from sliplab.flows.calibrating.measurement import Measurement

    board = _board(options)
    command = Measurement(rig, out, "lens", as_json)

    def measure(session: CalibrationSession) -> MeasurementResult:
        if images is not None:
            pictures = steps.read_pictures(images)
        else:
            pictures = steps.see_boards(session, views)
        return steps.calibrate_lens(pictures, board, session.today)

    command.run([], True, dry_run, measure, "nothing moves", with_arm=False)


@calibrate_app.command("crop", epilog="Example: sliplab calibrate crop --rig my-rig.yaml")
def calibrate_crop(
    rig: RigOption,
    depth: Annotated[
        float, typer.Option("--depth", min=0.2, max=20, help="Press depth, mm.")
    ] = 2.4,
    radius: Annotated[
        float, typer.Option("--radius", min=0.1, max=3, help="Radius of the circle, mm.")
    ] = 1.0,
    out: OutOption = None,
    yes: YesOption = False,
    dry_run: DryOption = False,
    as_json: JsonOption = False,
) -> None:
    """Locate the skin in the event camera's image by pressing and moving in a circle."""
    from sliplab.flows.calibrating import calibrate as steps
    from sliplab.flows.calibrating.measurement import Measurement, PlannedMove

    command = Measurement(rig, out, "crop", as_json)
    limit = float(command.file.limits.depth)
    if depth > limit:
        text = f"is deeper than the rig may go: limits.depth = {limit:g} mm"
        raise InputError("--depth", "", f"{depth:g} mm", text)
    moves = [
        PlannedMove("press", 0.0, 0.0, -5.0, depth, 2.0),
        PlannedMove(f"circle of {radius:g} mm", 0.0, 0.0, depth, depth, steps.CIRCLE_MM_S),
    ]
    command.run(moves, yes, dry_run, lambda session: steps.calibrate_crop(session, depth, radius))


@calibrate_app.command("detector", epilog="Example: sliplab calibrate detector --rig my-rig.yaml")
def calibrate_detector(
    rig: RigOption,
    depth: Annotated[
        float, typer.Option("--depth", min=0.2, max=20, help="Press depth, mm.")
    ] = 2.4,
    hold: Annotated[
        float,
        typer.Option(
            "--hold", min=5, max=36_000, help="Time pressed and still, s: more promises more."
        ),
    ] = 30.0,
    rub: Annotated[
        float, typer.Option("--rub", min=0.5, max=20, help="Length of a rub, mm.")
    ] = 3.0,
    speed: Annotated[
        float, typer.Option("--speed", min=0.1, max=20, help="Speed of the rubs, mm/s.")
    ] = 1.0,
    out: Annotated[
        Path | None,
        typer.Option("--out", help="File to write (.json); default: RIG.detector.json."),
    ] = None,
    yes: YesOption = False,
    dry_run: DryOption = False,
    as_json: JsonOption = False,
) -> None:
    """Set up the detector by papillae for a skin: a hold, an unload and three short rubs."""
    from sliplab.flows.calibrating import detector as steps
    from sliplab.flows.calibrating.measurement import Measurement

    command = Measurement(rig, None, "detector", as_json, poll_s=steps.POLL_S)
    motion = steps.SkinMotion(depth, hold, rub, speed)
    motion.check(command.file)
    target = steps.document_target(command.file, out)
    done = command.write_document(
        target,
        motion.moves,
        yes,
        dry_run,
        lambda session: steps.calibrate_detector(session, motion),
    )
    if done is None:
        return
    made, retained = done
    if as_json:
        kept = retained and str(retained)
        console.print_json({**made.to_json(), "written": str(target), "kept": kept})
        return
    simulated = " (simulated)" if made.simulated else ""
    console.print_pairs(f"detector of rig {made.rig}{simulated}", steps.shown(made))
    console.say(f"written to {target}; use it as `sliplab detect --model {target.name}`")
    if retained is not None:
        console.say(f"the old file is kept as {retained}")


@calibrate_app.command("board", epilog="Example: sliplab calibrate board --out board.pdf")
@model_options
def calibrate_board(
    out: Annotated[Path, typer.Option("--out", help="Output file, .pdf or .png.")] = Path(
        "sliplab-board.pdf"
    ),
    options: BoardOptions = BoardOptions(),
    as_json: JsonOption = False,
) -> None:
    """Write the calibration board to print, with a ruler to check its size."""
    from sliplab.flows.calibrating.calibrate import print_board

    board = _board(options)
    sizes = print_board(board, out)
    if as_json:
        console.print_json({"board": str(out), **sizes})
        return
    console.print_pairs(f"board {out}", sizes)
    console.say("print at 100 %, measure the ruler, and fix the sheet to something flat")


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


def _board(options: BoardOptions) -> Any:
    from sliplab.analysis.calibration.charuco import Board, BoardError

    columns, rows, square_mm = options.columns, options.rows, options.square_mm
    try:
        return Board(columns, rows, square_mm, 0.75 * square_mm)
    except BoardError as error:
        raise InputError("--columns", "", f"{columns} x {rows}", str(error)) from None
