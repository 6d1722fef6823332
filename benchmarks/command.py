"""Runs a command of the benchmarks with the error messages of the command line."""

from __future__ import annotations

import sys
from typing import Any

import typer

from sliplab.flows.cli import errors
from sliplab.flows.running import console, exit_codes


def run_command(app: typer.Typer) -> None:
    """Run a command; an error ends it with one message and its exit code."""
    console.begin(as_json="--json" in sys.argv[1:])
    try:
        code: Any = app(standalone_mode=False)
    except KeyboardInterrupt:
        sys.exit(errors.interruption().report())
    except Exception as error:
        sys.exit(errors.failure(error).report())
    sys.exit(code if isinstance(code, int) else exit_codes.DONE)
