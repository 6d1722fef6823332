"""Mutated headers of recordings and tables: each is read, or refused by name, nothing written."""

from __future__ import annotations

import random
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml

from sliplab.storage.formats.aedat4 import Aedat4Stream, Aedat4Writer
from sliplab.storage.streams import EventChunk
from tests.command_line import here
from tests.plugins.adapters.adapters import COUNTS, SLIDES, slides, touches
from tests.plugins.formats.test_prophesee import HEADS, cd, dat, evt2, evt3, evt21, high, write

FORMS = ("evt2", "evt21", "evt3", "dat", "aedat4", "events.csv", "t.npy", "force.npz", "counts")
HEAD = 128
"""Bytes at the beginning of a binary file that count as its header."""
PARTS = (
    b"",
    b"\x00",
    b"\xff",
    b"\n",
    b"%",
    b"9" * 30,
    b"-1",
    b"1e999",
    b"nan",
    b"\x0c",
    b"(",
    b",",
)


@pytest.fixture(scope="module")
def sets(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a whole file, or a whole data set, of each form."""
    folder = tmp_path_factory.mktemp("sets")
    words = {
        "evt2": evt2(high(1), cd(1, 3, 5, 6), cd(0, 4, 7, 8)),
        "evt21": evt21((high(1), 0), (cd(1, 3, 5, 6), 1)),
        "evt3": evt3((0x8, 1), (0x6, 3), (0x0, 6), (0x2, 1 << 11 | 5)),
        "dat": dat((3, 5, 6, 1), (4, 7, 8, 0)),
    }
    for form, data in words.items():
        (folder / form).mkdir()
        write(folder / form, form, data)
    (folder / "aedat4").mkdir()
    at = np.arange(100)
    streams = {0: Aedat4Stream("EVTS", "events", (64, 48), "camera")}
    with Aedat4Writer(folder / "aedat4" / "a.aedat4", streams) as file:
        xy = (at % 48).astype(np.uint16)
        file.events(0, EventChunk(xy, xy, (at % 2).astype(np.uint8), 10**15 + at.astype(np.int64)))
    touches(folder / "touches", lambda n: f"sample_{n}_label_{n % 3}.npy")
    slides(folder / "slides")
    return folder


def mutated(form: str, seed: int, sets: Path, folder: Path) -> tuple[Path, list[object]]:
    """Write a file, or a data set, whose header was changed; return it and how to import it."""
    draw = random.Random(f"{form} {seed}")
    own = {"counts": "touches", "events.csv": "slides", "t.npy": "slides", "force.npz": "slides"}
    name = own.get(form, form)
    made = folder / f"{name}-{form}-{seed}"
    shutil.copytree(sets / name, made)
    wanted = {"counts": "*.npy"}.get(form, form if name == "slides" else "a.*")
    path = min(made.rglob(wanted))  # of the first trial: what was whole before it stays
    data = path.read_bytes()
    head = {"events.csv": data.index(b"\n") if b"\n" in data else 0}.get(form, HEAD)
    head = min(len(HEADS[form]) if form in HEADS else head, len(data))
    for _ in range(draw.choice((1, 1, 2, 4))):
        begin = draw.randrange(head)
        end = min(begin + draw.choice((0, 1, 1, 4)), head)
        data = data[:begin] + draw.choice(PARTS) + data[end:]
    path.write_bytes(data)
    if name == form:
        return path, ["import", path, "--name", "a"]
    adapter = folder / "adapter.yaml"
    adapter.write_text(yaml.safe_dump(COUNTS if form == "counts" else SLIDES, sort_keys=False))
    return path, ["import", "--adapter", adapter, made]


def _run(seeds: range, sets: Path, folder: Path) -> int:
    refused = 0
    for seed in seeds:
        for form in FORMS:
            path, command = mutated(form, seed, sets, folder)
            store = folder / f"store-{form}-{seed}"
            done = here(*command, "--store", store)
            said = f"{form} {seed}: {path.read_bytes()[:HEAD]!r}\n{done.stderr}"
            assert "Traceback" not in done.stderr, said
            if done.returncode == 0:
                assert any((store / "campaigns").glob("*/trials/*")), said
                continue
            refused += 1
            assert path.name in done.stderr.strip().splitlines()[-1], said
            if done.returncode == 1:  # the header can be read, and what it promises is not there
                lost = set(re.findall(r"not imported: (\S+): ", done.stderr))
                there = {trial.name for trial in store.glob("campaigns/*/trials/*")}
                assert not there & lost, said
                assert lost or not there, said
                continue
            assert done.returncode == 2, said
            assert not store.exists(), said
    return refused


def test_mutated_headers_are_refused_by_name(sets: Path, tmp_path: Path) -> None:
    assert _run(range(3), sets, tmp_path) > 10


@pytest.mark.long
def test_a_thousand_mutated_headers_are_refused(sets: Path, tmp_path: Path) -> None:
    assert _run(range(100, 212), sets, tmp_path) > 400
