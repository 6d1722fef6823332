"""Stores whose files somebody wrote who means harm, or a fuzzer: nothing leaves, nothing escapes.

Each record here was once read without a question, and ended in an exception that says nothing.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest

from sliplab.storage.errors import StoreError
from sliplab.storage.files import read_json, sha256
from sliplab.storage.trials import control
from sliplab.storage.trials.catalogue import catalogue
from sliplab.storage.trials.checksums import read_sums
from sliplab.storage.trials.control import skipped
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import Campaign, TrialStore
from sliplab.storage.trials.verify import verify
from tests.protocols.planning import put_all
from tests.storage.trial_files import campaign, commit


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Campaign:
    """One trial."""
    where = campaign(tmp_path_factory.mktemp("hostile") / "store")
    commit(where, "t")
    return where


def _with(folder: Path, data: bytes) -> Recording:
    """The trial with another record, whose checksum fits."""
    (folder / "record.json").write_bytes(data)
    sums = read_json(folder / "checksums.json")
    sums["record.json"] = {"sha256": sha256(folder / "record.json"), "bytes": len(data)}
    (folder / "checksums.json").write_text(json.dumps(sums))
    return Recording(folder)


@pytest.fixture
def store(tmp_path: Path) -> TrialStore:
    """A store without anything."""
    return TrialStore.create(tmp_path / "store")


# what is put in a record's place (nothing: dropped)
RECORDS = """
    condition: 2.4 mm
    condition.depth: deep mm
    condition.depth: 1e999 mm
    clocks.events.map.reference_ns: [1.0e-300]
    clocks.events:
    clocks.events.uncertainty_ns: '1'
    counts.events: -1180591620717411303424
    quality:
    trial: [1]
    steps: [1]
    steps: [{phase: slide, start_ns: 18446744073709551616, end_ns: 0}]
    format: '9'
    recorded_s: .nan
"""


@pytest.mark.parametrize("change", RECORDS.strip().splitlines())
def test_a_record_of_another_shape_is_damage(made: Campaign, change: str) -> None:
    folder = made.folder / "trials" / "t"
    whole = (folder / "record.json").read_bytes()
    data = json.loads(whole)
    put_all(data, change)
    with pytest.raises(StoreError, match=r"record\.json"):
        _ = _with(folder, json.dumps(data).encode()).record
    store, unreadable = TrialStore.open(made.folder.parents[1]), []  # type: ignore[var-annotated]
    assert len(catalogue(store, unreadable)) == 0
    assert len(unreadable) == 1
    assert [p.trial for p in verify(store)] == ["t"]
    _with(folder, whole)


def test_a_record_that_is_no_json_is_damage(made: Campaign) -> None:
    folder = made.folder / "trials" / "t"
    whole = (folder / "record.json").read_bytes()
    for data in (b"{", b"\xb9", b"[1]", b'{"a":' * 50_000):
        with pytest.raises(StoreError, match=r"record\.json"):
            _ = _with(folder, data).record
    _with(folder, whole)


def test_a_record_without_steps_has_no_phases(made: Campaign) -> None:
    recording = made.recording("t")
    assert recording.record.steps == ()
    assert recording.motion_phase == "retract"
    with pytest.raises(KeyError, match="no step 'slide'"):
        recording.step("slide")


def test_a_trial_without_a_clock_says_which_it_has(made: Campaign) -> None:
    folder = made.folder / "trials" / "t"
    whole = (folder / "record.json").read_bytes()
    data = json.loads(whole)
    data["clocks"].pop("frames", None)
    recording = _with(folder, json.dumps(data).encode())
    with pytest.raises(StoreError, match=r"no clock 'frames'; it has: .*events"):
        recording.frame_times()
    _with(folder, whole)


def test_frames_of_another_size_than_the_record_says_are_damage(tmp_path: Path) -> None:
    where = campaign(tmp_path / "store")
    commit(where, "t", geometry={"frame_px": [48, 32]})
    commit(where, "u", geometry={"frame_px": [32, 48]})
    assert len(list(where.recording("t").frames())) == 12
    other = where.recording("u")
    for read in (lambda: list(other.frames()), lambda: other.frame(3)):
        with pytest.raises(StoreError, match=r"frame of 48 x 32 px, the record says 32 x 48"):
            read()


@pytest.mark.parametrize(
    "name", ["../x", "/etc/passwd", "a/b", "", ".", "..", "a\0b", "C:\\x", ".x", "x" * 200]
)
def test_checksums_name_files_beside_them_only(tmp_path: Path, name: str) -> None:
    sums = {name: {"sha256": "0", "bytes": 1}}
    (tmp_path / "checksums.json").write_text(json.dumps(sums))
    with pytest.raises(ValueError, match="not a list of checksums"):
        read_sums(tmp_path, ())


@pytest.mark.parametrize("said", [{"sha256": 1, "bytes": 1}, {"sha256": "0", "bytes": "1"}, [], 1])
def test_checksums_are_text_and_a_number(tmp_path: Path, said: Any) -> None:
    (tmp_path / "checksums.json").write_text(json.dumps({"a": said}))
    with pytest.raises(ValueError, match="not a list of checksums"):
        read_sums(tmp_path, ())


NAMES = ["../x", "/x", "a/b", "..", "", ".", ".hidden", "a\\b", "a\nb", "a\0b", "C:x", "a..b", "é"]
NAMES += ["x" * 252, "x" * 300, "a/../../b", "a\\..\\b/"]


@pytest.mark.parametrize("name", NAMES)
def test_names_stay_in_the_store(store: TrialStore, name: str) -> None:
    for use in (
        lambda: store.campaign(name),
        lambda: store.campaign("c").recording(name),
        lambda: store.campaign("c").begin(name, None, 100),
        lambda: Derived.of(store, name),
        lambda: Derived.of(store, "labels", "c").key(name),
    ):
        with pytest.raises(StoreError, match="cannot be the name"):
            use()


@pytest.mark.parametrize("name", ["campaigns", "control", "derived", "models", "report", "before"])
def test_a_link_out_of_the_store_is_refused(store: TrialStore, tmp_path: Path, name: str) -> None:
    (tmp_path / "outside").mkdir()
    (store.folder / "inside").mkdir()
    os.symlink(tmp_path / "outside", store.folder / name)
    with pytest.raises(StoreError, match="points out of the store"):
        TrialStore.open(store.folder)
    (store.folder / name).unlink()
    os.symlink("inside", store.folder / name)
    TrialStore.open(store.folder)


def test_a_quarantine_that_leads_out_is_refused(tmp_path: Path) -> None:
    where = campaign(tmp_path / "store")
    folder = commit(where, "t")
    (tmp_path / "outside").mkdir()
    (where.folder / "quarantine").rmdir()
    os.symlink(tmp_path / "outside", where.folder / "quarantine")
    with pytest.raises(StoreError, match="points out of the store"):
        where.quarantine(folder, "gate")
    assert list((tmp_path / "outside").iterdir()) == []


def test_names_of_trials_and_campaigns_cannot_lead_out_of_the_store(tmp_path: Path) -> None:
    where = campaign(tmp_path / "s")
    for name in ("../x", "a/b", "", ".hidden", "a\0b", "x" * 300):
        with pytest.raises(StoreError, match="cannot be the name"):
            where.begin(name, None, 100)
    store = TrialStore.open(tmp_path / "s")
    for name in ("..", "../x", "/etc", "a/../../b", "a\\..\\b/", "", ".", "é"):
        with pytest.raises(StoreError, match="cannot be the name"):
            store.campaign(name)


def test_derived_results_that_lead_out_are_refused(store: TrialStore, tmp_path: Path) -> None:
    (tmp_path / "outside").mkdir()
    (store.folder / "derived").mkdir()
    os.symlink(tmp_path / "outside", store.folder / "derived" / "labels")
    with pytest.raises(StoreError, match="points out of the store"):
        Derived.of(store, "labels", "c")


@pytest.mark.parametrize(
    "change", [{"campaign": "../../x"}, {"trials": ["../x"]}, {"trials": 1}, {"kind": "delete"}]
)
def test_a_request_that_leads_out_is_left_out(tmp_path: Path, change: dict[str, Any]) -> None:
    store = TrialStore.create(tmp_path / "store")
    control.ask(store, "again", campaign="c", trials=("t",))
    path = store.folder / "control" / "000001.json"
    path.write_text(json.dumps({**read_json(path), **change}))
    assert control.requests(store) == []


@pytest.mark.parametrize("text", ["{}", "[]", '{"did": 1}', "{", '{"did": {"a": NaN}}'])
def test_a_damaged_answer_is_an_empty_one(store: TrialStore, text: str) -> None:
    asked = control.ask(store, "pause")
    (store.folder / "control" / "000001.done.json").write_text(text)
    assert control.answered(store, asked) == {"did": {}}


def test_set_aside_without_by_whom_is_damage(tmp_path: Path) -> None:
    where = campaign(tmp_path / "store")
    (where.folder / "skipped.json").write_text('{"t": 1}')
    with pytest.raises(StoreError, match="who set which trial aside"):
        skipped(where)


def test_json_without_numbers_that_are_none(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text('{"a": NaN}')
    with pytest.raises(ValueError, match="not a JSON number"):
        read_json(tmp_path / "a.json")


REFITTED = """{"key": "k", "raw": RAW, "clocks": 1}
{"key": "k", "raw": RAW, "clocks": {}}
{"key": 1, "raw": RAW, "clocks": {}}
{"""


@pytest.mark.parametrize("reported", REFITTED.splitlines())
def test_refitted_clocks_of_another_shape_are_damage(
    made: Campaign, tmp_path: Path, reported: str
) -> None:
    recording = made.recording("t")
    file = tmp_path / "t.json"
    file.write_text(reported.replace("RAW", json.dumps(recording.raw_checksum)))
    with pytest.raises(StoreError, match="sliplab sync"):
        _ = Recording(recording.folder, file).clocks
