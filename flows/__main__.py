"""The program's entry: runs the command line, maps faults to messages and exit codes."""

from __future__ import annotations

import os
import sys
import traceback
from pathlib import Path

import typer
from typer.exceptions import TyperException

from flows.running import console, garbage, stopping
from protocols.errors import InputError
from storage.errors import StoreError, disk_error


def main() -> None:
    """Run the command line; ends the process with its exit code."""
    garbage.seldom()
    with stopping.signals():
        code = _run()
    sys.exit(code)


def _run() -> int:
    try:
        from flows.cli.app import app

        code = app(standalone_mode=False)
        if code == console.INTERRUPTED:
            return _interrupted()
        return code if isinstance(code, int) else console.DONE
    except InputError as error:
        console.say(f"error: {error.message}")
        return console.WRONG_INPUT
    except KeyboardInterrupt:
        return _interrupted()
    except Exception as error:
        return _interrupted() if stopping.requested() else _explain(error)


def _interrupted() -> int:
    console.say("interrupted: every committed trial is kept; run the same command to go on")
    return console.INTERRUPTED


def _explain(error: Exception) -> int:
    """Print what went wrong; a fault of the program itself shows where."""
    if isinstance(error, typer.Exit):
        return int(error.exit_code)
    if isinstance(error, typer.Abort):
        return _interrupted()
    if isinstance(error, TyperException):
        if message := error.format_message():  # without a command its help has been printed
            console.say(f"error: {message} (see --help)")
        return console.WRONG_INPUT
    if (
        isinstance(error, OSError)
        and error.filename
        and (said := disk_error(Path(os.fsdecode(error.filename)), error))
    ):
        console.say(f"error: {said}")
        return console.FAILED
    expected = {"RigError", "ArmFault", "Locked", "CampaignStopped", "ClusterError", "ServerError"}
    if type(error).__name__ not in expected and not isinstance(error, StoreError):
        console.say("".join(traceback.format_exception(error, limit=-8)))
    console.say(f"error: {error or type(error).__name__}")
    return console.FAILED


if __name__ == "__main__":
    main()
