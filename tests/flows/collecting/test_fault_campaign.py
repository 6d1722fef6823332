"""Every fault by name, once each in a campaign of 30 trials: docs/faults.md says what comes of it.

The page is compared with what happens: the arm, the trial, the gates that failed, and the message
to the operator. A wrong row fails here, with the right one.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from sliplab.analysis.labels.labelling import label_recording
from sliplab.flows.planning.campaign_trials import pending_trials
from sliplab.protocols.labelling import Labelling
from sliplab.rigs.core.capabilities import ArmFault, ArmState, RigError
from sliplab.rigs.core.faults import KINDS
from sliplab.rigs.core.rig import Rig
from sliplab.storage.errors import StoreError
from sliplab.storage.trials.store import Campaign, TrialStore
from sliplab.storage.trials.verify import verify
from tests.conftest import ROOT
from tests.flows.collecting.test_session import checksums, session, short
from tests.flows.conftest import requested, tiny_gravity

PLANNED = 30
_GATE = re.compile(r"(?:gate: |; )(\w+)(?: =|:)")
"""Name of a failed gate in the cause of a quarantined trial."""
CLEAR_MM = -0.5
"""Depth above which the tip stands clear of the plate."""

FAULTS: list[dict[str, Any]] = [
    {"kind": "arm_protective_stop", "at_mm": 0.8},
    {"kind": "arm_off_path", "mm": 0.3, "seconds": 0.5},
    {"kind": "frames_lost", "count": 3},
    {"kind": "frame_late", "seconds": 0.05},
    {"kind": "event_gap"},
    {"kind": "event_stall", "seconds": 0.3},
    {"kind": "event_burst", "seconds": 0.02},
    {"kind": "clock_drift", "device": "event_camera", "ppm": 20},
    {"kind": "clock_drift", "device": "sync_box", "ppm": 2000},
    {"kind": "clock_jump", "device": "arm", "seconds": 0.25},
    {"kind": "clock_jump", "device": "frame_camera", "seconds": -5000},
    {"kind": "clock_restart", "device": "event_camera"},
    {"kind": "pulses_lost", "count": 5},
    {"kind": "pulses_duplicated", "count": 5, "device": "arm"},
    {"kind": "pulses_late", "count": 5},
    {"kind": "pulses_late", "count": 30, "device": "arm"},
    {"kind": "papilla_torn", "papilla": 0},
    {"kind": "marker_occluded", "papilla": 0},
    {"kind": "papilla_sticky", "papilla": 3},
    {"kind": "skin_wear", "per_m": -0.5},
    {"kind": "plate_spot", "centre_mm": [9, 4], "radius_mm": 4},
    {"kind": "mains_light", "share": 0.08},
    {"kind": "mains_light", "share": 0.15},
    {"kind": "knock"},
    {"kind": "shaking"},
    {"kind": "event_noise"},
    {"kind": "skin_brushed"},
    {"kind": "arm_ramp", "mm_s2": 20},
    {"kind": "arm_ramp"},
    {"kind": "disk_full"},
    {"kind": "device_gone", "device": "arm"},
    {"kind": "device_gone", "device": "event_camera"},
    {"kind": "device_gone", "device": "frame_camera"},
    {"kind": "device_gone", "device": "sync_box"},
]
"""Each happens once, in the middle of a trial of its own; a plate sticks only where one falls."""
WHOLE_TRIALS = {"plate_stuck", "papilla_sticky", "skin_wear", "plate_spot", "arm_ramp"}


@dataclass(frozen=True)
class Row:
    """Return the outcome of a fault, in the terms of docs/faults.md."""

    fault: str
    trial: str
    message: str


def _shown(fault: dict[str, Any]) -> str:
    """A fault as it stands in a rig file."""
    return "{" + ", ".join(f"{key}: {value}" for key, value in fault.items()) + "}"


def _numbers_aside(text: str) -> str:
    """Words without their figures, which another processor may give in another last digit."""
    return re.sub(r"-?\d+(\.\d+)?(e-?\d+)?", "#", text)


def _arm(rig: Rig) -> str:
    """Return the arm's action when its trial ended early."""
    try:
        clear = rig.plate_frame.position(rig.arm.pose().xyz_mm).depth_mm < CLEAR_MM
        ready = rig.arm.state() is ArmState.READY
    except ArmFault:
        return "does not move"
    assert clear is ready  # it moves if, and only if, it is healthy
    return "retracts" if clear else "stays"


def _suffer(
    folder: Path, data: dict[str, Any], fault: dict[str, Any]
) -> tuple[Row, Campaign, set[str]]:
    """The next trial of a campaign with a fault in it; the trials that it committed, too."""
    at = {} if fault["kind"] in WHOLE_TRIALS or "at_mm" in fault else {"at_s": 0.8}
    work, campaign = session(
        folder, data, faults=[{**fault, "trial": 1, **at}], frame_camera={"level": "tracks"}
    )
    before = campaign.committed()
    (trial, *_) = pending_trials(work.plan, campaign)
    aside = {item["folder"] for item in campaign.quarantined()}
    error = ""
    try:
        work.take([trial])
    except (RigError, StoreError) as ended:
        error = str(ended).replace(f"{folder}/", "")
    arm = _arm(work.rig) if error else ""
    work.rig.close()
    made = campaign.committed() - before
    causes = [str(item["cause"]) for item in campaign.quarantined() if item["folder"] not in aside]
    if error:
        assert len(causes) == 1
        row = Row(_shown(fault), f"quarantined; the arm {arm}", error)
    elif causes:
        gates = [name for cause in causes for name in _GATE.findall(cause)]
        row = Row(_shown(fault), "retaken", ", ".join(gates))
    else:
        (recording,) = [each for each in campaign.recordings() if each.trial_id in made]
        doubts = label_recording(recording, Labelling()).document().doubts.to_json()
        reported = "; ".join(sorted({str(why) for why in doubts.values() if why is not None}))
        row = Row(_shown(fault), "good", f"label: {reported}" if reported else "")
    return row, campaign, made


def _table() -> dict[str, Row]:
    """The outcomes in docs/faults.md, by fault: one list of good trials, and rows."""
    text = (ROOT / "docs" / "faults.md").read_text().split("## Outcome of each fault")[1]
    good = text.split("**Good, no message:**")[1].split("\n\n")[0]
    rows = [Row(fault, "good", "") for fault in re.findall(r"`([^`]*)`", good)]
    for line in text.splitlines():
        if line.startswith("| `"):
            rows.append(Row(*(cell.strip().strip("`") for cell in line.strip("|").split("|"))))
    table = {row.fault: row for row in rows}
    assert len(table) == len(rows)
    return table


def test_the_table_in_the_docs_has_every_fault() -> None:
    falling = {"kind": "plate_stuck"}
    assert _table().keys() == {_shown(fault) for fault in [*FAULTS, falling]}
    # this rig has no further devices; tests/flows/collecting/test_further_streams.py loses some
    assert {fault["kind"] for fault in FAULTS} | {"plate_stuck", "stream_gone"} == set(KINDS)


@pytest.mark.parametrize("every", [6, pytest.param(1, marks=pytest.mark.long)])
def test_faults_once_each_in_a_campaign_as_in_the_table(tmp_path: Path, every: int) -> None:
    data = short()
    planned = min(PLANNED, len(FAULTS[::every]))
    directions = [round(137.508 * number % 360, 2) for number in range(planned)]
    data["collection"]["factors"]["direction"]["values"] = directions
    data["collection"]["maintenance"] = {}  # a trial is the first thing that the rig does
    rows = []
    kept: dict[str, str] = {}
    for fault in FAULTS[::every]:
        row, campaign, _ = _suffer(tmp_path, data, fault)
        rows.append(row)
        now = checksums(campaign)
        assert kept.items() <= now.items()  # what was committed stays as it was
        kept = now
    sound, campaign = session(tmp_path, data, frame_camera={"level": "tracks"})
    sound.take(pending_trials(sound.plan, campaign))
    assert len(sound.plan) == len(campaign.committed()) == planned
    assert kept.items() <= checksums(campaign).items()
    assert verify(TrialStore.open(tmp_path / "store")) == []
    counts = requested(tmp_path).counts(campaign)
    assert (counts["planned"], counts["missing"], counts["set_aside"]) == (planned, 0, [])

    falling = tiny_gravity()
    falling["collection"]["motion"][6]["distance"] = "0.5 mm"
    row, _, _ = _suffer(tmp_path / "falling", falling, {"kind": "plate_stuck"})
    rows.append(row)

    reported = _table()
    for row in rows:
        true = f"| `{row.fault}` | {row.trial} | {row.message} |"
        assert row.fault in reported, true
        said = reported[row.fault]
        assert said.trial == row.trial, true
        assert _numbers_aside(said.message) == _numbers_aside(row.message), true
