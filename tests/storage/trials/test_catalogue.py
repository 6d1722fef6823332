"""The catalogue's index: never another table than without it, and nothing read twice."""

from __future__ import annotations

import itertools
import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

from sliplab.protocols.errors import InputError
from sliplab.storage.files import make_folder, write_json, write_text
from sliplab.storage.trials import catalogue as module
from sliplab.storage.trials.catalogue import (
    _TYPES,
    _typed,
    catalogue,
    catalogue_so_far,
    check_table_path,
    query,
    write_table,
)
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import Campaign, TrialStore
from tests.command_line import here
from tests.storage.trial_files import IDENTITY, campaign, commit

INDEX = Path("derived/catalogue/index")


@pytest.fixture
def where(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Campaign:
    """A campaign of three trials; what changes counts as settled at once."""
    monkeypatch.setattr(module, "FRESH_NS", -(10**18))
    found = campaign(tmp_path / "s")
    commit(found, "a", condition={"depth": "2.4 mm", "side": "left"})
    commit(found, "b", condition={"depth": "3.4 mm", "speed": "1.6 mm/s"}, recorded_s=1 / 3)
    commit(found, "c", condition={"side": "right"})
    return found


@pytest.fixture
def read(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The trials that were read, in order."""
    names: list[str] = []
    row = module._row

    def reported(name: str, recording: Recording) -> dict[str, object]:
        names.append(recording.folder.name)
        return row(name, recording)

    monkeypatch.setattr(module, "_row", reported)
    return names


def _store(where: Campaign) -> TrialStore:
    return TrialStore.open(where.folder.parent.parent)


def _both(where: Campaign) -> tuple[pd.DataFrame, list[str]]:
    """The table with the index, held against the one without it."""
    lines: list[str] = []
    with_index = catalogue(_store(where), lines)
    index = _store(where).folder / INDEX
    kept = index.read_bytes() if index.exists() else None
    index.unlink(missing_ok=True)
    plain: list[str] = []
    without = catalogue(_store(where), plain)
    pd.testing.assert_frame_equal(with_index, without, check_exact=True)
    assert with_index.to_csv() == without.to_csv()
    assert with_index.to_json(orient="records") == without.to_json(orient="records")
    assert lines == plain
    if kept is not None:
        index.write_bytes(kept)
    return with_index, lines


def test_only_what_changed_is_read_again(where: Campaign, read: list[str]) -> None:
    first = catalogue(_store(where))
    assert read == ["a", "b", "c"]
    pd.testing.assert_frame_equal(catalogue(_store(where)), first, check_exact=True)
    assert read == ["a", "b", "c"]
    commit(where, "ab")
    assert list(catalogue(_store(where))["trial"]) == ["a", "ab", "b", "c"]
    assert read == ["a", "b", "c", "ab"]
    where.quarantine(where.folder / "trials" / "b", "again")
    assert list(_both(where)[0]["trial"]) == ["a", "ab", "c"]
    del read[:]
    commit(where, "b", attempt=1)
    assert list(catalogue(_store(where))["attempt"]) == [0, 0, 1, 0]
    assert read == ["b"]
    _both(where)


def test_reading_goes_on_where_its_time_ended(
    where: Campaign, read: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    store, clock = _store(where), itertools.count()
    monkeypatch.setattr(module.time, "monotonic", lambda: next(clock) ** 2)  # ever slower
    for names in ("a", "ab", "abc"):  # the first of each is read in any case
        table, left = catalogue_so_far(store, [], -1.0)
        assert (list(table["trial"]), left) == (list(names), 3 - len(names))
    assert read == ["a", "b", "c"]
    assert len(_both(where)[0]) == 3


def test_a_store_that_cannot_be_written_to_is_read_at_once(where: Any, monkeypatch: Any) -> None:
    def refuse(path: Path, data: bytes) -> None:
        raise PermissionError(path)

    monkeypatch.setattr(module, "write_bytes", refuse)
    table, left = catalogue_so_far(_store(where), [], -1.0)
    assert (list(table["trial"]), left) == (["a", "b", "c"], 0)
    assert not (_store(where).folder / INDEX).exists()


def test_a_campaign_more_or_less_is_seen(where: Campaign) -> None:
    store = _store(where)
    catalogue(store)
    commit(campaign(store.folder, "d"), "a")
    assert list(_both(where)[0]["campaign"]) == ["c", "c", "c", "d"]
    shutil.rmtree(store.folder / "campaigns" / "c")
    assert list(catalogue(store)["campaign"]) == ["d"]
    shutil.rmtree(store.folder / "campaigns" / "d")
    assert catalogue(store).empty


def test_damage_is_named_with_the_index_as_without(where: Campaign, read: list[str]) -> None:
    catalogue(_store(where))
    (where.folder / "trials" / "b" / "record.json").unlink()
    record = commit(where, "e") / "record.json"
    record.write_bytes(record.read_bytes().replace(b"kinematic", b"kinematix"))
    table, lines = _both(where)
    assert list(table["trial"]) == ["a", "c"]
    assert len(lines) == 2
    del read[:]
    catalogue(_store(where), [])
    assert read == ["e"]


def test_refitted_clocks_are_seen(where: Campaign, read: list[str]) -> None:
    assert list(catalogue(_store(where))["sync_uncertainty_us"]) == [1, 1, 1]
    folder = where.sync_folder
    for us in (2, 3):
        clock = {"map": IDENTITY, "uncertainty_ns": us * 1000.0}
        raw = where.recording("b").raw_checksum
        make_folder(folder)
        write_json(folder / "b.json", {"key": "k", "raw": raw, "clocks": {"events": clock}})
        assert list(_both(where)[0]["sync_uncertainty_us"]) == [1, us, 1]
    del read[:]
    catalogue(_store(where))
    assert read == []


@pytest.mark.parametrize("damage", ["gone", "empty", "short", "flipped", "older"])
def test_unusable_index_is_made_anew(where: Any, damage: str, read: Any, monkeypatch: Any) -> None:
    first = catalogue(_store(where))
    index = _store(where).folder / INDEX
    data = bytearray(index.read_bytes())
    if damage == "gone":
        shutil.rmtree(index.parent)
    elif damage == "older":
        monkeypatch.setattr(module, "VERSION", module.VERSION + 1)
    else:
        data[len(data) // 2] ^= 1
        index.write_bytes({"empty": b"", "short": data[:-1], "flipped": data}[damage])
    for _ in range(2):
        pd.testing.assert_frame_equal(catalogue(_store(where)), first, check_exact=True)
    assert read == ["a", "b", "c"] * 2


def test_what_changed_just_now_is_not_trusted(where: Campaign, read: Any, monkeypatch: Any) -> None:
    monkeypatch.setattr(module, "FRESH_NS", 3600 * 10**9)
    for _ in range(2):
        catalogue(_store(where))
    assert read == ["a", "b", "c"] * 2


def test_conditions_become_columns_with_units(tmp_path: Path) -> None:
    where = campaign(tmp_path / "s")
    commit(where, "a", condition={"depth": "2.4 mm", "speed": "0.6 mm/s", "side": "left"})
    commit(where, "b", condition={"depth": "3.4 mm", "speed": "1.6 mm/s", "side": "right"})
    table = catalogue(TrialStore.open(tmp_path / "s"))
    assert list(table["trial"]) == ["a", "b"]
    assert list(query(table, "depth_mm > 3 and side == 'right'")["speed_mm_per_s"]) == [1.6]
    assert list(query(table, "events == 1000")["trial"]) == ["a", "b"]


@pytest.mark.parametrize(
    "expression", ["@x", "trial.__class__", "nothing > 3", "import os", "depth_mm >"]
)
def test_expressions_that_are_no_query_are_refused(expression: str, tmp_path: Path) -> None:
    where = campaign(tmp_path / "s")
    commit(where, "a")
    with pytest.raises(ValueError, match=r"may contain only columns|cannot be read"):
        query(catalogue(TrialStore.open(tmp_path / "s")), expression)


def test_one_equals_sign_gets_a_hint() -> None:
    with pytest.raises(ValueError, match=r"cannot be read .*; == compares"):
        query(pd.DataFrame({"events": [1]}), "events = 3")


ENDLESS = f"""events == 9**9**9; events < 2 ** (2 ** 40); events == 1 << 10**12
trial == 'a' * 10**10; events in [1] * 10**9; events == (1, 2) * 10**9
events == {"1 + " * 1000}1; trial.str.contains('(a+)+$'); trial.str.repeat(10**9) == 'a'
(lambda: 1)() == events; [x for x in trial]; {"(" * 300}events{")" * 300}"""


@pytest.mark.parametrize("expression", re.split(r"; |\n", ENDLESS))
def test_expressions_without_bound_are_not_evaluated(expression: str, monkeypatch: Any) -> None:
    table = pd.DataFrame({"trial": ["a"], "events": [1]})
    monkeypatch.setattr(pd.DataFrame, "query", None)  # it is not asked
    with pytest.raises(ValueError, match=r"may contain only|at most 1000 characters|cannot be"):
        query(table, expression)


def test_expressions_of_columns_numbers_and_text_select_rows() -> None:
    columns = {"depth_mm": [2.4, 3.4], "side": ["left", "right"], "events": [4, 6]}
    table = pd.DataFrame({"trial": ["a", "b"], **columns})
    for expression, found in (
        ("depth_mm * 2 - 1 >= 4.8 and not side == 'left'", "b"),
        ("side in ['left', 'up'] or depth_mm > 9", "a"),
        ("(depth_mm / 2 > 1) & (events % 2 == 0) | (events // 3 == -1)", "ab"),
        ("trial.str.startswith('a')", "a"),
        ("side.str.contains('igh')", "b"),
        ("`depth_mm` == 3.4", "b"),
        ("side.isin(['left'])", "a"),
    ):
        assert list(query(table, expression)["trial"]) == list(found), expression


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".json"])
def test_table_is_written_into_a_folder_that_is_missing(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / "new" / "folder" / f"trials{suffix}"
    write_table(pd.DataFrame({"trial": ["a"]}), path)
    assert path.stat().st_size > 0


def test_an_empty_store_has_an_empty_catalogue(tmp_path: Path) -> None:
    campaign(tmp_path / "s")
    store = TrialStore.open(tmp_path / "s")
    assert len(catalogue(store)) == 0
    assert len(query(catalogue(store), "events > 0")) == 0


def test_columns_have_the_same_types_in_every_store(where: Any, tmp_path: Path) -> None:
    none, some = TrialStore.create(tmp_path / "none"), TrialStore.open(where.folder.parents[1])
    known, fields = catalogue(some), []
    rows = known.to_dict("records")
    without = _typed([{**row, "sync_uncertainty_us": None, "x": None} for row in rows])
    for number, table in enumerate((known, without, catalogue(none))):
        write_table(table, tmp_path / f"{number}.parquet")
        schema = pq.read_schema(tmp_path / f"{number}.parquet")
        fields.append({name: str(schema.field(name).type) for name in _TYPES})
        assert "null" not in map(str, schema.types)
    assert fields[0] == fields[1] == fields[2]


def test_no_table_replaces_a_file_of_a_store(tmp_path: Path) -> None:
    folder = TrialStore.create(tmp_path / "s").folder
    for name in ("store.json", "campaigns/new.csv", "campaigns/c/trials/a/trial.json"):
        with pytest.raises(InputError, match="belongs to the store"):
            check_table_path(folder / name)
    check_table_path(folder / "mine.csv")
    check_table_path(tmp_path / "mine.csv")
    assert here("schema", "trial", "--out", folder / "store.json").returncode == 2
    assert here("trials", folder, "--output", folder / "store.json").returncode == 2
    inside, csv = folder / "campaigns", tmp_path / "a.csv"
    inside.mkdir(exist_ok=True)
    write_text(csv, "t\n1\n2\n3\n")
    for words in (
        ("calibrate", "board", "--out", inside / "board.pdf"),
        ("align", csv, csv, "--out", inside / "t.csv"),
        ("reflex", folder, "--out", inside / "page"),
    ):
        done = here(*words)
        assert done.returncode == 2
        assert "belongs to the store" in done.stderr
    TrialStore.open(folder)


def test_json_keeps_every_digit_and_type(tmp_path: Path) -> None:
    columns = {
        "small": np.array([3.2e-12, 1 / 3]),
        "single": np.array([0.1, 2], np.float32),
        "missing": [np.nan, np.inf],
        "late": np.array([2**60 + 1, -5]),
        "nullable": pd.array([None, 2**60 + 1], "Int64"),
        "flag": [True, False],
        "text": ["a/b", None],
    }
    write_table(pd.DataFrame(columns), tmp_path / "t.json")
    rows = json.loads((tmp_path / "t.json").read_text())
    assert [list(row.values()) for row in rows] == [
        [3.2e-12, float(np.float32(0.1)), None, 2**60 + 1, None, True, "a/b"],
        [1 / 3, 2.0, None, -5, 2**60 + 1, False, None],
    ]
    assert [type(value) for value in rows[1].values()][-4:] == [int, int, bool, type(None)]
