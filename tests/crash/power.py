"""Power cuts: the calls of a real collection are recorded, and cut off after each of them."""

from __future__ import annotations

import base64
import json
import random
import shutil
from dataclasses import asdict
from pathlib import Path
from typing import Any

from tests.crash.campaign import NAME, collect, hashes, run_request, wrong, wrong_at_the_end
from tests.crash.disk import Disk, Tree, write_tree
from tests.crash.policies import Done, Killer, Recorder
from tests.crash.process import live

_TRIALS = f"campaigns/{NAME}/trials/"
_TORN = 2
"""Variants of every power cut of which some unflushed pieces survive."""


def recorded(folder: Path, trials: int, video: bool) -> tuple[Disk, list[Done], Path]:
    """A killed collection that goes on: the disk before, the calls that were made, the store.

    The protocol has one more direction than when it was begun, so that the campaign's description
    is written anew as well.

    Raises:
        RuntimeError: the collection failed.
    """
    begun = run_request(folder, trials - 1, video)
    live(lambda: collect(begun), begun.store, Killer("write", 70, 0.5))
    before = Disk(begun.store.resolve())
    more = run_request(folder, trials, video)
    recorder, file = Recorder(), folder / "calls.json"

    def work() -> None:
        collect(more)
        calls = [{**asdict(d), "data": base64.b64encode(d.data).decode()} for d in recorder.done]
        file.write_text(json.dumps(calls))

    end = live(work, more.store, recorder)
    if end.code:
        raise RuntimeError(f"the recorded collection failed: {end.said}")
    calls = [
        Done(**{**item, "data": base64.b64decode(item["data"])})
        for item in json.loads(file.read_text())
    ]
    return before, calls, more.store


def wrong_trials(tree: Tree, final: Tree) -> list[str]:
    """Committed trials of a tree that are not the final ones, file by file."""

    def by_trial(of: Tree) -> dict[str, dict[str, bytes | None]]:
        found: dict[str, dict[str, bytes | None]] = {}
        for path, data in of.items():
            if path.startswith(_TRIALS):
                name, _, inner = path[len(_TRIALS) :].partition("/")
                found.setdefault(name, {})[inner] = data
        return found

    whole = by_trial(final)
    return [name for name, files in by_trial(tree).items() if whole.get(name) != files]


def cut(
    folder: Path, seed: int, trials: int = 3, video: bool = False, every: int = 1
) -> dict[str, Any]:
    """Cut the power after every recorded call; what happened, and what was wrong.

    Args:
        every: each so manieth state is put on the disk, verified, and collected to the end.
    """
    calm = run_request(folder / "calm", trials, video)
    collect(calm)
    whole = hashes(calm.store)
    disk, calls, store = recorded(folder / "power", trials, video)
    final = Disk(store.resolve()).seen()
    rng = random.Random(seed)
    found: list[str] = [f"recorded: {text}" for text in wrong_at_the_end(store, whole)]
    states = tried = 0
    for number in range(len(calls) + 1):
        if number:
            disk.make(calls[number - 1])
        trees = {"killed": disk.seen(), "lost": disk.left()}
        trees |= {f"torn {k}": disk.torn(rng) for k in range(_TORN)}
        for kind, tree in trees.items():
            where = f"after call {number}, {kind}"
            found += [f"{where}: {name} is not whole" for name in wrong_trials(tree, final)]
            if states % every == 0:
                tried += 1
                found += [f"{where}: {text}" for text in _go_on(folder, tree, trials, video, whole)]
            states += 1
    if disk.seen() != final:
        found.append("the recorded calls do not lead to the store")
    return {"calls": len(calls), "states": states, "gone_on": tried, "wrong": found}


def _go_on(
    folder: Path, tree: Tree, trials: int, video: bool, whole: dict[str, dict[str, str]]
) -> list[str]:
    """Verify what a cut left, and collect to the end."""
    place = folder / "after"
    shutil.rmtree(place, ignore_errors=True)
    write_tree(tree, place / "store")
    found = wrong(place / "store", whole)
    try:
        collect(run_request(place, trials, video))
    except Exception as error:
        return [*found, f"cannot go on: {error!r}"]
    return found + wrong_at_the_end(place / "store", whole)
