"""Stores of older and of newer versions."""

from pathlib import Path
from typing import Any

import h5py
import pytest

from sliplab.storage.files import read_json, write_json
from sliplab.storage.trials import migrate as module
from sliplab.storage.trials.checksums import write_sums
from sliplab.storage.trials.migrate import STEPS, migrate, retained
from sliplab.storage.trials.store import FORMAT, StoreError, TrialStore
from sliplab.storage.trials.verify import verify
from tests.storage.trial_files import campaign, commit


def old(folder: Path) -> TrialStore:
    """A store as version 1 left it."""
    where = campaign(folder)
    commit(where, "t")
    (where.folder / "checksums.json").unlink()
    write_json(folder / "store.json", {"format": 1})
    return TrialStore.open(folder)


@pytest.fixture
def store(tmp_path: Path) -> TrialStore:
    """A store as version 1 left it."""
    return old(tmp_path / "s")


def files(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_an_older_store_is_read_as_it_is(store: TrialStore, tmp_path: Path) -> None:
    before = files(tmp_path)
    assert verify(store) == []
    assert len(store.campaign("c").recording("t").events()) == 1000
    assert files(tmp_path) == before


def test_it_migrates_forward_with_a_copy_kept(store: TrialStore) -> None:
    before = files(store.folder)
    assert migrate(store) == list(range(1, FORMAT))
    assert store.format == FORMAT
    assert verify(store) == []
    copies = files(retained(store, 1))
    assert copies == {name: before[name] for name in copies}
    names = ("campaign.json", "protocol.yaml", "rig.yaml")
    assert copies.keys() == {"store.json", *(f"campaigns/c/{name}" for name in names)}
    after = files(store.folder)
    assert all(after[name] == before[name] for name in before if "/trials/" in name)
    assert migrate(store) == []


@pytest.mark.parametrize("last", range(6))
def test_an_interrupted_migration_is_begun_again(
    last: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = old(tmp_path / "s")
    before = files(store.folder)
    left = [last]

    def dies(write: Any) -> Any:
        def step(*arguments: Any) -> None:
            left[0] -= 1
            if left[0] < 0:
                raise KeyboardInterrupt
            write(*arguments)

        return step

    for name in ("write_bytes", "write_json", "write_sums"):
        monkeypatch.setattr(module, name, dies(getattr(module, name)))
    with pytest.raises(KeyboardInterrupt):
        migrate(store)
    monkeypatch.undo()
    assert verify(store) == []
    assert migrate(store) == [1]
    assert verify(store) == []
    assert all(data == before[name] for name, data in files(retained(store, 1)).items())


def test_formats_follow_each_other(store: TrialStore) -> None:
    seen: list[int] = []
    steps = {n: lambda _, n=n: seen.append(n) for n in (1, 2, 3)}
    assert migrate(store, steps) == [1, 2, 3]
    assert seen == [1, 2, 3]
    assert read_json(store.folder / "store.json") == {"format": 4}
    assert set(STEPS) == set(range(1, FORMAT))


def test_a_newer_store_is_refused_by_name(store: TrialStore) -> None:
    write_json(store.folder / "store.json", {"format": FORMAT + 1})
    with pytest.raises(StoreError, match=r"written by a newer version .* update it"):
        TrialStore.open(store.folder)
    for wrong in (0, "2", None, True, 1.5):
        write_json(store.folder / "store.json", {"format": wrong})
        with pytest.raises(StoreError, match="must be a number"):
            TrialStore.open(store.folder)
    (store.folder / "store.json").write_text("{")
    with pytest.raises(StoreError, match="restore it from a copy"):
        TrialStore.open(store.folder)


def test_a_newer_trial_is_refused_by_name(store: TrialStore) -> None:
    campaign_ = store.campaign("c")
    commit(campaign_, "n", format=99)
    with pytest.raises(StoreError, match=r"record.json: format = 99: was written by a newer"):
        _ = campaign_.recording("n").record
    found = [p.what for p in verify(store) if p.trial == "n"]
    assert found == ["was written by a newer version (format 99)"]
    folder = commit(campaign_, "m")
    (folder / "data.h5").chmod(0o644)
    with h5py.File(folder / "data.h5", "r+") as file:
        file.attrs["format"] = 99
    write_sums(folder, ("data.h5", "record.json", "frames.mkv"))
    with pytest.raises(StoreError, match=r"data.h5: format = 99: was written by a newer"):
        campaign_.recording("m").open()


def test_a_migration_names_what_it_cannot_bring_forward(store: TrialStore) -> None:
    (store.campaign("c").folder / "rig.yaml").unlink()
    with pytest.raises(StoreError, match=r"rig.yaml: is missing: restore it .* nothing was"):
        migrate(store)
    assert store.format == 1
