"""The detectors of a store: its networks, each with its rule, and all that its trials tune."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from sliplab.analysis.campaigns import Collected, collected, training_campaigns
from sliplab.analysis.detectors.alarms import Level
from sliplab.analysis.detectors.detectors import Tuned
from sliplab.analysis.detectors.predictions import predict_trials
from sliplab.analysis.detectors.registry import is_known, known
from sliplab.analysis.detectors.smoothing_rule import paper_rule
from sliplab.analysis.evaluation.detectors import detector_work
from sliplab.analysis.labels.reviewed import StoreLabels
from sliplab.analysis.networks.models import (
    ModelOnDisk,
    choose_model,
    comparison_models,
    rules_of,
    training_settings,
    wanted_models,
)
from sliplab.flows.detecting.sources import NamedSource, named_source
from sliplab.flows.judge_network import spike_keeper
from sliplab.protocols import InputError
from sliplab.protocols.shown import one_of
from sliplab.storage.trials.store import StoreError, TrialStore

OWN = "own"
"""Title of the store's own network."""
NETWORK = "network"
"""Name of its detector with the rule; that of another network is its preset's."""


@dataclass(frozen=True)
class NetworkDetectors:
    """A network with the detectors that read it, and the stride of the windows of each, ms.

    Attributes:
        promised: the levels of detectors by their names, where a promise set them.
    """

    title: str
    model: ModelOnDisk
    detectors: Sequence[tuple[int, Tuned]]
    promised: Mapping[str, Level] = field(default_factory=dict)


def store_detectors(
    store: TrialStore, campaigns: list[Collected], promise: float | None = None
) -> Iterator[NetworkDetectors]:
    """Yield the store's own network with every detector, then the networks that `also` names.

    The first detector of each is its rule; the levels of the others are set by validation trials
    of the store.

    Args:
        promise: false alarms an hour, at most, that these levels promise; None: they leave a share
            of the trials false early.

    Raises:
        StoreError: a network is missing or stale.
    """
    model, settings = choose_model(wanted_models(store, campaigns)), training_settings(campaigns)
    rules = rules_of(campaigns, settings.network.outputs_per_class)
    rule = rules[training_campaigns(campaigns)[0].name]
    detectors: list[tuple[int, Tuned]] = [(settings.stride_ms, paper_rule(rule))]
    promised: dict[str, Level] = {}
    work = detector_work(StoreLabels(store), campaigns, rules, model.key)
    if work.compared is not None and settings.fine_stride_ms is not None:
        keep = spike_keeper(store, None)
        predict_trials(store, model.path, work.requests, keep)
        if promise is None:
            made = work.tune(store, settings, rule)
        else:
            rows = work.promise(store, settings, rule, promise)
            made = [row.rule for row in rows]
            promised = {row.rule.name: row.level for row in rows}
        detectors += [(settings.fine_stride_ms, it) for it in made]
    yield NetworkDetectors(OWN, model, detectors, promised)
    for other in _others(store, campaigns):
        theirs = other.settings
        with_rule = [(theirs.stride_ms, paper_rule(theirs.detection))]
        yield NetworkDetectors(f"preset: {theirs.preset}", other, with_rule)


def _others(store: TrialStore, campaigns: list[Collected]) -> Iterator[ModelOnDisk]:
    """Yield the networks that `also` names. Raises StoreError if one is missing or stale."""
    for other in comparison_models(store, campaigns):
        if not other.fresh:
            raise StoreError(f"{other.path}: is missing or stale; run `sliplab train` first")
        yield other


@dataclass(frozen=True)
class Chosen:
    """A network and what reads its spikes, or another detector.

    Attributes:
        model: None of a detector by its name.
        detector: None for the rule of the protocol that is run.
        stride_ms: from one window's start to the next one's; None for the window's length.
        set_by: the promise that set the level of a tuned detector.
    """

    model: Path | None
    detector: Tuned | NamedSource | None = None
    stride_ms: int | None = None
    set_by: Level | None = None


def detectors_of(
    place: Path | None,
    names: Sequence[str] = (),
    level: float | None = None,
    promise: float | None = None,
) -> dict[str, Chosen]:
    """Return detectors by their names: a model with the rule, or all that a store has.

    Args:
        place: a model file, or a store; None for a detector by its name that needs neither.
        names: of the requested detectors, also such as `sliplab bench` judges; by default all of
            the model or store.
        level: of detectors by their names; None: the store's validation trials set it.
        promise: false alarms an hour, at most, at which these set levels.

    Raises:
        InputError: there is none, or nothing at `place`.
        StoreError: a network of the store is missing or stale.
    """
    if place is not None and not place.exists():
        raise InputError(
            place, "", None, "is not there; expected a store's folder or a model's file"
        )
    store = place if place is not None and place.is_dir() else None
    found: dict[str, Chosen] = {}
    if place is not None:
        found = {place.stem: Chosen(place)} if store is None else _of_store(store, names, promise)
    for name in names:
        if name in found:
            continue
        if not is_known(name):
            raise InputError(
                "--detector", "", name, one_of(name, list(dict.fromkeys([*found, *known()])))
            )
        found[name] = Chosen(None, named_source(name, level, store, promise))
    return {name: found[name] for name in names or found}


def _of_store(place: Path, names: Sequence[str], promise: float | None) -> dict[str, Chosen]:
    """Return the networks with their rules, and the tuned detectors, unless none is wanted."""
    if not any((place / "models").glob("*.pt")):
        if names and all(map(is_known, names)):
            return {}
        right = "has no models/*.pt: train it first, or name a model file"
        raise InputError("MODEL", "", place, right)
    store = TrialStore(place)
    campaigns = collected(store, None)
    found = {NETWORK: Chosen(choose_model(wanted_models(store, campaigns)).path)}
    for other in _others(store, campaigns):
        found[str(other.settings.preset)] = Chosen(other.path)
    if names and all(name in found or is_known(name) for name in names):
        return found
    for network in store_detectors(store, campaigns, promise):
        for stride_ms, tuned in network.detectors[1:]:  # the first one is the rule
            set_by = network.promised.get(tuned.name)
            found[tuned.name] = Chosen(network.model.path, tuned, stride_ms, set_by)
    return found
