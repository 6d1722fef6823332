"""`sliplab check`: all checks that are possible before anything moves.

Protocol and limits, region of the outside camera, disk space, calibration; then the devices: do
they answer, what do they report of themselves, and can their clocks be fitted.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, TypedDict

from sliplab.flows.planning.campaign_trials import pending_trials
from sliplab.flows.planning.run_request import RunRequest, check_disk, make_request, missing_bytes
from sliplab.flows.running.console import size
from sliplab.flows.skin_change import to_repeat
from sliplab.protocols import InputError
from sliplab.protocols.program import Move
from sliplab.protocols.shown import plural
from sliplab.rigs.core.calibration import COMMANDS, find_faults, measured_on
from sliplab.rigs.core.capabilities import ArmFault, DeviceHealth, RigError
from sliplab.rigs.rig_inheritance import read_rig, rig_path
from sliplab.rigs.twin import warnings
from sliplab.storage.trials.context import SKIN, LoggedContext
from sliplab.storage.trials.lock import Locked
from sliplab.storage.trials.store import TrialStore

if TYPE_CHECKING:
    from sliplab.analysis.clocks.synchronise import DeviceSync
    from sliplab.protocols.timing import Timing
    from sliplab.rigs.core.rig import Rig
    from sliplab.storage.schema.trial import Gate

LISTEN_S = 3.0
"""Duration of the pulses' recording to fit the clocks, s."""


@dataclass(frozen=True)
class PreflightCheck:
    """One check and its finding.

    Attributes:
        caution: the finding is worth a look, although nothing is wrong.
    """

    name: str
    passed: bool
    finding: str
    caution: bool = False


def check(protocol: Path, rig: Path, store: Path, enable: tuple[str, ...]) -> list[PreflightCheck]:
    """Check protocol, rig file, space, calibration, devices and clocks; nothing moves.

    Raises:
        InputError: protocol or rig file cannot be used at all.
    """
    run_request = make_request(protocol, rig, store, enable=enable)
    pending = pending_trials(run_request.plan, TrialStore(store).campaign(run_request.campaign))
    found = [
        PreflightCheck(
            "protocol and limits",
            True,
            f"{plural(len(run_request.plan), 'trial')} within `limits` of protocol and rig",
        ),
        PreflightCheck(
            "campaign", True, f"{len(pending)} of {len(run_request.plan)} still to collect"
        ),
    ]
    found.append(PreflightCheck("outside camera", True, _outside_camera(run_request)))
    found += check_region(run_request)
    found += [PreflightCheck("hint", True, text, True) for text in run_request.plan.warnings()]
    if (twin := run_request.rig.twin) is not None:
        cautions = list(warnings(twin, run_request.plan))
        within = (
            f"within what it was fitted on: {plural(twin.trials, 'trial')} of '{twin.campaign}'"
        )
        found += [
            PreflightCheck("twin", True, text, bool(cautions)) for text in cautions or [within]
        ]
    try:
        free = check_disk([run_request])
        needed = size(missing_bytes(run_request))
        found.append(PreflightCheck("space", True, f"needs {needed}, {size(free)} free"))
    except InputError as error:
        found.append(PreflightCheck("space", False, error.expected))
    found += _check_calibration(run_request, rig)
    found += _check_skin(run_request)
    found += check_devices(run_request)
    return found


def _check_calibration(run_request: RunRequest, rig: Path) -> list[PreflightCheck]:
    """Check that the measurements of the rig exist, are recent, and are consistent."""
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
        PreflightCheck(
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
        age = " (simulated: any age)" if run_request.rig.simulated else ""
        found.append(PreflightCheck("calibration", True, f"{days}{age}"))
    return found


def _check_skin(run_request: RunRequest) -> list[PreflightCheck]:
    """Name what belongs to another skin than the one that was logged for the campaign."""
    if not TrialStore.exists(run_request.store):
        return []
    store = TrialStore.open(run_request.store)
    campaign = store.campaign(run_request.campaign)
    logged = LoggedContext(store, campaign.name)
    if SKIN not in logged.read() or (change := logged.last()) is None:
        return []
    skins = {item.trial_id: item.context.get(SKIN) for item in campaign.recordings()}
    items = to_repeat(store, campaign, run_request.plan, change, skins, run_request.rig)
    done = [PreflightCheck("skin", True, f"{change.context[SKIN]}, logged by {change.who}")]
    return [PreflightCheck("skin", True, str(item), True) for item in items] or done


def _outside_camera(run_request: RunRequest) -> str:
    """Describe what the labels will be read from."""
    frame_px = run_request.rig.frame_px(run_request.plan)
    if frame_px is None:
        return "not recorded: these trials cannot be labelled"
    simulated = "simulated " if run_request.rig.simulated else ""
    if run_request.rig.frame_source == "tracks":
        return f"{simulated}marker tracks, no video"
    return f"{simulated}video, {frame_px[0]} x {frame_px[1]} px"


def check_region(run_request: RunRequest) -> list[PreflightCheck]:
    """Check that the recorded region covers the markers on all motions; no check without video.

    The centre marker must stay in it, since gross slip is read from it. Outer markers may leave:
    they are not measured while they are cut by the edge.
    """
    size_px = run_request.rig.frame_px(run_request.plan)
    if size_px is None:
        return []
    scale = run_request.rig.frame_camera.scale_px_per_mm
    half = [side / scale / 2 for side in size_px]
    radius = float(run_request.rig.skin.radius)
    reach = _reach(run_request)
    skin = max(math.hypot(x, y) for x, y in run_request.rig.skin.layout_mm())
    spare = min(limit - moved - radius for limit, moved in zip(half, reach, strict=True))
    if spare < 0:
        text = (
            f"{2 * half[0]:.1f} x {2 * half[1]:.1f} mm is too small: the centre marker goes "
            f"{max(reach):.1f} mm from the middle and has a radius of {radius:g} mm; widen "
            f"recording.region by {-2 * spare:.1f} mm"
        )
        return [PreflightCheck("region", False, text)]
    text = f"covers the centre marker's whole path, with {spare:.1f} mm to spare"
    if spare < skin:
        text += f"; markers more than {spare:.1f} mm from the centre leave it on the longest"
    return [PreflightCheck("region", True, text)]


def _reach(run_request: RunRequest) -> tuple[float, float]:
    """Return how far from the middle recorded motion takes the sensor, mm, right and up."""
    x = y = 0.0
    for trial in run_request.plan:
        for step in run_request.plan.program(trial).steps:
            if isinstance(step, Move) and step.recorded:
                x, y = max(x, abs(step.to.x_mm)), max(y, abs(step.to.y_mm))
    return x, y


def check_devices(run_request: RunRequest) -> list[PreflightCheck]:
    """Connect every device, read its state, and fit the clocks; nothing moves."""
    from sliplab.rigs.rig_lock import held

    try:
        with held(run_request.rig, run_request.store):
            return _check_held(run_request)
    except Locked as error:
        return [PreflightCheck("rig", False, str(error))]
    except RigError as error:
        return [PreflightCheck(error.device, False, _message(error))]


def _check_held(run_request: RunRequest) -> list[PreflightCheck]:
    """Check the devices of a rig whose lock is held."""
    from sliplab.rigs.build import build_rig

    found = _check_reach(run_request)
    if not all(item.passed for item in found):
        return found
    try:
        rig = build_rig(run_request.rig)
    except RigError as error:
        return [PreflightCheck(error.device, False, _message(error))]
    try:
        rig.connect()
        state = rig.arm.state()
        if not state.healthy:
            raise ArmFault("arm", f"is in {state.value}: {state.advice}")
        found.append(PreflightCheck("arm", True, state.value))
        found += [
            PreflightCheck(device.device, True, _health_text(device)) for device in rig.health()
        ]
        found += _check_clocks(run_request, rig)
    except RigError as error:
        found.append(PreflightCheck(error.device, False, _message(error)))
    finally:
        try:
            rig.close()
        except RigError as error:  # added to what was found
            failed = PreflightCheck(error.device, False, _message(error))
            if failed not in found:
                found.append(failed)
    return found


def _check_reach(run_request: RunRequest) -> list[PreflightCheck]:
    """Return the devices of a real rig that cannot be reached at all, each by name."""
    if run_request.rig.simulated or run_request.rig.devices is None:
        return []
    from sliplab.rigs.discovery import ping_devices

    return [
        PreflightCheck(name, False, why)
        for name, why in ping_devices(run_request.rig.devices, run_request.rig.streams).items()
        if why is not None
    ]


def _check_clocks(run_request: RunRequest, rig: Rig) -> list[PreflightCheck]:
    """Fit every clock that needs no frames, as a trial's clocks are fitted."""
    from sliplab.analysis.clocks.synchronise import clocks_in, streams_of, synchronise
    from sliplab.analysis.quality import sync_gate
    from sliplab.storage.files import scratch_folder
    from sliplab.storage.trials.checksums import DATA
    from sliplab.storage.trials.hdf5_reader import StreamReader
    from sliplab.storage.trials.writer import TrialWriter

    rate = run_request.plan.protocol.collection.recording.sync_rate
    with scratch_folder() as folder:
        check = folder / "check"
        writer = TrialWriter(check, check.with_name("none"), None, rate)
        rig.listen(LISTEN_S, writer, rate)
        sealed = writer.seal()
        further = clocks_in(sealed, {device.name: device.about for device in rig.further})
        with StreamReader(sealed / DATA) as reader:
            streams = streams_of(reader, None, further)
    fitted = synchronise(streams, rig.timing, rate)
    gates = run_request.plan.protocol.collection.gates
    found = []
    for name, device in fitted.devices.items():
        gate = sync_gate(name, fitted, gates, rig.timing)
        text = (
            f"{device.map.drift_ppm():+.1f} ppm, within {device.uncertainty_ns / 1000:.1f} us "
            f"({device.grade})"
        )
        found.append(
            PreflightCheck(
                f"clock: {name}", gate.passed, text + _beyond_gate(gate, device, rig.timing)
            )
        )
    return found + [
        PreflightCheck(f"clock: {name}", False, why) for name, why in fitted.refused.items()
    ]


def _beyond_gate(gate: Gate, device: DeviceSync, timing: Timing) -> str:
    """Return how a clock fails the protocol's gate, with the delays that were seen; or nothing."""
    from sliplab.analysis.quality import gated_as

    if gate.passed or gate.limit is None or isinstance(gate.value, str | None):
        return ""
    key = f"gates.sync_uncertainty.{gated_as(device.grade, timing).replace(' ', '_')}"
    text = (
        f"; the protocol's gate {key} is {gate.limit * 1e6:.0f} us, and this is "
        f"{gate.value * 1e6:.0f} us against the events: every trial would be rejected"
    )
    if device.bounds is not None:
        slowest, widest = (ns / 1e3 for ns in (device.bounds.slowest_ns, device.bounds.widest_ns))
        text += (
            f". The slowest message took {slowest:.0f} us more than the fastest, and the rig file "
            f"allows {widest:.0f} us: bound the delay in `timing` more closely, or use a wire"
        )
    return text


def _health_text(device: DeviceHealth) -> str:
    """Format what a device reports of itself, in a line."""
    parts = [device.model, f"serial {device.serial}", f"firmware {device.firmware}"]
    if device.temperature_c is not None:
        parts.append(f"{device.temperature_c:.0f} °C")
    return ", ".join([*parts, f"clock: {device.clock}", *device.notes])


def _message(error: RigError) -> str:
    return str(error).removeprefix(f"{error.device}: ")


class Checks(TypedDict):
    """Checks as `sliplab check --json` prints them."""

    passed: bool
    checks: list[PreflightCheck]


def checks_json(found: list[PreflightCheck]) -> Checks:
    """Return the checks as one JSON object."""
    return {"passed": all(item.passed for item in found), "checks": found}
