"""A recording that is killed at any moment loses nothing committed, and keeps what verifies."""

from __future__ import annotations

import random
import time
from pathlib import Path

import pytest

from sliplab.flows.verify import verify
from sliplab.plugins.record.recorder import record
from sliplab.plugins.record.salvage import killed, salvage_campaign
from sliplab.storage.trials.prefix_journal import read_journal
from sliplab.storage.trials.store import TrialStore
from tests.plugins.record.recordings import (
    NAME,
    campaign_of,
    check_rows,
    feed,
    forked,
    record_for_ever,
    sources,
)

MOMENTS = (4, 200)


def kill_at(folder: Path, seconds: float, early: bool) -> int:
    """Kill a recording at a moment; return how many trials were cut.

    Args:
        early: count from the program's start; else from the first state of its first trial.
    """
    with forked(lambda: record_for_ever(folder)):
        if not early:
            wait_for_states(folder, 1)
        time.sleep(seconds)  # the moment of the kill
    if not (folder / "store.json").exists() or not campaign_of(folder).begun:
        return 0
    campaign = campaign_of(folder)
    before = campaign.committed()
    verified = [path.name for path in killed(campaign) if read_journal(path)]
    salvage_campaign(campaign)
    after = campaign.committed()
    assert before | set(verified) <= after  # and those whose record was written
    assert verify(str(folder))["ok"]
    cut = 0
    for recording in campaign.recordings():
        check_rows(recording)
        cut += recording.record.lost is not None
    return cut


@pytest.mark.parametrize(
    "moments", [MOMENTS[0], pytest.param(MOMENTS[1], marks=pytest.mark.long)], ids=str
)
def test_killed_recordings_keep_what_was_committed_and_what_verifies(
    tmp_path: Path, moments: int
) -> None:
    chance = random.Random(moments)
    cut = [kill_at(tmp_path / str(n), 2 * chance.random(), n % 4 == 0) for n in range(moments)]
    assert sum(cut) >= moments // 4


def test_a_damaged_tail_is_cut_to_the_state_before_it(tmp_path: Path) -> None:
    with forked(lambda: record_for_ever(tmp_path)):
        wait_for_states(tmp_path, 2)
    campaign = campaign_of(tmp_path)
    (folder,) = killed(campaign)
    states = read_journal(folder)
    data = bytearray((folder / "data.h5").read_bytes())
    lasting = len(data) * 3 // 4
    data[lasting:] = bytes(
        len(data) - lasting
    )  # as after a power cut: the length, but not the data
    (folder / "data.h5").write_bytes(data)
    salvaged = salvage_campaign(campaign)
    for recording in campaign.recordings():
        check_rows(recording)
    if salvaged:
        kept = campaign.recording(salvaged[0]).record.counts.events
        assert kept < states[-1][""]["columns"]["events/t"][0]
    else:
        assert campaign.quarantined()
    assert verify(str(tmp_path))["ok"]


def test_verify_keeps_an_unfinished_recording_and_names_it(tmp_path: Path) -> None:
    with forked(lambda: record_for_ever(tmp_path)):
        wait_for_states(tmp_path, 2)
    found = verify(str(tmp_path))
    (trial,) = found["salvaged"]
    assert trial.startswith(f"{NAME}/")
    (recording,) = [each for each in campaign_of(tmp_path).recordings() if each.record.lost]
    assert "was killed" in recording.record.lost.reason


def test_the_next_recording_keeps_the_unfinished_one_and_goes_on(tmp_path: Path) -> None:
    with forked(lambda: record_for_ever(tmp_path)):
        wait_for_states(tmp_path, 2)
    with record(sources(), tmp_path, NAME) as recorder:
        assert len(recorder.salvaged) == 1
        with recorder.trial() as trial:
            feed(trial, 0)
    assert trial.id not in recorder.salvaged
    assert TrialStore.open(tmp_path).campaign(NAME).committed() >= {trial.id, *recorder.salvaged}


def wait_for_states(folder: Path, count: int) -> None:
    """Wait until a running recording has noted some states of a trial."""
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline:
        for path in (folder / "campaigns" / NAME / "incoming").glob("*/journal.jsonl"):
            try:
                if len(read_journal(path.parent)) >= count:
                    return
            except OSError:  # it was committed meanwhile
                continue
        time.sleep(0.01)
    raise AssertionError("no state was noted")
