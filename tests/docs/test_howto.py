"""The how-to guides work as they are printed, in a checkout of their own."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.conftest import ROOT
from tests.docs.blocks import blocks
from tests.docs.walk import walk

GUIDES = sorted((ROOT / "docs" / "howto").glob("[a-z]*-*.md"))


@pytest.mark.parametrize("guide", GUIDES, ids=lambda path: path.stem)
def test_the_guide_works_as_printed(guide: Path, checkout: Path) -> None:
    assert walk(guide, checkout) >= 1


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
    assert len(GUIDES) == 7
    assert all(f"({guide.name})" in listed for guide in GUIDES)
