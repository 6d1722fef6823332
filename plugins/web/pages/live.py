"""The live page: what runs, how far the campaign is, last pictures, the last trial's curves.

One reader serves all viewers: what it reads is rendered once and sent to each as server-sent
events. It runs while at least one viewer is there.
"""

from __future__ import annotations

import asyncio
import json
import shutil
import time
from collections.abc import AsyncIterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, field
from datetime import datetime
from typing import TYPE_CHECKING

from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response, StreamingResponse
from starlette.routing import BaseRoute, Route

from sliplab.analysis.campaigns import Collected
from sliplab.flows.collecting.live_feed import PICTURES, STATE, LiveFolder
from sliplab.flows.running.console import duration, size
from sliplab.flows.status import CampaignStatus, StatusReader, StoreStatus
from sliplab.plugins.web.pages.controls import Controls
from sliplab.plugins.web.pages.gates import gate_texts
from sliplab.plugins.web.pages.trial_curves import curves_json
from sliplab.plugins.web.trial_data import load_trial
from sliplab.protocols.errors import InputError
from sliplab.storage.errors import StoreError
from sliplab.storage.streams import SCALAR, Json
from sliplab.storage.trials.recording import Recording

if TYPE_CHECKING:
    from sliplab.plugins.web.pages.web import Web

TICK_S = 0.5
"""Interval at which the collection's files are looked at, s."""
STATUS_S = 5.0
"""Interval at which the store is read, s."""
CURVES_S = 15.0
"""Shortest interval between the curves of two trials, s: a simulated rig takes several a second."""
MOST_VIEWERS = 32
ALIVE_S = 15.0
"""Longest silence of a stream, s; a proxy would close it."""


def routes(web: Web) -> list[BaseRoute]:
    """Return the routes of this subject."""
    hub = Hub(web)
    controls = Controls(web)

    async def show(request: Request) -> Response:
        return web.render(
            request, "live.html", title="Live", protocols=controls.protocols(), **hub.first()
        )

    async def stream(request: Request) -> Response:
        if hub.full:
            return PlainTextResponse(f"{MOST_VIEWERS} viewers are here already\n", 503)
        headers = {"cache-control": "no-store", "x-accel-buffering": "no"}
        return StreamingResponse(hub.stream(), media_type="text/event-stream", headers=headers)

    return [Route("/", show), Route("/live", stream), *controls.routes()]


@dataclass(eq=False)
class _Viewer:
    """One stream: what was not sent yet, the newest of each kind; a slow viewer skips others."""

    pending: dict[str, str] = field(default_factory=dict)
    news: asyncio.Event = field(default_factory=asyncio.Event)

    def put(self, kind: str, text: str) -> None:
        """Leave something to be sent."""
        self.pending[kind] = text
        self.news.set()


@dataclass(frozen=True)
class LastTrial:
    """The last committed trial of a campaign.

    Attributes:
        clocks: the gates of its clocks, in words.
        readings: last values of its sensors, such as temperatures, with their units.
    """

    campaign: str
    trial: str
    clocks: list[str]
    readings: list[tuple[str, str]]


class Hub:
    """Reads the store and the collection, and sends what changed to all viewers."""

    def __init__(self, web: Web) -> None:
        self._web, self._live = web, LiveFolder(web.store.folder)
        self._reader = StatusReader(web.store)
        self._viewers: set[_Viewer] = set()
        self._latest: dict[str, str] = {}
        self._left = asyncio.Event()
        self._task: asyncio.Task[None] | None = None
        self._status: StoreStatus | None = None
        self._read_at = self._curves_at = 0.0
        self._seen: dict[str, int] = {}
        self._last: LastTrial | None = None
        # one thread: nothing that other pages read waits for this, or the reverse
        self._thread = ThreadPoolExecutor(1, "live")

    @property
    def full(self) -> bool:
        """Return whether no further viewer is taken."""
        return len(self._viewers) >= MOST_VIEWERS

    def first(self) -> Json:
        """Return what is known before the stream begins."""
        return {"now": self._latest.get("now", ""), "campaigns": self._latest.get("status", "")}

    async def stream(self) -> AsyncIterator[str]:
        """Return the events of one viewer, until it leaves."""
        async with self._viewer() as viewer:
            while True:
                try:
                    await asyncio.wait_for(viewer.news.wait(), ALIVE_S)
                except TimeoutError:
                    yield ": alive\n\n"
                    continue
                viewer.news.clear()
                sent, viewer.pending = viewer.pending, {}
                for kind, text in sent.items():
                    yield event(kind, text)

    @asynccontextmanager
    async def _viewer(self) -> AsyncIterator[_Viewer]:
        viewer = _Viewer()
        for kind, text in self._latest.items():
            viewer.put(kind, text)
        self._viewers.add(viewer)
        self._left.clear()
        if self._task is None or self._task.done():
            self._task = asyncio.create_task(self._run())
        try:
            yield viewer
        finally:
            self._viewers.discard(viewer)
            if not self._viewers:
                self._left.set()

    async def _run(self) -> None:
        """Read and send while somebody watches."""
        loop = asyncio.get_running_loop()
        while self._viewers:
            began = time.monotonic()
            try:
                found = await loop.run_in_executor(self._thread, self._tick, began)
            except Exception as error:  # whatever is wrong with the store, the page goes on
                found = {"problem": str(error) or type(error).__name__}
            for kind, text in found.items():
                if self._latest.get(kind) != text:
                    self._latest[kind] = text
                    for viewer in self._viewers:
                        viewer.put(kind, text)
            rest_s = max(TICK_S - (time.monotonic() - began), TICK_S / 5)
            with suppress(TimeoutError):
                await asyncio.wait_for(self._left.wait(), rest_s)
        # the next viewer must not see an old state
        self._latest, self._seen, self._status, self._last = {}, {}, None, None
        self._curves_at = 0.0

    def _tick(self, now: float) -> dict[str, str]:
        """Return what may have changed, by kind; in the thread."""
        self._live.watch()
        found = {}
        state = self._new(STATE)
        if state is not None:
            found["now"] = self._now(state)
        pictures = self._new(PICTURES)
        if pictures:
            found["pictures"] = pictures
        if now - self._read_at >= STATUS_S or self._status is None:
            self._read_at = now
            status = self._reader.read()
            self._status = status
            campaign = shown_campaign(status)
            self._look_at_last(campaign, found, now)
            found["status"] = self._web.part(
                "live_status.html",
                status=status,
                shown=campaign,
                last=self._last,
                facts=facts(campaign),
                disk_words=disk_words(status, campaign),
                causes=causes(campaign),
                waiting=self._live.waiting(),
                disk=shutil.disk_usage(self._web.store.folder),
            )
            found["problem"] = ""
            written = self._seen.get(STATE, 0) / 1e9
            killed = status.running is None and time.time() - written > STATUS_S
            if killed or ("now" not in found and not written):  # killed: the file stayed
                found["now"] = self._now("")
        return found

    def _new(self, name: str) -> str | None:
        """Return the text of a file of the collection; None of one that has not changed."""
        stamp, text = self._live.read(name)
        if self._seen.get(name) == stamp:
            return None
        self._seen[name] = stamp
        return text

    def _now(self, text: str) -> str:
        state: Json = {"trial": "", "lines": []}
        with suppress(ValueError):
            state |= json.loads(text) if text else {}
        until = state.get("until")
        ends = datetime.fromtimestamp(until).astimezone().isoformat() if until else None
        return self._web.part("live_now.html", state=state, ends=ends, status=self._status)

    def _look_at_last(
        self, campaign: CampaignStatus | None, found: dict[str, str], now: float
    ) -> None:
        """Note the newest trial of the campaign, and render its curves if they are due."""
        if campaign is None or not campaign.committed:
            return
        where = self._web.store.campaign(campaign.campaign)
        trial = max(where.folders("trials"), key=lambda path: path.stat().st_mtime_ns).name
        known = self._last
        if known is not None and (known.campaign, known.trial) == (where.name, trial):
            return
        if self._curves_at and now - self._curves_at < CURVES_S:
            return
        self._curves_at = now
        try:
            recording = where.recording(trial)
            clocks = [
                f"{gate.name} {gate.text}"
                for gate in gate_texts(recording.record.quality.gates)
                if gate.name.endswith(" clock")
            ]
            self._last = LastTrial(where.name, trial, clocks, readings(recording))
            shown = load_trial(self._web.store, Collected(where), trial)
            curves = {"trial": f"{where.name} / {trial}", **curves_json(shown, None, "")}
            found["curves"] = json.dumps(curves)
        except (StoreError, InputError, ValueError) as error:
            found["problem"] = str(error)


def event(kind: str, text: str) -> str:
    """Return one server-sent event."""
    lines = "".join(f"data: {line}\n" for line in text.splitlines() or [""])
    return f"event: {kind}\n{lines}\n"


def shown_campaign(status: StoreStatus) -> CampaignStatus | None:
    """Return the campaign that is collected, else the one that was collected last."""
    sound = [item for item in status.campaigns if item.problem is None]
    for item in sound:
        if item.campaign == status.collects:
            return item
    return max(sound, key=lambda item: item.last_ended or "", default=None)


def causes(campaign: CampaignStatus | None) -> list[tuple[int, str]]:
    """Return why trials are set aside: number and cause, most frequent first."""
    counts: dict[str, int] = {}
    for item in () if campaign is None else campaign.excluded:
        by = f"{item['by']}: " if item["by"] else ""
        counts[by + item["cause"]] = counts.get(by + item["cause"], 0) + 1
    return sorted(((n, cause) for cause, n in counts.items()), reverse=True)


def facts(item: CampaignStatus | None) -> list[tuple[str, str]]:
    """Return the figures of a campaign as pairs of a name and a text."""
    found = []
    if item is not None and item.missing:
        found.append(("Time left", _time_left(item)))
        if item.nights_left is not None:
            found.append(("Nights left", _nights_left(item)))
    if item is not None and item.nights:
        found.append(("Night", f"{item.nights}, {item.tonight} trials in the current one"))
    return found


def disk_words(status: StoreStatus, item: CampaignStatus | None) -> str:
    """Return how much of the disk is free, and for how many nights that is enough."""
    words = f"{size(status.disk_free)} free"
    if item is not None and item.nights_of_disk is not None:
        words += f", enough for {item.nights_of_disk:.0f} nights"
    return words


def _time_left(item: CampaignStatus) -> str:
    if item.seconds_left is None:
        return "not known before two trials in a row"
    text = duration(item.seconds_left)
    if item.seconds_left_error is not None:
        text += f" ± {duration(item.seconds_left_error)}"
    return f"{text} at the rig"


def _nights_left(item: CampaignStatus) -> str:
    left = item.nights_left
    assert left is not None
    text = str(left.expected)
    if left.low is not None:
        text += f" ({left.low} to {left.high or 'many'}, 90 %)"
    return (
        f"{text}, until {left.last}"
        if left.first == left.last
        else (f"{text}, until {left.first} to {left.last}")
    )


def readings(recording: Recording) -> list[tuple[str, str]]:
    """Return the last value of each sensor of one quantity."""
    found = []
    for name, about in sorted(recording.record.streams.items()):
        if about.kind == SCALAR.name and about.rows:
            read = recording.scalars(name)
            found.append((name, f"{read.value[-1]:.1f} {read.unit.replace('degC', '°C')}"))
    return found
