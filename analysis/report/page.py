"""Pages: their sections, rendered to one self-contained HTML file.

The text of each section is a template in `templates/sections`. Its values come from a
dataclass that names the template; its figures are also written to the page's folder.
"""

from __future__ import annotations

import csv
import io
import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cache
from pathlib import Path
from typing import Any, ClassVar

from jinja2 import (
    ChoiceLoader,
    Environment,
    FileSystemLoader,
    PrefixLoader,
    StrictUndefined,
    Template,
    select_autoescape,
)
from markupsafe import Markup

from sliplab.storage.files import make_folder, safe_name, write_text


@dataclass(frozen=True)
class Figure:
    """A picture (SVG text) and its data; a template has its caption.

    Attributes:
        name: of its files in the page's folder, without an ending; none are written without a name.
        data: what is drawn, columns by their headings, units in these; they may differ in length.
    """

    svg: str
    name: str = ""
    data: Mapping[str, Sequence[object]] = field(default_factory=dict)

    def _repr_svg_(self) -> str:
        """Return the picture, for a notebook."""
        return self.svg


@dataclass(frozen=True)
class Table:
    """Rows of text; the first column names the row.

    Attributes:
        commands: which columns hold commands, to be copied.
        spare: how many of the last columns a narrow terminal may leave out.
    """

    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    caption: str = ""
    commands: Sequence[int] = ()
    spare: int = 0
    long: ClassVar[int] = 40
    """A cell of more characters is broken into lines."""

    @property
    def texts(self) -> set[int]:
        """Columns of words, aligned left; numbers are aligned right."""
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
class Number:
    """One headline number."""

    name: str
    value: str
    note: str = ""


@dataclass(frozen=True)
class Content:
    """Base of the values that a section shows."""

    template: ClassVar[str | Path]
    """The section's file in `templates/sections` by name, or a plug-in's file."""
    folded: ClassVar[bool] = False
    """It stands closed, for those who look for it."""

    @property
    def unmeasured(self) -> bool:
        """True if nothing was measured: only the command that would do it is shown, folded."""
        return False

    @property
    def notices(self) -> Sequence[str]:
        """What failed or is missing, for the first screen."""
        return ()

    def all_figures(self) -> Iterable[Figure]:
        """Every figure among the values."""
        for item in fields(self):
            value = getattr(self, item.name)
            values = value if isinstance(value, list | tuple) else [value]
            yield from (found for found in values if isinstance(found, Figure))


@dataclass(frozen=True)
class Rendered:
    """A section as HTML; the other values are those of its `Content`."""

    title: str
    html: Markup
    figures: Sequence[Figure]
    folded: bool
    unmeasured: bool
    notices: Sequence[str]

    def all_figures(self) -> Iterable[Figure]:
        """Every figure in it."""
        return self.figures


@cache
def _environment(folder: Path | None = None) -> Environment:
    """Return an environment with the templates here and, as ``own/NAME``, those of a plug-in."""
    here = FileSystemLoader(Path(__file__).parent / "templates")
    own = PrefixLoader({} if folder is None else {"own": FileSystemLoader(folder)})
    environment = Environment(
        loader=ChoiceLoader([here, own]),
        autoescape=select_autoescape(),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"number": number, "percent": percent, "one_line": one_line}
    return environment


def render_page(
    template: str | Path,
    sections: Sequence[Content | Rendered] = (),
    *,
    simulated: bool,
    **values: object,
) -> str:
    """Render a page of sections under the top that `template` and its `values` give it.

    Everything in it is escaped but the figures' SVG.

    Args:
        template: a file of `templates` by name, or a plug-in's file, which includes others of its
            folder as ``own/NAME``.
    """
    rendered = [
        section if isinstance(section, Rendered) else render_section(section, simulated=simulated)
        for section in sections
    ]
    return _template(template).render(sections=rendered, simulated=simulated, **values)


def _template(file: str | Path) -> Template:
    if isinstance(file, Path):
        file.stat()  # names the whole path of a missing file
        return _environment(file.parent).get_template(f"own/{file.name}")
    return _environment().get_template(file)


def render_section(content: Content, *, simulated: bool) -> Rendered:
    """Render one section."""
    file = content.template
    template = _template(file if isinstance(file, Path) else f"sections/{file}")
    module: Any = template.make_module({"v": content, "simulated": simulated})
    return Rendered(
        str(module.title),
        Markup(str(module)),
        list(content.all_figures()),
        content.folded,
        content.unmeasured,
        content.notices,
    )


def write_figures(folder: Path, figures: Sequence[Figure], *, simulated: bool) -> None:
    """Write each named figure and its data as separate files; those of an older page go.

    Raises:
        ValueError: two figures of one name.
    """
    named = [figure for figure in figures if figure.name]
    if len({figure.name for figure in named}) < len(named):
        raise ValueError(f"two figures of one name among {[figure.name for figure in named]}")
    retained: set[Path] = set()
    for figure in named:
        name = safe_name(figure.name)
        files = {
            folder / "figures" / f"{name}.svg": figure.svg,
            folder / "data" / f"{name}.csv": csv_text(figure.data, simulated=simulated),
        }
        for path, text in files.items():
            make_folder(path.parent)
            write_text(path, text)
            retained.add(path)
    for old in (*(folder / "figures").glob("*.svg"), *(folder / "data").glob("*.csv")):
        if old not in retained:
            old.unlink()


def csv_text(data: Mapping[str, Sequence[object]], *, simulated: bool) -> str:
    """Return a figure's data as CSV: headings first, then rows; what is missing is empty.

    A last column says of every row whether it is simulated, so that no table loses it.
    """
    buffer = io.StringIO()
    write = csv.writer(buffer, lineterminator="\n")
    write.writerow([*data, "simulated"])
    stated = "yes" if simulated else "no"
    for row in itertools.zip_longest(*data.values()):
        write.writerow([*("" if cell is None else cell for cell in row), stated])
    return buffer.getvalue()


def number(value: float | int | None, digits: int = 1, unit: str = "") -> str:
    """Return a number for people: fixed digits, a dash if there is none."""
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return "–"
    text = str(value) if isinstance(value, int) else f"{value:.{digits}f}"
    return f"{text} {unit}".rstrip()


def with_interval(
    value: float | None,
    span: tuple[float | None, float | None] | None,
    digits: int = 1,
    unit: str = "",
) -> str:
    """Return a value with its 95 % interval; an end that is None is infinite."""
    text = number(value, digits)
    if span is not None:
        low = "-∞" if span[0] is None else number(span[0], digits)
        high = "∞" if span[1] is None else number(span[1], digits)
        text = f"{text} ({low} to {high})"
    return f"{text} {unit}".rstrip()


def percent(value: float | None, digits: int = 1) -> str:
    """Return a share as a percentage."""
    return "–" if value is None else f"{100 * value:.{digits}f} %"


def one_line(text: str) -> str:
    """Join the lines of a text."""
    return type(text)(" ").join(text.split())
