"""The very commands of docs/scale.md: a scheduler, workers, and a step that has the same bytes."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from tests.conftest import ROOT
from tests.flows.conftest import six_trials
from tests.plugins.web.server.serving import until
from tests.storage.remote.remotes import tree

pytestmark = pytest.mark.programs

PORT = "8786"


def documented() -> list[list[str]]:
    """The words of the three commands, as the page prints them."""
    page = (ROOT / "docs" / "scale.md").read_text()
    block = page.split("## On a cluster")[1].split("```")[1]
    lines = [shlex.split(line, comments=True) for line in block.splitlines()[1:]]
    return [words for words in lines if words]


@contextmanager
def running(words: list[str], log: Path, environment: dict[str, str]) -> Iterator[None]:
    """A command in the background, in a session of its own, until the block ends."""
    folder = log.parent / f"cwd-{log.name}"  # workers keep their scratch where they are started
    folder.mkdir()
    with log.open("w") as output:
        process = subprocess.Popen(
            words, cwd=folder, env=environment, stdout=output, stderr=output, start_new_session=True
        )
    try:
        yield
        assert process.poll() is None, log.read_text()
    finally:
        process.send_signal(signal.SIGTERM)
        with suppress(subprocess.TimeoutExpired):
            process.wait(20)
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait(20)


@pytest.fixture(scope="module")
def taken(tmp_path_factory: pytest.TempPathFactory, rig_path: Path) -> Path:
    """A store with six trials, and nothing derived from them."""
    return six_trials(tmp_path_factory.mktemp("dask"), rig_path)


@pytest.mark.long  # test_dask.py has the same steps in this process
def test_the_documented_commands_make_the_same_bytes(taken: Path, tmp_path: Path) -> None:
    scheduler, worker, step = documented()
    assert [scheduler[:2], worker[:2], step[:2]] == [
        ["dask", "scheduler"],
        ["dask", "worker"],
        ["sliplab", "label"],
    ]
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    programs = Path(sys.executable).parent

    def ready(words: list[str], store: Path) -> list[str]:
        words = [word.replace(PORT, port) for word in words]
        words = [str(store) if word == "STORE" else word for word in words]
        if "--nworkers" in words:
            words[words.index("--nworkers") + 1] = "2"
        return [str(programs / words[0]), *words[1:]]

    environment = {**os.environ}
    environment.pop("PREFECT_HOME", None)
    store, alone = tmp_path / "store", tmp_path / "alone"
    shutil.copytree(taken, store)
    shutil.copytree(taken, alone)
    log = tmp_path / "worker"
    with (
        running(ready(scheduler, store), tmp_path / "scheduler", environment),
        running(ready(worker, store), log, environment),
    ):
        until("two workers", lambda: len(re.findall("Registered to", log.read_text())) >= 2)
        done = subprocess.run(
            ready(step, store),
            env=environment,
            text=True,
            capture_output=True,
            timeout=180,
            cwd=tmp_path,
            check=False,
        )
        assert done.returncode == 0, done.stderr + log.read_text()
    plain = [word for word in ready(step, alone) if word != "--dask" and port not in word]
    subprocess.run(plain, env=environment, timeout=180, check=True, capture_output=True)
    made = tree(store, "derived/labels")
    assert len(made) == 12
    assert made == tree(alone, "derived/labels")
