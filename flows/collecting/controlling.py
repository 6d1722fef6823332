"""Asking a store for something from another terminal, and waiting until it is done."""

from __future__ import annotations

import time
from contextlib import ExitStack
from dataclasses import dataclass
from difflib import get_close_matches

from sliplab.analysis.campaigns import collected
from sliplab.flows.collecting.halting import halt, holder_of
from sliplab.flows.collecting.run_session import owned
from sliplab.flows.collecting.trial_gate import carry_out
from sliplab.flows.running import console, stopping
from sliplab.protocols import InputError
from sliplab.storage import process
from sliplab.storage.streams import Json
from sliplab.storage.trials import control
from sliplab.storage.trials.control import Kind, Request
from sliplab.storage.trials.lock import Locked
from sliplab.storage.trials.store import Store

LOOK_S = 0.2


@dataclass(frozen=True)
class Outcome:
    """What came of a request.

    Attributes:
        answer: when it was carried out, and what was done; None if it is still open.
        holder: the program that had the store when it was asked, None if nobody had.
    """

    request: Request
    answer: Json | None
    holder: Json | None

    def as_json(self) -> Json:
        """One JSON object."""
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


def request(
    store: Store,
    kind: Kind,
    *,
    who: str = "",
    why: str = "",
    campaign: str = "",
    trials: tuple[str, ...] = (),
    limit_s: float = 600.0,
) -> Outcome:
    """Ask, and wait until a running collection, or else this program, has carried it out.

    Args:
        limit_s: how long to wait for the boundary between two trials, s.
    """
    made = control.ask(store, kind, who=who, why=why, campaign=campaign, trials=trials)
    holder = _settle(store)
    if control.answered(store, made) is None and limit_s > 0:
        _wait(store, "waiting for the end of the trial (s)", limit_s, made)
    return Outcome(made, control.answered(store, made), holder)


def stop(store: Store, *, who: str = "", why: str = "", limit_s: float = 60.0) -> Outcome:
    """Stop what collects into the store now, the arm first, and wait until it has ended.

    The signal goes out before anything is written. A collection that no signal reaches from here,
    because it runs on another machine, stops before its next trial.
    """
    return note_stop(store, *halt(store.folder), who=who, why=why, limit_s=limit_s)


def note_stop(
    store: Store,
    holder: Json | None,
    reached: bool,
    *,
    who: str = "",
    why: str = "",
    limit_s: float = 60.0,
) -> Outcome:
    """What `stop` does once `halt` has sent the signal."""
    if holder is not None and not holder.get("collects"):
        console.say(f"{process.named(holder)}: collects nothing and was left alone")
        holder = None
    if holder is not None:
        how = "was told to stop" if reached else "no signal reaches it; it stops at its next trial"
        console.say(f"{process.named(holder)}: {how}")
    made = control.ask(store, "stop", who=who, why=why)
    if holder is not None and limit_s > 0:
        _wait(store, "waiting until it has stopped (s)", limit_s, None)
    left = holder_of(store.folder)
    if holder is not None and (left is None or left.get("pid") != holder["pid"]):
        control.answer(store, made, {"stopped": True, "running": True})
    _settle(store)
    return Outcome(made, control.answered(store, made), holder)


def known_trials(
    store: Store, names: list[str] | None, trials: list[str]
) -> dict[str, tuple[str, ...]]:
    """The trials by campaign.

    Raises:
        InputError: one that no campaign's plan has, or that several have.
        StoreError: the store holds no campaign.
    """
    plans = {item.name: {trial.id for trial in item.plan} for item in collected(store, names)}
    found: dict[str, list[str]] = {}
    for trial in dict.fromkeys(trials):
        where = [name for name, ids in plans.items() if trial in ids]
        if len(where) > 1:
            raise InputError("--campaign", "", None, f"is needed: {trial} is in {', '.join(where)}")
        if not where:
            near = get_close_matches(trial, [i for ids in plans.values() for i in ids], n=1)
            hint = f"; did you mean '{near[0]}'?" if near else ""
            raise InputError("TRIAL", "", trial, f"is in no plan of {', '.join(plans)}{hint}")
        found.setdefault(where[0], []).append(trial)
    return {name: tuple(ids) for name, ids in found.items()}


def _settle(store: Store) -> Json | None:
    """Carry out what is open if nobody has the store; else say who has."""
    with ExitStack() as lock:
        try:
            lock.enter_context(owned(store, brief=True))
        except Locked as error:
            return error.holder
        carry_out(store)
    return None


def _wait(store: Store, title: str, limit_s: float, made: Request | None) -> None:
    """Until the request is answered, or nobody has the store any more; `limit_s` at most.

    Raises:
        KeyboardInterrupt: somebody does not want to wait any longer; the request stands.
    """
    begin = time.monotonic()
    with console.bar(title, round(limit_s)) as bar:
        shown = 0.0
        while (gone := time.monotonic() - begin) < limit_s:
            if made is None:
                if holder_of(store.folder) is None:
                    return
            elif control.answered(store, made) is not None or _settle(store) is None:
                return
            stopping.wait(LOOK_S)
            bar.advance(gone - shown)
            shown = gone
