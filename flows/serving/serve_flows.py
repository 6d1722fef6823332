"""The flows that `sliplab serve` registers; each one does what the command of its name does.

Annotations are evaluated here: a run's process gets its flow without the names round it.
"""

from collections.abc import Callable
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

from prefect import flow

from sliplab.flows.collecting import controlling
from sliplab.flows.planning.run_request import RunRequest, SessionMetadata, check_disk, make_request
from sliplab.flows.serving.serve_parameters import Ask, Chain, Collect, Evaluate, OnRig, Step, Study
from sliplab.flows.serving.serve_runs import HOOKS, run_of, until_of, when_free
from sliplab.flows.serving.service import Service
from sliplab.flows.steps import STEPS
from sliplab.flows.study_defaults import LABELS_CHECKED, study_protocols
from sliplab.storage.trials import control
from sliplab.storage.trials.store import Store

STEP, EVALUATE, STUDY, ASK = Step(), Evaluate(), Study(), Ask()
served: Callable[..., Any] = partial(flow, persist_result=False, **HOOKS)


@served(name="collect")
def collect(wanted: Collect) -> Any:
    """Take the trials that the store lacks; run again, it goes on."""
    return run_of(partial(_collect, wanted))


@served(name="label")
def label(wanted: Step = STEP) -> Any:
    """Find the true onsets of every trial."""
    return run_of(lambda here, run: _steps(here, wanted.campaigns, "label"))


@served(name="train")
def train(wanted: Step = STEP) -> Any:
    """Train the spiking network on the labelled kinematic trials."""
    return run_of(lambda here, run: _steps(here, wanted.campaigns, "train"))


@served(name="evaluate")
def evaluate(wanted: Evaluate = EVALUATE) -> Any:
    """Score the network on trials it has never seen."""
    options = {"margin": wanted.margin, "smoothing": wanted.smoothing}
    return run_of(lambda here, run: _steps(here, wanted.campaigns, "evaluate", **options))


@served(name="report")
def report(wanted: Step = STEP) -> Any:
    """Write report/index.html and report/summary.json."""
    return run_of(lambda here, run: _steps(here, wanted.campaigns, "report"))


@served(name="study")
def study(wanted: Study = STUDY) -> Any:
    """The whole chain: collect, sync, label, train, evaluate, report."""
    return run_of(partial(_study, wanted))


@served(name="chain")
def chain(wanted: Chain) -> Any:
    """Collect, then label, train and evaluate what there is."""
    return run_of(partial(_chain, wanted))


@served(name="pause")
def pause(wanted: Ask = ASK) -> Any:
    """Let the trial that runs come to its end, then stand still."""
    return run_of(partial(_ask, "pause", wanted))


@served(name="resume")
def resume(wanted: Ask = ASK) -> Any:
    """Go on after a pause."""
    return run_of(partial(_ask, "resume", wanted))


@served(name="stop")
def stop(wanted: Ask = ASK) -> Any:
    """Stop the collection that runs now, the arm first."""
    return run_of(partial(_ask, "stop", wanted))


ON_RIG = (collect, label, train, evaluate, report, study, chain)
"""One at a time: what moves the arm, and what needs both cores."""
CONTROL = (pause, resume, stop)
"""At any time."""


def _run_request(
    here: Service, wanted: OnRig, protocol: Path, run: Any, **options: Any
) -> RunRequest:
    metadata = SessionMetadata(
        wanted.operator, wanted.temperature_c, wanted.humidity_percent, wanted.note
    )
    run_request = make_request(
        protocol,
        Path(here.rig),
        here.folder,
        metadata=metadata,
        until=until_of(wanted, run),
        **options,
    )
    check_disk([run_request])
    return run_request


def _take(wanted: OnRig, run_request: RunRequest, run: Any) -> str:
    from sliplab.flows.collecting.collect import collect as take

    done = when_free(run_request, wanted.patience_min * 60, partial(take, run_request), run)
    simulated = "simulated " if run_request.rig.simulated else ""
    return (
        f"{done['taken']} {simulated}trials taken, {done['committed']} of {done['planned']} "
        f"committed, {done['missing']} missing, {len(done['set_aside'])} set aside"
    )


def _collect(wanted: Collect, here: Service, run: Any) -> str:
    run_request = _run_request(
        here, wanted, here.protocol(wanted.protocol), run,
        most=wanted.trials, campaign=wanted.campaign, enable=tuple(wanted.enable),
    )  # fmt: skip
    return _take(wanted, run_request, run)


def _chain(wanted: Chain, here: Service, run: Any) -> str:
    from sliplab.flows.collecting.stops import WindowOver

    try:
        taken = _collect(wanted, here, run)
    except WindowOver as over:  # the arm rests; what it took until then can be looked at
        taken = str(over)
    names = ["label", "train", "evaluate"] if wanted.train else ["label", "evaluate"]
    return "; ".join([taken, *(_steps(here, [], name) for name in names)])


def _study(wanted: Study, here: Service, run: Any) -> str:
    from sliplab.flows.study import study as whole

    files = study_protocols(wanted.pilot, wanted.extra)
    run_requests = [_run_request(here, wanted, file, run, enable=on) for file, on in files.items()]
    check_disk(run_requests)
    done: dict[str, Any] = {}

    def work() -> dict[str, Any]:
        outcome = whole(run_requests, LABELS_CHECKED)
        done.update({step["step"]: step["done"] for step in outcome.steps})
        return {"taken": sum(item["taken"] for item in outcome.collected)}

    taken = when_free(run_requests[0], wanted.patience_min * 60, work, run)["taken"]
    return f"{taken} trials taken; " + ", ".join(f"{name}: {n} done" for name, n in done.items())


def _steps(here: Service, campaigns: list[str], name: str, **options: Any) -> str:
    from sliplab.analysis.campaigns import collected

    store = Store.open(here.folder)
    step = getattr(import_module(STEPS[name]), name)
    result = step(store, collected(store, campaigns or None), **options)
    return f"{name}: {result['done']} done, {result['fresh']} were fresh"


def _ask(kind: control.Kind, wanted: Ask, here: Service, run: Any) -> str:
    store = Store.open(here.folder)
    who = wanted.who or "Prefect's page"
    if kind == "stop":
        outcome = controlling.stop(store, who=who, why=wanted.why, limit_s=wanted.wait_s)
    else:
        outcome = controlling.request(store, kind, who=who, why=wanted.why, limit_s=wanted.wait_s)
    if outcome.answer is None:
        return f"{kind}: not yet; request {outcome.request.number} stands"
    return f"{kind}: done, request {outcome.request.number}: {outcome.answer['did']}"
