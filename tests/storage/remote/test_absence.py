"""A list that is empty, short or missing is no order to withdraw anything."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from sliplab.storage.remote.manifest import manifest_key, read_manifests
from sliplab.storage.remote.mirror import open_for_trial, open_mirror
from sliplab.storage.remote.objects import Remote, RemoteError
from sliplab.storage.remote.pull import PULLED, origin_of, pull
from sliplab.storage.remote.push import push
from sliplab.storage.remote.verify import verify_remote
from sliplab.storage.trials.control import again
from sliplab.storage.trials.store import Campaign, TrialStore
from sliplab.storage.trials.verify import DAMAGED, verify
from tests.storage.remote.remotes import tree
from tests.storage.trial_files import campaign, commit

TRIALS = ("depth=2.4mm,r=1", "depth=2.8mm,r=1", "depth=3.2mm,r=1")
BY = {"who": "me", "when": "now", "why": "dust"}


@pytest.fixture
def lab(tmp_path: Path) -> Campaign:
    """A campaign with three trials, pushed to `remote` and pulled into `back`."""
    where = campaign(tmp_path / "lab")
    where.add_bench_record({"operator": "one"})
    for trial in TRIALS:
        commit(where, trial)
    push(store_of(where), Remote(f"file://{tmp_path}/shared"))
    pull(Remote(f"file://{tmp_path}/shared"), tmp_path / "back")
    return where


@pytest.fixture
def remote(lab: Campaign, tmp_path: Path) -> Remote:
    """Where it was pushed to."""
    return Remote(f"file://{tmp_path}/shared")


@pytest.fixture
def back(lab: Campaign, tmp_path: Path) -> Campaign:
    """The campaign in the second lab's store."""
    return TrialStore.open(tmp_path / "back").campaign("c")


def store_of(where: Campaign) -> TrialStore:
    """The store of a campaign."""
    return TrialStore.open(where.folder.parents[1])


def test_pull_leaves_trials_that_were_not_pulled(remote: Remote, back: Campaign) -> None:
    own = {"depth=4mm,r=1", "depth=5mm,r=1"}
    for trial in sorted(own):
        commit(back, trial, recorded_s=2.0)
    done = pull(remote, back.folder.parents[1])
    assert (done.withdrawn, done.replaced, done.there, done.problems) == (0, 0, 3, [])
    assert back.committed() == {*TRIALS, *own}
    assert back.quarantined() == []


def test_pull_leaves_own_trial_that_is_withdrawn_elsewhere(
    lab: Campaign, remote: Remote, back: Campaign
) -> None:
    """Equal trials of both labs: only a pulled one follows the mark."""
    for where in (lab, back):
        commit(where, "depth=4mm,r=1")
    push(store_of(lab), remote)
    again(lab, ["depth=4mm,r=1", TRIALS[0]], BY)
    assert push(store_of(lab), remote).withdrawn == 2
    done = pull(remote, back.folder.parents[1])
    assert (done.withdrawn, done.problems) == (1, [])
    assert back.committed() == {*TRIALS[1:], "depth=4mm,r=1"}


def test_pull_leaves_own_trial_of_a_name_that_is_pushed_later(
    lab: Campaign, remote: Remote, back: Campaign
) -> None:
    commit(lab, "depth=4mm,r=1")
    commit(back, "depth=4mm,r=1", recorded_s=2.0)
    push(store_of(lab), remote)
    before = tree(back.folder, "trials")
    done = pull(remote, back.folder.parents[1])
    assert (done.replaced, len(done.problems)) == (0, 1)
    assert "depth=4mm,r=1: is another attempt than that at" in done.problems[0]
    assert tree(back.folder, "trials") == before


@pytest.mark.parametrize("marks", [0, 1])
@pytest.mark.parametrize("gone", ["trials", "", "about.json", "../../campaigns"])
def test_pull_from_missing_folder_changes_nothing(
    gone: str, marks: int, lab: Campaign, remote: Remote, back: Campaign, tmp_path: Path
) -> None:
    for trial in range(marks):  # what was withdrawn before does not explain what is missing now
        again(lab, [TRIALS[trial]], BY)
        push(store_of(lab), remote)
        pull(remote, tmp_path / "back")
    before = tree(tmp_path / "back", "campaigns")
    folder = (tmp_path / "shared/campaigns/c" / gone).resolve()
    folder.rename(tmp_path / "unplugged")
    for place in ("back", "fresh"):
        try:
            problems = pull(remote, tmp_path / place).problems
        except RemoteError as error:
            problems = [str(error)]
        assert problems, place
    assert _problems(remote)
    assert tree(tmp_path / "back", "campaigns") == before
    (tmp_path / "unplugged").rename(folder)
    done = pull(remote, tmp_path / "back")
    assert (done.there, done.withdrawn, done.problems) == (3 - marks, 0, [])


def test_pull_where_all_was_withdrawn_is_no_problem(
    lab: Campaign, remote: Remote, back: Campaign, tmp_path: Path
) -> None:
    again(lab, TRIALS, BY)
    push(store_of(lab), remote)
    assert (pull(remote, tmp_path / "back").withdrawn, back.committed()) == (3, set())
    assert pull(remote, tmp_path / "fresh").problems == []
    assert verify_remote(remote) == (0, [])


def _problems(remote: Remote) -> list[str]:
    """What `verify` says of a remote store."""
    try:
        return [item.what for item in verify_remote(remote)[1]]
    except RemoteError as error:
        return [str(error)]


def test_pull_names_trials_that_are_neither_listed_nor_withdrawn(
    remote: Remote, back: Campaign, tmp_path: Path
) -> None:
    (tmp_path / "shared" / manifest_key("trials", "c", TRIALS[1])).unlink()
    done = pull(remote, tmp_path / "back")
    assert (done.there, done.withdrawn) == (2, 0)
    assert len(done.problems) == 1
    assert (
        f"neither listed nor marked as withdrawn, left unchanged: {TRIALS[1]}" in (done.problems[0])
    )
    assert back.committed() == set(TRIALS)


def test_mark_of_a_withdrawn_take_does_not_withdraw_the_next_one(
    lab: Campaign, remote: Remote, back: Campaign, tmp_path: Path
) -> None:
    again(lab, [TRIALS[0]], BY)
    commit(lab, TRIALS[0], attempt=1)
    assert push(store_of(lab), remote).replaced == 1
    assert len(read_manifests(remote, "c", "withdrawn")) == 1
    assert pull(remote, tmp_path / "back").replaced == 1
    (tmp_path / "shared" / manifest_key("trials", "c", TRIALS[0])).unlink()
    done = pull(remote, tmp_path / "back")
    assert (done.withdrawn, len(done.problems)) == (0, 1)
    assert back.committed() == set(TRIALS)


def test_push_marks_what_an_older_version_withdrew(
    lab: Campaign, remote: Remote, back: Campaign, tmp_path: Path
) -> None:
    """An older version removed the manifest, and left no mark."""
    again(lab, [TRIALS[2]], BY)
    (tmp_path / "shared" / manifest_key("trials", "c", TRIALS[2])).unlink()
    assert len(pull(remote, tmp_path / "back").problems) == 1
    push(store_of(lab), remote)
    done = pull(remote, tmp_path / "back")
    assert (done.withdrawn, done.problems) == (1, [])
    assert back.committed() == set(TRIALS[:2])


def test_store_pulled_by_older_version_follows(
    lab: Campaign, remote: Remote, back: Campaign, tmp_path: Path
) -> None:
    """It has no notes; the first pull takes those trials for pulled that agree."""
    shutil.rmtree(tmp_path / "back" / PULLED)
    commit(back, "depth=9mm,r=1", recorded_s=2.0)
    assert pull(remote, tmp_path / "back").problems == []
    again(lab, [TRIALS[0], TRIALS[1]], BY)
    commit(lab, TRIALS[1], attempt=1)
    push(store_of(lab), remote)
    done = pull(remote, tmp_path / "back")
    assert (done.withdrawn, done.replaced, done.problems) == (1, 1, [])
    assert back.committed() == {*TRIALS[1:], "depth=9mm,r=1"}


def test_store_pulled_by_older_version_follows_what_was_withdrawn_before(
    lab: Campaign, remote: Remote, back: Campaign, tmp_path: Path
) -> None:
    """The mark of its take says where a trial comes from that is not listed any more."""
    shutil.rmtree(tmp_path / "back" / PULLED)
    again(lab, TRIALS[:2], BY)
    commit(lab, TRIALS[1], attempt=1)
    push(store_of(lab), remote)
    done = pull(remote, tmp_path / "back")
    assert (done.withdrawn, done.replaced, done.problems) == (1, 1, [])


@pytest.mark.parametrize("how", ["interrupted", "one campaign"])
def test_store_pulled_by_older_version_follows_after_part_of_a_pull(
    how: str, lab: Campaign, remote: Remote, tmp_path: Path
) -> None:
    other = store_of(lab).campaign("d")
    other.update({"name": "d", "simulated": True}, "protocol: 1\n", "rig: 1\n")
    commit(other, TRIALS[0], campaign="d")
    push(store_of(lab), remote)
    pull(remote, tmp_path / "back")
    shutil.rmtree(tmp_path / "back" / PULLED)

    def interrupt(trial: str) -> None:
        raise KeyboardInterrupt

    if how == "interrupted":
        with pytest.raises(KeyboardInterrupt):
            pull(remote, tmp_path / "back", on_trial=interrupt)
    else:
        pull(remote, tmp_path / "back", campaigns=["c"])
    assert pull(remote, tmp_path / "back").problems == []
    for where in (lab, other):
        again(where, [TRIALS[0]], BY)
    again(lab, [TRIALS[1]], BY)
    commit(lab, TRIALS[1], attempt=1)
    push(store_of(lab), remote)
    done = pull(remote, tmp_path / "back")
    assert (done.withdrawn, done.replaced, done.problems) == (2, 1, [])


def test_push_does_not_bring_back_what_another_store_withdrew(
    lab: Campaign, remote: Remote, back: Campaign, tmp_path: Path
) -> None:
    again(lab, [TRIALS[0]], BY)
    push(store_of(lab), remote)
    done = push(store_of(back), remote)
    assert (done.pushed, done.there) == (0, 2)
    assert len(done.problems) == 1
    assert f"{TRIALS[0]}: was pulled, and is withdrawn there since" in done.problems[0]
    assert pull(remote, tmp_path / "back").withdrawn == 1
    assert push(store_of(back), remote).problems == []


def test_push_of_a_trial_that_is_wanted_after_all_removes_its_mark(
    lab: Campaign, remote: Remote, back: Campaign, tmp_path: Path
) -> None:
    again(lab, [TRIALS[0]], BY)
    push(store_of(lab), remote)
    aside = lab.folder / "quarantine" / lab.quarantined()[0]["folder"]
    aside.rename(lab.folder / "trials" / TRIALS[0])
    assert push(store_of(lab), remote).pushed == 1
    assert read_manifests(remote, "c", "withdrawn") == {}
    (tmp_path / "shared" / manifest_key("trials", "c", TRIALS[0])).unlink()
    done = pull(remote, tmp_path / "back")
    assert (done.withdrawn, len(done.problems)) == (0, 1)


def test_file_of_another_program_among_the_notes_is_no_campaign(
    remote: Remote, back: Campaign, tmp_path: Path
) -> None:
    (tmp_path / "back" / PULLED / ".DS_Store").write_text("x")
    assert pull(remote, tmp_path / "back").problems == []


def test_mirror_of_older_version_follows(
    lab: Campaign, remote: Remote, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Trials that a mirror has without their big files came from there, whatever is noted."""
    monkeypatch.setenv("SLIPLAB_CACHE", str(tmp_path / "cache"))
    mirror, _ = open_mirror(remote.url)
    shutil.rmtree(mirror.folder / PULLED)
    again(lab, TRIALS[:2], BY)
    commit(lab, TRIALS[1], attempt=1)
    push(store_of(lab), remote)
    open_for_trial(remote.url, "c", TRIALS[2])
    _, done = open_mirror(remote.url)
    assert (done.withdrawn, done.replaced, done.problems) == (1, 1, [])
    assert mirror.campaign("c").committed() == set(TRIALS[1:])


def test_pull_that_was_killed_at_once_follows_later(remote: Remote, tmp_path: Path) -> None:
    TrialStore.create(tmp_path / "killed")
    assert pull(remote, tmp_path / "killed").pulled == 3
    assert origin_of(tmp_path / "killed") == remote.url


def test_pull_goes_on_from_a_killed_one_without_its_leftovers(
    lab: Campaign, remote: Remote, back: Campaign
) -> None:
    commit(lab, "depth=9mm,r=1")
    push(store_of(lab), remote)
    staging = back.folder / "incoming" / "depth=9mm,r=1"
    staging.mkdir()
    (staging / "elsewhere.json").write_text("{}")
    (staging / ".data.h5.4194305.tmp").write_bytes(b"x")  # a process number beyond the largest
    assert pull(remote, back.folder.parents[1]).pulled == 1
    assert verify(store_of(back)) == []


def test_interrupted_download_of_a_trial_that_went_is_deleted(
    lab: Campaign, remote: Remote, back: Campaign
) -> None:
    for name in ("depth=9mm,r=1", f"{TRIALS[0]}.1.aside"):
        (back.folder / "incoming" / name).mkdir()
        (back.folder / "incoming" / name / "elsewhere.json").write_text("{}")
    begun = back.begin("depth=8mm,r=1", (48, 32), 100)
    assert pull(remote, back.folder.parents[1]).problems == []
    assert [path.name for path in (back.folder / "incoming").iterdir()] == ["depth=8mm,r=1"]
    begun.discard()


def test_pull_overwrites_neither_own_campaign_nor_own_session(
    lab: Campaign, remote: Remote, back: Campaign, tmp_path: Path
) -> None:
    for where, operator in ((lab, "one"), (back, "two")):
        where.add_bench_record({"operator": operator})
        other = store_of(where).campaign("d")
        other.update({"name": "d", "simulated": True, "rig": operator}, "protocol: 1\n", "rig: 1\n")
    push(store_of(lab), remote)
    before = tree(tmp_path / "back", "campaigns")
    done = pull(remote, tmp_path / "back")
    assert len(done.problems) == 2
    assert "bench/0002.json: differs from that at" in done.problems[0]
    assert "d/campaign.json: differs from that at" in done.problems[1]
    after = tree(tmp_path / "back", "campaigns")
    assert {path for path in before if after.get(path) != before[path]} == set()


def test_pull_of_a_campaign_that_is_not_listed_is_a_problem(remote: Remote, tmp_path: Path) -> None:
    done = pull(remote, tmp_path / "back", campaigns=["cc"])
    assert "campaign 'cc' is not listed" in done.problems[0]


@pytest.mark.parametrize("files", range(1, 7))
def test_pull_interrupted_in_a_description_is_no_damage_and_follows_later(
    files: int, lab: Campaign, remote: Remote, tmp_path: Path
) -> None:
    left = [files]

    def interrupt(size: int) -> None:
        left[0] -= 1
        if not left[0]:
            raise KeyboardInterrupt

    place = tmp_path / "killed"
    with pytest.raises(KeyboardInterrupt):
        pull(remote, place, on_bytes=interrupt)
    assert [item for item in verify(TrialStore.open(place)) if item.kind == DAMAGED] == []
    assert pull(remote, place).problems == []
    again(lab, [TRIALS[0]], BY)
    push(store_of(lab), remote)
    assert (pull(remote, place).withdrawn, verify(TrialStore.open(place))) == (1, [])
