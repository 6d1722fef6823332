"""The campaign of recorded trials: it has an adapter in a protocol's place, as an import has."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from sliplab.protocols.adapter import Adapter, load_adapter
from sliplab.protocols.errors import InputError
from sliplab.protocols.yaml_file import parse_yaml, read_text, validate
from sliplab.storage.process import now
from sliplab.storage.streams import EVENTS_KIND, Json
from sliplab.storage.trials.store import ADAPTER, IMPORTED, Campaign, CampaignInfo

FORMAT = "record"
_MAY = ("title", "about", "experiment", "classes", "split", "analysis")
_RIG = "# Recorded: there is no rig file.\nimported: record\n"


def join(campaign: Campaign, analysis: Path | None, simulated: bool) -> str:
    """Describe a new campaign, or check that the one there was recorded; return its experiment.

    Args:
        analysis: file with the settings of the analysis; without it those there stay.

    Raises:
        InputError: the campaign is another one, or the settings are wrong.
    """
    begun = campaign.begun
    origin: Json = {"from": "sliplab record", "format": FORMAT, ADAPTER: 1, "when": now()}
    if begun:
        origin = campaign.info.get(IMPORTED, {})
        if origin.get("format") != FORMAT:
            text = "is a campaign that was not recorded so; choose another name"
            raise InputError("--campaign", "", campaign.name, text)
        if campaign.info["simulated"] != simulated:
            text = "has trials that are marked as simulated, or not; choose another campaign"
            raise InputError("simulated", "", simulated, text)
    if analysis is None and begun:
        campaign.finish_description()
        return load_adapter(campaign.protocol_file).experiment
    text = _text(campaign.name, analysis, simulated)
    adapter = validate(Adapter, parse_yaml(text, analysis or "adapter"), analysis or "adapter")
    info: CampaignInfo = {
        "name": campaign.name,
        "simulated": simulated,
        "experiment": adapter.experiment,
        IMPORTED: origin,
    }
    campaign.update(info, text, _RIG)
    return adapter.experiment


def _text(name: str, analysis: Path | None, simulated: bool) -> str:
    """Return the adapter of recorded trials: only its analysis and split mean something."""
    text, given = "", dict[str, Any]()
    if analysis is not None:
        text = read_text(analysis, "analysis file")
        given = parse_yaml(text, analysis)
        if wrong := [key for key in given if key not in _MAY]:
            raise InputError(analysis, wrong[0], None, f"must be one of {', '.join(_MAY)}")
    head: dict[str, Any] = {
        "adapter": 1,
        "name": name,
        "simulated": simulated,
        "trials": {"files": "*"},
        "streams": {EVENTS_KIND: {"format": "dsec"}},
    }
    if "experiment" not in given:
        head["experiment"] = "kinematic"
    lines = [f"{key}: {json.dumps(value)}" for key, value in head.items()]
    return "\n".join(["# Recorded by `sliplab record`.", *lines, text])
