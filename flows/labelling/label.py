"""Labelling: ground truth for every committed trial whose label is missing or stale."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.labels import labelling
from sliplab.flows.running.parallel_map import TrialWork, run_trials, stale_trials
from sliplab.protocols.settings import Labelling
from sliplab.storage.schema.label import LABELS as STEP
from sliplab.storage.trials.derived import make_key
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import Store

if TYPE_CHECKING:
    from sliplab.flows.running.cluster import Cluster


def label_key(recording: Recording, settings: Labelling) -> str:
    """The key of a trial's label."""
    return make_key(STEP, labelling.VERSION, recording.checksum, settings.model_dump(mode="json"))


def _wanted(campaigns: list[Collected]) -> list[TrialWork]:
    """The label of every trial."""
    return [
        TrialWork(recording, item.name, label_key(recording, settings), settings)
        for item in campaigns
        for settings in (item.settings.labelling,)
        for _, recording in item.trials
    ]


def label(
    store: Store, campaigns: list[Collected], cluster: Cluster | None = None
) -> dict[str, Any]:
    """Label every trial of `campaigns` that needs it."""
    wanted = _wanted(campaigns)
    stale = stale_trials(store, STEP, wanted)
    run_trials(store, STEP, "label", stale, labelling.label_results, cluster)
    return {"step": "label", "done": len(stale), "fresh": len(wanted) - len(stale)}
