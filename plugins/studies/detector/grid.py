"""Settings of the detector's search: lines through the paper's setting, and a cross.

The whole cross of four factors is some 150 trainings a seed. By default every factor is varied
alone with the others at the paper's values, and window length and pooling, which share the events
among them, are crossed at the shortest, the paper's and the longest window; `full` gives the whole
cross.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from typing import Any

from sliplab.protocols.errors import InputError
from sliplab.protocols.network_settings import NetworkSettings
from sliplab.protocols.windows import Windows

CHANNELS = ("conv1_channels", "conv2_channels", "hidden")


@dataclass(frozen=True, order=True)
class NetworkSetting:
    """Windows and size of a network.

    Attributes:
        length_ms, step_ms: of a window and of the network's time steps.
        pool_px: side of a cell.
        width: factor on the channels of the convolutions and on the hidden neurons.
    """

    length_ms: int = 30
    step_ms: int = 1
    pool_px: int = 20
    width: float = 1.0

    @property
    def title(self) -> str:
        """The setting as text."""
        return f"{self.length_ms} ms in {self.step_ms} ms, {self.pool_px} px, ×{self.width:g}"

    @property
    def slug(self) -> str:
        """The setting as part of a file's name."""
        width = f"{self.width:g}".replace(".", "p")
        return f"l{self.length_ms}_s{self.step_ms}_p{self.pool_px}_w{width}"

    def windows(self, base: Windows) -> Windows:
        """Return a protocol's windows with these lengths and cells."""
        own = {name: getattr(self, name) for name in ("length_ms", "step_ms", "pool_px")}
        return Windows.model_validate({**base.model_dump(), **own})

    def network(self, base: NetworkSettings) -> NetworkSettings:
        """Return a protocol's network with this width: whole channels, at least one."""
        wide = {name: max(1, round(getattr(base, name) * self.width)) for name in CHANNELS}
        return NetworkSettings.model_validate({**base.model_dump(), **wide})


PAPER = NetworkSetting()


@dataclass(frozen=True)
class Axes:
    """Values of each factor; names as in `NetworkSetting`."""

    length_ms: tuple[int, ...] = (5, 10, 20, 30, 40, 50)
    step_ms: tuple[int, ...] = (1, 2, 5)
    pool_px: tuple[int, ...] = (10, 20, 40)
    width: tuple[float, ...] = (0.5, 1.0, 2.0)

    @property
    def default(self) -> list[NetworkSetting]:
        """All lines through the paper's setting, and the small cross of length and pooling."""
        lines = (
            replace(PAPER, **{field.name: value})
            for field in fields(self)
            for value in getattr(self, field.name)
        )
        cross = (
            replace(PAPER, length_ms=length, pool_px=pool)
            for length in (min(self.length_ms), max(self.length_ms))
            for pool in self.pool_px
        )
        return _ordered([PAPER, *lines, *cross])

    @property
    def full(self) -> list[NetworkSetting]:
        """All combinations of the values."""
        axes = (self.length_ms, self.step_ms, self.pool_px, self.width)
        return _ordered(NetworkSetting(*values) for values in itertools.product(*axes))


def _ordered(settings: Iterable[NetworkSetting]) -> list[NetworkSetting]:
    """Sort settings, the paper's first: an unfinished search has what others are compared with."""
    return sorted(set(settings), key=lambda setting: (setting != PAPER, setting))


@dataclass(frozen=True)
class SettingGrid:
    """Settings that are tried, and the reason of each that is not, by its title."""

    settings: list[NetworkSetting]
    left_out: dict[str, str]


def make_grid(
    axes: Axes, windows: Windows, network: NetworkSettings, full: bool = False
) -> SettingGrid:
    """Return the settings that a network can be built for.

    A value that is impossible whatever it is combined with is wrong input; a combination that is
    impossible is left out.

    Raises:
        InputError: such a value, by the option's name.
    """
    for field in fields(axes):
        for value in getattr(axes, field.name):
            requirement = _requirement(field.name, value, windows, network)
            if requirement:
                raise InputError(f"--{field.name.split('_')[0]}", "", value, requirement)
    settings, left_out = [], {}
    for setting in axes.full if full else axes.default:
        if setting.length_ms % setting.step_ms:
            left_out[setting.title] = (
                f"steps of {setting.step_ms} ms do not divide a window of {setting.length_ms} ms"
            )
        elif windows.crop_px % setting.pool_px:
            left_out[setting.title] = (
                f"cells of {setting.pool_px} px do not divide the crop of {windows.crop_px} px"
            )
        else:
            settings.append(setting)
    return SettingGrid(settings, left_out)


def _requirement(name: str, value: Any, windows: Windows, network: NetworkSettings) -> str | None:
    """Return the requirement that a value violates, as text; None for a valid one."""
    if name == "width":
        wide = {key: round(getattr(network, key) * value) for key in CHANNELS}
        limits = {"conv1_channels": 256, "conv2_channels": 256, "hidden": 1024}
        if min(wide.values()) < 1 or any(wide[key] > limits[key] for key in CHANNELS):
            return f"must leave each layer 1 to 256 channels and hidden neurons, not {wide}"
        return None
    lowest, highest = {"length_ms": (1, 1000), "step_ms": (1, 100), "pool_px": (1, 240)}[name]
    if not lowest <= value <= highest:
        return f"must lie between {lowest} and {highest}"
    if name == "pool_px" and windows.crop_px % value:
        return f"must divide the crop of {windows.crop_px} px"
    return None


def strides(length_ms: int, finest_ms: int) -> list[int]:
    """Return the strides of windows of a length: multiples of the finest, and the length itself.

    None is longer than the window: that would leave out events.
    """
    return sorted({*range(finest_ms, length_ms + 1, finest_ms), length_ms})


def counted_stride(length_ms: int, finest_ms: int) -> int:
    """Return the stride at which spikes are counted; each of `strides` takes every k-th window."""
    return math.gcd(*strides(length_ms, finest_ms))
