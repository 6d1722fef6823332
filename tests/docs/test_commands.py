"""Every command printed in the documentation exists, with its options and arguments.

Commands in blocks must be complete. In prose a command may be named without its arguments.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.exceptions import TyperException

from sliplab.flows.cli.app import command_line
from tests.conftest import ROOT
from tests.docs.blocks import PAGES, Command, blocks, commands

ROOT_COMMAND: Any = typer.main.get_command(command_line())
NUMBERS = {"N": "1", "P": "8000", "S": "1", "MS": "1"}
"""Placeholders of numbers in a synopsis, and values to substitute."""
MAKEFILES = {"docs/sync-box.md": "rigs/firmware/Makefile"}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_every_printed_command_is_one_that_there_is(page: Path) -> None:
    wrong = [
        f"{command}: {fault}"
        for command in commands(page)
        if (fault := _fault(command)) is not None
    ]
    assert not wrong, "\n".join(wrong)


def _leaves(command: Any, words: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    for name, each in getattr(command, "commands", {}).items():
        yield from _leaves(each, (*words, name))
    if not hasattr(command, "commands") and not command.hidden:  # hidden: former names
        yield words, command


@pytest.mark.parametrize(
    ("words", "command"),
    [pytest.param(*leaf, id=" ".join(leaf[0])) for leaf in _leaves(ROOT_COMMAND)],
)
def test_help_ends_with_an_example_that_can_be_run(words: tuple[str, ...], command: Any) -> None:
    start, program, *example = shlex.split(command.epilog)
    assert (start, program) == ("Example:", "sliplab")
    assert tuple(example[: len(words)]) == words
    assert _sliplab_fault(example, whole=True) is None


def test_commands_stand_in_groups_research_last() -> None:
    panels = dict.fromkeys(
        getattr(each, "rich_help_panel", None) for each in ROOT_COMMAND.commands.values()
    )
    assert list(panels) == ["Plan", "Collect", "Rig", "Analyse", "Data", "Research"]


def _fault(command: Command) -> str | None:
    name, *rest = command.words
    if name == "make":
        return _make_fault(command.page, rest)
    if name == "python" and rest[:2] != ["-m", "sliplab"]:
        return _python_fault(command.page, rest)
    return _sliplab_fault(rest[2:] if name == "python" else rest, command.fenced)


def _sliplab_fault(words: Sequence[str], whole: bool) -> str | None:
    command, rest = ROOT_COMMAND, [NUMBERS.get(word, word) for word in words]
    while hasattr(command, "commands"):
        if not rest or rest[0] == "COMMAND":
            return None  # `sliplab` by itself
        if rest == ["--help"]:
            return None
        command, rest = command.commands.get(rest[0]), rest[1:]
        if command is None:
            return "no such command"
    named = len(rest) > 0 and not rest[0].startswith("-")
    try:
        command.make_context(str(words[0]), list(rest))
    except typer.Exit:
        return None
    except TyperException as error:
        message = str(error.format_message())
        if "Missing" in message and not whole and not named:
            return None
        if message.endswith("requires an argument.") and not whole and rest[-1].startswith("-"):
            return None
        return message
    return None


def _python_fault(page: Path, words: Sequence[str]) -> str | None:
    if words[:1] != ["-m"]:
        written = {block.title for block in blocks(page)}
        return None if words[0] in written or (ROOT / words[0]).is_file() else "no such file"
    module, rest = words[1], list(words[2:])
    if module == "benchmarks" and rest and not rest[0].startswith("-") and rest[0] != "NAME":
        if not (ROOT / "benchmarks" / f"{rest[0]}.py").is_file():
            return f"no benchmark {rest[0]}"
        rest = rest[1:]
    spec = find_spec(module)
    if spec is not None and spec.submodule_search_locations is not None:
        spec = find_spec(f"{module}.__main__")
    if spec is None or spec.origin is None:
        return "no such module"
    source = Path(spec.origin).read_text()
    unknown = [word for word in rest if word.startswith("--") and f'"{word}"' not in source]
    return f"no option {unknown[0]}" if unknown else None


def _make_fault(page: Path, words: Sequence[str]) -> str | None:
    file = MAKEFILES.get(page.relative_to(ROOT).as_posix(), "Makefile")
    targets = set(re.findall(r"^([a-z]+):", (ROOT / file).read_text(), re.MULTILINE))
    unknown = [word for word in words if "=" not in word and word not in targets]
    return f"no target {unknown[0]} in {file}" if unknown else None


@pytest.mark.parametrize(
    ("line", "fault"),
    [
        ("frobnicate STORE", "no such command"),
        ("plan", "Missing"),
        ("plan PROTOCOL --rigs mock", "No such option"),
        ("collect PROTOCOL --rig RIG", "Missing option"),
        ("collect PROTOCOL --rig RIG --store DIR --trials many", "valid integer"),
        ("trials STORE --where", "requires an argument"),
        ("trials STORE other", "unexpected"),
    ],
)
def test_wrong_commands_are_found(line: str, fault: str) -> None:
    assert fault in (_sliplab_fault(line.split(), whole=True) or "")


def test_wrong_modules_and_targets_are_found() -> None:
    page = ROOT / "README.md"
    assert _python_fault(page, ["-m", "benchmarks", "nothing"]) == "no benchmark nothing"
    assert _python_fault(page, ["-m", "tests.nothing"]) == "no such module"
    assert _python_fault(page, ["-m", "tests.fuzz", "--fils", "3"]) == "no option --fils"
    assert _python_fault(page, ["docs/nothing.py"]) == "no such file"
    assert _make_fault(page, ["nothing"]) == "no target nothing in Makefile"
