"""`sliplab guesses`, which has moved."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sliplab.flows.cli.common import JsonOption
from sliplab.protocols.errors import InputError

app = typer.Typer()


@app.command(hidden=True)
def guesses(
    folder: Annotated[Path, typer.Argument(metavar="STORE")], as_json: JsonOption = False
) -> None:
    """Moved to the benchmarks."""
    raise InputError(
        "COMMAND",
        "",
        "guesses",
        f"has moved: python -m benchmarks.guesses {folder}, in a checkout of SlipLab",
    )
