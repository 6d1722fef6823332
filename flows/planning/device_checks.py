"""What `sliplab check` asks a rig's devices: do they answer, who are they, how do clocks agree."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from sliplab.rigs.core.capabilities import ArmFault, DeviceHealth, RigError
from sliplab.storage.trials.lock import Locked

if TYPE_CHECKING:
    from sliplab.flows.planning.run_request import RunRequest
    from sliplab.rigs.core.rig import Rig

LISTEN_S = 3.0
"""How long the pulses are listened to, s."""


@dataclass(frozen=True)
class Check:
    """One thing that was looked at."""

    name: str
    passed: bool
    finding: str


def check_devices(run_request: RunRequest) -> list[Check]:
    """Connect every device, read its state, and fit the clocks; nothing moves."""
    from sliplab.rigs.rig_lock import held

    try:
        with held(run_request.rig, run_request.store):
            return _check_held(run_request)
    except Locked as error:
        return [Check("rig", False, str(error))]
    except RigError as error:
        return [Check(error.device, False, _message(error))]


def _check_held(run_request: RunRequest) -> list[Check]:
    """As `check_devices`, of a rig that nobody else uses meanwhile."""
    from sliplab.rigs.build import build_rig

    found = _check_reach(run_request)
    if not all(item.passed for item in found):
        return found
    try:
        rig = build_rig(run_request.rig)
    except RigError as error:
        return [Check(error.device, False, _message(error))]
    try:
        rig.connect()
        state = rig.arm.state()
        if not state.healthy:
            raise ArmFault("arm", f"is in {state.value}: {state.advice}")
        found.append(Check("arm", True, state.value))
        found += [Check(device.device, True, _said(device)) for device in rig.health()]
        found += _check_clocks(run_request, rig)
    except RigError as error:
        found.append(Check(error.device, False, _message(error)))
    finally:
        try:
            rig.close()
        except RigError as error:  # beside what was found, not in its place
            failed = Check(error.device, False, _message(error))
            if failed not in found:
                found.append(failed)
    return found


def _check_reach(run_request: RunRequest) -> list[Check]:
    """Devices of a real rig that cannot be reached at all, each by name."""
    if run_request.rig.simulated or run_request.rig.devices is None:
        return []
    from sliplab.rigs.discovery import reach

    return [
        Check(name, False, why)
        for name, why in reach(run_request.rig.devices).items()
        if why is not None
    ]


def _check_clocks(run_request: RunRequest, rig: Rig) -> list[Check]:
    """Fit every clock that needs no frames, as a trial's would be."""
    from sliplab.analysis.clocks.synchronise import streams_of, synchronise
    from sliplab.storage.trials.hdf5 import StreamReader
    from sliplab.storage.trials.writer import DATA, TrialWriter

    rate = run_request.plan.protocol.collection.recording.sync_rate
    with TemporaryDirectory() as folder:
        aside = Path(folder) / "check"
        writer = TrialWriter(aside, aside.with_name("none"), None, rate)
        rig.listen(LISTEN_S, writer, rate)
        with StreamReader(writer.seal() / DATA) as reader:
            streams = streams_of(reader, None)
    fitted = synchronise(streams, rig.timing, rate)
    found = [
        Check(
            f"clock: {name}",
            True,
            f"{device.map.drift_ppm():+.1f} ppm, within {device.uncertainty_ns / 1000:.1f} us "
            f"({device.grade})",
        )
        for name, device in fitted.devices.items()
    ]
    return found + [Check(f"clock: {name}", False, why) for name, why in fitted.refused.items()]


def _said(device: DeviceHealth) -> str:
    """What a device says of itself, in a line."""
    parts = [device.model, f"serial {device.serial}", f"firmware {device.firmware}"]
    if device.temperature_c is not None:
        parts.append(f"{device.temperature_c:.0f} °C")
    return ", ".join([*parts, f"clock: {device.clock}", *device.notes])


def _message(error: RigError) -> str:
    return str(error).removeprefix(f"{error.device}: ")
