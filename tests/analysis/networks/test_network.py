"""The paper's network: neurons worked out by hand, sizes that fit, states that do not leak."""

import subprocess
import sys

import numpy as np
import pytest
import torch
from sinabs.utils import validate_memory_mapping_speck

from sliplab.analysis.networks import network
from sliplab.analysis.networks.network import SPIKING, WEIGHTED, build, spike_counts, weights
from sliplab.protocols.network_settings import NetworkSettings
from sliplab.protocols.windows import Windows

pytestmark = pytest.mark.usefixtures("one_thread")

SMALL = NetworkSettings(conv1_channels=2, conv2_channels=4, hidden=8)
WINDOWS = Windows(length_ms=10, crop_px=120)  # (10, 1, 6, 6)


def sparse(n: int, windows: Windows, seed: int, share: float = 0.2) -> np.ndarray:
    rng = np.random.default_rng(seed)
    shape = (n, windows.steps, windows.channels, windows.cells, windows.cells)
    return (rng.random(shape) < share).astype(np.uint8) * rng.integers(1, 4, shape, np.uint8)


@pytest.mark.parametrize(
    ("current", "expected"),
    [
        # 0.375 a step: 0.375, 0.75, 1.125 fires, and the 0.125 above the threshold is lost;
        # Sinabs' default would keep it and fire 11 times in 30 steps
        (0.375, [0, 0, 1] * 10),
        (0.5, [0, 1] * 15),  # the threshold itself fires
        (2.5, [1] * 30),  # once a step at most
        (-1.0, [0] * 30),
        (0.0, [0] * 30),
    ],
)
def test_the_neuron_is_single_spike_and_reset_to_zero(current: float, expected: list[int]) -> None:
    net = build(NetworkSettings(), Windows(), 0)
    for name in SPIKING:
        spikes = getattr(net, name)(torch.full((30, 2), current))
        assert spikes.tolist() == [[s, s] for s in expected]


def test_potential_has_no_lower_bound() -> None:
    net = build(NetworkSettings(), Windows(), 0)
    spikes = net.iaf1(torch.tensor([-10.0] + [0.5] * 29).unsqueeze(1))  # reaches 1 at the 22nd
    assert np.flatnonzero(spikes[:, 0].numpy()).tolist() == [22, 24, 26, 28]


def test_default_sizes_fit_the_chip() -> None:
    net = build(NetworkSettings(), Windows(), 0)
    assert {n: tuple(p.shape) for n, p in weights(net).items()} == {
        "conv1.weight": (8, 1, 5, 5),
        "conv2.weight": (16, 8, 3, 3),
        "fc1.weight": (32, 1600),
        "fc1.bias": (32,),
        "fc2.weight": (12, 32),
        "fc2.bias": (12,),
    }
    assert [n for n in WEIGHTED if getattr(net, n).bias is not None] == list(network.BIASED)
    plain = weights(build(NetworkSettings(biases=False, outputs_per_class=1), Windows(), 0))
    assert list(plain) == [f"{name}.weight" for name in WEIGHTED]
    # on the chip a fully connected layer is a convolution over all of its input
    for ins, outs, kernel, stride, padding, side in (
        (1, 8, 5, 1, 2, 20),
        (8, 16, 3, 2, 1, 20),
        (16, 32, 10, 1, 0, 10),
        (32, 3, 1, 1, 0, 1),
    ):
        said = validate_memory_mapping_speck(
            ins, outs, (kernel,) * 2, (stride,) * 2, (padding,) * 2, (side,) * 2
        )
        assert "mapped successfully" in said
    with pytest.raises(Exception, match=r"[Kk]ernel memory"):
        validate_memory_mapping_speck(16, 64, (10, 10), (1, 1), (0, 0), (10, 10))


@pytest.mark.parametrize(
    ("windows", "features"), [(Windows(crop_px=140), 16 * 4 * 4), (Windows(polarity="both"), 1600)]
)
def test_other_windows(windows: Windows, features: int) -> None:
    net = build(NetworkSettings(), windows, 0)
    assert net.fc1.in_features == features
    assert spike_counts(net, sparse(2, windows, 0)).shape == (2, 3)


@pytest.mark.parametrize("kernel", [1, 3, 5, 7])
def test_kernels_keep_the_sides(kernel: int) -> None:
    settings = SMALL.model_copy(update={"conv1_kernel": kernel, "conv2_kernel": kernel})
    assert spike_counts(build(settings, WINDOWS, 0), sparse(1, WINDOWS, 0)).shape == (1, 3)


def test_a_seed_decides_the_weights_and_nothing_else_random() -> None:
    torch.manual_seed(7)
    expected = torch.rand(1)
    torch.manual_seed(7)
    first = weights(build(SMALL, WINDOWS, 3))
    assert torch.equal(torch.rand(1), expected)
    second, other = weights(build(SMALL, WINDOWS, 3)), weights(build(SMALL, WINDOWS, 4))
    assert all(torch.equal(first[n], second[n]) for n in first)
    assert not any(torch.equal(first[n], other[n]) for n in first)
    low, high = network.FIRST_BIAS
    assert ((first["fc1.bias"] >= low) & (first["fc1.bias"] <= high)).all()


@pytest.mark.parametrize("hidden", [4, 16, 64])
def test_outputs_begin_alike_in_a_window_without_events(hidden: int) -> None:
    net = build(SMALL.model_copy(update={"hidden": hidden}), WINDOWS, 5)
    names = dict(net.named_children())
    steps = 840  # every rate of a neuron that fires within a window is a whole part of it
    rates = network.rates_alone(names["fc1"].bias, WINDOWS.steps)
    neurons = names["iaf3"]
    current = names["fc1"].bias.detach().expand(steps, -1)
    neurons.num_timesteps = steps
    fired = neurons(current).sum(dim=0)
    neurons.reset_states()
    inside = 1 / rates <= WINDOWS.steps
    assert 0 < int(inside.sum()) < hidden
    torch.testing.assert_close(fired[inside], torch.floor(steps * rates[inside] + 1e-3))
    drive = names["fc2"].weight @ rates + names["fc2"].bias
    torch.testing.assert_close(drive, torch.full((12,), network.FIRST_DRIVE))


def test_weight_scale_belongs_to_its_layer() -> None:
    plain = SMALL.model_copy(update={"weight_scale": (1.0, 1.0, 1.0, 1.0)})
    one, scaled = weights(build(plain, WINDOWS, 0)), weights(build(SMALL, WINDOWS, 0))
    for name, factor in zip(WEIGHTED, SMALL.weight_scale, strict=True):
        assert torch.equal(one[f"{name}.weight"] * factor, scaled[f"{name}.weight"])


def test_samples_are_independent() -> None:
    net = build(SMALL, WINDOWS, 1)
    x = sparse(9, WINDOWS, 1)
    all_at_once = spike_counts(net, x)
    assert all_at_once.dtype == np.int64
    assert all_at_once.any()
    np.testing.assert_array_equal(spike_counts(net, x), all_at_once)  # nothing is left behind
    np.testing.assert_array_equal(spike_counts(net, x, batch=2), all_at_once)
    np.testing.assert_array_equal(spike_counts(net, x[::-1]), all_at_once[::-1])
    np.testing.assert_array_equal(spike_counts(net, x.astype(np.float32)), all_at_once)


def test_without_a_reset_states_would_leak() -> None:
    net = build(SMALL, WINDOWS, 1)
    x = torch.from_numpy(sparse(1, WINDOWS, 1).astype(np.float32)).flatten(0, 1)
    with torch.no_grad():
        net(x)
        assert any(getattr(net, n).v_mem.any() for n in SPIKING)
        network.reset_states(net)
        assert not any(getattr(net, n).v_mem.any() for n in SPIKING)


def test_no_samples() -> None:
    assert spike_counts(build(SMALL, WINDOWS, 0), sparse(0, WINDOWS, 0)).shape == (0, 3)


def test_read_only_samples_are_taken() -> None:
    x = sparse(2, WINDOWS, 0)
    x.flags.writeable = False
    assert spike_counts(build(SMALL, WINDOWS, 0), x).shape == (2, 3)


@pytest.mark.parametrize("shape", [(2, 9, 1, 6, 6), (2, 10, 2, 6, 6), (2, 10, 6, 6)])
def test_wrong_samples_are_named(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"expected \(n, 10, 1, H, W\)"):
        spike_counts(build(SMALL, WINDOWS, 0), np.zeros(shape, np.uint8))


def test_weights_that_do_not_fit_are_named() -> None:
    net = build(SMALL, WINDOWS, 0)
    good = weights(net)
    with pytest.raises(ValueError, match=r"fc2\.weight"):
        network.set_weights(net, {k: v for k, v in good.items() if k != "fc2.weight"})
    with pytest.raises(ValueError, match=r"fc2.weight has the shape \(8, 12\)"):
        network.set_weights(net, good | {"fc2.weight": good["fc2.weight"].T})


@pytest.mark.long
def test_the_chip_vendors_package_is_never_imported() -> None:
    """It would try to install things when it is imported."""
    code = (
        "import sys\n"
        "import sliplab.analysis.detectors.live, sliplab.plugins.deploy.onnx_file\n"
        "import sliplab.analysis.networks.quantised, sliplab.analysis.networks.training\n"
        "from sliplab.analysis.networks.network import build\n"
        "from sliplab.protocols.network_settings import NetworkSettings\n"
        "from sliplab.protocols.windows import Windows\n"
        "build(NetworkSettings(), Windows(), 0)\n"
        "bad = [m for m in sys.modules if m.split('.')[0] == 'samna' or 'dynapcnn' in m]\n"
        "assert not bad, bad\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
