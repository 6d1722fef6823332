"""The review page of one browser tab: what it is made of, and what its controls do."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor, Future
from functools import partial
from html import escape
from typing import Any

from bokeh.document import Document
from bokeh.events import DocumentReady
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

from flows import review_words as words
from flows.review_frame import FramePlot
from flows.review_list import Row, TrialList, chosen
from flows.review_plots import TimePlots
from flows.review_trial import Shown, load
from flows.reviewed import STATES
from storage import review
from storage.errors import StoreError
from storage.review import Onsets, Verdict

REFRESH_MS = 2000
_ALL = "all"
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
_CELL = "<span title='<%- reasons %>' class='<%- state %>'><%- value %></span>"


class Page:
    """One tab.

    Args:
        trials: shared by all tabs.
        pool: of one thread, in which trials and frames are read; h5py and the videos are
            then used by one thread at a time.
        who: the reviewer's name to begin with.
    """

    def __init__(
        self, doc: Document, trials: TrialList, pool: Executor, who: str, *, simulated: bool
    ) -> None:
        self.doc, self.trials, self.pool = doc, trials, pool
        self.shown: Shown | None = None
        self._rows: list[Row] = []
        self._wanted: tuple[str, str] | None = None
        self._frame: int | None = None
        self._drawing = False
        self._closed = False
        self._close_by = False
        self._quiet = False
        self.plots = TimePlots(self._moved, self._cursor, simulated)
        self.frame = FramePlot()
        self._widgets(who)
        doc.title = "SlipLab review"
        doc.add_root(self._layout())
        doc.add_periodic_callback(self._look_again, REFRESH_MS)
        doc.on_session_destroyed(lambda _: self.close())
        keyboard = CustomJS(args={"pressed": self.pressed, "reason": self.reason}, code=KEYBOARD)
        doc.js_on_event(DocumentReady, keyboard)
        self._fill()
        doc.add_next_tick_callback(lambda: self._step(1))

    def _widgets(self, who: str) -> None:
        names = [_ALL, *self.trials.items]
        self.campaign = Select(title="campaign", value=_ALL, options=names, width=170)
        self.state = Select(
            title="decision",
            value=_ALL,
            options=[_ALL, "doubtful", *STATES],
            width=110,
            css_classes=["by-decision"],
        )
        self.text = TextInput(title="id holds", value="", width=128, css_classes=["by-id"])
        self.first = Checkbox(label="doubtful first", active=True, css_classes=["doubtful-first"])
        self.count = _div()
        for item in (self.campaign, self.state, self.text):
            item.on_change("value", lambda attr, old, new: self._fill())
        self.first.on_change("active", lambda attr, old, new: self._fill())
        names = ["trial", "state", "doubt", "campaign", "reasons"]
        self.source = ColumnDataSource({name: [] for name in names})
        self.source.selected.on_change("indices", self._picked)
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
        redraw = "const view = Bokeh.index.find_one(table); if (view) view.updateGrid();"
        self.source.js_on_change("data", CustomJS(args={"table": self.table}, code=redraw))
        self.heading, self.lines, self.flags, self.past = _div(), _div(), _div(), _div()
        self.said, self.caption = _div(), _div()
        self.who = TextInput(title="reviewer", value=who, width=120)
        self.reason = TextInput(
            title="reason (needed to reject)", value="", width=300, name="reason"
        )
        self.go_on = Checkbox(label="then the next", active=True)
        self.pressed = TextInput(value="", visible=False)
        self.pressed.on_change("value", self._key)
        self.buttons: dict[str, Button] = {}
        named: tuple[tuple[Verdict, str, str], ...] = (
            ("accept", "Accept label", "success"), ("adjust", "Adjust to lines", "primary"),
            ("reject", "Reject", "warning"), ("reopen", "Reopen", "default"),
        )  # fmt: skip
        for verdict, text, kind in named:
            button = Button(label=text, button_type=kind, width=110, name=verdict)
            button.on_click(partial(self._decide, verdict))
            self.buttons[verdict] = button
        self.no_incipient = Button(label="no incipient slip", width=115)
        self.no_gross = Button(label="no gross slip", width=115)
        self.zoom = Button(label="zoom", width=70)
        self.zoom.on_click(self._zoom)
        self.back = Button(label="lines back", width=90)
        self.no_incipient.on_click(lambda: self.plots.put("incipient", None))
        self.no_gross.on_click(lambda: self.plots.put("gross", None))
        self.back.on_click(self._reset_lines)

    def _layout(self) -> Any:
        left = column(
            row(self.campaign, self.state, self.text),
            row(self.first, self.count),
            self.table,
            Div(text=words.keys(), stylesheets=[words.STYLE], width=430),
            self.pressed,
            width=440,
        )
        tools = row(self.no_incipient, self.no_gross, self.back, self.zoom)
        decide = row(self.who, self.reason)
        buttons = row(*self.buttons.values(), self.go_on)
        middle = column(
            self.heading, self.plots.moved, self.plots.rate, self.lines, tools, decide, buttons,
            self.said, self.past, sizing_mode="stretch_width",
        )  # fmt: skip
        right = column(self.frame.plot, self.caption, self.flags, width=410)
        return row(left, middle, right, sizing_mode="stretch_width")

    # the list

    def _fill(self) -> None:
        """Show the rows that the filters let through; the trial that is shown stays."""
        campaign = "" if self.campaign.value == _ALL else self.campaign.value
        state = "" if self.state.value == _ALL else self.state.value
        self._rows = chosen(
            self.trials.rows, campaign=campaign, state=state, text=self.text.value,
            doubtful_first=bool(self.first.active),
        )  # fmt: skip
        columns: dict[str, list[str]] = {
            "trial": [item.trial for item in self._rows],
            "campaign": [item.campaign for item in self._rows],
            "state": [_state_word(item) for item in self._rows],
            "doubt": ["?" * item.severity for item in self._rows],
            "reasons": ["; ".join((item.campaign, *item.reasons)) for item in self._rows],
        }
        self._quiet = True
        try:
            if columns != dict(self.source.data):
                self.source.data = columns
            here = self._place()
            self.source.selected.indices = [] if here is None else [here]
        finally:
            self._quiet = False
        left = sum(item.state in {"open", "stale"} for item in self._rows)
        self.count.text = f"{len(self._rows)} trials, {left} to decide"

    def _place(self) -> int | None:
        names = [item.name for item in self._rows]
        return names.index(self._wanted) if self._wanted in names else None

    def _picked(self, _: str, __: object, new: list[int]) -> None:
        if not self._quiet and new and new[0] < len(self._rows):
            self._choose(self._rows[new[0]])

    def _step(self, by: int) -> None:
        """The next row, or the one before."""
        if not self._rows:
            return
        here = self._place()
        there = 0 if here is None else min(max(here + by, 0), len(self._rows) - 1)
        self._choose(self._rows[there])

    def _look_again(self) -> None:
        """Decisions of others and new trials, while nobody asked."""
        try:
            if not self.trials.refresh() and self.trials.rows is self._listed:
                return
        except StoreError as error:
            self._say(str(error), good=False)
            return
        self._listed = self.trials.rows
        self._fill()
        there = {item.name: item for item in self.trials.rows}
        if self.shown is not None and there.get(self.shown.row.name, self.shown.row) != (
            self.shown.row
        ):
            self._choose(there[self.shown.row.name])

    _listed: list[Row] | None = None

    # one trial

    def _choose(self, item: Row) -> None:
        """Read a trial in the background, then show it."""
        self._wanted = item.name
        here = self._place()
        self._quiet = True
        self.source.selected.indices = [] if here is None else [here]
        self._quiet = False
        self._later(lambda: load(self.trials.store, self.trials.items[item.campaign], item),
                    self._show)  # fmt: skip

    def _show(self, found: Shown) -> None:
        if found.row.name != self._wanted:
            found.close()
            return
        again = self.shown is not None and self.shown.row.name == found.row.name
        kept = self.plots.onsets() if again and self._is_moved() else None
        if self.shown is not None:
            self.shown.close()
        self.shown = found
        decided = self._history()
        self.frame.frame_to(found)
        self._close_by = False
        self.plots.show(found, kept or self._lines_of(found, decided))
        if not again:
            self.reason.value = ""
        place = self._place()
        position = "" if place is None else f"{place + 1} of {len(self._rows)}"
        self.heading.text = words.heading(found, position)
        self.flags.text = words.flags(found)
        self.past.text = words.past(decided, found.row.key)
        self._moved()
        able = found.row.label == "fresh" and not found.row.problem
        for button in self.buttons.values():
            button.disabled = not able
        times = [t for t in (found.suggested.incipient_ns,) if t is not None]
        self._cursor(times[0] / 1e9 if times else found.motion_s[0])

    def _history(self) -> list[review.Decision]:
        if self.shown is None:
            return []
        try:
            return review.history(self.trials.store, *self.shown.row.name)
        except StoreError:
            return []  # the row says so

    def _lines_of(self, shown: Shown, decided: list[review.Decision]) -> Onsets:
        """Where the lines begin: as adjusted, or as the label has them, or suggests them."""
        if decided and decided[-1].verdict == "adjust" and decided[-1].label == shown.row.key:
            return decided[-1].new
        return shown.suggested

    def _is_moved(self) -> bool:
        return self.shown is not None and self.plots.onsets() != self._lines_of(
            self.shown, self._history()
        )

    def _reset_lines(self) -> None:
        if self.shown is not None:
            self.plots.place(self.shown.suggested)
            self._moved()

    def _zoom(self) -> None:
        """Close to the cursor, or back."""
        if self.shown is None:
            return
        self._close_by = not self._close_by and self._frame is not None
        time = float(self.shown.frame_s[self._frame or 0]) if self._close_by else None
        self.plots.zoom(time, self.shown.threshold_px)

    def _moved(self) -> None:
        if self.shown is not None:
            self.lines.text = words.lines(self.shown, self.plots.onsets())

    # the frame under the cursor

    def _cursor(self, time_s: float) -> None:
        if self.shown is None or (index := self.shown.frame_at(time_s)) < 0:
            return
        self._frame = index
        self.plots.cursor(float(self.shown.frame_s[index]))
        if not self._drawing:
            self._draw()

    def _draw(self) -> None:
        """Read the wanted frame in the background; the newest wish counts."""
        shown, index = self.shown, self._frame
        if shown is None or index is None:
            return
        self._drawing = True

        def done(_: object) -> None:
            self._drawing = False
            if self.shown is shown:
                self.caption.text = self.frame.draw(shown, index)
            if (self.shown, self._frame) != (shown, index):
                self._draw()

        self._later(lambda: shown.picture(index), done, otherwise=lambda: done(None))

    # decisions

    def _decide(self, verdict: Verdict) -> None:
        shown = self.shown
        if shown is None or self.buttons["accept"].disabled:
            return
        now = self.trials.renew(shown.row)
        if now.label != "fresh" or now.key != shown.label_key:
            self._say("The label has changed meanwhile: look at it again.", good=False)
            self._choose(now)
            return
        new = {"accept": shown.onsets, "adjust": self.plots.onsets(), "reject": Onsets(),
               "reopen": shown.onsets}[verdict]  # fmt: skip
        try:
            if (problem := self._outside(shown, new)) is not None:
                raise ValueError(problem)
            made = review.decide(
                self.trials.store, *shown.row.name, verdict, label=shown.label_key,
                old=shown.onsets, new=new, seen=shown.row.decisions, who=self.who.value.strip(),
                why=self.reason.value,
            )  # fmt: skip
        except review.Overtaken as error:
            self._say(f"{error}. Look at it, then decide again.", good=False)
            self._choose(self.trials.renew(shown.row))
            return
        except (ValueError, OSError, StoreError) as error:
            self._say(f"Not kept: {error}", good=False)
            return
        kept = self.trials.renew(shown.row)
        self._say(f"{shown.row.trial}: {made}", good=True)
        after = self._after() if self.go_on.active and verdict != "reopen" else None
        self.shown.row = kept  # type: ignore[union-attr]  # it is `shown`
        self._fill()
        self._choose(after or kept)

    def _after(self) -> Row | None:
        """The row below the one that is shown; None at the end."""
        here = self._place()
        following = [] if here is None else self._rows[here + 1 : here + 2]
        return following[0] if following else None

    @staticmethod
    def _outside(shown: Shown, onsets: Onsets) -> str | None:
        for kind in ("incipient", "gross"):
            time = getattr(onsets, f"{kind}_ns")
            if time is not None and not shown.span_s[0] <= time / 1e9 <= shown.span_s[1]:
                return f"the {kind} onset lies outside the recording"
        return None

    def _key(self, _: str, __: str, new: str) -> None:
        """A key that the browser handed on."""
        name = new.partition(" ")[0]
        if name in self.buttons:
            self._decide(name)  # type: ignore[arg-type]  # the buttons are named by verdicts
        elif name in {"incipient", "gross"}:
            if self.shown is not None and self._frame is not None:
                time = float(self.shown.frame_s[self._frame])
                self.plots.put(name, time)  # type: ignore[arg-type]  # one of the two kinds
        elif name == "reset":
            self._reset_lines()
        elif name == "zoom":
            self._zoom()
        elif name in {"next", "previous"}:
            self._step(1 if name == "next" else -1)
        elif self.shown is not None and self._frame is not None:
            by = 1 if name == "forth" else -1
            last = len(self.shown.frame_s) - 1
            self._cursor(float(self.shown.frame_s[min(max(self._frame + by, 0), last)]))

    # work aside

    def _later(
        self,
        work: Callable[[], Any],
        then: Callable[[Any], None],
        otherwise: Callable[[], None] = lambda: None,
    ) -> None:
        """Do `work` in the pool and `then` with its result in this tab."""

        def back(done: Future[Any]) -> None:
            if not self._closed:
                self.doc.add_next_tick_callback(partial(finish, done))

        def finish(done: Future[Any]) -> None:
            error = done.exception()
            if error is None:
                then(done.result())
            else:
                self._say(f"{type(error).__name__}: {error}", good=False)
                otherwise()

        self.pool.submit(work).add_done_callback(back)

    def _say(self, text: str, *, good: bool) -> None:
        self.said.text = f"<p class='{'good' if good else 'bad'}'>{escape(text)}</p>"

    def close(self) -> None:
        """The tab is gone."""
        self._closed = True
        if self.shown is not None:
            self.shown.close()
            self.shown = None


def _state_word(item: Row) -> str:
    if item.problem:
        return "damaged"
    if item.label != "fresh":
        return "no label" if item.label == "missing" else "old label"
    return item.state


def _div() -> Div:
    return Div(text="", stylesheets=[words.STYLE], sizing_mode="stretch_width")


_TABLE_STYLE = """
:host { font-family: sans-serif; font-size: 12px; }
.slick-cell { font-size: 11px; } .slick-cell.selected { background: #cfe3f2; }
.accepted, .adjusted { color: #00664a; } .rejected { color: #b04700; } .stale { color: #8a6100; }
"""
