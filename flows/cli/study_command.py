"""The command of a study: its options are the parameters of what measures."""

from __future__ import annotations

import inspect
import re
from pathlib import Path
from typing import Annotated, Any, get_origin

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
    about, helps = _parts(inspect.getdoc(study.measure) or "")
    as_json = inspect.Parameter("as_json", kind, default=False, annotation=JsonOption)
    parameters = [
        each.replace(kind=kind, annotation=_option(each.annotation, helps.get(each.name)))
        for each in own
    ]
    run.__signature__ = inspect.Signature([*parameters, as_json])  # type: ignore[attr-defined]
    run.__doc__ = about
    app = typer.Typer()
    app.command(study.name, epilog=f"Example: {study.example}")(run)
    return app


def _parts(text: str) -> tuple[str, dict[str, str]]:
    """Return a docstring without its sections, and the meanings of ``Args:`` by name."""
    about, *sections = re.split(r"^(Args|Returns|Raises|Yields):\n", text, flags=re.MULTILINE)
    found = dict(zip(sections[::2], map(inspect.cleandoc, sections[1::2]), strict=True))
    named = re.findall(r"^(\w+): (.*(?:\n[ ]+.*)*)", found.get("Args", ""), re.MULTILINE)
    return about.strip(), {name: " ".join(words.split()) for name, words in named}


def _option(annotation: Any, words: str | None) -> Any:
    """Return the annotation of an option, with its help where it has none."""
    if words is None or get_origin(annotation) is Annotated:
        return annotation
    return Annotated[annotation, typer.Option(help=words[:1].upper() + words[1:])]
