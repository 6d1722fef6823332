"""A campaign's trials on a rig that differs from its own in a few simulated numbers."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from flows.planning.orders import Order, make_order
from flows.running.campaigns import Collected
from protocols.yaml_file import parse_yaml, read_text
from rigs.rig_inheritance import rig_yaml
from storage.files import make_folder, write_text


def other_order(
    item: Collected, change: Mapping[str, Any], folder: Path, most: int | None = None
) -> Order:
    """An order for the same protocol, into ``folder/store``.

    Args:
        change: values by key, as deep as they stand in a rig file.
        folder: gets the changed rig file too.
        most: trials at most.
    """
    source = item.campaign.folder / "rig.yaml"
    data = parse_yaml(read_text(source, "rig file"), source)
    _merge(data, change)
    make_folder(folder)
    rig = folder / f"{item.name}.yaml"
    write_text(rig, rig_yaml(data))
    enabled: Any = item.info.get("enabled", ())
    return make_order(
        item.campaign.protocol_file, rig, folder / "store",
        enable=tuple(enabled), campaign=item.name, most=most,
    )  # fmt: skip


def _merge(data: dict[str, Any], other: Mapping[str, Any]) -> None:
    for name, value in other.items():
        if isinstance(value, Mapping) and isinstance(data.setdefault(name, {}), dict):
            _merge(data[name], value)
        else:
            data[name] = value
