"""Campaigns that end by their claims: cut anywhere they take the same trials in the same order."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from sliplab.flows.collecting.session import open_session, refresh
from sliplab.flows.planning.run_request import Claims, RunRequest, make_request
from sliplab.plugins.claims.document import ChoiceRecord, StoppingRecord
from sliplab.protocols import InputError
from sliplab.storage.schema.campaign_end import CHOICES, STOPPING
from sliplab.storage.trials.store import Campaign, TrialStore
from tests.command_line import answer, here
from tests.conftest import ROOT
from tests.flows.collecting.test_session import short
from tests.flows.conftest import write
from tests.flows.live import quick

# the first slip of these slides comes after 0.3 to 1 s
SURE = {"figure": "first_slip", "at_most": "10 s"}
NEVER = {"figure": "first_slip", "statistic": "p05", "within": "0.001 ms"}  # needs 60 blocks
RIG = {
    "extends": str(ROOT / "rigs" / "mock.yaml"),
    "name": "mock",
    "mock": {"frame_camera": {"level": "tracks"}},
}


POOL = "sliplab.plugins.claims.rounds.ProcessPoolExecutor"


def thread(workers: int, context: object, initializer: object) -> ThreadPoolExecutor:
    """A thread in place of a process, which takes seconds to begin."""
    return ThreadPoolExecutor(workers)


@pytest.fixture
def in_a_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make figures in a thread."""
    monkeypatch.setattr(POOL, thread)


def request(
    folder: Path, claims: list[dict[str, Any]], use: Claims = "use", **collection: Any
) -> RunRequest:
    """Three short slides, eight of each, with claims that are looked at after each block."""
    folder.mkdir(exist_ok=True)
    data = short()
    data["collection"] |= {"repetitions": 8, "maintenance": {}, **collection}
    stopping = {"error": 0.3, "claims": claims, **collection.get("stopping", {})}
    data["collection"]["stopping"] = stopping
    rig = write(folder / "rig.yaml", RIG)
    return make_request(write(folder / "p.yaml", data), rig, folder / "store", claims=use)


def collect(run_request: RunRequest, most: int | None = None) -> list[str]:
    """Take trials until the campaign ends, or is cut after so many; return their ids."""
    taken: list[str] = []
    with open_session(run_request) as session:
        session.collector.rig.connect()
        trials = session.trials
        while trials:
            for trial in trials:
                if most is not None and len(taken) == most:
                    return taken
                session.collector.take([trial])
                taken.append(trial.id)
            trials = session.more()
    return taken


def campaign_of(run_request: RunRequest) -> Campaign:
    """The campaign in its store."""
    return TrialStore.open(run_request.store).campaign(run_request.campaign)


def record_of(run_request: RunRequest) -> StoppingRecord:
    """Its looks."""
    return StoppingRecord.load(campaign_of(run_request).folder / STOPPING)


@pytest.mark.long
def test_a_campaign_ends_when_its_claims_hold_and_stays_ended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_request = request(tmp_path / "a", [SURE])
    taken = collect(run_request)
    record = record_of(run_request)
    assert record.verdict == "settled"
    assert record.simulated
    assert record.looks[-1].taken == len(taken) < 24
    assert len(taken) % 3 == 0  # blocks stay whole
    assert taken == [trial.id for trial in run_request.plan][: len(taken)]
    (state,) = record.looks[-1].claims
    assert state.holds
    assert not any(each.holds for look in record.looks[:-1] for each in look.claims)
    assert run_request.due_trials(campaign_of(run_request)) == []
    # overruled, it goes on to the end, and says so; the process has been tried
    monkeypatch.setattr(POOL, thread)
    more = request(tmp_path / "a", [SURE], use="overrule")
    assert len(collect(more)) == 24 - len(taken)
    assert record_of(more).verdict == "overruled"
    assert len(record_of(more).looks) == 8


@pytest.mark.long
@pytest.mark.usefixtures("in_a_thread")
def test_least_and_most_bound_the_trials(tmp_path: Path) -> None:
    late = request(tmp_path / "a", [SURE], stopping={"least": 18})
    assert len(collect(late)) == 18
    early = request(tmp_path / "b", [NEVER], stopping={"most": 8})
    assert len(collect(early)) == 6  # another block would be more
    assert record_of(early).verdict == "most"


@pytest.mark.long
@pytest.mark.usefixtures("in_a_thread")
def test_cut_anywhere_an_adaptive_campaign_goes_on_with_the_same_trial(tmp_path: Path) -> None:
    options = {"order": "adaptive", "choice": {"batch": 4, "start": 3}}
    whole = request(tmp_path / "a", [SURE, NEVER], stopping={"most": 16}, **options)
    taken = collect(whole)
    kept = campaign_of(whole).folder
    assert 10 < len(taken) <= 16
    assert len(set(taken)) == len(taken)
    pieces: list[str] = []
    for most in (1, 3, 5, None):  # in the first batch, at its end, in a later one
        part = request(tmp_path / "b", [SURE, NEVER], stopping={"most": 16}, **options)
        pieces += collect(part, most)
    assert pieces == taken
    again = campaign_of(part).folder
    for name in (CHOICES, STOPPING):
        assert (again / name).read_bytes() == (kept / name).read_bytes()
    checksums = [
        {each.trial_id: each.checksum for each in campaign_of(one).recordings()}
        for one in (whole, part)
    ]
    assert checksums[0] == checksums[1]


@pytest.mark.long
@pytest.mark.usefixtures("in_a_thread")
def test_a_chosen_trial_is_the_grids_own(tmp_path: Path) -> None:
    options = {"order": "adaptive", "choice": {"batch": 4, "start": 3}}
    chosen = request(tmp_path / "a", [NEVER], stopping={"most": 8}, **options)
    taken = collect(chosen)
    plain = request(tmp_path / "b", [NEVER])
    collect(plain)
    own = {each.trial_id: each.checksum for each in campaign_of(plain).recordings()}
    for each in campaign_of(chosen).recordings():
        assert own[each.trial_id] == each.checksum
    batches = ChoiceRecord.of(campaign_of(chosen).folder).batches
    assert [item.trial for batch in batches for item in batch.trials][: len(taken)] == taken
    assert batches[0].least is None
    assert batches[1].least is not None
    # what was begun with either goes on with the other: the collection is the same
    assert len(collect(request(tmp_path / "a", [NEVER]))) == 24 - len(taken)


@pytest.mark.usefixtures("in_a_thread")
def test_a_trial_that_is_taken_again_is_looked_at_again(tmp_path: Path) -> None:
    run_request = request(tmp_path / "a", [NEVER], stopping={"most": 8})
    taken = collect(run_request)
    before = record_of(run_request).looks[-1].evidence
    campaign = campaign_of(run_request)
    campaign.quarantine(campaign.folder / "trials" / taken[1], "again")
    again = request(tmp_path / "a", [NEVER], stopping={"most": 8})
    assert collect(again) == [taken[1]]  # and no trial more
    record = record_of(again)
    assert (record.verdict, len(record.looks)) == ("most", 2)
    assert record.looks[-1].taken == 6
    attempt = campaign.recording(taken[1]).record.attempt
    assert attempt == 1
    assert (record.looks[-1].evidence == before) is False


@pytest.mark.long
@pytest.mark.usefixtures("in_a_thread")
def test_other_claims_are_looked_at_anew(tmp_path: Path) -> None:
    first = request(tmp_path / "a", [SURE])
    taken = len(collect(first))
    other = request(tmp_path / "a", [NEVER], stopping={"most": taken + 3})
    assert len(collect(other)) == 3
    record = record_of(other)
    assert len(record.looks) == taken // 3 + 1
    assert json.loads(record.model_dump_json())["verdict"] == "most"


@pytest.mark.quick(1)
@pytest.mark.usefixtures("in_a_thread")
@pytest.mark.parametrize("order", ["shuffled", "adaptive"])
def test_a_collection_cut_after_its_last_trial_is_looked_at_by_the_next(
    tmp_path: Path, order: str
) -> None:
    options = {} if order == "shuffled" else {"choice": {"batch": 3, "start": 3}}
    run_request = request(tmp_path / "a", [NEVER], order=order, repetitions=2, **options)
    assert len(collect(run_request)) == 6
    whole = record_of(run_request)
    path = campaign_of(run_request).folder / STOPPING
    cut = whole.model_copy(update={"verdict": "open", "looks": whole.looks[:1]})
    path.write_text(json.dumps(cut.to_json()))  # as if killed before the last look
    refresh(run_request)
    assert record_of(run_request) == whole
    assert (whole.verdict, whole.looks[-1].taken) == ("all", 6)


def end_of(folder: Path, *options: object, claims: list[dict[str, Any]], **stopping: Any) -> Any:
    """What `collect` prints at its end, of three short slides, eight of each."""
    run_request = request(folder, claims, stopping=stopping)
    words = (folder / "p.yaml", "--rig", folder / "rig.yaml", "--store", run_request.store)
    return answer("collect", *words, *options)


@pytest.mark.usefixtures("in_a_thread")
def test_collect_takes_so_many_trials_over_rounds_and_says_why_it_ended(tmp_path: Path) -> None:
    found = end_of(tmp_path / "a", "--trials", 4, claims=[NEVER])
    assert (found["taken"], found["ended"]) == (4, "as many trials as --trials 4 allows")
    found = end_of(tmp_path / "a", "--trials", 4, claims=[NEVER], most=8)
    assert found["taken"] == 2
    assert found["ended"] == "another round would exceed collection.stopping.most = 8"
    found = end_of(tmp_path / "a", claims=[SURE])
    assert found["ended"] == "all claims are settled"
    assert end_of(tmp_path / "a", claims=[SURE])["ended"] == found["ended"]  # nothing to do
    found = end_of(tmp_path / "a", "--no-stopping", claims=[SURE])
    assert (found["committed"], found["ended"]) == (24, "all trials are taken")


@pytest.mark.usefixtures("in_a_thread")
def test_plan_and_collect_warn_of_claim_without_enough_blocks(tmp_path: Path) -> None:
    run_request = request(tmp_path / "a", [SURE, NEVER])
    protocol = tmp_path / "a" / "p.yaml"
    (warning,) = [it for it in answer("plan", protocol)["warnings"] if "claims[" in it]
    assert "claims[1]" in warning
    assert "needs 60 blocks, and the plan has 8" in warning
    assert "collection.repetitions = 8 must be at least 60" in warning
    words = (protocol, "--rig", tmp_path / "a" / "rig.yaml", "--store", run_request.store)
    done = here("collect", *words, "--trials", 1)
    assert warning in done.stderr
    assert "as many trials as --trials 1 allows" in done.stdout
    assert warning in here("plan", protocol).stderr


def test_plan_refuses_missing_network_with_all_other_faults(tmp_path: Path) -> None:
    protocol = tmp_path / "p.yaml"
    data = short()
    lead = {"figure": "lead", "within": "10 ms"}
    data["collection"]["stopping"] = {"claims": [lead], "model": "none.pt", "most": 1}
    done = here("plan", write(protocol, data))
    assert done.returncode == 2
    lines = done.stderr.splitlines()
    assert "collection.stopping.most = 1" in lines[0]
    assert "collection.stopping.model = none.pt" in lines[1]
    assert "none.pt is no file" in lines[1]


def test_a_claim_about_a_network_needs_one(tmp_path: Path) -> None:
    lead = {"figure": "lead", "within": "10 ms"}
    with pytest.raises(InputError, match=r"collection\.stopping\.model.*needed"):
        request(tmp_path / "a", [lead])
    with pytest.raises(InputError, match=r"none\.pt is no file"):
        request(tmp_path / "a", [lead], stopping={"model": "none.pt"})


@pytest.mark.realtime
@pytest.mark.long
@pytest.mark.xdist_group("scene")
def test_through_real_drivers_a_campaign_ends_by_its_claims(tmp_path: Path) -> None:
    data = quick(trials=2, repetitions=9)
    data["collection"] |= {
        "order": "adaptive",
        "choice": {"batch": 2, "start": 2},
        "stopping": {"error": 0.4, "claims": [SURE]},
    }
    protocol, store = write(tmp_path / "quick.yaml", data), tmp_path / "store"
    words = ("collect", protocol, "--rig", "loopback", "--store", store)
    taken = answer(*words)["taken"]
    campaign = TrialStore.open(store).campaign("quick")
    record = StoppingRecord.load(campaign.folder / STOPPING)
    assert (record.verdict, record.looks[-1].taken) == ("settled", taken)
    assert taken < 18
    assert len(campaign.committed()) == taken
    assert answer(*words)["taken"] == 0
    assert answer(*words, "--no-stopping")["taken"] == 18 - taken
