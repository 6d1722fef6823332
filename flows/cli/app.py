"""The assembled command line. Heavy libraries are imported inside the commands that use them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Annotated

import typer
from typer.main import get_command_name

from sliplab.flows.cli import (
    collect,
    control,
    detect,
    exchange,
    export,
    register,
    rigs,
    schema,
    status,
    steps,
    store,
    study,
)
from sliplab.flows.cli.common import RESEARCH
from sliplab.flows.running import console
from sliplab.protocols.errors import InputError
from sliplab.protocols.plugin import plugins
from sliplab.protocols.plugins import PluginError, import_foreign

app = typer.Typer(
    name="sliplab",
    help="Run tactile slip experiments: plan, collect, sync, label, train, evaluate, report.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _version(asked: bool) -> None:
    if asked:
        from importlib.metadata import version

        console.show(f"sliplab {version('sliplab')}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_version, is_eager=True, help="Print the version."),
    ] = False,
) -> None:
    """Run tactile slip experiments: plan, collect, sync, label, train, evaluate, report."""


# panels of the help are in the order of their first commands
for part in (
    collect.app,
    register.app,
    schema.app,
    control.app,
    status.app,
    rigs.app,
    steps.app,
    detect.app,
    study.app,
    store.app,
    exchange.app,
    export.app,
):
    app.add_typer(part)

GROUPS = {"teach": rigs.teach_app, "calibrate": rigs.calibrate_app}
"""Groups that plug-ins extend."""


def _first_words(part: typer.Typer) -> Iterator[str]:
    for group in part.registered_groups:
        if isinstance(group.name, str):
            yield group.name
        elif group.typer_instance is not None:
            yield from _first_words(group.typer_instance)
    for command in part.registered_commands:
        assert command.callback is not None
        yield command.name or get_command_name(command.callback.__name__)


_CORE = frozenset(_first_words(app))
_added: set[str] = set()


def command_line(words: Sequence[str] = ()) -> typer.Typer:
    """Return the command line with the commands of plug-ins, where the given words may name one.

    A command of the core loads no plug-in. All are added at once, so that their order is always the
    same.

    Raises:
        InputError: the command of a plug-in that cannot be imported.
    """
    word = next((word for word in words if not word.startswith("-")), None)
    if word in _CORE and word not in GROUPS:
        return app
    for each, places in sorted(plugins().commands().items()):
        for place in places:
            _add(each, place, needed=each == word)
    if words and word is None:  # the help
        for fault in plugins().faults:
            console.say(f"warning: {fault}")
    return app


def _add(word: str, place: str, needed: bool) -> None:
    if place in _added:
        return
    try:
        part = import_foreign(place)
        if not isinstance(part, typer.Typer):
            from sliplab.flows.cli.study_command import study_app

            part = study_app(part)
    except PluginError as error:
        if needed:
            raise InputError("COMMAND", "", word, f"cannot be loaded: {error}") from None
        return
    _added.add(place)
    if word not in GROUPS:
        for command in part.registered_commands:
            command.rich_help_panel = command.rich_help_panel or RESEARCH
    GROUPS.get(word, app).add_typer(part)
