"""One trial's clocks fitted again, and held against its record.

Runs in processes of its own, so nothing here loads what only the command line needs.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from sliplab.analysis.clocks import synchronise
from sliplab.storage.schema.trial import SyncResult
from sliplab.storage.trials.recording import Recording

POINTS = 200
"""So many residuals are kept of a device in a trial, evenly spread over it."""
_SAME = 1e-9
"""Figures that differ by less than this share came from the same fit on another processor."""
_SAME_DRIFT = 10**6
"""Parts in 10**18: a nanosecond over a quarter of an hour."""


def fit_again(recording: Recording, _: None) -> tuple[dict[str, Any], dict[str, Any]]:
    """What is kept of a trial: JSON, with other clocks than the record's if there are, and
    residuals.
    """
    found = synchronise.synchronise_recording(recording)
    clocks, known = found.record(), recording.record.clocks
    data: dict[str, Any] = {"raw": recording.raw_checksum, "refused": found.refused}
    # a clock that is refused now is told to people; it is no better one
    if known.devices().keys() <= found.devices.keys() and not same_clocks(
        clocks.to_json(), known.to_json()
    ):
        data["clocks"] = clocks
    return SyncResult(**data).to_json(), _residuals(found)


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


def same_clocks(one: Any, other: Any, name: str = "") -> bool:
    """Whether two trials' clocks, as JSON, agree in every map and figure.

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
