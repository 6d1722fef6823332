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

from sliplab.analysis.labels import labelling
from sliplab.flows.collecting.collect import collect
from sliplab.flows.labelling.label import label
from sliplab.flows.labelling.label_errors import CHECK, rules_compared
from sliplab.flows.planning.orders import Order, make_order
from sliplab.flows.running.campaigns import collected
from sliplab.protocols.yaml_file import mask_secrets, parse_yaml
from sliplab.rigs.rig_inheritance import rig_yaml
from sliplab.storage.derived import Derived, make_key
from sliplab.storage.files import write_text
from sliplab.storage.store import Store

VERSION = 1
TRIALS = 60


def folder_of(order: Order) -> Path:
    """The store with the video."""
    return order.store / CHECK


def video_order(order: Order, trials: int) -> Order:
    """The same collection at the level `video`, for the trials that are still missing.

    Args:
        order: the study's own, of which something was collected.
    """
    folder = folder_of(order)
    data = parse_yaml(mask_secrets(order.rig_text), "rig file")
    data["name"] = f"{order.rig.name}-video"
    data.setdefault("mock", {}).setdefault("frame_camera", {})["level"] = "video"
    rig = folder.with_suffix(".yaml")
    write_text(rig, rig_yaml(data))
    protocol = Store.open(order.store).campaign(order.campaign).protocol_file
    wanted = make_order(protocol, rig, folder, campaign=order.campaign)
    there = 0
    if (folder / "store.json").exists():
        there = len(Store.open(folder).campaign(order.campaign).committed())
    return replace(wanted, most=max(trials - there, 0))


def wanted(order: Order) -> bool:
    """Whether there is anything to check: a simulated rig that draws no video."""
    return order.rig.simulated and order.rig.frame_source == "tracks"


def check_labels(order: Order, trials: int = TRIALS) -> dict[str, Any]:
    """Take, label and compare what is missing; the figures are kept in the study's store."""
    video = video_order(order, trials)
    taken = collect(video)["taken"] if video.most else 0
    store = Store.open(folder_of(order))
    campaigns = collected(store, [video.campaign])
    label(store, campaigns)
    made_of = [recording.checksum for _, recording in campaigns[0].trials]
    key = make_key(CHECK, VERSION, [made_of, labelling.VERSION], None)
    kept = Derived.of(Store.open(order.store), CHECK)
    stale = not kept.fresh(CHECK, key)
    if stale:
        figures = rules_compared(store, campaigns)
        kept.write(CHECK, key, {"trials": len(made_of), "simulated": True, "rules_ms": figures})
    return {"step": CHECK, "done": taken or int(stale), "fresh": len(made_of) - taken}
