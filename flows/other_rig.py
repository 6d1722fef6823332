"""Trials of a campaign on a rig with other simulated numbers: taken and labelled."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sliplab.analysis.campaigns import Collected, collected
from sliplab.flows.collect import collect
from sliplab.flows.label import label
from sliplab.flows.planning.run_request import RunRequest, make_request
from sliplab.protocols.yaml_file import parse_yaml, read_text
from sliplab.rigs.rig_inheritance import rig_yaml
from sliplab.storage.files import make_folder, write_text
from sliplab.storage.trials.store import TrialStore


def other_request(
    item: Collected,
    change: Mapping[str, Any],
    folder: Path,
    most: int | None = None,
    protocol: Mapping[str, Any] | None = None,
) -> RunRequest:
    """Return a run request for the same protocol, into ``folder/store``.

    Args:
        change: values by key, nested as in a rig file.
        folder: gets the changed rig file too.
        most: trials at most.
        protocol: values of the protocol to change, likewise.
    """
    make_folder(folder)
    rig = folder / f"{item.name}.yaml"
    _write_changed(item.campaign.folder / "rig.yaml", "rig file", change, rig)
    file = item.campaign.protocol_file
    if protocol is not None:
        file = folder / f"{item.name}.protocol.yaml"
        _write_changed(item.campaign.protocol_file, "protocol", protocol, file)
    return make_request(
        file,
        rig,
        folder / "store",
        enable=tuple(item.info.get("enabled", ())),
        campaign=item.name,
        most=most,
        claims="ignore",
    )


def _write_changed(source: Path, what: str, change: Mapping[str, Any], path: Path) -> None:
    data = parse_yaml(read_text(source, what), source)
    _merge(data, change)
    write_text(path, rig_yaml(data))


def _merge(data: dict[str, Any], other: Mapping[str, Any]) -> None:
    for name, value in other.items():
        if isinstance(value, Mapping) and isinstance(data.setdefault(name, {}), dict):
            _merge(data[name], value)
        else:
            data[name] = value


def retake(run_requests: Sequence[RunRequest]) -> tuple[TrialStore, list[Collected]]:
    """Take the missing trials and label them; return the store and its campaigns."""
    store = TrialStore.create(run_requests[0].store)
    for run_request in run_requests:
        collect(run_request)
    campaigns = collected(store, [run_request.campaign for run_request in run_requests])
    label(store, campaigns)
    return store, campaigns
