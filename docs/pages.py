"""Pages of the site that are made from the program itself when it is built, so that they are true.

The changelog, the command line, the keys of protocol and rig files and of documents, and the list
of decisions.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from schema_tables import tables

DOCS = Path(__file__).parent
_DOCUMENTS = {
    "trial": (
        "The record of a trial",
        "`campaigns/NAME/trials/ID/record.json`: what was recorded, and how well.",
    ),
    "label": (
        "The label of a trial",
        "`derived/labels/NAME/ID.json`: its onsets, and doubts of them ([Labels](../labels.md)).",
    ),
    "evaluation": (
        "An evaluation",
        "`derived/evaluation/evaluation.json`: figures of test trials ([Metrics](../metrics.md)).",
    ),
    "summary": (
        "The summary of a report",
        "`report/summary.json`: the numbers of a report ([The report's numbers](../summary.md)).",
    ),
    "classes": (
        "An evaluation of classes",
        "`derived/evaluation/classes.json`: figures of test recordings of classes "
        "([Metrics](../metrics.md#recordings-of-classes)).",
    ),
    "classes-summary": (
        "The summary of a report of classes",
        "`report/summary.json` of recordings of classes "
        "([The report's numbers](../summary.md#recordings-of-classes)).",
    ),
    "twin": (
        "The numbers of a twin",
        "`TWIN.json` beside `TWIN.yaml`: a simulated rig's fit to a pilot ([Twins](../twin.md)).",
    ),
    "drift": (
        "The numbers of a drift",
        "`report/drift.json`: a campaign's reference trials, each fitted by a simulated rig "
        "([Twins](../twin.md#drift-along-a-campaign)).",
    ),
    "gap": (
        "The gap of a twin",
        "`FOLDER/gap.json`: networks trained on a twin and tested on its rig "
        "([Twins](../twin.md#trained-on-the-twin-tested-on-the-rig)).",
    ),
    "stress": (
        "Nuisances",
        "`stress/stress.json`: detectors under nuisances ([Nuisances](../stress.md)).",
    ),
    "power": (
        "The trials that claims need",
        "`report/power.json`: after how many trials claims are called in campaigns that were drawn "
        "from a pilot ([Claims](../claims.md#how-many-trials-claims-need)).",
    ),
    "reflex": (
        "The study of reflexes",
        "`OUT/reflex.json`: drops that reflexes prevent ([Reflexes](../reflex.md)).",
    ),
    "tradeoff": (
        "Speed against error",
        "`report/detector_tradeoff.json`: settings of the detector, varied on a store's trials "
        "([Speed against error](../tradeoff.md#the-detector)).",
    ),
    "generalise": (
        "Levels left out and other skins",
        "`derived/generalisation/results.json`: accuracy on what the network was not trained on "
        "([Metrics](../metrics.md)).",
    ),
    "bench": (
        "The table of the bench",
        "`FOLDER/bench.json`: detectors on the scenes of the bench ([The bench](../bench.md)).",
    ),
}
"""Title and place of each document in a store."""
_ITEM = re.compile(r"(- |1\. )\S")


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Put every page of decisions under Decisions, so that none can be forgotten."""
    section = next(item for item in config.nav if "Decisions" in item)
    section["Decisions"] += [f"decisions/{path.name}" for path in _decisions()]
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that are made here."""
    pages: dict[str, Callable[[], str]] = {
        "changes.md": changes,
        "decisions/index.md": decisions,
        "reference/commands.md": commands,
        "reference/protocol-file.md": protocol_file,
        "reference/rig-file.md": rig_file,
        "reference/driver-rules.md": driver_rules,
        **{f"reference/{kind}-document.md": partial(document, kind) for kind in _DOCUMENTS},
    }
    for name, make in pages.items():
        files.append(File.generated(config, name, content=make()))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Begin a list where GitHub begins one: this Markdown wants an empty line before it."""
    lines: list[str] = []
    fenced = listed = False
    for line in markdown.split("\n"):
        fenced ^= line.lstrip().startswith("```")
        begins = not fenced and _ITEM.match(line) is not None
        if begins and not listed and lines and lines[-1].strip():
            lines.append("")
        listed = (listed or begins) and bool(line.strip())
        lines.append(line)
    return "\n".join(lines)


def _decisions() -> list[Path]:
    """The pages of decisions by subject, the history last."""
    pages = set((DOCS / "decisions").glob("*.md")) - {DOCS / "decisions" / "template.md"}
    return sorted(pages, key=lambda path: (path.stem == "history", path.stem))


def decisions() -> str:
    """The list of decisions."""
    lines = ["# Decisions", "", "What is in force, by subject, and why.", ""]
    for path in _decisions():
        title = path.read_text().splitlines()[0].removeprefix("# ")
        lines.append(f"- [{title}]({path.name})")
    return "\n".join(lines) + "\n"


def changes() -> str:
    """Return the changelog as a page."""
    return (DOCS.parent / "CHANGELOG.md").read_text().replace("](docs/", "](")


def protocol_file() -> str:
    """Every key of a protocol file."""
    from sliplab.flows.planning.json_schemas import file_schema

    schema = file_schema("protocol")
    return f"""# Protocol files

Every key of a protocol. [Write a protocol](../howto/write-a-protocol.md) explains how they work
together, and how an editor completes and checks them with [the schema](../schema/protocol.json).

{tables(schema, schema["definitions"])}"""


def rig_file() -> str:
    """Every key of a rig file."""
    from sliplab.flows.planning.json_schemas import file_schema

    models = file_schema("rig")["definitions"]
    return f"""# Rig files

Every key of a rig file. A file that begins with `extends: OTHER.yaml` has only the keys that
differ. [Bring up a rig](../howto/bring-up-a-rig.md) explains how to determine the values; the
schema for editors is [rig.json](../schema/rig.json).

{tables(models["RigFile"], models)}"""


def driver_rules() -> str:
    """Every rule that a driver is tested by."""
    from sliplab.plugins.driver_kit.rule_tables import rule_tables

    return f"""# Rules for drivers

`conformance` tests a driver on its fake by these rules
([Write a driver](../howto/write-a-driver.md#the-rules-for-drivers)).

{rule_tables()}"""


def document(kind: str) -> str:
    """Every key of a document in a store."""
    from sliplab.flows.planning.json_schemas import file_schema

    title, text = _DOCUMENTS[kind]
    schema = file_schema(kind)
    return f"""# {title}

{text} JSON Schema: [{kind}.json](../schema/{kind}.json). Unknown keys are preserved; optional
keys may be missing in documents of older versions.

{tables(schema, schema["definitions"])}"""


def commands() -> str:
    """Return the page of the command line, from the texts of `--help`."""
    import typer

    from sliplab.flows.cli.app import command_line

    lines = [
        "# Commands",
        "",
        "Every command takes `--json`. Exit codes and the JSON of an error:",
        "[all commands](index.md#all-commands).",
        "",
    ]
    for words, command in _walk("sliplab", typer.main.get_command(command_line())):
        arguments = [item for item in command.params if item.param_type_name == "argument"]
        options = [item for item in command.params if item.param_type_name == "option"]
        usage = [_argument(item) for item in arguments]
        usage += [_option(item, item.opts) for item in options if item.required]
        lines += [f"## {words}", "", f"`{' '.join([words, *usage])}`", "", command.help or "", ""]
        rows = [(_argument(item), item.help or "") for item in arguments]
        rows += [
            (_option(item, (*item.opts, *item.secondary_opts)), _help(item)) for item in options
        ]
        lines += ["| argument or option | meaning |", "| --- | --- |"]
        lines += [f"| `{name}` | {_cell(text)} |" for name, text in rows]
        lines.append("")
    return "\n".join(lines)


def _walk(words: str, command: Any) -> Iterator[tuple[str, Any]]:
    if hasattr(command, "commands"):
        for name, inner in ((n, c) for n, c in command.commands.items() if not c.hidden):
            yield from _walk(f"{words} {name}", inner)
    else:
        yield words, command


def _argument(item: Any) -> str:
    name = (item.metavar or item.name.upper()) + ("..." if item.nargs == -1 else "")
    return name if item.required else f"[{name}]"


def _option(item: Any, names: Iterable[str]) -> str:
    kind = getattr(item.type_descriptor.annotation, "__name__", "").upper()
    value = item.metavar or {"STR": "TEXT", "LIST": "TEXT", "INT": "N", "FLOAT": "NUMBER"}.get(
        kind, kind
    )
    return ", ".join(names) + ("" if item.is_flag else f" {value}")


def _help(item: Any) -> str:
    text = item.help or ""
    if item.required:
        return f"{text} Required."
    if item.is_flag or item.default is None or callable(item.default) or item.default == "":
        return text
    return f"{text} Default: `{item.default}`."


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")
