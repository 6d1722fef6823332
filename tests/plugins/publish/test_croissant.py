"""A published store: read back by Croissant's and RO-Crate's own readers, and as a store."""

from __future__ import annotations

import hashlib
import json
import logging
import subprocess
from pathlib import Path
from typing import Any

import mlcroissant
import pytest
from rocrate.rocrate import ROCrate

from sliplab.plugins.publish.forms import publish
from sliplab.plugins.publish.publication import Publication, PublicationInfo
from sliplab.protocols.errors import InputError
from sliplab.storage.formats.export_trials import label_table
from sliplab.storage.formats.import_trials import import_trials
from sliplab.storage.formats.recognition import trials_in
from sliplab.storage.schema.trial import Provenance
from sliplab.storage.trials.catalogue import catalogue
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import TrialStore
from sliplab.storage.trials.verify import verify_trial
from tests.flows.older import older_store
from tests.storage.formats.recordings import write_aedat4
from tests.storage.trial_files import FRAME, campaign, commit, fill, record

# of mlcroissant's own calls of rdflib and pandas
pytestmark = [
    pytest.mark.filterwarnings("ignore:ConjunctiveGraph is deprecated"),
    pytest.mark.filterwarnings("ignore:The inplace keyword in DataFrame.reset_index"),
]
ABOUT = PublicationInfo("Four slides", ("A. Author", "B. Author"), "CC-BY-4.0", "2026-11-24")


def publication(store: TrialStore, **changes: Any) -> Publication:
    """All of a store, every trial in the training part."""
    found = tuple(store.campaigns())
    splits = {(item.name, trial): "train" for item in found for trial in item.committed()}
    return Publication(store, found, changes.pop("about", ABOUT), changes.pop("splits", splits))


@pytest.fixture(scope="module")
def labelled(tmp_path_factory: pytest.TempPathFactory) -> TrialStore:
    """Four labelled slides, with refitted clocks."""
    return TrialStore.open(older_store(tmp_path_factory.mktemp("older")))


@pytest.fixture(scope="module")
def published(labelled: TrialStore, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same, published."""
    output = tmp_path_factory.mktemp("out") / "published"
    result = publish(publication(labelled), output, "croissant")
    assert (result["trials"], result["labels"], result["simulated"]) == (4, 4, True)
    return output


def _plain(value: object) -> object:
    return value.decode() if isinstance(value, bytes) else value


def test_croissants_own_reader_finds_no_fault_and_loads_the_tables(
    labelled: TrialStore, published: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING):
        data = mlcroissant.Dataset(published / "croissant.json")  # raises where one is wrong
    assert caplog.text == ""
    assert (data.metadata.name, data.metadata.version) == ("Four slides", "1.0.0")
    assert data.metadata.license == ["https://spdx.org/licenses/CC-BY-4.0.html"]
    assert data.metadata.description.startswith("Simulated data.")
    trials = [{key: _plain(value) for key, value in one.items()} for one in data.records("trials")]
    expected = catalogue(labelled)
    assert len(trials) == len(expected) == 4
    for one, row in zip(trials, expected.to_dict("records"), strict=True):
        assert {key: one[f"trials/{key}"] for key in row} == row
        assert one["trials/split"] == "train"
        assert (published / str(one["trials/path"]) / "data.h5").is_file()
    where = labelled.campaigns()[0]
    labels = label_table(labelled, where.name, sorted(where.committed()))
    for found, row in zip(data.records("labels"), labels.to_dict("records"), strict=True):
        assert {key: _plain(found[f"labels/{key}"]) for key in row} == row
    assert [one["splits/name"] for one in data.records("splits")] == ["train", "validation", "test"]


def test_rocrates_own_reader_finds_every_file_with_its_checksum(published: Path) -> None:
    crate = ROCrate(published)
    assert crate.name == "Four slides"
    assert [person["name"] for person in crate.root_dataset["creator"]] == list(ABOUT.creators)
    assert crate.root_dataset["license"]["name"] == "CC-BY-4.0"
    files = {item.id: item for item in crate.root_dataset["hasPart"]}
    there = {
        path.relative_to(published).as_posix() for path in published.rglob("*") if path.is_file()
    }
    assert there == files.keys() | {"ro-crate-metadata.json", "checksums.sha256"}
    for name, item in files.items():
        data = (published / name).read_bytes()
        assert item["sha256"] == hashlib.sha256(data).hexdigest()
        assert item["contentSize"] == str(len(data))
    (made,) = crate.root_dataset["mentions"]
    assert made.type == "CreateAction"
    assert made["name"] == "collection of small (simulated)"
    assert [item["version"] for item in made["instrument"]] == ["0.1.0"]
    assert len(made["result"]) == 4


def test_files_are_those_of_the_store_and_the_folder_reads_as_one(
    labelled: TrialStore, published: Path
) -> None:
    done = subprocess.run(
        ["sha256sum", "--check", "--quiet", "checksums.sha256"],
        cwd=published,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert (done.returncode, done.stdout) == (0, "")
    theirs = TrialStore.open(published)
    assert catalogue(theirs).equals(catalogue(labelled))
    for where, again in zip(labelled.campaigns(), theirs.campaigns(), strict=True):
        assert again.info == where.info
        for one, other in zip(where.recordings(), again.recordings(), strict=True):
            assert verify_trial(other.folder) == []
            assert other.checksum == one.checksum  # files, record and refitted clocks
            assert other.clocks == one.clocks
            kept = Provenance.load(other.folder / "provenance.json")
            assert (kept.host, kept.operator) == (None, None)
            assert kept.versions == where.provenance(one).versions
        names = sorted(where.committed())
        table = label_table(labelled, where.name, names)
        assert label_table(theirs, again.name, names).equals(table)


def test_the_card_says_what_the_data_are(published: Path) -> None:
    card = (published / "README.md").read_text()
    assert card.splitlines()[0] == "Simulated data."
    info = TrialStore.open(published).campaigns()[0].info
    for text in (
        "CC-BY-4.0",
        "A. Author, B. Author (2026): Four slides (simulated data)",
        info["collection_hash"],
        info["rig_hash"],
        "sliplab 0.1.0",
        "| small | 4 | 0 | 0 |",
        "| small | events | trigger input (95 %) | 4 | 1.35 | 1.42 |",
        "mm in the arm's base frame",
        "level of the factor speed, mm/s",
        "first slip of any marker, ns on the trial's time line",
    ):
        assert text in card


def test_a_real_campaign_with_a_video_without_labels(tmp_path: Path) -> None:
    where = campaign(tmp_path / "store")
    where.update({"name": "c", "simulated": False}, "protocol: 1\n", "rig: 1\n")
    writer = where.begin("t", FRAME, 100)
    fill(writer)
    writer.commit(record("t", simulated=False), Provenance(host="test", operator="somebody"))
    about = PublicationInfo("One | trial", (), None, "2026-11-24")
    output = tmp_path / "deep" / "out"
    publish(
        publication(TrialStore.open(tmp_path / "store"), about=about, splits={}),
        output,
        "croissant",
    )
    data = mlcroissant.Dataset(output / "croissant.json")
    assert {item.uuid for item in data.metadata.record_sets} == {"splits", "trials"}
    assert {item.uuid for item in data.metadata.file_sets} == {"recordings", "records", "videos"}
    (one,) = data.records("trials")
    assert _plain(one["trials/split"]) == "none"
    assert "somebody" not in "".join(path.read_text() for path in output.rglob("*.json"))
    card = (output / "README.md").read_text()
    assert card.startswith("# One | trial\n")
    assert "imulated data" not in card
    assert "None was given" in card
    (other,) = TrialStore.open(output).campaigns()[0].recordings()
    for mine, theirs in zip(
        Recording(where.folder / "trials" / "t").frames(), other.frames(), strict=True
    ):
        assert (mine == theirs).all()
    commit(where, "simulated")
    mixed = publication(TrialStore.open(tmp_path / "store"))
    publish(mixed, tmp_path / "mixed", "croissant")
    card = (tmp_path / "mixed" / "README.md").read_text()
    assert card.splitlines()[0] == "Simulated data in part: 1 of 2 trials."


def test_nothing_is_left_of_an_interrupted_publication(
    labelled: TrialStore, tmp_path: Path
) -> None:
    seen = []

    def stop(name: str) -> None:
        seen.append(name)
        if len(seen) == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        publish(publication(labelled), tmp_path / "out", "croissant", stop)
    assert list(tmp_path.iterdir()) == []


def test_what_cannot_be_published_is_said_and_changes_nothing(tmp_path: Path) -> None:
    where = campaign(tmp_path / "store")
    store = TrialStore.open(tmp_path / "store")
    with pytest.raises(InputError, match=r"campaigns = c: must have a committed trial"):
        publication(store)
    folder = commit(where, "t")
    output = tmp_path / "out"
    output.mkdir()
    with pytest.raises(InputError, match=r"--output = .*out: exists; it is not overwritten"):
        publish(publication(store), output, "croissant")
    output.rmdir()
    data = (folder / "data.h5").read_bytes()
    (folder / "data.h5").write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    with pytest.raises(InputError, match=r"campaigns\.c\.trials\.t = .*checksum.*must be whole"):
        publish(publication(store), output, "croissant")
    (folder / "data.h5").write_bytes(data[:-1])
    with pytest.raises(InputError, match=r"campaigns\.c\.trials\.t = .* bytes.*must be whole"):
        publication(store)
    assert [path.name for path in tmp_path.iterdir()] == ["store"]


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"licence": "CC-BY-4"}, "--licence = CC-BY-4: must be one of CC0-1.0"),
        ({"title": " "}, "--title"),
        ({"title": "a\nb"}, "must be one line"),
        ({"creators": ("",)}, "--creator"),
    ],
)
def test_wrong_facts_are_refused(changes: dict[str, Any], says: str) -> None:
    with pytest.raises(InputError, match=says):
        PublicationInfo(**{**vars(ABOUT), **changes})


def test_a_licence_of_ones_own_has_a_name_and_no_address(tmp_path: Path) -> None:
    commit(campaign(tmp_path / "store"), "t")
    about = PublicationInfo("T", (), "LicenseRef-Lab", "2026-11-24")
    output = tmp_path / "out"
    publish(publication(TrialStore.open(tmp_path / "store"), about=about), output, "croissant")
    assert json.loads((output / "croissant.json").read_text())["license"] == "LicenseRef-Lab"
    assert ROCrate(output).root_dataset["license"].id == "#LicenseRef-Lab"


def test_a_published_store_says_which_trials_are_not_whole(tmp_path: Path) -> None:
    store = TrialStore.create(tmp_path / "store")
    for name in ("a", "b"):
        path = tmp_path / f"{name}.aedat4"
        write_aedat4(path)
        if name == "b":
            path.write_bytes(path.read_bytes()[:-5000])
    trials = trials_in(tmp_path, "aedat4", salvage=True)
    import_trials(store, "theirs", trials, tmp_path, "aedat4", salvage=True)
    publish(publication(store), tmp_path / "out", "croissant")
    card = (tmp_path / "out" / "README.md").read_text()
    assert "salvaged from damaged files and are not whole" in card
    assert "is missing: `theirs/b`." in card
    data = mlcroissant.Dataset(tmp_path / "out" / "croissant.json")
    unread = [one["trials/unread_bytes"] for one in data.records("trials")]
    assert len(unread) == 2
    assert unread[1] > 0
