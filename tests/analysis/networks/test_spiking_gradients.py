"""Gradients through the event-driven network are Sinabs' own, to rounding."""

import copy
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from sliplab.analysis.networks.network import (
    BIASED,
    SPIKING,
    WEIGHTED,
    build,
    by_class,
    classes_of,
    matrices,
    parameters,
    reset_states,
)
from sliplab.analysis.networks.spiking import Trainer
from sliplab.analysis.networks.spiking_gradients import _through
from sliplab.analysis.windows.sparse import SparseWindows
from sliplab.protocols.network_settings import NetworkSettings
from sliplab.protocols.windows import Windows
from tests.analysis.networks import test_spiking
from tests.analysis.networks.test_spiking import FULL, SMALL, TAXELS, TINY, biased, gridded, sparse

pytestmark = pytest.mark.usefixtures("one_thread")

CONSTANTS = np.array([1, 0.5, 1], np.float32)
"""Threshold, width and scale of the surrogate."""


def ends(n: int) -> np.ndarray:
    return np.array([0, n], np.uint64)


def by_sinabs(
    net: nn.Sequential, x: np.ndarray, y: torch.Tensor, gain: float = 1.0, kind: type = np.float64
) -> list[torch.Tensor]:
    """Sinabs' own gradients, without their rounding unless `kind` is float32."""
    if kind is np.float64:
        net = copy.deepcopy(net).double()
        for name in SPIKING:  # they give float32 always
            getattr(net, name).register_forward_hook(lambda _m, _i, out: out.double())
    reset_states(net)
    out = net(torch.from_numpy(x.astype(kind)).flatten(0, 1)).unflatten(0, (len(x), -1))
    loss = nn.functional.cross_entropy(gain * by_class(out.sum(dim=1), classes_of(net)), y)
    wanted = parameters(net)
    grads = dict(zip(wanted, torch.autograd.grad(loss, list(wanted.values())), strict=True))
    return [
        torch.column_stack([grads[f"{name}.weight"], grads[f"{name}.bias"]])
        if name in BIASED
        else grads[f"{name}.weight"]
        for name in WEIGHTED
    ]


def by_events(
    net: nn.Sequential, x: np.ndarray, y: torch.Tensor, cells: int, gain: float = 1.0
) -> tuple[torch.Tensor, list[np.ndarray]]:
    trainer = Trainer(net, cells)
    found = trainer.gradients(SparseWindows.of(x), np.arange(len(x)), y.numpy(), gain)
    counts = torch.from_numpy(found.counts)
    expected = nn.functional.cross_entropy(gain * counts.double(), y)
    assert found.loss / len(x) == pytest.approx(expected.item())
    return counts, trainer.layout.unpack([grad / len(x) for grad in found.grads])


class _Spike(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, u: torch.Tensor) -> torch.Tensor:
        ctx.save_for_backward(u)
        return (u >= 1).to(u.dtype)

    @staticmethod
    def backward(ctx: Any, grad: torch.Tensor) -> torch.Tensor:
        (u,) = ctx.saved_tensors
        return grad * 2 * torch.exp(-(u - 1).abs() / 0.5)


def in_double(net: nn.Sequential, x: np.ndarray, y: torch.Tensor) -> list[torch.Tensor]:
    """The definition in float64, one step of time after the other."""
    weights = [torch.from_numpy(w).double().requires_grad_() for w in matrices(net)]
    w1, w2, w3, w4 = weights
    layers = [
        lambda v: nn.functional.conv2d(v, w1, padding=w1.shape[-1] // 2),
        lambda v: nn.functional.conv2d(v, w2, stride=2, padding=w2.shape[-1] // 2),
        lambda v: v.flatten(1) @ w3[:, :-1].T + w3[:, -1],
        lambda v: v @ w4[:, :-1].T + w4[:, -1],
    ]
    states: list[torch.Tensor | float] = [0.0] * 4
    out = torch.zeros(len(x), len(w4), dtype=torch.float64)
    for t in range(x.shape[1]):
        value = torch.from_numpy(x[:, t].astype(np.float64))
        for k, layer in enumerate(layers):
            u = states[k] + layer(value)
            value = _Spike.apply(u)
            states[k] = u * (1 - value.detach())
        out = out + value
    return list(
        torch.autograd.grad(nn.functional.cross_entropy(by_class(out, classes_of(net)), y), weights)
    )


def off(found: list[Any], expected: list[torch.Tensor]) -> list[float]:
    """Relative distance of each layer's gradient."""
    pairs = zip(found, expected, strict=True)
    return [float(np.linalg.norm(f - e.numpy()) / np.linalg.norm(e)) for f, e in pairs]


@pytest.mark.quick(1)
@pytest.mark.parametrize(
    ("windows", "share"), [(TINY, 0.1), (TINY, 0.3), (FULL, 0.01), (FULL, 0.03)]
)
def test_gradients_are_sinabs_own(windows: Windows, share: float) -> None:
    network = NetworkSettings() if windows is FULL else SMALL
    for seed in range(2):
        x = sparse(6, windows, seed, share)
        y = torch.tensor([0, 1, 2, 0, 1, 2])
        net = test_spiking.on_own_grid(build(network, windows, seed))
        _, fast = by_events(net, x, y, windows.cells)
        assert max(off(fast, by_sinabs(net, x, y))) <= 1e-6
        assert max(off(fast, in_double(net, x, y))) <= 1e-6
        net = gridded(network, windows, seed)  # other biases
        _, fast = by_events(net, x, y, windows.cells)
        assert max(off(fast, by_sinabs(net, x, y))) <= 1e-6
        assert max(off(fast, in_double(net, x, y))) <= 1e-6


def test_where_sums_cancel_the_error_is_that_of_float32() -> None:
    """Twenty times the events of a real window: Sinabs' own gradients are 2e-6 off there."""
    net = gridded(NetworkSettings(), FULL, 0)
    x = sparse(6, FULL, 0, 0.3)
    y = torch.tensor([0, 1, 2, 0, 1, 2])
    true = in_double(net, x, y)
    slow = off([g.numpy() for g in by_sinabs(net, x, y, kind=np.float32)], true)
    fast = off(by_events(net, x, y, FULL.cells)[1], true)
    assert max(fast) <= max(slow)


@pytest.mark.parametrize(("k1", "k2", "outputs"), [(1, 1, 1), (3, 5, 2), (7, 3, 4), (1, 7, 11)])
def test_every_shape_of_network(k1: int, k2: int, outputs: int) -> None:
    windows = Windows(length_ms=8, crop_px=100, polarity="both")
    network = NetworkSettings(
        conv1_channels=3,
        conv2_channels=5,
        hidden=9,
        outputs_per_class=outputs,
        conv1_kernel=k1,
        conv2_kernel=k2,
    )
    net = gridded(network, windows, 1)
    x = sparse(4, windows, 2, 0.5)
    y = torch.tensor([0, 1, 2, 1])
    slow = by_sinabs(net, x, y)
    _, fast = by_events(net, x, y, windows.cells)
    for found, expected in zip(fast, slow, strict=True):
        assert np.linalg.norm(found - expected.numpy()) <= 1e-6 * np.linalg.norm(expected)


def test_the_gain_of_the_loss() -> None:
    net = gridded(SMALL, TINY, 0)
    x, y = sparse(6, TINY, 0, 0.3), torch.arange(6) % 3
    _, fast = by_events(net, x, y, TINY.cells, gain=0.5)
    assert max(off(fast, by_sinabs(net, x, y, gain=0.5))) <= 1e-6


def test_windows_without_events_teach_the_biases_alone() -> None:
    net = gridded(SMALL, TINY, 0)
    x, y = np.zeros((2, 10, 1, 6, 6), np.uint8), torch.tensor([0, 1])
    _, grads = by_events(net, x, y, TINY.cells)
    assert not any(grad.any() for grad in grads[:2])
    assert not any(grad[:, :-1].any() for grad in grads[2:3])
    assert all(grad[:, -1].any() for grad in grads[2:])
    assert max(off(grads[2:], in_double(net, x, y)[2:])) <= 1e-6


def test_gradient_of_one_neuron_in_closed_form() -> None:
    # potentials 0.5, 1.25 (fires), 0.25, 0.5; the reset at step 2 cuts the way back in time
    u = np.array([0.5, 1.25, 0.25, 0.5], np.float32)
    up = np.array([1.0, 10.0, 100.0, 1000.0], np.float32)
    du, found = np.zeros(1, np.float32), []
    for t in reversed(range(4)):
        _through(up[t : t + 1], u[t : t + 1], *CONSTANTS, du, *ends(1))
        found.insert(0, float(du[0]))
    each = up * 2 * np.exp(-np.abs(u.astype(float) - 1) / 0.5)
    expected = [each[0] + each[1], each[1], each[2] + each[3], each[3]]
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_slope_over_the_whole_range() -> None:
    """The kernel's own exponential, from the threshold to where nothing is left."""
    u = np.concatenate([np.linspace(-60, 60, 20_001), [-np.inf, np.inf]]).astype(np.float32)
    du = np.zeros_like(u)
    _through(np.ones_like(u), u, *CONSTANTS, du, *ends(u.size))
    assert np.isfinite(du).all()
    v = u.astype(np.float64)
    expected = 2 * np.exp(-np.abs(v - 1) / 0.5)
    far = expected < 1e-30
    away = np.abs(du - expected)
    # the argument is rounded to float32 first: at -40 that alone is a few 1e-6
    assert (away[~far] / expected[~far]).max() < 1e-5
    near = np.abs(v - 1) < 2
    assert (away[near] / expected[near]).max() < 1e-6
    assert np.abs(du[far]).max() < 1e-29


def test_a_step_down_the_gradient_lowers_the_loss() -> None:
    """Not one of Sinabs' numbers: the gradients are of use."""
    net = build(SMALL, TINY, 1)
    x, y = sparse(30, TINY, 1, 0.3), torch.arange(30) % 3
    losses = []
    for _ in range(30):
        out, grads = by_events(net, x, y, TINY.cells)
        losses.append(nn.functional.cross_entropy(out.double(), y).item())
        values = matrices(net)
        test_spiking.put(net, [w - 0.05 * g for w, g in zip(values, grads, strict=True)])
    assert min(losses[20:]) < losses[0] - 0.1


@pytest.mark.quick(2)
@pytest.mark.parametrize("classes", [2, 5, 36])
@pytest.mark.parametrize("windows", [TINY, TAXELS], ids=["crop", "taxels"])
def test_gradients_of_any_number_of_classes(classes: int, windows: Windows) -> None:
    network = NetworkSettings(
        conv1_channels=9,
        conv2_channels=7,
        hidden=11,
        outputs_per_class=2,
        weight_scale=(1.0, 3.0, 4.0, 3.0),
    )
    net = test_spiking.on_own_grid(biased(build(network, windows, 3, classes), 3))
    x = sparse(4, windows, 5, 0.13 if windows is TAXELS else 0.3)
    y = torch.arange(4) * 7 % classes
    counts, fast = by_events(net, x, y, windows.cells)
    assert counts.shape == (4, classes)
    assert max(off(fast, by_sinabs(net, x, y))) <= 1e-6
    assert max(off(fast, in_double(net, x, y))) <= 1e-6
