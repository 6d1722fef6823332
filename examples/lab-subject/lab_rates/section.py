"""The rates in the report."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from lab_rates.study import RESULT, Rates, table
from sliplab.analysis.report.page import Content, Table
from sliplab.analysis.report.plugin_sections import ReportData, ReportSection


@dataclass(frozen=True)
class RatesSection(Content):
    """A table of rates."""

    template: ClassVar[Path] = Path(__file__).with_name("section.html")
    rates: Table


def make(data: ReportData) -> RatesSection | None:
    """Return the section; None where `sliplab rates` was never run."""
    result = RESULT.read(data.store)
    if result is None:
        return None
    return RatesSection(table(RESULT.parse(Rates, result)))


SECTION = ReportSection(make, last=True)
