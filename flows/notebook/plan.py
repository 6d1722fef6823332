"""A plan that a notebook shows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from sliplab.flows.notebook.html import table_html
from sliplab.flows.running import extras
from sliplab.protocols.plan import Plan

if TYPE_CHECKING:
    from sliplab.analysis.report.page import Figure

_ROWS = 8


@dataclass(frozen=True, repr=False)
class PlanView(Plan):
    """A protocol expanded, with its table and its figure."""

    def plot(self) -> Figure:
        """Planned trials by the first two factors, as the report draws them.

        Raises:
            InputError: the protocol has fewer than two factors.
            ModuleNotFoundError: the extra ``report`` is not installed.
        """
        with extras.named("Plan.plot"):
            from sliplab.analysis.report.campaign import grid_figure
        found = grid_figure(self.protocol.name, self, (), simulated=False)
        if found is None:
            from sliplab.protocols.errors import InputError

            raise InputError(self.file, "collection.factors", None, "has fewer than two factors")
        return found[-1]

    def _repr_html_(self) -> str:
        table = self.table()
        shown = table.head(_ROWS)
        more = f"; the first {_ROWS} of them" if len(table) > _ROWS else ""
        rows = [list(row) for row in shown.itertuples(index=False)]
        return table_html(f"{self!r}{more}", list(shown.columns), rows)
