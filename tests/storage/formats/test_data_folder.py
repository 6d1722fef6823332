"""Data sets in a zip: as in their folder, or refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sliplab.protocols.errors import InputError
from sliplab.storage.formats import data_folder, tables
from tests.plugins.adapters.adapter_streams import (
    BASE,
    EVENTS,
    adapter,
    folder_of,
    imported,
    marked,
    refused,
    some_frames,
    write_frames,
    zipped,
)
from tests.plugins.adapters.adapters import SLIDES, bring, slides


def test_a_zip_gives_what_its_folder_gives(tmp_path: Path) -> None:
    names = slides(tmp_path / "set")
    for name in names:
        write_frames(tmp_path / "set" / "rec" / name, "video", some_frames(4))
    frames = {**SLIDES["streams"]["frames"], "files": "rec/{folder}/film.mkv", "format": "video"}
    made = {**SLIDES, "streams": {**SLIDES["streams"], "frames": frames}}
    one = bring(made, tmp_path / "set", tmp_path / "store")
    two = bring(made, zipped(tmp_path / "set"), tmp_path / "again")
    for name in names:
        a, b = one.recording(name), two.recording(name)
        assert a.record == b.record
        np.testing.assert_array_equal(list(a.frames()), some_frames(4))
        np.testing.assert_array_equal(list(b.frames()), list(a.frames()))
        with a.open() as first, b.open() as second:
            for column in ("events/t", "events/x", "poses/xyz", "frames/t"):
                np.testing.assert_array_equal(first.column(column), second.column(column))
            forces = [reader.wrenches("force").force_n for reader in (first, second)]
            np.testing.assert_array_equal(*forces)


def _zip_of_one(tmp_path: Path) -> Path:
    folder = folder_of(tmp_path)
    rows = "".join(f"{t},{t % 8},{t % 6},1\n" for t in range(5000))
    (folder / "events.csv").write_text(rows)
    return zipped(tmp_path / "set")


def test_an_encrypted_zip_is_refused(tmp_path: Path) -> None:
    path = _zip_of_one(tmp_path)
    path.write_bytes(marked(path.read_bytes(), flag=1))
    with pytest.raises(InputError, match=r"set.zip/ann/events.csv: cannot be .*encrypted"):
        bring(BASE, path, tmp_path / "store")
    assert not list((tmp_path / "store").glob("campaigns/*"))


def test_a_damaged_zip_is_refused(tmp_path: Path) -> None:
    path = _zip_of_one(tmp_path)
    whole = path.read_bytes()
    for length in (0, 1, 100, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:length])
        with pytest.raises(InputError, match=r"set\.zip: is no zip"):
            bring(BASE, path, tmp_path / "store")
    for at in range(80, len(whole) - 200, 997):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 0xFF]) + whole[at + 1 :])
        with pytest.raises(InputError, match=r"set.zip/ann/events.csv: cannot be unpacked"):
            bring(BASE, path, tmp_path / "store")
    assert not list((tmp_path / "store").glob("campaigns/*"))


def test_a_zip_that_unpacks_to_more_than_the_limit_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = _zip_of_one(tmp_path)
    whole = path.read_bytes()
    size = (tmp_path / "set" / "ann" / "events.csv").stat().st_size
    monkeypatch.setattr(data_folder, "MOST_BYTES", size - 1)
    with pytest.raises(InputError, match=r"events\.csv: holds more than .* MiB; unpack the zip"):
        bring(BASE, path, tmp_path / "store")
    # a zip that states a smaller size than it unpacks to
    assert whole.count(size.to_bytes(4, "little")) == 2
    path.write_bytes(whole.replace(size.to_bytes(4, "little"), (1000).to_bytes(4, "little")))
    with pytest.raises(InputError, match=r"events\.csv: cannot be unpacked"):
        bring(BASE, path, tmp_path / "store")
    assert not list((tmp_path / "store").glob("campaigns/*"))
    monkeypatch.setattr(data_folder, "MOST_BYTES", size)
    path.write_bytes(whole)
    assert len(bring(BASE, path, tmp_path / "store").recording("ann").events()) == 5000


def test_an_archive_of_arrays_beyond_the_limit_is_refused(tmp_path: Path, monkeypatch: Any) -> None:
    folder = folder_of(tmp_path)
    np.savez_compressed(folder / "events.npz", t=np.zeros(200_000), x=np.zeros(200_000))
    monkeypatch.setattr(tables, "MOST_BYTES", 3 << 20)
    made = adapter(trials={"files": "{who}/events.npz", "id": "{who}"})
    table = {"format": "numpy", "columns": {"t": "t", "x": "x"}, "size_px": [8, 1]}
    made["streams"] = {"events": {**EVENTS, **table}}
    refused(made, tmp_path, "events.npz: streams.events: holds more than 3 MiB")
    monkeypatch.setattr(tables, "MOST_BYTES", 4 << 20)
    assert len(imported(made, tmp_path).events()) == 200_000
