"""`sliplab export WHAT --as FORM`: one command for trials, stores and networks."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from sliplab.flows.exports import export_names, known_export
from tests.command_line import answer, here
from tests.flows.older import older_store


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return older_store(tmp_path_factory.mktemp("export") / "store")


def test_every_form_is_known() -> None:
    assert set(export_names()) == {
        "aedat4",
        "dsec",
        "labels",
        "samples",
        "croissant",
        "archive",
        "mcap",
        "lerobot",
        "onnx",
        "nir",
        "card",
    }
    assert {known_export(name).of for name in export_names()} == {"trials", "store", "model"}


def test_former_options_give_the_same_files_and_name_the_new_ones(
    store: Path, tmp_path: Path
) -> None:
    asked = ("export", store, "small", "--output")
    new, old = tmp_path / "new", tmp_path / "old"
    found = answer(*asked, new, "--as", "dsec")
    done = here(*asked, old, "--format", "dsec")
    assert done.returncode == 0
    assert f"write: sliplab export {store} small --as dsec" in " ".join(done.stderr.split())
    assert answer(*asked, new, "--as", "dsec") == found  # files of the same names are replaced
    assert found["trials"] == len(list(new.glob("*.h5"))) == len(list(old.glob("*.h5")))
    for path in new.glob("*.csv"):
        assert path.read_bytes() == (old / path.name).read_bytes()


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (
            (),
            "--as: is needed: a store has the forms croissant, archive, mcap, lerobot; a campaign "
            "or a trial of it, as PART, aedat4, dsec, labels",
        ),
        (("--as", "dsek"), "--as = dsek: must be one of"),
        (("--as", "dsec"), "PART: is needed: --as dsec is of a campaign or a trial"),
        (("small", "--as", "mcap"), "PART = small: is too much: --as mcap is of a store"),
        (("small", "--as", "dsec", "--licence", "MIT"), "--licence: does not belong to --as"),
        (("--as", "mcap", "--windows", "3"), "to --as mcap; it is of onnx"),
        (("--as", "onnx"), "is a folder, and --as onnx is of a trained network"),
        (("nothing", "--as", "dsec"), "is no campaign or committed trial"),
    ],
)
def test_what_is_wrong_is_named(
    store: Path, tmp_path: Path, words: tuple[str, ...], says: str
) -> None:
    done = here("export", store, *words, "--output", tmp_path / "out.csv")
    assert done.returncode == 2, done.stderr
    assert says in " ".join(done.stderr.split())
    assert list(tmp_path.iterdir()) == []


def test_export_of_a_model_without_form_names_the_forms_of_models(tmp_path: Path) -> None:
    model = tmp_path / "seed0.pt"
    model.write_bytes(b"")
    done = here("export", model, "--output", tmp_path / "out")
    assert done.returncode == 2, done.stderr
    forms = " ".join(done.stderr.split()).partition("--as: is needed: ")[2]
    assert forms.startswith("a trained network has the forms ")
    assert set(forms.rpartition(" forms ")[2].split(", ")) == {"card", "onnx"}


def test_a_trial_of_several_campaigns_is_chosen_by_its_campaign(tmp_path: Path) -> None:
    store = older_store(tmp_path / "store")
    campaign = store / "campaigns" / "small"
    trial = min(path.name for path in (campaign / "trials").iterdir())
    shutil.copytree(campaign, campaign.with_name("copy"))
    info = campaign.with_name("copy") / "campaign.json"
    info.chmod(0o644)
    info.write_text(info.read_text().replace('"small"', '"copy"', 1))
    asked = ("export", store, trial, "--as", "dsec", "--output", tmp_path / "out")
    done = here(*asked)
    assert done.returncode == 2
    said = " ".join(done.stderr.split())
    assert f"{trial}: is in the campaigns copy, small of {store}; choose one by --campaign" in said
    done = here(*asked, "--campaign", "other")
    assert "--campaign = other: is no campaign of" in " ".join(done.stderr.split())
    done = here("export", store, "small", *asked[3:], "--campaign", "other")
    assert "--campaign = other: is no campaign of" in " ".join(done.stderr.split())
    assert answer(*asked, "--campaign", "copy")["trials"] == 1
