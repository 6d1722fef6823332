"""A package with a format: its files are imported, salvaged and exported as those of the core."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from sliplab.protocols.errors import InputError
from sliplab.protocols.plugin import plugins
from sliplab.storage.formats.export_trials import export_trials
from sliplab.storage.formats.import_trials import import_trials
from sliplab.storage.formats.known import export_formats
from sliplab.storage.formats.recognition import MIXED, kind_of, skipped_in, trials_in
from sliplab.storage.trials.store import TrialStore
from sliplab.storage.trials.verify import verify
from tests.examples.conftest import EXAMPLES, install
from tests.plugins.adapters.adapter_streams import BASE
from tests.plugins.adapters.adapters import bring
from tests.storage.formats.recordings import COUNT, write_aedat4


@pytest.fixture(autouse=True)
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Install the package for one test."""
    install("lab-format", tmp_path / "site", monkeypatch)
    plugins.cache_clear()
    yield
    plugins.cache_clear()


def ticks(path: Path) -> None:
    """Write ten events, 100 us apart."""
    t_us = 1000 + 100 * np.arange(10)
    rows = np.stack([np.arange(10), np.arange(10), np.arange(10) % 2, t_us], axis=1)
    path.write_bytes(b"ticks\n" + rows.astype(np.int64).tobytes())


def test_example_is_short() -> None:
    text = (EXAMPLES / "lab-format" / "lab_ticks.py").read_text()
    assert len(text.splitlines()) < 80


def test_format_of_another_package_is_imported_and_exported(tmp_path: Path) -> None:
    assert "ticks" in export_formats()
    folder = tmp_path / "in"
    folder.mkdir()
    ticks(folder / "a.tick")
    ticks(folder / "b")  # known by its first bytes
    (folder / "c.tick").write_bytes(b"other")  # known by its ending
    assert kind_of(folder) == "ticks"
    write_aedat4(folder / "d.aedat4")
    assert kind_of(folder) == MIXED
    assert skipped_in(folder, "ticks")[0].file == "d.aedat4"
    store = TrialStore.create(tmp_path / "store")
    done = import_trials(store, "theirs", trials_in(folder, MIXED), folder, MIXED)
    assert done["imported"] == ["a", "b", "d"]
    assert done["events"] == 20 + COUNT
    (failed,) = done["failed"]
    assert "is no file of ticks" in failed["reason"]
    assert verify(store) == []
    recording = store.campaign("theirs").recording("a")
    assert recording.record.imported.format == "ticks"
    export_trials([recording], tmp_path / "out", "ticks", "theirs")
    assert (tmp_path / "out" / "a.tick").read_bytes() == (folder / "a.tick").read_bytes()
    (again,) = trials_in(tmp_path / "out", kind_of(tmp_path / "out"))
    assert sum(len(chunk) for chunk in again.events()) == 10


def test_cut_file_of_another_package_is_salvaged(tmp_path: Path) -> None:
    file = tmp_path / "a.tick"
    ticks(file)
    file.write_bytes(file.read_bytes()[:-5])
    store = TrialStore.create(tmp_path / "store")
    with pytest.raises(InputError, match="--salvage imports 9 events up to 1800 us"):
        import_trials(store, "theirs", trials_in(file, "ticks"), file, "ticks")
    found = trials_in(file, "ticks", salvage=True)
    done = import_trials(store, "theirs", found, file, "ticks", salvage=True)
    assert done["events"] == 9
    assert done["salvaged"][0]["unread_bytes"] == 27


def test_adapter_reads_a_format_of_another_package(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    ticks(tmp_path / "in" / "a.tick")
    made = {**BASE, "trials": {"files": "{who}.tick"}}
    made["streams"] = {"events": {"format": "ticks"}}
    campaign = bring(made, tmp_path / "in", tmp_path / "store")
    assert campaign.recording("a").events().t_us.tolist() == list(range(1000, 2000, 100))
    made["streams"] = {"events": {"format": "tick"}}
    with pytest.raises(InputError, match=r"events.format = tick: must be one of counts.* ticks"):
        bring(made, tmp_path / "in", tmp_path / "other")
