"""One trial for a page's scripts: its curves as JSON, and a frame with its markers as SVG."""

from __future__ import annotations

from base64 import b64encode
from html import escape

import numpy as np

from sliplab.analysis.force import has_forces, plate_forces
from sliplab.analysis.labels.reviewed import state_of
from sliplab.plugins.web.trial_data import ShownTrial, tool_speed
from sliplab.storage.errors import StoreError
from sliplab.storage.streams import F64, SCALAR, WRENCH, Json
from sliplab.storage.trials.review import Decision

MOST_POINTS = 4000
"""Points of a curve; a longer one is drawn by the least and the greatest value of each part."""
TAIL_FRAMES = 60
"""Number of earlier frames through which a track is drawn."""
_ONLY = [("", "only")]
"""Name and kind of the only curve of a panel."""
_RING = 0.2
"""Radius of a ring around a marker, as a share of the skin's spacing."""


def curves_json(shown: ShownTrial, decision: Decision | None, key: str) -> Json:
    """Return what a page draws of a trial over its time line; times as s, exact ones as text in ns.

    A simulation's truth is left out: who reviews a label must not know it.

    Args:
        decision: the last one about its label, if any; key: of the label by the present settings.
    """
    onsets = {"label": shown.onsets, "suggested": shown.suggested}
    if decision is not None and state_of(decision, key) == "adjusted":
        onsets["review"] = decision.new
    return {
        "span": shown.span_s,
        "motion": shown.motion_s[0],
        "threshold": shown.threshold_px,
        "frames": len(shown.frame_ns),
        "panels": _panels(shown),
        "crossings": _crossings(shown),
        "onsets": {
            name: {kind: None if ns is None else str(ns) for kind, ns in vars(both).items()}
            for name, both in onsets.items()
        },
    }


def _panels(shown: ShownTrial) -> list[Json]:
    """Return displacement, event rate, forces, speed and readings, as far as there are any."""
    recording = shown.recording
    found = []
    if shown.displacement_px.shape[1]:
        first = None if shown.label is None else shown.label.first_marker
        order = sorted(
            range(shown.displacement_px.shape[1]), key=lambda i: (i == shown.centre, i == first)
        )
        kinds = ["centre" if i == shown.centre else "first" if i == first else "" for i in order]
        names = {"centre": "centre marker", "first": "first marker to slip", "": "other markers"}
        curves = [(names[kind], kind) for kind in kinds]
        moved = shown.displacement_px[:, order]
        found.append(_panel("displacement", "px", shown.frame_s, moved, curves))
    if len(shown.rate):
        found.append(_panel("events", "1/s", shown.rate_s, shown.rate[:, None], _ONLY))
    for name, about in sorted(recording.record.streams.items()):
        if about.kind == WRENCH.name and has_forces(recording, name):
            forces = plate_forces(recording, name)
            values = np.stack([forces.normal_n, forces.tangential_n], axis=1)
            parts = [("normal", "centre"), ("along the plate", "first")]
            found.append(_panel(name, "N", forces.t_ns / 1e9, values, parts))
    time_s, speed = tool_speed(recording)
    if len(speed):
        found.append(_panel("speed of the tool", "mm/s", time_s, speed[:, None], _ONLY))
    for name, about in sorted(recording.record.streams.items()):
        if about.kind == SCALAR.name and about.rows and name in recording.clocks.devices():
            read = recording.scalars(name)
            time_s = np.asarray(recording.clock(name).to_reference(read.t_ns)) / 1e9
            found.append(_panel(name, read.unit, time_s, read.value[:, None], _ONLY))
    return found


def _panel(name: str, unit: str, time_s: F64, values: F64, curves: list[tuple[str, str]]) -> Json:
    """Return curves over one axis.

    Args:
        values: (n, k); curves: name and kind, which is its colour, of each of the k.
    """
    time_s, values = thinned(time_s, values)
    return {
        "name": name,
        "unit": unit,
        "x": np.round(time_s, 5).tolist(),
        "curves": [
            {"name": title, "kind": kind, "y": _plain(column)}
            for (title, kind), column in zip(curves, values.T, strict=True)
        ],
    }


def thinned(time_s: F64, values: F64) -> tuple[F64, F64]:
    """Return at most about `MOST_POINTS` rows: least and greatest value of parts of equal length.

    Args:
        time_s: (n,); values: (n, k), NaN where unknown.
    """
    if len(time_s) <= MOST_POINTS:
        return time_s, values
    size = -(-2 * len(time_s) // MOST_POINTS)
    starts = np.arange(0, len(time_s), size)
    both = [extreme.reduceat(values, starts, axis=0) for extreme in (np.fmin, np.fmax)]
    middles = np.minimum(starts + size // 2, len(time_s) - 1)
    times = np.stack([time_s[starts], time_s[middles]], axis=1)
    return times.ravel(), np.stack(both, axis=1).reshape(-1, values.shape[1])


def _plain(values: F64) -> list[float | None]:
    return [float(f"{each:.5g}") if each == each else None for each in values.tolist()]


def _crossings(shown: ShownTrial) -> list[tuple[float, float, float]]:
    """Return each marker's slip by the label with its interval, where the label has one, s."""
    label = shown.label
    if label is None:
        return []
    times = np.asarray(label.per_marker_ns, np.float64)
    low = high = times
    if label.rule == "change_point" and label.change_point is not None:
        low, high = (
            np.asarray(bound, np.float64)
            for bound in (label.change_point.low_ns, label.change_point.high_ns)
        )
    there = times >= 0
    found: list[tuple[float, float, float]] = (
        np.stack([times, low, high], axis=1)[there] / 1e9
    ).tolist()
    return found


def frame_html(shown: ShownTrial, index: int) -> str:
    """Return one frame with its markers and their tracks as SVG, and its caption.

    Raises:
        IndexError: the trial has no such frame.
        StoreError: the trial is damaged.
    """
    if not 0 <= index < len(shown.frame_ns):
        raise IndexError(f"{shown.recording.trial_id}: has no frame {index}")
    picture = shown.picture(index)
    places = shown.places(index)
    seen = np.asarray(np.isfinite(places).all(axis=1))
    width, height = _size(shown) if picture is None else picture.shape[::-1]
    image = "" if picture is None else f"<image href='{_png(picture)}'/>"
    text = escape(_caption(shown, index, np.flatnonzero(~seen)))
    return (
        f"<svg viewBox='-0.5 -0.5 {width} {height}' role='img' aria-label='{text}' "
        f"data-frame='{index}' data-time='{shown.frame_s[index]}'>"
        f"{image}{_tails(shown, index)}{_rings(shown, index, seen)}{_plate(shown, index)}</svg>"
        f"<figcaption>{text}</figcaption>"
    )


def _size(shown: ShownTrial) -> tuple[int, int]:
    """Return columns and rows of a frame that was not stored."""
    # without frames, markers are shown where the event camera sees them
    return shown.recording.record.geometry.frame_px or shown.recording.event_px


def _png(picture: np.ndarray) -> str:
    """Return a picture as a URL that contains it."""
    import cv2

    done, packed = cv2.imencode(".png", picture, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if not done:
        raise StoreError("a frame cannot be packed as PNG")
    return "data:image/png;base64," + b64encode(packed.tobytes()).decode()


def _rings(shown: ShownTrial, index: int, seen: np.ndarray) -> str:
    places = shown.places(index)
    geometry = shown.recording.record.geometry
    skin = np.asarray(geometry.skin_mm)
    away = np.hypot(*(skin[1:] - skin[0]).T) if len(skin) > 1 else np.array([5.6])
    radius = _RING * (geometry.px_per_mm or 1.0) * float(away.min())
    return "".join(
        f"<circle class='{_slip(shown, index, i)}' cx='{places[i, 0]:.1f}' cy='{places[i, 1]:.1f}' "
        f"r='{radius:.1f}'/>"
        for i in np.flatnonzero(seen).tolist()
    )


def _tails(shown: ShownTrial, index: int) -> str:
    """Return the tracks of the last frames."""
    if shown.xy_px is None:
        return ""
    tracks = shown.xy_px[max(0, index - TAIL_FRAMES) : index + 1].transpose(1, 0, 2)
    seen = (track[np.isfinite(track).all(axis=1)] for track in tracks)
    lines = (" ".join(f"{x:.1f},{y:.1f}" for x, y in track) for track in seen)
    return "".join(f"<polyline points='{line}'/>" for line in lines)


def _plate(shown: ShownTrial, index: int) -> str:
    if shown.plate_px is None or not np.isfinite(shown.plate_px[index]).all():
        return ""
    x, y = shown.plate_px[index]
    return f"<path d='M{x - 7:.1f} {y - 7:.1f}l14 14m0 -14l-14 14'/>"


def _slip(shown: ShownTrial, index: int, marker: int) -> str:
    moved, threshold = shown.displacement_px, shown.threshold_px
    if threshold is None or moved.shape[1] <= marker or not moved[index, marker] > threshold:
        return "rest"
    return "centre" if marker == shown.centre else "first"


def _caption(shown: ShownTrial, index: int, lost: np.ndarray) -> str:
    text = f"frame {index} at {shown.frame_s[index]:.3f} s"
    if shown.recording.frame_source == "none":
        text = (
            f"slice {index} at {shown.frame_s[index]:.3f} s, as the event camera sees the markers"
        )
    elif not shown.recording.has_video:
        text += ", drawn from the camera's tracks: no video was stored"
    elif shown.xy_px is None:
        text += "; no tracks: `sliplab label` computes them"
    if len(lost):
        text += f"; markers not seen: {', '.join(map(str, lost))}"
    return text
