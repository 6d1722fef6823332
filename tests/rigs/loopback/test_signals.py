"""Ctrl-C of a terminal reaches every process of a loopback rig: only the command answers it."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from sliplab.rigs.devices.dvxplorer.fake import DvxplorerServer
from sliplab.rigs.rig_file import load_rig_file
from tests.flows.live import rig_yaml, stage_of

pytestmark = [pytest.mark.realtime, pytest.mark.xdist_group("scene")]
OF_TERMINAL = {signal.SIGINT, signal.SIGHUP}


def ignored(pid: int) -> set[int]:
    """Return the signals that a process ignores."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    (mask,) = (int(line.split()[1], 16) for line in lines if line.startswith("SigIgn"))
    return {number for number in range(1, 65) if mask >> (number - 1) & 1}


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
