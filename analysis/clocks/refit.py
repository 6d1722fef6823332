"""One trial's clocks fitted again, and compared with its record.

A trial's clocks are fitted when it is taken, by the program of that day. Where fitting has improved
since, the new clocks are among the derived results; the record stays as it was committed.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from sliplab.analysis.clocks import synchronise
from sliplab.storage.schema.trial import SyncResult
from sliplab.storage.trials.derived import make_key
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import SYNC

POINTS = 200
"""Number of residuals stored for a device in a trial, evenly spread over it."""
_SAME = 1e-9
"""Figures that differ by less than this share came from the same fit on another processor."""
_SAME_DRIFT = 10**6
"""Parts in 10**18: a nanosecond over a quarter of an hour."""


def sync_key(recording: Recording) -> str:
    """Return the key of a trial's clocks, fitted again."""
    return make_key(SYNC, synchronise.VERSION, recording.raw_checksum, None)


def fit_again(recording: Recording, _: None) -> tuple[dict[str, Any], dict[str, Any]]:
    """Fit the clocks of a trial.

    Returns:
        a `SyncResult` as JSON, with clocks where they differ from the record's; and residuals over
        the trial's time by device, ``NAME_s`` and ``NAME_us``.
    """
    found = synchronise.synchronise_recording(recording)
    clocks, known = found.record(), recording.record.clocks
    data: dict[str, Any] = {"raw": recording.raw_checksum, "refused": found.refused}
    # a clock that is refused now is reported; the record's is no worse
    if known.devices().keys() <= found.devices.keys() and not same_clocks(
        clocks.to_json(), known.to_json()
    ):
        data["clocks"] = clocks
    return SyncResult(**data).to_json(), _residuals(found)


def _residuals(found: synchronise.TrialSync) -> dict[str, Any]:
    fits = {name: device.fit for name, device in found.devices.items() if device.fit is not None}
    begin = min((int(fit.pulse_ns[0]) for fit in fits.values()), default=0)
    arrays: dict[str, Any] = {}
    for name, fit in fits.items():
        some = np.unique(np.linspace(0, fit.pulse_ns.size - 1, POINTS).round().astype(np.int64))
        arrays[f"{name}_s"] = (fit.pulse_ns[some] - begin) / 1e9
        arrays[f"{name}_us"] = fit.residual_ns[some] / 1e3
    return arrays


def same_clocks(one: Any, other: Any, name: str = "") -> bool:
    """Check that two trials' clocks, as JSON, agree in every map and figure.

    Processors differ in the last digit of a float, which is no other fit.
    """
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(
            same_clocks(one[key], other[key], key) for key in one
        )
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(
            same_clocks(a, b, name) for a, b in zip(one, other, strict=True)
        )
    if isinstance(one, float) and isinstance(other, float):
        return math.isclose(one, other, rel_tol=_SAME, abs_tol=_SAME)
    if name == "drift" and isinstance(one, int) and isinstance(other, int):
        return abs(one - other) <= _SAME_DRIFT
    return bool(one == other)
