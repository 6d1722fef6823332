"""`sliplab export --as croissant` and others as a person meets them."""

from __future__ import annotations

import json
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from tests.command_line import answer, here
from tests.flows.older import older_store
from tests.storage.trial_files import campaign


def test_a_store_is_published_with_its_splits(tmp_path: Path) -> None:
    store, output = older_store(tmp_path / "store"), tmp_path / "out"
    options = ("--as", "croissant", "--output", output, "--title", "Four", "--creator", "A. Author")
    found = answer("export", store, *options, "--licence", "CC0-1.0")
    assert found["trials"] == found["labels"] == 4
    assert found["simulated"]
    about = json.loads((output / "croissant.json").read_text())
    assert (about["name"], about["creator"][0]["name"]) == ("Four", "A. Author")
    splits = pq.read_table(output / "trials.parquet")["split"].to_pylist()
    assert sorted(splits) == ["test", "train", "train", "validation"]
    done = here("export", store, *options)
    assert done.returncode == 2
    assert "exists; it is not overwritten" in " ".join(done.stderr.split())


def test_one_campaign_is_published_and_a_missing_licence_is_said(tmp_path: Path) -> None:
    store = older_store(tmp_path / "store")
    campaign(store, "empty")
    done = here(
        "export", store, "--as", "croissant", "--output", tmp_path / "out", "--campaign", "small"
    )
    assert done.returncode == 0
    assert "warning: no --licence" in done.stderr
    assert "(simulated" in done.stdout
    assert [path.name for path in (tmp_path / "out" / "campaigns").iterdir()] == ["small"]


@pytest.mark.long
def test_mcap_files_are_published_and_imported_again(tmp_path: Path) -> None:
    store, output = older_store(tmp_path / "store"), tmp_path / "out"
    found = answer("export", store, "--as", "mcap", "--output", output, "--licence", "CC0-1.0")
    assert (found["trials"], found["labels"]) == (4, 4)
    folder, again = output / "campaigns" / "small", tmp_path / "again"
    taken = answer("import", folder, "--store", again, "--name", "small")
    assert len(taken["imported"]) == 4
    assert answer("verify", again)["whole"] == 4
    mine, theirs = answer("trials", store)["trials"], answer("trials", again)["trials"]
    assert mine == theirs
    # a campaign as any other: steps run on it, with what they need of protocol and rig
    labelled = answer("label", again)
    assert labelled["done"] + labelled["fresh"] == 4


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (
            ("--as", "word"),
            "--as = word: must be one of aedat4, dsec, labels, samples, onnx, card, nir",
        ),
        (("--as", "croissant", "--campaign", "x"), "--campaign = x: must be a campaign of"),
        (("--as", "croissant", "--licence", "free"), "--licence = free: must be one of CC0-1.0"),
        (("--as", "croissant", "--creator", " "), "--creator"),
        (("--as", "croissant"), "campaigns = c: must have a committed trial"),
    ],
)
def test_wrong_input_is_exit_2(tmp_path: Path, options: tuple[str, ...], says: str) -> None:
    where = campaign(tmp_path / "store")
    where.update({"name": "c", "simulated": True, "imported": {}}, "# none\n", "# none\n")
    done = here("export", tmp_path / "store", "--output", tmp_path / "out", *options)
    assert (done.returncode, done.stdout) == (2, "")
    assert says in " ".join(done.stderr.split())
    assert [path.name for path in tmp_path.iterdir()] == ["store"]


def test_the_former_name_does_the_same_and_names_the_new_one(tmp_path: Path) -> None:
    store, output = older_store(tmp_path / "store"), tmp_path / "out"
    done = here("publish", store, "--as", "mcap", "--output", output, "--licence", "CC0-1.0")
    assert done.returncode == 0
    hint = f"write: sliplab export {store} --as mcap --output {output}"
    assert hint in " ".join(done.stderr.split())
    assert (output / "README.md").exists()
