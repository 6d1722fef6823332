"""`python -m tests.storm --seed N`: campaigns under every fault at once, in virtual time.

Stories are played from a seed on: one, or as many as `--stories`, `--hours` of the rig's time or
`--minutes` on the wall ask for. A failure prints its seed, its invariant, and the shortest story
that still breaks it. With `--plant` the product has a small defect, which is to be found.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import resource
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any


def count(text: str) -> int:
    """Read a number of at least 1."""
    if (value := int(text)) < 1:
        raise argparse.ArgumentTypeError(f"{text}: must be at least 1")
    return value


def amount(text: str) -> float:
    """Read a finite number above 0."""
    if not 0 < (value := float(text)) < math.inf:
        raise argparse.ArgumentTypeError(f"{text}: must be above 0")
    return value


def story_file(text: str) -> dict[str, Any]:
    """Read a story that a failure printed."""
    from tests.storm.story import draw

    try:
        found: dict[str, Any] = json.loads(Path(text).read_text())
    except (OSError, ValueError) as error:
        raise argparse.ArgumentTypeError(f"{text}: {error}") from None
    lacking = {*draw(1)} - ({*found} if isinstance(found, dict) else set())
    if lacking:
        raise argparse.ArgumentTypeError(f"{text}: no story, it lacks {', '.join(sorted(lacking))}")
    return found


def plants(text: str) -> list[str]:
    """Read names of planted defects, with commas between them; all of them for `all`."""
    from tests.storm.planted import PLANTS

    names = [*PLANTS] if text == "all" else text.split(",")
    if unknown := {*names} - {*PLANTS}:
        known = ", ".join(PLANTS)
        raise argparse.ArgumentTypeError(f"{', '.join(unknown)}: must be all, or of {known}")
    return names


def main() -> int:
    """Exit code 0 when every invariant held."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.storm",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--seed", type=int, default=1, help="of the first story")
    parser.add_argument("--stories", type=count, help="how many to play")
    parser.add_argument("--hours", type=amount, help="virtual hours to play")
    parser.add_argument(
        "--minutes", type=amount, help="longest time on the wall; with --plant, of the processor"
    )
    parser.add_argument(
        "--jobs", type=count, default=1, help="processes, each with its share of seeds"
    )
    parser.add_argument("--story", type=story_file, help="play the story in this file")
    parser.add_argument(
        "--plant",
        type=plants,
        default=[],
        help="play with a defect of tests/storm/planted.py; with several, or `all`, one by one",
    )
    parser.add_argument("--show", action="store_true", help="print stories and traces")
    parser.add_argument("--no-shrink", action="store_true", help="leave a failing story long")
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output")
    parser.add_argument("--every", type=int, default=1, help=argparse.SUPPRESS)
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    asked = parser.parse_args()
    if len(asked.plant) > 1:
        result = _plants(asked)
    elif asked.jobs > 1:
        result = _jobs(asked)
    else:
        result = _play(asked)
    print(json.dumps(result) if asked.json else _words(result))
    return 1 if result["failed"] else 0


def _play(asked: argparse.Namespace) -> dict[str, Any]:
    from tests.storm.planted import PLANTS
    from tests.storm.play import play, shrink, warm
    from tests.storm.story import draw

    warm()
    for name in asked.plant:
        PLANTS[name]()
    seed, began, rig_s, passed_s = asked.seed, time.monotonic(), 0.0, 0.0
    clocks = Clocks()
    failed: list[dict[str, Any]] = []
    hashes: dict[int, str] = {}

    def over() -> bool:
        if asked.story or (asked.plant and failed):
            return True
        reached = [(asked.stories, len(hashes)), (asked.hours, rig_s / 3600)]
        # on a busy machine a defect is looked for as long as on a quiet one
        spent_s = _processor_s() if asked.plant else time.monotonic() - began
        reached.append((asked.minutes, spent_s / 60))
        limits = [have >= wanted for wanted, have in reached if wanted is not None]
        return any(limits) or not limits

    while True:
        story = asked.story or draw(seed)
        played = play(story)
        rig_s, passed_s = rig_s + played.rig_s, passed_s + played.passed_s
        hashes[seed] = played.hash
        if asked.show:
            print(json.dumps(story), *played.trace, sep="\n", file=sys.stderr)
        if (wrong := played.wrong) is not None:
            print(f"seed {seed}: {wrong}", file=sys.stderr, flush=True)
            short = story if asked.no_shrink else shrink(story, wrong)
            failed.append({"seed": seed, "wrong": str(wrong), "story": short})
        for text in clocks.add(played.errors):
            print(f"seed {asked.seed} to {seed}: {text}", file=sys.stderr, flush=True)
            failed.append({"seed": seed, "wrong": text, "story": None})
        seed += asked.every
        if over():
            result = _result(hashes, failed, rig_s, passed_s, time.monotonic() - began)
            found = {name: [clocks.beyond[name], count] for name, count in clocks.all.items()}
            return {**result, "clocks_beyond_their_interval": found}


class Clocks:
    """Errors of clocks over all stories: each may be beyond its 95 % interval, five of 100 may be.

    Attributes:
        beyond, all: numbers of clocks by device.
    """

    SHARE, CHANCE = 0.05, 1e-6

    def __init__(self) -> None:
        self.beyond: Counter[str] = Counter()
        self.all: Counter[str] = Counter()
        self._said: set[str] = set()

    def add(self, errors: list[tuple[str, float]]) -> list[str]:
        """Add a story's; return for which devices there are too many by now, each once."""
        from scipy.stats import binom

        for device, share in errors:
            self.all[device] += 1
            self.beyond[device] += share > 1
        found = [
            device
            for device, count in self.all.items()
            if binom.sf(self.beyond[device] - 1, count, self.SHARE) < self.CHANCE
        ]
        new = [device for device in found if device not in self._said]
        self._said |= {*new}
        return [
            f"clocks are as exact as they say: {self.beyond[device]} of {self.all[device]} clocks "
            f"of {device} are beyond their 95 % interval"
            for device in new
        ]


def _result(
    hashes: dict[int, str],
    failed: list[dict[str, Any]],
    rig_s: float,
    passed_s: float,
    took_s: float,
) -> dict[str, Any]:
    return {
        "stories": len(hashes),
        "campaign_hours": round(rig_s / 3600, 3),
        "hours_with_pauses": round(passed_s / 3600, 3),
        "minutes": round(took_s / 60, 2),
        "hours_an_hour": round(rig_s / took_s, 1),
        "processor_s": round(_processor_s(), 1),
        "hours_a_processor_hour": round(rig_s / max(_processor_s(), 1e-9), 1),
        "hashes": hashes,
        "failed": failed,
    }


def _processor_s() -> float:
    """Return the processor's time of this process and its children, s."""
    spent = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(each.ru_utime + each.ru_stime for each in spent)


def _words(result: dict[str, Any]) -> str:
    failed = result["failed"]
    lines = [
        f"seed {it['seed']}: {it['wrong']}\n{json.dumps(it['story'])}" for it in result["failed"]
    ]
    if table := result.get("plants"):
        lines = [f"{'name':20} {'found':6} {'seed':>7} {'processor':>9}  by"]
        lines += [_row(found) for found in table]
    if "stories" in result:
        lines.append(
            f"{result['stories']} stories, {result['campaign_hours']:.2f} campaign hours "
            f"({result['hours_with_pauses']:.0f} with pauses), "
            f"{result['hours_an_hour']:.0f} an hour ({result['hours_a_processor_hour']:.0f} of a "
            f"processor's), {len(failed)} failed"
        )
    return "\n".join(lines)


def _start(asked: argparse.Namespace, **other: Any) -> subprocess.Popen[str]:
    options = {
        "seed": asked.seed,
        "stories": asked.stories,
        "hours": asked.hours,
        "minutes": asked.minutes,
        **other,
    }
    given = [f"--{name}={value}" for name, value in options.items() if value is not None]
    given += ["--no-shrink"] if asked.no_shrink else []
    command = [sys.executable, "-m", "tests.storm", "--json", *given]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


def _jobs(asked: argparse.Namespace) -> dict[str, Any]:
    """Play in several processes, each with every n-th seed."""
    began = time.monotonic()
    shares = {
        name: None if (whole := getattr(asked, name)) is None else whole / asked.jobs
        for name in ("stories", "hours")
    }
    if shares["stories"] is not None:
        shares["stories"] = -(-asked.stories // asked.jobs)
    running = [
        _start(asked, seed=asked.seed + number, every=asked.jobs, **shares)
        for number in range(asked.jobs)
    ]
    parts = [json.loads(each.communicate()[0]) for each in running]
    hashes = {int(seed): value for part in parts for seed, value in part["hashes"].items()}
    failed = [it for part in parts for it in part["failed"]]
    rig_s, passed_s = (
        3600 * sum(part[name] for part in parts) for name in ("campaign_hours", "hours_with_pauses")
    )
    return _result(hashes, failed, rig_s, passed_s, time.monotonic() - began)


def _plants(asked: argparse.Namespace) -> dict[str, Any]:
    """Look for each planted defect by itself; `failed` are those that were not found."""
    from tests.storm.play import warm

    warm()
    asked.no_shrink, names, rows, missed = True, asked.plant, [], []
    asked.minutes = asked.minutes or 5.0
    for name in names:
        asked.plant = [name]
        part = _forked(asked)
        seen = part["failed"][0] if part["failed"] else None
        if seen is not None and _fails_without(asked, seen["seed"]):
            text = f"seed {seen['seed']} fails without {name}, too: {seen['wrong']}"
            print(text, file=sys.stderr, flush=True)
            seen = None
        row = {"name": name, "found": seen is not None, "processor_s": part["processor_s"]}
        rows.append({**row, "seed": seen and seen["seed"], "by": seen and seen["wrong"][:90]})
        print(_row(rows[-1]), file=sys.stderr, flush=True)
        if seen is None:
            missed.append({"seed": asked.seed, "wrong": f"{name} was not found", "story": None})
    return {"plants": rows, "failed": missed}


def _fails_without(asked: argparse.Namespace, seed: int) -> bool:
    """Return whether a story breaks an invariant without any defect, so that it shows none."""
    alone = {"plant": [], "seed": seed, "stories": 1, "hours": None, "minutes": None}
    return bool(_forked(argparse.Namespace(**(vars(asked) | alone)))["failed"])


def _row(found: dict[str, Any]) -> str:
    """Return a line of the table of planted defects."""
    seed = "-" if found["seed"] is None else found["seed"]
    state, by = ("found", found["by"]) if found["found"] else ("missed", "")
    return f"{found['name']:20} {state:6} {seed:>7} {found['processor_s']:>7.1f} s  {by}"


def _forked(asked: argparse.Namespace) -> dict[str, Any]:
    """Play in a process that has all of this one's code, and ends with what was planted."""
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reader)
        with os.fdopen(writer, "w") as file:
            json.dump(_play(asked), file)
        os._exit(0)
    os.close(writer)
    with os.fdopen(reader) as file:
        text = file.read()
    os.waitpid(child, 0)
    found: dict[str, Any] = json.loads(text)
    return found


if __name__ == "__main__":
    sys.exit(main())
