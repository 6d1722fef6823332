"""The log of a store: notes, requests, sessions, runs and decisions, in the order of time."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from uuid import uuid4

import pytest

import sliplab
from sliplab.flows.log import MOST_CHARACTERS, add_note, log_entries
from sliplab.flows.running import run_records
from sliplab.storage.errors import StoreError
from sliplab.storage.trials import control, review
from sliplab.storage.trials.review import ReviewedOnsets
from sliplab.storage.trials.store import TrialStore
from tests.command_line import answer, here
from tests.storage.trial_files import campaign, commit, fail


def test_the_log_holds_what_people_and_programs_did(tmp_path: Path) -> None:
    tiny = campaign(tmp_path / "s", "tiny")
    store = TrialStore.open(tmp_path / "s")
    commit(tiny, "a")
    fail(tiny, "b", 1)
    control.ask(store, "skip", who="anna", why="worn", campaign="tiny", trials=("b",))
    asked = control.ask(store, "pause", who="ben", why="lunch")
    control.answer(store, asked, {"paused": True})
    onsets = ReviewedOnsets(5, 9)
    review.decide(
        store, "tiny", "a", "accept", label="k", old=onsets, new=onsets, seen=0, who="cleo"
    )
    run = str(uuid4())
    run_records.begin(store.folder, run, "collect", run_records.EMBEDDED, "nightly")
    run_records.end(store.folder, run, "FAILED", "no answer", "flow")
    assert "stopped" not in "".join(entry.text for entry in log_entries(store))
    stopped = str(uuid4())
    run_records.begin(store.folder, stopped, "label", run_records.EMBEDDED)
    run_records.end(store.folder, stopped, "CRASHED", "KeyboardInterrupt: ", "flow")
    texts = [entry.text for entry in log_entries(store) if entry.what == "run"]
    assert "label: stopped by a person after 0 s" in texts
    add_note(store, "new skin", who="dora")
    faults: list[str] = []
    found = {entry.what: entry for entry in log_entries(store, faults)}
    assert faults == []
    assert found["note"].text == "new skin"
    assert (found["skip"].who, found["skip"].trials) == ("anna", ("b",))
    assert found["skip"].text == "worn (not carried out yet)"
    assert (found["pause"].who, found["pause"].text) == ("ben", "lunch")
    assert (found["accept"].who, found["accept"].trials) == ("cleo", ("a",))
    assert found["quarantine"].trials == ("b",)
    assert any(text.startswith("collect of nightly: failed after 0 s: no answer") for text in texts)
    times = [entry.when for entry in log_entries(store)]
    assert times == sorted(times)


def test_the_command_prints_the_entries_of_a_campaign(tmp_path: Path) -> None:
    fail(campaign(tmp_path / "s", "tiny"), "b", 1)
    fail(campaign(tmp_path / "s", "other"), "c", 1)
    add_note(TrialStore.open(tmp_path / "s"), "lunch", who="anna")
    found = answer("log", tmp_path / "s", "--campaign", "tiny")["entries"]
    assert [entry["trials"] for entry in found] == [["b"]]
    assert len(answer("log", tmp_path / "s")["entries"]) == 3
    done = here("log", tmp_path / "s", "--campaign", "tinny")
    assert "--campaign = tinny: must be one of other, tiny; did you mean 'tiny'?" in done.stderr


def test_a_damaged_file_is_named_and_hides_no_other(tmp_path: Path) -> None:
    store = TrialStore.create(tmp_path / "s")
    add_note(store, "first")
    add_note(store, "second")
    (store.folder / "log" / "000001.json").write_text("{")
    faults: list[str] = []
    assert [entry.text for entry in log_entries(store, faults)] == ["second"]
    assert "000001.json" in faults[0]


def test_a_notebook_reads_the_status_and_the_log_and_adds_a_note(tmp_path: Path) -> None:
    TrialStore.create(tmp_path / "s")
    store = sliplab.open_store(tmp_path / "s")
    entry = store.note("new skin", who="anna")
    assert store.log() == [entry]
    assert (store.status().running, store.status().campaigns) == (None, [])


def test_notes_made_at_once_are_all_kept(tmp_path: Path) -> None:
    store = TrialStore.create(tmp_path / "s")
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda n: add_note(store, str(n)), range(40)))
    assert sorted(int(entry.text) for entry in log_entries(store)) == list(range(40))


@pytest.mark.parametrize("text", ["", "  \n", "x" * (MOST_CHARACTERS + 1)])
def test_a_note_has_text_of_a_sensible_length(tmp_path: Path, text: str) -> None:
    with pytest.raises(ValueError, match="must"):
        add_note(TrialStore.create(tmp_path / "s"), text)


def test_a_log_outside_of_the_store_is_refused(tmp_path: Path) -> None:
    store = TrialStore.create(tmp_path / "s")
    (tmp_path / "elsewhere").mkdir()
    (store.folder / "log").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(StoreError, match="out of the store"):
        add_note(store, "x")
