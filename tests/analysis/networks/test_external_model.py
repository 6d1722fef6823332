"""Networks that were made elsewhere count as Sinabs itself does, and faults in them are named."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from sinabs.activation import MembraneReset, MembraneSubtract, MultiSpike, SingleSpike
from sinabs.layers import IAFSqueeze, LIFSqueeze, SumPool2d
from torch import nn

from sliplab.analysis.networks.external_model import Description, load_external
from sliplab.analysis.networks.network import spike_counts
from sliplab.analysis.networks.spiking import SpikeEngine
from sliplab.protocols import InputError
from sliplab.protocols.windows import Windows
from sliplab.protocols.yaml_file import parse_yaml, validate
from tests.conftest import ROOT

pytestmark = pytest.mark.usefixtures("one_thread")

STEPS, CELLS = 20, 12
WINDOWS = {"length_ms": STEPS, "crop_px": 240}
OURS: list[dict[str, Any]] = [
    {"kind": "conv", "name": "0", "padding": 2},
    {"kind": "iaf", "name": "1", "spikes": "single", "reset": "zero"},
    {"kind": "conv", "name": "2", "stride": 2, "padding": 1},
    {"kind": "iaf", "name": "3", "threshold": 1, "spikes": "single", "reset": "zero"},
    {"kind": "flatten"},
    {"kind": "linear", "name": "5"},
    {"kind": "iaf", "name": "6", "spikes": "single", "reset": "zero"},
    {"kind": "linear", "name": "7"},
    {"kind": "iaf", "name": "8", "spikes": "single", "reset": "zero"},
]


def papers(
    step: float, outputs: int = 3, threshold: float = 1.0, cells: int = CELLS, steps: int = STEPS
) -> nn.Sequential:
    """The paper's layers in plain Sinabs, weights whole multiples of `step`."""
    torch.manual_seed(0)

    def neurons() -> IAFSqueeze:
        return IAFSqueeze(
            num_timesteps=steps,
            spike_fn=SingleSpike,
            reset_fn=MembraneReset(),
            spike_threshold=torch.tensor(threshold),
        )

    net = nn.Sequential(
        nn.Conv2d(1, 4, 5, padding=2, bias=False),
        neurons(),
        nn.Conv2d(4, 6, 3, stride=2, padding=1, bias=False),
        neurons(),
        nn.Flatten(),
        nn.Linear(6 * (cells // 2) ** 2, 16),
        neurons(),
        nn.Linear(16, outputs),
        neurons(),
    )
    return rounded(net, step)


def rounded(net: nn.Sequential, step: float) -> nn.Sequential:
    with torch.no_grad():
        for layer in net:
            if isinstance(layer, nn.Conv2d | nn.Linear):
                for value in layer.parameters():
                    value.copy_((value * 4 / step).round() * step)
    return net


def by_hand(net: nn.Sequential, x: np.ndarray, batch: int) -> np.ndarray:
    """Output spikes (n, outputs) of Sinabs' layers as their documentation runs them."""
    out = []
    for start in range(0, len(x), batch):
        for layer in net:
            if hasattr(layer, "reset_states"):
                layer.reset_states()
        part = torch.from_numpy(x[start : start + batch].astype(np.float32))
        with torch.no_grad():
            spikes = net(part.flatten(0, 1))
        out.append(spikes.unflatten(0, (len(part), -1)).sum(dim=1).numpy())
    return np.concatenate(out).astype(np.int64)


def windows(n: int, share: float = 0.05, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).poisson(share, (n, STEPS, 1, CELLS, CELLS)).astype(np.uint8)


def saved(
    folder: Path, net: nn.Sequential, layers: list[dict[str, Any]] | None = None, **more: Any
) -> Path:
    """Weights and description of a network, in files."""
    torch.save(net.state_dict(), folder / "lab.pt")
    data = {"model": 1, "weights": "lab.pt", "windows": WINDOWS, "layers": layers or OURS, **more}
    path = folder / "lab.yaml"
    path.write_text(yaml.safe_dump(data))
    return path


def check_counts(found: Any, x: np.ndarray, expected: np.ndarray) -> None:
    """Sinabs' own layers, our engine and the plain kernels count alike."""
    np.testing.assert_array_equal(found.sinabs().counts(x), expected)
    np.testing.assert_array_equal(SpikeEngine(found.fast(), CELLS).counts(x), expected)


@pytest.mark.quick(1)
@pytest.mark.parametrize("batch", [1, 7, 64])
def test_weights_of_tenths_give_sinabs_own_counts(tmp_path: Path, batch: int) -> None:
    net, x = papers(0.1), windows(150, 0.2)
    found = load_external(saved(tmp_path, net))
    assert not found.on_grid()
    counts = found.sinabs().counts(x)
    np.testing.assert_array_equal(counts, by_hand(net, x, batch))
    assert len(np.unique(counts, axis=0)) > 10
    # a file written after a run holds potentials of its batch: they are left out
    np.testing.assert_array_equal(load_external(saved(tmp_path, net)).sinabs().counts(x), counts)


@pytest.mark.parametrize("outputs", [3, 12])
def test_on_the_grid_the_kernels_count_as_sinabs_does(tmp_path: Path, outputs: int) -> None:
    net, x = papers(2.0**-6, outputs), windows(100)
    names = ["no_slip", "incipient", "gross"] * (outputs // 3)
    found = load_external(saved(tmp_path, net, outputs=names))
    assert found.on_grid()
    assert found.outputs_per_class == outputs / 3
    expected = by_hand(net, x, 50).reshape(100, -1, 3).sum(axis=1)
    check_counts(found, x, expected)
    np.testing.assert_array_equal(spike_counts(found.fast(), x), expected)


def test_other_thresholds_are_kept(tmp_path: Path) -> None:
    net, x = papers(2.0**-6, threshold=1.5), windows(60)
    layers = [dict(each) for each in OURS]
    layers[3]["threshold"] = 1.5
    found = load_external(saved(tmp_path, net, layers))
    check_counts(found, x, by_hand(net, x, 60))


def test_pools_leaks_and_sinabs_default_neurons(tmp_path: Path) -> None:
    """Five outputs: two of no slip, two of incipient, one of gross."""
    torch.manual_seed(1)
    multi = {"spike_fn": MultiSpike, "reset_fn": MembraneSubtract()}
    net = nn.Sequential(
        nn.Conv2d(1, 4, 3, padding=1),
        IAFSqueeze(num_timesteps=STEPS, min_v_mem=-1.0, **multi),
        SumPool2d(2),
        nn.Conv2d(4, 4, (3, 3)),
        LIFSqueeze(tau_mem=15.0, num_timesteps=STEPS, norm_input=False, **multi),
        nn.AvgPool2d(2),
        nn.MaxPool2d(2, 1),
        nn.Flatten(),
        nn.Linear(4, 5),
        IAFSqueeze(num_timesteps=STEPS, **multi),
    )
    rounded(net, 0.1)
    both = {"spikes": "multi", "reset": "subtract"}
    layers = [
        {"kind": "conv", "name": "0", "padding": 1},
        {"kind": "iaf", "name": "1", **both},
        {"kind": "pool", "how": "sum", "size": 2},
        {"kind": "conv", "name": "3"},
        {"kind": "lif", "name": "4", "norm_input": False, **both},
        {"kind": "pool", "how": "average", "size": 2},
        {"kind": "pool", "how": "max", "size": 2, "stride": 1},
        {"kind": "flatten"},
        {"kind": "linear", "name": "8"},
        {"kind": "iaf", "name": "9", **both},
    ]
    names = ["incipient", "no_slip", "gross", "no_slip", "incipient"]
    found, x = load_external(saved(tmp_path, net, layers, outputs=names)), windows(40, 0.03)
    counts = by_hand(net, x, 40)
    expected = np.stack([counts[:, 1] + counts[:, 3], counts[:, 0] + counts[:, 4], counts[:, 2]], 1)
    assert len(np.unique(expected, axis=0)) > 10
    np.testing.assert_array_equal(found.sinabs().counts(x), expected)
    assert not found.on_grid()
    with pytest.raises(ValueError, match="not two convolutions"):
        found.fast()


def _at(place: int, **changes: Any) -> Callable[[list[dict[str, Any]]], None]:
    return lambda layers: layers[place].update(changes)


WRONG: dict[str, tuple[Callable[[list[dict[str, Any]]], object], str]] = {
    "no such weights": (
        _at(0, name="first"),
        r"lab\.pt: first\.weight: is missing, and layers\[0\] takes it; entries of 4 dimensions "
        r"that no layer before it takes: 0\.weight, 2\.weight",
    ),
    "weights taken twice": (
        _at(2, name="0"),
        r"lab\.pt: 0\.weight: is taken twice, again by layers\[2\]; .*: 2\.weight",
    ),
    "a matrix for a convolution": (
        _at(2, name="5"),
        r"lab\.pt: 5\.weight = \[16, 216\]: layers\[2\] takes weights of the shape "
        r"\(outputs, inputs, height, width\)",
    ),
    "stride forgotten": (
        _at(2, stride=1),
        r"lab\.pt: 5\.weight = \[16, 216\]: takes 216 inputs, but layers\[5\] is given \[864\]",
    ),
    "flatten forgotten": (
        lambda x: x.pop(4),
        r"lab\.pt: 5\.weight = \[16, 216\]: takes 216 inputs, but layers\[4\] is given "
        r"\[6, 6, 6\]; a flatten belongs before it",
    ),
    "threshold missing": (
        _at(3, threshold=None),
        r"layers\[3\]\.threshold: is missing, and the state_dict has none",
    ),
    "another threshold": (
        _at(1, threshold=2),
        r"layers\[1\]\.threshold = 2.0: the state_dict has 1",
    ),
    "no time constant": (_at(1, kind="lif"), r"layers\[1\]\.tau_mem: is missing"),
    "one too many": (_at(1, tau_mem=3), r"layers\[1\]\.tau_mem = 3.0: belongs to a lif"),
    "unknown layer": (_at(1, kind="relu"), r"layers\[1\]\.kind = relu: must be one of"),
    "spikes not said": (lambda x: x[1].pop("spikes"), r"layers\[1\]\.spikes: is missing"),
    "a layer left out": (
        lambda x: (x.pop(7), x.pop(7)),
        r"lab\.pt: 7\.weight = \[3, 16\]: no layer of the description takes it, nor 2 more; desc",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_faults_are_named(name: str, tmp_path: Path) -> None:
    change, message = WRONG[name]
    layers = [dict(each) for each in OURS]
    net = papers(0.1)
    change(layers)
    path = saved(tmp_path, net, layers)
    if name == "threshold missing":
        state = {k: v for k, v in net.state_dict().items() if not k.startswith("3.")}
        torch.save(state, tmp_path / "lab.pt")
    where = "" if message.startswith("lab") else r"lab\.yaml: "
    with pytest.raises(InputError, match=where + message):
        load_external(path)


NAN, INF = float("nan"), float("inf")
ENTRIES: dict[str, tuple[str, torch.Tensor | None, str]] = {
    "one bias for all": ("5.bias", torch.ones(1), r"= \[1\]: must have the shape \[16\], one "),
    "biases of another layer": ("5.bias", torch.ones(3), r"= \[3\]: must have the shape \[16\]"),
    "biases in a column": ("5.bias", torch.ones(16, 1), r"= \[16, 1\]: must have the shape \[16\]"),
    "a bias without a shape": ("5.bias", torch.tensor(1.0), r"= \[\]: must have the shape \[16\]"),
    "a bias that is NaN": (
        "7.bias",
        torch.tensor([0, NAN, 1]),
        r"= \[3\]: 1 of its 3 values are NaN, infinite",
    ),
    "a bias too large": (
        "7.bias",
        torch.tensor([0, 1e300, -INF], dtype=torch.float64),
        "2 of its 3 values",
    ),
    "a convolution's biases": ("2.bias", torch.ones(4), r"= \[4\]: must have the shape \[6\]"),
    "a convolution's NaN": ("0.bias", torch.full((4,), NAN), "4 of its 4 values"),
    "weights that are NaN": ("5.weight", torch.full((16, 216), NAN), r"= \[16, 216\]: 3456 of its"),
    "weights that are infinite": ("0.weight", torch.full((4, 1, 5, 5), INF), "100 of its 100"),
    "weights for two channels": (
        "0.weight",
        torch.ones(4, 2, 5, 5),
        r"= \[4, 2, 5, 5\]: takes 2 inputs, but layers\[0\] is given 1 channels, \[1, 12, 12\]",
    ),
    "a row of weights": (
        "5.weight",
        torch.ones(216),
        r"= \[216\]: layers\[5\] takes .* \(outputs, inputs\)",
    ),
    "no outputs": ("5.weight", torch.ones(0, 216), r"= \[0, 216\]: layers\[5\] takes weights"),
    "complex weights": (
        "5.weight",
        torch.ones(16, 216, dtype=torch.complex64),
        "must be a plain tensor of real",
    ),
    "sparse weights": ("5.weight", torch.ones(16, 216).to_sparse(), "must be a plain tensor"),
    "missing weights": ("5.weight", None, r": is missing, and layers\[5\] takes it; .*: 7\.w"),
    "a surplus entry": ("9.weight", torch.ones(3, 3), r"= \[3, 3\]: no layer of the description"),
    "a threshold that is NaN": ("1.spike_threshold", torch.tensor(NAN), "1 of its 1 values"),
    "a threshold below zero": (
        "1.spike_threshold",
        torch.tensor(-1.0),
        r"= \[\]: is -1 and must be above zero",
    ),
    "a threshold for each": (
        "1.spike_threshold",
        torch.ones(4),
        r"= \[4\]: must be one number for all neurons",
    ),
}


@pytest.mark.parametrize("name", ENTRIES)
def test_entries_are_checked(name: str, tmp_path: Path) -> None:
    entry, value, message = ENTRIES[name]
    path = saved(tmp_path, papers(0.1))
    state = torch.load(tmp_path / "lab.pt", weights_only=True)
    state.pop(entry, None)
    if value is not None:
        state[entry] = value
    torch.save(state, tmp_path / "lab.pt")
    with pytest.raises(InputError, match=rf"lab\.pt: {re.escape(entry)}.*{message}"):
        load_external(path)


def test_wrong_outputs_and_files(tmp_path: Path) -> None:
    net = papers(0.1)
    layers = [dict(each) for each in OURS]
    path = saved(tmp_path, net, layers, outputs=["no_slip", "gross"])
    with pytest.raises(InputError, match=r"outputs .*each class a neuron; none is incipient"):
        load_external(path)
    path = saved(tmp_path, net, layers, outputs=["no_slip", "incipient", "gross", "gross"])
    with pytest.raises(InputError, match=r"outputs = 4: the last layer gives \[3\]"):
        load_external(path)
    path = saved(tmp_path, net, layers)
    torch.save(net, tmp_path / "lab.pt")  # a whole pickled network, which nobody runs
    with pytest.raises(InputError, match=r"lab\.pt: must be a state_dict"):
        load_external(path)
    (tmp_path / "lab.pt").unlink()
    with pytest.raises(InputError, match=r"lab\.yaml: weights = lab\.pt: cannot be read"):
        load_external(path)


def test_a_file_that_is_no_description_lacks_keys_only(tmp_path: Path) -> None:
    path = tmp_path / "card.json"
    path.write_text('{"title": "seed 0", "classes": ["cup"]}')
    with pytest.raises(InputError) as wrong:
        load_external(path)
    keys = {fault.key for fault in wrong.value.faults}
    assert keys == {"title", "model", "weights", "layers", "classes"}
    assert "Undefined" not in str(wrong.value)


def test_the_documented_description_is_one() -> None:
    text = (ROOT / "docs" / "models.md").read_text()
    block = text.split('```yaml title="lab.yaml"\n')[1].split("```")[0]
    found = validate(Description, parse_yaml(block, "lab.yaml"), "lab.yaml")
    assert [each.kind for each in found.layers] == [each["kind"] for each in OURS]
    assert found.windows == Windows()


def test_other_classes_are_named(tmp_path: Path) -> None:
    net, x = papers(2.0**-6, 6), windows(40)
    names = ["cup", "spoon"]
    found = load_external(saved(tmp_path, net, classes=names, outputs=names * 3))
    assert found.outputs_per_class == 3
    check_counts(found, x, by_hand(net, x, 64).reshape(-1, 3, 2).sum(axis=1))
    with pytest.raises(InputError, match=r"outputs .*one of cup, spoon; gross is none"):
        load_external(saved(tmp_path, net, classes=names, outputs=["cup", "spoon", "gross"] * 2))
    with pytest.raises(InputError, match=r"classes .*must name each class once"):
        load_external(saved(tmp_path, net, classes=["cup", "cup"], outputs=names * 3))
    plain = Description.model_validate({"model": 1, "weights": "a", "layers": OURS})
    assert "classes" not in plain.model_dump()
