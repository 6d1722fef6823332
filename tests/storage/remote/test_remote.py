"""Pushed trials come back byte for byte, are never half there, and what is damaged is named."""

from __future__ import annotations

import itertools
import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from threading import Barrier, Event
from typing import Any
from uuid import uuid4

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sliplab.protocols.errors import InputError
from sliplab.protocols.hashing import hash_data
from sliplab.protocols.shown import MASK
from sliplab.storage.files import read_json, write_json
from sliplab.storage.remote.manifest import (
    Manifest,
    manifest_key,
    objects_folder,
    parse,
    read_manifests,
    trial_manifest,
)
from sliplab.storage.remote.mirror import mirror_folder, open_for_trial, open_mirror, place_of
from sliplab.storage.remote.objects import Remote, RemoteError, RemoteMissing, check_url, is_url
from sliplab.storage.remote.pull import ORIGIN, pull
from sliplab.storage.remote.push import PushOptions, push
from sliplab.storage.remote.verify import verify_remote
from sliplab.storage.trials.catalogue import catalogue
from sliplab.storage.trials.checksums import CHECKSUMS, DATA, Checksum
from sliplab.storage.trials.control import again
from sliplab.storage.trials.store import Campaign, StoreError, TrialStore
from sliplab.storage.trials.verify import verify
from tests.storage.remote.remotes import new_bucket, s3_server, tree
from tests.storage.trial_files import campaign, commit

TRIALS = ("depth=2.4mm,r=1", "depth=2.8mm,r=1", "depth=3.2mm,r=1")


@pytest.fixture(scope="module")
def endpoint() -> Iterator[str]:
    """A real S3 server."""
    with s3_server() as found:
        yield found


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with three trials and a bench record."""
    folder = tmp_path_factory.mktemp("made") / "store"
    where = campaign(folder)
    where.add_bench_record({"operator": "somebody"})
    for trial in TRIALS:
        commit(where, trial)
    return folder


@pytest.fixture
def store(made: Path, tmp_path: Path) -> TrialStore:
    """A copy of it."""
    return TrialStore.open(Path(shutil.copytree(made, tmp_path / "store")))


@pytest.fixture
def remote(tmp_path: Path) -> Remote:
    """An empty shared folder."""
    return Remote(f"file://{tmp_path}/shared")


def the(store: TrialStore) -> Campaign:
    """Its campaign."""
    return store.campaign("c")


@pytest.mark.quick(1)
@pytest.mark.parametrize("kind", ["s3", "file", "memory"])
def test_what_is_pulled_is_what_was_pushed(
    kind: str, endpoint: str, store: TrialStore, tmp_path: Path
) -> None:
    url = {
        "s3": lambda: new_bucket(endpoint),
        "file": lambda: f"file://{tmp_path}/shared/lab",
        "memory": lambda: f"memory://{uuid4().hex}/lab",
    }[kind]()
    the(store).quarantine(the(store).folder / "trials" / TRIALS[2], "gate: too loud")
    sent = push(store, Remote(url), options=PushOptions(quarantine=True))
    assert (sent.trials, sent.pushed, sent.set_aside, sent.problems) == (2, 2, 1, [])
    twice = push(store, Remote(url), options=PushOptions(quarantine=True))
    assert (twice.there, twice.pushed, twice.files, twice.bytes) == (2, 0, 0, 0)
    assert verify_remote(Remote(url)) == (2, [])
    back = pull(Remote(url), tmp_path / "back", quarantine=True)
    assert (back.trials, back.pulled, back.set_aside, back.problems) == (2, 2, 1, [])
    assert tree(tmp_path / "back", "campaigns") == tree(store.folder, "campaigns")
    assert verify(TrialStore.open(tmp_path / "back")) == []
    assert pull(Remote(url), tmp_path / "back", quarantine=True).files == 0


def test_cut_anywhere_nothing_half_is_visible(
    store: TrialStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The storage fails at its n-th write, for every n, and the next push goes on from there."""
    put, whole = Remote.put, 0
    for cut in range(100):
        url, count, done = f"memory://{uuid4().hex}", [0], 0

        def failing(self: Remote, key: str, *how: object, count: list[int] = count) -> None:
            count[0] += 1
            if count[0] > cut:  # noqa: B023 - called within this turn
                raise RemoteError(f"{key}: the line is cut")
            put(self, key, *how)  # type: ignore[arg-type]

        with monkeypatch.context() as patch:
            patch.setattr(Remote, "put", failing)
            try:
                whole = push(store, Remote(url)).files
            except RemoteError:
                pass
            else:
                break
        try:
            trials, problems = verify_remote(Remote(url))
        except RemoteMissing:
            trials, problems = 0, []
        assert problems == []
        known = read_manifests(Remote(url), "c", "trials")
        assert len(known) == trials < len(TRIALS)
        done = sum(map(len, _objects(Remote(url))))
        after = push(store, Remote(url))
        assert after.pushed == len(TRIALS) - trials
        assert done + after.files == len(_objects(Remote(url))[0])
    assert whole == len(_objects(Remote(url))[0])
    assert cut == whole + 1 + 1 + len(TRIALS)  # objects, layout, campaign, trials


def _objects(remote: Remote) -> list[dict[str, int]]:
    return [remote.sizes(objects_folder("c"))]


def test_a_pull_that_was_cut_goes_on(
    store: TrialStore, remote: Remote, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    push(store, remote)
    get, count = Remote.get, itertools.count(1)

    def failing(self: Remote, key: str, path: Path, known: Checksum, stop: Event) -> None:
        if next(count) > 7:
            raise KeyboardInterrupt
        get(self, key, path, known)

    with monkeypatch.context() as patch:
        patch.setattr(Remote, "get", failing)
        with pytest.raises(KeyboardInterrupt):
            pull(remote, tmp_path / "back")
    back = TrialStore.open(tmp_path / "back")
    assert the(back).committed() == {TRIALS[0]}
    assert pull(remote, tmp_path / "back").files == 3 * 5 - 7
    assert tree(back.folder, "campaigns") == tree(store.folder, "campaigns")


def test_files_of_a_trial_come_side_by_side_and_one_fault_stops_the_others(
    store: TrialStore, remote: Remote, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    push(store, remote)
    get, together = Remote.get, Barrier(2)
    stopped: list[str] = []

    def failing(self: Remote, key: str, path: Path, known: Checksum, stop: Event) -> None:
        if path.name in {CHECKSUMS, DATA}:
            together.wait(timeout=30)  # raises where they do not come side by side
        if path.name == CHECKSUMS:
            raise RemoteError(f"{key}: the line is cut")
        assert stop.wait(timeout=30)
        try:
            get(self, key, path, known, stop)
        except RemoteError as error:
            stopped.append(str(error))
            raise

    with monkeypatch.context() as patch:
        patch.setattr(Remote, "get", failing)
        done = pull(remote, tmp_path / "back")
    assert [problem.endswith("the line is cut") for problem in done.problems] == [True] * 3
    assert stopped
    assert all(text.endswith("was stopped") for text in stopped)
    assert pull(remote, tmp_path / "back").pulled == len(TRIALS)
    assert tree(tmp_path / "back", "campaigns") == tree(store.folder, "campaigns")


def test_a_damaged_object_is_named_and_sent_anew(
    store: TrialStore, remote: Any, tmp_path: Path
) -> None:
    push(store, remote)
    manifest = trial_manifest(the(store), TRIALS[1])
    objects = tmp_path / "shared" / objects_folder("c")
    video = objects / manifest.files["frames.mkv"].sha256
    data = bytearray(video.read_bytes())
    data[len(data) // 2] ^= 1
    video.write_bytes(data)
    own = objects / trial_manifest(the(store), TRIALS[2]).files["record.json"].sha256
    own.unlink()
    found = {(p.trial, p.path.rpartition("/")[2]): p.what for p in verify_remote(remote)[1]}
    # equal files are one object: every trial that has it is named
    assert "frames.mkv does not match its checksum" in found[TRIALS[1], video.name]
    assert "record.json is missing" in found[TRIALS[2], own.name]
    back = pull(remote, tmp_path / "back")
    assert back.pulled == 3 - len({trial for trial, _ in found})
    assert all("frames.mkv" in text or "record.json" in text for text in back.problems)
    assert push(store, remote).files in {0, 1}  # what is gone shows in the list
    assert push(store, remote, options=PushOptions(check=True)).problems == []
    assert verify_remote(remote) == (3, [])
    assert pull(remote, tmp_path / "back").problems == []


def test_a_damaged_trial_is_not_pushed(store: TrialStore, remote: Remote) -> None:
    path = the(store).folder / "trials" / TRIALS[0] / "record.json"
    path.write_bytes(path.read_bytes().replace(b"left", b"rite"))
    done = push(store, remote)
    assert (done.pushed, len(done.problems)) == (2, 1)
    assert "record.json: does not match its checksum" in done.problems[0]
    assert set(read_manifests(remote, "c", "trials")) == set(TRIALS[1:])


def test_a_trial_that_is_wanted_again_goes_and_comes_back(
    store: TrialStore, remote: Remote, tmp_path: Path
) -> None:
    push(store, remote)
    pull(remote, tmp_path / "back")
    again(the(store), [TRIALS[0]], {"who": "me", "when": "now", "why": "dust"})
    assert push(store, remote).withdrawn == 1
    back = pull(remote, tmp_path / "back")
    assert (back.trials, back.withdrawn) == (2, 1)
    commit(the(store), TRIALS[0], attempt=1)
    done = push(store, remote)
    assert (done.pushed, done.there) == (1, 2)
    assert pull(remote, tmp_path / "back").pulled == 1
    # and taken again between two pushes it is replaced in one step
    again(the(store), [TRIALS[1]], {"who": "me", "when": "now", "why": "dust"})
    commit(the(store), TRIALS[1], attempt=1)
    assert push(store, remote).replaced == 1
    assert pull(remote, tmp_path / "back").replaced == 1
    assert tree(tmp_path / "back/campaigns/c", "trials") == tree(the(store).folder, "trials")
    aside = the(TrialStore.open(tmp_path / "back")).quarantined()
    assert {item["cause"].split(":")[0] for item in aside} == {"withdrawn", "replaced"}


def test_two_stores_do_not_mix(store: TrialStore, remote: Remote, tmp_path: Path) -> None:
    push(store, remote)
    other = campaign(tmp_path / "other")
    commit(other, TRIALS[0], recorded_s=2.0)
    done = push(TrialStore.open(tmp_path / "other"), remote)
    assert "an attempt pushed from another store is there" in done.problems[0]
    other.update({"name": "c", "simulated": False}, "protocol: 1\n", "rig: 1\n")
    done = push(TrialStore.open(tmp_path / "other"), remote)
    assert "another campaign of this name is there: it differs in simulated" in done.problems[0]
    assert verify_remote(remote) == (3, [])
    # nor is anything in a store changed that was not pulled from there
    before = tree(tmp_path / "other", "campaigns")
    done = pull(remote, tmp_path / "other")
    assert "differs from that at" in done.problems[0]
    assert tree(tmp_path / "other", "campaigns") == before
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "thesis.tex").touch()
    with pytest.raises(StoreError, match="holds other files"):
        pull(remote, tmp_path / "elsewhere")
    with pytest.raises(RemoteError, match="contains other files"):
        push(store, Remote(f"file://{tmp_path}/elsewhere"))


def test_pushed_while_trials_are_taken(store: TrialStore, remote: Remote, tmp_path: Path) -> None:
    """A trial that stands aside is not seen; one that is committed meanwhile is sent next time."""
    begun = the(store).begin("depth=4mm,r=1", (48, 32), 100)
    new = iter(["depth=5mm,r=1"])

    def meanwhile(_: str) -> None:
        for trial in new:
            commit(the(store), trial)
            again(the(store), [TRIALS[2]], {"who": "me", "when": "now", "why": "dust"})

    done = push(store, remote, on_trial=meanwhile)
    assert done.pushed == 2
    assert len(done.problems) <= 1  # the one that went away
    assert set(read_manifests(remote, "c", "trials")) == set(TRIALS[:2])
    assert push(store, remote).pushed == 1
    begun.discard()
    assert verify_remote(remote) == (3, [])


ESCAPES = ["../x", "/etc/x", "a/b", "..", ".hidden", "bench/../../x", "x\0", "", "cause.json"]


@pytest.mark.parametrize("name", ESCAPES)
def test_a_manifest_leads_nowhere_else(
    name: str, store: TrialStore, remote: Remote, tmp_path: Path
) -> None:
    push(store, remote)
    for kind, trial in (("trials", TRIALS[0]), ("about", "")):
        path = tmp_path / "shared" / manifest_key(kind, "c", trial)  # type: ignore[arg-type]
        data = json.loads(path.read_text())
        del data["sum"]
        data["files"][name] = data["files"]["checksums.json"]
        path.write_text(json.dumps({**data, "sum": hash_data(data)}))
    before = {path for path in tmp_path.rglob("*") if "back" not in path.parts}
    done = pull(remote, tmp_path / "back")
    assert done.pulled == 0
    assert any("which does not belong there" in text for text in done.problems)
    assert {path for path in tmp_path.rglob("*") if "back" not in path.parts} == before
    assert not list((tmp_path / "back").rglob("x*"))


def test_names_and_objects_of_others_are_refused(
    store: TrialStore, remote: Any, tmp_path: Path
) -> None:
    push(store, remote)
    trials = tmp_path / "shared/campaigns/c/trials"
    shutil.copy(trials / f"{TRIALS[0]}.json", trials / "other=1mm.json")  # of something else
    shutil.copy(trials / f"{TRIALS[0]}.json", trials / "a b.json")
    shutil.copytree(tmp_path / "shared/campaigns/c", tmp_path / "shared/campaigns/c d")
    data = json.loads((trials / f"{TRIALS[0]}.json").read_text())
    del data["sum"]
    data["files"]["data.h5"]["sha256"] = "../../../etc/passwd"
    (trials / f"{TRIALS[0]}.json").write_text(json.dumps({**data, "sum": hash_data(data)}))
    (trials / f"{TRIALS[1]}.json").write_text((trials / f"{TRIALS[1]}.json").read_text()[:90])
    done = pull(remote, tmp_path / "back")
    assert done.pulled == 1
    reported = " ".join(done.problems)
    named = ("belongs to another trial or campaign", "'a b'", "'c d'")
    for part in (*named, "no checksum of data.h5", "is incomplete"):
        assert part in reported
    assert len(verify_remote(remote)[1]) == len(done.problems)


@settings(max_examples=150)
@given(st.data())
def test_a_mutated_manifest_is_refused(data: st.DataObject) -> None:
    names = ("data.h5", "record.json", "checksums.json", "provenance.json")
    files = dict.fromkeys(names, Checksum("a" * 64, 3))
    whole = Manifest("trials", "c", "t", files, "take").dump()
    assert parse(whole, "trials", "c", "t", "here").files == files
    at = data.draw(st.integers(0, len(whole) - 1))
    new = data.draw(st.binary(max_size=4))
    mutated = whole[:at] + new + whole[at + data.draw(st.integers(0, 4)) :]
    try:
        same = json.loads(mutated) == json.loads(whole)
    except ValueError:
        same = False
    if not same:
        with pytest.raises(RemoteError, match="here: "):
            parse(mutated, "trials", "c", "t", "here")


def test_a_mirror_fetches_what_is_read(
    store: TrialStore, remote: Remote, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SLIPLAB_CACHE", str(tmp_path / "cache"))
    push(store, remote)
    mirror, done = open_mirror(remote.url)
    assert (done.pulled, mirror.folder) == (3, mirror_folder(remote.url))
    assert mirror.folder.is_relative_to(tmp_path / "cache")
    assert not list(mirror.folder.rglob("data.h5"))
    assert the(mirror).committed() == set(TRIALS)
    assert verify(mirror) == []
    frame = catalogue(mirror)
    assert frame.equals(catalogue(store))
    assert not list(mirror.folder.rglob("data.h5"))
    recording = the(mirror).recording(TRIALS[0])
    assert len(recording.events()) == 1000
    assert len(list(recording.frames())) == 12
    assert {path.parent.name for path in mirror.folder.rglob("data.h5")} == {TRIALS[0]}
    assert place_of(mirror) == remote.url
    assert place_of(store) == str(store.folder)
    # another machine, of which only one trial is asked
    monkeypatch.setenv("SLIPLAB_CACHE", str(tmp_path / "other"))
    there = open_for_trial(remote.url, "c", TRIALS[1])
    assert len(the(there).recording(TRIALS[1]).events()) == 1000
    assert the(there).committed() == {TRIALS[1]}
    with pytest.raises(RemoteMissing, match="has no trial"):
        open_for_trial(remote.url, "c", "depth=9mm")
    # what is damaged there is not read
    target = trial_manifest(the(store), TRIALS[0]).files["data.h5"].sha256
    (tmp_path / "shared" / objects_folder("c") / target).write_bytes(b"x")
    again_there = open_for_trial(remote.url, "c", TRIALS[2])
    with pytest.raises(RemoteError, match=r"data\.h5: .*does not match its checksum"):
        the(again_there).recording(TRIALS[2]).events()
    assert not (the(again_there).folder / "trials" / TRIALS[2] / "data.h5").exists()


def test_versions_and_places_that_cannot_be_used(
    store: TrialStore, remote: Any, tmp_path: Path
) -> None:
    with pytest.raises(RemoteMissing, match="does not contain a pushed store"):
        pull(remote, tmp_path / "back")
    assert not (tmp_path / "back").exists()
    push(store, remote)
    write_json(tmp_path / "shared" / "sliplab.json", {"layout": 2})
    with pytest.raises(RemoteError, match="newer version"):
        push(store, remote)
    write_json(store.folder / "store.json", {"format": 1})
    with pytest.raises(StoreError, match="sliplab migrate"):
        push(store, remote)
    secret = ("s3://me:hunter2@b/x", "s3://b/x?token=hunter2")
    for url in ("lab", *secret, "zip::s3://b/x", "file:///a/../b"):
        with pytest.raises(InputError) as wrong:
            Remote(url)
        assert "hunter2" not in wrong.value.message
    with pytest.raises(InputError, match="cannot be used"):
        Remote("nonsense://a/b")
    for url in ("https://example.org/store", "http://example.org/store"):
        with pytest.raises(InputError, match=r"web page's .* s3://BUCKET/FOLDER, file:///FOLDER"):
            Remote(url)
    with pytest.raises(RemoteError, match=r"ftp://localhost:1/x: cannot be reached: .*refused"):
        Remote("ftp://localhost:1/x")
    assert is_url("s3://a/b")
    assert not is_url("/a/b")
    assert check_url("s3://a/b/") == "s3://a/b"


@pytest.mark.long
def test_secrets_are_nowhere(endpoint: str, store: TrialStore, tmp_path: Path) -> None:
    url = new_bucket(endpoint)
    push(store, Remote(url))
    pull(Remote(url), tmp_path / "back")
    secret = os.environ["AWS_SECRET_ACCESS_KEY"].encode()
    for folder in (store.folder, tmp_path / "back"):
        assert not [name for name, data in tree(folder, ".").items() if secret in data]
    assert read_json(tmp_path / "back" / ORIGIN) == {"url": url}
    lost = Remote("s3://no-such-bucket-here/x")
    with pytest.raises(RemoteError) as reported:
        push(store, lost)
    assert secret.decode() not in str(reported.value)
    with pytest.raises(RemoteError) as reported, lost._errors_translated("key", "read"):
        raise ValueError(f"signature of {secret.decode()} is wrong")
    assert f"signature of {MASK} is wrong" in str(reported.value)
