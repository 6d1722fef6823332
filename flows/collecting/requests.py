"""Requests to a store from another terminal: pause, resume, stop, skip or retake a trial.

A running collection carries them out between two trials; without one, the requesting program
does so. Either holds the store's lock. A stop is signalled before anything is written. This
module loads little: the arm moves until `halt` has run.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path

from sliplab.analysis.campaigns import collected
from sliplab.flows.running import console, run_records, stopping
from sliplab.protocols import InputError
from sliplab.rigs.core.capabilities import RigError
from sliplab.storage import process
from sliplab.storage.errors import translated_disk_errors
from sliplab.storage.interrupts import uninterrupted
from sliplab.storage.streams import Json
from sliplab.storage.trials import control
from sliplab.storage.trials.control import ControlRequest, Kind
from sliplab.storage.trials.journal import signature
from sliplab.storage.trials.lock import STORE_LOCK, Locked, current_holder, exclusive
from sliplab.storage.trials.migrate import migrate
from sliplab.storage.trials.store import TrialStore

POLL_S = 0.2
MOVING = ("collect", "chain", "study")
"""Names of the flows that move the arm."""


class CampaignStopped(RuntimeError):
    """A campaign ended between two trials without a fault; the message says why, and what to do."""


@contextmanager
def store_lock(store: TrialStore, *, brief: bool = False, collects: str = "") -> Iterator[None]:
    """Hold the store's lock for writing while the block runs; the store has the newest format then.

    Args:
        brief: held for a moment only; a collection that begins in the meantime waits for it.
        collects: the campaign that trials are taken for; `sliplab stop` stops nothing else.

    Raises:
        Locked: another process holds it.
        StoreError: its disk is full, read-only or failing.
    """
    about = {"collects": collects} if collects else None
    with (
        translated_disk_errors(store.folder, RigError),
        exclusive(store.folder / STORE_LOCK, f"the store {store.folder}", brief=brief, about=about),
    ):
        migrate(store)
        yield


@uninterrupted
def carry_out(store: TrialStore, running: bool = False) -> list[tuple[ControlRequest, Json]]:
    """Carry out all open requests; the caller holds the store's lock.

    Args:
        running: True if the caller is a collection, between two trials.

    Returns:
        The requests in order, each with its answer.
    """
    done = []
    for request in control.open_requests(store):
        did: Json
        if request.kind in {"pause", "resume"}:
            now = control.paused(store)
            did = {"paused": now is not None, "running": running}
        elif request.kind == "stop":
            did = {"stopped": running, "running": running}
        else:
            change = control.skip if request.kind == "skip" else control.again
            where = store.campaign(request.campaign)
            if where.begun:
                trials = change(where, request.trials, request.by)
            else:
                trials = dict.fromkeys(request.trials, "no such campaign")
            did = {"trials": trials, "running": running}
        done.append((request, control.answer(store, request, did)))
    return done


def end_if_stopped(store: TrialStore, since: int | None) -> None:
    """End a run that was stopped while it started or waited: no signal can reach it then.

    Args:
        since: `RunRequest.since`.

    Raises:
        KeyboardInterrupt: there is a newer request to stop.
    """
    if since is not None and (request := control.stop_after(store, since)) is not None:
        with suppress(OSError):  # a full disk must not keep the run going
            control.answer(store, request, {"stopped": True, "running": False})
        console.say(f"ended before anything moved: {request}")
        stopping.stop()


def refuse_paused(store: TrialStore) -> None:
    """Refuse to begin a collection whose store is paused; it would pause at once.

    Raises:
        CampaignStopped: the store is paused.
    """
    if request := control.paused(store):
        raise CampaignStopped(
            f"{store.folder} is paused ({request}): `sliplab resume {store.folder}`, then run the "
            "same command"
        )


def holder_of(folder: Path) -> Json | None:
    """Return the holder of the lock of the store in `folder`, None if it is not locked."""
    # by reading alone: a collection must be stopped whose store cannot be written to any more
    holder = current_holder(folder / STORE_LOCK)
    if holder and not holder.get("brief"):
        return holder
    try:
        with exclusive(folder / STORE_LOCK, "the store", brief=True):
            return None
    except Locked as error:
        return error.holder
    except OSError:
        return holder


def halt(folder: Path) -> tuple[Json | None, bool]:
    """Signal the collection that runs on the store in `folder` to stop.

    Returns:
        Holder of the store's lock, None if it is not locked; and whether the signal reached a
        collection. It does not reach another host or user, and is only sent to a collection.
    """
    holder = holder_of(folder)
    if holder is None or not holder.get("collects"):
        return holder, False
    return holder, process.send(holder, signal.SIGTERM)


@dataclass(frozen=True)
class RequestOutcome:
    """The outcome of a request.

    Attributes:
        answer: when it was carried out, and what was done; None while it is open.
        holder: the program that held the store when the request was made, if any.
    """

    request: ControlRequest
    answer: Json | None
    holder: Json | None

    def as_json(self) -> Json:
        """Return it as one JSON object."""
        return {
            "request": self.request.number,
            "what": self.request.kind,
            "who": self.request.who,
            "when": self.request.when,
            "why": self.request.why,
            "campaign": self.request.campaign or None,
            "done": self.answer is not None,
            "did": None if self.answer is None else self.answer["did"],
            "holder": self.holder,
        }


def ask(
    store: TrialStore,
    kind: Kind,
    *,
    who: str = "",
    why: str = "",
    campaign: str = "",
    trials: tuple[str, ...] = (),
    limit_s: float = 600.0,
) -> RequestOutcome:
    """Make a request, and wait until a running collection or this program has carried it out.

    Args:
        limit_s: how long to wait for the boundary between two trials, s.
    """
    made = control.ask(store, kind, who=who, why=why, campaign=campaign, trials=trials)
    holder = _carry_out_if_free(store)
    if control.answered(store, made) is None and limit_s > 0:
        _wait(store, "waiting for the current trial to end (s)", limit_s, made)
    return RequestOutcome(made, control.answered(store, made), holder)


def stop_collection(
    store: TrialStore, *, who: str = "", why: str = "", limit_s: float = 60.0
) -> RequestOutcome:
    """Stop the collection that runs on the store, the arm first, and wait until it has ended.

    The signal goes out before anything is written. A collection that no signal reaches from here,
    because it runs on another machine, stops before its next trial.
    """
    return note_stop(store, *halt(store.folder), who=who, why=why, limit_s=limit_s)


def note_stop(
    store: TrialStore,
    holder: Json | None,
    reached: bool,
    *,
    who: str = "",
    why: str = "",
    limit_s: float = 60.0,
) -> RequestOutcome:
    """Record a stop whose signal `halt` has sent, and wait until the collection has ended.

    Raises:
        OSError: it cannot be recorded, and no signal was sent: what may start now is not stopped.
    """
    if holder is not None and not holder.get("collects"):
        console.say(f"{process.named(holder)}: is not collecting and was not signalled")
        holder = None
    if holder is not None:
        how = (
            "was signalled to stop"
            if reached
            else "cannot be signalled; it stops before its next trial"
        )
        console.say(f"{process.named(holder)}: {how}")
    try:
        made = control.ask(store, "stop", who=who, why=why)
    except OSError as error:
        if not reached:
            raise
        console.say(f"signalled, but it could not be logged: {error}")
        unlogged: Json = {"kind": "stop", **signature(who, why)}
        made = ControlRequest(number=0, **unlogged)
    if holder is not None and limit_s > 0:
        _wait(store, "waiting for it to stop (s)", limit_s, None)
    left = holder_of(store.folder)
    ended = holder is not None and (left is None or left.get("pid") != holder["pid"])
    did = {"stopped": True, "running": True}
    if not made.number:
        return RequestOutcome(made, {"did": did} if ended else None, holder)
    if ended:
        control.answer(store, made, did)
    if waiting := [] if holder is not None else _waiting_runs(store):
        console.say(f"{', '.join(waiting)}: ends before it moves the arm")
        control.answer(store, made, {"stopped": True, "running": False, "waiting": waiting})
    _carry_out_if_free(store)
    return RequestOutcome(made, control.answered(store, made), holder)


def _waiting_runs(store: TrialStore) -> list[str]:
    """Return the runs of this machine that may yet move the arm, where none collects."""
    from sliplab.flows.collecting.live_feed import LiveFolder

    begun = [
        run
        for run in run_records.open_runs(store.folder)
        if run["flow"] in MOVING and process.is_here(run.get("process", {}))
    ]
    names = [
        f"{' of '.join(filter(None, [run['flow'], run.get('deployment')]))}, since {run['began']}"
        for run in begun
    ]
    # a process that starts has no record yet, and what waits for its turn has none at all
    recorded = any(run.get("deployment") for run in begun)
    return names + [
        f"{run['flow']}, due {run['due']}"
        for run in LiveFolder(store.folder).waiting()
        if not (run["begun"] and recorded)
    ]


def known_trials(
    store: TrialStore, names: list[str] | None, trials: list[str]
) -> dict[str, tuple[str, ...]]:
    """Return the trials by campaign.

    Raises:
        InputError: a trial is in no campaign's plan, or in several.
        StoreError: the store holds no campaign.
    """
    # imported trials are neither skipped nor taken again unless they are named
    plans = {
        item.name: {trial.id for trial in item.plan}
        for item in collected(store, names)
        if names or item.recorded is None
    }
    found: dict[str, list[str]] = {}
    for trial in dict.fromkeys(trials):
        where = [name for name, ids in plans.items() if trial in ids]
        if len(where) > 1:
            raise InputError(
                "--campaign", "", None, f"is required: {trial} is in {', '.join(where)}"
            )
        if not where:
            near = get_close_matches(trial, [i for ids in plans.values() for i in ids], n=1)
            hint = f"; did you mean '{near[0]}'?" if near else ""
            raise InputError(
                "TRIAL", "", trial, f"is in none of the plans of {', '.join(plans)}{hint}"
            )
        found.setdefault(where[0], []).append(trial)
    return {name: tuple(ids) for name, ids in found.items()}


def _carry_out_if_free(store: TrialStore) -> Json | None:
    """Carry out open requests if the store is not locked; else return the holder of its lock."""
    with ExitStack() as lock:
        try:
            lock.enter_context(store_lock(store, brief=True))
        except Locked as error:
            return error.holder
        carry_out(store)
    return None


def _wait(store: TrialStore, title: str, limit_s: float, made: ControlRequest | None) -> None:
    """Wait until the request is answered or the store's lock is free; `limit_s` at most.

    Raises:
        KeyboardInterrupt: the user stopped waiting; the request remains open.
    """
    begin = time.monotonic()
    with console.bar(title, round(limit_s)) as bar:
        shown = 0.0
        while (gone := time.monotonic() - begin) < limit_s:
            if made is None:
                if holder_of(store.folder) is None:
                    return
            elif control.answered(store, made) is not None or _carry_out_if_free(store) is None:
                return
            stopping.wait(POLL_S)
            bar.advance(gone - shown)
            shown = gone
