"""External spiking networks: a state_dict and a description of its layers.

Sinabs itself computes them, so that the counts are those that their authors see. The event-driven
kernels may take its place where the layers are those of `networks.network`; on weights off the
grid (`networks.network.on_grid`) they add in another order than Sinabs, and a potential that
ends at its threshold may fall on either side of it.
"""

from __future__ import annotations

import io
import pickle
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt
import torch
from pydantic import Field, ValidationInfo, field_validator
from sinabs.activation import MembraneReset, MembraneSubtract, MultiSpike, SingleSpike
from sinabs.layers import IAFSqueeze, LIFSqueeze, SumPool2d
from torch import nn

from sliplab.analysis.metrics.classification import CLASSES
from sliplab.analysis.networks.network import (
    SPIKING,
    WEIGHTED,
    build,
    exact,
    matrices,
    parameters,
    set_weights,
)
from sliplab.protocols.errors import InputError
from sliplab.protocols.key_errors import KeyedError, register_tags
from sliplab.protocols.network_settings import NetworkSettings
from sliplab.protocols.windows import Windows
from sliplab.protocols.yaml_file import StrictModel, input_error, load
from sliplab.storage.files import read_plain

Name = Annotated[str, Field(min_length=1, max_length=200)]
Side = Annotated[int, Field(ge=1, le=512)]
STATES = ("v_mem", "i_syn")
"""States that Sinabs' layers keep with their parameters; every window begins without them."""


class Conv(StrictModel):
    """A convolution over the cells; channels and kernel are those of its weights."""

    kind: Literal["conv"]
    name: Name
    """Name of the layer in the state_dict: ``conv1`` for ``conv1.weight``."""
    stride: Side = 1
    padding: Annotated[int, Field(ge=0, le=512)] = 0


class Linear(StrictModel):
    """A fully connected layer."""

    kind: Literal["linear"]
    name: Name


class Pool(StrictModel):
    """Sum, average or maximum of spikes over square patches."""

    kind: Literal["pool"]
    how: Literal["sum", "average", "max"]
    size: Side
    stride: Side | None = None
    """Equal to the size by default."""


class Flatten(StrictModel):
    """Flatten channels and cells into one axis."""

    kind: Literal["flatten"]


class Neurons(StrictModel):
    """Integrate-and-fire neurons of Sinabs, leaky with a time constant."""

    kind: Literal["iaf", "lif"]
    name: Name | None = None
    """Name of the layer in the state_dict, where that has its threshold."""
    threshold: Annotated[float, Field(gt=0, le=1e6)] | None = None
    """Potential at which a neuron fires; by default that of the state_dict."""
    spikes: Literal["single", "multi"]
    """At most one spike a step (SingleSpike), or as many as thresholds are in the potential
    (MultiSpike, which is Sinabs' default)."""
    reset: Literal["zero", "subtract"]
    """A neuron that fires goes back to zero (MembraneReset), or loses a threshold for each spike
    (MembraneSubtract, which is Sinabs' default)."""
    lowest: float | None = None
    """Potentials do not fall below it (min_v_mem)."""
    tau_mem: Annotated[float, Field(gt=0, le=1e6)] | None = None
    """Time constant of a lif's potential, steps; by default that of the state_dict."""
    norm_input: bool = True
    """For a lif, scale currents so that the potential approaches a constant one."""


Layer = Annotated[Conv | Linear | Pool | Flatten | Neurons, Field(discriminator="kind")]
register_tags("conv", "linear", "pool", "flatten", "iaf", "lif")


class Description(StrictModel):
    """The description file of a state_dict."""

    model: Literal[1]
    """Version of the file format."""
    weights: Annotated[str, Field(min_length=1, max_length=1000)]
    """The file that `torch.save(net.state_dict(), FILE)` wrote; relative to this one."""
    windows: Windows = Windows()
    """Input of the network: event counts (steps, channels, cells, cells)."""
    layers: tuple[Layer, ...] = Field(min_length=1, max_length=100)
    classes: tuple[Name, ...] = Field(
        default=CLASSES, min_length=2, max_length=1024, exclude_if=lambda names: names == CLASSES
    )
    """Names of the classes, where they are not those of slip."""
    outputs: tuple[Name, ...] = Field(default_factory=lambda data: data.get("classes", CLASSES))
    """The class of each output neuron; spikes of a class are added up."""

    @field_validator("classes")
    @classmethod
    def _distinct(cls, classes: tuple[str, ...]) -> tuple[str, ...]:
        if len(set(classes)) < len(classes):
            raise ValueError("must name each class once")
        return classes

    @field_validator("outputs")
    @classmethod
    def _every_class(cls, outputs: tuple[str, ...], info: ValidationInfo) -> tuple[str, ...]:
        classes = info.data.get("classes", CLASSES)
        other = [name for name in outputs if name not in classes]
        if other:
            raise ValueError(f"must be classes, one of {', '.join(classes)}; {other[0]} is none")
        left = [name for name in classes if name not in outputs]
        if left:
            raise ValueError(f"must give each class a neuron; none is {left[0]}")
        return outputs


@dataclass(frozen=True)
class ExternalModel:
    """A described network with its weights, checked against each other.

    Attributes:
        description: the file.
        weights: the state_dict's bytes.
    """

    description: Description
    weights: bytes

    @property
    def windows(self) -> Windows:
        """Windows that the network expects."""
        return self.description.windows

    @property
    def outputs_per_class(self) -> float:
        """Mean number of output neurons of a class."""
        return len(self.description.outputs) / len(self.description.classes)

    def sinabs(self) -> SinabsNet:
        """The network in Sinabs' layers."""
        return _assemble(self.description, _tensors(self.weights))

    def fast(self) -> nn.Sequential:
        """The same as `analysis.networks.network.build` makes it, for the kernels.

        Raises:
            ValueError: the kernels compute no such network; the message says which part.
        """
        return _as_ours(self.description, _tensors(self.weights))

    def on_grid(self) -> bool:
        """Check if the kernels' counts are Sinabs' by arithmetic."""
        try:
            return exact(matrices(self.fast()))
        except ValueError:
            return False


@dataclass(frozen=True)
class SinabsNet:
    """A network in Sinabs' layers, time folded into the batch.

    Attributes:
        classes: int64 (outputs,), the class of each output neuron; each class has one.
    """

    net: nn.Sequential
    windows: Windows
    classes: npt.NDArray[np.int64]

    def counts(self, x: npt.NDArray[Any], batch: int = 64) -> npt.NDArray[np.int64]:
        """Output spikes int64 (n, classes) of windows (n, T, C, H, W), from rest.

        Raises:
            ValueError: windows of another shape.
        """
        settings = self.windows
        expected = (settings.steps, settings.channels, settings.cells, settings.cells)
        if x.shape[1:] != expected:
            raise ValueError(f"samples have the shape {x.shape}; expected (n, {expected})")
        out = np.zeros((len(x), int(self.classes.max()) + 1), np.int64)
        with torch.no_grad():
            for start in range(0, len(x), batch):
                part = torch.from_numpy(x[start : start + batch].astype(np.float32))
                for layer in self.net:
                    if isinstance(layer, IAFSqueeze | LIFSqueeze):
                        layer.reset_states()
                spikes = self.net(part.flatten(0, 1)).unflatten(0, (len(part), -1)).sum(dim=1)
                counted = np.rint(spikes.numpy()).astype(np.int64)
                np.add.at(out[start : start + batch].T, self.classes, counted.T)
        return out


class EntryError(ValueError):
    """An entry of a state_dict that is missing, surplus, or does not fit its layer."""

    def __init__(self, entry: str, tensor: torch.Tensor | None, expected: str) -> None:
        super().__init__(expected)
        self.entry = entry
        self.shape = None if tensor is None else list(tensor.shape)


def load_external(path: Path) -> ExternalModel:
    """Read a description (YAML or JSON) and the weights that it names, and check both.

    Nothing in the weights is executed.

    Raises:
        InputError: file, key, value and what would be right; of an entry of the weights its name
            and its shape.
    """
    description = load(Description, path, "description of a model")
    file = path.parent / description.weights
    try:
        data = read_plain(file)
    except OSError as error:
        reason = f"cannot be read: {error.strerror}"
        raise InputError(path, "weights", description.weights, reason) from None
    try:
        _assemble(description, _tensors(data))
    except KeyedError as error:
        raise input_error(path, error) from None
    except EntryError as error:
        raise InputError(file, error.entry, error.shape, str(error)) from None
    except ValueError as error:
        raise InputError(file, "", None, str(error)) from None
    return ExternalModel(description, data)


def _tensors(data: bytes) -> dict[str, torch.Tensor]:
    """A state_dict's tensors, without the states of neurons."""
    try:
        found = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    except (RuntimeError, EOFError, ValueError, pickle.UnpicklingError):
        found = None
    if not isinstance(found, dict) or not all(isinstance(v, torch.Tensor) for v in found.values()):
        raise ValueError("must be a state_dict: save it by torch.save(net.state_dict(), FILE)")
    tensors = {
        str(name): value
        for name, value in found.items()
        if str(name).rpartition(".")[2] not in STATES
    }
    for name, value in tensors.items():
        retained = value.layout is torch.strided and value.device.type == "cpu"
        if not retained or value.is_complex() or value.is_quantized:
            raise EntryError(name, value, "must be a plain tensor of real numbers")
    return {name: value.float() for name, value in tensors.items()}


class _Entries:
    """A state_dict of which each entry is taken once, by one layer."""

    def __init__(self, tensors: dict[str, torch.Tensor]) -> None:
        self._all = tensors
        self._left = dict(tensors)

    def weight(self, name: str, layer: str, dimensions: int) -> torch.Tensor:
        """The weights of a layer, finite and of so many dimensions."""
        entry = f"{name}.weight"
        found = self.perhaps(entry)
        if found is None:
            fit = [key for key, value in self._left.items() if value.ndim == dimensions]
            why = (
                f"is taken twice, again by {layer}"
                if entry in self._all
                else (f"is missing, and {layer} takes it")
            )
            raise EntryError(
                entry,
                None,
                f"{why}; entries of {dimensions} dimensions that no layer before it takes: "
                f"{', '.join(sorted(fit)) or 'none'}",
            )
        if found.ndim != dimensions or not found.numel():
            sizes = "(outputs, inputs)" if dimensions == 2 else "(outputs, inputs, height, width)"
            raise EntryError(entry, found, f"{layer} takes weights of the shape {sizes}")
        return found

    def bias(self, name: str, weight: torch.Tensor) -> torch.Tensor | None:
        """The biases of a layer, one for each of its outputs; None where it has none."""
        found = self.perhaps(f"{name}.bias")
        if found is not None and found.shape != weight.shape[:1]:
            raise EntryError(
                f"{name}.bias",
                found,
                f"must have the shape {list(weight.shape[:1])}, one for each output of "
                f"{name}.weight {list(weight.shape)}",
            )
        return found

    def perhaps(self, entry: str) -> torch.Tensor | None:
        """Return and remove an entry, checked to be finite; None where it is missing."""
        found = self._left.pop(entry, None)
        if found is not None and not found.isfinite().all():
            wrong = int((~found.isfinite()).sum())
            raise EntryError(
                entry,
                found,
                f"{wrong} of its {found.numel()} values are NaN, infinite, or beyond "
                "32-bit floats; all must be finite",
            )
        return found

    def refuse_surplus(self) -> None:
        """Check that every entry was taken."""
        for entry, tensor in self._left.items():
            more = f", nor {len(self._left) - 1} more" if len(self._left) > 1 else ""
            raise EntryError(
                entry,
                tensor,
                f"no layer of the description takes it{more}; describe the layer, "
                "or leave the entry out of the file",
            )


def _assemble(description: Description, tensors: dict[str, torch.Tensor]) -> SinabsNet:
    """The layers in order, with every tensor used and every shape checked."""
    windows = description.windows
    entries = _Entries(tensors)
    shape: tuple[int, ...] = (windows.channels, windows.cells, windows.cells)
    layers: list[nn.Module] = []
    for place, layer in enumerate(description.layers):
        made = _module(layer, f"layers[{place}]", entries, shape, windows.steps)
        layers.append(made)
        with torch.no_grad():
            shape = tuple(made(torch.zeros(windows.steps, *shape)).shape[1:])
    entries.refuse_surplus()
    if not isinstance(description.layers[-1], Neurons):
        raise KeyedError("layers", description.layers[-1].kind, "must end with neurons")
    if shape != (len(description.outputs),):
        raise KeyedError(
            "outputs", len(description.outputs), f"the last layer gives {list(shape)}; name each"
        )
    classes = np.array([description.classes.index(name) for name in description.outputs], np.int64)
    return SinabsNet(nn.Sequential(*layers), windows, classes)


def _module(
    layer: Layer, key: str, entries: _Entries, shape: tuple[int, ...], steps: int
) -> nn.Module:
    """One layer with its entries."""
    if isinstance(layer, Neurons):
        return _neurons(layer, key, entries, steps)
    if isinstance(layer, Flatten):
        return nn.Flatten()
    if isinstance(layer, Linear):
        weight = entries.weight(layer.name, key, 2)
        if shape != weight.shape[1:]:
            hint = "; a flatten belongs before it" if len(shape) > 1 else ""
            raise _unfit(layer.name, weight, f"{key} is given {list(shape)}{hint}")
        bias = entries.bias(layer.name, weight)
        made: nn.Module = nn.Linear(weight.shape[1], weight.shape[0], bias=bias is not None)
        return _filled(made, weight, bias)
    if len(shape) != 3:
        raise KeyedError(f"{key}.kind", layer.kind, f"needs channels and cells, not {list(shape)}")
    if isinstance(layer, Conv):
        weight = entries.weight(layer.name, key, 4)
        if weight.shape[1] != shape[0]:
            raise _unfit(layer.name, weight, f"{key} is given {shape[0]} channels, {list(shape)}")
        outer = min(shape[1:]) + 2 * layer.padding
        if max(weight.shape[2:]) > outer:
            raise KeyedError(
                f"{key}.padding",
                layer.padding,
                f"leaves {outer} cells for a kernel of {max(weight.shape[2:])}",
            )
        bias = entries.bias(layer.name, weight)
        made = nn.Conv2d(
            weight.shape[1],
            weight.shape[0],
            (weight.shape[2], weight.shape[3]),
            stride=layer.stride,
            padding=layer.padding,
            bias=bias is not None,
        )
        return _filled(made, weight, bias)
    if layer.size > min(shape[1:]):
        raise KeyedError(f"{key}.size", layer.size, f"must not exceed the {min(shape[1:])} cells")
    stride = layer.stride or layer.size
    if layer.how == "sum":
        return SumPool2d(layer.size, stride)
    return (nn.AvgPool2d if layer.how == "average" else nn.MaxPool2d)(layer.size, stride)


def _unfit(name: str, weight: torch.Tensor, given: str) -> EntryError:
    """Weights for another number of inputs than the layer before gives."""
    return EntryError(f"{name}.weight", weight, f"takes {weight.shape[1]} inputs, but {given}")


def _filled(made: Any, weight: torch.Tensor, bias: torch.Tensor | None) -> Any:
    with torch.no_grad():
        made.weight.copy_(weight)
        if bias is not None:
            made.bias.copy_(bias)
    return made


def _neurons(layer: Neurons, key: str, entries: _Entries, steps: int) -> nn.Module:
    """Neurons with the parameters of the description, or those of the state_dict."""

    def of(parameter: str, stated: float | None, called: str, *, positive: bool) -> float | None:
        entry = f"{layer.name}.{parameter}"
        retained = entries.perhaps(entry) if layer.name else None
        if retained is None:
            return stated
        if retained.numel() != 1:
            raise EntryError(entry, retained, f"must be one number for all neurons of {key}")
        value = float(retained)
        if positive and value <= 0:
            raise EntryError(entry, retained, f"is {value:g} and must be above zero")
        if stated is not None and np.float32(stated) != np.float32(value):
            raise KeyedError(f"{key}.{called}", stated, f"the state_dict has {value:g}")
        return value

    threshold = of("spike_threshold", layer.threshold, "threshold", positive=True)
    lowest = of("min_v_mem", layer.lowest, "lowest", positive=False)
    tau = of("tau_mem", layer.tau_mem, "tau_mem", positive=True)
    if threshold is None:
        raise KeyedError(f"{key}.threshold", None, "is missing, and the state_dict has none")
    if (tau is None) == (layer.kind == "lif"):
        right = "is missing, and the state_dict has none" if tau is None else "belongs to a lif"
        raise KeyedError(f"{key}.tau_mem", tau, right)
    common: dict[str, Any] = {
        "num_timesteps": steps,
        "spike_threshold": torch.tensor(threshold),
        "spike_fn": SingleSpike if layer.spikes == "single" else MultiSpike,
        "reset_fn": MembraneReset() if layer.reset == "zero" else MembraneSubtract(),
        "min_v_mem": lowest,
    }
    if layer.kind == "iaf":
        return IAFSqueeze(**common)
    return LIFSqueeze(tau_mem=tau, norm_input=layer.norm_input, **common)


def _as_ours(description: Description, tensors: dict[str, torch.Tensor]) -> nn.Sequential:
    made: list[Any] = list(_assemble(description, tensors).net)
    order = (
        nn.Conv2d,
        IAFSqueeze,
        nn.Conv2d,
        IAFSqueeze,
        nn.Flatten,
        nn.Linear,
        IAFSqueeze,
        nn.Linear,
        IAFSqueeze,
    )
    if tuple(map(type, made)) != order:
        raise ValueError("the layers are not two convolutions and two fully connected ones")
    classes = description.classes
    if description.outputs != classes * (len(description.outputs) // len(classes)):
        raise ValueError(f"outputs must be {', '.join(classes)}, again and again")
    conv1, conv2, fc1, fc2 = weighted = [made[k] for k in (0, 2, 5, 7)]
    stated = [layer for layer in description.layers if isinstance(layer, Neurons)]
    if any((each.spikes, each.reset) != ("single", "zero") for each in stated):
        raise ValueError("neurons must fire once a step and be reset to zero")
    neurons = [made[k] for k in (1, 3, 6, 8)]
    if any(each.min_v_mem is not None for each in neurons):
        raise ValueError("neurons must have no lowest potential")
    if len({float(each.spike_threshold) for each in neurons}) > 1:
        raise ValueError("all thresholds must be the same")
    if (fc1.bias is None) != (fc2.bias is None):
        raise ValueError("both fully connected layers must have biases, or none")
    if conv1.bias is not None or conv2.bias is not None:
        raise ValueError("convolutions must have no biases")
    for conv, stride in ((conv1, 1), (conv2, 2)):
        (k, *_), square = conv.kernel_size, len(set(conv.kernel_size)) == 1
        if not square or k not in (1, 3, 5, 7) or conv.padding != (k // 2,) * 2:
            raise ValueError("kernels must be squares of 1, 3, 5 or 7, padded by their half")
        if conv.stride != (stride, stride):
            raise ValueError("strides must be 1 and 2")
    net = build(
        NetworkSettings(
            conv1_channels=conv1.out_channels,
            conv2_channels=conv2.out_channels,
            conv1_kernel=conv1.kernel_size[0],
            conv2_kernel=conv2.kernel_size[0],
            hidden=fc1.out_features,
            outputs_per_class=fc2.out_features // len(classes),
            biases=fc1.bias is not None,
        ),
        description.windows,
        0,
        len(classes),
    )
    theirs = dict(zip(WEIGHTED, weighted, strict=True))
    set_weights(
        net,
        {
            name: getattr(theirs[layer], kind).detach()
            for name in parameters(net)
            for layer, kind in [name.split(".")]
        },
    )
    for name, each in zip(SPIKING, neurons, strict=True):
        getattr(net, name).spike_threshold = each.spike_threshold
    return net
