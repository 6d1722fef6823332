"""Does what a page says, in order: writes its files, makes its changes, runs its commands.

Commands run in this process, which has loaded the libraries already.
"""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from sliplab.flows.running import console
from tests.command_line import here
from tests.docs.blocks import Block, blocks, steps

_OFFLINE = ("--quiet", "--no-index", "--no-deps", "--no-build-isolation")
WIDTH = 100
"""Columns of the terminal that the pages show."""


@dataclass(frozen=True)
class Done:
    """The result of a command."""

    code: int
    out: str
    said: str


def run(line: str, folder: Path) -> Done:
    """Run one command of a page in `folder`."""
    words = shlex.split(line)
    if words[0] == "sliplab":
        return _sliplab(words, folder)
    if words[:2] == ["pip", "install"]:  # beside the page's files, and without the network
        words = ["python", "-m", *words, *_OFFLINE, "--target", str(folder)]
    words[0] = sys.executable if words[0] == "python" else words[0]
    ended = subprocess.run(
        words,
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(folder)},
        capture_output=True,
        text=True,
        timeout=120,
    )
    return Done(ended.returncode, ended.stdout, ended.stderr)


def _sliplab(words: list[str], folder: Path) -> Done:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(console.results, "width", WIDTH)
        done = here(*words[1:], cwd=folder)
    return Done(done.returncode, done.stdout, done.stderr)


def walk(page: Path, folder: Path, *, long: bool = False) -> int:
    """Do what `page` says in `folder`; the number of commands that were run.

    A block with a title is a file, or (``diff``) a change to one. A console block is run, and what
    it shows is held against what is printed: ``...`` stands for anything, and after
    ``<!-- test: digits -->`` numbers may differ. ``<!-- test: skip -->`` leaves a block out,
    ``<!-- test: long -->`` all but in `long` tests.
    ``/SHARED/`` is a folder in `folder`.
    """
    count = 0
    for block in blocks(page):
        if "skip" in block.flags or ("long" in block.flags and not long):
            continue
        if block.title is not None:
            _write(folder / block.title, block)
        elif block.language == "console":
            for number, line, shown in steps(block):
                line = line.replace("/SHARED/", f"{folder}/shared/")
                done = run(re.sub(r"\s#( .*)?$", "", line), folder)
                place = f"{page.name}:{number}: {line}"
                wanted = 2 if any(text.startswith("error:") for text in shown) else 0
                assert done.code == wanted, f"{place}: exit {done.code}\n{done.out}{done.said}"
                _compare(shown, done, place, digits="digits" in block.flags)
                count += 1
    return count


def _write(path: Path, block: Block) -> None:
    if block.language != "diff":
        path.parent.mkdir(exist_ok=True)  # a device begins with a folder of its own
        path.write_text(block.text)
        return
    lines = block.text.splitlines(keepends=True)
    old = "".join(line[1:] for line in lines if line[0] in " -")
    new = "".join(line[1:] for line in lines if line[0] in " +")
    text = path.read_text()
    assert text.count(old) == 1, f"{block.page.name}:{block.line}: stands there other than once"
    path.write_text(text.replace(old, new))


def _compare(shown: list[str], done: Done, place: str, *, digits: bool) -> None:
    """Hold what a page shows against both streams; messages may be left out, results may not."""
    said = _lines(done.said.splitlines(), digits)
    left = [line for line in _lines(shown, digits) if line not in said]
    if not left:
        return
    pattern = "\n".join(re.escape(line).replace(r"\.\.\.", ".*") for line in left)
    printed = "\n".join(_lines(done.out.splitlines(), digits))
    assert re.fullmatch(pattern, printed, re.DOTALL), (
        f"{place} shows\n" + "\n".join(left) + "\nand printed\n" + printed + "\n" + done.said
    )


def _lines(lines: list[str], digits: bool) -> list[str]:
    """Lines as far as they matter: without empty ones, rules and the width of columns."""
    short = (" ".join(re.sub(r"─+", " ", line).split()) for line in lines)
    return [re.sub(r"\d[\d.,]*", "#", line) if digits else line for line in short if line]
