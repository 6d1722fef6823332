"""Publications of the store's own files: back into a store to the bit, or not at all."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from sliplab.plugins.publish.forms import publish
from sliplab.protocols.errors import InputError
from sliplab.storage.errors import DamagedFile
from sliplab.storage.formats.import_trials import import_trials
from sliplab.storage.formats.recognition import kind_of, trials_in
from sliplab.storage.schema.label import LABELS
from sliplab.storage.streams import Json
from sliplab.storage.trials.checksums import PROVENANCE
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.store import TrialStore
from sliplab.storage.trials.verify import verify
from tests.flows.older import older_store
from tests.plugins.publish.test_croissant import publication
from tests.storage.trial_files import campaign, commit


@pytest.fixture(scope="module")
def labelled(tmp_path_factory: pytest.TempPathFactory) -> TrialStore:
    """Four labelled slides, with refitted clocks."""
    return TrialStore.open(older_store(tmp_path_factory.mktemp("older")))


def take(folder: Path, path: Path, name: str = "again") -> Json:
    kind = kind_of(path)
    assert kind == "croissant"
    return import_trials(TrialStore.create(folder), name, trials_in(path, kind), path, kind)


@pytest.mark.parametrize("form", ["croissant", pytest.param("lerobot", marks=pytest.mark.long)])
def test_every_file_comes_back_to_the_bit(form: str, labelled: TrialStore, tmp_path: Path) -> None:
    output = tmp_path / "out"
    publish(publication(labelled), output, form)
    (where,) = labelled.campaigns()
    taken = take(tmp_path / "store", output, where.name)
    theirs = TrialStore.open(tmp_path / "store")
    assert (len(taken["imported"]), verify(theirs)) == (4, [])
    again = theirs.campaign(where.name)
    for name in ("campaign.json", "protocol.yaml", "rig.yaml"):
        assert (again.folder / name).read_bytes() == (where.folder / name).read_bytes()
    for one in where.recordings():
        other = again.recording(one.folder.name)
        for file in one.folder.iterdir():
            same = other.folder / file.name
            if file.name == PROVENANCE:
                kept, had = json.loads(same.read_text()), json.loads(file.read_text())
                changed = {"imported", "from", "operator", "host"}
                assert {k: v for k, v in kept.items() if k not in changed} == {
                    k: v for k, v in had.items() if k not in changed
                }
                assert kept["from"] == f"campaigns/{where.name}/trials/{one.folder.name}"
            else:
                assert same.read_bytes() == file.read_bytes(), file.name
        assert (other.clocks, other.refitted) == (one.clocks, one.refitted)
        labels = [Derived.of(store, LABELS, where.name) for store in (labelled, theirs)]
        ours, found = (item.folder / f"{one.folder.name}.json" for item in labels)
        assert found.read_bytes() == ours.read_bytes()
        ours, found = (item.arrays_path(one.folder.name) for item in labels)
        assert found.read_bytes() == ours.read_bytes()
    once_more = take(tmp_path / "store", output / "campaigns" / where.name, where.name)
    assert (once_more["imported"], len(once_more["there"])) == ([], 4)


def _no_rig(out: Path) -> None:
    (out / "campaigns/c/rig.yaml").unlink()


def _damaged(out: Path) -> None:
    path = out / "campaigns/c/trials/a/data.h5"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


def _more(out: Path) -> None:
    (out / "campaigns/c/trials/a/run.sh").write_text("true")


def _link(out: Path) -> None:
    path = out / "campaigns/c/trials/a/data.h5"
    path.rename(out / "data.h5")
    path.symlink_to(out / "data.h5")


def _record(out: Path) -> None:
    (out / "campaigns/c/trials/a/record.json").write_text("{}")


def _label(out: Path) -> None:
    path = out / "derived/labels/c/a.json"
    path.parent.mkdir(parents=True)
    path.write_text('{"format": 99}')


def _empty(out: Path) -> None:
    shutil.rmtree(out / "campaigns/c/trials/a")
    (out / "campaigns/c/trials/a").mkdir()


FAULTS: dict[str, tuple[Callable[[Path], None], str]] = {
    "a rig file that is missing": (_no_rig, "rig.yaml: is missing or not a regular file"),
    "a bit that was turned": (_damaged, "data.h5: .*checksum"),
    "a file too much": (_more, "run.sh: does not belong here"),
    "a link": (_link, "data.h5: does not belong to a trial"),
    "a record of nothing": (_record, "record.json"),
    "a label of a newer version": (_label, "a.json: .*99"),
    "a folder without files": (_empty, "checksums.json"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_damaged_publication_leaves_nothing(fault: str, tmp_path: Path) -> None:
    where = campaign(tmp_path / "ours")
    commit(where, "a")
    publish(publication(TrialStore.open(tmp_path / "ours")), tmp_path / "out", "croissant")
    damage, text = FAULTS[fault]
    damage(tmp_path / "out")
    with pytest.raises(DamagedFile, match=text):
        take(tmp_path / "store", tmp_path / "out")
    assert verify(TrialStore.open(tmp_path / "store")) == []
    assert not list((tmp_path / "store").rglob("a*"))


def test_one_campaign_is_imported_at_a_time(tmp_path: Path) -> None:
    for name in ("c", "d"):
        commit(campaign(tmp_path / "ours", name), "a", campaign=name)
    ours = TrialStore.open(tmp_path / "ours")
    publish(publication(ours), tmp_path / "out", "croissant")
    with pytest.raises(InputError, match=r"must be of one campaign; .*campaigns/c, .*campaigns/d"):
        take(tmp_path / "store", tmp_path / "out")
    assert take(tmp_path / "store", tmp_path / "out/campaigns/d")["imported"] == ["a"]
    other = campaign(tmp_path / "other", "again")
    other.update({"name": "again", "simulated": True, "protocol": "p"}, "protocol: 2\n", "rig: 1\n")
    with pytest.raises(InputError, match="has another protocol or rig"):
        take(tmp_path / "other", tmp_path / "out/campaigns/d")
