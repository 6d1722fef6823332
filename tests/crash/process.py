"""Lives of a campaign: each in a child process that is forked, so that it begins at once."""

from __future__ import annotations

import os
import select
import signal
import sys
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from tests.crash.hooks import Policy, install

LIMIT_S = 300.0
"""Longest silence of a life, without what it waits for a processor on a busy machine."""


@dataclass(frozen=True)
class End:
    """The end of a child process.

    Attributes:
        killed: by SIGKILL; otherwise it ended by itself with `code`.
        said: the last lines on its standard error.
    """

    killed: bool
    code: int
    said: str


def live(
    work: Callable[[], None],
    watched: Path | None = None,
    policy: Policy | None = None,
    kill_after_s: float | None = None,
) -> End:
    """Run `work` in a child until it ends or is killed.

    Args:
        watched: the folder about whose files `policy` is asked.
        kill_after_s: when it is killed from outside.

    Raises:
        TimeoutError: it neither ended nor wrote anything for `LIMIT_S`.
    """
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reader)
        os.dup2(writer, 2)
        code = 1
        try:
            if watched is not None and policy is not None:
                install(watched, policy)
            work()
            code = 0
        except SystemExit as end:
            code = int(end.code or 0)
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stderr.flush()
            os._exit(code)
    os.close(writer)
    said = _follow(child, reader, kill_after_s)
    _, status = os.waitpid(child, 0)
    killed = os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGKILL
    code = os.WEXITSTATUS(status) if os.WIFEXITED(status) else 128 + os.WTERMSIG(status)
    return End(killed, code, said)


def _follow(child: int, reader: int, kill_after_s: float | None) -> str:
    """Read what the child says until it is gone; kill it when its time has come."""
    said = b""
    limit = LIMIT_S if kill_after_s is None else kill_after_s
    waited = 0.0
    try:
        while True:
            ready, _, _ = select.select([reader], [], [], limit)
            more = _waited_s(child) - waited
            if not ready and kill_after_s is None and more > 0.01 * LIMIT_S:
                waited, limit = waited + more, more
            elif not ready:
                os.kill(child, signal.SIGKILL)
                if kill_after_s is None:
                    os.waitpid(child, 0)
                    raise TimeoutError(f"a life went on for {LIMIT_S:.0f} s: {said.decode()}")
                limit = LIMIT_S
            elif not (block := os.read(reader, 1 << 16)):
                return said[-2000:].decode(errors="replace")
            else:
                said += block
    finally:
        os.close(reader)


def _waited_s(child: int) -> float:
    """Return how long a process could have run and had no processor."""
    schedule = Path(f"/proc/{child}/schedstat")  # ns it ran, ns it waited, times it ran
    return int(schedule.read_text().split()[1]) / 1e9 if schedule.exists() else 0.0
