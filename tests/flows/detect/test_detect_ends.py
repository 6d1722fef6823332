"""Ends of a live detection, and the requests that it rejects."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from sliplab.flows.detect import detect
from sliplab.flows.detecting.request import choose_trial, make_detect_request
from sliplab.protocols import InputError, load_plan
from sliplab.rigs.build import ShouldStop
from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.core.rig import Rig, StopRequested
from sliplab.rigs.rig_file import RigFile
from sliplab.storage.trials.store import TrialStore
from tests.command_line import here
from tests.conftest import ROOT
from tests.flows.conftest import write
from tests.flows.detect.detecting import (
    RIG,
    keeping,
    ordered,
    scripted,
    slip_when_busy,
    stands_clear,
)

# -- how it ends -----------------------------------------------------------------------------


def test_a_stop_request_stops_the_arm(
    model: Path, protocol: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rigs: list[Rig] = []
    asked: list[int] = []

    def counting(x: np.ndarray) -> np.ndarray:
        asked.append(1)
        return np.array([[9, 0, 0]])

    # as the handler of Ctrl-C does, in the middle of the slide
    monkeypatch.setattr("sliplab.flows.running.stopping.requested", lambda: len(asked) > 25)
    order = ordered(model, protocol)
    with pytest.raises(StopRequested):
        detect(order, detector=scripted(order, counting), build=keeping(rigs))
    assert stands_clear(rigs[0])
    assert len(asked) < 30


def test_a_camera_whose_clock_falls_back_ends_it(
    model: Path, protocol: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rigs: list[Rig] = []

    def build(file: RigFile, should_stop: ShouldStop) -> Rig:
        rig = keeping(rigs)(file, should_stop)
        read, count = rig.events.read, iter(range(1000))

        def fallen() -> Any:
            chunk = read()
            back_us = 5_000_000 if next(count) > 150 else 0
            return replace(chunk, t_us=chunk.t_us - back_us)

        monkeypatch.setattr(rig.events, "read", fallen)
        return rig

    order = ordered(model, protocol)
    with pytest.raises(RigError, match=r"event camera: .*fell back"):
        detect(order, detector=scripted(order, slip_when_busy()), build=build)
    assert stands_clear(rigs[0])


def test_listening_moves_nothing_and_judges_silence(model: Path, tmp_path: Path) -> None:
    quiet = {"event_camera": {"noise_hz": 0, "hot_pixels": 0}}
    silent = {"extends": str(RIG), "name": "silent", "mock": quiet}
    order = make_detect_request(write(tmp_path / "r.yaml", silent), model, seconds=1.5)
    rigs: list[Rig] = []
    result = detect(order, detector=scripted(order, slip_when_busy()), build=keeping(rigs))
    assert result["trial"] is None
    assert result["events"] == 0
    # pulses tell the time; the last 200 ms are left open
    assert 38 <= result["windows"] == result["quiet_windows"] <= 47
    assert result["latency_ms"]["n"] == 0
    assert rigs[0].position().depth_mm == pytest.approx(-60, abs=0.1)


def test_listening_ends_when_somebody_asks(model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []

    def counting(x: np.ndarray) -> np.ndarray:
        asked.append(1)
        return np.array([[9, 0, 0]])

    monkeypatch.setattr("sliplab.flows.running.stopping.requested", lambda: len(asked) > 5)
    order = make_detect_request(RIG, model, seconds=60)
    result = detect(order, detector=scripted(order, counting))
    assert result["interrupted"] is True
    assert result["windows"] < 10


def test_a_terminal_shows_bars_state_and_what_is_simulated(
    model: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown = io.StringIO()
    terminal = Console(file=shown, force_terminal=True, width=100, height=30)
    monkeypatch.setattr("sliplab.flows.running.console.messages", terminal)
    order = make_detect_request(RIG, model, seconds=0.6)
    detect(order, detector=scripted(order, slip_when_busy()))
    text = shown.getvalue()
    for part in ("simulated listening", "no slip", "9.00", "events/s", "gross"):
        assert part in text
    assert "█" in text


# -- input -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"reflex": "stop"}, "--reflex = 'stop'|--reflex = stop: needs --protocol"),
        ({}, "--seconds: is needed on rehearsal"),
        ({"trial": "", "seconds": 3.0}, "--seconds = 3.0: applies only without --protocol"),
        ({"trial": "", "reflex": "jump"}, "must be 'stop', 'press:MM' or 'grip:MM'"),
        ({"trial": "", "reflex": "press:-1"}, "must be 'stop', 'press:MM' or 'grip:MM'"),
        ({"trial": "", "reflex": "grip:0.4"}, "needs a gripper, and the rig rehearsal"),
        ({"trial": "depth=9mm"}, "fits no trial: depth=2.4mm,direction=0deg"),
        ({"seconds": 1.0, "stride_ms": 31.0}, "--stride = 31 ms: must be over 0"),
    ],
)
def test_wrong_input_is_said(
    model: Path, protocol: Path, options: dict[str, Any], said: str
) -> None:
    if "trial" in options:
        options = {**options, "protocol": protocol}
    with pytest.raises(InputError, match=said):
        make_detect_request(RIG, model, **options)


def test_a_model_that_is_none_is_said(protocol: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        make_detect_request(RIG, tmp_path / "no.pt", seconds=1.0)
    with pytest.raises(InputError, match="not a model file"):
        make_detect_request(RIG, protocol, seconds=1.0)


def test_a_file_without_a_folder_is_said_before_anything_moves(
    model: Path, protocol: Path, tmp_path: Path
) -> None:
    rigs: list[Rig] = []
    with pytest.raises(InputError, match="--out"):
        detect(ordered(model, protocol), tmp_path / "no" / "d.jsonl", build=keeping(rigs))
    assert rigs == []


def test_only_a_file_of_lines_is_replaced(model: Path, protocol: Path, tmp_path: Path) -> None:
    folder = TrialStore.create(tmp_path / "s").folder
    (lines := folder / "runs.jsonl").write_text("")
    (folder / "campaigns").mkdir(exist_ok=True)
    rigs: list[Rig] = []
    for out in (model, protocol, lines, folder / "campaigns" / "new.jsonl"):
        before = out.exists() and out.read_bytes()
        with pytest.raises(
            InputError, match=r"--out = .*(only a \.jsonl file|belongs to the store)"
        ):
            detect(ordered(model, protocol), out, build=keeping(rigs))
        assert (out.exists() and out.read_bytes()) == before
    assert rigs == []


def test_a_condition_may_leave_out_what_is_clear() -> None:
    plan = load_plan(ROOT / "protocols" / "pilot.yaml")
    wanted = "speed=1mmps, depth=2.4mm,direction=90deg"
    assert choose_trial(plan, wanted).id == "depth=2.4mm,direction=90deg,speed=1mmps,r=1"
    with pytest.raises(InputError, match=r"fits several conditions: depth=.* and 3 more"):
        choose_trial(plan, "direction=90deg")
    with pytest.raises(InputError, match="is required: choose one of the protocol's conditions"):
        choose_trial(plan, None)


def test_the_command(model: Path, tmp_path: Path) -> None:
    out = tmp_path / "d.jsonl"
    command = ("detect", "--rig", "rehearsal", "--model", model)
    done = here(*command, "--seconds", "0.5", "--out", out, "--json")
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert result["windows"] == len(out.read_text().splitlines()) > 10
    assert "simulated listening" in done.stderr
    assert here(*command).returncode == 2
