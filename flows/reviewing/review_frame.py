"""The review page's picture: the frame under the cursor with its tracks, or a sketch of them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from bokeh.models import ColumnDataSource, LinearColorMapper, Range1d
from bokeh.palettes import grey
from bokeh.plotting import figure

from sliplab.analysis.report.figures.style import BLUE, GREEN, ORANGE, RED
from sliplab.flows.reviewing.review_trial import Shown
from sliplab.storage.schema.trial import Point
from sliplab.storage.streams import U8

_TAIL_FRAMES = 60
"""How many earlier frames a track is drawn through."""
_RING = 0.2
"""Radius of a ring around a marker, as a share of the skin's spacing."""
_DARK = "#20262c"


class FramePlot:
    """One frame; drawn for the trial that is shown."""

    def __init__(self) -> None:
        self.plot = figure(
            height=400, width=400, match_aspect=True, tools="pan,wheel_zoom,reset",
            x_range=Range1d(0, 1), y_range=Range1d(0, 1), toolbar_location="right",
            background_fill_color=_DARK, active_scroll="wheel_zoom",
        )  # fmt: skip
        self.plot.axis.visible = False
        self.plot.grid.visible = False
        self._picture = ColumnDataSource({"image": [], "w": [], "h": []})
        self.plot.image(
            "image", x=0, y=0, dw="w", dh="h", source=self._picture,
            color_mapper=LinearColorMapper(palette=grey(256), low=0, high=255),
        )  # fmt: skip
        self._tails = ColumnDataSource({"xs": [], "ys": []})
        self.plot.multi_line("xs", "ys", source=self._tails, line_color=GREEN, line_width=1.5)
        self._rings = ColumnDataSource({"x": [], "y": [], "r": [], "colour": []})
        self.plot.circle(
            "x", "y", radius="r", source=self._rings, fill_alpha=0.0, line_color="colour",
            line_width=2,
        )  # fmt: skip
        self._plate = ColumnDataSource({"x": [], "y": []})
        self.plot.scatter("x", "y", source=self._plate, marker="x", size=14, color=ORANGE)
        self._size = (0, 0)

    def frame_to(self, shown: Shown) -> None:
        """Fit the plot to another trial's frames."""
        width, height = shown.recording.frame_px
        self._size = (int(width), int(height))
        for axis, size in ((self.plot.x_range, width), (self.plot.y_range, height)):
            axis.update(start=0, end=int(size), reset_start=0, reset_end=int(size))
        self.clear()

    def clear(self) -> None:
        """Nothing to see."""
        self._picture.data = {"image": [], "w": [], "h": []}
        self._tails.data = {"xs": [], "ys": []}
        self._rings.data = {"x": [], "y": [], "r": [], "colour": []}
        self._plate.data = {"x": [], "y": []}

    def draw(self, shown: Shown, index: int, picture: U8 | None) -> str:
        """Show one frame, with its picture where there is one.

        Returns:
            what is seen, in words.
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
            **self._there(places[seen]),
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
            self._plate.data = self._there(plate[np.isfinite(plate).all(axis=1)])
        return _words(shown, index, np.flatnonzero(~seen))

    def _there(self, places: np.ndarray) -> dict[str, np.ndarray]:
        """Pixels, rows downwards, on the plot, whose y goes up."""
        return {"x": places[:, 0] + 0.5, "y": self._size[1] - places[:, 1] - 0.5}


def _spacing_mm(skin_mm: Sequence[Point]) -> float:
    """Distance of the centre's nearest neighbour."""
    skin = np.asarray(skin_mm)
    away = np.hypot(*(skin[1:] - skin[0]).T) if len(skin) > 1 else np.array([5.6])
    return float(away.min())


def _colour(shown: Shown, index: int, marker: int) -> str:
    moved = shown.displacement_px
    slipped = moved.shape[1] > marker and moved[index, marker] > shown.threshold_px
    if not slipped:
        return BLUE
    return RED if marker == shown.centre else ORANGE


def _words(shown: Shown, index: int, lost: np.ndarray) -> str:
    text = f"frame {index} at {shown.frame_s[index]:.3f} s"
    if not shown.recording.has_video:
        text += ", a sketch of the camera's own tracks: no picture was kept"
    elif shown.xy_px is None:
        text += "; this label keeps no tracks: `sliplab label` makes a newer one"
    if len(lost):
        text += f"; markers not seen: {', '.join(map(str, lost))}"
    return text
