"""The client of a loopback rig's fakes: an answer belongs to its question, and comes in time."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from types import SimpleNamespace
from typing import Any

import pytest

from sliplab.plugins.loopback import client
from sliplab.plugins.loopback.client import Loopback
from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.core.library_process import PipeCalls

Serve = Callable[[Connection], None]


def fakes(serve: Serve) -> Loopback:
    """A client whose fakes are a thread; to kill them breaks the pipe."""
    ours, theirs = Pipe()
    found = Loopback.__new__(Loopback)
    found._calls = PipeCalls(ours, theirs.close)
    threading.Thread(target=serve, args=(theirs,), daemon=True).start()
    return found


def test_answer_that_comes_late_is_not_taken_for_the_next_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(client, "ANSWER_S", 0.2)
    late = threading.Event()

    def serve(pipe: Connection) -> None:
        pipe.recv()
        late.wait(5.0)
        if not pipe.closed:
            pipe.send((True, 0.5))

    loopback = fakes(serve)
    with pytest.raises(RigError, match=r"fakes: no answer within 0\.2 s"):
        loopback.mass_kg()
    late.set()
    with pytest.raises(RigError, match="fakes: their process has ended"):
        loopback.at_rest()


@pytest.mark.parametrize(("pid", "limit_s"), [(0, 0.3), (os.getpid(), 1e-3)], ids=["idle", "work"])
def test_fakes_that_idle_or_work_for_too_long_do_not_start(
    monkeypatch: pytest.MonkeyPatch, pid: int, limit_s: float
) -> None:
    monkeypatch.setattr(client, "READY_S", limit_s)
    loopback = fakes(lambda pipe: None)
    monkeypatch.setattr(loopback, "_process", SimpleNamespace(pid=pid), raising=False)
    with pytest.raises(RigError, match="fakes: did not start"):
        loopback._result(loopback._ready)


def test_answer_after_ctrl_c_is_its_own_questions(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = threading.Event()

    def serve(pipe: Connection) -> None:
        for answer in (0.5, True):
            pipe.recv()
            pipe.send((True, answer))
            asked.set()

    loopback = fakes(serve)
    wait = loopback._calls._wait

    def interrupted(within_s: float) -> float:
        monkeypatch.setattr(loopback._calls, "_wait", wait)
        asked.wait(5.0)
        raise KeyboardInterrupt

    monkeypatch.setattr(loopback._calls, "_wait", interrupted)
    with pytest.raises(KeyboardInterrupt):
        loopback.mass_kg()
    found: Any = loopback.at_rest()
    assert found is True
