"""The how-to guides work as they are printed, in a checkout of their own."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.conftest import ROOT
from tests.docs.blocks import blocks
from tests.docs.walk import walk

NOTEBOOK = ROOT / "docs" / "howto" / "from-a-notebook.md"
GUIDES = sorted(set((ROOT / "docs" / "howto").glob("[a-z]*-*.md")) - {NOTEBOOK})


@pytest.mark.parametrize("guide", GUIDES, ids=lambda path: path.stem)
def test_the_guide_works_as_printed(guide: Path, checkout: Path) -> None:
    assert walk(guide, checkout) >= 1


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
    assert len(GUIDES) == 8
    assert all(f"({guide.name})" in listed for guide in [*GUIDES, NOTEBOOK])
