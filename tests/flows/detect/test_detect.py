"""The detector on the simulated rig: what it says of a stored trial, reflexes, and how it ends."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sliplab.analysis.detectors.live import LiveDetector
from sliplab.analysis.detectors.network_detector import NetworkDetector, counting_of
from sliplab.analysis.detectors.smoothing_rule import detect as detect_trial
from sliplab.analysis.networks.training import predict_counts
from sliplab.analysis.windows.dataset import trial_windows
from sliplab.analysis.windows.windows import bin_events
from sliplab.flows.detect import detect
from sliplab.flows.detecting.request import make_detect_request
from sliplab.protocols import InputError
from sliplab.protocols.detection import Detection
from sliplab.rigs.build import ShouldStop
from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.core.rig import Rig
from sliplab.rigs.rig_file import RigFile
from sliplab.storage.trials.recording import Recording
from tests.conftest import ROOT
from tests.flows.conftest import tiny_gravity, write
from tests.flows.detect import detecting
from tests.flows.detect.detecting import (
    RIG,
    keeping,
    ordered,
    scripted,
    slip_when_busy,
    stands_clear,
)
from tests.flows.live import only_trial, request_in


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """The same trial as `collect` takes it, by a rig that looks as often: moves end with a look."""
    folder = tmp_path_factory.mktemp("stored")
    rig_file = write(folder / "r.yaml", {"extends": str(RIG), "poll": "5 ms"})
    return only_trial(request_in(folder / "at", detecting.short_slide(), rig_file))


@pytest.mark.parametrize(("outputs", "margin"), [(1, 2.0), (4, 8.0)])
def test_the_margin_is_in_spikes_of_the_model(outputs: int, margin: float, tmp_path: Path) -> None:
    model, pilot = detecting.model_in(tmp_path, outputs), ROOT / "protocols" / "pilot.yaml"
    listening = make_detect_request(RIG, model, seconds=1.0)
    trial = "depth=2.4mm,speed=1.6mmps,direction=0deg"
    moving = make_detect_request(RIG, model, protocol=pilot, trial=trial)
    assert listening.source.detection.margin == moving.source.detection.margin == margin


# -- the same windows and decisions as offline -----------------------------------------------


def test_a_stored_trial_gives_the_offline_windows_and_decisions(stored: Recording) -> None:
    fitted, rule = detecting.untrained(), Detection(smoothing=3, margin=1)
    x, end_ns = trial_windows(stored, fitted.windows)
    counts = predict_counts(fitted, x)
    assert len(np.unique(counts, axis=0)) > 5
    whole = detect_trial(counts, end_ns, rule)

    length_ns = fitted.windows.length_ms * 1_000_000
    clock = stored.clock("events")
    starts_us = (np.asarray(clock.to_device(end_ns - length_ns)) // 1000).tolist()
    seen: list[np.ndarray] = []
    network = counting_of(fitted)

    def counting(window: np.ndarray) -> np.ndarray:
        seen.append(window)
        return network(window)

    detector = NetworkDetector(
        counting,
        fitted.windows,
        rule,
        starts=lambda number: starts_us[number] if number < len(starts_us) else 1 << 60,
    )
    live = LiveDetector(detector, origin_us=0)
    events = stored.events()
    made = []
    for begin in range(0, len(events), 997):
        piece = slice(begin, begin + 997)
        columns = {name: column[piece] for name, column in vars(events).items()}
        made += live.push(replace(events, **columns))
    made += live.advance(starts_us[-1] + length_ns // 1000)
    np.testing.assert_array_equal(np.concatenate(seen), x.dense())
    assert [item.counts for item in made] == [tuple(row) for row in counts.tolist()]
    assert [item.valid_class for item in made] == whole.valid_class.tolist()
    assert [item.smoothed for item in made] == [tuple(row) for row in whole.smoothed.tolist()]
    onsets = {item.onset: int(end) for item, end in zip(made, end_ns, strict=True) if item.onset}
    assert onsets.get("incipient") == whole.incipient_ns
    assert onsets.get("gross") == whole.gross_ns


def test_the_live_trial_is_the_stored_one(
    stored: Recording, model: Path, protocol: Path, tmp_path: Path
) -> None:
    """Same seed, same events: what is decided live is what the stored events give."""
    result = detect(ordered(model, protocol, margin=1), tmp_path / "d.jsonl")
    lines = [json.loads(line) for line in (tmp_path / "d.jsonl").read_text().splitlines()]
    assert result["windows"] == len(lines)
    assert result["simulated"] is True
    starts_us = np.array([line["start_us"] for line in lines])
    events, fitted = stored.events(), detecting.untrained()
    with stored.open() as file:
        first_pulse_us = file.pulses("event_pulses")[0] // 1000
    # what arrives first begins the windows
    assert starts_us[0] in (events.t_us[0], first_pulse_us)
    assert result["events"] == len(events)
    x = bin_events(events, starts_us, fitted.windows)
    counts = predict_counts(fitted, x)
    assert [line["counts"] for line in lines] == counts.tolist()
    whole = detect_trial(counts, (starts_us + 30_000) * 1000, Detection(margin=1))
    names = ["no_slip", "incipient", "gross", "undecided"]
    assert [names.index(line["state"]) for line in lines] == (whole.valid_class % 4).tolist()
    recorded_s = stored.record.recorded_s
    assert len(lines) >= recorded_s / 0.03 - 2
    assert {line["phase"] for line in lines} == {"hold", "slide"}
    # the simulated camera hands over blocks of 32 ms, and they are read every 5 ms
    assert 0 <= result["latency_ms"]["median"] - result["compute_ms"]["median"] < 60


# -- reflexes --------------------------------------------------------------------------------


def test_a_stop_keeps_the_arm_where_it_is_and_then_leaves_straight_out(
    model: Path, protocol: Path
) -> None:
    rigs: list[Rig] = []
    order = ordered(model, protocol, reflex="stop", hold_s=0.3)
    result = detect(order, detector=scripted(order, slip_when_busy()), build=keeping(rigs))
    reflex = result["reflex"]
    assert reflex["done"]
    assert reflex["phase"] == "slide"
    x, y, depth = reflex["stopped_mm"]
    assert -3.4 < x < 3.0  # it would have gone from -3.5 to 3.5 mm
    assert (y, depth) == (pytest.approx(0, abs=0.01), pytest.approx(2.4, abs=0.01))
    assert reflex["depth_mm"] == pytest.approx(2.4, abs=0.01)
    assert result["onsets"]["incipient"]["phase"] == "slide"
    assert stands_clear(rigs[0])


def test_pressing_on_goes_as_deep_as_was_said(model: Path, protocol: Path) -> None:
    rigs: list[Rig] = []
    order = ordered(model, protocol, reflex="press:0.5", hold_s=0.1)
    reflex = detect(order, detector=scripted(order, slip_when_busy()), build=keeping(rigs))[
        "reflex"
    ]
    assert reflex["depth_mm"] == pytest.approx(2.9, abs=0.01)
    assert reflex["stopped_mm"][2] == pytest.approx(2.4, abs=0.01)
    assert stands_clear(rigs[0])


def test_no_reflex_goes_deeper_than_the_limit(model: Path, protocol: Path) -> None:
    with pytest.raises(InputError, match=r"3\.7 mm; the protocol's limits.depth is 3\.6 mm"):
        ordered(model, protocol, reflex="press:1.3")
    order = ordered(model, protocol, reflex="press:1.1", hold_s=0.0)
    assert order.reflex is not None
    # where the arm stands deeper than it was told to, the limit still holds
    deeper = replace(order, reflex=replace(order.reflex, deepest_mm=3.0))
    reflex = detect(deeper, detector=scripted(deeper, slip_when_busy()))["reflex"]
    assert reflex["depth_mm"] == pytest.approx(3.0, abs=0.01)


def test_a_reflex_that_fails_stops_the_arm(
    model: Path, protocol: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rigs: list[Rig] = []
    move, stopped = Rig.move, []

    def failing(rig: Rig, step: Any, *rest: Any) -> Any:
        if step.phase == "reflex":
            rig.arm.start([])
            raise RigError("arm", "does not want to")
        return move(rig, step, *rest)

    def build(file: RigFile, should_stop: ShouldStop) -> Rig:
        rig = keeping(rigs)(file, should_stop)
        stop = rig.arm.stop
        monkeypatch.setattr(rig.arm, "stop", lambda: (stopped.append(1), stop())[1])
        return rig

    monkeypatch.setattr(Rig, "move", failing)
    order = ordered(model, protocol, reflex="press:0.5")
    with pytest.raises(RigError, match="does not want to"):
        detect(order, detector=scripted(order, slip_when_busy()), build=build)
    assert len(stopped) >= 2  # by the reflex, and because it failed
    assert stands_clear(rigs[0])


def test_a_false_alarm_in_the_hold_moves_nothing(model: Path, protocol: Path) -> None:
    order = ordered(model, protocol, reflex="stop")
    result = detect(order, detector=scripted(order, slip_when_busy(-1)), build=keeping([]))
    # slip is said of every window, so the first in the slide calls for it, and none before
    assert result["onsets"]["incipient"]["phase"] == "hold"
    assert result["reflex"]["phase"] == "slide"


@pytest.mark.long
def test_a_reflex_in_a_retraction_keeps_the_plate(model: Path, tmp_path: Path) -> None:
    data = tiny_gravity()
    data["collection"]["motion"][5] |= {"settle": "0.3 s", "duration": "0.3 s"}
    protocol = write(tmp_path / "g.yaml", data)
    options = {"trial": "mass=0.165kg", "reflex": "stop", "hold_s": 0.2}
    order = make_detect_request(RIG, model, protocol=protocol, **options)
    rigs: list[Rig] = []
    truth: list[dict[str, Any]] = []
    begun = [0]

    def look(rig: Rig, phase: str) -> None:
        assert rig.simulation is not None
        if phase == "retract":
            begun[0] = rig.arm.now_ns()
        if phase == "release":
            truth.append(rig.simulation.truth(begun[0]))

    scripts = scripted(order, slip_when_busy(80))
    result = detect(order, detector=scripts, build=keeping(rigs), on_step=look)
    assert result["reflex"]["phase"] == "retract"
    assert [found["gross_ns"] for found in truth] == [None]  # the plate never fell
    scripts = scripted(order, slip_when_busy(80))
    watched = detect(
        replace(order, reflex=None), detector=scripts, build=keeping(rigs), on_step=look
    )
    assert watched["reflex"] is None
    assert truth[1]["gross_ns"] is not None
    assert result["reflex"]["stopped_mm"][2] < 3.4
    assert stands_clear(rigs[0])
    plate = rigs[0].plate
    assert plate.mass_kg() == 0.165
