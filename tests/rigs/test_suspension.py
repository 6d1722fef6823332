"""Ctrl-Z while a rig is open: a suspended program would watch no arm."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from sliplab.rigs.build import build_rig
from sliplab.rigs.rig_file import RigFile, load_rig_file


def test_ctrl_z_is_ctrl_c_while_a_rig_is_open(monkeypatch: pytest.MonkeyPatch) -> None:
    file, _ = load_rig_file(Path("mock"))
    before = signal.getsignal(signal.SIGTSTP)
    build_rig(file).close()
    monkeypatch.setattr(RigFile, "in_virtual_time", False)
    rig = build_rig(file)
    ctrl_c = signal.signal(signal.SIGINT, signal.default_int_handler)  # a server's is ignored
    try:
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGTSTP)
    finally:
        signal.signal(signal.SIGINT, ctrl_c)
        rig.close()
    assert signal.getsignal(signal.SIGTSTP) is before


def test_a_simulated_rig_may_be_suspended() -> None:
    before = signal.getsignal(signal.SIGTSTP)
    rig = build_rig(load_rig_file(Path("mock"))[0])
    assert signal.getsignal(signal.SIGTSTP) is before
    rig.close()
