"""`python -m tests.fuzz --files N --seed S [--jobs J]`: damaged and hostile files, read.

Protocols, rig files, stores with a damaged file, and pickles are mutated bit by bit and by their
structure, and given to the real readers in processes with a limit of time and memory. Each file
must be read cleanly or be refused with a message (`InputError`, `StoreError`); any other
exception, a crash, a hang, a file outside of the box or a program that is started is a failure.
`--only NUMBER` looks at one case again.

One JSON object on standard output; exit code 1 when anything was `wrong`.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

LIMIT_S = 20.0
MOST_WRONG = 200


@dataclass
class Job:
    """One worker and what is left for it to read."""

    left: list[int]
    box: Path
    process: Any = None
    pipe: Connection | None = None
    last: int = -1
    lives: int = 0


@dataclass
class Tally:
    """Counts of the outcomes of all files."""

    outcomes: dict[str, Counter[str]] = field(default_factory=dict)
    wrong: list[str] = field(default_factory=list)

    def add(self, target: str, outcome: str, number: int) -> None:
        """One more."""
        known = outcome if outcome in {"clean", "refused"} else "wrong"
        self.outcomes.setdefault(target, Counter())[known] += 1
        if known == "wrong" and len(self.wrong) < MOST_WRONG:
            self.wrong.append(f"{number} ({target}): {outcome}")
            print(self.wrong[-1], file=sys.stderr, flush=True)


def fuzz(folder: Path, numbers: list[int], seed: int, jobs: int) -> dict[str, Any]:
    """Read all cases; what became of them, and what was wrong."""
    from tests.fuzz.targets import make_foreign, make_small_store

    make_small_store(folder / "small-store")
    foreign = make_foreign(folder)
    made = {path.name for path in folder.iterdir()}
    context = multiprocessing.get_context("spawn")
    tally = Tally()
    running = [Job(numbers[job::jobs], folder / f"box-{job}") for job in range(jobs)]
    for job in running:
        _start(context, job, foreign, seed)
    done = 0
    while running:
        for pipe in wait([job.pipe for job in running if job.pipe is not None], timeout=60):
            job = next(item for item in running if item.pipe is pipe)
            try:
                assert job.pipe is not None
                kind, what, outcome = job.pipe.recv()
            except EOFError:
                job.process.join(30)
                why = f"the reader died with code {job.process.exitcode} (1: over {LIMIT_S:g} s)"
                if job.last < 0:
                    raise RuntimeError(f"{why} before its first file") from None
                tally.add("died", why, job.last)
                job.left = [number for number in job.left if number > job.last]
                job.box = job.box.with_name(f"{job.box.name}+")
                job.last = -1
                _start(context, job, foreign, seed)
                continue
            if kind == "begin":
                job.last = what
            elif kind == "end":
                done += 1
                tally.add(what, outcome, job.last)
                if done % 5000 == 0:
                    wrong = len(tally.wrong)
                    print(f"{done} read, {wrong} wrong", file=sys.stderr, flush=True)
            else:
                job.process.join(30)
                running.remove(job)
    litter = [
        path.name
        for path in folder.iterdir()
        if path.name not in made and not path.name.startswith("box-")
    ]
    tally.wrong += [f"{name} was made outside of the box" for name in litter]
    return {
        "files": len(numbers),
        "seed": seed,
        "outcomes": {name: dict(counts) for name, counts in sorted(tally.outcomes.items())},
        "wrong": tally.wrong,
    }


def _start(context: Any, job: Job, foreign: dict[str, bytes], seed: int) -> None:
    from tests.fuzz.worker import work

    here, there = context.Pipe(duplex=False)
    job.process = context.Process(
        target=work, args=(there, job.box, foreign, seed, job.left, LIMIT_S), daemon=True
    )
    job.process.start()
    there.close()
    job.pipe = here


def main() -> int:
    """Exit code 0 when nothing was wrong."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.fuzz",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--files", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--only", type=int, help="one case, by its number")
    asked = parser.parse_args()
    numbers = list(range(asked.files)) if asked.only is None else [asked.only]
    begun = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="sliplab-fuzz-") as folder:
        found = fuzz(Path(folder), numbers, asked.seed, max(1, min(asked.jobs, len(numbers))))
    found["seconds"] = round(time.monotonic() - begun, 1)
    print(json.dumps(found))
    return 1 if found["wrong"] else 0


if __name__ == "__main__":
    sys.exit(main())
