"""The review page's plots: displacements with onset lines to drag, event rate, camera frame."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from bokeh.models import (
    ColumnDataSource,
    CustomJS,
    Label,
    LinearColorMapper,
    NumeralTickFormatter,
    Range1d,
    Span,
)
from bokeh.palettes import grey
from bokeh.plotting import figure

from sliplab.analysis.report.figures.style import BLUE, GREEN, GREY, ORANGE, RED
from sliplab.flows.ui.review import ShownTrial
from sliplab.storage.schema.trial import Point
from sliplab.storage.streams import U8
from sliplab.storage.trials.review import ReviewedOnsets

Kind = Literal["incipient", "gross"]
KINDS: tuple[Kind, Kind] = ("incipient", "gross")
COLOUR = {"incipient": ORANGE, "gross": RED}
_FAINT = "#b8bec4"
_CLOSE_S = 0.3
"""Half of the interval that is shown when zoomed in, s."""
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
"""Bokeh's own editable lines are caught within 2 pixels only, with an offset from their drawing."""
_RESOLUTION_NS = 100_000
"""Onsets set by hand are rounded to a tenth of a millisecond."""


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
        self._exact = ReviewedOnsets()
        self._texts: dict[Kind, Label] = {}
        self._whole = (0.0, 1.0, 1.0)
        span = Range1d(0, 1)
        tools = "xwheel_zoom,reset"
        common: dict[str, Any] = {
            "x_range": span,
            "sizing_mode": "stretch_width",
            "tools": tools,
            "active_scroll": "xwheel_zoom",
            "min_border_left": 62,
        }
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
        named = (
            ("centre marker", RED, 2.0),
            ("first marker to slip", ORANGE, 1.6),
            ("other markers", _FAINT, 1.0),
        )
        for text, colour, width in named:
            self.moved.line([0], [np.nan], color=colour, line_width=width, legend_label=text)
        legend = self.moved.legend[0]
        legend.update(
            orientation="horizontal",
            label_text_font_size="11px",
            padding=2,
            border_line_width=0,
            spacing=12,
        )
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
            dimension="height",
            location=0,
            visible=False,
            name=f"onset {kind}",
            line_color=colour,
            line_width=3,
            line_alpha=0.9,
            level="overlay",
        )
        text = Label(
            x=0,
            y=0,
            text=f"{kind} \u2194",
            text_color=colour,
            text_font_size="12px",
            text_font_style="bold",
            visible=False,
            background_fill_color="white",
            background_fill_alpha=0.7,
            x_offset=5,
            y_offset=-18 if kind == "incipient" else -36,
        )
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

    def show(self, shown: ShownTrial, onsets: ReviewedOnsets) -> None:
        """Show another trial, with these onset lines."""
        self.moved.title.text = "simulated" if shown.recording.simulated else ""
        moved = shown.displacement_px
        count = moved.shape[1]
        first = None if shown.label is None else shown.label.first_marker
        order = sorted(range(count), key=lambda i: (i == shown.centre, i == first))
        self._markers.data = {
            "xs": [shown.frame_s] * count,
            "ys": [moved[:, i] for i in order],
            "colour": [
                RED if i == shown.centre else ORANGE if i == first else _FAINT for i in order
            ],
            "width": [2.0 if i == shown.centre else 1.6 if i == first else 1.0 for i in order],
        }
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
        """Zoom in to a time and to small displacements, or out to the whole trial."""
        start, end, top = self._whole
        if time_s is not None:
            start, end = max(start, time_s - _CLOSE_S), min(end, time_s + _CLOSE_S)
            top = min(top, 5 * threshold_px)
        self.moved.x_range.update(start=start, end=end)
        self.moved.y_range.update(start=-0.02 * top, end=1.05 * top)
        for text in self._texts.values():
            text.y = 1.05 * top

    def place(self, onsets: ReviewedOnsets) -> None:
        """Move the lines without calling `on_move`."""
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
        """Place or remove one line, as a user would."""
        now = self.onsets()
        time = None if time_s is None else _rounded(time_s)
        values = {f"{other}_ns": getattr(now, f"{other}_ns") for other in KINDS}
        self.place(ReviewedOnsets(**{**values, f"{kind}_ns": time}))
        self._on_move()

    def onsets(self) -> ReviewedOnsets:
        """Return the lines' times; a line that was not moved keeps its time to the nanosecond."""
        found: dict[str, int | None] = {}
        for kind in KINDS:
            line = self.lines[kind]
            if kind in self._held or not line.visible:
                found[f"{kind}_ns"] = getattr(self._exact, f"{kind}_ns") if line.visible else None
            else:
                found[f"{kind}_ns"] = _rounded(float(line.location))
        return ReviewedOnsets(**found)

    def cursor(self, time_s: float) -> None:
        """Mark the time of the frame that is shown."""
        for line in self._cursors:
            line.update(location=time_s, visible=True)


def _line(colour: str, width: int, dash: str = "solid") -> Span:
    return Span(
        dimension="height",
        location=0,
        visible=False,
        line_color=colour,
        line_width=width,
        line_dash=dash,
    )


def _rounded(time_s: float) -> int:
    return round(time_s * 1e9 / _RESOLUTION_NS) * _RESOLUTION_NS


def _crossings(shown: ShownTrial) -> dict[str, npt.NDArray[np.float64]]:
    """Return when each marker slips by the label, with its interval where the label has one."""
    label = shown.label
    times = np.asarray(() if label is None else label.per_marker_ns, np.float64)
    there = times >= 0
    low = high = times
    if label is not None and label.rule == "change_point" and label.change_point is not None:
        bounds = label.change_point
        low, high = (np.asarray(bound, np.float64) for bound in (bounds.low_ns, bounds.high_ns))
    height = np.full(int(there.sum()), shown.threshold_px)
    return {
        "x": times[there] / 1e9,
        "y": height,
        "low": low[there] / 1e9,
        "high": high[there] / 1e9,
    }


_TAIL_FRAMES = 60
"""Number of earlier frames through which a track is drawn."""
_RING = 0.2
"""Radius of a ring around a marker, as a share of the skin's spacing."""
_DARK = "#20262c"


class FramePlot:
    """The camera frame under the cursor with its tracks, or a sketch of the tracks."""

    def __init__(self) -> None:
        self.plot = figure(
            height=400,
            width=400,
            match_aspect=True,
            tools="pan,wheel_zoom,reset",
            x_range=Range1d(0, 1),
            y_range=Range1d(0, 1),
            toolbar_location="right",
            background_fill_color=_DARK,
            active_scroll="wheel_zoom",
        )
        self.plot.axis.visible = False
        self.plot.grid.visible = False
        self._picture = ColumnDataSource({"image": [], "w": [], "h": []})
        self.plot.image(
            "image",
            x=0,
            y=0,
            dw="w",
            dh="h",
            source=self._picture,
            color_mapper=LinearColorMapper(palette=grey(256), low=0, high=255),
        )
        self._tails = ColumnDataSource({"xs": [], "ys": []})
        self.plot.multi_line("xs", "ys", source=self._tails, line_color=GREEN, line_width=1.5)
        self._rings = ColumnDataSource({"x": [], "y": [], "r": [], "colour": []})
        self.plot.circle(
            "x",
            "y",
            radius="r",
            source=self._rings,
            fill_alpha=0.0,
            line_color="colour",
            line_width=2,
        )
        self._plate = ColumnDataSource({"x": [], "y": []})
        self.plot.scatter("x", "y", source=self._plate, marker="x", size=14, color=ORANGE)
        self._size = (0, 0)

    def frame_to(self, shown: ShownTrial) -> None:
        """Fit the plot to another trial's frames."""
        # without frames, markers are shown where the event camera sees them
        width, height = shown.recording.record.geometry.frame_px or shown.recording.event_px
        self._size = (int(width), int(height))
        for axis, size in ((self.plot.x_range, width), (self.plot.y_range, height)):
            axis.update(start=0, end=int(size), reset_start=0, reset_end=int(size))
        self.clear()

    def clear(self) -> None:
        """Empty the plot."""
        self._picture.data = {"image": [], "w": [], "h": []}
        self._tails.data = {"xs": [], "ys": []}
        self._rings.data = {"x": [], "y": [], "r": [], "colour": []}
        self._plate.data = {"x": [], "y": []}

    def draw(self, shown: ShownTrial, index: int, picture: U8 | None) -> str:
        """Show one frame, with its picture where there is one.

        Returns:
            the caption.
        """
        if picture is not None:
            height, width = picture.shape
            self._size = (width, height)
            self._picture.data = {"image": [picture[::-1]], "w": [width], "h": [height]}
        places = shown.places(index)
        seen = np.isfinite(places).all(axis=1)
        geometry = shown.recording.record.geometry
        radius = _RING * (geometry.px_per_mm or 1.0) * _spacing_mm(geometry.skin_mm)
        self._rings.data = {
            **self._on_plot(places[seen]),
            "r": np.full(int(seen.sum()), radius),
            "colour": [_colour(shown, index, i) for i in np.flatnonzero(seen).tolist()],
        }
        tail = slice(max(0, index - _TAIL_FRAMES), index + 1)
        past = np.empty((0, 0, 2)) if shown.xy_px is None else shown.xy_px[tail]
        self._tails.data = {
            "xs": [past[:, i, 0] + 0.5 for i in range(past.shape[1])],
            "ys": [self._size[1] - past[:, i, 1] - 0.5 for i in range(past.shape[1])],
        }
        if shown.plate_px is not None:
            plate = shown.plate_px[index : index + 1]
            self._plate.data = self._on_plot(plate[np.isfinite(plate).all(axis=1)])
        return _caption(shown, index, np.flatnonzero(~seen))

    def _on_plot(self, places: np.ndarray) -> dict[str, np.ndarray]:
        """Convert pixels, rows downwards, to the plot's coordinates, y upwards."""
        return {"x": places[:, 0] + 0.5, "y": self._size[1] - places[:, 1] - 0.5}


def _spacing_mm(skin_mm: Sequence[Point]) -> float:
    """Return the distance of the centre marker's nearest neighbour."""
    skin = np.asarray(skin_mm)
    away = np.hypot(*(skin[1:] - skin[0]).T) if len(skin) > 1 else np.array([5.6])
    return float(away.min())


def _colour(shown: ShownTrial, index: int, marker: int) -> str:
    moved = shown.displacement_px
    slipped = moved.shape[1] > marker and moved[index, marker] > shown.threshold_px
    if not slipped:
        return BLUE
    return RED if marker == shown.centre else ORANGE


def _caption(shown: ShownTrial, index: int, lost: np.ndarray) -> str:
    text = f"frame {index} at {shown.frame_s[index]:.3f} s"
    if shown.recording.frame_source == "none":
        text = (
            f"slice {index} at {shown.frame_s[index]:.3f} s, as the event camera sees the markers"
        )
    elif not shown.recording.has_video:
        text += ", drawn from the camera's tracks: no video was stored"
    elif shown.xy_px is None:
        text += "; this label has no tracks: `sliplab label` computes a new one"
    if len(lost):
        text += f"; markers not seen: {', '.join(map(str, lost))}"
    return text
