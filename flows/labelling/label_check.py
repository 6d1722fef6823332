"""Labels of a study held against the truth where the camera is simulated whole.

A study on a rig that hands over tracks in the place of video sees labels, but not what finding the
markers does to them. So some of its trials, the first of its shuffled order, are taken once more
on the same rig with its camera at the level `video`, into a store of their own inside the study's,
and their labels are compared with what is true in the simulation.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from sliplab.analysis.campaigns import collected
from sliplab.analysis.labels import labelling
from sliplab.flows.collect import collect
from sliplab.flows.labelling.label import label
from sliplab.flows.labelling.label_errors import CHECK, rules_compared
from sliplab.flows.planning.run_request import RunRequest, make_request
from sliplab.protocols.yaml_file import mask_secrets, parse_yaml
from sliplab.rigs.rig_inheritance import rig_yaml
from sliplab.storage.files import write_text
from sliplab.storage.schema.evaluation import LabelCheck
from sliplab.storage.trials.derived import Derived, make_key
from sliplab.storage.trials.store import Store

VERSION = 1
TRIALS = 60


def folder_of(run_request: RunRequest) -> Path:
    """The store with the video."""
    return run_request.store / CHECK


def video_request(run_request: RunRequest, trials: int) -> RunRequest:
    """The same collection at the level `video`, for the trials that are still missing.

    Args:
        run_request: the study's own, of which something was collected.
    """
    folder = folder_of(run_request)
    data = parse_yaml(mask_secrets(run_request.rig_text), "rig file")
    data["name"] = f"{run_request.rig.name}-video"
    data.setdefault("mock", {}).setdefault("frame_camera", {})["level"] = "video"
    rig = folder.with_suffix(".yaml")
    write_text(rig, rig_yaml(data))
    protocol = Store.open(run_request.store).campaign(run_request.campaign).protocol_file
    wanted = make_request(protocol, rig, folder, campaign=run_request.campaign)
    there = 0
    if (folder / "store.json").exists():
        there = len(Store.open(folder).campaign(run_request.campaign).committed())
    return replace(wanted, most=max(trials - there, 0))


def wanted(run_request: RunRequest) -> bool:
    """Whether there is anything to check: a simulated rig that draws no video."""
    return run_request.rig.simulated and run_request.rig.frame_source == "tracks"


def check_labels(run_request: RunRequest, trials: int = TRIALS) -> dict[str, Any]:
    """Take, label and compare what is missing; the figures are kept in the study's store."""
    video = video_request(run_request, trials)
    taken = collect(video)["taken"] if video.most else 0
    store = Store.open(folder_of(run_request))
    campaigns = collected(store, [video.campaign])
    label(store, campaigns)
    made_of = [recording.checksum for _, recording in campaigns[0].trials]
    key = make_key(CHECK, VERSION, [made_of, labelling.VERSION], None)
    kept = Derived.of(Store.open(run_request.store), CHECK)
    stale = not kept.fresh(CHECK, key)
    if stale:
        figures = rules_compared(store, campaigns)
        found = LabelCheck(trials=len(made_of), simulated=True, rules_ms=figures)
        kept.write(CHECK, key, found)
    return {"step": CHECK, "done": taken or int(stale), "fresh": len(made_of) - taken}
