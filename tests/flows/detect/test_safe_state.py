"""Grips, and the safe state that a lost stream, a dead network or a late decision leads to."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Callable
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sliplab.analysis.detectors.network_detector import Counting
from sliplab.flows.detect import detect
from sliplab.flows.detecting.detector_process import NetworkLost, NetworkProcess, OwnProcess
from sliplab.flows.detecting.request import DetectRequest, make_detect_request
from sliplab.protocols import InputError
from sliplab.rigs.build import ShouldStop
from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.core.reacting import SafeState
from sliplab.rigs.core.real_time import real_time
from sliplab.rigs.core.rig import Rig
from sliplab.rigs.rig_file import RigFile, load_rig_file
from sliplab.storage.streams import EventChunk
from tests.command_line import here
from tests.conftest import ROOT
from tests.flows.conftest import write
from tests.flows.detect.detecting import keeping, scripted, slip_when_busy, stands_clear, untrained
from tests.patching import loose, put

RIG = ROOT / "rigs" / "mock_gripper.yaml"
STREAM_MS, DECISION_MS, REST_MS = 200.0, 100.0, 200.0
"""Timeouts of that rig file."""


@pytest.fixture
def gripping(model: Path, protocol: Path, tmp_path: Path) -> Callable[..., DetectRequest]:
    """A trial on the rig with a gripper, with changes of its file."""

    def request(action: str = "grip:0.4", **change: Any) -> DetectRequest:
        file = write(tmp_path / "rig.yaml", {"extends": str(RIG), **change})
        options = {"protocol": protocol, "trial": "", "reflex": action, "hold_s": 0.2}
        return make_detect_request(file, model, **options)

    return request


Gripping = Callable[..., DetectRequest]


def gone(device: str, at_s: float) -> dict[str, Any]:
    """A simulated rig of which a device goes."""
    return {"faults": [{"kind": "device_gone", "device": device, "at_s": at_s}]}


def quiet(x: np.ndarray) -> np.ndarray:
    """A network that never sees slip."""
    return np.array([[9, 0, 0]], np.int64)


def safe_state(
    order: DetectRequest, counting: Counting, disturb: Callable[[Rig], None] = lambda rig: None
) -> tuple[SafeState, Rig]:
    """Run until the safe state, and return it and the rig."""
    rigs: list[Rig] = []

    def build(file: RigFile, should_stop: ShouldStop) -> Rig:
        rig = keeping(rigs)(file, should_stop)
        disturb(rig)
        return rig

    with pytest.raises(SafeState) as found:
        detect(order, detector=scripted(order, counting), build=build)
    return found.value, rigs[0]


# -- the safe state --------------------------------------------------------------------------


def test_a_lost_stream_tightens_the_grip_and_the_arm_stays(gripping: Gripping) -> None:
    """The camera sends nothing any more, neither events nor pulses."""
    silent_ns: list[int] = []

    def disturb(rig: Rig) -> None:
        read, pulses = rig.events.read, rig.events.read_pulses

        def silent() -> bool:
            here = rig.position().x_mm > 0
            if here and not silent_ns:
                silent_ns.append(rig.clock.now_ns())
            return here

        nothing = EventChunk(*(np.empty(0, t) for t in (np.uint16, np.uint16, np.uint8, np.int64)))
        put(rig.events, "read", lambda: nothing if silent() else read())
        rig.events.read_pulses = (  # type: ignore[method-assign]
            lambda: type(pulses())(np.empty(0, np.int64)) if silent() else pulses()
        )

    order = gripping()
    error, rig = safe_state(order, quiet, disturb)
    assert "neither events nor pulses" in error.cause
    assert "the safe state 'grip' was reached" in str(error)
    reaction = error.reaction
    assert reaction.phase == "slide"
    assert reaction.closed_mm == pytest.approx(0.2)
    assert reaction.depth_mm == pytest.approx(2.6, abs=0.01)
    # in bounded time: the timeout, one poll, and the fingers; then the arm is seen at rest
    ended_ms = (rig.clock.now_ns() - silent_ns[0]) / 1e6
    assert ended_ms < STREAM_MS + 100.0 + REST_MS
    assert rig.arm.progress().done
    assert rig.position().depth_mm == pytest.approx(2.4, abs=0.01)  # not moved clear
    assert -3.5 < rig.position().x_mm < 3.4


def test_a_stream_that_lags_more_and_more_leads_to_the_safe_state(gripping: Gripping) -> None:
    """What was read arrives at half the rate: all data are newer, and later, than the last."""
    ages_ms = [0.0]

    def slowed(read: Callable[[], Any], rig: Rig) -> Callable[[], Any]:
        waiting: list[tuple[int, Any]] = []
        reads = count()

        def lagging() -> Any:
            now_ns, new = rig.clock.now_ns(), read()
            waiting.append((now_ns, new))
            if rig.position().x_mm <= -2.0:
                return waiting.pop(0)[1]
            if next(reads) % 2:
                return new[:0]
            ages_ms.append((now_ns - waiting[0][0]) / 1e6)
            return waiting.pop(0)[1]

        return lagging

    def disturb(rig: Rig) -> None:
        put(rig.events, "read", slowed(rig.events.read, rig))
        put(rig.events, "read_pulses", slowed(rig.events.read_pulses, rig))

    error, rig = safe_state(gripping(), quiet, disturb)
    assert "neither events nor pulses" in error.cause
    assert max(ages_ms) < 2 * STREAM_MS + 100.0
    assert rig.position().depth_mm > 2.0


@pytest.mark.parametrize(("at_s", "phase"), [(0.1, "hold"), (1.0, "slide")])
def test_a_camera_that_fails_leads_to_the_safe_state(
    gripping: Gripping, at_s: float, phase: str
) -> None:
    error, rig = safe_state(gripping(mock=gone("event_camera", at_s)), quiet)
    assert "event camera: does not answer" in error.cause
    assert (error.reaction.phase, error.reaction.closed_mm) == (phase, pytest.approx(0.2))
    assert rig.position().depth_mm > 2.0


def test_a_dead_network_leads_to_the_safe_state(model: Path, gripping: Gripping) -> None:
    network = NetworkProcess(model, OwnProcess(30.0))
    asked: list[int] = []

    def dying(x: np.ndarray) -> np.ndarray:
        asked.append(1)
        if len(asked) == 30:
            network.kill()
        return quiet(x) if network(x).shape == (1, 3) else x

    order = gripping(reflex={"safe_state": "stop"})
    error, rig = safe_state(order, dying)
    assert len(asked) == 30  # at once
    assert "network: counts: the network's process has exited" in error.cause
    assert error.reaction.closed_mm == 0.0
    assert rig.position().depth_mm > 2.0
    network.close()


def test_a_late_decision_leads_to_the_safe_state(gripping: Gripping) -> None:
    rigs: list[Rig] = []
    asked: list[int] = []

    def slow(x: np.ndarray) -> np.ndarray:
        asked.append(1)
        if len(asked) == 25:
            rigs[0].clock.wait((DECISION_MS + 1.0) / 1e3)
        return quiet(x)

    order = gripping()
    error, _ = safe_state(order, slow, rigs.append)
    assert "a decision took 101 ms, and reflex.decision_timeout is 100 ms" in error.cause
    assert len(asked) < 30


def test_whatever_a_detector_raises_leads_to_the_safe_state(gripping: Gripping) -> None:
    asked: list[int] = []

    def failing(x: np.ndarray) -> np.ndarray:
        asked.append(1)
        return quiet(x) if len(asked) < 25 else quiet(x).no_such_thing

    error, rig = safe_state(gripping(), failing)
    assert "detector: AttributeError: 'numpy.ndarray' object has no attribute" in error.cause
    assert rig.position().depth_mm > 2.0


def test_a_gripper_that_fails_leaves_the_arm_stopped_in_contact(gripping: Gripping) -> None:
    order = gripping(mock=gone("gripper", 0.6))
    error, rig = safe_state(order, slip_when_busy())
    assert "gripper: does not answer" in error.cause
    assert "the safe state 'stop'" in str(error)
    assert rig.position().depth_mm > 2.0
    assert rig.arm.progress().done


def test_without_a_safe_state_a_failure_moves_the_arm_clear(gripping: Gripping) -> None:
    order = gripping(mock=gone("event_camera", 1.0), reflex=None)
    rigs: list[Rig] = []
    with pytest.raises(RigError, match="event camera") as found:
        detect(order, detector=scripted(order, quiet), build=keeping(rigs))
    assert not isinstance(found.value, SafeState)
    assert stands_clear(rigs[0])


@pytest.mark.parametrize("how", ["silent", "frozen"])
@pytest.mark.parametrize("stays", [False, True], ids=["no safe state", "safe state"])
def test_events_that_stop_or_freeze_stop_a_reflex_trial(
    stays: bool, how: str, gripping: Gripping
) -> None:
    """With a safe state the arm stays; without one it moves clear, as after any failure."""
    rigs: list[Rig] = []

    def build(file: RigFile, should_stop: ShouldStop) -> Rig:
        rig = keeping(rigs)(file, should_stop)
        read, pulses = rig.events.read, rig.events.read_pulses

        def lost() -> bool:
            return rig.position().x_mm > 0

        def events() -> EventChunk:
            chunk = read()
            if not lost():
                return chunk
            if how == "frozen" and len(chunk):
                rows = np.zeros(len(chunk), int)
                kept = {name: column[rows] for name, column in vars(chunk).items()}
                return EventChunk(**kept | {"t_us": np.full(len(chunk), stamps[-1], np.int64)})
            if len(chunk):
                stamps.append(int(chunk.t_us.max()))
            return chunk[:0]

        stamps = [0]
        put(rig.events, "read", events)
        rig.events.read_pulses = (  # type: ignore[method-assign]
            lambda: type(pulses())(np.empty(0, np.int64)) if lost() else pulses()
        )
        return rig

    order = gripping(reflex={"safe_state": "stop"} if stays else None)
    expected = SafeState if stays else RigError
    said = "event camera: neither events nor pulses|event camera: .*clock|fell back"
    with pytest.raises(expected, match=said):
        detect(order, detector=scripted(order, quiet), build=build)
    assert rigs[0].arm.progress().done
    assert (rigs[0].position().depth_mm < 0) != stays


@pytest.mark.long
def test_the_command_says_what_was_lost_and_fails(
    model: Path, protocol: Path, tmp_path: Path
) -> None:
    change = {"extends": str(RIG), "mock": gone("event_camera", 1.0)}
    asked = ("--rig", write(tmp_path / "rig.yaml", change), "--model", model, "--json")
    trial = ("--protocol", protocol, "--trial", "depth=2.4mm", "--reflex", "grip:0.4")
    done = here("detect", *asked, *trial)
    assert done.returncode == 1
    error = json.loads(done.stdout)["error"]
    assert "event camera: does not answer" in error["message"]
    assert "the safe state 'grip' was reached" in error["message"]
    assert "secure the object, then move the arm clear" in error["message"]


# -- grips -----------------------------------------------------------------------------------


def test_a_grip_stops_the_arm_and_goes_as_deep_as_was_said(gripping: Gripping) -> None:
    rigs: list[Rig] = []
    order = gripping()
    result = detect(order, detector=scripted(order, slip_when_busy()), build=keeping(rigs))
    reflex = result["reflex"]
    assert (reflex["done"], reflex["stalled"]) == (True, False)
    assert reflex["stopped_mm"][2] == pytest.approx(2.4, abs=0.01)
    assert reflex["depth_mm"] == pytest.approx(2.8, abs=0.01)
    assert reflex["closed_mm"] == pytest.approx(0.4)
    parts = reflex["reaction_ms"]
    assert parts["window"] == 120.0  # four windows of 30 ms
    assert 0.0 <= parts["sensor"] < 60.0
    # 8 ms of reaction, and 40 ms for 0.4 mm at 1000 mm/s², looked at every 2 ms
    assert parts["actuator"] == pytest.approx(48.0, abs=4.0)
    assert parts["total"] == pytest.approx(sum(parts.values()) - parts["total"])
    assert stands_clear(rigs[0])
    # the next trial begins with open fingers
    rig = rigs[0]
    rig.connect()
    rig.begin_trial(loose(order.plan).program(order.trial).home, 1)
    assert rig.gripper.state().opening_mm == pytest.approx(40.0)


def test_a_grip_stalls_at_the_force_of_the_rig_file(gripping: Gripping) -> None:
    weak = {"mock": {"gripper": {"force_n": [2.0, 50.0]}}, "reflex": {"force": "2 N"}}
    order = gripping("grip:1", **weak)
    reflex = detect(order, detector=scripted(order, slip_when_busy()))["reflex"]
    assert reflex["stalled"]
    assert 0.0 < reflex["closed_mm"] < 0.5


def test_a_grip_ends_at_the_deepest_place(gripping: Gripping) -> None:
    with pytest.raises(InputError, match=r"3\.7 mm; the protocol's limits.depth is 3\.6 mm"):
        gripping("grip:1.3")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"reflex": {"grip": None}}, "reflex.grip.*is needed by safe_state: grip"),
        ({"mock": {"gripper": None}}, "reflex.safe_state = grip: needs a gripper"),
        ({"reflex": {"force": "60 N"}}, "reflex.force.*must be from 5 to 50 N"),
        ({"reflex": {"stream_timeout": "30 ms"}}, "must be over 32 ms, the camera's blocks"),
        ({"reflex": {"safe_state": "drop"}}, "reflex.safe_state.*'stop' or 'grip'"),
        ({"reflex": {"decision_timeout": 100}}, "reflex.decision_timeout.*has no unit"),
        ({"reflex": {"decision_timeout": "5.1 s"}}, "reflex.decision_timeout = 5.1 s: must be at"),
        ({"reflex": {"stream_timeout": "999999 s"}}, "reflex.stream_timeout.*must be at most 5 s"),
        ({"mock": {"gripper": {"opening_mm": 90}}}, "mock.gripper.opening_mm = 90"),
    ],
)
def test_wrong_rig_files_are_said(change: dict[str, Any], said: str, tmp_path: Path) -> None:
    file = write(tmp_path / "rig.yaml", {"extends": str(RIG), **change})
    with pytest.raises(InputError, match=said):
        load_rig_file(file)


def test_a_loopback_rig_needs_the_fingers_that_its_gripper_moves(tmp_path: Path) -> None:
    shipped = ROOT / "rigs" / "loopback_gripper.yaml"
    for fingers in (None, {"opening_mm": 30}):
        change = {"extends": str(shipped), "mock": {"gripper": fingers}}
        with pytest.raises(InputError, match=r"mock.gripper.opening_mm.* must be 40: the fake of"):
            load_rig_file(write(tmp_path / "rig.yaml", change))
    allowed = load_rig_file(shipped)[0].gripper_range
    assert allowed.force_n == (20.0, 235.0)


def test_limits_of_force_hold_for_grips(gripping: Gripping) -> None:
    with pytest.raises(InputError, match=r"limits.force is 10 N: set reflex.force to less"):
        gripping(mock={"force": {}}, limits={"force": "10 N"})


# -- the network's process -------------------------------------------------------------------


@pytest.mark.long
def test_the_network_in_its_process_is_the_network_and_a_hang_ends_in_time(model: Path) -> None:
    from sliplab.analysis.detectors.network_detector import counting_of

    windows = untrained().windows
    shape = (1, windows.steps, windows.channels, windows.cells, windows.cells)
    x = np.random.default_rng(1).integers(0, 3, shape).astype(np.uint8)
    network = NetworkProcess(model, OwnProcess(30.0, real_time=True))
    np.testing.assert_array_equal(network(x), counting_of(untrained())(x))
    with pytest.raises(NetworkLost):  # a window that is none: the process survives it
        network(x[:, :1, :, :3])
    network(x)
    with real_time() as refused:
        first = "rtprio" not in refused
    policy = os.sched_getscheduler(network.pid) & ~os.SCHED_RESET_ON_FORK
    assert policy == (os.SCHED_RR if first else os.SCHED_OTHER)
    network._answer_s = 0.5
    os.kill(network.pid, signal.SIGSTOP)
    with pytest.raises(NetworkLost, match=r"no answer within 0\.5 s"):
        network(x)
    with pytest.raises(NetworkLost, match="has exited"):  # it was ended
        network(x)
    network.close()


@pytest.mark.long  # `test_detect_ends` has one that is refused before
def test_a_model_that_is_none_does_not_start(tmp_path: Path) -> None:
    bad = tmp_path / "bad.pt"
    bad.write_text(json.dumps({}))
    with pytest.raises(NetworkLost, match="not a model file"):
        NetworkProcess(bad, OwnProcess(1.0))
