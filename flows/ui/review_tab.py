"""The review page of one browser tab: what its controls do, and its work in the background."""

from __future__ import annotations

import json
from collections.abc import Callable
from concurrent.futures import Executor, Future
from functools import partial
from html import escape
from typing import Any

from bokeh.document import Document
from bokeh.events import DocumentReady

from sliplab.flows.ui.review import (
    LabelChanged,
    ReviewRow,
    ShownTrial,
    TrialList,
    as_columns,
    filtered_rows,
    load_trial,
    record_verdict,
)
from sliplab.flows.ui.review_plots import FramePlot, TimePlots
from sliplab.flows.ui.review_widgets import (
    ALL,
    Widgets,
    flags_html,
    heading_html,
    history_html,
    lines_html,
)
from sliplab.protocols.shown import plural
from sliplab.storage.errors import StoreError
from sliplab.storage.streams import U8
from sliplab.storage.trials import review
from sliplab.storage.trials.review import ReviewedOnsets, Verdict

REFRESH_MS = 2000


class ReviewTab:
    """One tab.

    Args:
        trials: shared by all tabs.
        pool: of one thread, in which trials and frames are read; h5py and the videos are
            then used by one thread at a time.
        who: the reviewer's name to begin with.
    """

    def __init__(self, doc: Document, trials: TrialList, pool: Executor, who: str) -> None:
        self.trials = trials
        self._background = Background(doc, pool, self._say)
        self.shown: ShownTrial | None = None
        self._rows: list[ReviewRow] = []
        self._requested: tuple[str, str] | None = None
        self._frame: int | None = None
        self._drawing = False
        self._close_by = False
        self._looking = False
        self._listed: list[ReviewRow] | None = None
        self.plots = TimePlots(self._moved, self._cursor)
        self.frame = FramePlot()
        self.see = Widgets([*trials.items], who)
        if trials.ranked:
            self.see.first.label = "most change first"
        self._connect()
        doc.title = "SlipLab review"
        doc.add_root(self.see.layout(self.plots.moved, self.plots.rate, self.frame.plot))
        doc.add_periodic_callback(self._look_again, REFRESH_MS)
        doc.on_session_destroyed(lambda _: self.close())
        doc.js_on_event(DocumentReady, self.see.keyboard, self.see.choosing, self.plots.drag)
        self._fill()
        doc.add_next_tick_callback(lambda: self._step(1))

    def _connect(self) -> None:
        """Connect each control to its action."""
        see = self.see
        for item in (see.campaign, see.state, see.text):
            item.on_change("value", lambda attr, old, new: self._fill())
        see.first.on_change("active", lambda attr, old, new: self._fill())
        see.source.selected.on_change("indices", lambda attr, old, new: self._mark())
        see.picked.on_change("value", self._picked)
        see.pressed.on_change("value", self._key)
        for verdict, button in see.buttons.items():
            button.on_click(partial(self._decide, verdict))
        see.zoom.on_click(self._zoom)
        see.no_incipient.on_click(lambda: self.plots.put("incipient", None))
        see.no_gross.on_click(lambda: self.plots.put("gross", None))
        see.back.on_click(self._reset_lines)

    # the list

    def _fill(self) -> None:
        """List the rows that pass the filters; the trial that is shown stays."""
        campaign = "" if self.see.campaign.value == ALL else self.see.campaign.value
        state = "" if self.see.state.value == ALL else self.see.state.value
        self._rows = filtered_rows(
            self.trials.rows,
            campaign=campaign,
            state=state,
            text=self.see.text.value,
            doubtful_first=bool(self.see.first.active),
        )
        columns = as_columns(self._rows)
        if columns != dict(self.see.source.data):
            self.see.source.data = columns
        self._mark()
        left = sum(item.state in {"open", "stale"} for item in self._rows)
        self._head()
        self.see.count.text = f"{plural(len(self._rows), 'trial')}, {left} to review"

    def _head(self) -> None:
        if self.shown is not None:
            place = self._place()
            position = "" if place is None else f"{place + 1} of {len(self._rows)}"
            self.see.heading.text = heading_html(self.shown, position)

    def _place(self) -> int | None:
        names = [item.name for item in self._rows]
        return names.index(self._requested) if self._requested in names else None

    def _mark(self) -> None:
        """Mark the row of the requested trial, and no other."""
        here = self._place()
        self.see.source.selected.indices = [] if here is None else [here]

    def _picked(self, _: str, __: str, new: str) -> None:
        """Choose the row that was pressed in the browser, by name: the list may have changed."""
        campaign, trial, _count = json.loads(new)
        there = {item.name: item for item in self.trials.rows}
        if (campaign, trial) in there:
            self._choose(there[campaign, trial])

    def _step(self, by: int) -> None:
        """Choose the next row, or the one before."""
        if not self._rows:
            return
        here = self._place()
        there = 0 if here is None else min(max(here + by, 0), len(self._rows) - 1)
        self._choose(self._rows[there])

    def _look_again(self) -> None:
        """Look for decisions of others and for new trials."""
        if not self._looking:
            self._looking = True
            self._background.run(self.trials.refresh, self._renewed, otherwise=self._looked)

    def _looked(self) -> None:
        self._looking = False

    def _renewed(self, _: bool) -> None:
        self._looked()
        if self.trials.rows is self._listed:
            return
        self._listed = self.trials.rows
        self._fill()
        there = {item.name: item for item in self.trials.rows}
        if self.shown is not None and there.get(self.shown.row.name, self.shown.row) != (
            self.shown.row
        ):
            self._choose(there[self.shown.row.name])

    # one trial

    def _choose(self, item: ReviewRow) -> None:
        """Read a trial in the background, then show it."""
        self._requested = item.name
        self._mark()
        campaign = self.trials.items[item.campaign]
        self._background.run(lambda: load_trial(self.trials.store, campaign, item), self._show)

    def _show(self, found: ShownTrial) -> None:
        if found.row.name != self._requested:
            self._drop(found)
            return
        again = self.shown is not None and self.shown.row.name == found.row.name
        retained = self.plots.onsets() if again and self._is_moved() else None
        self._drop(self.shown)
        self.shown = found
        decided = self._history()
        self.frame.frame_to(found)
        self._close_by = False
        self.plots.show(found, retained or self._lines_of(found, decided))
        if not again:
            self.see.reason.value = ""
        self._head()
        self.see.flags.text = flags_html(found)
        self.see.past.text = history_html(decided, found.row.key)
        self._moved()
        able = found.row.label == "fresh" and not found.row.problem
        for button in self.see.buttons.values():
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

    def _lines_of(self, shown: ShownTrial, decided: list[review.Decision]) -> ReviewedOnsets:
        """Return where the lines begin: as adjusted, else as the label has or suggests them."""
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
        """Zoom to the cursor, or back."""
        if self.shown is None:
            return
        self._close_by = not self._close_by and self._frame is not None
        time = float(self.shown.frame_s[self._frame or 0]) if self._close_by else None
        self.plots.zoom(time, self.shown.threshold_px)

    def _moved(self) -> None:
        if self.shown is not None:
            self.see.lines.text = lines_html(self.shown, self.plots.onsets())

    # the frame under the cursor

    def _cursor(self, time_s: float) -> None:
        if self.shown is None or (index := self.shown.frame_at(time_s)) < 0:
            return
        self._frame = index
        self.plots.cursor(float(self.shown.frame_s[index]))
        if not self._drawing:
            self._draw()

    def _draw(self) -> None:
        """Read the requested frame in the background; the newest request counts."""
        shown, index = self.shown, self._frame
        if shown is None or index is None:
            return
        self._drawing = True

        def done(picture: U8 | None) -> None:
            self._drawing = False
            if self.shown is shown:
                self.see.caption.text = escape(self.frame.draw(shown, index, picture))
            if (self.shown, self._frame) != (shown, index):
                self._draw()

        self._background.run(lambda: shown.picture(index), done, otherwise=lambda: done(None))

    # decisions

    def _decide(self, verdict: Verdict) -> None:
        shown = self.shown
        if shown is None or self.see.buttons["accept"].disabled:
            return
        try:
            made = record_verdict(
                self.trials,
                shown,
                verdict,
                self.plots.onsets(),
                self.see.who.value,
                self.see.reason.value,
            )
        except (LabelChanged, review.Overtaken) as error:
            self._say(f"Not saved: {error}. Review it and decide again.")
            self._choose(self.trials.renew(shown.row))
            return
        except (ValueError, OSError, StoreError) as error:
            self._say(f"Not saved: {error}")
            return
        shown.row = self.trials.renew(shown.row)
        self._say(f"{shown.row.trial}: {made}", good=True)
        self.plots.place(made.new if verdict == "adjust" else shown.suggested)
        after = self._after() if self.see.go_on.active and verdict != "reopen" else None
        self._fill()
        self._choose(after or shown.row)

    def _after(self) -> ReviewRow | None:
        """Return the row below the one that is shown; None at the end."""
        here = self._place()
        following = [] if here is None else self._rows[here + 1 : here + 2]
        return following[0] if following else None

    def _key(self, _: str, __: str, new: str) -> None:
        """Act on a key that was pressed in the browser."""
        name = new.partition(" ")[0]
        if name in self.see.buttons:
            self._decide(name)
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

    def _say(self, text: str, *, good: bool = False) -> None:
        self.see.stated.text = f"<p class='{'good' if good else 'bad'}'>{escape(text)}</p>"

    def close(self) -> None:
        """Close what the tab has open; the tab is gone."""
        self._drop(self.shown)
        self._background.close()
        self.shown = None

    def _drop(self, shown: ShownTrial | None) -> None:
        """Close a trial's video, in the thread that reads it."""
        if shown is not None:
            self._background.run(shown.close)


class Background:
    """Runs work of one tab in another thread, and brings its result back to the tab.

    Args:
        pool: does the work; on_error: called in the tab with an error's message.
    """

    def __init__(self, doc: Document, pool: Executor, on_error: Callable[[str], None]) -> None:
        self._doc, self._pool, self._on_error = doc, pool, on_error
        self._closed = False

    def run(
        self,
        work: Callable[[], Any],
        then: Callable[[Any], None] = lambda _: None,
        otherwise: Callable[[], None] = lambda: None,
    ) -> None:
        """Do `work` in the pool, and `then` with its result in the tab, or `otherwise`."""

        def back(done: Future[Any]) -> None:
            if not self._closed:
                self._doc.add_next_tick_callback(partial(finish, done))

        def finish(done: Future[Any]) -> None:
            error = done.exception()
            if error is None:
                then(done.result())
            else:
                self._on_error(f"{type(error).__name__}: {error}")
                otherwise()

        self._pool.submit(work).add_done_callback(back)

    def close(self) -> None:
        """Drop all results from now on: the tab is gone."""
        self._closed = True
