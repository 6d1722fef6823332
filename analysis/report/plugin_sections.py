"""Sections of the report that plug-ins add; one that fails costs a line, not the report."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.report.page import Content, Figure, Rendered, csv_text, render_section
from sliplab.protocols.hashing import hash_data
from sliplab.protocols.plugin import plugins
from sliplab.protocols.plugins import PluginError, import_foreign
from sliplab.storage.files import safe_name
from sliplab.storage.trials.store import Store


@dataclass(frozen=True)
class ReportSection:
    """A section of a plug-in, which `protocols.plugin.Plugin.sections` names.

    Attributes:
        make: returns what is shown of a store's campaigns, given whether they are simulated; None
            where there is nothing to show. Names of its figures begin with the section's.
        key: returns what the section is made of, as plain data: the report is made again where it
            has changed. Left out: the section itself, made whenever a report is asked for.
    """

    make: Callable[[Store, Sequence[Collected], bool], Content | None]
    key: Callable[[Store, Sequence[Collected]], Sequence[Any]] | None = None


@dataclass(frozen=True)
class LostSections(Content):
    """Sections that could not be made, one line each."""

    template: ClassVar[str] = "lost_sections.html"
    faults: Sequence[str]


def plugin_sections(
    store: Store, campaigns: Sequence[Collected], *, simulated: bool
) -> Iterator[Content]:
    """Make the sections of plug-ins, in the order of the plug-ins' names; then what is lost."""
    faults = []
    for name, place in plugins().sections().items():
        try:
            made = _rendered(name, place, store, campaigns, simulated)
        except (Exception, SystemExit) as error:  # another package's code: whatever it raises
            faults.append(_fault(name, error))
        else:
            if made is not None:
                yield made
    if faults:
        yield LostSections(faults)


def sections_key(store: Store, campaigns: Sequence[Collected]) -> list[Any]:
    """Return what the sections of plug-ins depend on besides; empty where they show nothing."""
    found: list[Any] = []
    for name, place in plugins().sections().items():
        try:
            key = _section(place).key
            if key is not None:
                parts = list(key(store, campaigns))
                hash_data(parts)  # plain data
                found += parts
            elif made := _rendered(name, place, store, campaigns, store.simulated):
                found.append([made.title, made.html])
        except (Exception, SystemExit) as error:  # as above
            found.append(_fault(name, error))
    return found


def _section(place: str) -> ReportSection:
    section = import_foreign(place)
    if not isinstance(section, ReportSection):
        raise PluginError(f"{place} is a {type(section).__name__}, not a ReportSection")
    return section


def _rendered(
    name: str, place: str, store: Store, campaigns: Sequence[Collected], simulated: bool
) -> Rendered | None:
    """Return a section as HTML; None where it shows nothing."""
    content = _section(place).make(store, campaigns, simulated)
    if content is None:
        return None
    title, html = render_section(content, simulated=simulated)
    figures = [figure for figure in content.all_figures() if figure.name]
    _check(figures, name, simulated)
    return Rendered(str(title), html, figures)


def _check(figures: Sequence[Figure], section: str, simulated: bool) -> None:
    """Check that figures can be written beside those of other sections."""
    names = [safe_name(figure.name) for figure in figures]
    for name in names:
        if not f"{name}-".startswith(f"{section}-"):
            raise ValueError(f"the name of the figure {name} must begin with {section}-")
        if names.count(name) > 1:
            raise ValueError(f"two figures have the name {name}")
    for figure in figures:
        csv_text(figure.data, simulated=simulated)


def _fault(name: str, error: BaseException) -> str:
    """Return in one line why a section is lost."""
    kind = "" if isinstance(error, PluginError) else f"{type(error).__name__}: "
    return " ".join(f"{name}: {kind}{error}".split())
