"""A Dask cluster that takes the parts of a step which fall into independent trials.

Workers are checked before anything is sent: each must run this version and see the same store,
by the same path or by its URL. A worker that dies is replaced by the others; what it had in hand is
made again. Nothing here is loaded without `--dask`.
"""

from __future__ import annotations

import asyncio
import platform
import queue
import re
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from time import monotonic
from typing import Any

import sliplab
from sliplab import analysis, flows, protocols, rigs, storage
from sliplab.flows.running import stopping
from sliplab.protocols.errors import InputError
from sliplab.protocols.hashing import hash_text
from sliplab.storage.files import sha256

CONNECT_S = 15.0
"""Timeout for a scheduler, and for a first worker, s."""
ALONE_S = 60.0
"""Time without any worker after which the step fails, s."""
POLL_S = 0.5
ANSWER_S = 60.0
"""Timeout for the answers of all workers, s."""
REPORT_S = 5.0
"""Timeout for the workers' last reports to Prefect's server, s."""
_ADDRESS = re.compile(r"((tcp|tls|ws|wss|ucx)://)?[^/:\s]+:\d{1,5}")
_LIBRARIES = ("numpy", "numba", "scipy", "torch", "h5py", "av", "opencv-contrib-python-headless")


class ClusterError(RuntimeError):
    """A Dask cluster cannot do the work; the message says which worker and what to do."""


@dataclass(frozen=True)
class Cluster:
    """A scheduler with workers that were checked.

    Attributes:
        cores: that the workers have together, when they were checked.
    """

    address: str
    client: Any
    cores: int

    def runner(self) -> Any:
        """Prefect's task runner for this cluster."""
        from prefect_dask.task_runners import DaskTaskRunner

        return DaskTaskRunner(address=self.address)

    def check_server(self, url: str) -> None:
        """Check that workers reach the Prefect server, to which they report.

        Raises:
            ClusterError: one does not.
        """
        _ask_all(
            self.client,
            reach_server,
            url,
            "start a server that all machines reach, and set PREFECT_API_URL to it",
        )

    def check_store(self, look: Callable[[Any], None], job: Any) -> None:
        """Check that each worker finds a trial: `look(job)` raises there if it does not.

        Raises:
            ClusterError: one does not.
        """
        _ask_all(
            self.client,
            look,
            job,
            "workers need the store at the same path (share its folder), or give the URL of a "
            "pushed one",
        )

    def report(self) -> None:
        """Have the workers send their reports while Prefect's server still runs."""
        with suppress(Exception):  # nothing but Prefect's own view depends on it
            _run(self.client, report_all, REPORT_S)

    def gather(self, futures: list[Any], done: Callable[[int, Any], None]) -> None:
        """Pass on the result of each of Prefect's futures as soon as it is ready.

        Args:
            done: called in this thread with the number of a future and its result.

        Raises:
            ClusterError: no worker is left, or the scheduler is gone.
            KeyboardInterrupt: a stop was requested; queued tasks are cancelled.
        """
        ready: queue.SimpleQueue[int] = queue.SimpleQueue()
        for number, future in enumerate(futures):
            future.wrapped_future.add_done_callback(lambda _, number=number: ready.put(number))
        left, seen = len(futures), monotonic()
        try:
            while left:
                stopping.check()
                try:
                    number = ready.get(timeout=POLL_S)
                except queue.Empty:
                    seen = self._still_there(seen)
                    continue
                result, seen = _result(futures[number]), monotonic()
                futures[number] = None  # the cluster may forget it
                left -= 1
                done(number, result)
        except BaseException:
            for future in futures:
                if future is not None:
                    with suppress(Exception):  # a scheduler that is gone has cancelled it already
                        future.wrapped_future.cancel()
            raise

    def _still_there(self, seen: float) -> float:
        if self.client.status != "running":
            raise ClusterError(f"the Dask scheduler {self.address} was lost; {_GO_ON}")
        if self.client.scheduler_info(n_workers=1)["workers"]:
            return monotonic()
        if monotonic() - seen > ALONE_S:
            raise ClusterError(
                f"the Dask cluster {self.address} has had no worker for {ALONE_S:.0f} s; {_GO_ON}"
            )
        return seen


_GO_ON = "finished results are kept; run the same command to resume"


@contextmanager
def connected(address: str | None) -> Iterator[Cluster | None]:
    """The cluster at a scheduler's address while the block runs; None without an address.

    Raises:
        InputError: no address, or the packages for it are missing.
        ClusterError: nothing answers there, it has no worker, or one that cannot be used.
    """
    if address is None:
        yield None
        return
    if not _ADDRESS.fullmatch(address):
        raise InputError("--dask", "", address, "must be a scheduler's HOST:PORT")
    try:
        import distributed
        import prefect_dask  # noqa: F401
    except ImportError as error:
        text = f"needs packages that are not installed ({error}): `pip install 'sliplab[cluster]'`"
        raise InputError("--dask", "", address, text) from None
    try:
        client = distributed.Client(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise ClusterError(
            f"--dask {address}: no scheduler answers there ({_short(error)}); start one with "
            "`dask scheduler --host HOST` (docs/scale.md)"
        ) from None
    try:
        yield Cluster(address, client, _look_at_all(client, address))
    finally:
        client.close(timeout=CONNECT_S)


def _look_at_all(client: Any, address: str) -> int:
    """See that all workers are such that results are the same everywhere; their cores."""
    try:
        client.wait_for_workers(1, timeout=CONNECT_S)
    except TimeoutError:
        raise ClusterError(
            f"--dask {address}: has no worker; start some with `dask worker {address} --host HOST "
            "--nworkers N --nthreads 1` (docs/scale.md)"
        ) from None
    _ask_all(client, same_program, this_program(), "install the same version on it")
    cores = client.nthreads()
    for worker, threads in cores.items():
        if threads != 1:
            raise ClusterError(
                f"worker {worker}: works in {threads} threads; start it with --nthreads 1 (and "
                "--nworkers N): compiled code here is not made for threads side by side"
            )
    return len(cores)


def _ask_all(client: Any, question: Callable[[Any], None], about: Any, todo: str) -> None:
    """Ask every worker; the first that objects is named."""
    for worker, answer in sorted(_run(client, question, about).items()):
        if answer is not None:
            raise ClusterError(f"worker {worker}: {_short(answer)}; {todo}")


def _run(
    client: Any, question: Callable[[Any], None], about: Any
) -> dict[str, BaseException | None]:
    """Ask each worker; return None by worker, or the exception that the question raised there."""
    try:
        # as `client.run`, which knows no limit
        answers: dict[str, BaseException | None] = client.sync(
            client._run, in_thread, question, about, on_error="return", callback_timeout=ANSWER_S
        )
    except (OSError, TimeoutError) as error:
        raise ClusterError(f"the Dask workers do not answer ({_short(error)})") from None
    return answers


async def in_thread(question: Callable[[Any], None], about: Any) -> None:
    """Run `question` on a worker in a thread, so that the worker still answers its scheduler."""
    await asyncio.to_thread(question, about)


def this_program() -> dict[str, str]:
    """Return the versions that results depend on: our source, Python, and numerical libraries."""
    found = {"sliplab": _source(), "python": platform.python_version()}
    for name in _LIBRARIES:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found


@cache
def _source() -> str:
    """A hash of all packages' code."""
    files = [*Path(sliplab.__path__[0]).glob("*.py")]  # a wheel has the packages below it
    for package in (protocols, storage, analysis, rigs, flows):
        files += Path(package.__path__[0]).rglob("*.py")
    return hash_text("\n".join(sorted(f"{file.name} {sha256(file)}" for file in files)))[:12]


def same_program(expected: dict[str, str]) -> None:
    """Check on a worker that it runs the same program.

    Raises:
        ClusterError: it does not.
    """
    ours = this_program()
    differ = [
        f"{name} {ours.get(name)} instead of {value}"
        for name, value in expected.items()
        if ours.get(name) != value
    ]
    if differ:
        raise ClusterError(f"({socket.gethostname()}) runs another version: {', '.join(differ)}")


def reach_server(url: str) -> None:
    """Check on a worker that it reaches the Prefect server.

    Raises:
        ClusterError: it does not.
    """
    import urllib.request

    report_all(0.0)  # whatever is left is for the server of a command that was killed
    try:
        with urllib.request.urlopen(f"{url}/health", timeout=10) as answer:
            if answer.status == 200:
                return
            problem = f"status {answer.status}"
    except OSError as error:
        problem = str(error)
    raise ClusterError(f"({socket.gethostname()}) cannot reach the Prefect server {url}: {problem}")


def report_all(limit_s: float = REPORT_S) -> None:
    """Send a worker's pending Prefect events, and start a new reporter.

    The next command may have another server, of which a worker that reports already would not know.
    """
    from prefect.events.worker import EventsWorker

    EventsWorker.drain_all(timeout=limit_s, at_exit=False)


def _result(future: Any) -> Any:
    """Return a chunk's result; errors of the work itself are raised unchanged."""
    from concurrent.futures import CancelledError

    from distributed import KilledWorker
    from distributed.comm import CommClosedError

    try:
        return future.result(timeout=CONNECT_S)
    except KilledWorker as error:
        raise ClusterError(
            f"workers died repeatedly on one chunk of the work ({_short(error)}); {_GO_ON}"
        ) from None
    except (CommClosedError, CancelledError) as error:
        raise ClusterError(f"the Dask cluster lost the work ({_short(error)}); {_GO_ON}") from None


def _short(error: object) -> str:
    return " ".join(str(error).split())[:300] or type(error).__name__
