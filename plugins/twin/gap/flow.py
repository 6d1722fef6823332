"""`sliplab calibrate gap`: networks trained on a twin, tested on the rig that it imitates.

The training trials of a protocol are simulated on the twin, on the rig file as it was before it was
fitted, and on rigs drawn from the twin's posterior, among which the trials are divided. A network
is trained on each, and tested on the real test trials along with the store's own.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from sliplab.analysis.campaigns import Collected, training_campaigns
from sliplab.analysis.evaluation.trials import EvaluatedTrials, judge, summaries
from sliplab.analysis.networks import model_file
from sliplab.analysis.networks.models import (
    ModelOnDisk,
    choose_model,
    rules_of,
    training_settings,
    wanted_models,
)
from sliplab.flows.other_rig import retake
from sliplab.flows.planning.run_request import RunRequest, make_request
from sliplab.flows.running import console
from sliplab.flows.train import train
from sliplab.plugins.twin.document import TITLES, Behind, GapNetwork, TrainedOn, TwinGap
from sliplab.plugins.twin.drawn_rigs import read_samples, samples_file, write_drawn
from sliplab.plugins.twin.gap.scores import behind, macro_f1
from sliplab.protocols import InputError, Plan, load_plan
from sliplab.protocols.detection import Detection
from sliplab.protocols.yaml_file import parse_yaml, read_text
from sliplab.rigs.rig_inheritance import read_rig, rig_path, rig_yaml
from sliplab.storage.files import make_folder, write_text
from sliplab.storage.trials.store import StoreError, TrialStore

TRAINING = ("train", "validation")


@dataclass(frozen=True)
class Gap:
    """Request of a comparison, checked.

    Attributes:
        tested: campaigns of the store whose test trials judge.
        rig: file of the twin. fitted: file that has its fit. assumed: that this one extends.
        plan: of the trials that train. out: folder of all that is made. drawn: number of rigs.
    """

    store: TrialStore
    tested: list[Collected]
    rig: Path
    fitted: Path
    assumed: Path
    plan: Plan
    out: Path
    drawn: int


@dataclass(frozen=True)
class Trained:
    """A network, and the trials that trained and chose it."""

    trained_on: TrainedOn
    rig: str
    simulated: bool
    rigs: int
    trials: int
    model: ModelOnDisk


def request(
    store: TrialStore, tested: list[Collected], rig: Path, protocol: Path, out: Path, drawn: int
) -> Gap:
    """Check a request before anything is simulated.

    Raises:
        InputError: the rig is no twin, its samples are missing, or the protocol trains no network
            that could be tested here.
        StoreError: there are no labelled test trials with events.
    """
    path = rig_path(rig)
    parts = read_rig(path).parts
    place = next((k for k, (_, data) in enumerate(parts) if "twin" in data), len(parts))
    if place + 1 >= len(parts):
        text = "must be a twin that `sliplab calibrate scene` wrote, or a file that extends one"
        raise InputError("--rig", "", str(rig), text)
    read_samples(samples_file(parts[place][0]), drawn)
    plan = load_plan(protocol)
    if plan.protocol.collection.experiment != "kinematic":
        raise InputError("--protocol", "", str(protocol), "must be kinematic: slides train")
    for part in TRAINING:
        if not any(trial.split == part for trial in plan):
            raise InputError("--protocol", "", str(protocol), f"has no {part} trials")
    if plan.protocol.analysis.windows != training_settings(tested).windows:
        name = training_campaigns(tested)[0].name
        text = f"must have the windows of the campaign '{name}', on which networks are tested"
        raise InputError("--protocol", "analysis.windows", str(protocol), text)
    for item in tested:
        item.need("events", "a network is tested on windows of them")
    if not any(True for item in training_campaigns(tested) for _ in item.of_split("test")):
        raise StoreError(f"{store.folder}: has no test trials of slides")
    return Gap(store, tested, path, parts[place][0], parts[place + 1][0], plan, out, drawn)


def measure_gap(wanted: Gap) -> TwinGap:
    """Train what is missing and test all networks.

    Raises:
        StoreError: a tested trial has no label, or a folder holds trials of another twin.
    """
    make_folder(wanted.out)
    networks = [*own_network(wanted)]
    for name, run_requests in requests(wanted).items():
        console.say(f"network of {TITLES[name]} (simulated)")
        networks.append(simulated_network(name, run_requests))
    judged = [tested(wanted, network.model) for network in networks]
    first = judged[0]
    return TwinGap(
        simulated=any(item.info.get("simulated") for item in wanted.tested),
        campaigns=tuple(item.name for item in wanted.tested),
        trials=len(first.rows),
        rig=wanted.rig.stem,
        protocol=wanted.plan.protocol.name,
        networks=tuple(
            scores(wanted, network, one, None if one is first else behind(first, one))
            for network, one in zip(networks, judged, strict=True)
        ),
    )


def own_network(wanted: Gap) -> Iterator[Trained]:
    """Yield the network that the store trained on its own trials, if it has one.

    Raises:
        StoreError: a trial has no label.
    """
    models = wanted_models(wanted.store, wanted.tested)
    if not all(model.fresh for model in models):
        return
    used = training_campaigns(wanted.tested)
    trials = sum(trial.split in TRAINING for item in used for trial, _ in item.trials)
    simulated, rig = bool(used[0].info.get("simulated")), used[0].info["rig"]
    yield Trained("own", rig, simulated, 1, trials, choose_model(models))


def requests(wanted: Gap) -> dict[TrainedOn, list[RunRequest]]:
    """Return what each simulated network's trials are requested by; write the files for it.

    Raises:
        StoreError: the folder holds trials of another twin or protocol.
    """
    protocol = wanted.out / "protocol.yaml"
    data = parse_yaml(read_text(Path(wanted.plan.file), "protocol"), wanted.plan.file)
    # the network of `also` is tested nowhere
    data["analysis"].pop("also", None)
    write_text(protocol, rig_yaml(data))
    training = [trial.id for trial in wanted.plan if trial.split in TRAINING]
    drawn = [wanted.out / f"drawn-{k + 1}.yaml" for k in range(wanted.drawn)]
    samples = read_samples(samples_file(wanted.fitted), wanted.drawn)
    for file, values in zip(drawn, samples, strict=True):
        write_drawn(wanted.rig, values, file)
    rigs: dict[TrainedOn, list[Path]] = {
        "twin": [wanted.rig],
        "drawn": drawn,
        "assumed": [wanted.assumed],
    }
    try:
        return {
            name: [
                replace(
                    make_request(
                        protocol,
                        rig,
                        wanted.out / name,
                        campaign=f"{name}-{k + 1}",
                        claims="ignore",
                    ),
                    only=frozenset(training[k :: len(files)]),
                )
                for k, rig in enumerate(files)
            ]
            for name, files in rigs.items()
        }
    except StoreError as error:
        text = f"holds trials of another twin or protocol; name another folder with --out ({error})"
        raise StoreError(f"{wanted.out}: {text}") from error


def simulated_network(name: TrainedOn, run_requests: list[RunRequest]) -> Trained:
    """Take, label and train what is missing."""
    store, campaigns = retake(run_requests)
    train(store, campaigns)
    trials = sum(len(item.trials) for item in campaigns)
    model = choose_model(wanted_models(store, campaigns))
    rig = run_requests[0].rig.name if len(run_requests) == 1 else f"{len(run_requests)} drawn rigs"
    return Trained(name, rig, True, len(run_requests), trials, model)


def tested(wanted: Gap, model: ModelOnDisk) -> EvaluatedTrials:
    """Test a network on the real test trials, by their protocols' own rules."""
    fitted = model_file.load(model.path)
    return judge(fitted, rules(wanted, model), wanted.store, wanted.tested)


def rules(wanted: Gap, model: ModelOnDisk) -> dict[str, Detection]:
    """Return the rule of each tested campaign, in spikes of a network."""
    return rules_of(wanted.tested, model.settings.network.outputs_per_class)


def scores(
    wanted: Gap, network: Trained, judged: EvaluatedTrials, less: Behind | None
) -> GapNetwork:
    """Return the stored result of a network.

    Args:
        less: how far it is behind the first one.
    """
    slides = training_campaigns(wanted.tested)[0].name
    windows = judged.window_scores(rules(wanted, network.model)[slides].margin)
    return GapNetwork(
        trained_on=network.trained_on,
        rig=network.rig,
        simulated=network.simulated,
        rigs=network.rigs,
        trials=network.trials,
        validation=network.model.info.validation.strict,
        windows=windows,
        f1=macro_f1(windows),
        experiments=summaries(judged.rows),
        behind=less,
    )
