"""Prefect as this project runs it: embedded by default, its home in the store, no telemetry.

`configure_prefect` must run before Prefect is imported, for Prefect reads its settings then. A
server that the user names with PREFECT_API_URL is used instead of the embedded one.

No campaign waits for its server (docs/decisions/prefect.md). Prefect's engine calls it in the
flow's own thread, when a run begins and when it ends; `ServerLink` gives each of these requests a
limit. A run that cannot begin there is made without Prefect. An end that was not delivered is saved
in the store (`run_records`), from where the next command reports it. One line says so.
"""

from __future__ import annotations

import asyncio
import logging
import os
import re
import ssl
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from sliplab.flows.running import console, run_records, stopping
from sliplab.flows.running.embedded_server import EmbeddedServer, ServerError
from sliplab.protocols.errors import InputError
from sliplab.storage.errors import masked

if TYPE_CHECKING:
    from uuid import UUID

    from sliplab.flows.running.cluster import Cluster

T = TypeVar("T")

BEGIN_S = 15.0
"""Limit of each request when a run begins; no arm moves yet."""
END_S = 5.0
"""Limit of each when it ends, and of the events that the program's end waits for."""
LOST_S = 0.5
"""Limit of each once the server was lost, or when a stop was requested."""
NOWHERE = "http://127.0.0.1:9/api"
"""The address that Prefect has where there is no server; it is never called."""
_DEFAULTS = {
    "DO_NOT_TRACK": "1",
    "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
    "PREFECT_LOGGING_LEVEL": "CRITICAL",
    "PREFECT_LOGGING_TO_API_ENABLED": "false",
    "PREFECT_RESULTS_PERSIST_BY_DEFAULT": "false",
    "PREFECT_CLI_PROMPT": "false",
}
NO_RESULTS: Any = Path(os.devnull)
"""A flow's `result_storage`. Without one, Prefect queries the server for it, with a separate client
that has no timeout and stays open."""
_LOGGING = "PREFECT_LOGGING_SETTINGS_PATH"
_CERTIFICATES = ("SSL_CERT_FILE", "PREFECT_API_SSL_CERT_FILE")
_PROXY = re.compile("(all|https?|no)_proxy", re.IGNORECASE)
_LOOPBACK = ("127.0.0.1", "localhost")
_NO_PROXY = ",".join(_LOOPBACK)
_servers: dict[str, EmbeddedServer] = {}
_store: Path | None = None
_link: ServerLink | None = None
_lost_servers: set[str] = set()
"""Servers already reported as unreachable; removed once they answer."""


class Opaque(Generic[T]):
    """Opaque argument of a task: Prefect does not validate, walk or store its content.

    Pickled without its content: with a task that runs elsewhere Prefect also sends its flow, of
    whose arguments (`run` keeps them opaque) that task has no use.
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


def configure_prefect(store: Path) -> None:
    """Point Prefect at the store's own home, unless the user has set one; the store must exist.

    Raises:
        InputError: Prefect cannot work with the proxies or certificates of the environment.
    """
    global _store
    _store = store.resolve()
    home = _store / ".prefect"
    if "PREFECT_HOME" not in os.environ:
        home.mkdir(exist_ok=True)
        os.environ["PREFECT_HOME"] = str(home)
    for name, value in _DEFAULTS.items():
        os.environ.setdefault(name, value)
    try:
        Path.home()
    except RuntimeError:  # a user without one, as in a container: Prefect names it and needs none
        os.environ["HOME"] = os.environ["PREFECT_HOME"]
    check_connections()
    _ask_loopback_directly()
    hide_what_a_lost_server_leaves()


def check_connections() -> None:
    """Check that HTTP clients can be made with the proxies and certificates of the environment.

    Prefect makes one for whatever it does, and the first one while it is imported.

    Raises:
        InputError: one of the variables cannot be used, or its file cannot be read.
    """
    proxies = [
        name
        for name, value in sorted(os.environ.items())
        if _PROXY.fullmatch(name) and value not in ("", _NO_PROXY)
    ]
    if proxies and find_spec("httpx") is not None:  # else the command says which packages it lacks
        import httpx

        with _checked(", ".join(proxies)):
            httpx.Client(verify=False).close()
    for name in _CERTIFICATES:
        if path := os.environ.get(name):
            with _checked(name):
                ssl.create_default_context(cafile=path)
    if os.path.exists(path := os.environ.get(_LOGGING) or ""):  # else Prefect uses its own
        with _checked(_LOGGING):
            Path(path).read_text()


@contextmanager
def _checked(names: str) -> Iterator[None]:
    """Report any error of the block as that of some variables of the environment."""
    try:
        yield
    except Exception as error:
        text = f"cannot be used ({masked(reason_of(error))}); correct or unset it"
        raise InputError("environment", names, None, text) from None


def hide_what_a_lost_server_leaves() -> None:
    """Suppress Prefect's log messages about a lost server, in each process with a flow.

    The flow reports it in one line, and saves what could not be sent in the store.
    """
    logging.getLogger("asyncio").addFilter(_is_fault)
    logging.getLogger("prefect._internal.concurrency").setLevel(logging.CRITICAL)


def _is_fault(record: logging.LogRecord) -> bool:
    """Return False for a callback of asyncio that found its task cancelled.

    Prefect's watch of a served run looks at the result of its poll, which is cancelled when the
    run ends while the server does not answer; asyncio prints that with its whole traceback.
    """
    kind = record.exc_info[0] if record.exc_info else None
    return kind is None or not issubclass(kind, asyncio.CancelledError)


def _ask_loopback_directly() -> None:
    """Exclude the loopback from the proxies that the environment names: they cannot reach it."""
    retained = os.environ.get("no_proxy") or os.environ.get("NO_PROXY") or ""
    names = [name.strip() for name in retained.split(",") if name.strip()]
    names += [name for name in _LOOPBACK if name not in names]
    os.environ["no_proxy"] = os.environ["NO_PROXY"] = ",".join(names)


def start_server() -> None:
    """Start the embedded server, if a flow will need it, and continue without waiting for it.

    The flow reports one that cannot be started.
    """
    if "PREFECT_API_URL" not in os.environ:
        with suppress(ServerError):
            embedded()


def embedded() -> EmbeddedServer:
    """Return the embedded server of Prefect's home; start it if there is none, or it was lost.

    Raises:
        ServerError: another program has taken the port of the one that was lost.
    """
    home = os.environ["PREFECT_HOME"]
    server = _servers.get(home)
    doubtful = run_records.EMBEDDED in _lost_servers  # one that is only slow is left alone
    if server is not None and (not server.alive or (doubtful and not server.answers)):
        _servers.pop(home).stop()
        # at the same address, where what Prefect could not send yet is sent to
        _servers[home] = EmbeddedServer(Path(home), server.port, password=server.password)
    elif server is None:
        _servers[home] = EmbeddedServer(Path(home))
    return _servers[home]


def uses_private_server() -> bool:
    """Return True if the server is this program's own, with no page, or there is none."""
    from prefect.settings import PREFECT_API_URL

    own = {None, NOWHERE, *(server.address for server in _servers.values())}
    return PREFECT_API_URL.value() in own


class ServerLink:
    """The connection of one flow run to Prefect's server: limits, and whether it answers.

    Each request passes here (httpx's event hooks) and gets a limit. One that failed is tried once
    more, because SQLite may be busy; after that no other is sent. So a lost server costs a run one
    limit at its begin and one at its end.

    Args:
        server: as `run_records.server_name` calls it.
    """

    def __init__(self, server: str) -> None:
        global _link
        self.server = server
        self.ending = False
        """The work is over, and only its end is to be reported."""
        self._unanswered = False
        """The last request had no answer, or that of a broken server."""
        self._request: Any = None
        self._limit_s = BEGIN_S
        _link = self

    @contextmanager
    def client(self) -> Iterator[Any]:
        """Give Prefect's engine a client with these limits while the block runs."""
        from prefect.context import SyncClientContext

        hooks = {"request": [self._before], "response": [self._after]}
        with SyncClientContext(httpx_settings={"event_hooks": hooks}) as context:
            yield context.client

    def mark_lost(self, error: BaseException | str) -> None:
        """Record that the server is unreachable, and warn once."""
        if self.server not in _lost_servers:
            _lost_servers.add(self.server)
            name = "" if self.server == run_records.EMBEDDED else f" {self.server}"
            reason = error if isinstance(error, str) else self._reason(error)
            console.say(
                f"warning: the Prefect server{name} does not respond ({reason}); work continues "
                "without it, the store keeps everything, and the next command reports this run"
            )

    def _before(self, request: Any) -> None:
        again = request is self._request
        if self._unanswered and not again:
            raise _NotSent
        self._unanswered, self._request = True, request
        if again or self.server in _lost_servers or stopping.requested():
            limit_s = LOST_S
        else:
            self._limit_s = limit_s = END_S if self.ending else BEGIN_S
        limits = dict.fromkeys(("connect", "read", "write", "pool"), limit_s)
        request.extensions = {**request.extensions, "timeout": limits}

    def _after(self, response: Any) -> None:
        self._unanswered = response.status_code >= 500
        if not self._unanswered:
            _lost_servers.discard(self.server)

    def _reason(self, error: BaseException) -> str:
        from httpx import TimeoutException

        while isinstance(error, _NotSent) and error.__context__ is not None:
            error = error.__context__  # the request before
        if isinstance(error, TimeoutException):
            return f"nothing came in {self._limit_s:g} s"
        return reason_of(error)


class _NotSent(Exception):
    """A request was not sent, because the one before it failed."""


def show_running(client: Any, run: UUID, name: str, message: str) -> None:
    """Show on Prefect's page what a run that is running does; another state is left alone.

    Args:
        client: Prefect's, a synchronous one.
        name: in place of "Running".
    """
    from prefect.states import Running

    known = client.read_flow_run(run).state
    if known is not None and known.is_running():
        state: Any = Running(name=name, message=message)
        client.set_flow_run_state(run, state, force=True)


def is_unreachable() -> bool:
    """Return True if the server of the flow that runs now, or ran last, did not answer."""
    return _link is not None and _link.server in _lost_servers


def report_unreachable(reason: str) -> None:
    """Report that the server of the current flow does not answer."""
    if _link is not None:
        _link.mark_lost(reason)


def work_is_over() -> None:
    """Note that only the end of the flow that runs now is to be reported."""
    if _link is not None:
        _link.ending = True


def reason_of(error: BaseException) -> str:
    """Return an error and what caused it as one line."""
    text = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
    cause = error.__cause__
    more = "" if cause is None or str(cause) in text else f" ({type(cause).__name__}: {cause})"
    return " ".join(f"{text}{more}".split())[:300]


def limited_settings() -> dict[Any, Any]:
    """Return Prefect's settings for a flow run: limits, one retry, no heartbeat.

    A heartbeat's thread would cost a flow a second at its end. A killed run is known by what the
    store lacks, and closed by the next one.
    """
    from prefect import settings

    return {
        settings.PREFECT_FLOWS_HEARTBEAT_FREQUENCY: None,
        settings.PREFECT_CLIENT_MAX_RETRIES: 1,
        settings.PREFECT_API_REQUEST_TIMEOUT: BEGIN_S,
    }


class _Work:
    """The work of a flow run and its outcome, which is available even if its report fails."""

    def __init__(
        self, do: Callable[..., Any], arguments: tuple[Any, ...], link: ServerLink
    ) -> None:
        self._do, self._arguments, self._link = do, Opaque(arguments), link
        self.started = self._done = False
        self._result: Any = None
        self.error: BaseException | None = None

    def do(self, on_start: Callable[[], None] = lambda: None) -> Any:
        """Do it after `on_start`, and keep its result or its error."""
        self.started = True
        try:
            with stopping.signals():  # around a flow Prefect has its own handler of SIGTERM
                on_start()
                self._result = self._do(*self._arguments.content)
                self._done = True
        except BaseException as error:
            self.error = error
            raise
        finally:
            self._link.ending = True
        return self._result

    def outcome(self) -> Any:
        """Return its result.

        Raises:
            WorkNotBegun: there is none, because the work did not begin.
            BaseException: that of the work.
        """
        if self.error is not None:
            raise self.error
        if not self._done:
            raise WorkNotBegun("Prefect ended the run before its work began; nothing was done")
        return self._result

    @property
    def end(self) -> tuple[str, str]:
        """State and message of its end, as Prefect calls it."""
        if self.error is None:
            return "COMPLETED", ""
        stated = f"{type(self.error).__name__}: {self.error}"
        return ("FAILED" if isinstance(self.error, Exception) else "CRASHED"), stated


class WorkNotBegun(RuntimeError):
    """A flow run ended before its work began."""


def run(flow: Any, *arguments: Any, cluster: Cluster | None = None) -> Any:
    """Run a flow on the user's server, or on the embedded one, which the first flow starts.

    Inside a served flow it is part of that flow's run, which reports its own end.
    A server that is lost or cannot be started delays nothing.

    Args:
        arguments: of the flow, which Prefect does not see.
        cluster: where its tasks go that are submitted, instead of threads.

    Raises:
        ServerError: there is no server, and a cluster, whose workers report there.
        WorkNotBegun: the run was cancelled on the server before its work began.
    """
    from prefect.context import FlowRunContext
    from prefect.settings import PREFECT_API_URL, temporary_settings

    if FlowRunContext.get() is not None:
        return flow.fn(*arguments)
    link = ServerLink(run_records.server_name(PREFECT_API_URL.value()))
    work = _Work(flow.fn, arguments, link)
    with ExitStack() as stack:
        try:
            own = embedded().settings() if link.server == run_records.EMBEDDED else {}
            stack.enter_context(temporary_settings(updates={**limited_settings(), **own}))
            client = stack.enter_context(link.client())
            if _store is not None:
                run_records.close_killed_runs(_store, link.server, client)
            name = flow.name if _store is None else f"{flow.name} {_in_utf8(_store.name)}"
            flow_run = client.create_flow_run(flow, name=name)
        except Exception as error:
            if cluster is not None:
                raise ServerError(
                    f"the Prefect server {link.server}, to which the workers of --dask report, "
                    f"does not answer ({reason_of(error)})"
                ) from error
            link.mark_lost(str(error) if isinstance(error, ServerError) else error)
            return _without_server(work.do)
        return _reported(flow, flow_run, work, link, cluster)


def _in_utf8(name: str) -> str:
    """Return the name of a folder for the server; it need not be UTF-8 on the disk."""
    return name.encode(errors="replace").decode()


def _reported(
    flow: Any, flow_run: Any, work: _Work, link: ServerLink, cluster: Cluster | None
) -> Any:
    """Do the work as a flow run that the server knows, and keep in the store how it ended."""
    from prefect import Flow
    from prefect.exceptions import CancelledRun, PausedRun, PrefectSignal, TerminationSignal
    from prefect.flow_engine import run_flow

    store, run_id = _store, str(flow_run.id)

    def begin() -> None:
        if store is not None:
            run_records.begin(store, run_id, flow.name, link.server)

    def do() -> Any:
        return work.do(begin)

    reported_flow: Any = Flow(
        do,
        name=flow.name,
        version=flow.version,
        task_runner=None if cluster is None else cluster.runner(),
        validate_parameters=False,
        persist_result=False,
        result_storage=NO_RESULTS,
    )
    interrupted: BaseException | None = None
    delivered = False
    try:
        run_flow(reported_flow, flow_run=flow_run)
        delivered = True
    except (PrefectSignal, CancelledRun, PausedRun) as error:  # raised by the server or by the work
        delivered = not work.started or error is work.error
    except Exception as error:
        if not work.started:
            link.mark_lost(error)
            try:
                _without_server(do)
            except BaseException:
                if not work.started:  # an error of the work is stored, and raised below
                    raise
        elif not (delivered := error is work.error):
            link.mark_lost(error)
    except BaseException as error:  # Ctrl-C, during the work or while its end was reported
        interrupted = error
        delivered = error is work.error
    if store is not None and work.started:
        if not delivered:
            run_records.record_undelivered_end(store, run_id, *work.end)
        run_records.end(store, run_id, *work.end, "flow")
    if work.error is None and isinstance(interrupted, TerminationSignal):
        stopping.stop()  # of Prefect's own handler of SIGTERM
    if work.error is None and interrupted is not None:
        raise interrupted
    if work.error is None:
        stopping.check()  # Prefect swallows a Ctrl-C that comes when the end has been reported
    return work.outcome()


def _without_server(do: Callable[[], Any]) -> Any:
    """Do the work without a server that records it."""
    from prefect.context import SyncClientContext
    from prefect.events.clients import NullEventsClient
    from prefect.events.worker import EventsWorker
    from prefect.settings import (
        PREFECT_API_URL,
        PREFECT_CLIENT_SERVER_VERSION_CHECK_ENABLED,
        temporary_settings,
    )

    settings = {PREFECT_API_URL: NOWHERE, PREFECT_CLIENT_SERVER_VERSION_CHECK_ENABLED: False}
    EventsWorker.set_client_override(NullEventsClient)
    try:
        with temporary_settings(updates=settings), SyncClientContext():
            return do()
    finally:
        EventsWorker.set_client_override(None)


def close() -> bool:
    """Send what Prefect has not sent yet, as a program ends, within `END_S`.

    Returns:
        False if something is left. Prefect's thread for it would hold up the interpreter's end
        until the server answers, so the program has to leave without that.
    """
    if "prefect.events.worker" not in sys.modules:
        return True
    from prefect.events.worker import EventsWorker

    # it says as a warning how much it has left to send
    logging.getLogger(EventsWorker.__name__).setLevel(logging.ERROR)
    limit_s = LOST_S if is_unreachable() else END_S
    waited: Any = EventsWorker.drain_all(timeout=limit_s, at_exit=False)
    _, left = waited
    if left:
        for server in _servers.values():
            server.stop()
    return not left
