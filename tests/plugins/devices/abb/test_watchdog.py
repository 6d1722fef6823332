"""The module for a real controller and what the fake makes of it, held together."""

from __future__ import annotations

import re
from typing import Any

import pytest

from sliplab.plugins.devices.abb.fake import WATCH_S
from sliplab.plugins.devices.abb.rws import WebRefused
from sliplab.plugins.devices.abb.settings import AbbSettings
from sliplab.plugins.devices.abb.watchdog import BEAT, BEAT_S, ECHO, LIMIT, Watchdog
from tests.conftest import ROOT
from tests.patching import loose

RAPID = ROOT / "docs" / "rapid"
AHEAD = range(-4500, 5000, 500)
MODULE = (RAPID / "sliplab_watchdog.mod").read_text()


def test_the_module_speaks_by_the_signals_that_the_driver_knows() -> None:
    code = "\n".join(line.partition("!")[0] for line in MODULE.splitlines())
    assert set(re.findall(r"sliplab_(?!watchdog)\w+", code)) == {BEAT, ECHO, LIMIT}
    signals = (RAPID / "sliplab_watchdog_eio.cfg").read_text()
    assert re.findall(r'-Name "(\w+)" -SignalType "AO"( -Access "All")?', signals) == [
        (BEAT, ' -Access "All"'),
        (LIMIT, ' -Access "All"'),
        (ECHO, ""),
    ]


def test_the_module_is_loaded_into_a_task_whose_end_stops_the_arm() -> None:
    system = (RAPID / "sliplab_watchdog_sys.cfg").read_text()
    (task,) = set(re.findall(r'-Task "(\w+)"', system)) & set(re.findall(r'-Name "(\w+)"', system))
    assert len(task) <= 16  # the controller's limit of a task's name
    assert '-TrustLevel "SysStop"' in system
    assert MODULE.startswith("MODULE sliplab_watchdog\n")
    assert MODULE.count("SystemStopAction\\Stop;") == 1


def test_the_stand_in_has_the_cycle_of_the_module_and_beats_fit_into_every_limit() -> None:
    found = re.search(r"CONST num cycle_s:=([0-9.]+);", MODULE)
    assert float(found[1]) == WATCH_S
    shortest = AbbSettings.model_json_schema()["properties"]["watchdog_s"]["anyOf"][0]["minimum"]
    assert shortest > BEAT_S + WATCH_S


class Signals:
    """Analog signals of a controller whose watchdog task has ended; they keep their values."""

    def __init__(self, echo: float) -> None:
        self.values = {BEAT: 0.0, ECHO: echo, LIMIT: 0.0}

    def read_signal(self, name: str) -> float:
        return self.values[name]

    def write_signal(self, name: str, value: float) -> None:
        self.values[name] = value

    def close(self) -> None:
        """Nothing to close."""


@pytest.mark.parametrize("ahead", [*AHEAD, float("nan")])
def test_echo_of_a_task_that_has_ended_is_no_echo(ahead: float, monkeypatch: Any) -> None:
    monkeypatch.setattr("sliplab.plugins.devices.abb.watchdog.ECHO_S", 0.02)
    settings = AbbSettings.model_validate(
        {"host": "127.0.0.1", "limits": {"low_mm": [0, 0, 0], "high_mm": [9, 9, 9]}}
    )
    watchdog = Watchdog(settings, 2.0)
    controller = Signals((watchdog._count + ahead) % 10_000)
    watchdog._web = controller  # type: ignore[assignment]
    try:
        with pytest.raises(WebRefused, match="the task is not running"):
            loose(watchdog).begin(controller)
    finally:
        watchdog.close(watch=False)
