"""Presets of the `analysis:` section: named settings of a published experiment.

``preset: paper`` is the network, the training and the rule of Lu et al., "A Neuromorphic Incipient
Slip Detection System using Papillae Morphology". Not every required value is published: each
one states its source.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

Source = Literal["published", "assumed"]


@dataclass(frozen=True)
class Value:
    """One setting of a preset.

    Attributes:
        key: below `analysis:`, such as ``network.biases``.
        value: as a protocol file says it.
        source: ``published`` by the authors, or ``assumed`` here because they do not say it.
        words: name of the setting for a report.
    """

    key: str
    value: Any
    source: Source
    words: str


PAPER = (
    Value("labelling.rule", "paper", "published", "rule of the labels"),
    Value("labelling.reference", "hold_start", "published", "displacements count from"),
    Value("labelling.threshold_px", 2.0, "published", "displacement that is slip (px)"),
    Value("windows.length_ms", 30, "published", "window (ms)"),
    Value("windows.step_ms", 1, "published", "time step (ms)"),
    Value("windows.crop_px", 400, "published", "centre crop (px)"),
    Value("windows.pool_px", 20, "published", "pixels of a cell, a side"),
    Value("windows.polarity", "positive", "published", "polarity of the events"),
    Value("samples.per_class", 50, "published", "windows of a class and trial, at most"),
    Value("network.conv1_channels", 8, "assumed", "channels of the first convolution"),
    Value("network.conv2_channels", 16, "assumed", "channels of the second convolution"),
    Value("network.conv1_kernel", 5, "assumed", "kernel of the first convolution"),
    Value("network.conv2_kernel", 3, "assumed", "kernel of the second convolution"),
    Value("network.hidden", 32, "assumed", "hidden neurons"),
    Value("network.outputs_per_class", 1, "published", "output neurons of a class"),
    Value("network.biases", False, "assumed", "biases in the full layers"),
    Value("network.weight_scale", (4.0, 3.0, 4.0, 3.0), "assumed", "scale of the first weights"),
    Value("training.learning_rate", 1e-3, "assumed", "learning rate of Adam"),
    Value("training.schedule", "constant", "assumed", "schedule of the learning rate"),
    Value("training.warm_up", 0.0, "assumed", "share of steps to warm up"),
    Value("training.gain", 1.0, "assumed", "gain of a spike in the cross-entropy"),
    Value("training.mirror", False, "assumed", "windows mirrored in training"),
    Value("detection.smoothing", 4, "published", "windows of the sliding mean"),
    Value("detection.margin", 2.0, "published", "lead of a winner (spikes)"),
    Value("detection.choose", "protocol", "published", "source of sliding mean and lead"),
    Value("detection.stride_ms", None, "published", "stride of the windows (ms)"),
)
"""The paper mentions no overlapping windows; it gives no mirroring, layer sizes, loss or rate."""

COMPARED = ("network", "training", "detection")
"""Sections that an additional network takes from a preset; it shares the others."""


def expanded(data: Mapping[str, Any]) -> dict[str, Any]:
    """Return `analysis:` with the preset's values for the keys that it does not set itself.

    A section that is not a mapping stays unchanged, for the later check.
    """
    found = dict(data)
    for each in PAPER if data.get("preset") == "paper" else ():
        section, key = each.key.split(".")
        stated = found.get(section, {})
        if isinstance(stated, dict):
            found[section] = {key: each.value, **stated}
    return found


def at(settings: Any, key: str) -> Any:
    """The value at a dotted key of settings."""
    for part in key.split("."):
        settings = getattr(settings, part)
    return settings
