"""A Prefect server that stands still, dies or cannot write while trials are taken.

The store is the truth: the trials go on and are committed, one line says what happened, and the
run's end is reported by the next command.
"""

from __future__ import annotations

import os
import resource
import signal
import socket
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest

from sliplab.flows.running.embedded_server import EmbeddedServer
from tests.command_line import SLIPLAB
from tests.flows.conftest import tiny, write
from tests.flows.programs import ended, environment, running
from tests.plugins.web.server.serving import until

pytestmark = pytest.mark.programs

END_S = 60.0
"""Generous: a run that waits for its server takes many minutes."""
STOP_S = 20.0
"""Generous, too: Ctrl-C acts within 2 s, arm first; the rest is the interpreter's end."""
LOST = "Prefect server"


class Collection:
    """`sliplab collect` in a process of its own, as a terminal runs it."""

    def __init__(self, folder: Path, process: subprocess.Popen[str], env: dict[str, str]) -> None:
        self.store, self.log = folder / "store", folder / "messages"
        self.process, self._environment = process, env

    @property
    def committed(self) -> int:
        """Trials in the store."""
        trials = self.store / "campaigns" / "tiny" / "trials"
        return len(list(trials.iterdir())) if trials.is_dir() else 0

    @property
    def server(self) -> int:
        """The embedded server's process."""
        for path in Path("/proc").glob("[0-9]*/stat"):
            try:
                parent = int(path.read_text().rsplit(")", 1)[1].split()[1])
                command = (path.parent / "cmdline").read_text()
            except OSError:  # it has ended meanwhile
                continue
            if parent == self.process.pid and "embedded_server" in command:
                return int(path.parent.name)
        raise AssertionError("there is no embedded server")

    def begun(self) -> None:
        """Wait for the first trial, when the flow run has long been told to the server."""
        until("a trial", lambda: self.committed or self.process.poll() is not None)
        assert self.process.poll() is None, self.log.read_text()
        assert self.committed < 6

    def ends(self, limit_s: float = END_S) -> int:
        """Wait for the end; returns the exit code."""
        return self.process.wait(limit_s)

    def lines(self) -> list[str]:
        """Return the messages about the server."""
        return [line for line in self.log.read_text().splitlines() if LOST in line]

    def label(self) -> str:
        """Run the next command; returns its messages."""
        done = ended([*SLIPLAB, "label", self.store], 120, env=self._environment)
        assert done.returncode == 0, done.stderr
        return done.stderr


@contextmanager
def collecting(folder: Path, *, trials: int = 6, **changes: str) -> Iterator[Collection]:
    """One collection; nothing of it is left when the block ends."""
    folder.mkdir(exist_ok=True)
    command = ("collect", write(folder / "p.yaml", tiny()), "--store", folder / "store", "--json")
    command += ("--trials", str(trials))
    env = environment(**changes)
    with running([*SLIPLAB, *command, "--rig", "rehearsal"], folder / "messages", env) as process:
        yield Collection(folder, process, env)


def states(database: Path) -> list[tuple[str, str]]:
    """Name and state of each flow run that a server knows."""
    question = "select flow.name, state_type from flow_run join flow on flow.id = flow_id"
    with closing(sqlite3.connect(f"{database.as_uri()}?mode=ro", uri=True)) as file:
        return sorted(file.execute(question).fetchall())


def stand_still(server: int) -> None:
    """Stop it as a debugger or a frozen disk does."""
    os.kill(server, signal.SIGSTOP)


def die(server: int) -> None:
    """End it as the kernel does where memory is short."""
    os.kill(server, signal.SIGKILL)


def fill(server: int) -> None:
    """Let the kernel refuse every byte that it writes into a file, as on a full disk."""
    resource.prlimit(server, resource.RLIMIT_FSIZE, (0, resource.RLIM_INFINITY))


@pytest.mark.parametrize(
    "lose", [die, *(pytest.param(how, marks=pytest.mark.long) for how in (stand_still, fill))]
)
def test_a_campaign_goes_on_without_its_server(lose: Callable[[int], None], tmp_path: Path) -> None:
    with collecting(tmp_path) as run:
        run.begun()
        lose(run.server)
        assert run.ends() == 0, run.log.read_text()
        assert run.committed == 6
        assert len(run.lines()) == 1, run.log.read_text()
        assert "Traceback" not in (log := run.log.read_text()), log
        said = run.label()
        assert LOST not in said
    database = run.store / ".prefect" / "prefect.db"
    assert ("collect", "COMPLETED") in states(database)
    assert all(state == "COMPLETED" for _, state in states(database))


@pytest.mark.long
def test_ctrl_c_acts_while_the_server_stands_still(tmp_path: Path) -> None:
    with collecting(tmp_path) as run:
        run.begun()
        stand_still(run.server)
        run.process.send_signal(signal.SIGINT)
        assert run.ends(STOP_S) == 130, run.log.read_text()
        assert "every committed trial is kept" in run.log.read_text()
        assert run.committed < 6
        run.label()
    known = dict(states(run.store / ".prefect" / "prefect.db"))
    assert known["collect"] == "CRASHED"


@pytest.mark.long  # the test before is of the same, while a trial is taken
def test_ctrl_c_acts_while_the_end_is_reported(tmp_path: Path) -> None:
    with collecting(tmp_path) as run:
        run.begun()
        stand_still(run.server)
        until("all trials", lambda: run.committed == 6 or run.process.poll() is not None)
        run.process.send_signal(signal.SIGINT)
        assert run.ends(STOP_S) in {0, 130}, run.log.read_text()


@contextmanager
def users_server(home: Path) -> Iterator[EmbeddedServer]:
    """A server that the user has started and named."""
    home.mkdir()
    server = EmbeddedServer(home)
    try:
        yield server
    finally:
        os.kill(server.pid, signal.SIGCONT)
        server.stop()


@pytest.mark.long  # a lost server of ours is reported to again above
def test_a_named_server_that_stands_still_is_reported_to_again(tmp_path: Path) -> None:
    with (
        users_server(tmp_path / "home") as server,
        collecting(
            tmp_path / "work", PREFECT_API_URL=server.url, PREFECT_API_AUTH_STRING=server.password
        ) as run,
    ):
        run.begun()
        stand_still(server.pid)
        assert run.ends() == 0, run.log.read_text()
        assert run.committed == 6
        assert len(run.lines()) == 1
        os.kill(server.pid, signal.SIGCONT)
        assert LOST not in run.label()
        assert all(state == "COMPLETED" for _, state in states(tmp_path / "home" / "prefect.db"))


@pytest.mark.long
def test_a_named_server_that_is_not_there_is_said(tmp_path: Path) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{free.getsockname()[1]}/api"
    with collecting(tmp_path, trials=1, PREFECT_API_URL=url) as run:
        assert run.ends(120) == 0, run.log.read_text()
        assert run.committed == 1
        (line,) = run.lines()
        assert url.removesuffix("/api") in line
        assert "refused" in line


@pytest.mark.long
def test_a_server_that_cannot_start_is_said_with_its_cause(tmp_path: Path) -> None:
    home = tmp_path / "home"
    home.mkdir()
    (home / "prefect.db").write_bytes(b"is no database" * 1000)
    with collecting(tmp_path / "work", trials=1, PREFECT_HOME=str(home)) as run:
        assert run.ends(120) == 0, run.log.read_text()
        assert run.committed == 1
        (line,) = run.lines()
        assert "file is not a database" in line
        assert str(home / "server.log") in line


@pytest.mark.parametrize(
    "closed",
    [*(pytest.param(one, marks=pytest.mark.long) for one in ("<&-", ">&-")), "<&- >&- 2>&-"],
)
def test_neither_closed_standard_streams_nor_proxies_matter(closed: str, tmp_path: Path) -> None:
    """A service manager may start a program without any of them, where proxies answer nothing."""
    dead = "http://127.0.0.1:9"
    proxies = dict.fromkeys(("http_proxy", "https_proxy", "all_proxy"), dead)
    proxies |= {name.upper(): value for name, value in proxies.items()}
    env = environment(**proxies, no_proxy="", NO_PROXY="")
    protocol = write(tmp_path / "p.yaml", tiny())
    command = f"{sys.executable} -m flows collect {protocol} --rig rehearsal --trials 1"
    store = tmp_path / "store"
    done = ended(["/bin/sh", "-c", f"exec {command} --store {store} {closed}"], 120, env=env)
    # the result has nowhere to go where standard output is closed, which is said as a failure
    assert done.returncode == (1 if ">&-" in closed else 0), done.stderr
    assert LOST not in done.stderr
    database = store / ".prefect" / "prefect.db"
    assert states(database) == [("collect", "COMPLETED")]
    tasks = "select count(*) from task_run where state_type = 'COMPLETED'"
    with closing(sqlite3.connect(f"{database.as_uri()}?mode=ro", uri=True)) as file:
        assert file.execute(tasks).fetchone()[0] >= 1


@pytest.mark.long
def test_a_limit_on_the_size_of_files_is_named(tmp_path: Path) -> None:
    began = time.monotonic()
    protocol = write(tmp_path / "p.yaml", tiny())
    command = f"{sys.executable} -m flows collect {protocol} --rig rehearsal --trials 1"
    line = f"ulimit -f 100; exec {command} --store {tmp_path / 'store'}"
    env = environment(XDG_CACHE_HOME=str(tmp_path / "none"))
    done = ended(["/bin/sh", "-c", line], 120, env=env)
    assert "file size limit" in done.stderr, done.stderr
    assert time.monotonic() - began < 110
