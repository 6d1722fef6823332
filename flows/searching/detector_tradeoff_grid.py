"""Which networks the detector's trade-off trains: lines through the paper's point, and a cross.

A whole cross of four factors is some 150 trainings a seed. By default every factor is varied alone
with the others at the paper's values, and window length and pooling, which share the events among
them, are crossed at the shortest, the paper's and the longest window; `full` gives the whole cross.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

from sliplab.protocols.errors import InputError
from sliplab.protocols.settings import Network, Windows

CHANNELS = ("conv1_channels", "conv2_channels", "hidden")


@dataclass(frozen=True, order=True)
class Setting:
    """What a network is trained for.

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
    def words(self) -> str:
        """For people."""
        return f"{self.length_ms} ms in {self.step_ms} ms, {self.pool_px} px, ×{self.width:g}"

    @property
    def slug(self) -> str:
        """For the names of files."""
        width = f"{self.width:g}".replace(".", "p")
        return f"l{self.length_ms}_s{self.step_ms}_p{self.pool_px}_w{width}"

    def windows(self, base: Windows) -> Windows:
        """A protocol's windows with these lengths and cells."""
        return Windows.model_validate({**base.model_dump(), **self._windows()})

    def _windows(self) -> dict[str, int]:
        return {name: getattr(self, name) for name in ("length_ms", "step_ms", "pool_px")}

    def network(self, base: Network) -> Network:
        """A protocol's network with this width: whole channels, at least one."""
        wide = {name: max(1, round(getattr(base, name) * self.width)) for name in CHANNELS}
        return Network.model_validate({**base.model_dump(), **wide})

    def as_dict(self) -> dict[str, Any]:
        """Plain data."""
        return asdict(self)


PAPER = Setting()


@dataclass(frozen=True)
class Axes:
    """The values of each factor; names as in `Setting`."""

    length_ms: tuple[int, ...] = (5, 10, 20, 30, 40, 50)
    step_ms: tuple[int, ...] = (1, 2, 5)
    pool_px: tuple[int, ...] = (10, 20, 40)
    width: tuple[float, ...] = (0.5, 1.0, 2.0)

    def line(self, name: str) -> list[Setting]:
        """One factor varied, the others at the paper's values."""
        return [replace(PAPER, **{name: value}) for value in getattr(self, name)]

    @property
    def default(self) -> list[Setting]:
        """All lines through the paper's point, and the small cross of length and pooling."""
        lines = (setting for field in fields(self) for setting in self.line(field.name))
        cross = (
            replace(PAPER, length_ms=length, pool_px=pool)
            for length in (min(self.length_ms), max(self.length_ms))
            for pool in self.pool_px
        )
        return _once([PAPER, *lines, *cross])

    @property
    def whole(self) -> list[Setting]:
        """Each value with each."""
        return _once(
            Setting(length, step, pool, width)
            for length in self.length_ms
            for step in self.step_ms
            for pool in self.pool_px
            for width in self.width
        )


def _once(settings: Iterable[Setting]) -> list[Setting]:
    """In a fixed order, the paper's point first: an unfinished search has what it is held to."""
    return sorted(set(settings), key=lambda setting: (setting != PAPER, setting))


@dataclass(frozen=True)
class Grid:
    """What is tried, and what is not, with the reason."""

    settings: list[Setting]
    left_out: dict[str, str]


def make_grid(axes: Axes, windows: Windows, network: Network, full: bool = False) -> Grid:
    """The settings that a network can be built for.

    A value that is impossible whatever it is combined with is wrong input; a combination that is
    impossible is left out.

    Raises:
        InputError: such a value, by the option's name.
    """
    for name in ("length_ms", "step_ms", "pool_px", "width"):
        option = f"--{name.split('_')[0]}"
        for value in getattr(axes, name):
            wrong = _impossible(name, value, windows, network)
            if wrong:
                raise InputError(option, "", value, wrong)
    wanted = axes.whole if full else axes.default
    left_out = {}
    for setting in wanted:
        if setting.length_ms % setting.step_ms:
            left_out[setting.words] = (
                f"steps of {setting.step_ms} ms do not divide a window of {setting.length_ms} ms"
            )
        elif windows.crop_px % setting.pool_px:
            left_out[setting.words] = (
                f"cells of {setting.pool_px} px do not divide the crop of {windows.crop_px} px"
            )
    return Grid([setting for setting in wanted if setting.words not in left_out], left_out)


def _impossible(name: str, value: Any, windows: Windows, network: Network) -> str | None:
    """What would be right, where no network can have this value."""
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
    """Strides of windows of a length: multiples of the finest, and the length itself.

    None is longer than the window: that would leave out events.
    """
    return sorted({*range(finest_ms, length_ms + 1, finest_ms), length_ms})


def counted_stride(length_ms: int, finest_ms: int) -> int:
    """The stride at which spikes are counted once; each of `strides` takes every k-th window."""
    return math.gcd(*strides(length_ms, finest_ms))
