"""`sliplab power`: how many trials the claims of a protocol need, by a pilot's labelled trials.

Campaigns of the protocol are drawn from the pilot's figures, and each is looked at as a campaign is
while it is collected. Figures and trained classifiers are stored among the store's derived results,
so a stopped run resumes, and a second run with other claims repeats only the drawing.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Literal

import numpy as np

from sliplab.analysis.campaigns import Collected, collected, training_campaigns
from sliplab.analysis.labels.reviewed import StoreLabels
from sliplab.analysis.trial_work import stale_trials
from sliplab.analysis.windows.dataset import SampleSet
from sliplab.analysis.windows.sample_sets import STEP as SAMPLES
from sliplab.analysis.windows.sample_sets import load_samples
from sliplab.flows.running import console, orchestration
from sliplab.flows.running.parallel_map import START_S, parallel_map_flow, run_trials
from sliplab.flows.running.run_records import timed
from sliplab.plugins.claims import trial_figures as figures
from sliplab.plugins.claims.blocks import F64, I64
from sliplab.plugins.claims.document import TrialFigures
from sliplab.plugins.claims.evidence import TrialGrid
from sliplab.plugins.claims.power import learning
from sliplab.plugins.claims.power.document import Learning, PowerRecord
from sliplab.plugins.claims.power.drawing import SHARES, CampaignDraw, Drawing, claim_powers, spread
from sliplab.plugins.claims.power.resampling import (
    ONE_SESSION,
    PilotFigures,
    Sessions,
    sessions_text,
    shared_axes,
)
from sliplab.plugins.claims.simulated import claims_of
from sliplab.protocols import InputError, Plan, PlannedTrial, load_plan
from sliplab.protocols.claims import Claim, Stopping
from sliplab.protocols.consistency import check_consistency
from sliplab.protocols.key_errors import KeyedError
from sliplab.protocols.plan import make_plan
from sliplab.protocols.settings import AnalysisSettings
from sliplab.protocols.yaml_file import input_error, parse_leniently, raise_all, validate
from sliplab.storage.trials.derived import Derived, make_key
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import TrialStore

FEWEST = 6
"""Trials of a pilot with a figure."""
FEWEST_TRAINING = 8
"""Training trials of which a quarter can train."""
MOST_SHARE = 100.0
PAUSE_S = 3600.0
"""Between two trials of a pilot, from which on the second begins another session."""
CAMPAIGNS, ADAPTIVE_CAMPAIGNS = 100, 20
"""Drawn where the plan gives the order, and where trials are chosen, which takes longer."""
SPLITS = ("train", "validation", "test")
Classifier = Literal["logistic", "network"]
LOGISTIC: Classifier = "logistic"
TITLES: Mapping[Classifier, str] = {
    "logistic": "logistic regression on cells and parts of a window",
    "network": "the pilot's network",
}
PilotTrial = tuple[Collected, PlannedTrial, Recording]


@dataclass(frozen=True)
class PowerRequest:
    """Request of a power analysis, checked.

    Attributes:
        plan: with the claims. pilot: trials whose figures are used.
        campaigns: of the store that they are from, with trials that train.
        judge: makes the figures. drawn: number of campaigns. sessions: of each of them.
        classifier: of the learning curve; None: no curve.
    """

    store: TrialStore
    plan: Plan
    campaigns: list[Collected]
    pilot: list[PilotTrial]
    judge: figures.Judge
    drawn: int
    seed: int
    classifier: Classifier | None
    sessions: Sessions = ONE_SESSION


def plan_with_claims(
    protocol: Path, texts: Sequence[str], enable: Sequence[str], model: Path | None
) -> tuple[Plan, Path | None]:
    """Return a protocol's plan with claims, and the file of the network that judges them.

    Args:
        texts: claims in place of the protocol's own, each as YAML.
        model: instead of the protocol's.

    Raises:
        InputError: there is no claim, one is wrong, or a network is needed.
    """
    plan = load_plan(protocol, enable, judged=model is None and not texts)
    collection = plan.protocol.collection
    stopping = collection.stopping
    if texts:
        claims = tuple(read_claim(text, plan) for text in texts)
        stopping = (stopping or Stopping(claims=claims)).model_copy(update={"claims": claims})
    if stopping is None:
        raise InputError(
            "--claim", "", None, f"is needed: {plan.file} has no claims (collection.stopping)"
        )
    changed = collection.model_copy(update={"stopping": stopping})
    changed_protocol = plan.protocol.model_copy(update={"collection": changed})
    try:
        check_consistency(changed_protocol)
    except KeyedError as error:
        raise input_error("--claim", error) from None
    plan = make_plan(changed_protocol, plan.file, enable)
    return plan, judging_model(plan, model)


def judging_model(plan: Plan, model: Path | None) -> Path | None:
    """Return the file of the network that judges a plan's claims; None where none is needed.

    Args:
        model: instead of the protocol's.

    Raises:
        InputError: a network is needed, and none is named, or it is no file.
    """
    stopping = claims_of(plan)
    if not stopping.needs_network:
        return None
    if model is None and stopping.model is not None:
        model = Path(plan.file).parent / stopping.model
    if model is None or not model.is_file():
        raise InputError(
            "--model",
            "",
            model,
            "is no file"
            if model is not None
            else "is needed: a claim is about a network's "
            "output; name the file of a trained one, such as STORE/models/seed0.pt",
        )
    return model.resolve()


def read_claim(text: str, plan: Plan) -> Claim:
    """Read a claim that an option gives as YAML.

    Raises:
        InputError: it is wrong.
    """
    claim = validate(Claim, parse_leniently(text, "--claim"), "--claim")
    try:
        factors = plan.protocol.collection.all_factors
        raise_all([lambda: Stopping(claims=(claim,)).factor_faults(factors)])
    except KeyedError as error:
        below = "collection.stopping.claims[0]."
        faults = [each.with_key(each.key.removeprefix(below)) for each in error.faults]
        raise input_error("--claim", KeyedError.joined(faults)) from None
    return claim


def request(
    store: TrialStore,
    campaigns: list[Collected],
    plan: Plan,
    model: Path | None,
    drawn: int | None = None,
    seed: int = 1,
    classifier: Classifier | None = LOGISTIC,
    sessions: Sessions = ONE_SESSION,
) -> PowerRequest:
    """Check a request.

    Raises:
        InputError: the store has no trials of the protocol's experiment, or sessions are wrong.
    """
    for option, share in (("--between", sessions.between), ("--drift", sessions.drift)):
        if share is not None and not 0.0 <= share <= MOST_SHARE:
            raise InputError(option, "", str(share), f"must be from 0 to {MOST_SHARE:g}")
    if sessions.between is not None and sessions.count == 1:
        raise InputError("--between", "", str(sessions.between), "needs --sessions of 2 or more")
    experiment = plan.protocol.collection.experiment
    used = [it for it in campaigns if it.recorded is None and it.experiment == experiment]
    # a network that the store trained has seen the others
    own = model is not None and model.is_relative_to(store.folder.resolve())
    pilot = [
        (item, trial, recording)
        for item in used
        for trial, recording in item.trials
        if trial.role == "measured" and (not own or trial.split == "test")
    ]
    if len(pilot) < FEWEST:
        which = "test trials" if own else "trials"
        raise InputError(
            "--store",
            "",
            str(store.folder),
            f"has {len(pilot)} {which} of the experiment '{experiment}', and at least {FEWEST} are "
            "needed: collect a pilot first",
        )
    adaptive = plan.protocol.collection.adaptive is not None
    count = drawn or (ADAPTIVE_CAMPAIGNS if adaptive else CAMPAIGNS)
    judge = figures.Judge(plan.protocol.analysis, model)
    return PowerRequest(store, plan, used, pilot, judge, count, seed, classifier, sessions)


def of_plan(plan: Plan, pilot: TrialStore) -> PowerRecord:
    """Draw campaigns of a plan by a pilot's trials, without a learning curve.

    Raises:
        InputError: the plan has no claims, or the pilot is not sufficient.
    """
    if plan.protocol.collection.stopping is None:
        raise InputError(
            "--pilot", "", str(pilot.folder), f"{plan.file} has no claims (collection.stopping)"
        )
    model = judging_model(plan, None)
    return foretell(request(pilot, collected(pilot), plan, model, classifier=None))


def foretell(asked: PowerRequest) -> PowerRecord:
    """Draw campaigns, and return their statistics of each claim.

    Raises:
        InputError: the pilot has too few figures, or lacks levels of the protocol.
    """
    pilot, notes = read_pilot(asked)
    notes += sessions_text(pilot, asked.sessions)
    drawing = Drawing(asked.plan, pilot, asked.seed, asked.sessions)
    found = drawn_campaigns(drawing, asked.drawn)
    curve, more = learning_curve(asked)
    plan, stopping = asked.plan, claims_of(asked.plan)
    planned = len(TrialGrid.of(plan).trials)
    ended = tuple(it.ended for it in found)
    taken = [min(stopping.most or planned, planned) if n is None else n for n in ended]
    hours = plan.total_seconds / 3600.0
    return PowerRecord(
        simulated=any(bool(item.info.get("simulated")) for item in asked.campaigns),
        protocol=plan.name,
        order=plan.protocol.collection.order,
        pilots=tuple(dict.fromkeys(item.name for item, _, _ in asked.pilot)),
        pilot_trials=len(asked.pilot),
        model=asked.judge.model_hash,
        campaigns=asked.drawn,
        planned=planned,
        repetitions=plan.protocol.collection.repetitions,
        sessions=asked.sessions.count,
        drift=asked.sessions.drift,
        hours=hours,
        notes=(*notes, *more),
        claims=claim_powers(drawing, found),
        together=spread(ended),
        ended=ended,
        never=sum(n is None for n in ended) / len(ended),
        expected_hours=tuple(hours * float(n) / planned for n in np.quantile(taken, SHARES)),
        learning=curve,
    )


def read_pilot(asked: PowerRequest) -> tuple[PilotFigures, list[str]]:
    """Return the figures of the pilot's trials, and what it does not determine.

    Raises:
        InputError: they are too few, or the pilot lacks levels of the protocol.
    """
    plan, claims = asked.plan, claims_of(asked.plan).claims
    conditions = [dict(trial.condition) for _, trial, _ in asked.pilot]
    try:
        axes, notes = shared_axes(plan, conditions)
    except KeyedError as error:
        raise input_error(plan.file, error) from None
    work = [asked.judge.work(recording, item.name) for item, _, recording in asked.pilot]
    stale = stale_trials(asked.store, figures.STEP, work)
    run_trials(asked.store, figures.STEP, "figures", stale, figures.kept_figures)
    made = [
        TrialFigures.model_validate(Derived.of(asked.store, figures.STEP, item.name).read(trial.id))
        for item, trial, _ in asked.pilot
    ]
    values: dict[str, F64] = {}
    for claim in claims:
        values[claim.figure] = np.array([each.of(claim.figure) for each in made])
        known = int((~np.isnan(values[claim.figure])).sum())
        if known < FEWEST:
            raise InputError(
                "--store",
                "",
                str(asked.store.folder),
                f"has the figure {claim.figure} of {known} of {len(made)} trials, and at least "
                f"{FEWEST} are needed: the others' labels lack an onset",
            )
    blocks = [(item.name, trial.block) for item, trial, _ in asked.pilot]
    numbers = {block: number for number, block in enumerate(dict.fromkeys(blocks))}
    number = np.array([numbers[block] for block in blocks], np.int64)
    return PilotFigures(axes, tuple(conditions), number, values, sessions_of(asked.pilot)), notes


def sessions_of(pilot: Sequence[PilotTrial]) -> I64:
    """Return the number of each trial's session, (n,).

    A session is of one campaign and one skin, without a pause of `PAUSE_S`.
    """
    known = [item.campaign.provenance(recording) for item, _, recording in pilot]
    kinds: dict[tuple[str, str | None], list[tuple[datetime, datetime, int]]] = {}
    for k, ((item, _, _), it) in enumerate(zip(pilot, known, strict=True)):
        began = datetime.fromisoformat(it.started or "1970-01-01T00:00:00+00:00")
        ended = began if it.ended is None else datetime.fromisoformat(it.ended)
        kinds.setdefault((item.name, it.skin), []).append((began, ended, k))
    found, number = np.zeros(len(known), np.int64), -1
    for trials in kinds.values():
        last: datetime | None = None
        for began, ended, k in sorted(trials):
            number += last is None or (began - last).total_seconds() >= PAUSE_S
            found[k], last = number, ended
    return found


def drawn_campaigns(drawing: Drawing, count: int) -> list[CampaignDraw]:
    """Draw campaigns, on all cores if it takes long."""
    found: dict[int, CampaignDraw] = {}
    with console.bar("drawn campaigns", count) as bar:

        def keep(number: int, made: CampaignDraw) -> None:
            found[number] = made
            bar.advance()

        began = time.monotonic()
        while len(found) < count and time.monotonic() - began < START_S:
            keep(len(found), drawing.campaign(len(found)))
        here = len(found)
        orchestration.run(
            parallel_map_flow,
            "campaigns",
            drawing.campaign,
            range(here, count),
            lambda k, made: keep(here + k, made),
        )
    return [found[number] for number in range(count)]


def learning_curve(asked: PowerRequest) -> tuple[Learning | None, list[str]]:
    """Return the learning curve where a claim is about accuracy; else why there is none."""
    if asked.classifier is None or not any(
        claim.figure == "accuracy" for claim in claims_of(asked.plan).claims
    ):
        return None, []
    parts = [sum(1 for it in asked.campaigns for _ in it.of_split(s)) for s in ("train", "test")]
    if (
        asked.plan.protocol.collection.experiment != "kinematic"
        or parts[0] < FEWEST_TRAINING
        or parts[1] < FEWEST
    ):
        return None, [
            f"no learning curve: it takes {FEWEST_TRAINING} training and {FEWEST} test trials of "
            f"slides, and the pilot has {parts[0]} and {parts[1]}"
        ]
    planned = sum(trial.split == "train" for trial in asked.plan)
    with timed(asked.store, "learning curve"):
        labels = StoreLabels(asked.store)
        train, validation, test = (load_samples(labels, asked.campaigns, split) for split in SPLITS)
        found = dict(_accuracies(asked, train, validation, test))
    orders = range(_orders(asked.classifier))
    counts = np.array([found[0, share][0] for share in learning.SHARES], np.float64)
    accuracy = np.array([[found[order, share][1] for share in learning.SHARES] for order in orders])
    title = TITLES[asked.classifier]
    return learning.learning_of(title, counts, accuracy, planned), []


def _orders(classifier: Classifier) -> int:
    return learning.ORDERS if classifier == LOGISTIC else 1


def _accuracies(
    asked: PowerRequest, train: SampleSet, validation: SampleSet, test: SampleSet
) -> Iterator[tuple[tuple[int, float], tuple[int, list[float]]]]:
    """Yield, by order and share, how many trials trained, and the accuracy on each test trial."""
    assert asked.classifier is not None
    settings = training_campaigns(asked.campaigns)[0].settings
    saved = Derived.of(asked.store, "learning")
    samples = Derived.of(asked.store, SAMPLES)
    inputs = [samples.key(split) for split in SPLITS]
    how = None if asked.classifier == LOGISTIC else settings.model_dump(mode="json")
    shares = [(o, s) for o in range(_orders(asked.classifier)) for s in learning.SHARES]
    with console.bar("learning curve (trainings)", len(shares)) as bar:
        for order, share in shares:
            place = 0 if share == 1.0 else order  # all of them are the same in any order
            name = f"{asked.classifier}-{place}-{round(100 * share)}"
            key = make_key("learning", learning.VERSION, inputs, [place, share, how])
            if not saved.fresh(name, key):
                count, part = learning.share_of(train, share, place)
                accuracy = (
                    learning.logistic_accuracy(part, test)
                    if asked.classifier == LOGISTIC
                    else network_accuracy(settings, part, validation, test)
                )
                saved.write(name, key, {"trials": count, "accuracy": accuracy.tolist()})
            made = saved.read(name)
            bar.advance(1, name)
            yield (order, share), (made["trials"], made["accuracy"])


def network_accuracy(
    settings: AnalysisSettings, train: SampleSet, validation: SampleSet, test: SampleSet
) -> F64:
    """Train a network; return its accuracy on each test trial."""
    from sliplab.analysis.metrics.window_groups import strict_hits
    from sliplab.analysis.networks import training

    fitted = training.fit(
        train.windows,
        train.y,
        validation.windows,
        validation.y,
        settings.network,
        settings.windows,
        settings.training,
        settings.training.seeds[0],
    )
    return learning.by_trial(
        strict_hits(training.predict_counts(fitted, test.windows), test.y), test.trial
    )
