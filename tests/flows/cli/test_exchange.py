"""`sliplab import` and `export` as a person meets them, and what follows for other commands."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from sliplab.analysis.campaigns import collected
from sliplab.flows.__main__ import _run
from sliplab.flows.planning.run_request import make_request
from sliplab.protocols import InputError
from sliplab.storage.formats.aedat4 import Aedat4Writer, Stream
from sliplab.storage.streams import EventChunk
from sliplab.storage.trials.store import Store, StoreError
from tests.conftest import ROOT
from tests.flows.conftest import tiny, write
from tests.storage.formats.files import lab_hdf5
from tests.storage.trial_files import campaign, commit


@pytest.fixture
def sliplab(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Any:
    """Run a command in this process: its exit code, what it printed, what it said."""

    def run(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["sliplab", *map(str, arguments)])
        code = _run()
        reported = capsys.readouterr()
        return code, reported.out, reported.err

    return run


def test_in_and_out(tmp_path: Path, sliplab: Any) -> None:
    lab_hdf5(tmp_path / "slide.h5")
    store, out = tmp_path / "store", tmp_path / "out"
    path = tmp_path / "slide.h5"
    code, reported, _ = sliplab("import", path, "--store", store, "--name", "a", "--json")
    assert code == 0
    assert json.loads(reported) == {
        "campaign": "a", "imported": ["slide"], "there": [], "events": 50, "frames": 0,
    }  # fmt: skip
    code, reported, said = sliplab("verify", store, "--json")
    assert (code, json.loads(reported)["whole"]) == (0, 1)
    code, reported, said = sliplab("trials", store, "--output", tmp_path / "t.parquet")
    assert code == 0
    assert "left out" not in said
    assert pd.read_parquet(tmp_path / "t.parquet")["trial"].tolist() == ["slide"]
    code, reported, _ = sliplab("export", store, "slide", "--output", out, "--json")
    assert (code, json.loads(reported)["events"]) == (0, 50)
    code, reported, _ = sliplab("import", "aedat4", out, "--store", store, "--name", "b", "--json")
    assert (code, json.loads(reported)["imported"]) == (0, ["slide"])
    assert not Store.open(store).simulated
    code, *_ = sliplab("export", store, "a", "--labels", "--output", tmp_path / "l.csv")
    assert code == 0


@pytest.mark.parametrize("command", ["view", "review"])
def test_a_command_that_needs_a_protocol_says_that_there_is_none(
    tmp_path: Path, sliplab: Any, command: str
) -> None:
    lab_hdf5(tmp_path / "slide.h5")
    store = tmp_path / "store"
    sliplab("import", tmp_path / "slide.h5", "--store", store, "--name", "a")
    options = ("slide", "--save", tmp_path / "t.rrd") if command == "view" else ()
    code, _, said = sliplab(command, store, *options)
    assert code == 2
    expected = "CAMPAIGN = a: was imported without an adapter: it has neither labels nor a split"
    assert expected in " ".join(said.split())


def test_a_gap_of_years_is_said(tmp_path: Path, sliplab: Any) -> None:
    column = np.arange(200, dtype=np.uint16)
    times = np.concatenate([[0], 1_795_000_000_000_000 + np.arange(199)]).astype(np.int64)
    path = tmp_path / "a.aedat4"
    with Aedat4Writer(path, {0: Stream("EVTS", "events", (346, 260), "DAVIS346")}) as file:
        file.events(0, EventChunk(column, column, column.astype(np.uint8) % 2, times))
    store = tmp_path / "store"
    code, reported, said = sliplab("import", path, "--store", store, "--name", "a", "--json")
    assert code == 0
    assert len(json.loads(reported)["warnings"]) == 1
    assert "warning: a.aedat4: 498,611.1 hours without an event between 0 and" in " ".join(
        said.split()
    )
    code, *_ = sliplab("verify", store)
    assert code == 0


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("import", "none.aedat4", "--store", "s", "--name", "a"), "no such file"),
        (("import", "bad.aedat4", "--store", "s", "--name", "a"), "is not an AEDAT4 file"),
        (("import", "bad.h5", "--store", "s", "--name", "a"), "is not an HDF5 file"),
        (("import", "bad.aedat4", "--store", "s", "--name", "../a"), "--name"),
        (("import", "word", "bad.aedat4", "--store", "s", "--name", "a"), "must be one of"),
        (("import", ".", "--store", "s", "--name", "a"), "is not an HDF5 file"),
        (("export", "ours", "nothing", "--output", "o"), "is no campaign"),
        (("export", "ours", "c", "--output", "o", "--format", "word"), "must be one of"),
        (("export", "ours", "c", "--labels", "--output", "o.xls"), "must end in"),
    ],
)
def test_wrong_input_is_exit_2(
    arguments: tuple[str, ...],
    says: str,
    tmp_path: Path,
    sliplab: Any,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("bad.aedat4", "bad.h5"):
        (tmp_path / name).write_text("hello")
    campaign(tmp_path / "ours")
    code, reported, said = sliplab(*arguments)
    assert (code, reported) == (2, "")
    assert says in said
    assert not list(tmp_path.glob("s/campaigns/*"))


def test_an_imported_campaign_has_no_protocol(tmp_path: Path, sliplab: Any) -> None:
    lab_hdf5(tmp_path / "slide.h5")
    store = tmp_path / "store"
    assert sliplab("import", tmp_path / "slide.h5", "--store", store, "--name", "tiny")[0] == 0
    with pytest.raises(StoreError, match="is an imported campaign"):
        make_request(write(tmp_path / "p.yaml", tiny()), ROOT / "rigs" / "rehearsal.yaml", store)
    with pytest.raises(StoreError, match="imported without an adapter"):
        collected(Store.open(store))
    where = Store.open(store).campaign("c")
    where.update({"name": "c", "simulated": True}, "protocol: 1\n", "rig: 1\n")
    commit(where, "t")
    assert [item.name for item in collected(Store.open(store))] == ["c"]
    with pytest.raises(InputError, match="without an adapter"):
        collected(Store.open(store), ["tiny"])
