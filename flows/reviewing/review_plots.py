"""The review page's plots over time: displacements with onset lines to drag, and the event rate."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import numpy as np
from bokeh.models import ColumnDataSource, CustomJS, Label, NumeralTickFormatter, Range1d, Span
from bokeh.plotting import figure

from sliplab.analysis.report.figures.style import BLUE, GREY, ORANGE, RED
from sliplab.flows.reviewing.review_trial import Shown
from sliplab.storage.trials.review import Onsets

Kind = Literal["incipient", "gross"]
KINDS: tuple[Kind, Kind] = ("incipient", "gross")
COLOUR = {"incipient": ORANGE, "gross": RED}
_FAINT = "#b8bec4"
_CLOSE_S = 0.3
"""Half of what is seen close by."""
_DRAG = """
const view = Bokeh.index.find_one(plot);
if (!view || plot.sliplab_drag) return;
plot.sliplab_drag = true;
let held = null;
const scale = () => view.frame.x_scale;
const place = (event) => event.clientX - view.el.getBoundingClientRect().left;
const nearest = (event) => {
  const far = (line) => Math.abs(scale().compute(line.location) - place(event));
  return lines.filter((line) => line.visible && far(line) < 9).sort((a, b) => far(a) - far(b))[0];
};
view.el.addEventListener("pointerdown", (event) => {
  held = event.button == 0 ? nearest(event) : null;
}, true);
view.el.addEventListener("pointermove", (event) => {
  view.el.style.cursor = held || nearest(event) ? "ew-resize" : "";
}, true);
window.addEventListener("pointermove", (event) => {
  if (held) held.location = scale().invert(place(event));
}, true);
window.addEventListener("pointerup", () => { held = null; }, true);
"""
"""Bokeh's own editable lines are caught within 2 pixels only, and beside where they are drawn."""
_STEP_NS = 100_000
"""Onsets set by hand are kept to a tenth of a millisecond."""


class TimePlots:
    """Two plots over one axis of time.

    Args:
        on_move: called when a person has moved an onset line; on_cursor: with the time, s, that
            the pointer is at.
    """

    def __init__(self, on_move: Callable[[], None], on_cursor: Callable[[float], None]) -> None:
        self._on_move = on_move
        self._quiet = False
        self._held: set[Kind] = set()
        self._exact = Onsets()
        self._texts: dict[Kind, Label] = {}
        self._whole = (0.0, 1.0, 1.0)
        span = Range1d(0, 1)
        tools = "xwheel_zoom,reset"
        common: dict[str, Any] = {
            "x_range": span, "sizing_mode": "stretch_width", "tools": tools,
            "active_scroll": "xwheel_zoom",
            "min_border_left": 62,
        }  # fmt: skip
        # the program sets all ranges: a page that had to find them in data not yet there complains
        self.moved = figure(
            height=330,
            y_axis_label="displacement (px)",
            y_range=Range1d(0, 1),
            toolbar_location="above",
            **common,
        )
        self.rate = figure(
            height=170,
            y_axis_label="events (1/s)",
            y_range=Range1d(0, 1),
            toolbar_location=None,
            x_axis_label="time in the trial (s)",
            **common,
        )
        self.moved.xaxis.visible = False
        self._markers = ColumnDataSource({"xs": [], "ys": [], "colour": [], "width": []})
        self.moved.multi_line(
            "xs", "ys", source=self._markers, line_color="colour", line_width="width"
        )
        self._crossings = ColumnDataSource({"x": [], "y": [], "low": [], "high": []})
        self.moved.segment("low", "y", "high", "y", source=self._crossings, line_color=BLUE)
        self.moved.scatter(
            "x", "y", source=self._crossings, size=5, color=BLUE, legend_label="slip of a marker"
        )
        self._threshold = Span(dimension="width", line_color=GREY, line_dash="dotted")
        self.moved.add_layout(self._threshold)
        self._events = ColumnDataSource({"x": [], "y": []})
        self.rate.step("x", "y", source=self._events, mode="center", line_color=BLUE)
        self.rate.yaxis.formatter = NumeralTickFormatter(format="0,0")
        for plot in (self.moved, self.rate):
            plot.on_event("mousemove", lambda event: on_cursor(float(event.x)))
            plot.xgrid.grid_line_alpha = plot.ygrid.grid_line_alpha = 0.4
        named = (("centre marker", RED, 2.0), ("first marker to slip", ORANGE, 1.6),
                  ("other markers", _FAINT, 1.0))  # fmt: skip
        for text, colour, width in named:
            self.moved.line([0], [np.nan], color=colour, line_width=width, legend_label=text)
        legend = self.moved.legend[0]
        legend.update(
            orientation="horizontal", label_text_font_size="11px", padding=2, border_line_width=0,
            spacing=12,
        )  # fmt: skip
        self.moved.add_layout(legend, "above")
        self.moved.title.align, self.moved.title.text_color = "right", GREY
        self.moved.title.text_font_style = "italic"
        self._cursors = [_line(GREY, 1), _line(GREY, 1)]
        self._motion = [_line(GREY, 1, "dashed"), _line(GREY, 1, "dashed")]
        self.lines: dict[Kind, Span] = {}
        self._automatic: dict[Kind, Span] = {}
        self._below: dict[Kind, Span] = {}
        for kind in KINDS:
            self._add_onset(kind)
        self.drag = CustomJS(args={"plot": self.moved, "lines": [*self.lines.values()]}, code=_DRAG)
        for pair in (self._cursors, self._motion):
            for plot, line in zip((self.moved, self.rate), pair, strict=True):
                plot.add_layout(line)

    def _add_onset(self, kind: Kind) -> None:
        colour = COLOUR[kind]
        self._automatic[kind] = _line(colour, 1, "dashed")
        self._below[kind] = _line(colour, 2)
        line = Span(
            dimension="height", location=0, visible=False, name=f"onset {kind}",
            line_color=colour, line_width=3, line_alpha=0.9, level="overlay",
        )  # fmt: skip
        text = Label(
            x=0, y=0, text=f"{kind} \u2194", text_color=colour, text_font_size="12px",
            text_font_style="bold", visible=False, background_fill_color="white",
            background_fill_alpha=0.7, x_offset=5, y_offset=-18 if kind == "incipient" else -36,
        )  # fmt: skip
        follow = CustomJS(
            args={"text": text, "below": self._below[kind]},
            code="text.x = cb_obj.location; below.location = cb_obj.location;",
        )
        line.js_on_change("location", follow)
        line.js_link("visible", text, "visible")
        line.js_link("visible", self._below[kind], "visible")
        line.on_change("location", lambda attr, old, new: self._dragged(kind))
        for item in (self._automatic[kind], line, text):
            self.moved.add_layout(item)
        self.rate.add_layout(self._below[kind])
        self.lines[kind] = line
        self._texts[kind] = text

    def _dragged(self, kind: Kind) -> None:
        if not self._quiet:
            self._held.discard(kind)
            self._on_move()

    def show(self, shown: Shown, onsets: Onsets) -> None:
        """Another trial, with the onset lines there."""
        self.moved.title.text = "simulated" if shown.recording.simulated else ""
        moved = shown.displacement_px
        count = moved.shape[1]
        first = None if shown.label is None else shown.label.first_marker
        order = sorted(range(count), key=lambda i: (i == shown.centre, i == first))
        self._markers.data = {
            "xs": [shown.frame_s] * count,
            "ys": [moved[:, i] for i in order],
            "colour": [RED if i == shown.centre else ORANGE if i == first else _FAINT
                       for i in order],
            "width": [2.0 if i == shown.centre else 1.6 if i == first else 1.0 for i in order],
        }  # fmt: skip
        self._crossings.data = _crossings(shown)
        self._events.data = {"x": shown.rate_s, "y": shown.rate}
        self._threshold.location = shown.threshold_px
        start, end = shown.span_s
        self.moved.x_range.update(reset_start=start, reset_end=end, bounds=(start, end))
        top = float(np.nanmax(moved, initial=2 * shown.threshold_px))
        self._whole = (start, end, top)
        self.moved.y_range.update(reset_start=-0.02 * top, reset_end=1.05 * top)
        self.zoom(None, shown.threshold_px)
        most = 1.1 * float(np.max(shown.rate, initial=1.0))
        self.rate.y_range.update(start=0, end=most, reset_start=0, reset_end=most)
        for line in self._motion:
            line.update(location=shown.motion_s[0], visible=True)
        for kind in KINDS:
            known = getattr(shown.onsets, f"{kind}_ns")
            self._automatic[kind].update(location=(known or 0) / 1e9, visible=known is not None)
        self.place(onsets)

    def zoom(self, time_s: float | None, threshold_px: float) -> None:
        """Look closely at some time and at what is small, or at all of it again."""
        start, end, top = self._whole
        if time_s is not None:
            start, end = max(start, time_s - _CLOSE_S), min(end, time_s + _CLOSE_S)
            top = min(top, 5 * threshold_px)
        self.moved.x_range.update(start=start, end=end)
        self.moved.y_range.update(start=-0.02 * top, end=1.05 * top)
        for text in self._texts.values():
            text.y = 1.05 * top

    def place(self, onsets: Onsets) -> None:
        """Put the lines there, without telling that somebody moved them."""
        self._quiet = True
        try:
            self._exact = onsets
            self._held = set(KINDS)
            for kind in KINDS:
                time = getattr(onsets, f"{kind}_ns")
                line, text = self.lines[kind], self._texts[kind]
                if time is not None:
                    line.location = text.x = self._below[kind].location = time / 1e9
                line.visible = text.visible = self._below[kind].visible = time is not None
        finally:
            self._quiet = False

    def put(self, kind: Kind, time_s: float | None) -> None:
        """Put one line somewhere, or take it away, for a person."""
        now = self.onsets()
        time = None if time_s is None else _rounded(time_s)
        values = {f"{other}_ns": getattr(now, f"{other}_ns") for other in KINDS}
        self.place(Onsets(**{**values, f"{kind}_ns": time}))
        self._on_move()

    def onsets(self) -> Onsets:
        """Where the lines are; one that was not moved keeps its time to the nanosecond."""
        found: dict[str, int | None] = {}
        for kind in KINDS:
            line = self.lines[kind]
            if kind in self._held or not line.visible:
                found[f"{kind}_ns"] = getattr(self._exact, f"{kind}_ns") if line.visible else None
            else:
                found[f"{kind}_ns"] = _rounded(float(line.location))
        return Onsets(**found)

    def cursor(self, time_s: float) -> None:
        """Mark the time of the frame that is shown."""
        for line in self._cursors:
            line.update(location=time_s, visible=True)


def _line(colour: str, width: int, dash: str = "solid") -> Span:
    return Span(
        dimension="height", location=0, visible=False, line_color=colour, line_width=width,
        line_dash=dash,
    )  # fmt: skip


def _rounded(time_s: float) -> int:
    return round(time_s * 1e9 / _STEP_NS) * _STEP_NS


def _crossings(shown: Shown) -> dict[str, Any]:
    """When each marker slips by the label, with its interval where the label has one."""
    label = shown.label
    times = np.asarray(() if label is None else label.per_marker_ns, np.float64)
    there = times >= 0
    low = high = times
    if label is not None and label.rule == "change_point" and label.change_point is not None:
        bounds = label.change_point
        low, high = (np.asarray(bound, np.float64) for bound in (bounds.low_ns, bounds.high_ns))
    height = np.full(int(there.sum()), shown.threshold_px)
    return {
        "x": times[there] / 1e9, "y": height, "low": low[there] / 1e9, "high": high[there] / 1e9
    }  # fmt: skip
