"""What the process of one step does: a night at the rig, a request, a push, and so on."""

from __future__ import annotations

import math
import os
import shutil
import signal
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from sliplab.flows.cli.errors import failure
from sliplab.flows.collecting import supervisor as supervising
from sliplab.flows.collecting.requests import ask as ask_for
from sliplab.flows.collecting.requests import (
    carry_out,
    refuse_paused,
    store_lock,
)
from sliplab.flows.collecting.session import open_session, refresh
from sliplab.flows.collecting.supervisor import SessionListener, WindowOver
from sliplab.flows.detect import detect
from sliplab.flows.detecting.request import make_detect_request
from sliplab.flows.detecting.sources import named_source
from sliplab.flows.exports import ExportRequest, export
from sliplab.flows.imports import import_data
from sliplab.flows.log import add_note
from sliplab.flows.planning.run_request import RunRequest, make_request
from sliplab.flows.running import stopping
from sliplab.flows.status import StatusReader
from sliplab.flows.verify import verify
from sliplab.plugins.record.recorder import record
from sliplab.plugins.record.sources import push as pushed
from sliplab.protocols import PlannedTrial
from sliplab.protocols.errors import InputError
from sliplab.protocols.program import ACTING, Move, Position
from sliplab.rigs.build import build_rig
from sliplab.rigs.core import force_watch
from sliplab.rigs.core.guard import GuardError
from sliplab.rigs.core.host_clock import STEP_S
from sliplab.rigs.core.rig import StopRequested
from sliplab.rigs.rig_file import rig_hash
from sliplab.storage.errors import StoreError
from sliplab.storage.remote import pull as pulling
from sliplab.storage.remote.objects import Remote, RemoteError
from sliplab.storage.remote.pull import pull
from sliplab.storage.remote.push import PushOptions, push
from sliplab.storage.schema.trial import TrialRecord
from sliplab.storage.trials import control
from sliplab.storage.trials.checksums import read_sums
from sliplab.storage.trials.lock import Locked
from sliplab.storage.trials.store import TrialStore
from sliplab.storage.trials.verify import verify_trial
from tests.patching import put
from tests.storm.alerts import watch
from tests.storm.virtual import Host, Notes
from tests.storm.witness import Witness

NAME = "storm"
"""Of the campaign."""
NIGHT_S = 4 * 3600.0
"""Bound of a night of some trials, pauses of 12 hours apart."""
LATE_S = 0.15
"""Time after an alarm within which its motion may end before it is answered."""


@dataclass(frozen=True)
class Stage:
    """Folders of one story.

    Attributes:
        folder: of it all; its `data` holds what the weather befalls.
    """

    folder: Path
    story: dict[str, Any]

    @property
    def data(self) -> Path:
        """Where the store, its copy at a URL, and one that was pulled are."""
        return self.folder / "data"

    @property
    def store(self) -> Path:
        """The store."""
        return self.data / "store"

    @cached_property
    def calm(self) -> RunRequest:
        """The request to collect on a rig without faults; read once, for all processes."""
        request = self.request([])
        rig_hash(request.rig_text)  # keeps the text's nodes for all processes, too
        return request

    @cached_property
    def trials(self) -> tuple[str, ...]:
        """Ids of the planned trials, in their order."""
        return tuple(trial.id for trial in self.calm.plan)

    def request(
        self, faults: list[dict[str, Any]], most: int | None = None, until: float | None = None
    ) -> RunRequest:
        """Return the request to collect on a rig with these faults."""
        if not faults and "calm" in vars(self):
            since = control.last_number(TrialStore(self.store))
            return replace(self.calm, most=most, until=until, since=since)
        return make_request(*self.write(faults), self.store, most=most, until=until)

    def write(self, faults: list[dict[str, Any]]) -> list[Path]:
        """Write the files of the protocol and of a rig with these faults; return their paths."""
        rig = {**self.story["rig"]}
        rig["mock"] = {**rig["mock"], "faults": faults}
        files = {"protocol.yaml": self.story["protocol"], "rig.yaml": rig}
        for name, content in files.items():
            (self.folder / name).write_text(yaml.dump(content, Dumper=yaml.CSafeDumper))
        return [self.folder / name for name in files]


@dataclass(frozen=True)
class Process:
    """The process that carries out a step."""

    stage: Stage
    host: Host
    notes: Notes

    def run(self, step: dict[str, Any]) -> None:
        """Carry out a step as a command does, and note how it ended."""
        handles, threads = _handles(), threading.active_count()
        try:
            with stopping.signals():
                DO[step["do"]](self, step)
            self.notes.add(end="done")
        except (KeyboardInterrupt, StopRequested):
            self.notes.add(end="stopped")
        except WindowOver:
            self.notes.add(end="WindowOver")
        except Exception as error:
            failed = failure(error)
            if failed.trace:
                self.notes.add(wrong="errors are explained", what=self.scrubbed(repr(error)))
                raise
            self.notes.add(end=type(error).__name__, text=self.scrubbed(failed.message))
        for thread in threading.enumerate():
            if thread is not threading.current_thread():
                thread.join(0.5)  # a progress display's ends a little later
        left = _handles() - handles
        if left or threading.active_count() > threads:
            names = sorted(thread.name for thread in threading.enumerate())
            what = self.scrubbed(f"{sorted(left)}, threads {names}")
            self.notes.add(wrong="nothing is left open", what=what)

    def scrubbed(self, text: str) -> str:
        """Return a text without what differs between two runs of one story."""
        return text.replace(str(self.stage.folder.resolve()), "").replace(
            str(self.stage.folder), ""
        )


def _handles() -> set[str]:
    found = set()
    for name in os.listdir("/proc/self/fd"):
        try:
            found.add(f"{name} {os.readlink(f'/proc/self/fd/{name}')}")
        except OSError:
            continue  # that of the listing
    return found


# -- a night -------------------------------------------------------------------------------------


class _Listener(SessionListener):
    def __init__(self, notes: Notes, witness: Witness) -> None:
        self._notes, self._witness = notes, witness

    def on_trial_done(self, trial: PlannedTrial, outcome: str) -> None:
        self._notes.add(trial=trial.id, outcome=outcome)

    def on_paused(self, why: str) -> None:
        self._notes.add(paused=why.partition(" (")[0])

    def on_resumed(self, seconds: float) -> None:
        self._notes.add(resumed_s=seconds)
        self._witness.resumed = True


def night(process: Process, step: dict[str, Any]) -> None:
    """Collect what is missing, while faults, people and weather have their way."""
    stage, host, notes = process.stage, process.host, process.notes
    until = host.wall_s + step["window_s"] if "window_s" in step else None
    request = stage.request(step.get("faults", []), step.get("most"), until)
    planned_s = sum(request.plan.seconds(trial) for trial in request.plan)
    host.most_s = NIGHT_S + 10 * planned_s + 10 * supervising.PAUSE_LIMIT_S
    # what costs most is done less often: looking at a pause of 12 hours, and at simulated forces,
    # though not so rarely that `StallTimer` leaves time out
    supervising.POLL_S, force_watch.POLL_S = 300.0, STEP_S
    disturbed = any({"lie", "suspend"} & event.keys() for event in step.get("events", ()))
    witness = Witness(request.rig, host, notes, calm=not (step.get("faults") or disturbed))
    witness.install()
    host.events = [
        (event["at_s"], partial(happen, process, event, witness))
        for event in step.get("events", [])
    ]
    store = TrialStore.create(stage.store)
    refuse_paused(store)
    if control.open_requests(store):
        with store_lock(store):
            carry_out(store)
    if not request.due_trials(store.campaign(request.campaign)):
        refresh(request)
        return
    began_s = host.passed_s
    with open_session(request, _Listener(notes, witness)) as session, stopping.signals():
        witness.watch(session.supervisor, request.plan)
        session.supervisor.wait = partial(_wait, host)
        session.supervisor.clock = lambda: host.wall_s
        session.supervisor.passed_s = lambda: host.passed_s - began_s
        rig = session.collector.rig
        close = rig.close

        def closing() -> None:
            close()
            _rival(process, witness)  # until here the rig is this program's

        put(rig, "close", closing)
        rig.connect()
        trials = session.trials
        while trials:
            session.collector.take(trials)
            trials = session.more() if step.get("most") is None else []
        left = request.due_trials(store.campaign(request.campaign))
        if left and step.get("most") is None and not control.open_requests(store):
            witness.wrong("a night takes all that is due", f"{[each.id for each in left]} are left")


def _wait(host: Host, seconds: float) -> None:
    stopping.check()
    host.wait(seconds)
    stopping.check()


def happen(process: Process, event: dict[str, Any], witness: Witness) -> None:
    """Let something happen in the middle of a night."""
    if "signal" in event:
        witness.stop_asked()
        process.notes.add(signal=event["signal"])
        if event["signal"] == "dropped":  # its exception was lost in a destructor
            stopping.request()
        else:
            # to this thread: another one may get a process's signal, and later
            signal.raise_signal(getattr(signal, event["signal"]))
    elif "clock" in event:
        process.host.wall_s += event["clock"]
    elif "fill" in event:
        process.host.free = event["fill"]
        process.notes.add(filled=event["fill"])
    elif "suspend" in event:
        witness.suspend(event["suspend"])
    elif "lie" in event:
        witness.lie.begin(event["lie"], event["seconds"], event["axis"])
    elif "look" in event:
        _look(process, witness)
    elif "rival" in event:
        _rival(process, witness)
    else:
        try:
            if "log" in event:
                _log(process, event["log"])
            else:
                _file_request(process, event)
        except (OSError, StoreError, InputError) as error:
            process.notes.add(refused=type(error).__name__)


def _rival(process: Process, witness: Witness) -> None:
    """Let a second program try to get the store."""
    try:
        with store_lock(TrialStore.open(process.stage.store)):
            witness.wrong("one program at a time", "a second one got the store's lock")
    except Locked:
        pass


def _look(process: Process, witness: Witness) -> None:
    """Hold the status in the middle of a night against the disk."""
    store = TrialStore.open(process.stage.store)
    found = StatusReader(store).read()
    says = found.collects, [(one.campaign, one.committed) for one in found.campaigns]
    there = len([*store.campaign(NAME).folders("trials")])
    if says[0] != NAME or (NAME, there) not in says[1]:
        witness.wrong("a status is true", f"says {says} in a night, with {there} trials")


def _file_request(process: Process, wanted: dict[str, Any]) -> None:
    store, kind = TrialStore.open(process.stage.store), wanted["ask"]
    ids = _ids(process, wanted)
    if ids and not store.campaign(NAME).begun:
        return
    process.notes.add(asks=kind, trials=ids)  # it may be killed before the request has a number
    made = control.ask(store, kind, who="anna", campaign=NAME if ids else "", trials=ids)
    process.notes.add(asked=kind, number=made.number, trials=ids)


def _ids(process: Process, wanted: dict[str, Any]) -> tuple[str, ...]:
    every = process.stage.trials
    return tuple(every[index % len(every)] for index in wanted.get("trials", ()))


# -- other steps ---------------------------------------------------------------------------------


def ask(process: Process, step: dict[str, Any]) -> None:
    """Ask for something while no collection runs."""
    if not TrialStore.exists(process.stage.store):
        return
    store, ids = TrialStore.open(process.stage.store), _ids(process, step)
    if ids and not store.campaign(NAME).begun:
        return
    process.notes.add(asks=step["ask"], trials=ids)
    campaign = NAME if ids else ""
    with stopping.signals():
        done = ask_for(store, step["ask"], who="ben", campaign=campaign, trials=ids, limit_s=0)
    process.notes.add(asked=step["ask"], number=done.request.number, trials=ids)
    if done.answer is None:
        process.notes.add(wrong="requests are carried out", what=str(done.as_json()["what"]))


def log(process: Process, step: dict[str, Any]) -> None:
    """Log a skin, or a note."""
    if TrialStore.exists(process.stage.store):
        _log(process, step)


def _log(process: Process, step: dict[str, Any]) -> None:
    """Log a note, or a skin."""
    store = TrialStore.open(process.stage.store)
    context = {"skin": step["skin"]} if "skin" in step else None
    text = f"note at {process.host.wall_s:.0f}"
    if context and not store.campaign(NAME).begun:
        return
    about = {"at_s": process.host.wall_s, **(context or {})}
    process.notes.add(logs=text, **about)
    add_note(store, text, who="anna", context=context)
    process.notes.add(logged=text, **about)


def check(process: Process, step: dict[str, Any]) -> None:
    """Verify the store: what is damaged is named, and set aside if that is asked for."""
    if not TrialStore.exists(process.stage.store):
        return
    with stopping.signals():
        found = verify(str(process.stage.store), quarantine=step.get("quarantine", False))
    for problem in found["problems"]:
        if problem.kind == "damaged":
            what = process.scrubbed(f"{problem.path}: {problem.what}")
            process.notes.add(found=problem.trial, what=what)
    process.notes.add(quarantined=found["quarantined"])


def damage(process: Process, step: dict[str, Any]) -> None:
    """A disk loses the end of a file, or changes a byte of it."""
    data, where, how = process.stage.data, step.get("where", "trials"), step.get("how", "cut")
    if where == "remote":
        files = sorted((data / "remote" / "campaigns" / NAME / "objects").glob("*"))
        files = [path for path in files if path.stat().st_size > 1000]
    else:
        files = sorted((process.stage.store / "campaigns" / NAME / where).glob("*/data.h5"))
    if not files:
        return
    path = files[step["trial"] % len(files)]
    if where == "trials":
        process.notes.add(damaged=path.parent.name, how=how)
    elif where == "remote":
        process.notes.add(spoilt=path.name)
    path.chmod(0o644)
    if where == "incoming" and not _has_sums(path.parent):
        how = "cut"  # before a trial has checksums, a changed byte cannot be seen
    if how == "cut":
        os.truncate(path, 1000)
        return
    with path.open("r+b") as file:
        file.seek(-300, os.SEEK_END)
        byte = file.read(1)[0]
        file.seek(-1, os.SEEK_CUR)
        file.write(bytes([(byte + 85) % 256]))  # twice is not as before


def _has_sums(folder: Path) -> bool:
    try:
        return bool(read_sums(folder))
    except (OSError, ValueError):
        return False


def bring(process: Process, step: dict[str, Any]) -> None:
    """Import a recording of another program: here a copy of a trial's own data."""
    file = process.stage.folder / "one.h5"
    folder = process.stage.store / "campaigns" / NAME / "trials"
    if not file.exists():
        trials = sorted(folder.iterdir()) if folder.is_dir() else []
        # not every rig has an event camera, and another step may have damaged a trial
        trials = [each for each in trials if TrialRecord.load(each / "record.json").counts.events]
        trials = [each for each in trials if not verify_trial(each)]
        if not trials:
            return
        shutil.copy(trials[0] / "data.h5", file)
    import_data(file, process.stage.store, name="copied", simulated=True)
    process.notes.add(kept="copied/one")


def take_down(process: Process, step: dict[str, Any]) -> None:
    """Record numbers beside a program of its own, which may fail in the middle of a trial."""
    first = step["first"]
    with record(
        [pushed("grip", {"width": "mm"})], process.stage.store, "recorded", simulated=True
    ) as recorder:
        for rows in step["rows"]:
            try:
                with recorder.trial(object="mug") as trial:
                    for place in range(first, first + rows):
                        trial.push("grip", None, float(place))
                    trial.mark("slip")
                    if step["fails"]:
                        raise LookupError("the program fails")
            except LookupError:
                pass
            process.notes.add(kept=f"recorded/{trial.id}", first=first, rows=rows)


def carry(process: Process, step: dict[str, Any]) -> None:
    """Export a trial for another program, import that, and compare the events."""
    stage, form = process.stage, step["form"]
    if not TrialStore.exists(stage.store):
        return
    store = TrialStore.open(stage.store)
    names = sorted(store.campaign(NAME).committed())
    if not names:
        return
    name, out = names[step["trial"] % len(names)], stage.folder / "exported"
    shutil.rmtree(out, ignore_errors=True)
    export(ExportRequest(str(stage.store), name, form, out, {"campaign": [NAME]}))
    (file,) = out.glob(f"{name}.*")
    back = f"back{len(store.campaigns())}"
    import_data(file, stage.store, name=back, simulated=True)
    (known,) = store.campaign(back).committed()
    one, other = (
        store.campaign(each).recording(trial).events()
        for each, trial in ((NAME, name), (back, known))
    )
    same = all(np.array_equal(getattr(one, part), getattr(other, part)) for part in "xyp")
    if not same or not np.array_equal(np.diff(one.t_us), np.diff(other.t_us)):
        process.notes.add(wrong="what is exported is whole", what=f"{name} as {form}")
    process.notes.add(kept=f"{back}/{known}")


def react(process: Process, step: dict[str, Any]) -> None:
    """Let a detector listen in a trial's motion, at whose alarm a reflex cuts it short."""
    stage = process.stage
    protocol, rig = stage.write(step["faults"])
    request = stage.request(step["faults"])
    witness = Witness(request.rig, process.host, process.notes, calm=not step["faults"])
    witness.install()
    witness.watch_reflexes()
    process.host.most_s = NIGHT_S
    measured = [each.id for each in request.plan if each.role == "measured"]
    wanted = make_detect_request(
        rig,
        None,
        protocol=protocol,
        trial=measured[step["trial"] % len(measured)].rpartition(",r=")[0],
        detector=named_source("rate", step["level"], None),
        reflex=step["reflex"],
        poll_s=0.05,
    )
    done = detect(wanted, show=False)
    alarm, reflex = done["onsets"]["incipient"], done["reflex"]
    assert reflex is not None
    process.notes.add(reflex=reflex["done"], phase=reflex.get("phase"))
    if alarm is None or alarm["phase"] not in ACTING or reflex["done"]:
        return
    # a motion that ends before the decision is made has nothing to cut short
    window_s = (alarm["end_us"] - alarm["start_us"]) / 1e6
    if (done["windows"] - alarm["window"]) * window_s > LATE_S:
        process.notes.add(wrong="an alarm in motion is answered", what=f"at {alarm['phase']}")


def probe(process: Process, step: dict[str, Any]) -> None:
    """Send the arm to places within and beyond the limits: only the former are reached."""
    file = process.stage.calm.rig
    limits, at = file.limits, Position(0.0, 0.0, -5.0)
    witness = Witness(file, process.host, process.notes, calm=True)
    witness.install()
    rig = build_rig(file, stopping.requested)
    try:
        rig.connect()
        with rig.safely(at):
            rig.begin_trial(at, 0)
            for deeper_mm, farther_mm, angle, share in step["places"]:
                depth_mm = float(limits.depth) + deeper_mm
                reach_mm = float(limits.reach) + farther_mm
                to = Position(reach_mm * math.cos(angle), reach_mm * math.sin(angle), depth_mm)
                allowed = deeper_mm < 0 and farther_mm < 0 and 0 < share <= 1
                try:
                    rig.move(Move("probe", to, share * float(limits.speed)), at)
                except GuardError:
                    reached = False
                else:
                    reached, at = True, to
                if reached != allowed:
                    witness.wrong("within limits", f"{deeper_mm, farther_mm, share}: {reached}")
    finally:
        rig.close()


def _remote(process: Process, step: dict[str, Any]) -> Remote:
    """Return the URL of the copy, which fails at every n-th object, or reads part of it."""
    fails, short = step["fails"], step.get("short", False)
    folder = process.stage.data / "remote"
    remote, seen = Remote(f"file://{folder}"), [0]

    def failing(real: Callable[..., Any]) -> Callable[..., Any]:
        def call(*given: Any, **named: Any) -> Any:
            seen[0] += 1
            if not fails or seen[0] % fails:
                return real(*given, **named)
            if not short:
                raise OSError(5, "the network is gone")
            found = real(*given, **named)
            return found[: len(found) // 2]

        return call

    calls = ("cat_file",) if short else ("info", "open", "ls", "cat", "pipe_file", "rm_file")
    for name in calls:
        setattr(remote._fs, name, failing(getattr(remote._fs, name)))
    real_put = remote.put

    def sent(key: str, source: bytes | Path) -> None:
        seen[0] += 1
        if fails and not short and seen[0] % fails == 0:
            raise RemoteError("the network is gone")
        real_put(key, source)

    put(remote, "put", sent)
    return remote


def send(process: Process, step: dict[str, Any]) -> None:
    """Push the store."""
    if TrialStore.exists(process.stage.store):
        options = PushOptions(check=step.get("check", False))
        remote = _remote(process, step)
        done = push(TrialStore.open(process.stage.store), remote, options=options)
        process.notes.add(pushed=done.pushed, problems=len(done.problems), check=options.check)


def fetch(process: Process, step: dict[str, Any]) -> None:
    """Pull what was pushed into another store."""
    if (process.stage.data / "remote").exists():
        pulling._AT_ONCE = 1  # one after another, in an order that the seed decides
        done = pull(_remote(process, step), process.stage.data / "pulled")
        process.notes.add(pulled=done.pulled, problems=len(done.problems))


def serve(process: Process, step: dict[str, Any]) -> None:
    """Runs are begun from a page, which gets lost and comes back."""
    from tests.storm.page import serve  # loads Prefect

    if TrialStore.exists(process.stage.store):
        serve(process.stage.store, process.notes, step["seed"], step["lost"])


def alert(process: Process, step: dict[str, Any]) -> None:
    """Tell people what happens to the store."""
    if TrialStore.exists(process.stage.store):
        store = TrialStore.open(process.stage.store)
        watch(store, process.host, process.notes, step["seed"], step["lost"])


DO: dict[str, Callable[[Process, dict[str, Any]], None]] = {
    "night": night,
    "ask": ask,
    "log": log,
    "verify": check,
    "damage": damage,
    "import": bring,
    "push": send,
    "pull": fetch,
    "serve": serve,
    "record": take_down,
    "carry": carry,
    "react": react,
    "probe": probe,
    "alert": alert,
}
"""What each kind of step does."""
