"""The program's entry: runs the command line, maps faults to messages and exit codes."""

from __future__ import annotations

import sys

import typer

from flows.cli import errors
from flows.running import console, garbage, stopping
from protocols.errors import InputError


def main() -> None:
    """Run the command line; ends the process with its exit code."""
    garbage.seldom()
    with stopping.signals():
        code = _run()
    sys.exit(code)


def _run() -> int:
    console.begin(as_json="--json" in sys.argv[1:])
    try:
        from flows.cli.app import app

        code = app(standalone_mode=False)
        if code == console.INTERRUPTED:
            return errors.interruption().report()
        return code if isinstance(code, int) else console.DONE
    except KeyboardInterrupt:
        return errors.interruption().report()
    except typer.Exit as ended:
        return int(ended.exit_code)
    except InputError as error:
        return errors.failure(error).report()
    except Exception as error:
        stopped = stopping.requested()
        return (errors.interruption() if stopped else errors.failure(error)).report()


if __name__ == "__main__":
    main()
