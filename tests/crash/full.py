"""A disk that fills up, anywhere in a trial; and one that is read-only."""

from __future__ import annotations

import os
import random
import shutil
from pathlib import Path
from typing import Any

from sliplab.flows.__main__ import _explain
from sliplab.flows.planning.run_request import RunRequest
from tests.crash.campaign import collect, hashes, run_request, wrong, wrong_at_the_end
from tests.crash.hooks import Policy
from tests.crash.policies import Full, ReadOnly
from tests.crash.process import End, live

STEP = 64 * 1024


def last_end(wanted: RunRequest, policy: Policy) -> End:
    """Collect as the command line does, with its exit code and its message."""

    def work() -> None:
        try:
            collect(wanted)
        except Exception as error:
            code = _explain(error)
            os._exit(code)

    return live(work, wanted.store, policy)


def size(store: Path) -> int:
    """Bytes of all files of a store."""
    return sum(path.stat().st_size for path in store.rglob("*") if path.is_file())


def wrong_message(end: End, says: str) -> list[str]:
    """Return the faults in how a collection ended; exit code 1 and one message is correct."""
    found = [] if end.code == 1 and not end.killed else [f"exit code {end.code}"]
    lines = [line for line in end.said.splitlines() if line.strip()]
    if len(lines) != 1 or not lines[0].startswith("error: ") or says not in lines[0]:
        found.append(f"said {end.said!r}")
    return found


def rooms(needed: int, step: int, more: int, seed: int) -> list[int]:
    """Every so manieth byte of `needed`, and `more` random ones."""
    rng = random.Random(seed)
    return [*range(0, needed, step), *(rng.randrange(needed) for _ in range(more))]


def fill(
    folder: Path, video: bool, step: int = STEP, more: int = 0, seed: int = 1
) -> dict[str, Any]:
    """Let the disk fill up in one trial; what happened, and what was wrong.

    Args:
        step: bytes from one boundary to the next.
        more: how often besides, at random bytes.
    """
    calm = run_request(folder / "calm", 1, video)
    collect(calm)
    whole, needed = hashes(calm.store), size(calm.store)
    found, tried = [], rooms(needed, step, more, seed)
    for room in tried:
        place = folder / "full"
        shutil.rmtree(place, ignore_errors=True)
        wanted = run_request(place, 1, video)
        end = last_end(wanted, Full(room))
        said = wrong_message(end, "its disk is full") + wrong(wanted.store, whole)
        found += [f"room for {room} bytes: {text}" for text in said + _goes_on(wanted, whole)]
    return {"bytes": needed, "step": step, "tried": len(tried), "wrong": found}


def _goes_on(wanted: RunRequest, whole: dict[str, dict[str, str]]) -> list[str]:
    try:
        collect(wanted)
        return wrong_at_the_end(wanted.store, whole, also="OSError: ")
    except Exception as error:
        return [f"cannot go on: {error!r}"]


def read_only(folder: Path) -> dict[str, Any]:
    """Collect into a read-only store that lacks a trial, and into a folder that is read-only."""
    begun = run_request(folder / "some", 1)
    collect(begun)
    whole = hashes(begun.store)
    more, none = run_request(folder / "some", 2), run_request(folder / "none", 1)
    found = []
    for wanted in (more, none):
        end = last_end(wanted, ReadOnly())
        said = wrong_message(end, "its disk is read-only") + wrong(wanted.store, whole)
        found += [f"{wanted.store}: {text}" for text in said]
    if hashes(begun.store) != whole:
        found.append(f"{begun.store}: changed")
    return {"wrong": found}
