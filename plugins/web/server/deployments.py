"""The flows that `sliplab serve` registers; each one does what the command of its name does.

A served run ends with the service, with the arm first, and with a record. Annotations are evaluated
here: a run's process gets its flow without the names round it.
"""

import os
from collections.abc import Callable
from contextlib import suppress
from datetime import datetime
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, TypeVar

from prefect import flow

from sliplab.flows.collecting import requests
from sliplab.flows.collecting.requests import CampaignStopped
from sliplab.flows.collecting.supervisor import WindowOver
from sliplab.flows.planning.run_request import RunRequest, check_disk, make_request
from sliplab.flows.running import console, orchestration, run_records, stopping
from sliplab.flows.running.process import die_with
from sliplab.flows.steps import STEPS
from sliplab.flows.study_defaults import LABELS_CHECKED, study_protocols
from sliplab.plugins.web.server.schedules import (
    Ask,
    Collect,
    Evaluate,
    OnRig,
    ScheduledChain,
    ScheduledPush,
    ScheduledReport,
    ScheduledStep,
    ScheduledStudy,
    window_end,
)
from sliplab.plugins.web.server.service import Service, service
from sliplab.protocols import InputError
from sliplab.protocols.shown import plural
from sliplab.rigs.core.capabilities import RigError
from sliplab.storage.errors import disk_error
from sliplab.storage.remote.mirror import open_store
from sliplab.storage.trials import control
from sliplab.storage.trials.lock import Locked
from sliplab.storage.trials.store import StoreError, TrialStore

POLL_S = 2.0
"""Interval between attempts to lock a rig that is in use, s."""
_EXPECTED = (StoreError, RigError, Locked, CampaignStopped, InputError)


def run_of(work: Callable[[Service, Any], str]) -> Any:
    """Do the work of one served flow run.

    Args:
        work: gets the service and Prefect's flow run; returns a text about its result.

    Returns:
        The state in which the run ends.
    """
    from prefect.context import FlowRunContext
    from prefect.exceptions import Pause
    from prefect.states import Cancelled, Completed, Failed

    context = FlowRunContext.get()
    if context is None or context.flow_run is None or context.flow is None:
        raise RuntimeError("is no flow run")
    run, here, name = context.flow_run, service(), context.flow.name
    run_records.begin(here.folder, str(run.id), name, here.server, here.name)
    state: Any
    try:
        with stopping.signals():
            if os.getpid() != here.pid and not die_with(here.pid):
                stopping.stop()
            try:
                state = Completed(message=work(here, run))
            except WindowOver as over:
                state = Completed(message=str(over))
    except KeyboardInterrupt:
        state = Cancelled(message="stopped, the arm first; every committed trial is kept")
    except Exception as error:
        if stopping.requested():  # compiled code interrupted by a signal raises other errors
            state = Cancelled(message="stopped, the arm first; every committed trial is kept")
        else:
            state = Failed(message=_words(error))
            if not isinstance(error, _EXPECTED):
                console.messages.print_exception(max_frames=8)
    except Pause:  # Prefect's page: leave the rig, continue when resumed
        run_records.suspended(here.folder, str(run.id))
        raise
    with suppress(OSError):
        run_records.end(here.folder, str(run.id), state.type.value, state.message or "", "flow")
    console.say(f"{name} {run.name}: {state.type.value}: {state.message}")
    orchestration.work_is_over()
    return state


def until_of(wanted: OnRig, run: Any) -> float | None:
    """Return the time by which the rig must be free again, seconds since 1970.

    Raises:
        WindowOver: that was before the run began.
    """
    if wanted.until is None:
        return None
    due: datetime = run.expected_start_time or run.start_time
    end = window_end(due, wanted.until, wanted.timezone)
    if datetime.now(end.tzinfo) >= end:
        raise WindowOver(
            f"the window ended {end:%Y-%m-%d %H:%M %Z}, before the run began; "
            f"{run_records.NOTHING_TAKEN}"
        )
    return end.timestamp()


Done = TypeVar("Done")


def when_free(
    run_request: RunRequest, patience_s: float, work: Callable[[], Done], run: Any
) -> Done:
    """Do `work` as soon as no other program holds the store or the rig.

    Raises:
        Locked: one still does after `patience_s`.
        WindowOver: one still does when the window ends.
        KeyboardInterrupt: a stop was requested since the run was.
    """
    waited = 0.0
    while True:
        requests.end_if_stopped(TrialStore(run_request.store), run_request.since)
        try:
            return work()
        except Locked as busy:
            if run_request.until is None and waited >= patience_s:
                raise
            if run_request.until is not None and datetime.now().timestamp() >= run_request.until:
                raise WindowOver(
                    f"the window is over and {run_records.NOTHING_TAKEN}: {busy}"
                ) from None
            if not waited:
                _report_waiting(run, str(busy))
        stopping.wait(POLL_S)
        waited += POLL_S


def _report_waiting(run: Any, why: str) -> None:
    """Show on Prefect's page that a run waits for its rig."""
    from prefect.client.orchestration import get_client

    console.say(f"waiting: {why}")
    with suppress(Exception), get_client(sync_client=True) as client:
        orchestration.show_running(client, run.id, "WaitingForRig", why)


def _words(error: Exception) -> str:
    name = getattr(error, "filename", None)
    if isinstance(error, OSError) and name:
        return str(disk_error(Path(os.fsdecode(name)), error) or error)
    return str(error) or type(error).__name__


STEP, EVALUATE, STUDY, ASK = ScheduledStep(), Evaluate(), ScheduledStudy(), Ask()
REPORT, PUSH = ScheduledReport(), ScheduledPush()
served: Callable[..., Any] = partial(
    flow, persist_result=False, result_storage=orchestration.NO_RESULTS
)


@served(name="collect")
def collect(wanted: Collect) -> Any:
    """Collect the missing trials of a protocol; run it again to resume."""
    return run_of(partial(_collect, wanted))


@served(name="label")
def label(wanted: ScheduledStep = STEP) -> Any:
    """Label the slip onsets of every trial."""
    return run_of(lambda here, run: _steps(here, wanted.campaigns, "label"))


@served(name="train")
def train(wanted: ScheduledStep = STEP) -> Any:
    """Train the spiking network on the labelled kinematic trials."""
    return run_of(lambda here, run: _steps(here, wanted.campaigns, "train"))


@served(name="evaluate")
def evaluate(wanted: Evaluate = EVALUATE) -> Any:
    """Evaluate the network on the test trials."""
    rule = {"margin": wanted.margin, "smoothing": wanted.smoothing}
    return run_of(lambda here, run: _steps(here, wanted.campaigns, "evaluate", **rule))


@served(name="report")
def report(wanted: ScheduledReport = REPORT) -> Any:
    """Write report/index.html and report/summary.json, or the page of a period."""
    return run_of(partial(_report, wanted))


@served(name="study")
def study(wanted: ScheduledStudy = STUDY) -> Any:
    """Collect, sync, label, train, evaluate and report, over all protocols of the study."""
    return run_of(partial(_study, wanted))


@served(name="chain")
def chain(wanted: ScheduledChain) -> Any:
    """Collect, then label, train and evaluate the trials in the store."""
    return run_of(partial(_chain, wanted))


@served(name="push")
def push(wanted: ScheduledPush = PUSH) -> Any:
    """Send committed trials to a remote store; it may run while trials are taken."""
    return run_of(partial(_push, wanted))


@served(name="pause")
def pause(wanted: Ask = ASK) -> Any:
    """Pause the collection after the current trial."""
    return run_of(partial(_ask, "pause", wanted))


@served(name="resume")
def resume(wanted: Ask = ASK) -> Any:
    """Resume a paused collection."""
    return run_of(partial(_ask, "resume", wanted))


@served(name="stop")
def stop(wanted: Ask = ASK) -> Any:
    """Stop the current collection; the arm stops first."""
    return run_of(partial(_ask, "stop", wanted))


ON_RIG = (collect, label, train, evaluate, report, study, chain)
"""One at a time: what moves the arm, and what needs both cores."""
BESIDE = (push,)
"""One at a time, beside those on the rig: a network that does not answer delays no trial."""
CONTROL = (pause, resume, stop)
"""At any time."""


def _run_request(
    here: Service, wanted: OnRig, protocol: Path, run: Any, **options: Any
) -> RunRequest:
    given = {"metadata": wanted, "since": here.since, **options}
    run_request = make_request(
        protocol, Path(here.rig), here.folder, until=until_of(wanted, run), **given
    )
    check_disk([run_request])
    return run_request


def _take(wanted: OnRig, run_request: RunRequest, run: Any) -> str:
    from sliplab.flows.collect import collect as take

    campaign = TrialStore(run_request.store).campaign(run_request.campaign)
    before = campaign.committed()
    try:
        done = when_free(run_request, wanted.patience_min * 60, partial(take, run_request), run)
    except WindowOver as over:
        if run_records.NOTHING_TAKEN in str(over) or campaign.committed() != before:
            raise
        raise WindowOver(f"{over}; {run_records.NOTHING_TAKEN}") from None
    simulated = "simulated " if run_request.rig.simulated else ""
    return (
        f"{done['taken']} {simulated}trials taken, {done['committed']} of {done['planned']} "
        f"committed, {done['missing']} missing, {len(done['set_aside'])} set aside"
    )


def _collect(wanted: Collect, here: Service, run: Any) -> str:
    protocol = here.protocol(wanted.protocol)
    run_request = _run_request(here, wanted, protocol, run, **wanted.arguments())
    return _take(wanted, run_request, run)


def _chain(wanted: ScheduledChain, here: Service, run: Any) -> str:
    from sliplab.flows.collecting.supervisor import WindowOver

    try:
        taken = _collect(wanted, here, run)
    except WindowOver as over:  # the arm rests; what it took until then can be inspected
        taken = str(over)
    names = ["label", "train", "evaluate"] if wanted.train else ["label", "evaluate"]
    return "; ".join([taken, *(_steps(here, [], name) for name in names)])


def _study(wanted: ScheduledStudy, here: Service, run: Any) -> str:
    from sliplab.flows.study import study as whole

    files = study_protocols(wanted.pilot, wanted.extra)
    run_requests = [_run_request(here, wanted, file, run, enable=on) for file, on in files.items()]
    check_disk(run_requests)
    work = partial(whole, run_requests, LABELS_CHECKED)
    outcome = when_free(run_requests[0], wanted.patience_min * 60, work, run)
    taken = sum(item["taken"] for item in outcome.collected)
    # of steps of one name, the last
    done = {step["step"]: step["done"] for step in outcome.steps}
    return f"{plural(taken, 'trial')} taken; " + ", ".join(
        f"{name}: {n} done" for name, n in done.items()
    )


def _steps(here: Service, campaigns: list[str], name: str, **options: Any) -> str:
    from sliplab.analysis.campaigns import collected

    store = open_store(here.folder)
    step = getattr(import_module(STEPS[name]), name)
    result = step(store, collected(store, campaigns or None), **options)
    return f"{name}: {result['done']} done, {result['fresh']} were fresh"


def _report(wanted: ScheduledReport, here: Service, run: Any) -> str:
    from sliplab.flows.period import period_before, write_period_report

    if wanted.period is None:
        return _steps(here, wanted.campaigns, "report")
    now = datetime.now().astimezone()
    page = write_period_report(open_store(here.folder), *period_before(now, wanted.period), now)
    return f"report of the last {wanted.period}: {page}"


def _push(wanted: ScheduledPush, here: Service, run: Any) -> str:
    from sliplab.storage.remote.objects import Remote
    from sliplab.storage.remote.push import PushOptions, push

    store, url = open_store(here.folder), here.url(wanted.url)
    there = {campaign.name: campaign for campaign in store.campaigns()}
    for name in wanted.campaigns:
        if name not in there:
            raise InputError("campaigns", "", name, f"must be one of {', '.join(there)}")
    chosen = [there[name] for name in wanted.campaigns or there]
    options = PushOptions(quarantine=wanted.quarantine)
    done = push(store, Remote(url), chosen, options, on_bytes=lambda _: stopping.check())
    if done.problems:
        raise StoreError(f"{url}: {len(done.problems)} not sent; first: {done.problems[0]}")
    return f"push: {plural(done.pushed, 'trial')} sent, {done.there} were there"


def _ask(kind: control.Kind, wanted: Ask, here: Service, run: Any) -> str:
    store = open_store(here.folder)
    given = {**wanted.arguments(), "who": wanted.who or "Prefect's page"}
    if kind == "stop":
        outcome = requests.stop_collection(store, **given)
    else:
        outcome = requests.ask(store, kind, **given)
    if outcome.answer is None:
        return f"{kind}: not yet; request {outcome.request.number} is still open"
    return f"{kind}: done, request {outcome.request.number}: {outcome.answer['did']}"
