"""Check whether the network fits a Speck (DynapCNN) chip, layer by layer, without the chip.

The vendor's compiler lives in a package that this program never imports, so
the rules are here as a table with their sources:

- cores and their memories: Sinabs 3.1.3, "Available Network Architecture" (its documentation,
  speck/faqs/available_network_arch) and the table in its `validate_memory_speck.py`;
- what a layer may be (kernel, stride, padding, features, sizes, bits, destinations): the vendor's
  page of the Speck 2e (samna's documentation, models/speckSeries/speck2e), and of the 2b before.

A fully connected layer is mapped as a convolution whose kernel covers its whole input.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

from sliplab.analysis.metrics.classification import CLASSES
from sliplab.analysis.networks.quantised import WEIGHT_BITS
from sliplab.plugins.deploy.card import latency_table, percent, table
from sliplab.plugins.deploy.chip import STATE_BITS
from sliplab.plugins.deploy.document import (
    ChipCore,
    ChipFit,
    ChipLimits,
    PlacedLayer,
    SpeckDescription,
)
from sliplab.protocols.network_settings import NetworkSettings
from sliplab.protocols.windows import Windows

KI = 1024


@dataclass(frozen=True)
class Core:
    """One core of the chip; memories in words."""

    number: int
    kernel_words: int
    neuron_words: int


CORES = tuple(
    Core(number, kernel * KI, neuron * KI)
    for numbers, kernel, neuron in (
        ((0, 1, 2), 16, 64),
        ((3, 4), 32, 32),
        ((5, 6), 64, 16),
        ((7, 8), 16, 16),
    )
    for number in numbers
)
MOST_KERNEL = 16
MOST_FEATURES = 1024
MOST_INPUT = 128
MOST_OUTPUT = 64
STRIDES = (1, 2, 4, 8)
MOST_PADDING = 7
DESTINATIONS = 2
"""Cores that one core may send to."""


@dataclass(frozen=True)
class SpeckLayer:
    """One layer of weights and the neurons behind it, as the chip sees it.

    Attributes:
        weights: that there are; the memory rounds up to powers of two.
        kernel_words, neuron_words: memory that the layer takes.
        fan_in: synapses of one neuron.
        fan_out: neurons that one input spike reaches at most.
    """

    name: str
    in_channels: int
    in_side: int
    out_channels: int
    out_side: int
    kernel: int
    stride: int
    padding: int
    weights: int
    neurons: int
    kernel_words: int
    neuron_words: int
    fan_in: int
    fan_out: int

    @property
    def problems(self) -> tuple[str, ...]:
        """Reasons for which no core of the chip can take the layer."""
        found = []
        for what, value, most in (
            ("kernel", self.kernel, MOST_KERNEL),
            ("input features", self.in_channels, MOST_FEATURES),
            ("output features", self.out_channels, MOST_FEATURES),
            ("input side", self.in_side, MOST_INPUT),
            ("output side", self.out_side, MOST_OUTPUT),
            ("padding", self.padding, MOST_PADDING),
        ):
            if value > most:
                found.append(f"{self.name}: {what} is {value}, at most {most}")
        if self.stride not in STRIDES:
            found.append(f"{self.name}: stride is {self.stride}, one of {STRIDES}")
        if not any(self.fits(core) for core in CORES):
            found.append(
                f"{self.name}: needs {self.kernel_words / KI:g} Ki of kernel memory and "
                f"{self.neuron_words / KI:g} Ki of neuron memory; no core has both"
            )
        return tuple(found)

    def fits(self, core: Core) -> bool:
        """True if the core's memories are enough."""
        return self.kernel_words <= core.kernel_words and self.neuron_words <= core.neuron_words


@dataclass(frozen=True)
class SpeckFit:
    """The layers, and the core of each.

    Attributes:
        cores: layer to number of its core; empty where they do not all fit.
        problems: why not.
    """

    layers: tuple[SpeckLayer, ...]
    cores: dict[str, int]
    problems: tuple[str, ...]

    @property
    def fits(self) -> bool:
        """True if the whole network fits on one chip."""
        return not self.problems

    def document(self) -> ChipFit:
        """Return the document of it: limits, layers with their cores, problems."""
        by_number = {core.number: core for core in CORES}
        layers = []
        for place, layer in enumerate(self.layers):
            number = self.cores.get(layer.name)
            following = self.layers[place + 1 : place + 2]
            core = None if number is None else by_number[number]
            layers.append(
                PlacedLayer(
                    **asdict(layer),
                    core=number,
                    core_kernel_words=None if core is None else core.kernel_words,
                    core_neuron_words=None if core is None else core.neuron_words,
                    destinations=tuple(self.cores[next_.name] for next_ in following if self.cores),
                )
            )
        return ChipFit(
            fits=self.fits,
            problems=self.problems,
            layers=tuple(layers),
            limits=ChipLimits(
                cores=tuple(ChipCore(**asdict(core)) for core in CORES),
                kernel=MOST_KERNEL,
                features=MOST_FEATURES,
                input_side=MOST_INPUT,
                output_side=MOST_OUTPUT,
                padding=MOST_PADDING,
                strides=STRIDES,
                destinations_of_a_core=DESTINATIONS,
                weight_bits=WEIGHT_BITS,
                state_bits=STATE_BITS,
            ),
        )


def speck_fit(network: NetworkSettings, windows: Windows) -> SpeckFit:
    """Lay a network out on the chip."""
    side = -(-windows.cells // 2)
    layers = (
        _layer(
            "conv1",
            windows.channels,
            windows.cells,
            network.conv1_channels,
            network.conv1_kernel,
            1,
            network.conv1_kernel // 2,
        ),
        _layer(
            "conv2",
            network.conv1_channels,
            windows.cells,
            network.conv2_channels,
            network.conv2_kernel,
            2,
            network.conv2_kernel // 2,
        ),
        _layer("fc1", network.conv2_channels, side, network.hidden, side, 1, 0),
        _layer("fc2", network.hidden, 1, len(CLASSES) * network.outputs_per_class, 1, 1, 0),
    )
    problems = [problem for layer in layers for problem in layer.problems]
    cores = _assign(layers)
    if not problems and len(cores) < len(layers):
        problems.append("each layer fits a core, but there are not enough of the cores needed")
    return SpeckFit(layers, {} if problems else cores, tuple(problems))


def _layer(
    name: str,
    in_channels: int,
    in_side: int,
    out_channels: int,
    kernel: int,
    stride: int,
    padding: int,
) -> SpeckLayer:
    out_side = (in_side - kernel + 2 * padding) // stride + 1
    reach = min(-(-kernel // stride), out_side)
    return SpeckLayer(
        name,
        in_channels,
        in_side,
        out_channels,
        out_side,
        kernel,
        stride,
        padding,
        weights=in_channels * kernel**2 * out_channels,
        neurons=out_channels * out_side**2,
        kernel_words=in_channels << _bits(kernel**2) + _bits(out_channels),
        neuron_words=out_channels << 2 * _bits(out_side),
        fan_in=in_channels * kernel**2,
        fan_out=out_channels * reach**2,
    )


def _bits(count: int) -> int:
    """Return the address bits for a number of things: the memory is addressed by whole bits."""
    return (count - 1).bit_length()


def _assign(layers: tuple[SpeckLayer, ...]) -> dict[str, int]:
    """Assign a core to each layer, as many as possible (augmenting paths)."""
    taken: dict[int, SpeckLayer] = {}

    def place(layer: SpeckLayer, seen: set[int]) -> bool:
        for core in CORES:
            if core.number in seen or not layer.fits(core):
                continue
            seen.add(core.number)
            if core.number not in taken or place(taken[core.number], seen):
                taken[core.number] = layer
                return True
        return False

    for layer in layers:
        place(layer, set())
    return {layer.name: number for number, layer in taken.items()}


NOT_SHOWN = (
    "The chip has no time steps: it looks at a neuron's threshold after every spike, where this "
    "looks once a millisecond.",
    "The chip adds biases (fc1, fc2) by its leak clock: it must tick once a step.",
    "The chip does not reset its neurons between windows; the program that reads it has to.",
    "Spikes of a class's output neurons are added up by the program that reads the chip.",
    "Routing, delays and lost spikes of the chip are not in here, and no chip has seen this file.",
)


def speck_markdown(found: SpeckDescription) -> str:
    """Write the content of ``*.speck.json`` as a page."""
    fit, whole = found.fit, found.quantisation
    stated = " (simulated)" if found.simulated else ""
    text = [f"# {found.model.file} on a Speck", ""]
    if fit.fits:
        text.append("It fits: one core a layer.")
    else:
        text += ["**It does not fit:**", "", *(f"- {problem}" for problem in fit.problems)]
    text += ["", "## Memory (words of the chip, rounded up as it rounds)", ""]
    text += table(
        [
            "layer",
            "core",
            "kernel memory",
            "of",
            "neuron memory",
            "of",
            "fan-in",
            "fan-out",
            "sends to",
        ],
        [
            [
                f"{layer.name} {layer.in_channels}x{layer.in_side}² → "
                f"{layer.out_channels}x{layer.out_side}², kernel {layer.kernel}",
                _or_dash(layer.core),
                _words(layer.kernel_words),
                _words(layer.core_kernel_words),
                _words(layer.neuron_words),
                _words(layer.core_neuron_words),
                layer.fan_in,
                layer.fan_out,
                ", ".join(map(str, layer.destinations)) or "output",
            ]
            for layer in fit.layers
        ],
    )
    text += ["", "## 8-bit weights", ""]
    text += table(
        ["layer", "scale", "threshold", "rounding (RMS)", "lowest potential", "highest", "cut off"],
        [
            [
                name,
                f"{layer.scale:g}",
                layer.threshold,
                f"{layer.rounding:.2%}",
                f"{layer.potential[0]:,.0f}",
                f"{layer.potential[1]:,.0f}",
                f"{layer.saturated:.3%}",
            ]
            for name, layer in whole.layers.items()
        ],
    )
    change = whole.change
    real, chip = whole.accuracy["real"], whole.accuracy["whole"]
    text += [
        "",
        f"A potential holds 16 bits and is cut off beyond. Over {change.windows} windows"
        f"{stated}: equal spike counts in {percent(change.equal_counts)}, the same class in "
        f"{percent(change.equal_class)}, the same class by the margin in "
        f"{percent(change.equal_class_by_margin)}; a count changes by "
        f"{change.mean_change:.2f} on average and {change.largest_change} at most.",
        "",
        *table(
            [f"accuracy{stated}", "as trained", "8 bits"],
            [
                ["strict", percent(real.strict), percent(chip.strict)],
                ["margin", percent(real.margin), percent(chip.margin)],
                ["argmax", percent(real.argmax), percent(chip.argmax)],
            ],
        ),
        "",
        f"## Detection latency as trained{stated}",
        "",
        *latency_table(found.detection["real"]),
        "",
        f"## Detection latency with 8 bits{stated}",
        "",
        *latency_table(found.detection["whole"]),
        "",
        "## What this does not show",
        "",
        *(f"- {line}" for line in NOT_SHOWN),
    ]
    return "\n".join(text) + "\n"


def _words(words: int | None) -> str:
    if words is None:
        return "-"
    return f"{words / KI:g} Ki" if words >= KI else str(words)


def _or_dash(value: object) -> str:
    return "-" if value is None else str(value)
