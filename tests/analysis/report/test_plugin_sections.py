"""Sections of plug-ins: those of other packages are in the report, and cannot end it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from sliplab.analysis.report.page import Rendered
from sliplab.analysis.report.plugin_sections import (
    LostSections,
    ReportData,
    plugin_sections,
    sections_key,
)
from sliplab.storage.trials.store import TrialStore
from tests.protocols.test_plugin import installed

__all__ = ["installed"]  # a fixture

DECLARED = """
from dataclasses import dataclass
from pathlib import Path
from sliplab.analysis.report.page import Content, Figure
from sliplab.analysis.report.plugin_sections import ReportSection
from sliplab.protocols.plugin import Plugin

PLUGIN = Plugin(sections={"rubs": "NAME:SECTION"})

@dataclass(frozen=True)
class Rubs(Content):
    text: str = "7 rubs"
    figures: tuple = (Figure("<svg></svg>", "rubs-force", {"force (N)": [1, 2]}),)
    template = Path(__file__).with_suffix(".html")

def make(data):
    return Rubs()

SECTION = ReportSection(make)
"""
TEMPLATE = '{% set title = "Rubs" %}\n<p>{{ v.text }}{% if simulated %}, simulated{% endif %}</p>\n'


def install(installed: Any, folder: Path, name: str, *changes: tuple[str, str]) -> None:
    """Install a package with a section."""
    declared = DECLARED.replace("NAME", name)
    for before, after in changes:
        assert before in declared
        declared = declared.replace(before, after)
    installed(name, declared)
    (folder / f"{name}.html").write_text(TEMPLATE)


def test_a_section_of_another_package_is_shown(installed: Any, tmp_path: Path) -> None:
    install(installed, tmp_path, "lab_rubs")
    store = TrialStore.create(tmp_path / "store")
    (section,) = plugin_sections(ReportData(store, [], True))
    assert isinstance(section, Rendered)
    assert (section.title, [figure.name for figure in section.figures]) == ("Rubs", ["rubs-force"])
    assert "<p>7 rubs, simulated</p>" in section.html
    before = sections_key(store, [])
    assert sections_key(store, []) == before
    (tmp_path / "lab_rubs.html").write_text(TEMPLATE + "<p>more</p>")
    assert sections_key(store, []) != before  # the report is made again


def test_a_key_stands_for_the_section(installed: Any, tmp_path: Path) -> None:
    keyed = ("ReportSection(make)", "ReportSection(make, lambda store, campaigns: [1, 'a'])")
    install(installed, tmp_path, "lab_keyed", keyed)
    assert sections_key(TrialStore.create(tmp_path / "store"), []) == [1, "a"]


def test_nothing_is_shown_where_there_is_nothing(installed: Any, tmp_path: Path) -> None:
    install(installed, tmp_path, "lab_still", ("return Rubs()", "return None"))
    store = TrialStore.create(tmp_path / "store")
    assert list(plugin_sections(ReportData(store, [], False))) == []
    assert sections_key(store, []) == []


@pytest.mark.parametrize(
    ("before", "after", "reason"),
    [
        ("lab_broken:SECTION", "lab_broken:NONE", "has no attribute 'NONE'"),
        ("lab_broken:SECTION", "no_such_package:SECTION", "No module named 'no_such_package'"),
        ("lab_broken:SECTION", "lab_broken:make", "is a function, not a ReportSection"),
        ("return Rubs()", "raise OSError('no\\ncamera')", "OSError: no camera"),
        ("return Rubs()", "raise SystemExit(3)", "SystemExit: 3"),
        ("return Rubs()", "return 4", "AttributeError: 'int' object has no attribute"),
        ("text: str", "words: str", "has no attribute 'text'"),
        (".html", ".htm", "No such file or directory"),
        ("rubs-force", "confusion", "the name of the figure confusion must begin with rubs-"),
        ("rubs-force", "rubs-a/b", "cannot be the name"),
        ("[1, 2]", "1", "TypeError: "),
        ("}),)", "}),) * 2", "two figures have the name rubs-force"),
    ],
)
def test_one_that_fails_is_a_line(
    installed: Any, tmp_path: Path, before: str, after: str, reason: str
) -> None:
    install(installed, tmp_path, "lab_broken", (before, after))
    install(installed, tmp_path, "lab_other", ('"rubs"', '"more"'), ("rubs-", "more-"))
    store = TrialStore.create(tmp_path / "store")
    *shown, last = plugin_sections(ReportData(store, [], True))
    assert [section.title for section in shown if isinstance(section, Rendered)] == ["Rubs"]
    assert isinstance(last, LostSections)
    (line,) = last.faults
    assert line.startswith("rubs: ")
    assert reason in line
    assert "\n" not in line
    assert line in sections_key(store, [])


def test_a_key_that_fails_is_part_of_the_key(installed: Any, tmp_path: Path) -> None:
    for name, key in (("lab_raises", "1 / 0"), ("lab_object", "[object()]")):
        keyed = ("ReportSection(make)", f"ReportSection(make, lambda *_: {key})")
        install(installed, tmp_path, name, ('"rubs"', f'"{name}"'), keyed)
    first, second = sections_key(TrialStore.create(tmp_path / "store"), [])
    assert first.startswith("lab_object: TypeError: ")
    assert second == "lab_raises: ZeroDivisionError: division by zero"
