"""`python -m tests.study_kills --kills 5 --seed S`: a study that is killed ends as one that is not.

The pilot study runs once undisturbed. Then it runs again in lives that end by SIGKILL at random
times of the undisturbed one's length, and once more to its end. Both must say the same: every trial
the same bytes, the same model, the same summary but for the seconds that it took and the number of
attempts that were broken off. It takes some
minutes and is no part of the tests. One JSON object on standard output; exit code 1 when anything
differs.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from hashlib import sha256
from pathlib import Path
from typing import Any

LONGEST_S = 3600.0
"""Bound of one life."""
TIMES = ("timing_s",)
"""Keys of the summary that tell of clocks on the wall."""
DATED = ("provenance.json",)
"""Files that say when and where a trial was taken: no two runs are alike in them."""


def command(store: Path, arguments: list[str]) -> list[str]:
    """Return the command line that runs a study in `store`."""
    return [sys.executable, "-m", "sliplab", "study", str(store), "--json", *arguments]


def live(store: Path, arguments: list[str], log: Path, kill_s: float | None = None) -> int:
    """One life of a study; its exit code, negative when it was killed after `kill_s` seconds."""
    environment = {key: value for key, value in os.environ.items() if key != "PREFECT_HOME"}
    with log.open("ab") as messages:
        process = subprocess.Popen(
            command(store, arguments),
            stdout=subprocess.DEVNULL,
            stderr=messages,
            env=environment,
            start_new_session=True,
        )
        try:
            return process.wait(kill_s if kill_s is not None else LONGEST_S)
        except subprocess.TimeoutExpired:
            os.kill(process.pid, signal.SIGKILL)  # its children are left to the next life
            return process.wait(30)


def figures(store: Path) -> dict[str, Any]:
    """Return a finished study's result: hashes of its trials and models, and its summary."""
    summary = json.loads((store / "report" / "summary.json").read_text())
    del summary["quality"]["interrupted"]  # what the kills broke off
    data = [*store.glob("campaigns/*/trials/**/*"), *store.glob("models/*.pt")]
    return {
        "summary": {key: value for key, value in summary.items() if key not in TIMES},
        "files": {
            str(path.relative_to(store)): sha256(path.read_bytes()).hexdigest()
            for path in sorted(data)
            if path.is_file() and path.name not in DATED
        },
    }


def differences(calm: Any, killed: Any, place: str = "") -> list[str]:
    """Return the paths at which two results differ."""
    if isinstance(calm, dict) and isinstance(killed, dict):
        return [
            found
            for key in sorted(calm.keys() | killed.keys())
            for found in differences(calm.get(key), killed.get(key), f"{place}/{key}")
        ]
    return [] if calm == killed else [place]


def kill_study(folder: Path, kills: int, seed: int, arguments: list[str]) -> dict[str, Any]:
    """Run a study undisturbed and killed, and compare.

    Raises:
        RuntimeError: a study that nobody killed failed.
    """
    rng, log = random.Random(seed), folder / "messages"
    calm, stopped = folder / "calm", folder / "killed"
    began = time.monotonic()
    if live(calm, arguments, log) != 0:
        raise RuntimeError(f"the undisturbed study failed: {log.read_text()[-2000:]}")
    whole_s = time.monotonic() - began
    at, done = [], 0
    while done < kills:
        after = rng.uniform(0.02, 0.3) * whole_s
        code = live(stopped, arguments, log, after)
        if code >= 0:
            break  # it was complete before its time
        at.append(round(after, 1))
        done += 1
    if live(stopped, arguments, log) != 0:
        raise RuntimeError(f"the last life failed: {log.read_text()[-2000:]}")
    return {
        "seed": seed,
        "undisturbed_s": round(whole_s, 1),
        "killed_after_s": at,
        "wrong": differences(figures(calm), figures(stopped)),
    }


def main() -> int:
    """Run it; 1 if anything differs."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--kills", type=int, default=5)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--protocol", type=Path, action="append", default=[])
    wanted = parser.parse_args()
    arguments = [f"--protocol={path.resolve()}" for path in wanted.protocol] or ["--pilot"]
    with tempfile.TemporaryDirectory(prefix="sliplab-study-") as folder:
        found = kill_study(
            Path(folder), wanted.kills, wanted.seed, [*arguments, "--check-labels", "0"]
        )
    print(json.dumps(found))
    return 1 if found["wrong"] else 0


if __name__ == "__main__":
    sys.exit(main())
