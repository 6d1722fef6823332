"""Faults in one campaign on a loopback rig: the arm stops, a person is told what to do.

Every fault happens once the sensor has passed a point of its slide. How long the arm went on is
reckoned from how far it went on, so it does not matter how quick this test is. Bounds are the
drivers' own; `BUSY_S` is what a machine with other work may add.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, cast

import pytest

from sliplab.flows.collecting.session import TrialCollector
from sliplab.flows.planning.campaign_trials import pending_trials
from sliplab.flows.planning.run_request import RunRequest
from sliplab.plugins.devices.ur.driver import UrArm
from sliplab.plugins.devices.ur.settings import SILENCE_S, WATCHDOG_HZ
from sliplab.plugins.loopback.client import Loopback
from sliplab.rigs.build import calibrated_arm
from sliplab.rigs.core.capabilities import ArmFault, ArmState, RigError
from sliplab.storage.files import read_json
from sliplab.storage.trials.store import Campaign, TrialStore
from sliplab.storage.trials.verify import verify
from tests.flows.collecting.test_session import checksums
from tests.flows.live import at_work, quick, request_in, rig_yaml, stage_of
from tests.rigs.waiting import until

pytestmark = [pytest.mark.realtime, pytest.mark.xdist_group("scene")]

BUSY_S = 1.5
SPEED_MM_S, LENGTH_MM, DEPTH_MM = 2.5, 7.0, 2.4
PAST_MM = 0.5
POLL_S = 0.1
"""Of the rig file: how often streams are read."""
STOP_S = 0.5
"""From a fault being read to the arm at rest, over its control client."""
WATCHING_S = 30.0
"""The longest that anybody waits for the slide to pass a point."""


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Loopback, RunRequest]]:
    """Fakes for all tests here, and the campaign of which each takes the next trial."""
    folder = tmp_path_factory.mktemp("faults")
    data = quick(LENGTH_MM, SPEED_MM_S, repetitions=len(CASES) + 2)
    run_request = request_in(folder / "begin", data, rig_yaml(folder))
    with stage_of(run_request.rig) as stage:
        yield stage, run_request


def take_next(work: TrialCollector) -> None:
    """Take the campaign's next trial."""
    work.take(pending_trials(work.plan, work.campaign)[:1])


def new_in_quarantine(campaign: Campaign, before: list[Any]) -> dict[str, Any]:
    """The one trial that was set aside since."""
    (new,) = [item for item in campaign.quarantined() if item not in before]
    return dict(new)


@contextmanager
def once_sliding(stage: Loopback, do: Callable[[], Any]) -> Iterator[Future[tuple[float, Any]]]:
    """Does something as soon as the arm slides: where it was then (mm), and what came of it."""

    def watch() -> tuple[float, Any]:
        pause, place = threading.Event(), (0.0, 0.0, 0.0)

        def slides() -> bool:
            nonlocal place
            place = stage.arm_place()
            pause.wait(0.005)
            return place[2] > DEPTH_MM - 0.2 and -LENGTH_MM / 2 + PAST_MM < place[0] < 0.0

        until(slides, WATCHING_S)
        return place[0], do()

    with ThreadPoolExecutor(1) as pool:
        yield pool.submit(watch)


@dataclass(frozen=True)
class Case:
    """A fault, what the person at the rig reads, and for how long the arm may go on."""

    device: str
    kind: str
    says: str
    advises: str
    bound_s: float


CASES = [
    Case("arm", "arm_protective_stop", "protective stop", "unlock the stop at the pendant", 0.05),
    Case(
        "arm",
        "device_gone",
        "may still move: check power and network",
        "its own watchdog ends a move after 1 s",
        1 / WATCHDOG_HZ,
    ),
    Case(
        "arm",
        "device_silent",
        "may still move: check power and network",
        "its own watchdog ends a move after 1 s",
        1 / WATCHDOG_HZ,
    ),
    Case(
        "frame_camera",
        "device_gone",
        "frame camera: the camera was unplugged",
        "plug it in",
        0.1 + POLL_S + STOP_S,
    ),
    Case(
        "event_camera",
        "event_stall",
        "event camera: sent no event and no pulse",
        "check cable",
        1.0 + POLL_S + STOP_S,
    ),
    Case(
        "event_camera",
        "device_gone",
        "event camera: the connection is lost",
        "check its cable",
        POLL_S + STOP_S,
    ),
    Case(
        "sync_box",
        "clock_restart",
        "sync box: .*restarted",
        "start the trial again",
        POLL_S + STOP_S,
    ),
    Case(
        "sync_box", "device_gone", "sync box: the connection broke", "Plug it in", POLL_S + STOP_S
    ),
]


FIRST = {("arm", "arm_protective_stop"), ("sync_box", "device_gone")}
"""Tried every time; a further event camera is unplugged in test_loopback_streams.py."""


@pytest.mark.quick(1)
@pytest.mark.parametrize(
    "case",
    [
        pytest.param(
            case,
            id=f"{case.device}-{case.kind}",
            marks=() if (case.device, case.kind) in FIRST else pytest.mark.long,
        )
        for case in CASES
    ],
)
def test_the_arm_stops_the_trial_is_put_aside_and_the_next_one_is_good(
    scene: tuple[Loopback, RunRequest], case: Case
) -> None:
    stage, run_request = scene
    with at_work(run_request, stage) as (work, campaign):
        good, aside = checksums(campaign), campaign.quarantined()

        def happen() -> None:
            if case.device == "frame_camera":
                cast("Any", work.rig.frames).device.unplug()
            else:
                stage.inject(case.device, case.kind)

        with once_sliding(stage, happen) as happened:
            with pytest.raises(RigError, match=f"{case.says}.*{case.advises}") as raised:
                take_next(work)
            at_mm, _ = happened.result(WATCHING_S)
        until(stage.at_rest, case.bound_s + BUSY_S)
        x_mm, _, depth_mm = stage.arm_place()
        went_on_s = (x_mm - at_mm) / SPEED_MM_S
        print(
            f"{case.device} {case.kind}: simulated arm went on for {went_on_s:.2f} s; "
            f"{raised.value}"
        )
        assert 0 <= went_on_s <= case.bound_s + BUSY_S
        assert x_mm < LENGTH_MM / 2 - 0.5  # not just the end of the slide
        if case.device == "arm":
            assert isinstance(raised.value, ArmFault)
            assert depth_mm == pytest.approx(DEPTH_MM, abs=0.1)  # an unhealthy arm is not moved
        else:
            assert depth_mm == pytest.approx(-1.0, abs=0.1)  # clear of the plate
    assert checksums(campaign) == good
    assert campaign.failed_attempts() == {}
    failed = new_in_quarantine(campaign, aside)
    assert str(raised.value) in failed["cause"]
    kept = read_json(campaign.folder / "quarantine" / failed["folder"] / "cause.json")
    assert kept["cause"] == f"{type(raised.value).__name__}: {raised.value}"
    if case.kind == "arm_protective_stop":
        nobody_unlocks_it(run_request, stage)
    put_right(stage, case.device)
    with at_work(run_request, stage) as (work, campaign):
        take_next(work)
        assert work.rig.arm.state() is ArmState.READY
    assert new_in_quarantine(campaign, aside) == failed
    now = checksums(campaign)
    assert good.items() <= now.items()
    assert now.keys() - good.keys() == {failed["trial"]}
    assert verify(TrialStore.open(run_request.store)) == []


def nobody_unlocks_it(run_request: RunRequest, stage: Loopback) -> None:
    """The same command again, with nobody at the pendant in between, is refused."""
    with (
        pytest.raises(ArmFault, match="protective stop; clear the cause and unlock the stop"),
        at_work(run_request, stage),
    ):
        pytest.fail("it took control of a stopped arm")


def put_right(stage: Loopback, device: str) -> None:
    """A person goes there; done when the arm stands clear of the plate."""
    if device != "frame_camera":  # plugging that one in is opening it again
        stage.restore(device)
    until(stage.at_rest, 5.0)
    assert stage.arm_place()[2] < 0


@pytest.mark.long
def test_frames_that_are_lost_are_noticed_and_the_trial_is_taken_again(
    scene: tuple[Loopback, RunRequest],
) -> None:
    stage, run_request = scene
    with at_work(run_request, stage) as (work, campaign):
        aside = campaign.quarantined()
        camera = cast("Any", work.rig.frames)
        with once_sliding(stage, lambda: camera.device.drop_frames(3)):
            take_next(work)
    assert (work.taken, work.retaken) == (2, 1)
    failed = new_in_quarantine(campaign, aside)
    # a busy machine may lose one more
    assert re.fullmatch(r"gate: frames_lost = [3-9] \(limit 0\)", failed["cause"])
    assert campaign.recording(failed["trial"]).record.attempt == 1
    assert verify(TrialStore.open(run_request.store)) == []


@pytest.mark.long
def test_a_second_program_gets_no_arm_that_slides(scene: tuple[Loopback, RunRequest]) -> None:
    stage, run_request = scene
    assert run_request.rig.devices is not None
    second = UrArm(cast("Any", calibrated_arm(run_request.rig, run_request.rig.devices)))

    def take_it() -> str:
        with pytest.raises(ArmFault) as refused:
            second.connect()
        second.close()
        return str(refused.value)

    with at_work(run_request, stage) as (work, campaign):
        good = campaign.committed()
        with once_sliding(stage, take_it) as tried:
            take_next(work)
        _, said = tried.result(SILENCE_S)
    assert said == "arm: a program is already running on it; end it at the pendant first"
    assert (work.taken, work.retaken) == (1, 0)
    assert len(campaign.committed()) == len(good) + 1
