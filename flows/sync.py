"""Fitting the clocks of every committed trial again, and showing what they are worth.

A trial's clocks are fitted when it is taken, by the program of that day. When fitting has improved
since, this step makes them again from the raw streams. The record stays as it was committed; where
the new clocks differ they stand among the derived results, every later step reads them there, and
its results become stale exactly then.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from analysis import synchronise
from flows import console
from flows.campaigns import Collected
from flows.sync_page import PAGE, render
from flows.sync_trials import DEVICES, TrialClocks, read_trials, same_clocks
from flows.trial_work import Made, TrialWork, run_trials, stale_trials
from storage.derived import Derived, make_key
from storage.files import write_text
from storage.recording import Recording
from storage.store import SYNC, Store

PAGE_VERSION = 1
POINTS = 200
"""So many residuals are kept of a device in a trial, evenly spread over it."""


def sync_key(recording: Recording) -> str:
    """The key of a trial's clocks, fitted again."""
    return make_key(SYNC, synchronise.VERSION, recording.raw_checksum, None)


def _fit_one(work: TrialWork) -> Made:
    """Runs in a process of its own."""
    recording = work.recording
    found = synchronise.synchronise_recording(recording)
    # as a file gives them back, which is how the record has them
    clocks = json.loads(json.dumps(found.to_json()))
    known = recording.record["clocks"]
    data: dict[str, Any] = {"raw": recording.raw_checksum, "refused": found.refused}
    # a clock that is refused now is told to people; it is no better one
    if all(name in found.devices for name in DEVICES if name in known) and not same_clocks(
        clocks, known
    ):
        data["clocks"] = clocks
    return data, _residuals(found)


def _residuals(found: synchronise.TrialSync) -> dict[str, Any]:
    """Residuals over the trial's time by device: ``NAME_s`` and ``NAME_us``."""
    fits = {name: device.fit for name, device in found.devices.items() if device.fit is not None}
    begin = min((int(fit.pulse_ns[0]) for fit in fits.values()), default=0)
    arrays: dict[str, Any] = {}
    for name, fit in fits.items():
        some = np.unique(np.linspace(0, fit.pulse_ns.size - 1, POINTS).round().astype(np.int64))
        arrays[f"{name}_s"] = (fit.pulse_ns[some] - begin) / 1e9
        arrays[f"{name}_us"] = fit.residual_ns[some] / 1e3
    return arrays


def sync(store: Store, campaigns: list[Collected]) -> dict[str, Any]:
    """Fit what is stale, and write the page if anything on it has changed."""
    wanted = [
        TrialWork(recording, item.name, sync_key(recording))
        for item in campaigns
        for _, recording in item.trials
    ]
    stale = stale_trials(store, SYNC, wanted)
    run_trials(store, SYNC, "sync", stale, _fit_one)
    for work in wanted:
        work.recording.forget_clocks()
    trials = {item.name: read_trials(store, item) for item in campaigns}
    page = _write_page(store, campaigns, wanted, trials)
    fitted = {item.name: sum(work.campaign == item.name for work in stale) for item in campaigns}
    numbers = {name: campaign_numbers(found, fitted[name]) for name, found in trials.items()}
    for name, found in trials.items():
        for trial in found:
            if trial.refused:
                console.say(f"warning: {name}: {trial.name}: {trial.doubt}")
    return {
        "step": SYNC,
        "done": len(stale),
        "fresh": len(wanted) - len(stale),
        "changed": sum(known["changed"] for known in numbers.values()),
        "simulated": store.simulated,
        "page": str(page),
        "campaigns": numbers,
    }


def _write_page(
    store: Store,
    campaigns: list[Collected],
    wanted: list[TrialWork],
    trials: dict[str, list[TrialClocks]],
) -> Any:
    path = store.folder / "report" / PAGE
    quarantined = [[item.name, item.campaign.quarantined()] for item in campaigns]
    shown = [[work.campaign, work.key] for work in wanted]
    key = make_key(SYNC, PAGE_VERSION, [shown, quarantined], None)
    kept = Derived.of(store, SYNC)
    if not kept.fresh("page", key) or not path.exists():
        path.parent.mkdir(exist_ok=True)
        write_text(path, render(campaigns, trials, simulated=store.simulated))
        kept.write("page", key, {})
    return path


def campaign_numbers(trials: list[TrialClocks], fitted: int) -> dict[str, Any]:
    """What is known of a campaign's clocks, by device; uncertainties are of events against it."""
    devices = {}
    for name in DEVICES:
        there = [trial.devices[name] for trial in trials if name in trial.devices]
        if not there:
            continue
        uncertainty = [device.against_events_us for device in there]
        drift = [device.drift_ppm for device in there if device.drift_ppm is not None]
        wired = [device.pulses for device in there if device.pulses is not None]
        devices[name] = {
            "grade": " or ".join(sorted({device.grade for device in there})),
            "uncertainty_us": {
                "median": float(np.median(uncertainty)),
                "worst": max(uncertainty),
            },
            "drift_ppm": [min(drift), max(drift)] if drift else None,
            "pulses": {
                kind: sum(pulses[kind] for pulses in wired)
                for kind in ("missed", "late", "spurious")
            }
            if wired
            else None,
        }
    return {
        "trials": len(trials),
        "refitted": fitted,
        "changed": sum(trial.changed for trial in trials),
        "refused": sum(bool(trial.refused) for trial in trials),
        "devices": devices,
    }


def table_rows(result: dict[str, Any]) -> list[list[str]]:
    """What `sliplab sync` prints, under `COLUMNS`."""
    rows = []
    for campaign, known in result["campaigns"].items():
        trials = f"{known['refitted']} / {known['changed']}"
        for device, found in known["devices"].items():
            drift, pulses, uncertain = (
                found["drift_ppm"], found["pulses"], found["uncertainty_us"]
            )  # fmt: skip
            rows.append([
                campaign,
                device,
                found["grade"],
                f"{uncertain['median']:.1f}",
                f"{uncertain['worst']:.1f}",
                "-" if drift is None else f"{drift[0]:.2f} to {drift[1]:.2f}",
                "-" if pulses is None else " / ".join(map(str, pulses.values())),
                trials,
            ])  # fmt: skip
    return rows


COLUMNS = (
    "campaign", "device", "grade", "median (µs)", "worst (µs)", "drift (ppm)",
    "missed / late / spurious", "trials refitted / changed",
)  # fmt: skip
"""Uncertainties are of events against the device, both clocks together; of events, their own."""
