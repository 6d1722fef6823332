"""The review page's widgets and where they stand."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from bokeh.layouts import column, row
from bokeh.models import (
    Button,
    Checkbox,
    ColumnDataSource,
    CustomJS,
    DataTable,
    Div,
    HTMLTemplateFormatter,
    Select,
    TableColumn,
    TextInput,
)

from sliplab.flows.labelling.reviewed import STATES
from sliplab.flows.reviewing import review_words as words
from sliplab.storage.trials.review import Verdict

ALL = "all"
VERDICTS: tuple[tuple[Verdict, str, str], ...] = (
    ("accept", "Accept label", "success"), ("adjust", "Adjust to lines", "primary"),
    ("reject", "Reject", "warning"), ("reopen", "Reopen", "default"),
)  # fmt: skip
_REDRAW = "const view = Bokeh.index.find_one(table); if (view) view.updateGrid();"
KEYBOARD = """
if (window.sliplab_keys) return;
window.sliplab_keys = true;
const known = {n: "next", ArrowDown: "next", p: "previous", ArrowUp: "previous",
  ArrowLeft: "back", ArrowRight: "forth", i: "incipient", g: "gross", a: "accept",
  s: "adjust", r: "reason", u: "reopen", "0": "reset", z: "zoom"};
let count = 0;
window.addEventListener("keydown", (event) => {
  const target = event.composedPath()[0];
  const typing = target.isContentEditable || /^(INPUT|TEXTAREA|SELECT)$/.test(target.tagName || "")
    && target.type !== "checkbox";
  if (typing) { if (event.key === "Escape") target.blur(); return; }
  if (event.ctrlKey || event.metaKey || event.altKey || !(event.key in known)) return;
  event.preventDefault();
  event.stopPropagation();
  if (known[event.key] === "reason") {
    const view = Bokeh.index.find_one(reason);
    if (view) view.input_el.focus();
  } else {
    count += 1;
    pressed.value = known[event.key] + " " + count;
  }
}, true);
"""
# the trial of the row that was pressed, as it stands there: by the time that the server hears of
# it, its number in the list may be another trial's
CHOOSING = """
if (window.sliplab_rows) return;
window.sliplab_rows = true;
let count = 0;
window.addEventListener("mousedown", (event) => {
  const row = event.composedPath().find((item) => item.classList?.contains("slick-row"));
  const cell = row?.querySelector("[data-trial]");
  if (!cell || event.button !== 0) return;
  count += 1;
  picked.value = JSON.stringify([cell.dataset.campaign, cell.dataset.trial, count]);
}, true);
"""
_CELL = (
    "<span title='<%- reasons %>' class='<%- state %>' data-campaign='<%- campaign %>' "
    "data-trial='<%- trial %>'><%- value %></span>"
)
_TABLE_STYLE = """
:host { font-family: sans-serif; font-size: 12px; }
.slick-cell { font-size: 11px; } .slick-cell.selected { background: #cfe3f2; }
.accepted, .adjusted { color: #00664a; } .rejected { color: #b04700; } .stale { color: #8a6100; }
"""


class Widgets:
    """What a tab shows beside its plots.

    Args:
        campaigns: to choose from; who: the reviewer's name to begin with.
    """

    def __init__(self, campaigns: Sequence[str], who: str) -> None:
        self.campaign = Select(title="campaign", value=ALL, options=[ALL, *campaigns], width=170)
        self.state = Select(
            title="decision",
            value=ALL,
            options=[ALL, "doubtful", *STATES],
            width=110,
            css_classes=["by-decision"],
        )
        self.text = TextInput(title="id holds", value="", width=128, css_classes=["by-id"])
        self.first = Checkbox(label="doubtful first", active=True, css_classes=["doubtful-first"])
        self.count = _div()
        names = ["trial", "state", "doubt", "campaign", "reasons"]
        self.source = ColumnDataSource({name: [] for name in names})
        cell = HTMLTemplateFormatter(template=_CELL)
        self.table = DataTable(
            source=self.source, width=430, height=600, index_position=None, row_height=24,
            sortable=False, reorderable=False, scroll_to_selection=True, autosize_mode="none",
            columns=[
                TableColumn(field="doubt", title="", width=26, formatter=cell),
                TableColumn(field="trial", title="trial", width=318, formatter=cell),
                TableColumn(field="state", title="decision", width=66, formatter=cell),
            ],
            stylesheets=[_TABLE_STYLE],
        )  # fmt: skip
        # a table draws itself anew only where its rows became more or fewer
        self.source.js_on_change("data", CustomJS(args={"table": self.table}, code=_REDRAW))
        self.heading, self.lines, self.flags, self.past = _div(), _div(), _div(), _div()
        self.said, self.caption = _div(), _div()
        self.who = TextInput(title="reviewer", value=who, width=120)
        self.reason = TextInput(title="reason (needed to reject)", value="", width=300)
        self.go_on = Checkbox(label="then the next", active=True)
        self.pressed = TextInput(value="", visible=False)
        self.picked = TextInput(value="", visible=False)
        self.buttons: dict[Verdict, Button] = {
            verdict: Button(label=text, button_type=kind, width=110)
            for verdict, text, kind in VERDICTS
        }
        self.no_incipient = Button(label="no incipient slip", width=115)
        self.no_gross = Button(label="no gross slip", width=115)
        self.zoom = Button(label="zoom", width=70)
        self.back = Button(label="lines back", width=90)
        self.keyboard = CustomJS(
            args={"pressed": self.pressed, "reason": self.reason}, code=KEYBOARD
        )
        self.choosing = CustomJS(args={"picked": self.picked}, code=CHOOSING)

    def layout(self, moved: Any, rate: Any, frame: Any) -> Any:
        """All of it, around the plots of displacements, event rate and frame."""
        left = column(
            row(self.campaign, self.state, self.text),
            row(self.first, self.count),
            self.table,
            Div(text=words.keys(), stylesheets=[words.STYLE], width=430),
            self.pressed,
            self.picked,
            width=440,
        )
        tools = row(self.no_incipient, self.no_gross, self.back, self.zoom)
        decide = row(self.who, self.reason)
        buttons = row(*self.buttons.values(), self.go_on)
        middle = column(
            self.heading, moved, rate, self.lines, tools, decide, buttons,
            self.said, self.past, sizing_mode="stretch_width",
        )  # fmt: skip
        right = column(frame, self.caption, self.flags, width=410)
        return row(left, middle, right, sizing_mode="stretch_width")


def _div() -> Div:
    return Div(text="", stylesheets=[words.STYLE], sizing_mode="stretch_width")
