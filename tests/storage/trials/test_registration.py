"""Registrations are numbered, chained and never changed; damage and foreign stamps are named."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest

from sliplab.protocols.errors import InputError
from sliplab.storage.errors import StoreError
from sliplab.storage.files import json_text, sha256, write_json
from sliplab.storage.remote.objects import Remote
from sliplab.storage.remote.pull import pull
from sliplab.storage.remote.push import push
from sliplab.storage.remote.verify import verify_remote
from sliplab.storage.schema.registration import Registration
from sliplab.storage.trials.registration import (
    add_registration,
    attach_stamp,
    copy_registrations,
    registration_files,
    registration_problems,
    registrations,
    stamps,
)
from sliplab.storage.trials.store import Campaign, TrialStore
from sliplab.storage.trials.verify import DAMAGED, UNFINISHED, verify
from tests.storage.remote.remotes import tree
from tests.storage.trial_files import campaign, commit

PROTOCOL = {"name": "c", "file_sha256": "f" * 64, "text": "protocol: 1\n", "enabled": []}
PROTOCOL |= {"collection_hash": "c" * 64, "analysis_hash": "a" * 64}
CONTENT: dict[str, Any] = {
    "protocol": PROTOCOL,
    "analysis": {"windows": {"length_ms": 30}},
    "stopping": {"error": 0.05, "claims": []},
    "taken": {"committed": 0, "attempts": 0},
    "registered": "2026-01-02T03:04:05+00:00",
}
CONTENT |= {"judging_model": None, "planned": 3, "rig": None, "versions": {"numpy": "2.0"}}
HEADS = {
    ".tsr": bytes.fromhex("30820100 3003 020100"),  # a response begins with its status
    ".ots": b"\x00OpenTimestamps\x00\x00Proof\x00",
}


@pytest.fixture
def where(tmp_path: Path) -> Campaign:
    """A campaign."""
    return campaign(tmp_path / "store")


def registered(where: Campaign, count: int = 1) -> list[Path]:
    """Register a campaign some times."""
    return [add_registration(where, CONTENT) for _ in range(count)]


@pytest.fixture
def path(where: Campaign) -> Path:
    """A registration."""
    return registered(where)[0]


def problems(where: Campaign) -> dict[str, str]:
    """What is wrong, by the file's name."""
    return {path.name: what for path, what in registration_problems(where)}


def test_same_content_gives_the_same_bytes(tmp_path: Path) -> None:
    (one,), (other,) = (registered(campaign(tmp_path / name)) for name in "ab")
    assert one.read_bytes() == other.read_bytes()
    data = json.loads(one.read_bytes())
    assert one.read_bytes() == json_text(dict(reversed(data.items()))).encode()
    assert Registration.load(one).after == "before the first trial"


def test_later_registration_is_numbered_and_chained(where: Campaign, tmp_path: Path) -> None:
    first, second, third = registered(where, 3)
    assert [path.name for path in (first, second, third)] == ["0001.json", "0002.json", "0003.json"]
    assert [it.previous for _, it in registrations(where)] == [None, sha256(first), sha256(second)]
    assert problems(where) == {}
    assert verify(TrialStore.open(tmp_path / "store")) == []


def test_taken_number_is_never_overwritten(where: Any, monkeypatch: Any) -> None:
    (first,) = registered(where)
    before = first.read_bytes()
    module = "sliplab.storage.trials.registration"
    monkeypatch.setattr(f"{module}.registrations", lambda campaign: [])  # as another process saw it
    with pytest.raises(StoreError, match="never overwritten"):
        add_registration(where, {**CONTENT, "planned": 4})
    assert first.read_bytes() == before
    assert first.stat().st_mode & 0o222 == 0


def test_registered_campaign_without_trials_is_whole(tmp_path: Path) -> None:
    store = TrialStore.create(tmp_path / "store")
    registered(store.campaign("c"))
    assert verify(store) == []
    assert store.campaigns() == []


@pytest.mark.parametrize(
    ("change", "name", "what"),
    [
        (lambda data: {**data, "planned": 4}, "0002.json", "does not match its checksum"),
        (lambda data: {**data, "planned": "4"}, "0002.json", "planned"),
        (lambda data: {**data, "campaign": "d"}, "0002.json", "checksum"),
        (lambda data: "", "0002.json", "is not JSON"),
    ],
)
def test_changed_file_is_named(
    where: Any, tmp_path: Any, change: Any, name: str, what: str
) -> None:
    _, second = registered(where, 2)
    text = change(json.loads(second.read_bytes()))
    os.chmod(second, 0o644)
    second.write_text(text if isinstance(text, str) else json_text(text))
    assert what in problems(where)[name]
    (found,) = verify(TrialStore.open(tmp_path / "store"))
    assert (Path(found.path).name, found.kind, found.campaign) == (name, DAMAGED, "c")


def test_other_spaces_are_named(path: Path, where: Campaign) -> None:
    os.chmod(path, 0o644)
    path.write_text(json.dumps(json.loads(path.read_bytes())))
    assert "not as it was written" in problems(where)["0001.json"]


def test_every_cut_or_changed_byte_is_named(path: Path, where: Campaign) -> None:
    os.chmod(path, 0o644)
    whole = path.read_bytes()
    for at in range(0, len(whole), 7):
        for damaged in (whole[:at], whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :]):
            path.write_bytes(damaged)
            assert "0001.json" in problems(where), damaged


def test_missing_registration_is_named(where: Campaign) -> None:
    first, second, third = registered(where, 3)
    second.unlink()
    assert "missing or changed" in problems(where)["0003.json"]
    third.unlink()
    assert problems(where) == {}  # the last ones: only a session remembers them
    where.add_bench_record({"operator": "", "registration": sha256(first)})
    assert problems(where) == {}
    first.rename(first.with_name("0002.json"))
    assert "is number 1" in problems(where)["0002.json"]
    first.with_name("0002.json").unlink()
    assert "missing or changed" in problems(where)["0001.json"]


def test_damaged_earlier_registration_refuses_another_one(where: Campaign) -> None:
    (first,) = registered(where)
    os.chmod(first, 0o644)
    first.write_text(first.read_text().replace('"planned": 3', '"planned": 4'))
    said = r"0001\.json.* does not match its checksum; restore it from a copy"
    with pytest.raises(StoreError, match=said):
        registered(where)
    assert registration_files(where) == [first]


def test_temporary_and_foreign_files_are_named(path: Path, where: Campaign, tmp_path: Path) -> None:
    (path.parent / "notes.txt").write_text("")
    (path.parent / f".0002.json.{2**22 + 1}.tmp").write_text("")
    found = {Path(it.path).name: it.kind for it in verify(TrialStore.open(tmp_path / "store"))}
    assert found == {"notes.txt": DAMAGED, f".0002.json.{2**22 + 1}.tmp": UNFINISHED}
    where.sweep()
    assert [each.name for each in sorted(path.parent.iterdir())] == ["0001.json", "notes.txt"]


@pytest.mark.parametrize("ending", [".tsr", ".ots"])
def test_stamp_goes_to_the_registration_it_is_of(where: Any, tmp_path: Path, ending: str) -> None:
    files = registered(where, 2)
    stamp = tmp_path / f"answer{ending}"
    stamp.write_bytes(HEADS[ending] + bytes.fromhex(sha256(files[0])) + b" by an authority")
    assert attach_stamp(files, stamp) == files[0].with_name(f"0001.json{ending}")
    assert attach_stamp(files, stamp)  # the same once more changes nothing
    assert [path.name for path in stamps(files[0])] == [f"0001.json{ending}"]
    assert stamps(files[1]) == []
    assert problems(where) == {}
    stamp.write_bytes(HEADS[ending] + b"of another file")
    with pytest.raises(InputError, match="does not contain the SHA-256"):
        attach_stamp(files, stamp)
    # a request to an authority begins with its version
    stamp.write_bytes(bytes.fromhex("3059 020101") + bytes.fromhex(sha256(files[0])))
    with pytest.raises(InputError, match=r"is no response of a time|is no proof of OpenTimestamps"):
        attach_stamp(files, stamp)


def test_second_authority_does_not_overwrite_the_first(where: Campaign, tmp_path: Path) -> None:
    files = registered(where)
    digest = bytes.fromhex(sha256(files[0]))
    for ending in (".tsr", ".ots"):
        (tmp_path / f"one{ending}").write_bytes(HEADS[ending] + digest + b"1")
        (tmp_path / f"two{ending}").write_bytes(HEADS[ending] + digest + b"2")
        attach_stamp(files, tmp_path / f"one{ending}")
    with pytest.raises(StoreError, match="never overwritten"):
        attach_stamp(files, tmp_path / "two.tsr")
    attach_stamp(files, tmp_path / "two.ots")  # a completed proof
    assert [path.read_bytes()[-1:] for path in stamps(files[0])] == [b"1", b"2"]


def test_stamp_of_another_kind_or_missing_is_refused(where: Campaign, tmp_path: Path) -> None:
    files = registered(where)
    with pytest.raises(InputError, match=r"must end in \.tsr or \.ots"):
        attach_stamp(files, tmp_path / "stamp.sig")
    with pytest.raises(InputError, match="cannot be read"):
        attach_stamp(files, tmp_path / "none.tsr")
    with pytest.raises(InputError, match="cannot be read"):
        attach_stamp(files, Path(os.fspath(tmp_path)).with_suffix(".tsr"))


def test_changed_stamp_and_stamp_without_registration_are_named(path: Any, where: Campaign) -> None:
    path.with_name("0001.json.tsr").write_bytes(b"of another file")
    path.with_name("0007.json.ots").write_bytes(b"")
    assert "SHA-256" in problems(where)["0001.json.tsr"]
    assert problems(where)["0007.json.ots"] == "is of no registration"


def test_push_and_pull_take_registrations_along(path: Any, where: Campaign, tmp_path: Path) -> None:
    path.with_name("0001.json.tsr").write_bytes(bytes.fromhex(sha256(path)))
    commit(where, "a")
    remote = Remote(f"file://{tmp_path / 'shared'}")
    assert push(TrialStore.open(tmp_path / "store"), remote).problems == []
    registered(where)
    assert push(TrialStore.open(tmp_path / "store"), remote).problems == []
    assert verify_remote(remote) == (1, [])
    assert pull(remote, tmp_path / "copy").problems == []
    part = "campaigns/c/registrations"
    assert len(tree(tmp_path / "copy", part)) == 3
    assert tree(tmp_path / "copy", part) == tree(tmp_path / "store", part)
    assert verify(TrialStore.open(tmp_path / "copy")) == []


def test_pull_leaves_another_registration_as_it_is(where: Campaign, tmp_path: Path) -> None:
    commit(where, "a")
    remote = Remote(f"file://{tmp_path / 'shared'}")
    push(TrialStore.open(tmp_path / "store"), remote)
    pull(remote, tmp_path / "copy")
    mine = TrialStore.open(tmp_path / "copy").campaign("c")
    path = add_registration(mine, {**CONTENT, "planned": 4})
    before = path.read_bytes()
    registered(where)
    push(TrialStore.open(tmp_path / "store"), remote)
    (problem,) = pull(remote, tmp_path / "copy").problems
    assert "0001.json: differs" in problem
    assert path.read_bytes() == before


def test_copies_are_the_files_and_their_stamps(where: Campaign, tmp_path: Path) -> None:
    copy_registrations(where, tmp_path / "none")
    assert not (tmp_path / "none").exists()
    (path,) = registered(where)
    path.with_name("0001.json.ots").write_bytes(bytes.fromhex(sha256(path)))
    write_json(path.with_name("notes.json"), {})
    copy_registrations(where, tmp_path / "out" / "c")
    names = sorted(it.name for it in (tmp_path / "out" / "c").iterdir())
    assert names == ["0001.json", "0001.json.ots"]
