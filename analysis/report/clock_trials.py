"""Clocks of every trial, one row a trial and device, and a campaign's in a few numbers."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypedDict

import numpy as np
import numpy.typing as npt

from sliplab.analysis.campaigns import Collected
from sliplab.storage.schema.trial import DEVICES, Gate, SyncResult, TrialClockMaps
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import SYNC, TrialStore

F64 = npt.NDArray[np.float64]

PULSES = ("missed", "late", "spurious")


@dataclass(frozen=True)
class DeviceClocks:
    """One device in one trial.

    Attributes:
        kind: ``95 %`` or ``hard bound``: what the uncertainty means.
        against_events_us: of events against this device, both maps together; of events, and in a
            trial without them, the device's own.
        gate_us: what the protocol allows; None where the record has no such gate.
        drift_ppm: what the box gains on the device.
        pulses: ``seen``, ``missed``, ``late``, ``spurious``; None without a wire.
    """

    grade: str
    kind: str
    against_events_us: float
    gate_us: float | None
    drift_ppm: float
    pulses: dict[str, int] | None


@dataclass(frozen=True)
class TrialClocks:
    """The clocks of one committed trial.

    Attributes:
        number: its place in the order in which the campaign's trials were taken, from 1.
        changed: fitting again gave other clocks than the record has, and they are in use.
        refused: by device, why fitting again gave no clock; the record's is still in use.
        frames_lost: frames that the camera lost; None without a video.
    """

    campaign: str
    name: str
    number: int
    devices: Mapping[str, DeviceClocks]
    changed: bool
    refused: Mapping[str, str]
    frames_lost: int | None
    results: Derived
    further: tuple[str, ...] = ()
    """Names of the further devices, each of which gives a stream."""

    @property
    def worst_us(self) -> float:
        """The largest uncertainty of events against any device."""
        return max((device.against_events_us for device in self.devices.values()), default=0.0)

    @property
    def missed(self) -> int:
        """Pulses that some device missed."""
        pulses = (device.pulses for device in self.devices.values())
        return sum(found["missed"] for found in pulses if found is not None)

    @property
    def doubt(self) -> str:
        """Reason to reject this committed trial by today's gates, as text; empty if none."""
        found = [
            f"{device} cannot be fitted again ({reason}); the record's clock is in use"
            for device, reason in self.refused.items()
        ]
        for name, device in self.devices.items():
            if device.gate_us is not None and device.against_events_us > device.gate_us:
                found.append(
                    f"{name} ({device.grade}): {device.against_events_us:.1f} µs, "
                    f"the gate is {device.gate_us:g} µs"
                )
        return "; ".join(found)

    @cached_property
    def residuals(self) -> dict[str, F64]:
        """Residuals by ``DEVICE_us`` over the trial's time, ``DEVICE_s``."""
        return self.results.arrays(self.name)


def device_names(trials: Iterable[TrialClocks]) -> tuple[str, ...]:
    """Return the devices whose clocks are shown: the first ones, then further ones by name."""
    further = {name for trial in trials for name in trial.further}
    return (*DEVICES, *sorted(further))


def read_trials(store: TrialStore, item: Collected) -> list[TrialClocks]:
    """Read the trials of a campaign, in the order in which they were taken."""
    results = Derived.of(store, SYNC, item.name)
    taken = sorted(
        (recording for _, recording in item.trials),
        key=lambda recording: item.campaign.provenance(recording).started or "",
    )
    return [_read(item, recording, k + 1, results) for k, recording in enumerate(taken)]


def _read(item: Collected, recording: Recording, number: int, results: Derived) -> TrialClocks:
    clocks, gates = recording.clocks, recording.record.quality.gates
    name = recording.folder.name
    known = recording.record.clocks.devices()
    refused = results.load(name, SyncResult).refused
    lost = gates["frames_lost"].value if "frames_lost" in gates else None
    return TrialClocks(
        item.name,
        name,
        number,
        {device: _device(clocks, gates, device) for device in clocks.devices()},
        recording.refitted,
        {device: reason for device, reason in refused.items() if device in known},
        int(lost) if isinstance(lost, int) else None,
        results,
        tuple(name for name, about in recording.record.streams.items() if about.timing is not None),
    )


def _device(clocks: TrialClockMaps, gates: Mapping[str, Gate], name: str) -> DeviceClocks:
    known = clocks.devices()[name]
    both = clocks.against_events_ns(name)
    uncertainty_ns = known.uncertainty_ns if both is None else both
    gate = gates.get(f"sync_uncertainty_{name}_s")
    limit = None if gate is None else gate.limit
    # through the host, the recorded drift is of one step of the way
    drift_ppm = known.drift_ppm if known.wired else None
    pulses = {kind: getattr(known, f"pulses_{kind}") for kind in ("seen", *PULSES)}
    return DeviceClocks(
        known.grade,
        known.kind or "",
        math.nan if uncertainty_ns is None else uncertainty_ns / 1e3,
        None if limit is None else 1e6 * limit,
        known.map.drift_ppm() if drift_ppm is None else drift_ppm,
        pulses if known.wired else None,
    )


class DeviceNumbers(TypedDict):
    """One device in all trials of a campaign that have it.

    Attributes:
        uncertainty_us: ``median`` and ``worst``, of events against it.
        drift_ppm: least and most.
        pulses: by `PULSES`; None without a wire.
    """

    grade: str
    kind: str
    trials: int
    uncertainty_us: dict[str, float]
    gates_us: list[float]
    drift_ppm: list[float]
    pulses: dict[str, int] | None


class CampaignClocks(TypedDict):
    """Clocks of a campaign in the result of `sliplab sync`.

    Attributes:
        refitted: trials that were fitted again now.
    """

    refitted: int
    trials: int
    changed: int
    refused: int
    devices: dict[str, DeviceNumbers]


def campaign_clocks(trials: Sequence[TrialClocks], refitted: int = 0) -> CampaignClocks:
    """Summarise a campaign's clocks by device."""
    devices = {}
    for name in device_names(trials):
        there = [trial.devices[name] for trial in trials if name in trial.devices]
        if there:
            devices[name] = _numbers(there)
    return CampaignClocks(
        refitted=refitted,
        trials=len(trials),
        changed=sum(trial.changed for trial in trials),
        refused=sum(bool(trial.refused) for trial in trials),
        devices=devices,
    )


def _numbers(there: Sequence[DeviceClocks]) -> DeviceNumbers:
    uncertainty = [device.against_events_us for device in there]
    drift = [device.drift_ppm for device in there]
    wired = [device.pulses for device in there if device.pulses is not None]
    counts = {kind: sum(pulses[kind] for pulses in wired) for kind in PULSES}
    return DeviceNumbers(
        grade=" or ".join(sorted({device.grade for device in there})),
        kind=" or ".join(sorted({device.kind for device in there})),
        trials=len(there),
        uncertainty_us={"median": float(np.median(uncertainty)), "worst": max(uncertainty)},
        gates_us=sorted({device.gate_us for device in there if device.gate_us is not None}),
        drift_ppm=[min(drift), max(drift)],
        pulses=counts if wired else None,
    )
