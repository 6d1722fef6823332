"""The report's page as a whole, about slip with both cameras or one."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from sliplab.analysis.campaigns import Collected, missing_stream
from sliplab.analysis.report import one_camera, report
from sliplab.analysis.report.cover import Cover
from sliplab.analysis.report.page import Content, Figure, Rendered, render_page
from sliplab.analysis.report.sources import read_sources, report_key
from sliplab.analysis.report.summary import make_summary
from sliplab.storage.schema.summary import OneCameraSummary
from sliplab.storage.streams import Json
from sliplab.storage.trials.store import TrialStore


@dataclass(frozen=True)
class Page:
    """A page and its numbers.

    Attributes:
        numbers: of the summary.
        figures: those with a name are written as files, too.
    """

    numbers: Json
    figures: Sequence[Figure]
    html: str
    simulated: bool


def slip_report_key(store: TrialStore, campaigns: list[Collected]) -> str:
    """Return the key of all inputs of the page about slip.

    Raises:
        StoreError: there is no evaluation of this version, or a label is missing.
    """
    if missing_stream(campaigns) is None:
        return report_key(store, campaigns)
    evaluated = one_camera.is_evaluated(store, campaigns)
    shown = (report_key(store, campaigns),) if evaluated else ()
    return one_camera.one_camera_key(store, campaigns, shown)


def slip_page(
    store: TrialStore,
    campaigns: list[Collected],
    planned_bytes: Callable[[Collected], int],
    seconds: Mapping[str, float],
) -> Page:
    """Return the page about slip.

    Args:
        planned_bytes: returns those that a campaign's committed trials were expected to take.
        seconds: that steps took.
    """
    planned = {item.name: planned_bytes(item) for item in campaigns}
    if missing_stream(campaigns) is None:
        return _evaluated(store, campaigns, planned, seconds)
    evaluated = one_camera.is_evaluated(store, campaigns)
    shown = one_camera.one_camera_summary(store, campaigns, planned, evaluated=evaluated)
    if evaluated:
        return _evaluated(store, campaigns, planned, seconds, shown)
    sections = one_camera.one_camera_sections(store, campaigns, shown)
    return make_page(campaigns, shown.to_json(), one_camera.one_camera_cover(shown), sections)


def _evaluated(
    store: TrialStore,
    campaigns: list[Collected],
    planned: Mapping[str, int],
    seconds: Mapping[str, float],
    without_frames: OneCameraSummary | None = None,
) -> Page:
    """Return the page of campaigns with a spiking network.

    Args:
        without_frames: summary of a study without frames; adds its sections to the page.
    """
    sources = read_sources(store, campaigns, planned, seconds)
    summary = make_summary(sources)
    sections = report.make_sections(sources, summary)
    numbers = summary.to_json()
    if without_frames is not None:
        rates = one_camera.rate_section(campaigns, without_frames)
        sections = [one_camera.left_out_section(without_frames), *sections]
        sections += [] if rates is None else [rates]
        numbers = without_frames.to_json() | numbers
    return make_page(campaigns, numbers, report.report_cover(summary), sections)


def make_page(
    campaigns: Sequence[Collected],
    numbers: Json,
    cover: Cover,
    sections: Sequence[Content | Rendered],
) -> Page:
    """Render a page.

    Args:
        numbers: of the summary; `simulated` is one.
    """
    simulated = bool(numbers["simulated"])
    html = render_page(
        cover.template, sections, simulated=simulated, campaigns=campaigns, cover=cover
    )
    figures = [figure for section in sections for figure in section.all_figures()]
    figures += [] if cover.answer.figure is None else [cover.answer.figure]
    return Page(numbers, figures, html, simulated)
