"""Stores under faults as the command line meets them: figures that add up, one clear message."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from sliplab.flows.collecting.session import open_session
from sliplab.flows.planning.campaign_trials import pending_trials
from sliplab.flows.planning.run_request import make_request
from sliplab.storage.files import read_json, write_json
from sliplab.storage.trials.lock import Locked, exclusive
from sliplab.storage.trials.store import FORMAT, StoreError, TrialStore
from tests.command_line import outcome
from tests.flows.collecting.test_faults import TRACKS, slides
from tests.flows.collecting.test_session import session
from tests.flows.conftest import requested, take_all, write


@pytest.fixture(scope="module")
def taken(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a protocol, a rig file, and a store with two trials."""
    folder = tmp_path_factory.mktemp("taken") / "lab"
    work, _ = session(folder, slides(2), frame_camera=TRACKS)
    take_all(work)
    return folder


@pytest.fixture
def whole(taken: Path, tmp_path: Path) -> Path:
    """A copy of it, to be damaged at will."""
    return shutil.copytree(taken, tmp_path / "lab")


def trials(folder: Path) -> list[Path]:
    return sorted((folder / "store" / "campaigns" / "tiny" / "trials").iterdir())


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


def test_figures_add_up_after_damage(whole: Path) -> None:
    (trials(whole)[0] / "data.h5").write_bytes(b"x")
    run_request = requested(whole)
    campaign = TrialStore.open(whole / "store").campaign("tiny")
    counts = run_request.counts(campaign)
    assert (counts["planned"], counts["committed"], counts["missing"]) == (2, 1, 1)
    assert [trial.id for trial in pending_trials(run_request.plan, campaign)] == [
        trials(whole)[0].name
    ]
    code, found, _ = outcome("verify", whole / "store", "--json")
    assert code == 1
    assert (found["trials"], found["whole"], found["damaged"]) == (2, 1, 1)
    assert (found["format"], found["ok"], found["quarantined"]) == (FORMAT, False, [])
    assert [item["trial"] for item in found["problems"]] == [trials(whole)[0].name]
    code, table, said = outcome("trials", whole / "store", "--json")
    assert (code, table["count"], len(table["unreadable"])) == (0, 1, 1)
    assert "left out: " in said


def test_a_damaged_trial_is_set_aside_and_taken_again(whole: Path) -> None:
    sums = {path.name: read_json(path / "checksums.json") for path in trials(whole)}
    flip(trials(whole)[0] / "data.h5")
    code, found, _ = outcome("verify", whole / "store", "--quarantine", "--json")
    assert (code, found["quarantined"]) == (1, [min(sums)])
    work, campaign = session(whole, slides(2), frame_camera=TRACKS)
    take_all(work)
    assert {path.name: read_json(path / "checksums.json") for path in trials(whole)} == sums
    assert campaign.quarantined()[0]["cause"].startswith("damaged: data.h5: does not match")
    code, found, _ = outcome("verify", whole / "store", "--json")
    assert (code, found["whole"], found["damaged"], found["ok"]) == (0, 2, 0, True)


def test_a_second_writer_is_refused_and_told_who_is_first(whole: Path) -> None:
    flip(trials(whole)[0] / "data.h5")
    run_request = requested(whole)
    with exclusive(whole / "store" / ".lock", "the store"):
        with (
            pytest.raises(Locked, match=r"in use by another program .*pid"),
            open_session(run_request),
        ):
            raise AssertionError("two writers")
        for command in (["verify", "--quarantine"], ["migrate"]):
            code, _, said = outcome(command[0], whole / "store", *command[1:])
            assert code == 1
            assert "is in use by another program" in " ".join(said.split())
        code, found, _ = outcome("verify", whole / "store", "--json")  # readers need no lock
        assert (code, found["damaged"]) == (1, 1)
    assert len(trials(whole)) == 2


def test_an_older_store_is_brought_forward_by_hand_and_by_collecting(whole: Path) -> None:
    for by_hand in (True, False):
        write_json(whole / "store" / "store.json", {"format": 1})
        if by_hand:
            code, found, _ = outcome("migrate", whole / "store", "--json")
            assert (code, found["format"], found["from"]) == (0, FORMAT, [1])
            assert Path(found["copies"][0], "store.json").is_file()
        else:
            with open_session(requested(whole)):
                assert TrialStore.open(whole / "store").format == FORMAT
    code, found, _ = outcome("migrate", whole / "store", "--json")
    assert (code, found["from"]) == (0, [])


def test_a_newer_store_is_refused(whole: Path) -> None:
    write_json(whole / "store" / "store.json", {"format": FORMAT + 1})
    for command in ("verify", "trials", "migrate"):
        code, _, said = outcome(command, whole / "store")
        assert code == 1
        assert "written by a newer version of SlipLab" in " ".join(said.split())
        assert "Traceback" not in said


@pytest.mark.parametrize("name", ["../x", "/tmp/x", "a/b", "..", ""])
def test_no_path_of_a_protocol_leads_out_of_the_store(whole: Path, name: str) -> None:
    data = slides(2)
    data["name"] = name
    before = sorted(whole.parent.rglob("*"))
    path = write(whole.parent / "evil.yaml", data)
    with pytest.raises((StoreError, ValueError, RuntimeError)):
        make_request(path, whole / "rig.yaml", whole / "store")
    path.unlink()
    with pytest.raises(StoreError, match="cannot be the name"):
        make_request(whole / "p.yaml", whole / "rig.yaml", whole / "store", campaign=name or ".")
    assert sorted(whole.parent.rglob("*")) == before


def test_a_campaign_without_its_description_is_not_begun_anew(whole: Path) -> None:
    (whole / "store" / "campaigns" / "tiny" / "campaign.json").unlink()
    with pytest.raises(StoreError, match=r"campaign.json.*restore it from a copy"):
        requested(whole)
