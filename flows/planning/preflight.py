"""`sliplab check`: all that can be known before anything moves."""

from __future__ import annotations

from datetime import date
from pathlib import Path
from typing import Any

from sliplab.flows.planning.device_checks import Check, check_devices
from sliplab.flows.planning.region import check_region
from sliplab.flows.planning.run_request import (
    RunRequest,
    check_disk,
    make_request,
    missing_bytes,
    pending_trials,
)
from sliplab.flows.running.console import size
from sliplab.protocols import InputError
from sliplab.rigs.core.calibration import COMMANDS, find_faults, measured_on
from sliplab.rigs.rig_inheritance import read_rig, rig_path
from sliplab.storage.trials.store import Store


def check(protocol: Path, rig: Path, store: Path, enable: tuple[str, ...]) -> list[Check]:
    """Look at protocol, rig file, space, devices and clocks; nothing moves.

    Raises:
        InputError: protocol or rig file cannot be used at all.
    """
    run_request = make_request(protocol, rig, store, enable=enable)
    pending = pending_trials(run_request.plan, Store(store).campaign(run_request.campaign))
    found = [
        Check("protocol and limits", True, f"{len(run_request.plan)} trials within all limits"),
        Check("campaign", True, f"{len(pending)} of {len(run_request.plan)} still to take"),
    ]
    found.append(Check("outside camera", True, _outside_camera(run_request)))
    found += check_region(run_request)
    found += [Check("hint", True, text) for text in run_request.plan.warnings()]
    try:
        free = check_disk([run_request])
        needed = size(missing_bytes(run_request))
        found.append(Check("space", True, f"needs {needed}, {size(free)} free"))
    except InputError as error:
        found.append(Check("space", False, error.expected))
    found += _check_calibration(run_request, rig)
    found += check_devices(run_request)
    return found


def _check_calibration(run_request: RunRequest, rig: Path) -> list[Check]:
    """Whether what was measured on the rig is there, recent, and of one piece."""
    plan, calibration = run_request.plan.protocol.collection, run_request.rig.calibration
    needed = {"contact_plane", "tool_centre_point", "event_crop"}
    if "frames" in plan.recording.streams:
        needed.add("lens")
    if plan.maintenance.rezero is None:
        needed.add("depth_zero")
    faults = find_faults(
        calibration,
        simulated=run_request.rig.simulated,
        needed=needed,
        scale_px_per_mm=run_request.rig.frame_camera.scale_px_per_mm,
        today=date.today(),
    )
    source = read_rig(rig_path(rig))
    found = [
        Check(
            "calibration",
            False,
            InputError(
                source.blame(f.key),
                f.key,
                f.value,
                f"{f.expected}: run `{f.command} --rig {rig}`",
            ).message,
        )
        for f in faults
    ]
    if not found:
        entries = [name for name in COMMANDS if getattr(calibration, name) is not None]
        days = ", ".join(f"{name} {measured_on(calibration, name)}" for name in entries)
        age = " (simulated: of any age)" if run_request.rig.simulated else ""
        found.append(Check("calibration", True, f"{days}{age}"))
    return found


def _outside_camera(run_request: RunRequest) -> str:
    """What the labels will be read from."""
    size = run_request.rig.frame_px(run_request.plan)
    if size is None:
        return "not recorded: these trials cannot be labelled"
    simulated = "simulated " if run_request.rig.simulated else ""
    if run_request.rig.frame_source == "tracks":
        return f"{simulated}tracks of the markers, no video"
    return f"{simulated}video, {size[0]} x {size[1]} px"


def as_json(found: list[Check]) -> dict[str, Any]:
    """The checks as one JSON object."""
    return {
        "passed": all(item.passed for item in found),
        "checks": [vars(item) for item in found],
    }
