"""Verification of a store or of a pushed one, for the command and the Python interface."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import NotRequired, TypedDict

from sliplab.flows.running import console
from sliplab.protocols.errors import InputError
from sliplab.protocols.plugin import plugins
from sliplab.rigs.core.capabilities import RigError
from sliplab.storage.trials.lock import Locked
from sliplab.storage.trials.prefix_journal import JOURNAL
from sliplab.storage.trials.store import TrialStore
from sliplab.storage.trials.verify import (
    DAMAGED,
    StoreProblem,
    imported_trials,
    quarantine_damaged,
    trial_folders,
)
from sliplab.storage.trials.verify import verify as find_problems


class Verification(TypedDict):
    """What a verification found, as ``sliplab verify --json`` prints it.

    Attributes:
        trials, whole, damaged: numbers of committed trials.
        ok: nothing is damaged; unfinished trials are no damage.
        url: of a pushed store. format, quarantined: of any other.
        mended: data files that another program had left open for writing, now closed.
        salvaged: trials that are not all that was recorded, as ``campaign/trial``.
        failed_gates: gates that imported trials do not pass, by ``campaign/trial``.
        dropped: rows that were left out of trials, by ``campaign/trial`` and reason.
        no_clock: why streams have no clock, by ``campaign/trial`` and stream.
    """

    trials: int
    whole: int
    damaged: int
    ok: bool
    problems: list[StoreProblem]
    url: NotRequired[str]
    format: NotRequired[int]
    quarantined: NotRequired[list[str]]
    mended: NotRequired[list[str]]
    salvaged: NotRequired[list[str]]
    failed_gates: NotRequired[dict[str, list[str]]]
    dropped: NotRequired[dict[str, dict[str, int]]]
    no_clock: NotRequired[dict[str, dict[str, str]]]


def verify(place: str, quarantine: bool = False) -> Verification:
    """Check every checksum, count and clock; close files that others left open.

    Args:
        place: a store's folder, or the URL of a pushed one, all of which is read.
        quarantine: move damaged trials to quarantine; the next collection retakes them.

    Raises:
        InputError: there is no store, or `quarantine` was given with a URL.
        Locked: another program writes into the store, from which trials are to be moved.
    """
    from sliplab.storage.remote.objects import is_url

    if is_url(place):
        return _verify_pushed(place, quarantine)
    opened = TrialStore.open(Path(place))
    _salvage(opened)
    total = sum(len(trial_folders(campaign)) for campaign in opened.campaigns())
    mended: list[Path] = []
    with console.bar("verify (trials)", total) as bar:
        problems = find_problems(opened, lambda name: bar.advance(1, name), mended.append)
    moved: list[str] = []
    if quarantine and any(item.trial for item in problems):
        from sliplab.flows.collecting.requests import store_lock

        with store_lock(opened):
            moved = quarantine_damaged(opened, problems)
    damaged = _damaged(problems)
    result: Verification = {
        "trials": total,
        "whole": total - damaged,
        "damaged": damaged,
        "format": opened.format,
        "ok": all(item.kind != DAMAGED for item in problems),
        "problems": problems,
        "quarantined": moved,
    }
    if mended:
        result["mended"] = [str(path) for path in mended]
    for trial, record in imported_trials(opened):
        if record.lost is not None:
            result.setdefault("salvaged", []).append(trial)
        if not record.quality.passed:
            gates = [gate for gate, each in record.quality.gates.items() if not each.passed]
            result.setdefault("failed_gates", {})[trial] = gates
        if record.imported is not None and record.imported.dropped:
            result.setdefault("dropped", {})[trial] = record.imported.dropped
        if record.clocks.refused:
            result.setdefault("no_clock", {})[trial] = record.clocks.refused
    return result


def _salvage(store: TrialStore) -> None:
    """Let plug-ins keep what verifies of trials whose program was killed, if none other writes."""
    folders = (path for each in store.campaigns() for path in each.folders("incoming"))
    if not any((path / JOURNAL).exists() for path in folders):
        return
    from sliplab.flows.collecting.requests import store_lock

    with suppress(Locked, RigError), store_lock(store):
        for salvage in plugins().hooks("salvage"):
            for trial in salvage(store):
                console.say(f"kept what verifies of the unfinished trial {trial}")


def _verify_pushed(url: str, quarantine: bool) -> Verification:
    if quarantine:
        raise InputError(
            "--quarantine",
            "",
            url,
            "must not be given with a URL: `sliplab push --check` from a "
            "whole store replaces what is damaged there",
        )
    from sliplab.flows.running import stopping
    from sliplab.storage.remote.objects import Remote
    from sliplab.storage.remote.verify import verify_remote

    with console.bar(f"verify {url} (trials)", 0) as bar:
        trials, problems = verify_remote(Remote(url), bar.count, lambda _: stopping.check())
    damaged = _damaged(problems)
    return {
        "url": url,
        "trials": trials,
        "whole": trials - damaged,
        "damaged": damaged,
        "ok": not problems,
        "problems": problems,
    }


def _damaged(problems: list[StoreProblem]) -> int:
    """Return how many committed trials have a problem."""
    return len({(item.campaign, item.trial) for item in problems if item.trial})
