"""What Prefect's page shows of a collection: progress, trials by outcome, a picture, the rig.

A thread of its own tells the server, every few seconds at most, so that neither a batch of quick
trials nor a slow server holds a trial up. What cannot be shown is left out: a page is a view, and
the store has it all.
"""

from __future__ import annotations

import base64
import contextvars
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any
from uuid import UUID

from sliplab.flows.planning.run_request import RunRequest
from sliplab.flows.running import orchestration, stopping
from sliplab.protocols import Trial
from sliplab.protocols.hashing import hash_text
from sliplab.storage.streams import Json
from sliplab.storage.trials.store import Store, StoreError

PERIOD_S = 5.0
END_LIMIT_S = 10.0
"""How long the end of a collection waits for its page, while the server answers."""
STOP_LIMIT_S = 0.5
"""How long it does when a stop was requested."""
ANSWER_S = 5.0
"""How long one answer of the server is waited for."""
LOST_AFTER = 3
"""So many periods without an answer, and the server is called lost."""
MOST_POINTS = 300


class Show:
    """What a collection tells while it runs; all of it returns at once."""

    def __init__(self, start: Callable[[], None] = lambda: None) -> None:
        self._total = self._done = 0
        self.outcomes: Counter[str] = Counter()
        self._lock = threading.Lock()
        self._start = start

    def begin(self, count: int) -> None:
        """The rig is ours, and so many trials are to be taken."""
        self.more(count)
        self._start()

    def more(self, count: int) -> None:
        """So many trials are to be taken besides."""
        with self._lock:
            self._total += count

    def on_trial_done(self, trial: Trial, outcome: str) -> None:
        """Count a trial that is over."""
        with self._lock:
            self._done += 1
            self.outcomes[outcome] += 1

    @property
    def progress(self) -> tuple[float, str]:
        """Percent, and in words."""
        with self._lock:
            share = 100.0 * self._done / self._total if self._total else 0.0
            words = ", ".join(f"{n} {what}" for what, n in sorted(self.outcomes.items()))
            return min(share, 100.0), f"{self._done} of {self._total} trials: {words or 'none yet'}"


@contextmanager
def shown(run_request: RunRequest) -> Iterator[Show]:
    """Show a collection on the page of the flow run round it while the block runs."""
    from prefect.context import FlowRunContext

    context = FlowRunContext.get()
    if context is None or context.flow_run is None:
        yield Show()
        return
    page = _Page(run_request, context.flow_run.id)
    try:
        yield page.show
    finally:
        page.end()


class _Page:
    """The thread that reports progress to the server."""

    def __init__(self, run_request: RunRequest, run: UUID) -> None:
        self._run_request, self._run = run_request, run
        self._over = threading.Event()
        self._progress: Any = None
        self._misses = 0
        self._public = not orchestration.private()
        settings = contextvars.copy_context()  # Prefect's settings do not come along by themselves
        self._thread = threading.Thread(
            target=settings.run, args=(self._report_until_end,), name="page", daemon=True
        )
        self.show = Show(self._thread.start)

    def end(self) -> None:
        """Send the last report; wait for it, up to a limit."""
        self._over.set()
        if self._thread.is_alive() and not orchestration.lost():
            self._thread.join(STOP_LIMIT_S if stopping.requested() else END_LIMIT_S)

    def _report_until_end(self) -> None:
        from httpx import TransportError
        from prefect.client.orchestration import get_client
        from prefect.settings import PREFECT_CLIENT_MAX_RETRIES, temporary_settings

        with (
            suppress(Exception),
            temporary_settings(updates={PREFECT_CLIENT_MAX_RETRIES: 0}),
            # with settings of its own it is not the client of the flow run
            get_client(httpx_settings={"timeout": ANSWER_S}, sync_client=True) as client,
        ):
            self._answered(self._rig, client, True)
            before = None
            while not self._over.wait(PERIOD_S):
                if (now := self.show.progress) != before and self._answered(
                    self._report_progress, client
                ):
                    before = now
            public = [self._report_figure, lambda client: self._rig(client, False)]
            last = [self._report_progress, self._report_table, *(public if self._public else ())]
            for report in last:
                try:
                    report(client)
                except TransportError as error:
                    orchestration.lose(orchestration.reason_of(error))
                    return
                except Exception:
                    continue

    def _answered(self, report: Callable[..., None], *about: Any) -> bool:
        """Whether the server took it; without an answer again and again it is lost."""
        try:
            report(*about)
        except Exception as error:
            self._misses += 1
            if self._misses == LOST_AFTER:
                orchestration.lose(orchestration.reason_of(error))
            return False
        self._misses = 0
        return True

    def _rig(self, client: Any, busy: bool) -> None:
        """The concurrency limit of the rig's name: a sign on its door, and not its lock."""
        if self._public:
            sign_rig(client, self._run_request.rig.name, busy)

    def _report_progress(self, client: Any) -> None:
        from prefect.client.schemas.actions import ArtifactUpdate

        percent, words = self.show.progress
        if self._progress is None:
            self._progress = self._make(client, "progress", percent, words).id
        else:
            client.update_artifact(self._progress, ArtifactUpdate(data=percent, description=words))

    def _report_table(self, client: Any) -> None:
        import json

        campaign = Store(self._run_request.store).campaign(self._run_request.campaign)
        rows = outcome_rows(self._run_request.counts(campaign), self.show.outcomes)
        self._make(client, "table", json.dumps(rows), self._title("trials by outcome"))

    def _report_figure(self, client: Any) -> None:
        from sliplab.analysis.report.figures.campaign import event_rates

        numbers, rates = self._rates()
        if rates:
            svg = event_rates(numbers, rates, simulated=self._run_request.rig.simulated)
            data = "data:image/svg+xml;base64," + base64.b64encode(svg.encode()).decode()
            self._make(client, "image", data, self._title("events a second of each trial"))

    def _rates(self) -> tuple[list[int], list[float]]:
        """Places in the plan from 1, and events a second, of trials evenly spread over it."""
        campaign = Store(self._run_request.store).campaign(self._run_request.campaign)
        there = campaign.committed()
        wanted = [(n, t) for n, t in enumerate(self._run_request.plan, 1) if t.id in there]
        numbers, rates = [], []
        for number, trial in wanted[:: -(-len(wanted) // MOST_POINTS) or 1]:
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


def outcome_rows(counts: Json, here: Counter[str]) -> list[Json]:
    """The table of trials by outcome: how many in this run, and in the whole campaign."""
    return [
        {"outcome": "planned", "this run": "", "campaign": counts["planned"]},
        {"outcome": "committed", "this run": here["committed"], "campaign": counts["committed"]},
        {"outcome": "set aside", "this run": here["set aside"] + here["skipped"],
         "campaign": len(counts["set_aside"])},
        {"outcome": "missing", "this run": "", "campaign": counts["missing"]},
        {"outcome": "takes in quarantine", "this run": "", "campaign": counts["quarantined"]},
    ]  # fmt: skip


def artifact_key(campaign: str, kind: str) -> str:
    """Prefect takes letters a-z, digits and dashes only; what that loses, a hash tells apart."""
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
