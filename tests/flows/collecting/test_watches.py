"""Disk, reference trials and time are watched while a campaign runs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from sliplab.analysis.quality import hold_rate
from sliplab.flows.collecting.progress import Remaining
from sliplab.flows.collecting.requests import CampaignStopped, carry_out
from sliplab.flows.collecting.session import TrialCollector
from sliplab.flows.collecting.supervisor import CollectionSupervisor
from sliplab.flows.collecting.watches import DiskWatch, ReferenceWatch
from sliplab.flows.planning.campaign_trials import pending_trials
from sliplab.flows.planning.disk_space import RESERVE
from sliplab.flows.planning.run_request import RunRequest
from sliplab.flows.planning.size_estimate import trial_bytes
from sliplab.protocols import InputError, load_plan
from sliplab.storage.trials import control
from sliplab.storage.trials.store import Campaign, TrialStore
from sliplab.storage.trials.verify import verify
from tests.flows.collecting.test_session import session, short
from tests.flows.conftest import requested, tiny, write


def begin(folder: Path, data: dict[str, Any]) -> tuple[TrialCollector, Campaign, RunRequest]:
    """A session and its run request."""
    work, campaign = session(folder, data)
    return work, campaign, requested(folder)


def test_a_campaign_stops_before_its_disk_is_full(tmp_path: Path) -> None:
    work, campaign, run_request = begin(tmp_path / "a", short())
    left = [RESERVE + 1e9, RESERVE + 1e9, RESERVE + 1000]
    disk = DiskWatch(run_request, campaign, lambda folder: int(left.pop(0)))
    store = TrialStore.open(run_request.store)
    work.supervisor = CollectionSupervisor(run_request, store, campaign, disk)
    with pytest.raises(CampaignStopped) as stopped:
        work.take(pending_trials(work.plan, campaign))
    for part in (
        "stopped, the disk is nearly full: 200.0 MB are free",
        "(by the trials so far)",
        "200.0 MB stay in reserve",
        "make room, then run the same command to resume",
    ):
        assert part in str(stopped.value)
    assert len(campaign.committed()) == 2
    assert campaign.quarantined() == []
    assert not list((campaign.folder / "incoming").iterdir())
    assert verify(TrialStore.open(run_request.store)) == []


def test_what_a_trial_needs_comes_from_the_plan_then_from_the_trials(tmp_path: Path) -> None:
    work, campaign, run_request = begin(tmp_path / "a", short())
    first, second, _ = run_request.plan
    disk = DiskWatch(run_request, campaign)
    planned = trial_bytes(run_request.rig, run_request.plan, second)
    assert disk.needs(second) == planned
    work.take([first])
    disk.learn(first)
    folder = campaign.folder / "trials" / first.id
    took = sum(path.stat().st_size for path in folder.iterdir())
    ratio = took / trial_bytes(run_request.rig, run_request.plan, first)
    assert disk.needs(second) == pytest.approx(planned * ratio)
    assert DiskWatch(run_request, campaign).needs(second) == disk.needs(second)  # next stretch
    camera = run_request.rig.frame_camera.model_copy(update={"spool": True})
    spooling = run_request.rig.model_copy(update={"frame_camera": camera})
    raw = DiskWatch(RunRequest(**{**vars(run_request), "rig": spooling}), campaign)
    frame = run_request.rig.frame_px(run_request.plan)
    seconds = run_request.plan.seconds(second, recorded_only=True)
    assert raw.needs(second) - disk.needs(second) == frame[0] * frame[1] * 100 * seconds


def with_references(bound: str = "20 %") -> dict[str, Any]:
    """A reference trial before every measured one."""
    data = short()
    condition = {"depth": 2.4, "speed": 1.6, "direction": 0}
    data["collection"]["references"] = {"every": 1, "condition": condition}
    data["collection"]["gates"]["reference"] = {"event_rate": bound}
    return data


def test_references_that_drift_apart_stop_the_campaign(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    work, campaign, run_request = begin(tmp_path / "a", with_references())
    store = TrialStore.open(run_request.store)
    work.supervisor = CollectionSupervisor(run_request, store, campaign)
    references = [trial.id for trial in run_request.plan if trial.role == "reference"]
    first, second = references[:2]
    rates = {first: 1000.0, second: 1234.4}
    monkeypatch.setattr(
        "sliplab.analysis.references.hold_rate", lambda recording: rates[recording.trial_id]
    )
    with pytest.raises(CampaignStopped) as stopped:
        work.take(pending_trials(work.plan, campaign))
    message = str(stopped.value)
    for part in (
        f"{second} has 1,234 events/s in the hold, {first} had 1,000 (+23.4 %, "
        "gates.reference.event_rate = 20 %)",
        "simulated reference trials",
        f"`sliplab again {run_request.store} {second} --why ...`",
        "Onsets were not compared",
    ):
        assert part in message
    assert len(campaign.committed()) == 3
    # it does not go on by itself ...
    with pytest.raises(CampaignStopped, match="drifted apart"):
        CollectionSupervisor(run_request, store, campaign).begin()
    # ... but when the trial is wanted again
    control.ask(store, "again", campaign="tiny", trials=(second,), why="skin cleaned")
    carry_out(store)
    rates = dict.fromkeys(references, 1100.0) | {first: 1000.0}
    work.supervisor = CollectionSupervisor(run_request, store, campaign)
    work.supervisor.begin()
    pending = pending_trials(work.plan, campaign)
    assert pending[0].id == second
    work.take(pending)
    assert len(campaign.committed()) == 6


def test_true_event_rates_in_the_hold_agree_within_some_percent(tmp_path: Path) -> None:
    work, campaign, run_request = begin(tmp_path / "a", with_references())
    work.supervisor = CollectionSupervisor(
        run_request, TrialStore.open(run_request.store), campaign
    )
    work.take(pending_trials(work.plan, campaign))
    rates = [
        hold_rate(campaign.recording(trial.id))
        for trial in run_request.plan
        if trial.role == "reference"
    ]
    assert len(rates) == 3
    assert min(rates) > 0
    assert max(rates) / min(rates) < 1.2


def test_without_the_gate_nothing_is_compared(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = with_references()
    del data["collection"]["gates"]["reference"]
    work, campaign, run_request = begin(tmp_path / "a", data)

    def never(recording: object) -> float:
        raise AssertionError("read")

    monkeypatch.setattr("sliplab.analysis.references.hold_rate", never)
    work.supervisor = CollectionSupervisor(
        run_request, TrialStore.open(run_request.store), campaign
    )
    work.take(pending_trials(work.plan, campaign)[:3])
    ReferenceWatch(run_request, campaign).begin()


def test_a_gate_without_reference_trials_is_refused(tmp_path: Path) -> None:
    data = short()
    data["collection"]["gates"]["reference"] = {"event_rate": "20 %"}
    with pytest.raises(InputError, match=r"collection\.gates\.reference.*add references"):
        load_plan(write(tmp_path / "p.yaml", data))


def test_the_time_that_is_left_follows_the_planned_lengths(tmp_path: Path) -> None:
    data = tiny()
    data["collection"]["factors"]["speed"]["values"] = [0.4, 1.6]
    plan = load_plan(write(tmp_path / "p.yaml", data))
    trials, now = list(plan), [100.0]
    real = Remaining(plan, trials, real_time=True, clock=lambda: now[0])
    assert real.seconds == pytest.approx(plan.total_seconds)
    virtual = Remaining(plan, trials, real_time=False, clock=lambda: now[0])
    assert str(virtual) == ""
    now[0] += 2 * plan.seconds(trials[0])  # it took twice as long as planned
    for remaining in (real, virtual):
        remaining.done(trials[0])
        left = plan.total_seconds - plan.seconds(trials[0])
        assert remaining.seconds == pytest.approx(2 * left)
        assert str(remaining).endswith(" left")
    now[0] += 3600
    real.pause(3600)
    assert real.seconds == pytest.approx(2 * left)
    real.add(trials[:1])
    assert real.seconds == pytest.approx(2 * plan.total_seconds)
