"""Plays a story: one process for each step, which kills, power cuts and full disks may end."""

from __future__ import annotations

import gc
import hashlib
import json
import os
import random
import shutil
import signal
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

from sliplab.rigs.rig_file import load_rig_file
from sliplab.storage.remote.objects import Remote
from sliplab.storage.remote.pull import pull
from sliplab.storage.remote.push import push
from sliplab.storage.trials.control import open_requests
from sliplab.storage.trials.store import TrialStore
from sliplab.storage.trials.verify import verify
from tests.conftest import ROOT
from tests.crash.campaign import collect, run_request
from tests.crash.disk import Disk, write_tree
from tests.crash.hooks import Call, Policy, entries
from tests.crash.policies import Full, Killer, ReadOnly, Recorder
from tests.crash.process import End, live
from tests.storm.ledger import Ledger, Wrong
from tests.storm.steps import NAME, Process, Stage
from tests.storm.story import Story, shorter
from tests.storm.virtual import BEGIN_S, Host, Notes, modules_with_dates

NIGHT_GAP_S = 8 * 3600.0
MOST_SHORTER = 60
"""Stories that are tried to make a failing one shorter."""


@dataclass
class Played:
    """The outcome of a story.

    Attributes:
        trace: what happened, line by line; the same for the same story.
        rig_s: virtual time of the rig.
        passed_s: virtual time of nights, with the pauses that were stepped through.
        errors: of clocks with a 95 % interval, as a share of it, by device.
        wrong: the invariant that was broken, and how; None if all held.
    """

    trace: list[str] = field(default_factory=list)
    rig_s: float = 0.0
    passed_s: float = 0.0
    errors: list[tuple[str, float]] = field(default_factory=list)
    wrong: Wrong | None = None

    @property
    def hash(self) -> str:
        """SHA-256 of the trace, its first 16 digits."""
        return hashlib.sha256("\n".join(self.trace).encode()).hexdigest()[:16]


class PowerCut:
    """Cuts the power after so many changes, or at the end: what was not flushed is lost, or torn.

    Args:
        before: the disk when the process began. after: where what is left is put.
        name: part of the paths whose changes are counted.
    """

    def __init__(
        self, before: Disk, after: Path, at: int, torn: int | None, name: str = ""
    ) -> None:
        self._before, self._after, self._at, self._torn = before, after, at, torn
        self._name, self._seen = name, 0
        self._recorder = Recorder()

    def __call__(self, call: Call) -> int:
        """Make the call; the last one ends the process."""
        before = len(self._recorder.done)
        result = self._recorder(call)
        if self._name in f"{call.path} {call.to}":
            self._seen += len(self._recorder.done) - before
        if self._seen >= self._at:
            self.cut()
        return result

    def cut(self) -> None:
        """Put what is left in its place, and end this process."""
        for done in self._recorder.done:
            self._before.make(done)
        torn = self._torn
        tree = self._before.left() if torn is None else self._before.torn(random.Random(torn))
        write_tree(tree, self._after)
        os.kill(os.getpid(), signal.SIGKILL)


def _policy(weather: dict[str, Any], stage: Stage) -> Policy | None:
    """Return what stands between a step's process and its disk."""
    if "kill" in weather:
        return Killer(**weather["kill"])
    if "power" in weather:
        return PowerCut(Disk(stage.data), stage.folder / "after", **weather["power"])
    if "full" in weather:
        return Full(weather["full"]["room"], weather["full"]["errno"])
    return ReadOnly() if "read_only" in weather else None


def _but_locks(policy: Policy) -> Policy:
    """Leave a lock's content out, which names the process and is no data."""

    def asked(call: Call) -> int:
        inner = isinstance(policy, PowerCut) or not call.path.endswith("/.lock")
        return policy(call) if inner else call.go()

    return asked


class Player:
    """Plays one story in its own folder."""

    def __init__(self, folder: Path, story: Story) -> None:
        self._stage = Stage(folder, story)
        self._stage.data.mkdir(parents=True)
        self._ledger = Ledger(self._stage.store, self._stage.calm)
        self._notes = Notes(folder / "notes")
        self._wall_s = BEGIN_S
        self._text = ""
        self.played = Played()

    def play(self) -> Played:
        """Play every step, and then what a person does to end the campaign in peace."""
        try:
            for number, step in enumerate(self._stage.story["steps"]):
                self._step(f"{number} {step['do']}", step)
            self._settle()
        except Wrong as wrong:
            self.played.wrong = wrong
            self.played.trace.append(str(wrong))
        self.played.errors = self._ledger.errors
        return self.played

    def _step(self, name: str, step: dict[str, Any]) -> str:
        weather, notes, stage = step.get("weather", {}), self._notes, self._stage
        free = weather.get("low", {}).get("free", 50_000_000_000)
        host = Host(self._wall_s + NIGHT_GAP_S, notes, free)

        policy = _policy(weather, stage)
        if step["do"] == "serve":
            import_module("tests.storm.page")  # here, once for all processes

        def work() -> None:
            signal.signal(signal.SIGINT, signal.default_int_handler)
            signal.signal(signal.SIGHUP, signal.SIG_DFL)  # nohup lets them be ignored
            host.install()
            try:
                Process(stage, host, notes).run(step)
            finally:
                notes.add(wall_s=host.wall_s, rig_s=host.rig_s, passed_s=host.passed_s)
            if isinstance(policy, PowerCut):
                policy.cut()

        try:
            end = live(work, stage.data, None if policy is None else _but_locks(policy))
        except TimeoutError as error:
            raise Wrong("waits are bounded", str(error)[:300]) from None
        if (stage.folder / "after").exists():
            shutil.rmtree(stage.data)
            (stage.folder / "after").rename(stage.data)
        found = notes.take()
        self._wall_s = next((n["wall_s"] for n in found if "wall_s" in n), host.wall_s)
        self.played.rig_s += sum(note.get("rig_s", 0.0) for note in found)
        self.played.passed_s += sum(note.get("passed_s", 0.0) for note in found)
        how = next((note["end"] for note in found if "end" in note and not end.killed), "killed")
        text = self._text = next((note["text"] for note in found if "text" in note), "")
        self.played.trace += [f"{name}: {json.dumps(note)}" for note in found]
        self._check_end(step, end, found, how, text)
        damaged = {*self._ledger.damaged}
        disturbing = {"lie", "suspend", "clock"}
        calm = not step.get("faults") and not any(
            disturbing & event.keys() for event in step.get("events", ())
        )
        self._ledger.look(found, how != "killed", calm)
        if step["do"] == "verify" and (TrialStore.exists(stage.store)):
            said = {note["found"] for note in found if "found" in note}
            if said != damaged:
                what = f"names {sorted(said)}, damaged are {sorted(damaged)}"
                raise Wrong("verify names what is damaged, and nothing else", what)
        state = self._ledger
        self.played.trace.append(f"{name}: {how}; {sorted(state.trials)}; {sorted(state.aside)}")
        self.played.trace += [f"{n} {_data(sums)}" for n, sums in sorted(state.trials.items())]
        return how

    def _check_end(
        self, step: dict[str, Any], end: End, notes: list[dict[str, Any]], how: str, text: str
    ) -> None:
        """An end needs a cause: a fault, a person or the weather."""
        for note in notes:
            if "wrong" in note:
                raise Wrong(note["wrong"], note["what"])
        weather = step.get("weather", {})
        events = step.get("events", ())
        lies = any("lie" in event for event in events)
        filled = any("fill" in event for event in events)
        late = any("suspend" in event for event in events)
        if how == "killed" and not ({"kill", "power"} & weather.keys() and end.killed):
            raise Wrong("errors are explained", f"ended with {end.code}: {end.said[-300:]}")
        why = {
            "done": True,
            "killed": True,
            "stopped": any("signal" in n or n.get("asked") == "stop" for n in notes),
            "CampaignStopped": bool(
                "low" in weather or filled or "paused" in text or "drifted" in text
            ),
            "WindowOver": "window_s" in step,
            "RigError": bool(step.get("faults") or weather or lies or late),
            "SafeState": bool(step.get("faults")),
            "ForceLimitError": bool(step.get("faults") or lies),
            "ArmFault": bool(step.get("faults") or lies),
            "GuardError": bool(step.get("faults") or lies),
            "StoreError": bool(weather or self._ledger.damaged) or _has(step, "disk_full"),
            "OSError": bool(weather),
            "RemoteError": bool(step.get("fails") or weather or self._ledger.spoilt),
            "RemoteDamaged": bool(step.get("short") or self._ledger.spoilt),
            # an earlier push was ended before its first trial
            "NoPushedStore": step["do"] == "pull",
            "RemoteMissing": step["do"] == "pull",
        }
        kind = "GuardError" if text.startswith("arm: ") else how
        if (kind == "GuardError" and not (step.get("faults") or lies)) or not why.get(kind, False):
            raise Wrong("errors are explained", f"{how}: {text[:300]}")

    def _settle(self) -> None:
        """Resume as the messages say; the campaign must come to its end, with nothing left over.

        Raises:
            Wrong: it does not.
        """
        self._step("end resume", {"do": "ask", "ask": "resume"})
        self._step("end verify", {"do": "verify", "quarantine": True})
        for _ in range(6):
            if (how := self._step("end night", {"do": "night"})) == "done":
                break
            if "drifted" in self._text:  # both are given again, as it says
                again = [n for n, trial in enumerate(self._stage.trials) if trial in self._text]
                self._step("end again", {"do": "ask", "ask": "again", "trials": again})
        if how != "done":
            raise Wrong("what a message advises works", f"a calm night ended: {how}")
        if (self._stage.folder / "one.h5").exists():  # what an import has left, it clears up
            self._step("end import", {"do": "import"})
        store = TrialStore.open(self._stage.store)
        for request in open_requests(store):
            raise Wrong("requests are carried out", f"request {request.number} is open")
        for problem in verify(store):
            what = f"{problem.path}: {problem.what}".replace(str(self._stage.folder), "")
            raise Wrong("nothing is damaged", what)
        campaign = store.campaign(NAME)
        if self._stage.calm.due_trials(campaign):
            raise Wrong("what a message advises works", "trials are left after a calm night")
        litter = [*self._stage.store.rglob("*.tmp"), *(campaign.folder / "incoming").iterdir()]
        for path in litter:
            raise Wrong("nothing is left over", str(path.relative_to(self._stage.store)))
        self._step("end push", {"do": "push", "fails": 0, "check": True})
        self._step("end pull", {"do": "pull", "fails": 0})
        pulled = self._stage.data / "pulled" / "campaigns" / NAME / "trials"
        there = {path.name: path for path in pulled.iterdir()} if pulled.is_dir() else {}
        for name, sums in self._ledger.trials.items():
            kept = self._ledger._sums(there[name]) if name in there else {}
            # a simulated trial that is retaken may have the same data: the same take to a pull
            whole = kept in self._ledger.takes.get(name, ())
            if not whole or kept["data.h5"] != sums["data.h5"]:
                raise Wrong("nothing committed is lost or changed", f"{name} in the pulled store")


def _has(step: dict[str, Any], kind: str) -> bool:
    return any(fault["kind"] == kind for fault in step.get("faults", ()))


def _data(sums: dict[str, str]) -> str:
    """A trial's files in one hash, without the one that names the process's host."""
    parts = [f"{name} {value}" for name, value in sums.items() if name != "provenance.json"]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]


def play(story: Story) -> Played:
    """Play a story in a folder that is deleted afterwards."""
    warm()
    with _folder() as folder:
        return Player(folder, story).play()


@cache
def warm() -> None:
    """Load code and kernels here, once, for all processes that are forked."""
    with _folder() as folder:
        data = run_request(folder / "warm", 2)
        collect(data)
        collect(
            replace(data, rig=load_rig_file(ROOT / "rigs" / "mock_force.yaml")[0], campaign="b")
        )
        remote = Remote(f"file://{folder / 'remote'}")
        push(TrialStore.open(data.store), remote)
        pull(remote, folder / "pulled")
    entries()
    modules_with_dates()
    gc.collect()
    gc.freeze()  # or each forked process copies what it counts


@contextmanager
def _folder() -> Iterator[Path]:
    memory = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
    folder = Path(tempfile.mkdtemp(prefix="storm-", dir=memory))
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def shrink(story: Story, wrong: Wrong, most: int = MOST_SHORTER) -> Story:
    """Return a shorter story that breaks the same invariant."""
    tried = 0
    found = True
    while found:
        found = False
        for other in shorter(story):
            tried += 1
            if tried > most:
                return story
            again = play(other).wrong
            if again is not None and again.invariant == wrong.invariant:
                story, found = other, True
                break
    return story
