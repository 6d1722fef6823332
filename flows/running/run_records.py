"""Ends of flow runs, saved in the store: they outlive the server, the process and the machine.

    STORE/control/runs/ID.json       what began, when, and in which process on which machine
    STORE/control/runs/ID.end.json   how it ended; written once
    STORE/control/runs/ID.owed.json  how it ended, while Prefect's server does not know it yet

A process that is killed writes no end. The next program that opens the store finds its begin, sees
that the process is gone, writes the end and reports it to Prefect, which would otherwise show the
run as running for ever. It also reports the ends that a server which did not answer still lacks.
"""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from sliplab.storage.files import (
    make_folder,
    read_json,
    sweep_temporary,
    write_json,
    write_new_json,
)
from sliplab.storage.process import is_here, named, now, this_process
from sliplab.storage.streams import Json
from sliplab.storage.trials.control import FOLDER
from sliplab.storage.trials.store import TrialStore

EMBEDDED = "embedded"
NOTHING_TAKEN = "no trial was taken"
"""In the message of a run whose window ended with nothing done: no fault, but unexpected."""
_ID = r"[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}"
_BEGIN = re.compile(rf"{_ID}\.json")
_OWED = re.compile(rf"({_ID})\.owed\.json")


def server_name(url: str | None) -> str:
    """Return a Prefect server's address without the secrets that it may contain."""
    if not url:
        return EMBEDDED
    try:
        parts = urlsplit(url)
        port = f":{parts.port}" if parts.port else ""
    except ValueError:
        return "at an invalid address"
    return f"{parts.scheme}://{parts.hostname or ''}{port}"


def begin(store: Path, run: str, flow: str, server: str, deployment: str = "") -> None:
    """A flow run begins in this process; a run that is resumed has begun already."""
    folder = _folder(store)
    make_folder(folder.parent)
    make_folder(folder)
    write_new_json(
        folder / f"{run}.json",
        {
            "run": run,
            "flow": flow,
            "deployment": deployment,
            "server": server,
            "began": now(),
            "process": this_process(),
        },
    )


def end(store: Path, run: str, state: str, message: str, by: str) -> bool:
    """A flow run ended; False if that was known already.

    Args:
        state: as Prefect calls it: ``COMPLETED``, ``CANCELLED``, ``FAILED``, ``CRASHED``.
        by: who says so: ``flow``, ``service``, or ``next start`` of what a killed process left.
    """
    folder = _folder(store)
    if not (folder / f"{run}.json").exists():
        return False
    stated = {"state": state, "message": message, "when": now(), "by": by}
    return write_new_json(folder / f"{run}.end.json", stated)


def record_undelivered_end(store: Path, run: str, state: str, message: str) -> None:
    """Keep an end that the server did not take; `close_killed_runs` reports it."""
    stated = {"state": state, "message": message, "when": now()}
    write_new_json(_folder(store) / f"{run}.owed.json", stated)


def end_of(store: Path, run: str) -> Json | None:
    """Return how a flow run ended, ``state`` and ``message``; None if that is not known."""
    path = _folder(store) / f"{run}.end.json"
    return read_json(path) if path.exists() else None


def delivered(store: Path, run: str) -> None:
    """Note that the server knows how a flow run ended."""
    (_folder(store) / f"{run}.owed.json").unlink(missing_ok=True)


def suspended(store: Path, run: str) -> None:
    """A flow run left its process to be resumed in another one: it counts as not begun."""
    (_folder(store) / f"{run}.json").unlink(missing_ok=True)


def runs(store: Path) -> list[tuple[Json, Json | None]]:
    """Return the runs that began, each with its end if that is known; damaged files are left out.

    A run has ``run``, ``flow``, ``deployment``, ``server``, ``began`` and ``process``; an end has
    ``state``, ``message``, ``when`` and ``by``.
    """
    folder = _folder(store)
    if not folder.is_dir():
        return []
    found: list[tuple[Json, Json | None]] = []
    for path in sorted(folder.iterdir()):
        if _BEGIN.fullmatch(path.name):
            ended = path.with_suffix(".end.json")
            with suppress(OSError, ValueError):
                found.append((read_json(path), read_json(ended) if ended.exists() else None))
    return found


def was_stopped(ended: Json) -> bool:
    """Return whether a run ended because a person stopped it, which Prefect calls a crash."""
    return str(ended.get("message", "")).startswith("KeyboardInterrupt")


def was_killed(run: Json) -> bool:
    """Return whether the process of a run without an end is gone, as far as this machine knows."""
    process = run.get("process", {})
    return process.get("host") == this_process()["host"] and not is_here(process)


def open_runs(store: Path) -> list[Json]:
    """Return the runs that began and did not end, as far as the store knows."""
    return [run for run, ended in runs(store) if ended is None]


def close_killed_runs(store: Path, server: str, client: Any = None) -> list[Json]:
    """Close what killed processes of this machine left open on `server`, and report owed ends.

    Prefect gets the report first: a program that dies in between does both again.

    Args:
        client: Prefect's, a synchronous one; a new one by default.

    Returns:
        The runs that were closed because their process was killed.
    """
    dead = [item for item in open_runs(store) if item.get("server") == server and was_killed(item)]
    owed = _owed(store, server)
    if not dead and not owed:
        return []
    sweep_temporary(_folder(store))
    from prefect.client.orchestration import get_client

    with nullcontext(client) if client else get_client(sync_client=True) as client:
        for path, run in owed:
            stated = read_json(path)
            _report(client, run, stated["state"], stated["message"])
            path.unlink(missing_ok=True)
        for item in dead:
            message = (
                f"its process was killed ({named(item['process'])}); detected at the next start"
            )
            _report(client, item["run"], "CRASHED", message)
            end(store, item["run"], "CRASHED", message, "next start")
    return dead


def _owed(store: Path, server: str) -> list[tuple[Path, str]]:
    """Files of the ends that a server lacks, with their runs."""
    folder = _folder(store)
    found = []
    for path in sorted(folder.iterdir()) if folder.is_dir() else ():
        if match := _OWED.fullmatch(path.name):
            with suppress(OSError, ValueError):
                if read_json(folder / f"{match[1]}.json")["server"] == server:
                    found.append((path, match[1]))
    return found


def _report(client: Any, run: str, state: str, message: str) -> None:
    """Set how a flow run ended, unless it has an end or the server does not know it."""
    from prefect.client.schemas.objects import State, StateType
    from prefect.exceptions import ObjectNotFound

    with suppress(ObjectNotFound):
        known = client.read_flow_run(run).state
        if known is None or not known.is_final():
            ended: Any = State(type=StateType(state), message=message)
            client.set_flow_run_state(run, ended, force=True)


def _folder(store: Path) -> Path:
    return store / FOLDER / "runs"


def _timing_file(store: TrialStore) -> Path:
    return store.folder / "derived" / "timing.json"


def step_seconds(store: TrialStore) -> dict[str, float]:
    """Wall seconds by step, of the last run that had something to do."""
    path = _timing_file(store)
    return {key: float(value) for key, value in read_json(path).items()} if path.exists() else {}


@contextmanager
def timed(store: TrialStore, step: str) -> Iterator[None]:
    """Keep the wall seconds of the block under `step` if it ends well."""
    start = time.perf_counter()
    yield
    path = _timing_file(store)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, {**step_seconds(store), step: round(time.perf_counter() - start, 2)})
