"""Settings of the spiking network."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from sliplab.protocols.yaml_file import StrictModel

MARGIN = 2.0
"""Spikes by which a class must lead for each of its output neurons: the paper's rule."""
SPIKE_THRESHOLD = 1.0
"""Membrane potential at which a neuron fires."""
MOST_CHANNELS = 4096
"""And hidden neurons, of a layer."""
SIZES = frozenset(
    {"conv1_channels", "conv2_channels", "hidden", "conv1_kernel", "conv2_kernel", "weight_scale"}
)
"""Settings that follow from the data with ``start: regression``."""
Scale = Annotated[float, Field(ge=0, le=1e6)]


class NetworkSettings(StrictModel):
    """The spiking network: two convolutions, two fully connected layers, IAF neurons."""

    start: Literal["random", "regression"] = Field(
        default="random", exclude_if=lambda value: value == "random"
    )
    """First weights: drawn, or a logistic regression on the events of taxels, which sets the sizes
    of all layers. It is the default where there are taxels, and no size is given."""
    conv1_channels: int = Field(default=8, ge=1, le=MOST_CHANNELS)
    conv2_channels: int = Field(default=16, ge=1, le=MOST_CHANNELS)
    hidden: int = Field(default=32, ge=1, le=MOST_CHANNELS)
    outputs_per_class: int = Field(default=4, ge=1, le=64)
    """Output neurons of each class, whose spikes are counted together: with one, as in the paper,
    a window of 30 steps has 31 counts to distinguish classes by, and more ties."""
    biases: bool = True
    """Biases in the full layers: without them nothing can say "no events" (docs/network.md)."""
    conv1_kernel: Literal[1, 3, 5, 7] = 5
    conv2_kernel: Literal[1, 3, 5, 7] = 3
    """Side of the square kernels, cells."""
    weight_scale: tuple[Scale, Scale, Scale, Scale] = (4.0, 3.0, 4.0, 3.0)
    """Factors on the default initial weights; without them the deep layers stay silent."""

    @property
    def margin(self) -> float:
        """The paper's lead of a winner, in spikes of a class: two for each of its neurons."""
        return MARGIN * self.outputs_per_class
