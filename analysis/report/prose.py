"""Prose of pages: the blocks of a text template as paragraphs."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined, Template

from sliplab.analysis.report.page import number, percent

_TEMPLATES = Path(__file__).parent / "templates"


def paragraphs(template: str, block: str, **values: object) -> list[str]:
    """Return the paragraphs of a block as plain text; the page that shows them escapes them.

    Blank lines part paragraphs. Filters: `percent` and `number` of `analysis.report.page`.

    Args:
        template: file name in the folder of templates.

    Raises:
        jinja2.UndefinedError: the block names a value that is not among `values`.
    """
    found = _template(template)
    text = "".join(found.blocks[block](found.new_context(values)))
    parts = (re.sub(r"[ \n]+", " ", part).strip() for part in text.split("\n\n"))
    return [part for part in parts if part]


def paragraph(template: str, block: str, **values: object) -> str:
    """Return a block of one paragraph, such as a caption."""
    (found,) = paragraphs(template, block, **values)
    return found


@cache
def _template(name: str) -> Template:
    # plain text: it is escaped once, where it is put into a page
    environment = Environment(
        loader=FileSystemLoader(_TEMPLATES),
        autoescape=False,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(percent=percent, number=number)
    return environment.get_template(name)
