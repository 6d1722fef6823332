"""The command of a study: its options are the parameters of what measures."""

from __future__ import annotations

import inspect
from typing import Any

import typer

from sliplab.analysis.study import Study
from sliplab.flows.cli.common import JsonOption
from sliplab.flows.running import console


def study_app(study: Study[Any]) -> typer.Typer:
    """Return an application with the command of one study."""

    def run(as_json: bool, **options: Any) -> None:
        found = study.measure(**options)
        page = study.write(found)
        if found.error is not None:
            raise found.error
        if as_json:
            places = {name: str(path) for name, path in {"page": page, **found.named}.items()}
            console.print_json({**places, **found.result.to_json()})
        for part in study.shown(found.result, *found.more):
            if isinstance(part, str):
                console.say(part)
            elif not as_json:
                console.print_table(part.caption, part.columns, part.rows, spare=part.spare)
        console.say(f"page: {page}")
        if found.failed:
            raise typer.Exit(console.FAILED)

    own = inspect.signature(study.measure, eval_str=True).parameters.values()
    kind = inspect.Parameter.KEYWORD_ONLY
    as_json = inspect.Parameter("as_json", kind, default=False, annotation=JsonOption)
    parameters = [each.replace(kind=kind) for each in own]
    run.__signature__ = inspect.Signature([*parameters, as_json])  # type: ignore[attr-defined]
    run.__doc__ = inspect.getdoc(study.measure)
    app = typer.Typer()
    app.command(study.name, epilog=f"Example: {study.example}")(run)
    return app
