"""The command of a study: its options are the parameters of what measures."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Any

import typer

from sliplab.analysis.study import Study
from sliplab.flows.cli.common import JsonOption
from sliplab.flows.running import console, exit_codes


def study_app(study: Study[Any]) -> typer.Typer:
    """Return an application with the command of one study."""

    def run(as_json: bool, **options: Any) -> None:
        if isinstance(out := options.get("out"), Path):
            from sliplab.storage.trials.catalogue import refuse_store_file

            refuse_store_file(out, "--out", again=True)
        found = study.measure(**options)
        files = {} if found.dry else {"page": study.write(found)}
        if found.error is not None:
            raise found.error
        if as_json:
            entries = {
                name: str(entry) if isinstance(entry, Path) else entry
                for name, entry in {**files, **found.named}.items()
            }
            console.print_json({**entries, **found.result.to_json(), **entries})
        for part in study.shown(found.result, *found.more):
            if isinstance(part, str):
                console.say(part)
            elif not as_json:
                console.print_table(part.caption, part.columns, part.rows, spare=part.spare)
        for name, path in files.items():
            console.say(f"{name}: {path}")
        if found.failed:
            raise typer.Exit(exit_codes.FAILED)

    own = inspect.signature(study.measure, eval_str=True).parameters.values()
    kind = inspect.Parameter.KEYWORD_ONLY
    as_json = inspect.Parameter("as_json", kind, default=False, annotation=JsonOption)
    parameters = [each.replace(kind=kind) for each in own]
    run.__signature__ = inspect.Signature([*parameters, as_json])  # type: ignore[attr-defined]
    run.__doc__ = inspect.getdoc(study.measure)
    app = typer.Typer()
    app.command(study.name, epilog=f"Example: {study.example}")(run)
    return app
