"""A study: options, a result and a page. Command, files, tables and schema follow from these.

A study measures something once that takes minutes to hours, and says it in three ways: a document
(JSON), its lists as tables (CSV, Parquet), and a page (HTML). Plug-ins name their studies in
`protocols.plugin.Plugin.studies`; `flows.cli.study_command` makes the commands.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from sliplab.storage.files import make_folder, safe_name, write_bytes, write_json, write_text
from sliplab.storage.schema.document import Document

if TYPE_CHECKING:
    from sliplab.analysis.report.page import Table

ResultT = TypeVar("ResultT", bound=Document)
Row = dict[str, Any]
"""Plain cells by column."""
TABLES = "tables"
"""Folder of the tables, beside the page."""


@dataclass(frozen=True)
class Finding(Generic[ResultT]):
    """What a study found, and where its files go.

    Attributes:
        folder: of its files. stem: their name without an ending; empty: the study's.
        failed: the command ends with exit code 1, such as for a limit that is exceeded.
        error: is raised when everything is written, in place of anything that is shown.
        more: further arguments of `Study.view` and `shown`: what the result does not hold.
        named: further entries of the JSON of the command, in place of the result's; paths are
            written as text.
        dry: a plan of what would be done; nothing is written.
    """

    result: ResultT
    folder: Path
    stem: str = ""
    failed: bool = False
    error: Exception | None = None
    more: tuple[Any, ...] = ()
    named: Mapping[str, Any] = field(default_factory=dict)
    dry: bool = False


@dataclass(frozen=True)
class Study(Generic[ResultT]):
    """What a study measures and shows.

    Attributes:
        name: of its command and files.
        title: of the JSON Schema of its result.
        measure: does the work. Its parameters are the options of the command; its docstring is the
            help, and its ``Args:`` that of options without one. It imports what is slow to import
            when it is called.
        result: the document that it returns.
        page: a template that extends ``page.html``.
        view: returns the values of the template, given the result and `Finding.more`.
        shown: returns what the terminal shows, tables and lines, given the same.
        example: a command line for the help.
        kind: of the schema; empty: the name.
    """

    name: str
    title: str
    measure: Callable[..., Finding[ResultT]]
    result: type[ResultT]
    page: Path
    view: Callable[..., Mapping[str, Any]]
    shown: Callable[..., Iterable[Table | str]]
    example: str
    kind: str = ""

    def paths(self, found: Finding[ResultT]) -> tuple[Path, Path]:
        """Return where the page and the document go."""
        stem = found.stem or self.name
        return found.folder / f"{stem}.html", found.folder / f"{stem}.json"

    def write(self, found: Finding[ResultT]) -> Path:
        """Write document, page and tables; return the page's path."""
        make_folder(found.folder)
        page, document = self.paths(found)
        write_json(document, found.result.to_json())
        write_text(page, self.render(found.result, *found.more))
        write_tables(found.folder / TABLES, page.stem, found.result)
        return page

    def render(self, result: ResultT, *more: Any) -> str:
        """Return the page of a result and of `Finding.more`."""
        from sliplab.analysis.report.page import render_page

        return render_page(
            self.page,
            simulated=bool(getattr(result, "simulated", False)),
            result=result,
            **self.view(result, *more),
        )

    def read(self, path: Path) -> ResultT:
        """Read a document that the study wrote.

        Raises:
            DocumentError, NewerFormat: it is of another shape.
            FileNotFoundError: it is not there.
        """
        return self.result.load(path)


def write_tables(folder: Path, stem: str, result: Document) -> None:
    """Write the lists of a document as tables, ``STEM.LIST.csv`` and ``.parquet``."""
    import pandas as pd

    for name, rows in tables(result.to_json(), simulated=getattr(result, "simulated", None)):
        make_folder(folder)
        frame = pd.DataFrame(rows)
        for column in frame:
            if frame[column].dropna().map(type).nunique() > 1:  # numbers and words: all as text
                frame[column] = frame[column].map(str, na_action="ignore")
        place = folder / safe_name(f"{stem}.{name}")
        write_text(place.with_name(f"{place.name}.csv"), frame.to_csv(index=False))
        write_bytes(place.with_name(f"{place.name}.parquet"), frame.to_parquet(index=False))


def tables(
    document: Mapping[str, Any], *, simulated: bool | None = None
) -> Iterator[tuple[str, list[Row]]]:
    """Yield each list of a document as a table: its name and rows of plain cells.

    A row has the cells of the rows that hold it, then its own; a mapping in it is joined to its
    cells by ``_``, and a list of numbers is JSON text. The last column is ``simulated``.
    """
    found: dict[str, list[Row]] = {}
    for name, value in document.items():
        _collect(found, name, value, {})
    for name, rows in found.items():
        yield name, rows if simulated is None else [{**row, "simulated": simulated} for row in rows]


def _collect(found: dict[str, list[Row]], name: str, value: Any, above: Row) -> None:
    """Add the rows of a list, or of a mapping of names to mappings, and of the lists in them."""
    if isinstance(value, Mapping) and value and all(isinstance(v, Mapping) for v in value.values()):
        value = [{"name": key, **item} for key, item in value.items()]
    if not isinstance(value, list) or not value or not isinstance(value[0], Mapping):
        return
    last = name.rsplit(".", 1)[-1]
    for item in value:
        cells = _cells(item)
        row = {**above, **{f"{last}_{k}" if k in above else k: v for k, v in cells.items()}}
        found.setdefault(name, []).append(row)
        for key, inner in item.items():
            _collect(found, f"{name}.{key}", inner, row)


def _cells(item: Mapping[str, Any]) -> Row:
    cells: Row = {}
    for key, value in item.items():
        if isinstance(value, Mapping):
            inner = _cells(value)
            cells |= {key if k == "value" else f"{key}_{k}": v for k, v in inner.items()}
        elif isinstance(value, list):
            if value and not isinstance(value[0], Mapping):
                cells[key] = json.dumps(value)
        else:
            cells[key] = value
    return cells
