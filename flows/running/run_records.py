"""How each flow run ended, kept in the store: it outlives the server, the process and the machine.

    STORE/control/runs/ID.json       what began, when, and in which process on which machine
    STORE/control/runs/ID.end.json   how it ended; the first word stands

A process that is killed writes no end. The next program that opens the store finds its begin, sees
that the process is gone, writes the end, and tells Prefect, which would show the run as running
for ever.
"""

from __future__ import annotations

import re
from contextlib import suppress
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from storage.control import FOLDER
from storage.files import make_folder, read_json, sweep_temporary, write_new_json
from storage.process import is_here, named, now, this_process
from storage.streams import Json

EMBEDDED = "embedded"
_BEGIN = re.compile(r"[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}\.json")


def server_name(url: str | None) -> str:
    """A Prefect server's address without the secrets that an address may hold."""
    if not url:
        return EMBEDDED
    parts = urlsplit(url)
    port = f":{parts.port}" if parts.port else ""
    return f"{parts.scheme}://{parts.hostname or ''}{port}"


def begin(store: Path, run: str, flow: str, server: str, deployment: str = "") -> None:
    """A flow run begins in this process; a run that is resumed has begun already."""
    folder = _folder(store)
    make_folder(folder.parent)
    make_folder(folder)
    write_new_json(
        folder / f"{run}.json",
        {"run": run, "flow": flow, "deployment": deployment, "server": server,
         "began": now(), "process": this_process()},
    )  # fmt: skip


def end(store: Path, run: str, state: str, message: str, by: str) -> bool:
    """A flow run ended; False if that was known already.

    Args:
        state: as Prefect calls it: ``COMPLETED``, ``CANCELLED``, ``FAILED``, ``CRASHED``.
        by: who says so: ``flow``, ``hook``, or ``next start`` of what a killed process left.
    """
    folder = _folder(store)
    if not (folder / f"{run}.json").exists():
        return False
    said = {"state": state, "message": message, "when": now(), "by": by}
    return write_new_json(folder / f"{run}.end.json", said)


def suspended(store: Path, run: str) -> None:
    """A flow run left its process to be resumed in another one: it has not begun any more."""
    (_folder(store) / f"{run}.json").unlink(missing_ok=True)


def open_runs(store: Path) -> list[Json]:
    """Runs that began and did not end, as far as the store knows."""
    folder = _folder(store)
    if not folder.is_dir():
        return []
    found = []
    for path in sorted(folder.iterdir()):
        if _BEGIN.fullmatch(path.name) and not path.with_suffix(".end.json").exists():
            with suppress(OSError, ValueError):
                found.append(read_json(path))
    return found


def close_dead(store: Path, server: str) -> list[Json]:
    """Close what killed processes of this machine left open on `server`.

    Prefect is told first: a program that dies in between does both again.

    Returns:
        The runs that were closed.
    """
    here = this_process()["host"]
    dead = [
        item
        for item in open_runs(store)
        if item.get("server") == server
        and item.get("process", {}).get("host") == here
        and not is_here(item["process"])
    ]
    if not dead:
        return []
    sweep_temporary(_folder(store))
    from prefect.client.orchestration import get_client

    with get_client(sync_client=True) as client:
        for item in dead:
            message = f"its process was killed ({named(item['process'])}); found at the next start"
            crash(client, item["run"], message)
            end(store, item["run"], "CRASHED", message, "next start")
    return dead


def crash(client: Any, run: str, message: str) -> None:
    """Set a flow run to CRASHED, unless it ended or the server does not know it."""
    from prefect.exceptions import ObjectNotFound
    from prefect.states import Crashed

    with suppress(ObjectNotFound):
        state = client.read_flow_run(run).state
        if state is None or not state.is_final():
            client.set_flow_run_state(run, Crashed(message=message), force=True)


def hooks(store: Path, server: str) -> dict[str, list[Any]]:
    """Hooks for a flow that runs in this process: its begin and its end are kept."""

    def began(flow: Any, flow_run: Any, state: Any) -> None:
        begin(store, str(flow_run.id), flow.name, server)

    def ended(flow: Any, flow_run: Any, state: Any) -> None:
        end(store, str(flow_run.id), state.type.value, state.message or "", "hook")

    last = ("on_completion", "on_failure", "on_cancellation", "on_crashed")
    return {"on_running": [began], **{name: [ended] for name in last}}


def _folder(store: Path) -> Path:
    return store / FOLDER / "runs"
