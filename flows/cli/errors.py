"""Error reporting of a failed command: message, JSON error object and exit code.

Without ``--json`` an error is one message on standard error. With it, one object goes to standard
output as well, unless the command had already printed its result before it failed:
``{"error": {"file", "key", "value", "message", "exit_code"}}``, null where unknown. Where several
faults were found, ``"faults"`` lists each with its file, key, value and message.
"""

from __future__ import annotations

import errno
import os
import re
import sys
import traceback
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import entry_points

import typer
from pydantic import ValidationError
from typer.exceptions import TyperException

from sliplab.flows.running import console, exit_codes, extras
from sliplab.flows.running.process import OutputLost, exhausted
from sliplab.protocols.errors import InputError
from sliplab.protocols.plugin import package_of
from sliplab.storage.errors import DamagedFile, StoreError, disk_fault, masked, named_disk_error

LONGEST_SHOWN = 80
"""Characters of a file name that is too long."""
_NAMES = {
    errno.ENAMETOOLONG: "the file name is too long",
    errno.EISDIR: "is a folder; give a file",
    errno.EEXIST: "exists already as a file; give a folder or another name",
}
"""Errors of the system that are those of a given name."""
_RESUMABLE = "interrupted: every committed trial is kept; run the same command to resume"
_WITH_TRIALS = {
    "collect",
    "sync",
    "label",
    "train",
    "evaluate",
    "generalise",
    "holdout",
    "study",
    "demo",
    "stress",
    "tradeoff",
    "push",
    "pull",
    "import",
    "serve",
    "migrate",
    "reflex",
}
"""Commands that take trials or process them, and resume."""
_ENDLESS = {
    "status": "interrupted: no longer watching",
    "alerts": "interrupted: no longer watching; what waits is sent when alerts run again",
    "page": "interrupted: the page is closed",
    "detect": "interrupted: no longer detecting",
    "record": "interrupted: every committed trial is kept; of an unfinished one, the next "
    "recording or `sliplab verify` keeps what was written",
}
"""What is said at the end of commands that run until they are interrupted."""
_EXPECTED = {
    "RigError",
    "ArmFault",
    "Locked",
    "CampaignStopped",
    "ClusterError",
    "ServerError",
    "OutputLost",
    "WorkerKilled",
    "WorkNotBegun",
    "MainModuleError",
}
"""Errors that need no traceback, by name: their modules are slow to import."""
_PACKAGES = ("sliplab.plugins", "sliplab.drivers", "sliplab.units")
"""Entry points of other packages."""
_OPTION = re.compile(r"--[a-z-]+|COMMAND|DETECTOR|FOLDER|KIND|NAME|PART|STORE|TRIAL|URL|WHAT")
"""Names of options and arguments: an `InputError` about one has it in place of a file."""


@dataclass(frozen=True)
class Failure:
    """The error that ended a command.

    Attributes:
        file: the file, folder or URL that is wrong; None if there is none.
        key: the key inside it, or the option or argument.
        value: the offending value, as written.
        trace: the traceback, if the error is a bug in the program.
        faults: each fault of the input, where there are several.
    """

    message: str
    exit_code: int
    file: str | None = None
    key: str | None = None
    value: str | None = None
    trace: str = ""
    faults: tuple[InputError, ...] = ()

    def report(self) -> int:
        """Print the message, and with ``--json`` the error object; return the exit code."""
        if self.trace:
            console.say(self.trace)
        if self.message:
            console.say(self.message if self.interrupted else f"error: {self.message}")
        named = {"file": self.file, "key": self.key, "value": self.value}
        faults = [
            {"file": f.file, "key": f.key or None, "value": f.value, "message": f.message}
            for f in self.faults
        ]
        with suppress(OutputLost):  # the error is already on standard error
            console.print_error({**named, "message": self.message}, self.exit_code, faults)
        return self.exit_code

    @property
    def interrupted(self) -> bool:
        """True if the user stopped the program and nothing failed."""
        return self.exit_code == exit_codes.INTERRUPTED


def interruption() -> Failure:
    """Return the failure of a program that the user stopped."""
    command = _command().removeprefix("sliplab ")
    text = "interrupted: nothing is left half-written; run the same command again"
    if command in _WITH_TRIALS:
        text = _RESUMABLE
    text = _ENDLESS.get(command, text)
    return Failure(text, exit_codes.INTERRUPTED)


def is_arm_fault(error: Exception) -> bool:
    """Return whether an arm failed or could not be stopped, which Ctrl-C must not hide."""
    return type(error).__name__ == "ArmFault"  # its module is slow to import


def failure(error: Exception) -> Failure:
    """Return the message, location and exit code of an error."""
    if isinstance(error, typer.Exit):
        return Failure("", error.exit_code)
    if isinstance(error, typer.Abort):
        return interruption()
    if isinstance(error, OutputLost) and error.unread:
        return Failure("", exit_codes.UNREAD)
    if known := exhausted(error):
        return Failure(known, exit_codes.FAILED)
    if isinstance(error, InputError):
        return _wrong_input(error)
    if stated := extras.lacking(error, _command()):
        return Failure(stated, exit_codes.WRONG_INPUT)
    if isinstance(error, TyperException):
        return _wrong_usage(error)
    if isinstance(error, FileNotFoundError | NotADirectoryError) and error.filename:
        place = os.fsdecode(error.filename)
        stated = os.strerror(error.errno or 0).lower()
        return Failure(f"{place}: {stated}", exit_codes.FAILED, place)
    if isinstance(error, OSError) and error.errno in _NAMES:
        place = os.fsdecode(error.filename2 or error.filename or "")
        if error.errno == errno.ENAMETOOLONG and len(place) > LONGEST_SHOWN:
            place = f"{place[:LONGEST_SHOWN]}..."
        return Failure(f"{place}: {_NAMES[error.errno]}", exit_codes.WRONG_INPUT, place or None)
    if isinstance(error, OSError) and error.filename:
        error = named_disk_error(error) or error
    elif isinstance(error, OSError) and (fault := disk_fault(error)):
        return Failure(f"a file cannot be written: its disk {fault}", exit_codes.FAILED)
    if isinstance(error, StoreError):
        return Failure(str(error), exit_codes.FAILED, _place(str(error)))
    if isinstance(error, UnicodeEncodeError):  # a lone surrogate: a byte that is not UTF-8
        return Failure(
            f"{error.object[:200]!r}: is not UTF-8; rename the file or folder, or correct the text",
            exit_codes.WRONG_INPUT,
        )
    if _in_prefects_settings(error):
        return Failure(
            f"Prefect's settings cannot be read: {_brief(error)}; check the variables PREFECT_* of "
            "the environment, and .env, prefect.toml and pyproject.toml in this folder",
            exit_codes.WRONG_INPUT,
        )
    trace = ""
    if not any(kind.__name__ in _EXPECTED for kind in type(error).__mro__):
        if where := _in_package(error):
            return Failure(f"{where}: {type(error).__name__}: {_brief(error)}", exit_codes.FAILED)
        trace = "".join(traceback.format_exception(error, limit=-8))
    return Failure(str(error) or type(error).__name__, exit_codes.FAILED, trace=trace)


def _in_package(error: Exception) -> str:
    """Return package, file and line where code of another package failed; empty if none did."""
    points = [each for group in _PACKAGES for each in entry_points(group=group)]
    known = {each.module.partition(".")[0]: package_of(each) for each in points}
    for frame, line in reversed(list(traceback.walk_tb(error.__traceback__))):
        package = known.get(str(frame.f_globals.get("__name__")).partition(".")[0])
        if package is not None:
            return f"the package {package} fails in {frame.f_code.co_filename}:{line}"
    return ""


def _in_prefects_settings(error: Exception) -> bool:
    """Return whether Prefect raised an error while it read its settings."""
    frames = traceback.walk_tb(error.__traceback__)
    modules = (str(frame.f_globals.get("__name__")) for frame, _ in frames)
    return any(name.startswith("prefect.settings") for name in modules)


def _brief(error: Exception) -> str:
    """Return an error as one line; of a pydantic one the first fault with its key and value."""
    if isinstance(error, ValidationError):
        found = error.errors()[0]
        where = ".".join([error.title, *map(str, found["loc"])])
        value = f" = {masked(found['input'])}" if isinstance(found["input"], str) else ""
        return f"{where}{value}: {found['msg']}"
    return " ".join(str(error).split()) or type(error).__name__


def _command() -> str:
    """Return the command that was called."""
    named = [word for word in sys.argv[1:] if not word.startswith("-")]
    return " ".join(["sliplab", *named[:1]])


def _place(message: str) -> str | None:
    """Return the path or URL that the message of a `StoreError` begins with, if it does."""
    head, colon, _ = message.partition(": ")
    return head if colon and ("/" in head or os.path.exists(head)) else None


def _wrong_input(error: InputError) -> Failure:
    file, key = error.file, error.key
    if _OPTION.fullmatch(file):
        file, key = "", f"{file} {key}".strip()
    code = exit_codes.FAILED if isinstance(error, DamagedFile) else exit_codes.WRONG_INPUT
    faults = error.faults if error.more else ()
    return Failure(error.message, code, file or None, key or None, error.value, faults=faults)


def _wrong_usage(error: TyperException) -> Failure:
    """Describe a wrong command line: an unknown option, a missing argument, a bad value."""
    message = error.format_message()  # empty without a command: its help has been printed
    key = getattr(error, "option_name", None)
    value = None
    parameter = getattr(error, "param", None)
    if parameter is not None:
        key = parameter.opts[0]
        key = key if key.startswith("-") else key.upper()
    if isinstance(error.__cause__, ValidationError):
        found = error.__cause__.errors()[0]
        value = str(found["input"])
        expected = re.sub("^Input should", "must", found["msg"].removeprefix("Value error, "))
        if value.lower().lstrip("+-") == "nan":
            expected = "must be a number"
        message = f"{key} = {value}: {expected}"
    if message:
        command = getattr(getattr(error, "ctx", None), "command", None)
        example = getattr(command, "epilog", None)  # of one command, not of a group
        message = f"{message.rstrip('.')} (see --help)"
        message += f". {example}" if example else ""
    return Failure(message, exit_codes.WRONG_INPUT, None, key, value)
