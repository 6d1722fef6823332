"""Mutated adapters: each is read, or refused with file and key, and nothing is written then."""

from __future__ import annotations

import copy
import random
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.command_line import here
from tests.plugins.adapters.adapters import COUNTS, SLIDES, slides, touches

SECRET = "what stands outside"
HOSTILE: tuple[Any, ...] = (
    *(None, True, -1, 0, 1e400, 10**30, [], {}, "", " ", "\x00"),
    *["../../*", "/etc/*", "**", "**/**/x", "{", "{}", "{a}{a}", "{a:b", "(a+)+$"],
    *("*" * 17, "*a" * 16, "?" * 600),
    *["{stem}", "{x:number}", "a/../b", "~", "\\", "C:\\x", "\u202e"],
    *([[]], {"a": {"b": {}}}, "outside.csv", "nan", "1 mm", 2026, "2026-11-24"),
    *(["taxel", "taxel"], {"t": 0}, "!!python/object:os.system"),
)
PLACE = r"(?:\S+(?:\\ufeff \S+)?|row \d+(?:, .+)?|line \d+, column \d+|byte \d+)"
"""A key, or what stands in its place in a table or a file that is no YAML."""
TEXTS = (
    *["adapter: 1\nadapter: 1\n", "a: &x [*x]\n", "a: !!python/object/apply:os.system [id]\n"],
    *("[" * 100, "{a: " * 100, "\t", "- 1\n", "adapter: 1\n<<: {a: 1}\n", "\ufeff"),
    *["adapter: 0x1\n", "'", "a: 1:30\n", "? a\n", "%YAML 9.9\n---\n"],
)


def _places(part: Any, at: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    items = part.items() if isinstance(part, dict) else enumerate(part)
    for key, value in items:
        yield (*at, key)
        if isinstance(value, dict | list):
            yield from _places(value, (*at, key))


def mutated(seed: int) -> tuple[str, str]:
    """Return the data set's name, and the text of an adapter that something was done to."""
    draw = random.Random(seed)
    name = draw.choice(("touches", "slides"))
    adapter: Any = copy.deepcopy(COUNTS if name == "touches" else SLIDES)
    for _ in range(draw.choice((1, 1, 1, 2, 4))):
        at = draw.choice(list(_places(adapter)))
        part = adapter
        for key in at[:-1]:
            part = part[key]
        way = draw.randrange(5)
        if way == 0:
            del part[at[-1]]
        elif way == 1 and isinstance(part, dict):
            part[str(at[-1]) + "x"] = part.pop(at[-1])
        elif way == 2 and isinstance(part[at[-1]], str):
            text = part[at[-1]]
            cut = draw.randrange(len(text) + 1)
            part[at[-1]] = text[:cut] + draw.choice("{}*?/.:|\\") + text[cut + 1 :]
        else:
            part[at[-1]] = draw.choice(HOSTILE)
    text = yaml.safe_dump(adapter, sort_keys=False, allow_unicode=True)
    if draw.random() < 0.1:
        cut = draw.randrange(len(text))
        text = text[:cut] + draw.choice(TEXTS) + text[cut:]
    return name, text


@pytest.fixture(scope="module")
def sets(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two small data sets, and beside them what must not be read."""
    folder = tmp_path_factory.mktemp("sets")
    touches(folder / "touches", lambda n: f"sample_{n}_label_{n % 3}.npy")
    slides(folder / "slides")
    (folder / "outside.csv").write_text(f"trial,first,full\nann_2_1,{SECRET},\n")
    (folder / "slides" / "onsets_too.csv").symlink_to(folder / "outside.csv")
    return folder


def _run(seeds: range, sets: Path, folder: Path) -> int:
    refused = 0
    for seed in seeds:
        name, text = mutated(seed)
        file, store = folder / "mutated.yaml", folder / f"store-{seed}"
        file.write_text(text)
        done = here("import", "--adapter", file, sets / name, "--store", store)
        said = f"seed {seed}: {done.stderr}\n{text}"
        assert "Traceback" not in done.stderr, said
        assert SECRET not in done.stderr, said
        if done.returncode == 0:
            assert any((store / "campaigns").glob("*/trials/*")), said
            continue
        refused += 1
        assert done.returncode == 2, said
        faults = done.stderr.strip().rpartition("error: ")[2].splitlines()
        where = rf"(?:{file}|{sets / name}(?:/\S+)?): {PLACE}(?: = .*)?: ."
        assert "error: " in done.stderr, said
        for line in faults:
            assert re.match(where, line) or re.fullmatch(r"and \d+ more", line), said
        assert not store.exists(), said
    return refused


def test_mutated_adapters_are_refused_with_file_and_key(sets: Path, tmp_path: Path) -> None:
    assert _run(range(30), sets, tmp_path) > 15


@pytest.mark.long
def test_a_thousand_mutated_adapters_are_refused(sets: Path, tmp_path: Path) -> None:
    assert _run(range(1000, 2000), sets, tmp_path) > 500
