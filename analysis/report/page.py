"""The report as one self-contained HTML page, put together from sections."""

from __future__ import annotations

import csv
import io
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

from jinja2 import Environment, FileSystemLoader, StrictUndefined, select_autoescape

_TEMPLATES = Path(__file__).parent / "templates"


@dataclass(frozen=True)
class Figure:
    """A picture (SVG text) and what to see in it.

    Attributes:
        name: of its files beside the page, without an ending; none are written without a name.
        data: what is drawn, columns by their headings, units in these; they may differ in length.
        paper: what the paper shows in its place, in words.
    """

    svg: str
    caption: str
    name: str = ""
    data: Mapping[str, Sequence[object]] = field(default_factory=dict)
    paper: str = ""


@dataclass(frozen=True)
class Table:
    """Rows of text; the first column names the row.

    Attributes:
        commands: which columns hold commands, to be copied.
    """

    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    caption: str = ""
    commands: Sequence[int] = ()
    long: ClassVar[int] = 40
    """A cell of more characters is broken into lines."""

    @property
    def texts(self) -> set[int]:
        """Columns of words, which read from the left; numbers stand below each other's ends."""
        columns = (
            [row[k] for row in self.rows if k < len(row) and row[k] not in ("", "–")]
            for k in range(len(self.columns))
        )
        return {
            k
            for k, cells in enumerate(columns)
            if any(len(c) > self.long for c in cells)
            or (cells and all(c[0].isalpha() for c in cells))
        }


@dataclass(frozen=True)
class Link:
    """A page beside this one: its file's name, and what it shows."""

    file: str
    text: str


@dataclass(frozen=True)
class Section:
    """One part of the report.

    Attributes:
        commands: to be copied, each with what it does.
    """

    title: str
    text: Sequence[str] = ()
    figures: Sequence[Figure] = ()
    tables: Sequence[Table] = field(default=())
    links: Sequence[Link] = ()
    commands: Sequence[tuple[str, str]] = ()


@dataclass(frozen=True)
class Number:
    """One headline number."""

    name: str
    value: str
    note: str = ""


def render(
    campaigns: Sequence[str],
    headline: Sequence[Number],
    sections: Sequence[Section],
    *,
    simulated: bool,
) -> str:
    """The page as text; everything in it is escaped but the figures' SVG."""
    return render_page(
        "report.html", sections, simulated=simulated, campaigns=campaigns, headline=headline
    )


def render_page(
    template: str, sections: Sequence[Section], *, simulated: bool, **values: object
) -> str:
    """A page of sections as text, under the top that `template` and its `values` give it.

    Everything in it is escaped but the figures' SVG.
    """
    environment = Environment(
        loader=FileSystemLoader(_TEMPLATES),
        autoescape=select_autoescape(),
        undefined=StrictUndefined,
        trim_blocks=True,
    )
    return environment.get_template(template).render(
        sections=sections, simulated=simulated, **values
    )


def csv_text(data: Mapping[str, Sequence[object]], *, simulated: bool) -> str:
    """A figure's data as CSV: headings first, then rows; what is missing is empty.

    A last column says of every row whether it is simulated, so that no table loses it.
    """
    buffer = io.StringIO()
    write = csv.writer(buffer, lineterminator="\n")
    write.writerow([*data, "simulated"])
    said = "yes" if simulated else "no"
    for row in itertools.zip_longest(*data.values()):
        write.writerow([*("" if cell is None else cell for cell in row), said])
    return buffer.getvalue()


def number(value: float | int | None, digits: int = 1, unit: str = "") -> str:
    """A number for people: fixed digits, a dash where there is none."""
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return "–"
    text = str(value) if isinstance(value, int) else f"{value:.{digits}f}"
    return f"{text} {unit}".rstrip()


def percent(value: float | None, digits: int = 1) -> str:
    """A share as a percentage."""
    return "–" if value is None else f"{100 * value:.{digits}f} %"
