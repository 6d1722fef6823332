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
        TimeoutError: it did not end within five minutes.
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
    try:
        while True:
            ready, _, _ = select.select([reader], [], [], limit)
            if not ready:
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
