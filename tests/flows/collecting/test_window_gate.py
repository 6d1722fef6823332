"""When a window closes, a collection ends between two trials, and the next one goes on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from sliplab.flows.collecting.session import TrialGate, WindowOver, run_session
from sliplab.flows.planning.run_request import RunRequest, describe_campaign
from sliplab.rigs.rig_file import load_rig_file
from sliplab.storage.trials import control
from sliplab.storage.trials.store import Store
from tests.conftest import ROOT
from tests.crash import campaign


def after(calls: int, before: float = 0.0, then: float = 1000.0) -> Callable[[], float]:
    """A clock that shows `before` so many times."""
    times = iter([before] * calls)
    return lambda: next(times, then)


def test_a_window_ends_between_trials_and_nothing_is_lost(tmp_path: Path) -> None:
    wanted = campaign.run_request(tmp_path, 4)

    def night() -> None:
        with run_session(replace(wanted, until=500.0)) as work:
            work.gate.clock = after(3)
            work.session.rig.connect()
            work.session.take(work.trials)

    with pytest.raises(WindowOver, match="the next collection goes on"):
        night()
    store = Store.open(wanted.store).campaign(campaign.NAME)
    assert 1 <= len(store.committed()) <= 3  # retakes ask as well
    assert not list((store.folder / "incoming").iterdir())
    campaign.collect(wanted)
    whole = campaign.run_request(tmp_path / "undisturbed", 4)
    campaign.collect(whole)
    assert campaign.hashes(wanted.store) == campaign.hashes(whole.store)


def test_a_pause_ends_with_its_window(tmp_path: Path) -> None:
    wanted = replace(campaign.run_request(tmp_path, 2), until=500.0)
    with run_session(wanted) as work:
        control.ask(Store.open(wanted.store), "pause")
        work.gate.clock, work.gate.wait = after(3), lambda seconds: None
        with pytest.raises(WindowOver):
            work.session.take(work.trials)
    assert control.paused(Store.open(wanted.store)) is not None


def test_in_real_time_no_trial_is_begun_that_would_not_be_over(tmp_path: Path) -> None:
    mock = campaign.run_request(tmp_path, 2)
    loopback, text = load_rig_file(ROOT / "rigs" / "loopback.yaml")
    store = Store.create(tmp_path / "store")
    for rig, needed in ((mock.rig, 0.0), (loopback, None)):
        wanted = RunRequest(mock.plan, rig, text, store.folder, "c", (), until=500.0)
        gate = TrialGate(wanted, store, describe_campaign(store, wanted))
        trial = wanted.plan.trials[0]
        seconds = wanted.plan.seconds(trial) if needed is None else needed
        gate.clock = lambda seconds=seconds: 499.9 - seconds
        assert gate.may_take(trial)
        gate.clock = lambda seconds=seconds: 500.1 - seconds
        with pytest.raises(WindowOver, match=trial.id):
            gate.may_take(trial)
