"""`sliplab import` and `export` as a person meets them, and what follows for other commands."""

from __future__ import annotations

import errno
import random
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from sliplab.analysis.campaigns import collected
from sliplab.flows.planning.run_request import make_request
from sliplab.protocols import InputError
from sliplab.storage.files import read_json
from sliplab.storage.formats import export_trials as _exports
from sliplab.storage.formats.aedat4 import Aedat4Stream, Aedat4Writer
from sliplab.storage.streams import EventChunk
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import StoreError, TrialStore
from tests.command_line import here, outcome
from tests.conftest import ROOT
from tests.flows.conftest import tiny, write
from tests.storage.formats.files import lab_hdf5
from tests.storage.formats.recordings import FILES, HEADERS, write_aedat4
from tests.storage.trial_files import campaign, commit


def test_in_and_out(tmp_path: Path) -> None:
    lab_hdf5(tmp_path / "slide.h5")
    store, out = tmp_path / "store", tmp_path / "out"
    path = tmp_path / "slide.h5"
    code, reported, _ = outcome("import", path, "--store", store, "--name", "a", "--json")
    assert code == 0
    assert reported == {
        "campaign": "a",
        "imported": ["slide"],
        "there": [],
        "events": 50,
        "frames": 0,
    }
    code, reported, said = outcome("verify", store, "--json")
    assert (code, reported["whole"]) == (0, 1)
    code, reported, said = outcome("trials", store, "--output", tmp_path / "t.parquet")
    assert code == 0
    assert "left out" not in said
    assert pd.read_parquet(tmp_path / "t.parquet")["trial"].tolist() == ["slide"]
    code, reported, _ = outcome(
        "export", store, "slide", "--as", "aedat4", "--output", out, "--json"
    )
    assert (code, reported["events"]) == (0, 50)
    code, reported, _ = outcome("import", "aedat4", out, "--store", store, "--name", "b", "--json")
    assert (code, reported["imported"]) == (0, ["slide"])
    assert not TrialStore.open(store).simulated
    code, _, said = outcome("export", store, "a", "--as", "labels", "--output", tmp_path / "l.csv")
    assert code == 1
    assert "a has no labels" in said


def test_a_command_that_needs_a_protocol_says_that_there_is_none(tmp_path: Path) -> None:
    lab_hdf5(tmp_path / "slide.h5")
    store = tmp_path / "store"
    outcome("import", tmp_path / "slide.h5", "--store", store, "--name", "a")
    code, _, said = outcome("review", store)
    assert code == 2
    expected = "CAMPAIGN = a: was imported without an adapter: it has neither labels nor a split"
    assert expected in " ".join(said.split())


def test_a_gap_of_years_is_said(tmp_path: Path) -> None:
    column = np.arange(200, dtype=np.uint16)
    times = np.concatenate([[0], 1_795_000_000_000_000 + np.arange(199)]).astype(np.int64)
    path = tmp_path / "a.aedat4"
    with Aedat4Writer(path, {0: Aedat4Stream("EVTS", "events", (346, 260), "DAVIS346")}) as file:
        file.events(0, EventChunk(column, column, column.astype(np.uint8) % 2, times))
    store = tmp_path / "store"
    code, reported, said = outcome("import", path, "--store", store, "--name", "a", "--json")
    assert code == 0
    assert len(reported["warnings"]) == 1
    assert "warning: a.aedat4: 498,611.1 hours without an event between 0 and" in " ".join(
        said.split()
    )
    code, *_ = outcome("verify", store)
    assert code == 0


def test_a_damaged_recording_is_exit_1_and_salvaged_when_asked(tmp_path: Path) -> None:
    path, store = tmp_path / "a.aedat4", tmp_path / "store"
    write_aedat4(path)
    path.write_bytes(path.read_bytes()[:-5000])
    command = ("import", path, "--store", store, "--name", "a", "--json")
    code, reported, said = outcome(*command)
    assert code == 1
    error = reported["error"]
    assert (error["file"], error["exit_code"]) == (str(path), 1)
    assert "is cut short" in error["message"]
    assert "--salvage imports 2,300 events up to 68" in error["message"]
    assert not list(store.glob("campaigns/*"))
    code, reported, said = outcome(*command, "--salvage")
    assert code == 0
    result = reported
    (lost,) = result["salvaged"]
    assert (result["events"], lost["trial"]) == (2300, "a")
    assert 0 < lost["unread_bytes"] < 2000
    assert lost["at_byte"] + lost["unread_bytes"] == path.stat().st_size
    assert "warning: a.aedat4: is not whole" in " ".join(said.split())
    code, reported, said = outcome("trials", store, "--output", tmp_path / "trials.csv")
    assert pd.read_csv(tmp_path / "trials.csv")["unread_bytes"].tolist() == [lost["unread_bytes"]]
    code, reported, said = outcome("verify", store, "--json")
    assert (code, reported["salvaged"]) == (0, ["a/a"])
    assert "a/a: was salvaged from a damaged file" in " ".join(said.split())


def test_a_file_damaged_before_its_first_packet_is_exit_1(tmp_path: Path) -> None:
    path = tmp_path / "a.aedat4"
    write_aedat4(path)
    whole = path.read_bytes()
    for length in (0, 5, 20, HEADERS["aedat4"] - 1, HEADERS["aedat4"] + 20):
        path.write_bytes(whole[:length])
        for options in ((), ("--salvage",)):
            code, *_ = outcome("import", path, "--store", tmp_path / "s", "--name", "a", *options)
            assert code == 1
    assert not list(tmp_path.glob("s/campaigns/*"))


def test_what_is_skipped_in_a_folder_is_listed(tmp_path: Path) -> None:
    folder = tmp_path / "theirs"
    folder.mkdir()
    write_aedat4(folder / "a.aedat4")
    lab_hdf5(folder / "b.h5")
    (folder / "notes.txt").write_text("a note")
    command = ("import", folder, "--store", tmp_path / "store", "--name", "a", "--json")
    code, reported, said = outcome(*command)
    result = reported
    assert (code, result["imported"]) == (0, ["a", "b"])
    assert [item["file"] for item in result["skipped"]] == ["notes.txt"]
    assert "skipped: notes.txt: is of no known format" in " ".join(said.split())


def _mutated(head: bytes, rng: random.Random) -> bytes:
    """A header with some bytes changed, taken out, put in, or digits made others."""
    made = bytearray(head)
    for _ in range(rng.choice((1, 1, 2, 8))):
        at = rng.randrange(len(made))
        what = rng.randrange(5)
        if what == 0:
            made[at] ^= 1 << rng.randrange(8)
        elif what == 1:
            made[at : at + rng.choice((1, 4, 8))] = rng.choice((b"", b"\xff" * 8, bytes(8)))
        elif what == 2:
            made[at:at] = rng.randbytes(rng.choice((1, 4, 30)))
        elif what == 3:
            del made[at : at + rng.randrange(1, 30)]
        else:
            digits = [n for n, value in enumerate(made) if 48 <= value < 58] or [at]
            made[rng.choice(digits)] = rng.choice(b"0123456789-.x")
        made = made or bytearray(b"\0")
    return bytes(made)


@pytest.mark.quick(4)
@pytest.mark.parametrize("count", [5, pytest.param(100, marks=pytest.mark.long)])
@pytest.mark.parametrize("name", FILES)
def test_mutated_headers_give_one_message_and_leave_nothing(
    tmp_path: Path, name: str, count: int
) -> None:
    file, write = FILES[name]
    path = tmp_path / file
    write(path)
    whole = path.read_bytes()
    rng = random.Random(f"{name} {count}")
    refused = 0
    for number in range(count):
        size = min(HEADERS[name], len(whole))
        path.write_bytes(_mutated(whole[:size], rng) + whole[size:])
        store = tmp_path / str(number)
        options = ("--salvage",) if rng.random() < 0.3 else ()
        code, _, said = outcome("import", path, "--store", store, "--name", "a", *options)
        assert code in {0, 1, 2}, said
        assert "Traceback" not in said
        if code:
            refused += 1
            assert "error: " in said
            assert file in said.replace("\n", "")
            assert not list(store.glob("campaigns/*"))
    assert refused


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("import", "none.aedat4", "--store", "s", "--name", "a"), "no such file"),
        (("import", "bad.aedat4", "--store", "s", "--name", "a"), "is not an AEDAT4 file"),
        (("import", "bad.h5", "--store", "s", "--name", "a"), "is not an HDF5 file"),
        (("import", "bad.aedat4", "--store", "s", "--name", "../a"), "--name"),
        (("import", "word", "bad.aedat4", "--store", "s", "--name", "a"), "must be one of"),
        (("import", ".", "--store", "s", "--name", "a"), "holds 2 files for the trial bad"),
        (("export", "ours", "nothing", "--output", "o"), "is no campaign"),
        (("export", "ours", "c", "--output", "o", "--as", "word"), "must be one of"),
        (("export", "ours", "c", "--as", "labels", "--output", "o.xls"), "must end in"),
    ],
)
def test_wrong_input_is_exit_2(
    arguments: tuple[str, ...],
    says: str,
    tmp_path: Path,
) -> None:
    for name in ("bad.aedat4", "bad.h5"):
        (tmp_path / name).write_text("hello")
    campaign(tmp_path / "ours")
    done = here(*arguments, cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert says in done.stderr
    assert not list(tmp_path.glob("s/campaigns/*"))


def test_an_imported_campaign_has_no_protocol(tmp_path: Path) -> None:
    lab_hdf5(tmp_path / "slide.h5")
    store = tmp_path / "store"
    assert outcome("import", tmp_path / "slide.h5", "--store", store, "--name", "tiny")[0] == 0
    with pytest.raises(StoreError, match="is an imported campaign"):
        make_request(write(tmp_path / "p.yaml", tiny()), ROOT / "rigs" / "rehearsal.yaml", store)
    with pytest.raises(StoreError, match="imported without an adapter"):
        collected(TrialStore.open(store))
    where = TrialStore.open(store).campaign("c")
    where.update({"name": "c", "simulated": True}, "protocol: 1\n", "rig: 1\n")
    commit(where, "t")
    assert [item.name for item in collected(TrialStore.open(store))] == ["c"]
    with pytest.raises(InputError, match="without an adapter"):
        collected(TrialStore.open(store), ["tiny"])


@pytest.mark.parametrize("place", ["campaigns", "campaigns/new", "campaigns/a/trials/slide/new"])
def test_no_store_is_made_among_the_campaigns_of_one(place: str, tmp_path: Path) -> None:
    lab_hdf5(tmp_path / "slide.h5")
    store, remote = tmp_path / "store", f"file://{tmp_path}/remote"
    asked = ("import", tmp_path / "slide.h5", "--name", "a", "--store")
    assert here(*asked, store).returncode == 0
    assert here("push", store, remote).returncode == 0
    before = sorted(tmp_path.rglob("*"))
    for words in ((*asked, store / place), ("pull", remote, store / place)):
        done = here(*words)
        assert done.returncode == 2
        told = " ".join(done.stderr.split())
        assert (
            "holds other files" in told or f"lies among the campaigns of the store {store}" in told
        )
    assert sorted(tmp_path.rglob("*")) == before


def test_exports_replace_no_original_and_nothing_of_a_store(tmp_path: Path) -> None:
    originals, store, out = tmp_path / "originals", tmp_path / "store", tmp_path / "out"
    originals.mkdir()
    lab_hdf5(originals / "slide.h5")
    assert outcome("import", originals, "--store", store, "--name", "a", "--json")[0] == 0
    trial = store / "campaigns/a/trials/slide"
    before = {path: path.read_bytes() for path in (originals / "slide.h5", trial / "data.h5")}
    asked = ("export", store, "a", "--as", "dsec", "--output")
    whole = ("export", store, "--as", "croissant", "--output")
    (store / "there").mkdir()
    belongs = f"belongs to the store {store}; give a path outside of it"
    for words, says in (
        ((*asked, originals), "slide.h5: is not in sliplab-export.json and is not replaced"),
        *(((*asked, place), belongs) for place in (trial, trial / "new", store, store / "there")),
        ((*whole, store / "campaigns/b"), belongs),
        (("push", store, f"file://{store}/campaigns/pp"), belongs),
        (("push", store, f"file://{store}/there"), belongs),
    ):
        done = here(*words)
        assert done.returncode == 2, words
        assert says in " ".join(done.stderr.split())
    assert before == {path: path.read_bytes() for path in before}
    assert {path.name for path in (store / "campaigns").iterdir()} == {"a"}
    for place in (out, store / "out"):  # its own files are replaced, also within the store
        assert [here(*asked, place).returncode for _ in range(2)] == [0, 0]
    (out / "sliplab-export.json").unlink()
    assert here(*asked, out).returncode == 2


@pytest.mark.parametrize("begun", [1, 2])
def test_an_export_that_was_killed_may_be_run_again(begun: int, tmp_path: Path) -> None:
    """It leaves files and no word of what it has written; a foreign file stays."""
    store, out = tmp_path / "store", tmp_path / "out"
    where = campaign(store)
    for trial in ("a", "b"):
        commit(where, trial)
    code = f"""
import os, sys
from dataclasses import replace
from sliplab.flows.__main__ import main
from sliplab.storage.formats import export_trials as ours
known, calls = ours.known_format("dsec"), []
def killed(*given):
    calls.append(given)
    if len(calls) == {begun}:
        given[1].write_bytes(b"half")
        os.kill(os.getpid(), 9)
    return known.export(*given)
ours.known_format = lambda kind: replace(known, export=killed)
main()
"""
    asked = ("export", str(store), "c", "--as", "dsec", "--output", str(out))
    done = subprocess.run([sys.executable, "-c", code, *asked], check=False)
    assert done.returncode == -9
    (out / "mine.h5").write_bytes(b"mine")
    assert [here(*asked).returncode for _ in range(2)] == [0, 0]
    names = {"a.h5", "b.h5", "mine.h5", "sliplab-export.json"}
    assert {path.name for path in out.iterdir()} == names
    assert (out / "mine.h5").read_bytes() == b"mine"
    assert "unfinished" not in read_json(out / "sliplab-export.json")


def test_an_export_that_was_stopped_may_be_run_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store, out = tmp_path / "store", tmp_path / "out"
    where = campaign(store)
    for trial in ("a", "b"):
        commit(where, trial)
    asked = ("export", store, "c", "--as", "dsec", "--output", out)
    with monkeypatch.context() as patch:
        export = _exports.known_format("dsec").export

        def full(recording: Recording, path: Path, stream: str) -> dict[str, int]:
            if recording.trial_id == "b":
                raise OSError(errno.ENOSPC, "No space left on device")
            return export(recording, path, stream)

        known = replace(_exports.known_format("dsec"), export=full)
        patch.setattr(_exports, "known_format", lambda kind: known)
        done = here(*asked)
    assert done.returncode == 1
    said = " ".join(done.stderr.split())
    assert f"{out}: its disk is full" in said
    assert "make room, then export again" in said
    assert "resume" not in said
    assert [here(*asked).returncode for _ in range(2)] == [0, 0]
    assert {path.name for path in out.glob("*.h5")} == {"a.h5", "b.h5"}
