"""Progress of a collection: time left, the console's bar, and Prefect's page.

The run's page has its name, a line for each trial, how many are done, and who paused it and why.
A separate thread reports to the server, every few seconds at most, so that neither a batch of
quick trials nor a slow server delays a trial. Failed reports are dropped: the page is only a
view of the store.
"""

from __future__ import annotations

import base64
import contextvars
import logging
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from typing import Any
from uuid import UUID

from sliplab.flows.collecting.supervisor import SessionListener
from sliplab.flows.planning.run_request import CampaignCounts, RunRequest
from sliplab.flows.running import console, orchestration, stopping
from sliplab.protocols import Plan, PlannedTrial
from sliplab.protocols.hashing import hash_text
from sliplab.protocols.shown import plural
from sliplab.storage.streams import Json
from sliplab.storage.trials.store import StoreError, TrialStore

PERIOD_S = 5.0
END_LIMIT_S = 10.0
"""Longest wait for the last report at the end of a collection, s."""
STOP_LIMIT_S = 0.5
"""The same after a stop was requested, s."""
ANSWER_S = 5.0
"""Longest wait for one answer of the server, s."""
LOST_AFTER = 3
"""Number of unanswered reports after which the server counts as lost."""
MOST_POINTS = 300
MOST_LINES = 5000
"""Lines that wait for a server that does not answer."""


class Remaining:
    """Estimates the time left: the planned time left times the ratio of actual to planned so far.

    Trials are not counted, because a slow slide takes many times as long as a fast one.

    Args:
        real_time: True if trials take at least their planned time; then there is an estimate before
            the first one is done.
        clock: returns seconds of a monotonic clock.
    """

    def __init__(
        self,
        plan: Plan,
        trials: Sequence[PlannedTrial],
        *,
        real_time: bool,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._plan, self._clock, self._real_time = plan, clock, real_time
        self._left = sum(plan.seconds(trial) for trial in trials)
        self._planned_done = 0.0
        self._began = clock()

    def add(self, trials: Sequence[PlannedTrial]) -> None:
        """Add trials to take."""
        self._left += sum(self._plan.seconds(trial) for trial in trials)

    def done(self, trial: PlannedTrial) -> None:
        """Note that a trial is over, whatever its outcome."""
        self._left -= self._plan.seconds(trial)
        self._planned_done += self._plan.seconds(trial)

    def pause(self, seconds: float) -> None:
        """Leave out the time of a pause."""
        self._began += seconds

    @property
    def seconds(self) -> float | None:
        """Estimated seconds left; None while nothing is known."""
        if self._planned_done:
            return self._left * (self._clock() - self._began) / self._planned_done
        return self._left if self._real_time else None

    def __str__(self) -> str:
        seconds = self.seconds
        return "" if seconds is None else f"{console.duration(max(seconds, 0.0))} left"


class CollectionProgress(SessionListener):
    """Progress of one collection: trials by outcome, and the time left.

    It is shown as a bar on the console, and read by the thread that reports to Prefect's page.

    Args:
        on_begin: called when the rig is ours and trials are about to be taken.

    Attributes:
        title: names the collection: its campaign, rig and number of trials.
        paused: why it is paused; empty if it is not.
        lines: of its log, with their times; the oldest that the page lacks come first.
    """

    def __init__(self, run_request: RunRequest, on_begin: Callable[[], None]) -> None:
        self._run_request, self._on_begin = run_request, on_begin
        self._total = self._done = 0
        self.outcomes: Counter[str] = Counter()
        self.title = self.paused = ""
        self.lines: deque[tuple[datetime, str]] = deque(maxlen=MOST_LINES)
        self._lock = threading.Lock()
        self._bar: console.ProgressBar
        self._left: Remaining

    @contextmanager
    def begin(self, trials: Sequence[PlannedTrial]) -> Iterator[None]:
        """Show the progress of taking `trials` while the block runs."""
        rig = self._run_request.rig
        self._total = len(trials)
        simulated = "simulated " if rig.simulated else ""
        campaign, count = self._run_request.campaign, plural(len(trials), f"{simulated}trial")
        self.title = f"collect {campaign} on {rig.name}, {count}"
        self._on_begin()
        self._left = Remaining(self._run_request.plan, trials, real_time=not rig.in_virtual_time)
        title = f"collect {campaign} ({simulated}trials)"
        with (
            console.lines_to(self._log),
            console.bar(title, len(trials), str(self._left)) as self._bar,
        ):
            yield

    def _log(self, line: str) -> None:
        self.lines.append((datetime.now(UTC), line))

    def add(self, trials: Sequence[PlannedTrial]) -> None:
        """Add trials that are to be taken as well."""
        with self._lock:
            self._total += len(trials)
        self._left.add(trials)
        self._bar.extend(len(trials))

    def on_trial_done(self, trial: PlannedTrial, outcome: str) -> None:
        """Count a trial that is over.

        Raises:
            KeyboardInterrupt: a stop was requested.
        """
        with self._lock:
            self._done += 1
            self.outcomes[outcome] += 1
        self._left.done(trial)
        self._log(f"{trial.id} {outcome}")
        self._bar.advance(1, f"{trial.id} {outcome}", str(self._left))

    def on_paused(self, why: str) -> None:
        """Show a pause."""
        self.paused = why

    def on_resumed(self, seconds: float) -> None:
        """Leave the time of a pause out of the estimate."""
        self.paused = ""
        self._left.pause(seconds)

    @property
    def summary(self) -> tuple[float, str]:
        """Percent of the trials that are done, and a text."""
        with self._lock:
            share = 100.0 * self._done / self._total if self._total else 0.0
            words = ", ".join(f"{n} {what}" for what, n in sorted(self.outcomes.items()))
            return min(share, 100.0), (
                f"{self._done} of {plural(self._total, 'trial')}: {words or 'none yet'}"
            )


@contextmanager
def progress_display(run_request: RunRequest) -> Iterator[CollectionProgress]:
    """Yield the progress of a collection, and report it to the page of the flow run around it."""
    from prefect.context import FlowRunContext

    context = FlowRunContext.get()
    if context is None or context.flow_run is None:
        yield CollectionProgress(run_request, lambda: None)
        return
    page = _Page(run_request, context.flow_run.id)
    try:
        yield page.progress
    finally:
        page.end()


class _Page:
    """Reports the progress to Prefect's server, in a thread."""

    def __init__(self, run_request: RunRequest, run: UUID) -> None:
        self._run_request, self._run = run_request, run
        self._over = threading.Event()
        self._artifact: Any = None
        self._summary: tuple[float, str] | None = None
        self._paused = ""
        self._misses = 0
        self._public = not orchestration.uses_private_server()
        settings = contextvars.copy_context()  # Prefect's settings do not come along by themselves
        self._thread = threading.Thread(
            target=settings.run, args=(self._report_until_end,), name="page", daemon=True
        )
        self.progress = CollectionProgress(run_request, self._thread.start)

    def end(self) -> None:
        """Send the last report; wait for it, up to a limit."""
        self._over.set()
        if self._thread.is_alive() and not orchestration.is_unreachable():
            self._thread.join(STOP_LIMIT_S if stopping.requested() else END_LIMIT_S)

    def _report_until_end(self) -> None:
        from httpx import TransportError
        from prefect.client.orchestration import get_client
        from prefect.settings import PREFECT_CLIENT_MAX_RETRIES, temporary_settings

        with (
            suppress(Exception),
            temporary_settings(updates={PREFECT_CLIENT_MAX_RETRIES: 0}),
            # with separate settings it is not the client of the flow run
            get_client(httpx_settings={"timeout": ANSWER_S}, sync_client=True) as client,
        ):
            self._answered(self._rig, client, True)
            self._answered(self._report_name, client)
            while not self._over.wait(PERIOD_S):
                for report in (self._report_lines, self._report_pause, self._report_progress):
                    if not self._answered(report, client):
                        break
            # the rig is free before the figure, which takes longest, is drawn
            public = [lambda client: self._rig(client, False), self._report_figure]
            last = [self._report_lines, self._report_progress, self._report_table]
            last += public if self._public else []
            for report in last:
                try:
                    report(client)
                except TransportError as error:
                    orchestration.report_unreachable(orchestration.reason_of(error))
                    return
                except Exception:
                    continue

    def _answered(self, report: Callable[..., None], *about: Any) -> bool:
        """Return whether the server took a report; after `LOST_AFTER` failures it is lost."""
        try:
            report(*about)
        except Exception as error:
            self._misses += 1
            if self._misses == LOST_AFTER:
                orchestration.report_unreachable(orchestration.reason_of(error))
            return False
        self._misses = 0
        return True

    def _rig(self, client: Any, busy: bool) -> None:
        """Show on a public server whether the rig is in use; the lock is elsewhere."""
        if self._public:
            sign_rig(client, self._run_request.rig.name, busy)

    def _report_name(self, client: Any) -> None:
        client.update_flow_run(self._run, name=self.progress.title)

    def _report_lines(self, client: Any) -> None:
        lines = list(self.progress.lines)
        if lines:
            about = {"name": "sliplab", "level": logging.INFO, "flow_run_id": str(self._run)}
            client.create_logs(
                {**about, "message": line, "timestamp": when.isoformat()} for when, line in lines
            )
        for _ in lines:
            self.progress.lines.popleft()

    def _report_pause(self, client: Any) -> None:
        if (now := self.progress.paused) != self._paused:
            orchestration.show_running(client, self._run, "Paused" if now else "Running", now)
            self._paused = now

    def _report_progress(self, client: Any) -> None:
        from prefect.client.schemas.actions import ArtifactUpdate

        if (now := self.progress.summary) == self._summary:
            return
        percent, words = now
        if self._artifact is None:
            self._artifact = self._make(client, "progress", percent, words).id
        else:
            client.update_artifact(self._artifact, ArtifactUpdate(data=percent, description=words))
        self._summary = now

    def _report_table(self, client: Any) -> None:
        import json

        campaign = TrialStore(self._run_request.store).campaign(self._run_request.campaign)
        rows = outcome_rows(self._run_request.counts(campaign), self.progress.outcomes)
        self._make(client, "table", json.dumps(rows), self._title("trials by outcome"))

    def _report_figure(self, client: Any) -> None:
        from sliplab.analysis.report.figures.campaign import event_rates

        numbers, rates = self._rates()
        if rates:
            svg = event_rates(numbers, rates, simulated=self._run_request.rig.simulated)
            data = "data:image/svg+xml;base64," + base64.b64encode(svg.encode()).decode()
            self._make(client, "image", data, self._title("events a second of each trial"))

    def _rates(self) -> tuple[list[int], list[float]]:
        """Return plan numbers from 1, and events per second, of evenly spread trials."""
        campaign = TrialStore(self._run_request.store).campaign(self._run_request.campaign)
        there = campaign.committed()
        taken = [(n, t) for n, t in enumerate(self._run_request.plan, 1) if t.id in there]
        numbers, rates = [], []
        for number, trial in taken[:: -(-len(taken) // MOST_POINTS) or 1]:
            with suppress(StoreError):
                record = campaign.recording(trial.id).record
                numbers.append(number)
                rates.append(record.counts.events / record.recorded_s)
        return numbers, rates

    def _title(self, what: str) -> str:
        simulated = " (simulated)" if self._run_request.rig.simulated else ""
        return f"{self._run_request.campaign}: {what}{simulated}"

    def _make(self, client: Any, kind: str, data: Any, words: str) -> Any:
        from prefect.client.schemas.actions import ArtifactCreate

        return client.create_artifact(
            ArtifactCreate(
                key=artifact_key(self._run_request.campaign, kind),
                type=kind,
                data=data,
                description=words,
                flow_run_id=self._run,
            )
        )


def outcome_rows(counts: CampaignCounts, here: Counter[str]) -> list[Json]:
    """Return the table of trials by outcome: in this run, and in the whole campaign."""
    return [
        {"outcome": "planned", "this run": "", "campaign": counts["planned"]},
        {"outcome": "committed", "this run": here["committed"], "campaign": counts["committed"]},
        {
            "outcome": "set aside",
            "this run": here["set aside"] + here["skipped"],
            "campaign": len(counts["set_aside"]),
        },
        {"outcome": "missing", "this run": "", "campaign": counts["missing"]},
        {"outcome": "takes in quarantine", "this run": "", "campaign": counts["quarantined"]},
    ]


def artifact_key(campaign: str, kind: str) -> str:
    """Return a key of a-z, digits and dashes, as Prefect wants it; a hash keeps it unique."""
    plain = "".join(c if c.isascii() and c.isalnum() else "-" for c in campaign.lower())
    if plain != campaign:
        plain += f"-{hash_text(campaign)[:6]}"
    return f"collect-{plain}-{kind}"


def sign_rig(client: Any, rig: str, busy: bool) -> None:
    """Show on Prefect's page whether a rig is in use: its limit's one slot is taken, or free.

    The slot is set and not acquired: a lease of a killed process would stay taken for minutes.
    """
    from prefect.client.schemas.actions import GlobalConcurrencyLimitUpdate

    name = f"rig {rig}"
    client.upsert_global_concurrency_limit_by_name(name, 1)
    client.update_global_concurrency_limit(
        name, GlobalConcurrencyLimitUpdate(active_slots=int(busy))
    )
