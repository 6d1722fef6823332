"""`sliplab rigs`: the rig files there are, what they name, and whether it can be reached."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from sliplab.flows.running import console
from sliplab.protocols.errors import InputError
from sliplab.rigs.capabilities import RigError
from sliplab.rigs.reach import reach
from sliplab.rigs.rig_file import RigFile, load_rig_file
from sliplab.rigs.rig_inheritance import shipped_rigs
from sliplab.rigs.rig_lock import held
from sliplab.storage.secrets import masked
from sliplab.storage.trials.lock import Locked


def rigs(
    files: Annotated[
        list[Path] | None,
        typer.Argument(help="Rig files (YAML); those that ship are listed without."),
    ] = None,
    ask: Annotated[
        bool, typer.Option("--ask", help="See whether each device answers; nothing moves.")
    ] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="One JSON object on standard output.")
    ] = False,
) -> None:
    """List rig files: what each names, and with --ask whether it answers."""
    found = [_about(path, ask) for path in (files or shipped_rigs().values())]
    if as_json:
        console.print_json({"rigs": found})
    else:
        rows = [[str(item[name]) for name in COLUMNS] for item in found]
        console.print_table("rigs", [*COLUMNS.values()], rows)
    if any(item["wrong"] for item in found):
        raise typer.Exit(console.FAILED)


COLUMNS = {"name": "name", "driver": "driver", "arm": "arm", "cameras": "cameras", "answer": "says"}


def _about(path: Path, ask: bool) -> dict[str, Any]:
    """One rig file in words."""
    try:
        file, _ = load_rig_file(path)
    except InputError as error:
        text = masked(str(error))
        known = dict.fromkeys(COLUMNS, "")
        return {**known, "name": path.name, "answer": text, "wrong": True, "file": str(path)}
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
    """By device whether it answers; a rig that somebody uses is not disturbed."""
    assert file.devices is not None
    try:
        with held(file):
            return reach(file.devices)
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
    arm = file.devices.arm
    kind = {"ur": "Universal Robots", "abb": "ABB, motion programs", "abb_socket": "ABB, RAPID"}
    return f"{kind[arm.driver]}, {'stand-in' if file.simulated else arm.host}"


def _cameras(file: RigFile) -> str:
    if file.devices is None:
        return f"simulated, {file.frame_source}"
    suffix = " (stand-ins)" if file.simulated else ""
    return f"DVXplorer, Basler{suffix}"
