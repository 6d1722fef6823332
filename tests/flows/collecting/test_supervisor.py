"""Between two trials: requests from another terminal, and the time window; without waiting."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pytest

from sliplab.flows.collecting import preparation
from sliplab.flows.collecting import supervisor as supervising
from sliplab.flows.collecting.requests import CampaignStopped, carry_out, refuse_paused
from sliplab.flows.collecting.session import TrialCollector, open_session
from sliplab.flows.collecting.supervisor import CollectionSupervisor, WindowOver
from sliplab.flows.planning.campaign_trials import excluded_trials, pending_trials
from sliplab.flows.planning.run_request import RunRequest, describe_campaign
from sliplab.flows.running import stopping
from sliplab.protocols import PlannedTrial
from sliplab.protocols.program import Position
from sliplab.rigs.core import surface_search
from sliplab.rigs.core.capabilities import Segment
from sliplab.rigs.rig_file import load_rig_file
from sliplab.storage.trials import control
from sliplab.storage.trials.control import skipped
from sliplab.storage.trials.store import Campaign, TrialStore
from sliplab.storage.trials.verify import verify
from tests.conftest import ROOT
from tests.crash import campaign as crash
from tests.flows.collecting.test_session import checksums, session, short
from tests.flows.conftest import requested, tiny_gravity
from tests.patching import put


def supervised(
    folder: Path, data: dict[str, Any] | None = None, **mock: Any
) -> tuple[TrialCollector, Campaign, TrialStore]:
    """A collector with a supervisor, whose waits fail unless a test says what happens in them."""
    work, campaign = session(folder, data or short(), **mock)
    store = TrialStore.open(folder / "store")
    work.supervisor = CollectionSupervisor(requested(folder), store, campaign)

    def never(seconds: float) -> None:
        raise AssertionError("waits")

    work.supervisor.wait = never
    return work, campaign, store


def after_first(work: TrialCollector, do: Callable[[], object]) -> list[tuple[str, str]]:
    """Take what is pending; `do` is called during the first trial; return outcomes."""
    outcomes: list[tuple[str, str]] = []

    def on_trial(trial: PlannedTrial, outcome: str) -> None:
        if not outcomes:
            do()
        outcomes.append((trial.id, outcome))

    work.on_trial = on_trial
    work.take(pending_trials(work.plan, work.campaign))
    return outcomes


def test_a_pause_stands_still_between_trials_and_changes_no_data(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain, untouched = session(tmp_path / "plain", short())
    plain.take(pending_trials(plain.plan, untouched))
    work, campaign, store = supervised(tmp_path / "a")
    waits: list[float] = []
    pauses: list[float] = []
    reasons: list[str] = []
    during: list[int] = []

    def wait(seconds: float) -> None:
        waits.append(seconds)
        during.append(len(campaign.committed()))
        if len(waits) == 3:
            control.ask(store, "resume", who="ben")

    work.supervisor.wait = wait
    monkeypatch.setattr(work.supervisor.listener, "on_paused", reasons.append)
    monkeypatch.setattr(work.supervisor.listener, "on_resumed", pauses.append)
    after_first(work, lambda: control.ask(store, "pause", who="anna", why="lunch"))
    assert during == [1, 1, 1]
    assert pauses == [3 * supervising.POLL_S]
    (reason,) = reasons
    assert reason.startswith("paused before ")
    assert "anna" in reason
    assert "lunch" in reason
    asked = control.requests(store)
    known = [(item.kind, item.who, item.why) for item in asked]
    assert known == [("pause", "anna", "lunch"), ("resume", "ben", "")]
    answers = [control.answered(store, item) for item in asked]
    assert [answer and answer["did"]["paused"] for answer in answers] == [True, False]
    assert checksums(campaign) == checksums(untouched)


def test_a_pause_that_nobody_ends_ends_the_stretch(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(supervising, "PAUSE_LIMIT_S", 2.0)
    work, campaign, store = supervised(tmp_path / "a")
    work.supervisor.wait = lambda seconds: None
    with pytest.raises(CampaignStopped, match=r"pause by anna.*nobody resumed it: `sliplab resume"):
        after_first(work, lambda: control.ask(store, "pause", who="anna"))
    assert len(campaign.committed()) == 1
    with pytest.raises(CampaignStopped, match="is paused"):
        refuse_paused(store)
    control.ask(store, "resume")
    refuse_paused(store)


def test_after_a_pause_the_skin_is_warmed_up_and_zero_found_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = short()
    warm_up = {"presses": 1, "depth": "2.4 mm", "speed": "2 mm/s", "clearance": "5 mm"}
    data["collection"]["maintenance"]["warm_up"] = warm_up
    work, campaign, store = supervised(tmp_path / "a", data)
    done: list[str] = []
    press, touch_off = work.rig.press, surface_search.touch_off
    put(work.rig, "press", lambda *given: (done.append("warm up"), press(*given))[1])
    for module in (preparation, surface_search):
        monkeypatch.setattr(
            module, "touch_off", lambda *given: (done.append("zero"), touch_off(*given))[1]
        )
    work.supervisor.wait = lambda seconds: control.ask(store, "resume") and None
    after_first(work, lambda: control.ask(store, "pause"))
    assert done == ["zero", "warm up", "zero"] * 2
    assert len(campaign.committed()) == 3


def test_a_stop_that_came_by_file_is_heeded_at_the_next_boundary(tmp_path: Path) -> None:
    work, campaign, store = supervised(tmp_path / "a")
    with pytest.raises(KeyboardInterrupt):
        after_first(work, lambda: control.ask(store, "stop", why="smoke"))
    assert stopping.requested()
    assert len(campaign.committed()) == 1
    assert campaign.quarantined() == []
    (request,) = control.requests(store)
    answer = control.answered(store, request)
    assert answer["did"]["stopped"]


def test_an_old_stop_stops_nothing_that_begins_later(tmp_path: Path) -> None:
    work, _, store = supervised(tmp_path / "a")
    work.rig.close()
    control.ask(store, "stop")
    with open_session(requested(tmp_path / "a")) as work_now:
        work_now.collector.rig.connect()
        work_now.collector.take(work_now.trials)
        assert work_now.collector.taken == 3


def test_trials_are_set_aside_and_wanted_again_while_it_runs(tmp_path: Path) -> None:
    work, campaign, store = supervised(tmp_path / "a")
    first, second, third = (trial.id for trial in work.plan)
    by = {"who": "anna", "why": "cable in the way"}

    def ask() -> None:
        control.ask(store, "skip", campaign="tiny", trials=(second, first), **by)
        control.ask(store, "again", campaign="tiny", trials=(first,), who="ben", why="dust")

    outcomes = after_first(work, ask)
    assert outcomes == [(first, "committed"), (second, "skipped"), (third, "committed")]
    (request, _) = control.requests(store)
    answer = control.answered(store, request)
    assert answer["did"]["trials"] == {second: "set aside", first: "is committed: left as it is"}
    (aside,) = excluded_trials(work.plan, campaign)
    assert (aside["trial"], aside["cause"], aside["by"]) == (second, "cable in the way", "anna")
    assert skipped(campaign)[second]["request"] == 1
    (kept,) = campaign.quarantined()
    assert (kept["cause"], kept["asked"]["who"]) == ("again: dust", "ben")
    again = work.supervisor.more()
    assert [trial.id for trial in again] == [first]
    work.take(again)
    assert work.supervisor.more() == []
    assert campaign.recording(first).record.attempt == 1  # another take, another seed
    assert campaign.committed() == {first, third}
    assert verify(store) == []
    control.ask(store, "again", campaign="tiny", trials=(second,), why="cable is gone")
    work.take(work.supervisor.more())
    assert campaign.committed() == {first, second, third}
    assert excluded_trials(work.plan, campaign) == []


def test_a_trial_that_used_its_retakes_up_gets_all_of_them_again(tmp_path: Path) -> None:
    data = short()
    data["collection"]["gates"]["retakes"] = 1
    fault = {"kind": "event_gap", "at_s": 0.6, "seconds": 0.2}
    work, campaign, store = supervised(tmp_path / "a", data, faults=[fault])
    work.take(list(work.plan)[:1])
    (aside,) = excluded_trials(work.plan, campaign)
    assert aside["cause"].startswith("gate: event_gap_s = 0.2")
    assert (aside["attempts"], aside["by"]) == (2, None)
    control.ask(store, "again", campaign="tiny", trials=(aside["trial"],), why="cable mended")
    carry_out(store)
    assert len(pending_trials(work.plan, campaign)) == 3
    mended, campaign = session(tmp_path / "a", data)
    mended.take(list(mended.plan)[:1])
    assert mended.taken == 1
    assert campaign.recording(aside["trial"]).record.attempt == 2
    assert len(campaign.quarantined()) == 2


def test_a_request_is_done_once_even_after_a_crash(tmp_path: Path) -> None:
    """Killed between doing and answering: done again, it changes nothing."""
    work, campaign, store = supervised(tmp_path / "a")
    work.take(list(work.plan)[:1])
    (first,) = campaign.committed()
    request = control.ask(store, "again", campaign="tiny", trials=(first,), why="dust")
    carry_out(store)
    (store.folder / control.FOLDER / "000001.done.json").unlink()
    ((_, answer),) = carry_out(store)
    assert answer["did"]["trials"] == {first: "was pending already"}
    assert control.answered(store, request) == answer
    assert carry_out(store) == []
    assert len(campaign.quarantined()) == 1


def after(calls: int, before: float = 0.0, then: float = 1000.0) -> Callable[[], float]:
    """A clock that shows `before` so many times."""
    times = iter([before] * calls)
    return lambda: next(times, then)


def show(supervisor: CollectionSupervisor, clock: Callable[[], float]) -> None:
    """Let another clock alone say when the window ends."""
    supervisor.clock, supervisor.passed_s = clock, lambda: -math.inf


def test_a_window_ends_between_trials_and_nothing_is_lost(tmp_path: Path) -> None:
    wanted = crash.run_request(tmp_path, 4)

    def night() -> None:
        with open_session(replace(wanted, until=500.0)) as work:
            show(work.supervisor, after(7))  # an attempt asks three times
            work.collector.rig.connect()
            work.collector.take(work.trials)

    with pytest.raises(WindowOver, match="the next collection continues"):
        night()
    store = TrialStore.open(wanted.store).campaign(crash.NAME)
    assert 1 <= len(store.committed()) <= 3  # retakes ask as well
    assert not list((store.folder / "incoming").iterdir())
    crash.collect(wanted)
    whole = crash.run_request(tmp_path / "undisturbed", 4)
    crash.collect(whole)
    assert crash.hashes(wanted.store) == crash.hashes(whole.store)


@dataclass
class Night:
    """A collection in real time, whose clock is the simulated one, from 0 at its begin.

    Attributes:
        sent: times at which the arm began a motion, s.
    """

    until: float
    at_s: float = 0.0
    sent: list[float] = field(default_factory=list)
    end: Position | None = None

    def take(self, wanted: RunRequest) -> None:
        """Collect until the window ends."""
        with open_session(replace(wanted, until=self.until)) as work:
            work.supervisor.in_real_time = True
            show(work.supervisor, lambda: self.at_s)
            rig = work.collector.rig
            wait, start = rig.clock.wait, rig.arm.start

            def waiting(seconds: float) -> None:
                self.at_s += seconds
                wait(seconds)

            def starting(path: list[Segment]) -> None:
                self.sent.append(self.at_s)
                start(path)

            put(rig.clock, "wait", waiting)
            put(rig.arm, "start", starting)
            rig.connect()
            try:
                work.collector.take(work.trials)
            finally:
                self.end = rig.position()


def night(folder: Path) -> RunRequest:
    """Request two trials, before which the skin is warmed up for long."""
    data = short()
    warm_up = {"presses": 20, "depth": "2.4 mm", "speed": "2 mm/s", "clearance": "5 mm"}
    data["collection"]["maintenance"]["warm_up"] = warm_up
    session(folder, data)
    return requested(folder)


@pytest.mark.parametrize("motion", [10, -3], ids=["warm-up", "slide"])
def test_an_arm_that_still_moves_when_the_window_ends_is_stopped(
    motion: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    undisturbed = Night(until=1e9)
    undisturbed.take(night(tmp_path / "whole"))
    whole = checksums(TrialStore.open(tmp_path / "whole" / "store").campaign("tiny"))
    wanted = night(tmp_path / "a")
    monkeypatch.setattr(CollectionSupervisor, "check_window", lambda *_: None)  # all seems to fit
    late = Night(undisturbed.sent[motion] + 0.5)
    with pytest.raises(WindowOver, match=r"which stopped the arm before .* next collection"):
        late.take(wanted)
    assert len([at_s for at_s in late.sent if at_s > late.until]) <= 1  # out of the plate
    assert late.at_s < late.until + 2.0
    assert late.end is not None
    assert late.end.depth_mm < 0
    campaign = TrialStore.open(wanted.store).campaign("tiny")
    assert {item["cause"] for item in campaign.quarantined()} <= {"its time window ended"}
    assert campaign.attempts() == {}
    Night(until=1e9).take(wanted)
    assert checksums(campaign) == whole


def test_what_is_done_before_a_trial_counts_as_its_time(tmp_path: Path) -> None:
    wanted = night(tmp_path / "a")
    trial = wanted.plan.trials[0]
    late = Night(until=wanted.plan.seconds(trial) + 60.0)  # 20 presses take 88 s
    with pytest.raises(WindowOver, match=f"too soon for {trial.id}"):
        late.take(wanted)
    assert late.sent == []


def test_a_window_may_end_while_a_person_is_asked(tmp_path: Path) -> None:
    data = tiny_gravity()
    session(tmp_path / "a", data)
    wanted = requested(tmp_path / "a")
    with open_session(replace(wanted, until=1000.0)) as work:
        work.supervisor.in_real_time = True
        show(work.supervisor, lambda: now)
        now, rig = 0.0, work.collector.rig
        ask = rig.operator.ask

        def slow(task: str, prompt: str, expected: str) -> bool:
            nonlocal now
            now = 2000.0
            return ask(task, prompt, expected)

        put(rig.operator, "ask", slow)
        put(rig.arm, "start", None)  # it is not moved
        rig.connect()
        with pytest.raises(WindowOver, match="too soon for"):
            work.collector.take(work.trials)


def test_a_pause_ends_with_its_window(tmp_path: Path) -> None:
    wanted = replace(crash.run_request(tmp_path, 2), until=500.0)
    with open_session(wanted) as work:
        control.ask(TrialStore.open(wanted.store), "pause")
        show(work.supervisor, after(3))
        work.supervisor.wait = lambda seconds: None
        with pytest.raises(WindowOver):
            work.collector.take(work.trials)
    assert control.paused(TrialStore.open(wanted.store)) is not None


def test_in_real_time_no_trial_is_begun_that_would_not_be_over(tmp_path: Path) -> None:
    mock = crash.run_request(tmp_path, 2)
    loopback, text = load_rig_file(ROOT / "rigs" / "loopback.yaml")
    store = TrialStore.create(tmp_path / "store")
    for rig, needed in ((mock.rig, 0.0), (loopback, None)):
        wanted = RunRequest(mock.plan, rig, text, store.folder, "c", (), until=500.0)
        supervisor = CollectionSupervisor(wanted, store, describe_campaign(store, wanted))
        trial = wanted.plan.trials[0]
        seconds = wanted.plan.seconds(trial) if needed is None else needed
        show(supervisor, lambda seconds=seconds: 499.9 - seconds)
        assert supervisor.may_take(trial)
        show(supervisor, lambda seconds=seconds: 500.1 - seconds)
        with pytest.raises(WindowOver, match=trial.id):
            supervisor.may_take(trial)


def test_a_clock_that_is_set_back_does_not_lengthen_the_window(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wanted = replace(crash.run_request(tmp_path, 2), until=10_600.0)
    store = TrialStore.create(wanted.store)
    campaign, wall_s, passed_s = describe_campaign(store, wanted), 10_000.0, 50.0
    monkeypatch.setattr(time, "time", lambda: wall_s + passed_s - 50.0)
    monkeypatch.setattr(time, "monotonic", lambda: passed_s)
    supervisor = CollectionSupervisor(wanted, store, campaign)
    supervisor.in_real_time, trial = True, wanted.plan.trials[0]
    wall_s -= 3600.0
    assert supervisor.may_take(trial)
    passed_s = 651.0 - wanted.plan.seconds(trial)
    assert not supervisor.is_window_over()
    with pytest.raises(WindowOver, match=trial.id):
        supervisor.may_take(trial)
    passed_s = 651.0
    assert supervisor.is_window_over()
