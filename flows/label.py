"""Labelling of every committed trial whose label is missing or stale, and a check with video.

Labels from marker tracks do not include the error of finding the markers in a
video. So some of a study's trials, the first of its shuffled order, are repeated
on the same rig with its camera at the level `video`, into a separate store inside the study's,
and their labels are compared with the simulation's truth.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, TypedDict

from sliplab.analysis.campaigns import Collected, collected
from sliplab.analysis.labels import labelling
from sliplab.analysis.labels.label_errors import CHECK, rules_compared
from sliplab.analysis.labels.reviewed import State, StoreLabels, label_key
from sliplab.analysis.trial_work import TrialWork, stale_trials
from sliplab.flows.running import console
from sliplab.flows.running.parallel_map import run_trials
from sliplab.flows.steps import StepResult
from sliplab.protocols.shown import plural
from sliplab.protocols.yaml_file import mask_secrets, parse_yaml
from sliplab.rigs.rig_inheritance import rig_yaml
from sliplab.storage.files import write_text
from sliplab.storage.schema.evaluation import LabelCheck
from sliplab.storage.schema.label import LABELS
from sliplab.storage.trials.derived import Derived, make_key
from sliplab.storage.trials.store import TrialStore

if TYPE_CHECKING:
    from sliplab.flows.planning.run_request import RunRequest
    from sliplab.flows.running.cluster import Cluster

CHECK_VERSION = 1
CHECKED_TRIALS = 60


def _required_labels(campaigns: list[Collected]) -> list[TrialWork]:
    """The label of every trial."""
    return [
        TrialWork(recording, item.name, label_key(recording, settings), settings)
        for item in campaigns
        for settings in (item.settings.labelling,)
        for _, recording in item.trials
    ]


def label(
    store: TrialStore, campaigns: list[Collected], cluster: Cluster | None = None
) -> StepResult:
    """Label every trial of `campaigns` that needs it.

    Trials without frames are labelled by their events.
    """
    required = _required_labels(campaigns)
    stale = stale_trials(store, LABELS, required)
    run_trials(store, LABELS, "label", stale, labelling.label_results, cluster)
    return {"step": "label", "done": len(stale), "fresh": len(required) - len(stale)}


class Reviewed(TypedDict, total=False):
    """Review states in a step's result; no key where decisions are not applied."""

    reviewed: dict[State, int]


def report_states(labels: StoreLabels, campaigns: list[Collected]) -> Reviewed:
    """Return review states as part of a step's result; warn of decisions that are not applied."""
    states = labels.states(campaigns)
    if states is None:
        return {}
    if states["stale"]:
        console.say(
            f"warning: decisions on {plural(states['stale'], 'trial')} were made on labels "
            "that have "
            f"changed since and are not applied; see `sliplab review {labels.store.folder}`"
        )
    return {"reviewed": states}


def check_folder(run_request: RunRequest) -> Path:
    """The store with the video."""
    return run_request.store / CHECK


def video_request(run_request: RunRequest, trials: int) -> RunRequest:
    """The same collection at the level `video`, for the trials that are still missing.

    Args:
        run_request: the study's own, of which something was collected.
    """
    from sliplab.flows.planning.run_request import make_request

    folder = check_folder(run_request)
    data = parse_yaml(mask_secrets(run_request.rig_text), "rig file")
    data["name"] = f"{run_request.rig.name}-video"
    data.setdefault("mock", {}).setdefault("frame_camera", {})["level"] = "video"
    rig = folder.with_suffix(".yaml")
    write_text(rig, rig_yaml(data))
    protocol = TrialStore.open(run_request.store).campaign(run_request.campaign).protocol_file
    request = make_request(protocol, rig, folder, campaign=run_request.campaign, claims="ignore")
    there = 0
    if (folder / "store.json").exists():
        there = len(TrialStore.open(folder).campaign(run_request.campaign).committed())
    return replace(request, most=max(trials - there, 0))


def check_required(run_request: RunRequest) -> bool:
    """Return True where labels need a check: a simulated rig that draws no video."""
    return run_request.rig.simulated and run_request.rig.frame_source == "tracks"


def check_labels(run_request: RunRequest, trials: int = CHECKED_TRIALS) -> StepResult:
    """Take, label and compare missing trials; save the figures in the study's store."""
    from sliplab.flows.collect import collect  # a command that only labels needs no rig

    video = video_request(run_request, trials)
    taken = collect(video)["taken"] if video.most else 0
    store = TrialStore.open(check_folder(run_request))
    campaigns = collected(store, [video.campaign])
    label(store, campaigns)
    made_of = [recording.checksum for _, recording in campaigns[0].trials]
    key = make_key(CHECK, CHECK_VERSION, [made_of, labelling.VERSION], None)
    stored = Derived.of(TrialStore.open(run_request.store), CHECK)
    stale = not stored.fresh(CHECK, key)
    if stale:
        figures = rules_compared(store, campaigns)
        found = LabelCheck(trials=len(made_of), simulated=True, rules_ms=figures)
        stored.write(CHECK, key, found)
    return {"step": CHECK, "done": taken or int(stale), "fresh": len(made_of) - taken}
