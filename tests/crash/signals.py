"""Signals at exact lines of a collection: in campaign files, begin, commit and clean-up.

A trace function counts the lines that run in the modules that write a trial, and sends a signal at
one of them. SIGINT, SIGTERM and SIGHUP come once, twice or ten times; SIGKILL once.
"""

from __future__ import annotations

import os
import random
import signal
import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any

from sliplab.flows.running import stopping
from sliplab.rigs.core.rig import Rig, StopRequested
from sliplab.storage.files import read_json
from sliplab.storage.trials.store import TrialStore
from sliplab.storage.trials.verify import verify
from tests.crash.campaign import NAME, collect, hashes, run_request, wrong, wrong_at_the_end
from tests.crash.process import live
from tests.patching import put

SOFT = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
PHASES = ("campaign", "trial", "motion")
MODULES = {
    f"sliplab.{name}"
    for name in (
        "flows.collecting.session",
        "flows.planning.run_request",
        "storage.files",
        "storage.trials.checksums",
        "storage.trials.control",
        "storage.trials.store",
        "storage.trials.frame_writer",
        "storage.trials.hdf5_writer",
        "storage.trials.lock",
        "storage.trials.recovery",
        "storage.trials.writer",
    )
}
"""Modules whose lines are counted."""
MORE = {1: 0.5, 2: 0.3, 10: 0.2}
"""Number of signals, with its probability."""
MOST_LIVES = 3000


@dataclass(frozen=True)
class Plan:
    """The signals of one life.

    Attributes:
        phase: ``campaign`` (before the first motion), ``trial`` (between motions) or ``motion``.
        at: number of the line in that phase; count: signals. gap: lines from one to the next.
    """

    number: signal.Signals
    phase: str
    at: int
    count: int = 1
    gap: int = 1


class Tracer:
    """Counts lines by phase in this process, and sends the signals of a plan.

    Args:
        notes: file to which the id of each completely recorded trial is appended.
    """

    def __init__(self, plan: Plan | None, notes: Path) -> None:
        self.plan, self.lines = plan, Counter[str]()
        self._notes, self._moving, self._begun = notes, False, False
        self._sent = 0

    def install(self) -> None:
        """Trace this process from now on."""
        original: Any = Rig.run_trial

        def run_trial(rig: Rig, program: Any, sink: Any, *arguments: Any, **options: Any) -> Any:
            self._moving = self._begun = True
            try:
                run = original(rig, program, sink, *arguments, **options)
                with self._notes.open("a") as file:
                    writer = getattr(sink, "_sink", sink)  # the page's is around it
                    file.write(f"{writer.folder.name}\n")
                return run
            finally:
                self._moving = False

        put(Rig, "run_trial", run_trial)
        sys.setprofile(self._profile)
        self._trace_stack(sys._getframe())

    def _trace_stack(self, frame: FrameType | None) -> None:
        sys.settrace(self._trace)
        while frame is not None:
            if frame.f_globals.get("__name__") in MODULES:
                frame.f_trace = self._trace
            frame = frame.f_back

    def _profile(self, frame: FrameType, event: str, argument: object) -> None:
        """Trace again: Python stops tracing when a trace function raises, as a signal's handler."""
        if sys.gettrace() is None:
            self._trace_stack(frame)

    def _trace(self, frame: FrameType, event: str, argument: object) -> Callable[..., Any] | None:
        if frame.f_globals.get("__name__") not in MODULES:
            return None
        if event == "line":
            self._line()
        return self._trace

    def _line(self) -> None:
        phase = "motion" if self._moving else "trial" if self._begun else "campaign"
        self.lines[phase if not self._sent else "later"] += 1
        plan = self.plan
        if plan is None or self._sent == plan.count:
            return
        if not self._sent:
            due = phase == plan.phase and self.lines[phase] == plan.at
        else:
            due = self.lines["later"] == self._sent * plan.gap
        if due:
            self._sent += 1
            os.kill(os.getpid(), plan.number)


def send(folder: Path, signals: int, seed: int, trials: int) -> dict[str, Any]:
    """Interrupt a campaign `signals` times; what happened, and what was wrong.

    Raises:
        RuntimeError: a life ended in another way than by completing the campaign or by its signal.
    """
    collect(run_request(folder / "warm", 1))  # compiled code is loaded once, for every child
    calm = run_request(folder / "calm", trials)
    lengths = _count_lines(folder, calm.store, lambda: collect(calm))
    whole = hashes(calm.store)
    rng, sent, places = random.Random(seed), Counter[str](), Counter[str]()
    found: list[str] = []
    campaigns = lives = 0
    while sum(sent.values()) < signals or campaigns == 0:
        wanted = run_request(folder / f"disturbed-{campaigns}", trials)
        notes, complete = folder / f"recorded-{campaigns}", False
        notes.touch()
        left: set[str] = set()
        while not complete:
            lives += 1
            if lives > MOST_LIVES:
                raise RuntimeError(f"not complete after {MOST_LIVES} lives")
            plan = _plan(rng, lengths, trials) if sum(sent.values()) < signals else None

            end = live(partial(_interrupted, plan, notes, partial(collect, wanted)))
            complete = not end.killed and end.code == 0
            if plan is not None and not complete:
                sent[plan.number.name] += 1
                places[plan.phase] += 1
            if not (end.killed or end.code in {0, 130}):
                raise RuntimeError(f"{plan}: a life ended with exit code {end.code}: {end.said}")
            if end.killed:
                found += [f"{plan}: {text}" for text in wrong(wanted.store, whole)]
                found += [f"{plan}: {text}" for text in _unnamed(wanted.store)]
                _forget_unfinished(wanted.store, notes)
                left = _named(wanted.store)
            else:
                found += [f"{plan}: {text}" for text in _not_clean(wanted.store, whole, left)]
        found += wrong_at_the_end(wanted.store, whole, "stopped by a person")
        found += _repeated(wanted.store, notes)
        campaigns += 1
    return {
        "signals": sum(sent.values()),
        "by_signal": dict(sorted(sent.items())),
        "by_place": dict(sorted(places.items())),
        "lives": lives,
        "campaigns": campaigns,
        "trials": trials,
        "seed": seed,
        "wrong": found,
    }


def _interrupted(plan: Plan | None, notes: Path, work: Callable[[], None]) -> None:
    """Do `work` as the command line does, under a plan."""
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # nohup ignores it
    try:
        with stopping.signals():
            Tracer(plan, notes).install()
            try:
                work()
            finally:
                sys.setprofile(None)
                sys.settrace(None)
    except (KeyboardInterrupt, StopRequested):
        raise SystemExit(130) from None


def _count_lines(folder: Path, store: Path, work: Callable[[], None]) -> dict[str, int]:
    """Do `work` undisturbed in a child; return its lines by phase."""
    counts = folder / "lines"

    def count() -> None:
        tracer = Tracer(None, folder / "recorded-calm")
        tracer.install()
        work()
        sys.setprofile(None)
        sys.settrace(None)
        counts.write_text("\n".join(f"{phase} {tracer.lines[phase]}" for phase in PHASES))

    end = live(count)
    if end.code:
        raise RuntimeError(f"the undisturbed collection failed: {end.said}")
    lines = {name: int(number) for name, number in map(str.split, counts.read_text().splitlines())}
    if missing := [name for name, number in lines.items() if not number]:
        raise RuntimeError(f"no line was counted in {missing}: MODULES names other files than ran")
    return lines


def _plan(rng: random.Random, lengths: dict[str, int], trials: int) -> Plan:
    """Draw a place in the campaign's files, in one of the next trials, or in a motion."""
    phase = rng.choice(PHASES)
    length = lengths[phase] if phase == "campaign" else lengths[phase] * min(4, trials) // trials
    at = rng.randint(1, max(1, length))
    if rng.random() < 0.25:
        return Plan(signal.SIGKILL, phase, at)
    count = rng.choices([*MORE], [*MORE.values()])[0]
    return Plan(rng.choice(SOFT), phase, at, count, rng.randint(1, 12))


def _not_clean(store: Path, whole: dict[str, dict[str, str]], left: set[str]) -> list[str]:
    """Return what a program that was asked to stop has left besides committed trials.

    Args:
        left: paths that a SIGKILL had left before.
    """
    return [*wrong(store, whole), *(f"{path}: is left" for path in _named(store) - left)]


def _named(store: Path) -> set[str]:
    """Return the paths that `verify` names."""
    if not (store / "store.json").exists():
        return set()
    return {problem.path for problem in verify(TrialStore.open(store))}


def _unnamed(store: Path) -> list[str]:
    """Return unfinished trials that `verify` does not name."""
    there = {str(path) for path in store.glob(f"campaigns/{NAME}/incoming/*")}
    return [f"{path}: is not named" for path in there - _named(store)]


def _forget_unfinished(store: Path, notes: Path) -> None:
    """Strike out a recording that a SIGKILL met before its record was written."""
    noted = notes.read_text().split()
    folder = store / "campaigns" / NAME / "incoming"
    for path in folder.iterdir() if folder.is_dir() else []:
        try:
            read_json(path / "record.json")
        except (OSError, ValueError):
            if path.name in noted and noted[-1] == path.name:
                notes.write_text("".join(f"{name}\n" for name in noted[:-1]))


def _repeated(store: Path, notes: Path) -> list[str]:
    """Return trials that were recorded completely more often than they were kept."""
    kept = Counter(path.name for path in (store / "campaigns" / NAME / "trials").iterdir())
    for item in TrialStore.open(store).campaign(NAME).quarantined():
        kept[item["trial"]] += str(item["cause"]).startswith("gate")
    recorded = Counter(notes.read_text().split())
    return [
        f"{name}: was recorded completely {count} times and kept {kept[name]} times"
        for name, count in sorted(recorded.items())
        # more are kept where recovery finished a recording that was struck out above
        if count > kept[name]
    ]
