"""What a collection shows while somebody watches: the trial that runs, its phase, last pictures.

    STORE/.live/watched         touched by every page that is watched
    STORE/.live/state.json      the trial, its phase, the last lines for people
    STORE/.live/pictures.json   the last picture of each camera, JPEG in base64
    STORE/.live/waiting.json    runs of the service that wait or have begun, of those with the arm

Nothing here is data: the files are replaced, not flushed, and those of a session deleted with it.
The trial only leaves references to its last chunks; a thread makes pictures of them. While nobody
watches it does nothing but look for `watched`.
"""

from __future__ import annotations

import base64
import json
import os
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sliplab.flows.running import console
from sliplab.protocols.later import Later
from sliplab.storage.process import is_here
from sliplab.storage.streams import (
    EVENTS_KIND,
    FRAMES_KIND,
    U8,
    Chunk,
    EventChunk,
    FrameChunk,
    Json,
    Sink,
)

if TYPE_CHECKING:
    import cv2

    from sliplab.flows.planning.run_request import RunRequest
    from sliplab.protocols import PlannedTrial
    from sliplab.protocols.program import Step
else:
    cv2 = Later("cv2")

THREAD = "live feed"
"""Name of the thread that publishes."""
FOLDER = ".live"
WATCHED, STATE, PICTURES, WAITING = "watched", "state.json", "pictures.json", "waiting.json"
PERIOD_S = 0.5
"""Of new pictures, s."""
WATCHED_S = 5.0
"""Age of `watched` from which nobody watches, s."""
WINDOW_US = 30_000
"""Time of the events in a picture, µs."""
_CHUNKS = 8
"""Last chunks of a camera among which are those of `WINDOW_US`."""
_WIDTH = 400
"""Largest width of a picture, px."""
_QUALITY = 70
_LINES = 5
_DARK, _BRIGHT = (230, 160, 70), (90, 170, 255)
"""Colours of darker and brighter, blue, green, red."""


@dataclass(frozen=True)
class LiveFolder:
    """The files of a store, as a page reads them."""

    store: Path

    @property
    def folder(self) -> Path:
        """Where they are."""
        return self.store / FOLDER

    def watch(self) -> None:
        """Say that somebody watches; a store that cannot be written to shows no pictures."""
        with suppress(OSError):
            self.folder.mkdir(exist_ok=True)
            (self.folder / WATCHED).touch()

    def read(self, name: str) -> tuple[int, str]:
        """Return when a file was written, ns, and its text; 0 and "" where there is none."""
        try:
            with (self.folder / name).open(encoding="utf-8") as file:
                return os.fstat(file.fileno()).st_mtime_ns, file.read()
        except (OSError, UnicodeDecodeError):
            return 0, ""

    def waiting(self) -> list[Json]:
        """Return what is in `WAITING`; nothing where the service that wrote it was killed."""
        try:
            found = json.loads(self.read(WAITING)[1] or "{}")
        except ValueError:
            return []
        runs: list[Json] = found["runs"] if is_here(found.get("process", {})) else []
        return runs

    def write(self, name: str, text: str) -> None:
        """Replace a file; it is not flushed, as it is no data.

        Raises:
            OSError: it cannot be written.
        """
        self.folder.mkdir(exist_ok=True)
        new = self.folder / f"{name}.new"
        new.write_text(text, encoding="utf-8")
        os.replace(new, self.folder / name)


class LiveFeed:
    """Publishes one session.

    Attributes:
        watched: somebody watches now.
    """

    def __init__(self, run_request: RunRequest) -> None:
        self._run_request = run_request
        self._live = LiveFolder(run_request.store)
        self._order = {trial.id: number for number, trial in enumerate(run_request.plan, 1)}
        self.watched = False
        self._state: Json = {}
        self._lines: deque[str] = deque(maxlen=_LINES)
        self._recent: dict[str, tuple[Chunk, ...]] = {}
        self._size: tuple[int, int] | None = None
        self._over = threading.Event()

    def begin(
        self, trial: PlannedTrial, attempt: int, sink: Sink, event_px: tuple[int, int] | None
    ) -> Sink:
        """Note the trial that begins, and return the sink of its streams.

        Args:
            event_px: size of the event camera.
        """
        self._size = event_px
        self._recent = {}
        self._state = {
            "trial": trial.id,
            "number": self._order.get(trial.id),
            "attempt": attempt + 1,
            "began": time.time(),
            "seconds": self._run_request.plan.seconds(trial),
            "condition": self._run_request.plan.describe(trial),
            "phase": "approach",
        }
        return _WatchedSink(sink, self)

    def on_step(self, step: Step) -> None:
        """Note a step of the motion that begins."""
        self._state = {**self._state, "phase": step.phase}

    def on_chunk(self, device: str, chunk: Chunk) -> None:
        """Keep a reference to a camera's chunk for the next picture."""
        self._recent[device] = (*self._recent.get(device, ())[1 - _CHUNKS :], chunk)

    def _publish(self) -> None:
        """Look for viewers, and write what is new for them, until the session ends."""
        written: dict[str, str] = {}
        while not self._over.wait(PERIOD_S):
            try:
                age = time.time() - (self._live.folder / WATCHED).stat().st_mtime
            except OSError:
                age = WATCHED_S
            self.watched = age < WATCHED_S
            if not self.watched:
                self._recent = {}
                continue
            try:
                self._write(written, STATE, self._words())
                if recent := dict(self._recent):
                    self._write(written, PICTURES, json.dumps(self._pictures(recent)))
            except (OSError, ImportError):  # a full disk, no library for pictures
                continue
            except Exception as error:  # a picture is worth no trial
                console.say(f"warning: the page gets no more pictures: {error!r}")
                self.watched = False
                return

    def _words(self) -> str:
        request = self._run_request
        words = {
            "campaign": request.campaign,
            "rig": request.rig.name,
            "simulated": request.rig.simulated,
            "operator": request.metadata.operator,
            "temperature_c": request.metadata.temperature_c,
            "until": request.until,
            "lines": list(self._lines),
            **self._state,
        }
        return json.dumps(words, default=str)

    def _write(self, written: dict[str, str], name: str, text: str) -> None:
        if written.get(name) == text:
            return
        self._live.write(name, text)
        written[name] = text

    def _pictures(self, recent: dict[str, tuple[Chunk, ...]]) -> dict[str, str]:
        found = {}
        for device, chunks in sorted(recent.items()):
            if isinstance(chunks[-1], EventChunk):
                events = [chunk for chunk in chunks if isinstance(chunk, EventChunk)]
                picture = event_picture(events, self._size if device == EVENTS_KIND else None)
            elif isinstance(chunks[-1], FrameChunk):
                picture = frame_picture(chunks[-1])
            found[device] = base64.b64encode(jpeg(picture)).decode()
        return found

    @contextmanager
    def running(self) -> Iterator[None]:
        """Publish while the block runs."""
        thread = threading.Thread(target=self._publish, name=THREAD, daemon=True)
        with console.lines_to(self._lines.append):
            thread.start()
            try:
                yield
            finally:
                self._over.set()
                thread.join(PERIOD_S + 2.0)
                for name in (STATE, PICTURES):
                    with suppress(OSError):
                        (self._live.folder / name).unlink(missing_ok=True)


class _WatchedSink:
    """Passes chunks on, and shows those of cameras to the feed while somebody watches."""

    def __init__(self, sink: Sink, feed: LiveFeed) -> None:
        self._sink, self._feed = sink, feed

    def add(self, device: str, chunk: Chunk) -> None:
        """Append a chunk; raises what the sink raises."""
        self._sink.add(device, chunk)
        if self._feed.watched and chunk.KIND.name in (EVENTS_KIND, FRAMES_KIND) and len(chunk):
            self._feed.on_chunk(device, chunk)


def event_picture(chunks: list[EventChunk], size: tuple[int, int] | None) -> U8:
    """Return a picture of the last `WINDOW_US` of events, shape (height, width, 3).

    Args:
        chunks: in order of time, not empty.
        size: (width, height) of the camera; by default that of the events.
    """
    since = int(chunks[-1].t_us[-1]) - WINDOW_US
    parts = []
    for chunk in chunks:
        parts.append(chunk[int(np.searchsorted(chunk.t_us, since)) :])
    events = EventChunk.concatenate(parts)
    if size is None:
        size = int(events.x.max()) + 1, int(events.y.max()) + 1
    width, height = size
    inside = (events.x < width) & (events.y < height)
    shrunk = -(-width // _WIDTH)  # whole pixels are joined, so that no event is lost
    x, y = events.x[inside] // shrunk, events.y[inside] // shrunk
    picture = np.zeros((-(-height // shrunk), -(-width // shrunk), 3), np.uint8)
    bright = events.p[inside] > 0
    picture[y[~bright], x[~bright]] = _DARK
    picture[y[bright], x[bright]] = _BRIGHT
    return picture


def frame_picture(chunk: FrameChunk) -> U8:
    """Return the last frame, shape (height, width), or its markers where there are only tracks."""
    image = chunk.images[-1]
    if image.size:
        height, width = image.shape
        if width > _WIDTH:
            size = (_WIDTH, max(1, round(height * _WIDTH / width)))
            image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        return image
    points: Any = np.zeros((0, 2)) if chunk.markers_px is None else chunk.markers_px[-1]
    points = points[np.isfinite(points).all(axis=1)]
    least, most = (points.min(axis=0), points.max(axis=0)) if len(points) else (0.0, 1.0)
    scale = (_WIDTH - 40) / max(float(np.max(most - least)), 1.0)
    picture = np.zeros((_WIDTH, _WIDTH), np.uint8)
    for column, row in (points - least) * scale + 20:
        cv2.circle(picture, (round(column), round(row)), 5, 220, -1)
    return picture


def jpeg(picture: U8) -> bytes:
    """Return a picture as JPEG."""
    done, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    if not done:
        raise OSError("the picture cannot be encoded")
    return bytes(data)
