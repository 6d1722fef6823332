"""The how-to guides work as they are printed, in a checkout of their own."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from sliplab.storage.schema.label import LABELS
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.store import TrialStore
from tests.conftest import ROOT
from tests.docs.blocks import blocks
from tests.docs.walk import walk
from tests.flows.older import older_store

NOTEBOOK = ROOT / "docs" / "howto" / "from-a-notebook.md"
READ_WITHOUT = ROOT / "docs" / "howto" / "read-without-sliplab.md"
INDEX = ROOT / "docs" / "howto" / "index.md"
GUIDES = sorted(set((ROOT / "docs" / "howto").glob("[a-z]*.md")) - {NOTEBOOK, INDEX})
MARKS = {
    # they install a package, or go through all steps
    "write-a-driver": [pytest.mark.programs],
    "add-an-analysis-step": [pytest.mark.programs, pytest.mark.long],
    "import-labelled-data": [pytest.mark.programs, pytest.mark.long],
    "import-old-data": [pytest.mark.long],
    "one-camera": [pytest.mark.long],
    "record": [pytest.mark.long],
}


@pytest.mark.parametrize(
    "guide",
    [pytest.param(g, marks=MARKS.get(g.stem, ())) for g in GUIDES],
    ids=lambda path: path.stem,
)
def test_the_guide_works_as_printed(guide: Path, checkout: Path) -> None:
    assert walk(guide, checkout) >= 1


@pytest.mark.long
@pytest.mark.parametrize(
    "guide", [g for g in GUIDES if any("long" in b.flags for b in blocks(g))], ids=lambda p: p.stem
)
def test_the_guide_s_long_commands_work_too(guide: Path, checkout: Path) -> None:
    assert walk(guide, checkout, long=True) > walk(guide, checkout)


def test_the_notebook_prints_what_it_shows(
    checkout: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(checkout)
    names: dict[str, object] = {}
    shown = 0
    for block in blocks(NOTEBOOK):
        if block.language == "python":
            exec(compile(block.text, f"{NOTEBOOK.name}:{block.line}", "exec"), names)
        else:
            assert capsys.readouterr().out == block.text
            shown += 1
    assert shown >= 5
    assert (checkout / "displacement.svg").stat().st_size > 1000


def test_a_trial_is_read_without_sliplab_as_with_it(tmp_path: Path) -> None:
    """The page's script, where nothing of SlipLab can be imported, against SlipLab itself."""
    (script,) = [block for block in blocks(READ_WITHOUT) if block.title == "read_trial.py"]
    assert len(script.text.splitlines()) <= 33
    alone = "import sys\nsys.modules['sliplab'] = None\n" + script.text
    (tmp_path / "alone.py").write_text(
        f"{alone}\nnp.savez(sys.argv[2], x=x, y=y, p=p, t=events_ns, poses=poses_ns, xyz=xyz_mm)\n"
    )
    store = TrialStore.open(older_store(tmp_path / "store"))
    (campaign,) = store.campaigns()
    for recording in campaign.recordings():
        done = subprocess.run(
            [sys.executable, tmp_path / "alone.py", recording.folder, tmp_path / "read.npz"],
            capture_output=True,
            text=True,
            timeout=60,
            check=True,
        )
        with np.load(tmp_path / "read.npz") as read, recording.open() as reader:
            events, poses = recording.events(), reader.poses()
            for name in "xyp":
                np.testing.assert_array_equal(read[name], getattr(events, name))
            line = recording.clock("events").to_reference(events.t_us * 1000)
            np.testing.assert_array_equal(read["t"], line)
            line = recording.clock("arm").to_reference(poses.t_ns)
            np.testing.assert_array_equal(read["poses"], line)
            np.testing.assert_array_equal(read["xyz"], poses.xyz_mm)
        label = Derived.of(store, LABELS, campaign.name).read(recording.folder.name)
        assert done.stdout.splitlines()[-1] == (
            f"slip begins at {label['incipient_ns']} ns, gross at {label['gross_ns']} ns"
        )
        assert str(recording.record.clocks.events.uncertainty_ns) in done.stdout


@pytest.mark.parametrize("page", ["protocols", "storage"])
def test_the_references_examples_run(
    page: str, checkout: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(checkout)
    examples = [
        block
        for block in blocks(ROOT / "docs" / "reference" / f"{page}.md")
        if block.language == "python"
    ]
    assert examples
    for example in examples:
        exec(compile(example.text, f"{page}.md", "exec"), {})


def test_there_is_a_guide_for_each_question() -> None:
    listed = (ROOT / "docs" / "howto" / "index.md").read_text()
    assert len(GUIDES) == 12
    assert all(f"({guide.name})" in listed for guide in [*GUIDES, NOTEBOOK])
