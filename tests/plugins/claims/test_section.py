"""Claims in a report: each with the look that called it, and every look as data."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.report.page import render_section
from sliplab.analysis.report.plugin_sections import ReportData
from sliplab.plugins.claims.document import ClaimState, Look, StoppingRecord
from sliplab.plugins.claims.section import claims_key, claims_section
from sliplab.storage.files import write_json
from sliplab.storage.schema.campaign_end import STOPPING
from sliplab.storage.trials.store import TrialStore


def state(low: float | None, **more: Any) -> ClaimState:
    """A claim of at most 90 ms."""
    return ClaimState(
        claim="median latency at most 90 ms",
        kind="at_most",
        value=90.0,
        unit="ms",
        trials=7,
        estimate=70.5,
        low=low,
        high=None,
        **{"holds": False, "refuted": False, **more},
    )


def campaign(
    folder: Path, small: dict[str, Any], looks: tuple[Look, ...] | None
) -> tuple[TrialStore, list[Collected]]:
    """A store with a campaign that has looked at a claim, without its trials."""
    claims = [{"figure": "latency_incipient", "at_most": "90 ms"}]
    small["collection"]["stopping"] = {"claims": claims, "error": 0.1}
    store = TrialStore.create(folder / "store")
    found = store.campaign("pilot")
    info: Any = {"name": "pilot", "experiment": "kinematic", "simulated": True, "enabled": []}
    found.update(info, yaml.safe_dump(small, sort_keys=False), "")
    if looks is not None:
        record = StoppingRecord(
            simulated=True, section="s", model=None, verdict="settled", looks=looks
        )
        write_json(found.folder / STOPPING, record.to_json())
    return store, [Collected(found)]


def test_a_claim_stands_with_the_look_that_called_it(tmp_path: Path, small: dict[str, Any]) -> None:
    looks = (
        Look(round=1, taken=9, claims=(state(None),)),
        Look(round=2, taken=18, claims=(state(60.0, holds=True),)),
        Look(round=3, taken=27, claims=(state(61.0, holds=True),)),
    )
    found = campaign(tmp_path, small, looks)
    section = claims_section(ReportData(*found, True))
    assert section is not None
    (shown,) = section.campaigns
    assert (shown.taken, shown.planned, shown.error, shown.chosen) == (27, 36, 10.0, False)
    (row,) = shown.table.rows
    assert row == [
        "median latency at most 90 ms",
        "holds",
        "18",
        "70.5",
        "61",
        "–",
        "ms",
        "7",
        "0",
        "0",
        "0",
        "–",
    ]
    data = shown.figure.data
    assert data["trials"] == [9, 18, 27]
    assert data["1: median latency at most 90 ms, low (ms)"] == [None, 60.0, 61.0]
    text = render_section(section, simulated=True).html
    assert "27 of 36 trials" in text
    assert "every claim is settled" in text
    assert "Claims and estimates are of conditions repeated for ever" in text
    assert "simulated" in text
    assert claims_key(*found)


def test_a_campaign_without_looks_has_no_section(tmp_path: Path, small: dict[str, Any]) -> None:
    assert claims_section(ReportData(*campaign(tmp_path / "a", small, None), True)) is None
    assert claims_section(ReportData(*campaign(tmp_path / "b", small, ()), True)) is None
    assert claims_key(*campaign(tmp_path / "c", small, None)) == []
