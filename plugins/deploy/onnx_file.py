"""Export of a trained network as ONNX, including neurons and time, verified against Sinabs.

The graph takes windows as binned by this program (uint8, n at a time) and returns output spikes. It
is written by hand, because it is small: one `Scan` over the time steps, whose
body is the two convolutions, the two fully connected layers and four integrate-and-fire neurons.
Another runtime adds in another order, so a current may differ in its last bit, and a spike with it:
`check_onnx` compares real windows with Sinabs, and a network is not exported if any count differs.

`onnx` writes and `onnxruntime` runs it; both are the optional extra ``onnx``.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from torch import nn

from sliplab.analysis.networks.network import (
    SPIKING,
    WEIGHTED,
    classes_of,
    parameters,
    spike_counts,
)
from sliplab.protocols.windows import Windows

OPSET = 17
IR_VERSION = 8
"""Versions that runtimes of 2022 support."""
INPUT, OUTPUT = "windows", "counts"


class OnnxDiffers(RuntimeError):
    """The exported graph does not give the counts that Sinabs gives."""


def to_onnx(net: nn.Sequential, windows: Windows, about: dict[str, str]) -> bytes:
    """The network as the bytes of an ONNX model; the same network gives the same bytes.

    Input ``windows``: uint8 (n, steps, channels, cells, cells), n free. Output ``counts``: int64
    (n, classes), output spikes in the order of the classes. All neurons begin at zero.

    Args:
        net: from `analysis.networks.network.build`.
        about: stored in the file's metadata.

    Raises:
        ModuleNotFoundError: the extra ``onnx`` is not installed.
    """
    from onnx import TensorProto, checker, helper, numpy_helper

    layers: dict[str, Any] = dict(net.named_children())
    shapes = _state_shapes(net, windows)
    whole, each = TensorProto.FLOAT, helper.make_tensor_value_info
    nodes = [
        helper.make_node("Shape", [INPUT], ["n"], start=0, end=1),
        helper.make_node("Cast", [INPUT], ["floats"], to=whole),
        helper.make_node("Transpose", ["floats"], ["by_step"], perm=[1, 0, 2, 3, 4]),
    ]
    constants = [
        numpy_helper.from_array(value.detach().numpy(), name)
        for name, value in parameters(net).items()
    ]
    constants += [
        numpy_helper.from_array(np.array([0, -1, classes_of(net)], np.int64), "by_class"),
        numpy_helper.from_array(np.array([1], np.int64), "neurons"),
    ]
    states = [*SPIKING, "sum"]
    for name in states:
        rest = np.array(shapes[name], np.int64)
        constants.append(numpy_helper.from_array(rest, f"{name}.shape"))
        nodes += [
            helper.make_node("Concat", ["n", f"{name}.shape"], [f"{name}.whole"], axis=0),
            helper.make_node("ConstantOfShape", [f"{name}.whole"], [f"{name}.start"]),
        ]
    body = helper.make_graph(
        _step_nodes(helper, layers),
        "one_step",
        [each(f"{s}.in", whole, ["n", *shapes[s]]) for s in states]
        + [each("x", whole, ["n", windows.channels, windows.cells, windows.cells])],
        [each(f"{s}.out", whole, ["n", *shapes[s]]) for s in states],
        [
            numpy_helper.from_array(
                np.array(float(layers[s].spike_threshold), np.float32), f"{s}.threshold"
            )
            for s in SPIKING
        ]
        + [numpy_helper.from_array(np.array(0, np.float32), "zero")],
    )
    nodes += [
        helper.make_node(
            "Scan",
            [*(f"{s}.start" for s in states), "by_step"],
            [f"{s}.end" for s in states],
            body=body,
            num_scan_inputs=1,
        ),
        # neuron j is of class j % classes, and a class's spikes are added up
        helper.make_node("Reshape", ["sum.end", "by_class"], ["sums"]),
        helper.make_node("ReduceSum", ["sums", "neurons"], ["counted"], keepdims=0),
        helper.make_node("Cast", ["counted"], [OUTPUT], to=TensorProto.INT64),
    ]
    sample = [windows.steps, windows.channels, windows.cells, windows.cells]
    graph = helper.make_graph(
        nodes,
        "sliplab",
        [each(INPUT, TensorProto.UINT8, ["n", *sample])],
        [each(OUTPUT, TensorProto.INT64, ["n", classes_of(net)])],
        constants,
    )
    model = helper.make_model(
        graph, producer_name="sliplab", opset_imports=[helper.make_opsetid("", OPSET)]
    )
    model.ir_version = IR_VERSION
    helper.set_model_props(model, dict(sorted(about.items())))
    checker.check_model(model, full_check=True)
    return bytes(model.SerializeToString(deterministic=True))


def onnx_counts(data: bytes, x: npt.NDArray[np.uint8], batch: int = 64) -> npt.NDArray[np.int64]:
    """Output spikes int64 (n, classes) by onnxruntime in one thread, for x (n, T, C, H, W) uint8.

    Raises:
        ModuleNotFoundError: the extra ``onnx`` is not installed.
    """
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    parts = [
        session.run([OUTPUT], {INPUT: x[start : start + batch]})[0]
        for start in range(0, len(x), batch)
    ]
    none = np.empty((0, session.get_outputs()[0].shape[1]), np.int64)
    return np.concatenate([*parts, none])


def check_onnx(data: bytes, net: nn.Sequential, x: npt.NDArray[np.uint8]) -> int:
    """Hold the file against Sinabs' own layers on windows x; how many there were.

    Raises:
        OnnxDiffers: a count differs, or there are no windows that say anything.
    """
    expected, found = spike_counts(net, x), onnx_counts(data, x)
    if not expected.any():
        raise OnnxDiffers(f"the network is silent in all {len(x)} windows: nothing was checked")
    wrong = np.flatnonzero((expected != found).any(axis=1))
    if len(wrong):
        first = int(wrong[0])
        raise OnnxDiffers(
            f"{len(wrong)} of {len(x)} windows have other counts; window {first}: Sinabs "
            f"{expected[first].tolist()}, ONNX {found[first].tolist()}"
        )
    return len(x)


def _state_shapes(net: nn.Sequential, windows: Windows) -> dict[str, list[int]]:
    """Shape of each layer's potentials in one sample, and of the sum of output spikes."""
    layers: dict[str, Any] = dict(net.named_children())
    side = -(-windows.cells // 2)
    return {
        "iaf1": [layers["conv1"].out_channels, windows.cells, windows.cells],
        "iaf2": [layers["conv2"].out_channels, side, side],
        "iaf3": [layers["fc1"].out_features],
        "iaf4": [layers["fc2"].out_features],
        "sum": [layers["fc2"].out_features],
    }


def _step_nodes(helper: Any, layers: dict[str, Any]) -> list[Any]:
    """One time step: states and events in, states out."""
    nodes, at = [], "x"
    for weighted, spiking in zip(WEIGHTED, SPIKING, strict=True):
        layer, weight = layers[weighted], f"{weighted}.weight"
        if isinstance(layer, nn.Conv2d):
            nodes.append(
                helper.make_node(
                    "Conv",
                    [at, weight],
                    [f"{weighted}.current"],
                    kernel_shape=list(layer.kernel_size),
                    strides=list(layer.stride),
                    pads=[*map(int, layer.padding)] * 2,
                )
            )
        else:
            if len(nodes) and weighted == "fc1":
                nodes.append(helper.make_node("Flatten", [at], ["flat"], axis=1))
                at = "flat"
            given = [at, weight, *([] if layer.bias is None else [f"{weighted}.bias"])]
            nodes.append(helper.make_node("Gemm", given, [f"{weighted}.current"], transB=1))
        u, fired, at = f"{spiking}.u", f"{spiking}.fired", f"{spiking}.spikes"
        nodes += [
            helper.make_node("Add", [f"{spiking}.in", f"{weighted}.current"], [u]),
            helper.make_node("GreaterOrEqual", [u, f"{spiking}.threshold"], [fired]),
            helper.make_node("Cast", [fired], [at], to=1),
            helper.make_node("Where", [fired, "zero", u], [f"{spiking}.out"]),
        ]
    nodes.append(helper.make_node("Add", ["sum.in", at], ["sum.out"]))
    return nodes
