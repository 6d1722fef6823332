"""Ctrl-C of a terminal reaches every process of a loopback rig: only the command answers it."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.dvxplorer_server import DvxplorerServer
from sliplab.rigs.rig_file import load_rig_file
from tests.flows.live import rig_yaml, stage_of
from tests.flows.programs import environment

PARENT = """
import time
from benchmarks.dvxplorer_server import DvxplorerServer

if __name__ == "__main__":
    print(DvxplorerServer(list, realtime=False)._process.pid, flush=True)
    time.sleep(600)
"""
pytestmark = [pytest.mark.realtime, pytest.mark.xdist_group("scene")]
OF_TERMINAL = {signal.SIGINT, signal.SIGHUP}


def ignored(pid: int) -> set[int]:
    """Return the signals that a process ignores."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    (mask,) = (int(line.split()[1], 16) for line in lines if line.startswith("SigIgn"))
    return {number for number in range(1, 65) if mask >> (number - 1) & 1}


@pytest.mark.long
def test_simulation_server_survives_signals_of_the_terminal(tmp_path: Path) -> None:
    with stage_of(load_rig_file(rig_yaml(tmp_path))[0]) as stage:
        pid = stage._process.pid
        assert pid is not None
        assert ignored(pid) >= OF_TERMINAL
        for number in OF_TERMINAL:
            os.kill(pid, number)
        assert stage.at_rest()
        assert stage.mass_kg() > 0


def test_dvxplorer_server_survives_signals_of_the_terminal() -> None:
    with DvxplorerServer(list, realtime=False) as server:
        pid = server._process.pid
        assert pid is not None
        assert ignored(pid) >= OF_TERMINAL
        for number in OF_TERMINAL:
            os.kill(pid, number)
        assert not server.answered  # it has not died


def test_fakes_end_with_a_killed_parent(tmp_path: Path) -> None:
    script = tmp_path / "parent.py"
    script.write_text(PARENT)
    command = [sys.executable, str(script)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, env=environment()) as parent:
        assert parent.stdout is not None
        server = os.pidfd_open(int(parent.stdout.readline()))
        parent.kill()
        parent.wait(30)
        try:
            assert select.select([server], [], [], 30)[0] == [server]
        finally:
            os.close(server)
