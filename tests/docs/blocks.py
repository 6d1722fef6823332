"""Fenced blocks of the documentation, and every SlipLab command in them or in prose.

A synopsis is spelled out: ``pause / resume STORE`` is two commands, ``[--rig RIG]`` with and
without, ``TRIAL...`` one trial.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path

from tests.conftest import ROOT

PAGES = [
    ROOT / "README.md",
    ROOT / "CHANGELOG.md",
    *sorted(path for path in (ROOT / "docs").rglob("*.md") if "decisions" not in path.parts),
    *sorted((ROOT / "docs" / "decisions").glob("*.md")),
]
_FENCE = re.compile(
    r"^(?P<flags><!-- test: (?P<words>[^>]*) -->\n)?"
    r"^(?P<indent> *)```(?P<info>[^\n`]*)\n(?P<body>.*?)^(?P=indent)```[ ]*$",
    re.MULTILINE | re.DOTALL,
)
_INLINE = re.compile(r"(?<!`)`((?:[^`\n]|\n(?!\s*\n))+)`(?!`)")
_OURS = re.compile(r"^(?:[^\s=]*/)?(?P<name>sliplab|make|python3?)(?= |$)")
_VARIABLE = re.compile(r"^[A-Z_]+=(\"[^\"]*\"|'[^']*'|\S*) +")


@dataclass(frozen=True)
class Block:
    """A fenced block."""

    page: Path
    line: int
    language: str
    title: str | None
    flags: frozenset[str]
    text: str


@dataclass(frozen=True)
class Command:
    """A command of ours: ``sliplab``, ``make`` or ``python``, then its words."""

    page: Path
    line: int
    words: tuple[str, ...]
    fenced: bool

    def __str__(self) -> str:
        place = self.page.relative_to(ROOT).as_posix()
        return f"{place}:{self.line}: {' '.join(self.words)}"


def blocks(page: Path) -> list[Block]:
    """The fenced blocks of a page, in order."""
    text = page.read_text()
    found = []
    for match in _FENCE.finditer(text):
        language, _, rest = match["info"].strip().partition(" ")
        title = re.search(r'title="([^"]*)"', rest)
        body = re.sub(rf"^{match['indent']}", "", match["body"], flags=re.MULTILINE)
        found.append(
            Block(
                page,
                text.count("\n", 0, match.start("body")),
                language,
                title[1] if title else None,
                frozenset((match["words"] or "").split()),
                body,
            )
        )
    return found


def steps(block: Block) -> Iterator[tuple[int, str, list[str]]]:
    """The commands of a console block: line, command, and the output that is printed below it.

    Where a block has prompts, what has none is output; where it has none, every line is a command.
    """
    lines = block.text.splitlines()
    prompted = any(line.startswith("$ ") for line in lines)
    at = 0
    while at < len(lines):
        line, number = lines[at], block.line + 1 + at
        at += 1
        if prompted and not line.startswith("$ "):
            continue
        while line.endswith("\\"):
            line = line[:-1] + lines[at].strip()
            at += 1
        output = []
        while prompted and at < len(lines) and not lines[at].startswith("$ "):
            output.append(lines[at])
            at += 1
        yield number, line.removeprefix("$ "), output


def commands(page: Path) -> list[Command]:
    """Every command of ours that a page prints."""
    found = []
    for block in blocks(page):
        for number, line, _ in steps(block):
            line = line.removeprefix("ExecStart=")
            for part in re.split(r" && |; ", re.sub(r"\s#( .*)?$", "", line)):
                found += _spelled(page, number, part.strip(" ()"), fenced=True)
    text = page.read_text()
    blanked = _FENCE.sub(lambda match: "\n" * match[0].count("\n"), text)
    for match in _INLINE.finditer(blanked):
        number = blanked.count("\n", 0, match.start()) + 1
        found += _spelled(page, number, " ".join(match[1].split()), fenced=False)
    return found


def _spelled(page: Path, number: int, text: str, *, fenced: bool) -> Iterator[Command]:
    while _VARIABLE.match(text):
        text = _VARIABLE.sub("", text)
    match = _OURS.match(text)
    if match is None:
        return
    rest = text[match.end() :].strip()
    for line in _without_brackets(rest):
        for words in _alternatives(shlex.split(line)):
            name = "python" if match["name"].startswith("python") else match["name"]
            yield Command(page, number, (name, *words), fenced)


def _without_brackets(text: str) -> list[str]:
    match = re.search(r"(?<!\S)\[([^\[\]]*)\]", text)
    if match is None:
        return [text]
    before, after = text[: match.start()], text[match.end() :]
    return [
        line for inside in ("", match[1]) for line in _without_brackets(f"{before}{inside}{after}")
    ]


def _alternatives(words: list[str]) -> Iterator[tuple[str, ...]]:
    choices: list[list[str]] = []
    at = 0
    while at < len(words):
        if words[at] == "/" and choices and at + 1 < len(words):
            choices[-1].append(words[at + 1])
            at += 2
        else:
            choices.append([words[at]])
            at += 1
    kept = [[word for word in choice if word != "..."] for choice in choices]
    for line in product(*(choice for choice in kept if choice)):
        yield tuple(word.removesuffix("...") for word in line)
