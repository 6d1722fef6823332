"""The review page's widgets, their layout, and its texts as HTML; what people wrote is escaped."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
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

from sliplab.analysis.labels.reviewed import STATES
from sliplab.flows.ui.review import ShownTrial
from sliplab.storage.trials.review import Decision, ReviewedOnsets, Verdict

ALL = "all"
VERDICTS: tuple[tuple[Verdict, str, str], ...] = (
    ("accept", "Accept label", "success"),
    ("adjust", "Adjust to lines", "primary"),
    ("reject", "Reject", "warning"),
    ("reopen", "Reopen", "default"),
)
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
# the trial of the clicked row is sent by its id: when the server receives the click, its number in
# the list may be another trial's
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
    """The widgets of a tab, besides its plots.

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
            source=self.source,
            width=430,
            height=600,
            index_position=None,
            row_height=24,
            sortable=False,
            reorderable=False,
            scroll_to_selection=True,
            autosize_mode="none",
            columns=[
                TableColumn(field="doubt", title="", width=26, formatter=cell),
                TableColumn(field="trial", title="trial", width=318, formatter=cell),
                TableColumn(field="state", title="decision", width=66, formatter=cell),
            ],
            stylesheets=[_TABLE_STYLE],
        )
        # a table redraws itself only if its number of rows changed
        self.source.js_on_change("data", CustomJS(args={"table": self.table}, code=_REDRAW))
        self.heading, self.lines, self.flags, self.past = _div(), _div(), _div(), _div()
        self.stated, self.caption = _div(), _div()
        self.who = TextInput(title="reviewer", value=who, width=120)
        self.reason = TextInput(title="reason (required to reject)", value="", width=300)
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
        """Arrange the widgets around the plots of displacements, event rate and frame."""
        left = column(
            row(self.campaign, self.state, self.text),
            row(self.first, self.count),
            self.table,
            Div(text=keys_html(), stylesheets=[STYLE], width=430),
            self.pressed,
            self.picked,
            width=440,
        )
        tools = row(self.no_incipient, self.no_gross, self.back, self.zoom)
        decide = row(self.who, self.reason)
        buttons = row(*self.buttons.values(), self.go_on)
        middle = column(
            self.heading,
            moved,
            rate,
            self.lines,
            tools,
            decide,
            buttons,
            self.stated,
            self.past,
            sizing_mode="stretch_width",
        )
        right = column(frame, self.caption, self.flags, width=410)
        return row(left, middle, right, sizing_mode="stretch_width")


def _div() -> Div:
    return Div(text="", stylesheets=[STYLE], sizing_mode="stretch_width")


KEYS = (
    ("n, &darr;", "next"),
    ("p, &uarr;", "previous"),
    ("&larr; &rarr;", "frame"),
    ("i, g", "line to the cursor"),
    ("a", "accept"),
    ("s", "adjust"),
    ("r", "reason, reject"),
    ("u", "reopen"),
    ("0", "lines back"),
    ("z", "zoom"),
)


def keys_html() -> str:
    """Format the keyboard help, in one line."""
    return "<div class='keys'>" + " ".join(f"<kbd>{k}</kbd> {what}" for k, what in KEYS) + "</div>"


def heading_html(shown: ShownTrial, position: str) -> str:
    """Format the trial's name, its conditions, and the reasons for doubt."""
    row = shown.row
    condition = shown.recording.record.condition
    levels = ", ".join(f"{name} {text}" for name, text in condition.items())
    who = f" by {escape(row.who)}" if row.who else ""
    badges = [f"<span class='state {row.state}'>{row.state}{who}</span>"]
    if shown.recording.simulated:
        badges.append("<span class='state simulated'>simulated</span>")
    reasons = [f"<li class='doubt'>{escape(text)}</li>" for text in row.reasons]
    if row.label != "fresh":
        words = {"missing": "No label yet", "stale": "This label is out of date"}
        reasons.insert(
            0, f"<li class='doubt'>{words[row.label]}: run `sliplab label`, then decide.</li>"
        )
    if row.state == "stale":
        reasons.insert(
            0,
            "<li class='doubt'>The last decision was made on a label that has changed since; "
            "it is not used.</li>",
        )
    if row.problem:
        reasons.insert(0, f"<li class='doubt'>{escape(row.problem)}</li>")
    if not reasons:
        reasons = ["<li>no doubts</li>"]
    return (
        f"<h1>{escape(levels)} {' '.join(badges)}</h1>"
        f"<p class='id'>{escape(row.campaign)} / {escape(row.trial)} &middot; {position}</p>"
        f"<ul>{''.join(reasons)}</ul>"
    )


def lines_html(shown: ShownTrial, onsets: ReviewedOnsets) -> str:
    """Format the positions of the onset lines, and their distance from the label."""
    rows = []
    for kind in ("incipient", "gross"):
        now, was = getattr(onsets, f"{kind}_ns"), getattr(shown.onsets, f"{kind}_ns")
        far = "" if now is None or was is None else f"{(now - was) / 1e6:+.1f} ms"
        if was is None and now is not None and now == getattr(shown.suggested, f"{kind}_ns"):
            far = "suggested from the visible markers"
        rows.append(
            f"<tr><th class='{kind}'>{kind}</th><td>{_seconds(was)}</td>"
            f"<td>{_seconds(now)}</td><td>{far}</td></tr>"
        )
    return (
        "<table><tr><th>onset</th><th>label</th><th>line</th><th>moved</th></tr>"
        + "".join(rows)
        + "</table>"
    )


def flags_html(shown: ShownTrial) -> str:
    """Format the trial's gates and the quality of its label."""
    cells = []
    for name, gate in shown.recording.record.quality.gates.items():
        mark = "" if gate.passed else " class='doubt'"
        limit = "" if gate.limit is None else f" (limit {gate.limit:g})"
        cells.append((f"<td{mark}>{escape(name)}</td>", f"{_plain(gate.value)}{limit}"))
    label = {} if shown.label is None else shown.label.to_json()
    for name in ("source", "rule", "reference", "markers_lost", "plate_lost", "camera_moved_px"):
        if label.get(name) is not None:
            cells.append((f"<td>{name}</td>", escape(_plain(label[name]))))
    if shown.label is not None and shown.label.quality:
        worst = min(shown.label.quality)
        which = shown.label.quality.index(worst)
        cells.append(("<td>worst marker</td>", f"{which}, quality {worst:.2f} of 1"))
    cells.append(("<td>clocks</td>", "fitted again" if shown.recording.refitted else "as recorded"))
    body = "".join(f"<tr>{name}<td>{value}</td></tr>" for name, value in cells)
    return f"<table class='flags'>{body}</table>"


def history_html(history: Sequence[Decision], key: str) -> str:
    """Format all decisions about a trial, the newest first."""
    if not history:
        return "<p class='id'>no decision yet</p>"
    rows = []
    for made in reversed(history):
        change = (
            ""
            if made.verdict in {"accept", "reopen"}
            else (
                f"{_seconds(made.old.incipient_ns)}, {_seconds(made.old.gross_ns)} &rarr; "
                f"{_seconds(made.new.incipient_ns)}, {_seconds(made.new.gross_ns)}"
            )
        )
        old = "" if made.label == key else " (on an older label)"
        rows.append(
            f"<tr><td>{made.number}</td><td>{escape(made.verdict)}{old}</td><td>{change}</td>"
            f"<td>{escape(made.who)}</td><td>{escape(made.when[:16].replace('T', ' '))}</td>"
            f"<td class='why'>{escape(made.why)}</td></tr>"
        )
    head = "<tr><th></th><th>decision</th><th>incipient, gross</th><th>who</th><th>UTC</th>"
    return f"<table class='past'>{head}<th>reason</th></tr>{''.join(rows)}</table>"


def _seconds(ns: int | None) -> str:
    return "&ndash;" if ns is None else f"{ns / 1e9:.4f} s"


def _plain(value: object) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)


STYLE = """
:host { font-family: sans-serif; font-size: 13px; color: #20262c; }
h1 { font-size: 17px; margin: 0 0 2px; font-weight: 600; }
p { margin: 2px 0; } ul { margin: 2px 0; padding-left: 18px; }
.id { color: #666666; font-size: 12px; overflow-wrap: anywhere; }
.doubt { color: #b04700; }
.state { font-size: 12px; padding: 1px 7px; border-radius: 8px; background: #e8ebee;
  font-weight: 400; vertical-align: 2px; }
.state.accepted { background: #cdeee2; } .state.adjusted { background: #d5e6f4; }
.state.rejected { background: #f9ddcf; } .state.stale { background: #fbe9c0; }
.state.simulated { background: none; border: 1px solid #999; font-style: italic; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
td, th { padding: 1px 10px 1px 0; text-align: left; font-weight: 400; vertical-align: top;
  white-space: nowrap; }
tr:first-child th { color: #666666; }
th.incipient { color: #b87d00; font-weight: 600; } th.gross { color: #D55E00; font-weight: 600; }
.past td.why { white-space: normal; overflow-wrap: anywhere; }
.flags td { font-size: 12px; padding-bottom: 0; }
kbd { border: 1px solid #bbb; border-radius: 3px; padding: 0 4px; background: #f4f5f6; }
.keys { color: #666666; font-size: 12px; line-height: 1.7; }
.good { color: #00664a; } .bad { color: #b04700; font-weight: 600; }
"""
