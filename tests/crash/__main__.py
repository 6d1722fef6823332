"""`python -m tests.crash --kills N --seed S`: a store under faults, in five parts.

**kills**: a campaign of small simulated trials is taken once undisturbed. Then it is taken again in
lives that end by SIGKILL, at a random time or in a random write, fsync or rename, until it is
complete; and again from the beginning until there were N kills. After every kill each trial that is
there must be byte for byte the undisturbed one; at the end all of them, and nothing else.

**signals**: the same with Ctrl-C, SIGTERM, SIGHUP and SIGKILL at lines of the code that writes
campaigns and trials. Nothing that was recorded completely is lost, and a program that was asked to
stop leaves nothing behind.

**power**: the calls of a collection are recorded, and the power is cut after each of them.
**full**: the disk fills up at every 64 KiB of a trial with a video. **read_only**: it is read-only.

One JSON object on standard output; exit code 1 when anything was `wrong`.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

KINDS = ("time", "write", "fsync", "rename", "any")
PARTS = ("kills", "signals", "power", "full", "read_only")
MAX_LIVES = 2000


def crash(folder: Path, kills: int, seed: int, trials: int, video: bool = False) -> dict[str, Any]:
    """Kill a campaign `kills` times; what happened, and what was wrong.

    Raises:
        RuntimeError: a life ended by itself in another way than by completing the campaign.
    """
    from tests.crash.campaign import collect, hashes, run_request, wrong, wrong_at_the_end
    from tests.crash.policies import Killer
    from tests.crash.process import live

    collect(run_request(folder / "warm", 1, video))  # compiled code is loaded once, for every child
    calm = run_request(folder / "calm", trials, video)
    collect(calm)
    whole = hashes(calm.store)
    rng, killed = random.Random(seed), Counter[str]()
    found: list[str] = [f"undisturbed: {text}" for text in wrong_at_the_end(calm.store, whole)]
    campaigns = lives = 0
    while sum(killed.values()) < kills or campaigns == 0:
        wanted = run_request(folder / f"disturbed-{campaigns}", trials, video)
        complete = False
        while not complete:
            lives += 1
            if lives > MAX_LIVES:
                raise RuntimeError(f"not complete after {MAX_LIVES} lives")
            kind = rng.choice(KINDS) if sum(killed.values()) < kills else "none"
            # from the first call to those of the third trial, early ones more often
            at = max(1, round(2 ** rng.uniform(0, {"write": 7, "any": 8}.get(kind, 5))))
            share = rng.choice((0.0, 0.3, 0.7, 1.0))
            policy = None if kind in {"time", "none"} else Killer(kind, at, share)
            after = rng.uniform(0, 1.0) if kind == "time" else None
            end = live(lambda wanted=wanted: collect(wanted), wanted.store, policy, after)
            where = f"{kind} {at if after is None else f'{after:.3f} s'}"
            if end.killed:
                killed[kind] += 1
            elif end.code:
                raise RuntimeError(f"a life ended with exit code {end.code}: {end.said}")
            complete = not end.killed
            found += [f"after {where}: {text}" for text in wrong(wanted.store, whole)]
        found += wrong_at_the_end(wanted.store, whole)
        campaigns += 1
    quarantined = len(list((wanted.store / "campaigns").glob("*/quarantine/*")))
    return {
        "kills": sum(killed.values()),
        "by_kind": dict(sorted(killed.items())),
        "lives": lives,
        "campaigns": campaigns,
        "trials": trials,
        "retaken_undisturbed": len(list((calm.store / "campaigns").glob("*/quarantine/*"))),
        "quarantined_last": quarantined,
        "seed": seed,
        "wrong": found,
    }


def main() -> int:
    """Exit code 0 when nothing was wrong."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.crash",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--kills", type=int, default=200, help="kills or signals of a part")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--trials", type=int, default=40)
    parser.add_argument("--every", type=int, default=1, help="power: states that are gone on from")
    parser.add_argument("--step", type=int, default=64 * 1024, help="full: bytes of a boundary")
    parser.add_argument(
        "--only", choices=PARTS, action="append", help="one part, may be repeated; all by default"
    )
    parser.add_argument(
        "--video", action="store_true", help="with a video of every trial, and further cameras"
    )
    asked = parser.parse_args()
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    results: dict[str, Any] = {}
    for part in asked.only or PARTS:
        print(f"{part} ...", file=sys.stderr, flush=True)
        begun = time.monotonic()
        with tempfile.TemporaryDirectory(prefix="sliplab-crash-") as folder:
            results[part] = _part(part, Path(folder), asked)
        results[part]["seconds"] = round(time.monotonic() - begun, 1)
    print(json.dumps(results))
    return 1 if any(result["wrong"] for result in results.values()) else 0


def _part(part: str, folder: Path, asked: argparse.Namespace) -> dict[str, Any]:
    from tests.crash.full import fill, read_only
    from tests.crash.power import cut
    from tests.crash.signals import send

    if part == "kills":
        return crash(folder, asked.kills, asked.seed, asked.trials, asked.video)
    if part == "signals":
        return send(folder, asked.kills, asked.seed, asked.trials)
    if part == "power":
        return cut(folder, asked.seed, video=asked.video, every=asked.every)
    if part == "full":
        # without a video a trial has few boundaries, and is quicker
        return fill(folder, asked.video or asked.only is None, asked.step, seed=asked.seed)
    return read_only(folder)


if __name__ == "__main__":
    sys.exit(main())
