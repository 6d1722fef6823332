"""Model exports: the ONNX graph, the chip's layout and arithmetic, the model card."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from sinabs.activation import MembraneSubtract
from sinabs.utils import validate_memory_mapping_speck
from torch import nn

from sliplab.analysis.networks.network import (
    BIASED,
    SPIKING,
    WEIGHTED,
    build,
    parameters,
    reset_states,
    spike_counts,
    weights,
)
from sliplab.analysis.networks.quantised import quantise
from sliplab.analysis.networks.synaptic import count_net_work
from sliplab.analysis.networks.training import EpochRecord, Fitted, restore
from sliplab.analysis.windows.sparse import SparseWindows
from sliplab.flows.exports import ExportRequest, export
from sliplab.plugins.deploy.card import SplitResult, card_markdown, model_card
from sliplab.plugins.deploy.chip import LOWEST, chip_run, compare, quantised_net, rounding
from sliplab.plugins.deploy.document import CardCampaign, CardData, ModelFile
from sliplab.plugins.deploy.onnx_file import OnnxDiffers, check_onnx, onnx_counts, to_onnx
from sliplab.plugins.deploy.speck import CORES, KI, speck_fit
from sliplab.protocols.errors import InputError
from sliplab.protocols.network_settings import NetworkSettings
from sliplab.protocols.training import Training
from sliplab.protocols.windows import Windows
from tests.analysis.networks.test_spiking import FULL, SMALL, TAXELS, TINY, biased, sparse
from tests.patching import loose

pytestmark = pytest.mark.usefixtures("one_thread")

onnx = pytest.importorskip("onnx", reason="ONNX is not installed (sliplab[onnx])")


def fitted(network: NetworkSettings = SMALL, windows: Windows = TINY, seed: int = 0) -> Fitted:
    record = EpochRecord(1, 1.0, 0.3, 1.0, 0.3, 0.3, 0.3, dict.fromkeys(SPIKING, 0.1))
    state = weights(biased(build(network, windows, seed), seed))
    return Fitted(state, network, windows, Training(epochs=1), seed, (record,), 1, ())


# -- ONNX ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("network", "windows"),
    [
        (NetworkSettings(), FULL),
        (SMALL, TINY),
        (NetworkSettings(conv1_kernel=3, conv2_kernel=5, hidden=5), TINY),
        (NetworkSettings(biases=False, outputs_per_class=1), TINY),
        (SMALL, Windows(length_ms=8, step_ms=2, crop_px=100, pool_px=20, polarity="both")),
    ],
)
def test_the_graph_counts_as_sinabs_does(network: NetworkSettings, windows: Windows) -> None:
    net = biased(build(network, windows, 1), 1)
    x = sparse(20, windows, 1, 0.1)
    data = to_onnx(net, windows, {"classes": "a"})
    assert check_onnx(data, net, x) == 20
    np.testing.assert_array_equal(onnx_counts(data, x, batch=7), spike_counts(net, x))
    assert onnx_counts(data, x[:0]).shape == (0, 3)
    model = onnx.load_from_string(data)
    assert [op.op_type for op in model.graph.node].count("Scan") == 1  # all of time is inside
    assert model.metadata_props[0].key == "classes"
    again = biased(build(network, windows, 1), 1)
    assert to_onnx(again, windows, {"classes": "a"}) == data


@pytest.mark.parametrize("classes", [2, 36])
def test_a_graph_of_other_classes_and_taxels(classes: int) -> None:
    net = biased(build(SMALL, TAXELS, 1, classes), 1)
    x = sparse(6, TAXELS, 1, 0.13)
    data = to_onnx(net, TAXELS, {})
    assert check_onnx(data, net, x) == 6
    assert onnx_counts(data, x).shape == (6, classes)
    assert onnx_counts(data, x[:0]).shape == (0, classes)


def test_nir_is_refused_since_its_neurons_count_otherwise(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    x = sparse(50, FULL, 1, 0.1)
    net = biased(build(NetworkSettings(), FULL, 1), 1)
    ours = spike_counts(net, x)
    for name in SPIKING:
        getattr(net, name).reset_fn = MembraneSubtract()
    assert (spike_counts(net, x) != ours).any(axis=1).mean() > 0.9
    request = ExportRequest(str(tmp_path / "seed0.pt"), "", "nir", tmp_path)
    with pytest.raises(InputError, match=r"seed0\.pt"):
        export(request)
    monkeypatch.setattr("sliplab.flows.detecting.request.load_model", lambda _: fitted())
    with pytest.raises(InputError, match=r"nir: cannot hold .* --as onnx"):
        export(request)


def test_a_graph_that_counts_otherwise_is_not_let_through() -> None:
    net = build(SMALL, TINY, 1)
    x = sparse(20, TINY, 1, 0.3)
    with pytest.raises(OnnxDiffers, match=r"of 20 windows have other counts; window \d+: Sinabs"):
        check_onnx(to_onnx(build(SMALL, TINY, 2), TINY, {}), net, x)
    with torch.no_grad():
        for name in BIASED:
            parameters(net)[f"{name}.bias"].zero_()
    with pytest.raises(OnnxDiffers, match="silent in all 20 windows"):
        check_onnx(to_onnx(net, TINY, {}), net, np.zeros_like(x))


# -- the chip's layout -----------------------------------------------------------------------


def test_the_default_network_fits_a_speck() -> None:
    fit = speck_fit(NetworkSettings(), Windows())
    assert fit.problems == ()
    assert fit.fits
    assert sorted(fit.cores) == sorted(WEIGHTED)
    assert len(set(fit.cores.values())) == 4
    by_name = {layer.name: layer for layer in fit.layers}
    assert by_name["fc1"].kernel_words == 64 * KI  # exactly all of a core of the largest kind
    assert fit.cores["fc1"] in {5, 6}
    by_number = {core.number: core for core in CORES}
    for name, number in fit.cores.items():
        assert by_name[name].fits(by_number[number])


@pytest.mark.parametrize(
    ("network", "windows", "said"),
    [
        (NetworkSettings(hidden=64), Windows(), "fc1: needs 128 Ki of kernel memory"),
        (NetworkSettings(hidden=33), Windows(), "fc1: needs 128 Ki of kernel memory"),
        (NetworkSettings(conv1_channels=128), Windows(), "conv1: needs .* 128 Ki of neuron memory"),
        (NetworkSettings(), Windows(pool_px=10), "fc1: kernel is 20, at most 16"),
    ],
)
def test_what_does_not_fit_is_said(network: NetworkSettings, windows: Windows, said: str) -> None:
    fit = speck_fit(network, windows)
    assert not fit.fits
    assert fit.cores == {}
    assert any(re.search(said, problem) for problem in fit.problems)


@settings(max_examples=60)
@given(
    st.integers(1, 64),
    st.integers(1, 64),
    st.integers(1, 128),
    st.sampled_from([1, 3, 5, 7]),
    st.sampled_from([1, 3, 5, 7]),
    st.sampled_from([6, 10, 20, 28]),
)
def test_memories_are_those_that_sinabs_reckons(
    conv1: int, conv2: int, hidden: int, kernel1: Any, kernel2: Any, cells: int
) -> None:
    """Sinabs' own check, on sides where the half pixel that it leaves in does not matter."""
    network = NetworkSettings(
        conv1_channels=conv1,
        conv2_channels=conv2,
        hidden=hidden,
        conv1_kernel=kernel1,
        conv2_kernel=kernel2,
    )
    for layer in speck_fit(network, Windows(crop_px=10 * cells, pool_px=10)).layers:
        arguments = (
            layer.in_channels,
            layer.out_channels,
            (layer.kernel, layer.kernel),
            (layer.stride, layer.stride),
            (layer.padding, layer.padding),
            (layer.in_side, layer.in_side),
        )
        if layer.problems:
            with pytest.raises(Exception, match=r"[Kk]ernel|memory"):  # it raises nothing finer
                validate_memory_mapping_speck(*arguments)
            continue
        said = validate_memory_mapping_speck(*arguments)
        assert f"Kernel memory is {layer.kernel_words / KI:g}Ki" in said
        assert f"neuron memory is {layer.neuron_words / KI:g}Ki" in said


# -- 8 bits ----------------------------------------------------------------------------------


def test_weights_and_threshold_are_whole_and_in_range() -> None:
    net = biased(build(NetworkSettings(), FULL, 3), 3)
    found = quantise(net)
    for name, spiking in zip(WEIGHTED, SPIKING, strict=True):
        parts = {k: w for k, w in found.weights.items() if k.startswith(name)}
        assert len(parts) == 1 + (name in BIASED)
        # as large as a whole threshold lets them be
        assert max(np.abs(whole.astype(int)).max() for whole in parts.values()) >= 120
        assert found.thresholds[spiking] == found.scales[name]
        for key, whole in parts.items():
            assert whole.dtype == np.int8
            real = parameters(net)[key].detach().numpy().astype(np.float64)
            assert np.abs(whole / found.scales[name] - real).max() <= 0.5001 / found.scales[name]
    assert all(0 < share < 0.05 for share in rounding(found, net).values())


def test_the_chips_arithmetic_is_the_networks_in_whole_numbers() -> None:
    one = fitted(NetworkSettings(), FULL, 3)
    whole = quantised_net(one, quantise(restore(one)))
    x = sparse(24, FULL, 3, 0.03)
    ran = chip_run(whole, x)
    assert not any(ran.saturated.values())
    np.testing.assert_array_equal(ran.counts, spike_counts(whole, x))
    assert ran.counts.any()
    # held against whole numbers proper, first layer, first window
    layer: Any = whole.conv1
    currents = torch.nn.functional.conv2d(
        torch.from_numpy(x[0].astype(np.int64)), layer.weight.long(), padding=layer.padding
    ).flatten(1)
    v, low, spikes = torch.zeros_like(currents[0]), 0, []
    for current in currents:
        v = v + current
        low = min(low, int(v.min()))
        fired = v >= round(float(loose(whole.iaf1).spike_threshold))  # a tensor
        spikes.append(fired)
        v = torch.where(fired, 0, v)
    seen = layer_outputs(whole, x[:1])["iaf1"].flatten(1)
    assert torch.equal(torch.stack(spikes).float(), seen)
    assert chip_run(whole, x[:1]).potentials["iaf1"][0] == low


def test_potentials_stay_within_16_bits_as_in_sinabs() -> None:
    """Inhibition that is strong and then ends: what was cut off comes back sooner."""
    net = build(SMALL, TINY, 0)
    with torch.no_grad():
        for number, name in enumerate(WEIGHTED):
            getattr(net, name).weight.fill_(-127.0 if number == 0 else 1.0)
            getattr(net, name).weight[0] = 127.0
        for name in BIASED:
            getattr(net, name).bias.fill_(1.0)  # whole, as the chip's: Sinabs' bound rounds others
        for name in SPIKING:
            getattr(net, name).spike_threshold.fill_(2.0)
    x = np.zeros((2, 10, 1, 6, 6), np.uint8)
    x[0, :4], x[1, ::2] = 200, 3
    ran = chip_run(net, x)
    assert ran.potentials["iaf1"][0] < LOWEST
    assert 0 < ran.saturated["iaf1"] < 1
    for name in SPIKING:
        getattr(net, name).min_v_mem = torch.nn.Parameter(
            torch.tensor(float(LOWEST)), requires_grad=False
        )
    np.testing.assert_array_equal(ran.counts, spike_counts(net, x))


def test_what_cannot_be_quantised_is_refused() -> None:
    net = build(SMALL, TINY, 0)
    layer: Any = net.fc2
    with torch.no_grad():
        layer.weight.fill_(0.0)
        layer.bias.fill_(0.0)
    with pytest.raises(ValueError, match="fc2: all weights are zero"):
        quantise(net)
    with torch.no_grad():
        layer.weight.fill_(200.0)
    with pytest.raises(ValueError, match="fc2: a weight is over 127 times the threshold"):
        quantise(net)


def test_changes_are_counted() -> None:
    real = np.array([[5, 0, 0], [5, 0, 0], [1, 1, 0], [0, 4, 3]])
    whole = np.array([[5, 0, 0], [4, 3, 0], [1, 1, 0], [0, 3, 4]])
    assert compare(real, whole, 2.0).to_json() == {
        "windows": 4,
        "equal_counts": 0.5,
        "equal_class": 0.75,
        "equal_class_by_margin": 0.75,
        "mean_change": 6 / 12,
        "largest_change": 3,
    }
    with pytest.raises(ValueError, match="expected as many"):
        compare(real, whole[:2], 2.0)


def layer_outputs(net: nn.Sequential, x: np.ndarray) -> dict[str, torch.Tensor]:
    """Return the output of each of Sinabs' layers, (n * steps, ...)."""
    reset_states(net)
    found, at = {}, torch.from_numpy(x.astype(np.float32)).flatten(0, 1)
    with torch.no_grad():
        for name, module in net.named_children():
            at = found[name] = module(at)
    return found


# -- operations and the card -----------------------------------------------------------------


@pytest.mark.parametrize("simulated", [True, False])
def test_a_card_says_where_the_data_are_from(simulated: bool) -> None:
    one = fitted()
    counts = np.array([[5, 0, 0], [0, 5, 0], [0, 0, 5], [1, 1, 0]])
    part = SplitResult(counts, np.array([0, 1, 2, 2]), 4)
    work = count_net_work(
        build(SMALL, TINY, 0), TINY.cells, SparseWindows.of(sparse(2, TINY, 0, 0.2))
    )
    assert work is not None
    campaign = CardCampaign(
        name="c",
        experiment="kinematic",
        protocol="p",
        collection_hash="a" * 64,
        analysis_hash="b" * 64,
        rig="r",
        simulated=simulated,
        trials={"train": 2, "test": 4},
    )
    data = CardData(
        store="s", simulated=simulated, made_from_these_data=False, campaigns=(campaign,)
    )
    card = model_card(
        one,
        ModelFile(file="m.pt", sha256="c" * 64),
        data,
        {"test": part},
        work,
        {},
        {"torch": "1"},
        2.0,
    )
    reported = card.to_json()
    assert json.loads(json.dumps(reported, allow_nan=False)) == reported
    assert reported["model"]["network"] == SMALL.model_dump(mode="json")  # the defaults too
    assert reported["figures"]["test"]["accuracy"]["strict"] == 0.75
    assert f"footprint {work.footprint_bytes:,} bytes, connection sparsity 0.0 %" in card_markdown(
        card
    )
    assert reported["figures"]["test"]["recall"]["gross"] == 0.5
    page = card_markdown(card)
    assert f"footprint {work.footprint_bytes:,} bytes, connection sparsity 0.0 %" in page
    assert ("simulated" in page) == simulated
    assert "not those that the model was trained on" in page
    assert "only 4 test trials" in page
    assert "| test | 4 | 4 | 75.0 % | 75.0 % |" in page
