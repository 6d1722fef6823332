"""HDF5 files that hold other things than a trial does: refused by name, never read blindly."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import h5py
import hdf5plugin
import numpy as np
import pytest

from sliplab.storage.errors import StoreError
from sliplab.storage.trials.hdf5_reader import RowFile, StreamReader
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.verify import verify_trial
from tests.conftest import ROOT
from tests.storage.trials.foreign_hdf5 import LOOKS, SHAPES, changed, committed, look

PACKED: list[dict[str, Any]] = [
    *({}, {"fletcher32": True}, {"shuffle": True}, {"scaleoffset": 0}),
    *({"compression": "gzip"}, {"compression": "lzf"}),
    {"compression": "gzip", "shuffle": True, "fletcher32": True},
    *map(dict, (hdf5plugin.Zstd(), hdf5plugin.LZ4(), hdf5plugin.Blosc(), hdf5plugin.Blosc2())),
    *(dict(hdf5plugin.BZip2()), dict(hdf5plugin.Bitshuffle())),
    *(dict(hdf5plugin.Bitshuffle(cname=name)) for name in ("zstd", "none")),
]
Found = dict[str, tuple[list[str], list[str]]]


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Found:
    """What reading every case gave, in another process: a fault of this kind may end it."""
    done = subprocess.run(
        [
            sys.executable,
            "-X",
            "faulthandler",
            "-m",
            "tests.storage.trials.foreign_hdf5",
            str(tmp_path_factory.mktemp("foreign")),
        ],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
        cwd=ROOT,
        stdin=subprocess.DEVNULL,
    )
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    assert done.returncode == 0, (lines[-1:], done.stderr)
    return {name: (looks, problems) for name, looks, problems in lines}


def test_trial_as_committed_is_read(tmp_path: Path) -> None:
    trial = committed(tmp_path / "store")
    assert look(trial) == ["clean"] * len(LOOKS)
    assert verify_trial(trial) == []


@pytest.mark.parametrize("name", SHAPES)
def test_trial_with_other_data_is_refused(name: str, found: Found) -> None:
    looks, problems = found[name]
    assert len(problems) >= 1
    assert all(text == "clean" or "data.h5" in text for text in looks)
    # an index only bounds the search for a window: nothing else may come of a wrong one
    assert any(text != "clean" for text in looks) or name in {
        "an index that ends beyond",
        "an index that runs backwards",
        "a negative index",
    }


def test_wrong_index_returns_no_other_events(tmp_path: Path) -> None:
    trial = committed(tmp_path / "store")
    with StreamReader(trial / "data.h5") as reader:
        whole = reader.events()
    changed(trial, SHAPES["an index that ends beyond"])
    with Recording(trial).open() as reader:
        some = reader.events(int(whole.t_us[10]), int(whole.t_us[20]))
    assert set(some.t_us.tolist()) <= set(whole.t_us[10:20].tolist())


def test_attribute_of_one_integer_is_read_in_any_type(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    for value in (np.int8(5), np.uint64(5), np.array([5]), np.array([[5]], ">i2")):
        with h5py.File(path, "w") as file:
            file.attrs["n"] = value
        rows = RowFile(path)
        assert (rows.attribute("n", 0), rows.attribute("m", 7)) == (5, 7)
        rows.close()


def test_attribute_of_many_integers_names_file_and_key(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.attrs["n"] = np.full(8000, 1 << 62)
    rows = RowFile(tmp_path / "a.h5")
    with pytest.raises(StoreError, match=r"a\.h5: .*'n'"):
        rows.attribute("n", 0)
    rows.close()


@pytest.mark.parametrize("filters", PACKED, ids=str)
def test_column_packed_in_any_way_is_read(filters: dict[str, Any], tmp_path: Path) -> None:
    values = np.arange(3000, dtype="u4").reshape(1000, 3)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("t", data=values, chunks=(300, 2), **filters)
    rows = RowFile(tmp_path / "a.h5")
    assert (rows.rows("t").read() == values).all()
    assert (rows.rows("t").read(599, 950) == values[599:950]).all()
    rows.close()
