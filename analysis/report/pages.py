"""The report's page as a whole: about slip, with both cameras or one, and about classes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from sliplab.analysis.campaigns import Collected, missing_stream
from sliplab.analysis.networks.models import ModelOnDisk
from sliplab.analysis.report import classes, one_camera, report
from sliplab.analysis.report.cover import Cover
from sliplab.analysis.report.marker_network import read_judged
from sliplab.analysis.report.page import Content, Figure, Rendered
from sliplab.analysis.report.sources import read_sources, report_key
from sliplab.analysis.report.summary import make_summary
from sliplab.storage.schema.summary import OneCameraSummary
from sliplab.storage.streams import Json
from sliplab.storage.trials.store import Store


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


def class_page(store: Store, campaigns: list[Collected], model: ModelOnDisk) -> Page:
    """Return the page about recordings of classes.

    Args:
        model: the evaluated network.

    Raises:
        StoreError: there is no evaluation of this version yet.
    """
    summary = classes.class_summary(store, campaigns)
    sections = classes.class_sections(store, campaigns, summary, model)
    return _page(campaigns, summary.to_json(), classes.class_cover(summary), sections)


def slip_report_key(store: Store, campaigns: list[Collected]) -> str:
    """Return the key of all inputs of the page about slip.

    Raises:
        StoreError: there is no evaluation of this version, or a label is missing.
    """
    if missing_stream(campaigns) is not None:
        return one_camera.one_camera_key(store, campaigns)
    return report_key(store, campaigns)


def slip_page(
    store: Store,
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
    missing = missing_stream(campaigns)
    if missing is None:
        return _evaluated(store, campaigns, planned, seconds)
    judged = read_judged(store, campaigns) if missing == "events" else None
    shown = one_camera.one_camera_summary(store, campaigns, planned, judged)
    if one_camera.is_evaluated(store, campaigns):
        return _evaluated(store, campaigns, planned, seconds, shown)
    sections = one_camera.one_camera_sections(store, campaigns, shown, judged)
    return _page(campaigns, shown.to_json(), one_camera.one_camera_cover(shown), sections)


def _evaluated(
    store: Store,
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
    sections = report.make_sections(sources, summary, report.read_shown(sources))
    numbers = summary.to_json()
    if without_frames is not None:
        rates = one_camera.rate_section(campaigns, without_frames)
        sections = [one_camera.left_out_section(without_frames), *sections]
        sections += [] if rates is None else [rates]
        numbers = without_frames.to_json() | numbers
    return _page(campaigns, numbers, report.report_cover(summary), sections)


def _page(
    campaigns: Sequence[Collected],
    numbers: Json,
    cover: Cover,
    sections: Sequence[Content | Rendered],
) -> Page:
    """Render the page."""
    simulated = bool(numbers["simulated"])
    html = cover.render(campaigns, sections, simulated=simulated)
    figures = [figure for section in sections for figure in section.all_figures()]
    figures += [] if cover.answer.figure is None else [cover.answer.figure]
    return Page(numbers, figures, html, simulated)
