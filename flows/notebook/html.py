"""Short HTML of what a notebook shows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape


def pairs_html(title: str, pairs: Mapping[str, object]) -> str:
    """Return names and values as a table."""
    return table_html(title, (), list(pairs.items()))


def table_html(title: str, columns: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Return rows of cells as a table with a title; a None is an empty cell."""
    head = _row("th", columns) if columns else ""
    body = "".join(_row("td", row) for row in rows)
    return f"<p><b>{escape(title)}</b></p><table>{head}{body}</table>"


def _row(tag: str, cells: Sequence[object]) -> str:
    inner = "".join(f"<{tag}>{'' if it is None else escape(str(it))}</{tag}>" for it in cells)
    return f"<tr>{inner}</tr>"
