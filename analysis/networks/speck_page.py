"""The description of a network on a Speck chip for people."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sliplab.analysis.networks.model_card import latency_table, percent, table
from sliplab.analysis.networks.speck import KI

NOT_SHOWN = (
    "The chip has no time steps: it looks at a neuron's threshold after every spike, where this "
    "looks once a millisecond.",
    "The chip adds biases (fc1, fc2) by its leak clock: it must tick once a step.",
    "The chip does not reset its neurons between windows; the program that reads it has to.",
    "Spikes of a class's output neurons are added up by the program that reads the chip.",
    "Routing, delays and lost spikes of the chip are not in here, and no chip has seen this file.",
)


def speck_markdown(found: Mapping[str, Any]) -> str:
    """What `flows.learning.model_export` puts into ``*.speck.json``, as a page."""
    fit, whole = found["fit"], found["quantisation"]
    said = " (simulated)" if found["simulated"] else ""
    text = [f"# {found['model']['file']} on a Speck", ""]
    if fit["fits"]:
        text.append("It fits: one core a layer.")
    else:
        text += ["**It does not fit:**", "", *(f"- {problem}" for problem in fit["problems"])]
    text += ["", "## Memory (words of the chip, rounded up as it rounds)", ""]
    text += table(
        ["layer", "core", "kernel memory", "of", "neuron memory", "of", "fan-in", "fan-out",
         "sends to"],
        [
            [
                f"{layer['name']} {layer['in_channels']}x{layer['in_side']}² → "
                f"{layer['out_channels']}x{layer['out_side']}², kernel {layer['kernel']}",
                _or_dash(layer["core"]), _words(layer["kernel_words"]),
                _words(layer["core_kernel_words"]), _words(layer["neuron_words"]),
                _words(layer["core_neuron_words"]), layer["fan_in"], layer["fan_out"],
                ", ".join(map(str, layer["destinations"])) or "output",
            ]
            for layer in fit["layers"]
        ],
    )  # fmt: skip
    text += ["", "## 8-bit weights", ""]
    text += table(
        ["layer", "scale", "threshold", "rounding (RMS)", "lowest potential", "highest", "cut off"],
        [
            [
                name, f"{layer['scale']:g}", layer["threshold"], f"{layer['rounding']:.2%}",
                f"{layer['potential'][0]:,.0f}", f"{layer['potential'][1]:,.0f}",
                f"{layer['saturated']:.3%}",
            ]
            for name, layer in whole["layers"].items()
        ],
    )  # fmt: skip
    change = whole["change"]
    text += [
        "",
        f"A potential holds 16 bits and is cut off beyond. Over {change['windows']} windows"
        f"{said}: equal spike counts in {percent(change['equal_counts'])}, the same class in "
        f"{percent(change['equal_class'])}, the same class by the margin in "
        f"{percent(change['equal_class_by_margin'])}; a count changes by "
        f"{change['mean_change']:.2f} on average and {change['largest_change']} at most.",
        "",
        *table(
            [f"accuracy{said}", "as trained", "8 bits"],
            [
                [kind, percent(whole["accuracy"]["real"][kind]),
                 percent(whole["accuracy"]["whole"][kind])]
                for kind in ("strict", "margin", "argmax")
            ],
        ),
        "", f"## Detection latency as trained{said}", "",
        *latency_table(found["detection"]["real"]),
        "", f"## Detection latency with 8 bits{said}", "",
        *latency_table(found["detection"]["whole"]),
        "", "## What this does not show", "", *(f"- {line}" for line in NOT_SHOWN),
    ]  # fmt: skip
    return "\n".join(text) + "\n"


def _words(words: int | None) -> str:
    if words is None:
        return "-"
    return f"{words / KI:g} Ki" if words >= KI else str(words)


def _or_dash(value: object) -> str:
    return "-" if value is None else str(value)
