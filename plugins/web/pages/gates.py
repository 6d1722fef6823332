"""The gates of a trial in words: what was measured, and how much of it the protocol allows."""

from __future__ import annotations

from dataclasses import dataclass

from sliplab.storage.schema.trial import Gate

_MEANING = {
    "sync_unvouched_s": "recording beyond the clocks' sync pulses",
    "frames_lost": "frames lost",
    "event_gap_s": "longest silence of the event camera",
    "event_burst": "most events in 10 ms",
    "hold_slip_px": "largest motion of a marker in the hold",
    "path_deviation_mm": "largest distance from the path",
    "speed_deviation_percent": "largest deviation from the speed",
    "normal_force_n": "largest normal force",
    "hold_force_n": "normal force in the hold",
}
_OF_DEVICE = (
    ("sync_uncertainty_", "{} clock"),
    ("frames_lost_", "frames lost by {}"),
    ("event_burst_", "most events of {} in 10 ms"),
    ("event_gap_", "longest silence of {}"),
)
_UNITS = {"px": "px", "mm": "mm", "percent": "%", "n": "N"}
_SECONDS = ((1.0, "s"), (1e-3, "ms"), (1e-6, "µs"), (1e-9, "ns"))
_AT_LEAST = frozenset({"hold_force_n"})
"""Gates whose limit is a lower one."""


@dataclass(frozen=True)
class GateText:
    """One gate as a sentence of two parts: what it is about, and its figure with its limit."""

    name: str
    text: str
    passed: bool


def gate_texts(gates: dict[str, Gate]) -> list[GateText]:
    """Return all gates in words, failed ones first."""
    found = (
        GateText(_name(name), _figure(name, gate), gate.passed) for name, gate in gates.items()
    )
    return sorted(found, key=lambda text: text.passed)


def _name(gate: str) -> str:
    if gate in _MEANING:
        return _MEANING[gate]
    for beginning, text in _OF_DEVICE:
        if gate.startswith(beginning):
            return text.format(gate.removeprefix(beginning).removesuffix("_s"))
    return gate.replace("_", " ")


def _figure(name: str, gate: Gate) -> str:
    if gate.value is None or isinstance(gate.value, str):  # why there is none
        return gate.value or "unknown"
    figure = "unknown" if gate.value < 0 else amount(name, gate.value)
    if gate.limit is None:
        return figure
    limit = amount(name, gate.limit)
    if name in _AT_LEAST:
        return f"{figure}, at least {limit} needed"
    return f"{figure} of {limit} allowed"


def amount(name: str, value: float) -> str:
    """Return a figure with its unit, which is the last part of its name."""
    unit = name.rpartition("_")[2]
    if unit == "s":
        if value == 0:
            return "0 s"
        rounded = float(f"{abs(value):.3g}")
        factor, unit = next((pair for pair in _SECONDS if rounded >= pair[0]), _SECONDS[-1])
        return f"{value / factor:.3g} {unit}"
    number = f"{value:,.0f}" if float(value).is_integer() else f"{value:.3g}"
    return f"{number} {_UNITS[unit]}" if unit in _UNITS else number
