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
from sliplab.protocols.shown import plural
from sliplab.storage.files import safe_name
from sliplab.storage.schema.summary import OneCameraSummary, Summary
from sliplab.storage.trials.store import TrialStore


@dataclass(frozen=True)
class ReportData:
    """Data that a section is made of.

    Attributes:
        summary: the report's figures; None where only the key of a section is needed.
    """

    store: TrialStore
    campaigns: Sequence[Collected]
    simulated: bool
    summary: Summary | OneCameraSummary | None = None

    @property
    def collected_here(self) -> bool:
        """True if any of the campaigns was collected here rather than imported."""
        return any(item.recorded is None for item in self.campaigns)

    @property
    def collected(self) -> Summary | None:
        """The figures where campaigns were collected here, by both cameras; else None."""
        return self.summary if isinstance(self.summary, Summary) and self.collected_here else None


@dataclass(frozen=True)
class ReportSection:
    """A section of a plug-in, which `protocols.plugin.Plugin.sections` names.

    Attributes:
        make: returns what is shown; None where there is nothing to show. Names of its figures begin
            with the section's.
        key: returns what the section is made of, as plain data: the report is made again where it
            has changed. Left out: the section itself, made for every report.
        last: put it with the results of longer studies, not after the registrations.
    """

    make: Callable[[ReportData], Content | None]
    key: Callable[[TrialStore, Sequence[Collected]], Sequence[Any]] | None = None
    last: bool = False


@dataclass(frozen=True)
class LostSections(Content):
    """Sections that could not be made, one line each."""

    template: ClassVar[str] = "lost_sections.html"
    faults: Sequence[str]

    @property
    def notices(self) -> list[str]:
        """How many there are."""
        return [f"{plural(len(self.faults), 'section')} could not be made"]


def plugin_sections(data: ReportData, *, last: bool = False) -> Iterator[Content | Rendered]:
    """Make the sections of plug-ins, in the order of the plug-ins' names; then what is lost.

    Args:
        last: those that are among the results of longer studies.
    """
    faults = []
    for name, place in plugins().declared("sections").items():
        try:
            section = _section(place)
            made = _rendered(name, section, data) if section.last == last else None
        except (Exception, SystemExit) as error:  # another package's code: whatever it raises
            faults.append(_fault(name, error))
        else:
            if made is not None:
                yield made
    if faults:
        yield LostSections(faults)


def sections_key(store: TrialStore, campaigns: Sequence[Collected]) -> list[Any]:
    """Return what the sections of plug-ins depend on besides; empty where they show nothing."""
    found: list[Any] = []
    data = ReportData(store, campaigns, store.simulated)
    for name, place in plugins().declared("sections").items():
        try:
            section = _section(place)
            if section.key is not None:
                parts = list(section.key(store, campaigns))
                hash_data(parts)  # plain data
                found += parts
            elif made := _rendered(name, section, data):
                found.append([made.title, made.html])
        except (Exception, SystemExit) as error:  # as above
            found.append(_fault(name, error))
    return found


def _section(place: str) -> ReportSection:
    section = import_foreign(place)
    if not isinstance(section, ReportSection):
        raise PluginError(f"{place} is a {type(section).__name__}, not a ReportSection")
    return section


def _rendered(name: str, section: ReportSection, data: ReportData) -> Rendered | None:
    """Return a section as HTML; None where it shows nothing."""
    content = section.make(data)
    if content is None:
        return None
    made = render_section(content, simulated=data.simulated)
    _check([figure for figure in made.figures if figure.name], name, data.simulated)
    return made


def _check(figures: Sequence[Figure], section: str, simulated: bool) -> None:
    """Check that the names of figures do not clash with those of other sections."""
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
