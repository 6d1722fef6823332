"""Prefect as this project runs it: embedded by default, at home in the store, silent off-line.

`prepare` must run before Prefect is imported, because Prefect reads its settings then. A server
that the user names with PREFECT_API_URL is used instead of the embedded one.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from sliplab.flows.running import run_records, server_calls
from sliplab.flows.running.embedded_server import EmbeddedServer, ServerError

if TYPE_CHECKING:
    from sliplab.flows.running.cluster import Cluster

T = TypeVar("T")

_DEFAULTS = {
    "DO_NOT_TRACK": "1",
    "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
    "PREFECT_LOGGING_LEVEL": "CRITICAL",
    "PREFECT_LOGGING_TO_API_ENABLED": "false",
    "PREFECT_RESULTS_PERSIST_BY_DEFAULT": "false",
    "PREFECT_CLI_PROMPT": "false",
}
_LOOPBACK = ("127.0.0.1", "localhost")
_servers: dict[str, EmbeddedServer] = {}
_store: Path | None = None


class Opaque(Generic[T]):
    """Opaque flow or task argument: Prefect does not validate, walk or store its content.

    Pickled without its content: with a task that runs elsewhere Prefect also sends the arguments
    of its flow, which that task has no use for.
    """

    def __init__(self, content: T) -> None:
        self.content = content

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle without the content."""
        return type(self), (None,)


class Pickled(Opaque[T]):
    """Opaque argument that is pickled with its content, for tasks in other processes."""

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle with the content."""
        return type(self), (self.content,)


def prepare(store: Path) -> None:
    """Point Prefect at the store's own home, unless the user has set one; the store must exist."""
    global _store
    _store = store.resolve()
    home = _store / ".prefect"
    if "PREFECT_HOME" not in os.environ:
        home.mkdir(exist_ok=True)
        os.environ["PREFECT_HOME"] = str(home)
    for name, value in _DEFAULTS.items():
        os.environ.setdefault(name, value)
    _ask_loopback_directly()


def _ask_loopback_directly() -> None:
    """Except the loopback from the proxies that the environment names: they cannot reach it."""
    kept = os.environ.get("no_proxy") or os.environ.get("NO_PROXY") or ""
    names = [name.strip() for name in kept.split(",") if name.strip()]
    names += [name for name in _LOOPBACK if name not in names]
    os.environ["no_proxy"] = os.environ["NO_PROXY"] = ",".join(names)


def begin() -> None:
    """Start the embedded server, if a flow will need it, and go on without waiting for it."""
    if "PREFECT_API_URL" not in os.environ:
        embedded()


def embedded() -> EmbeddedServer:
    """Return the embedded server of Prefect's home; start it if there is none, or it was lost."""
    home = os.environ["PREFECT_HOME"]
    there = _servers.get(home)
    doubtful = server_calls.was_lost(run_records.EMBEDDED)  # one that is slow is left alone
    if there is not None and (not there.alive or (doubtful and not there.answers)):
        from sliplab.flows.running import run_events

        _servers.pop(home).stop()
        run_events.renew()
    if home not in _servers:
        _servers[home] = EmbeddedServer(Path(home))
        server_calls.forget(run_records.EMBEDDED)
    return _servers[home]


def private() -> bool:
    """Whether Prefect's server is this program's own, with no page that anybody could look at."""
    from prefect.settings import PREFECT_API_URL

    return PREFECT_API_URL.value() in {None, *(server.address for server in _servers.values())}


def run(flow: Any, argument: Opaque[Any], cluster: Cluster | None = None) -> Any:
    """Run a flow on the user's server, or on the embedded one, which the first flow starts.

    Inside a flow that is served it is part of that flow's run, which has an end of its own.
    A server that is lost, or cannot be started, holds nothing up (`server_calls`).
    Without heartbeats, because each would cost a flow a second of waiting for their thread; a
    killed run is known by what the store lacks, and closed by the next one.

    Args:
        cluster: where its tasks go that are submitted, instead of threads.
    """
    from prefect.context import FlowRunContext, SyncClientContext
    from prefect.settings import (
        PREFECT_API_URL,
        PREFECT_FLOWS_HEARTBEAT_FREQUENCY,
        temporary_settings,
    )

    from sliplab.flows.running import run_events

    if FlowRunContext.get() is not None:
        return flow.fn(argument)
    updates: dict[Any, Any] = {PREFECT_FLOWS_HEARTBEAT_FREQUENCY: None}
    server = run_records.server_name(PREFECT_API_URL.value())
    calls = server_calls.Calls(server, _store)
    if server == run_records.EMBEDDED:
        try:
            updates |= embedded().settings()
        except ServerError as error:
            if cluster is not None:  # its workers report there
                raise
            updates[PREFECT_API_URL] = server_calls.NOWHERE
            calls.absent(str(error))
    with temporary_settings(updates=updates), calls:
        run_events.install(silent=calls.nobody)
        if _store is not None:
            calls.close_dead()
            flow = flow.with_options(**run_records.hooks(_store, server))
        if cluster is not None:
            flow = flow.with_options(task_runner=cluster.runner())
        context = SyncClientContext()
        calls.through(context.client)
        with context:
            return flow(argument)
