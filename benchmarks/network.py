"""Training, inference and cutting windows beside what a user would pick, in one run.

All sides hold the same weights and see the same windows, cut from a simulated trial. Ours uses all
threads, as in use; rivals have whichever is faster in the run, all threads or one, because threads
that wait for each other at every step suffer from whatever else runs. One window at a time is timed
on one thread on all sides. What is trained is arbitrary: only time and spikes count here. Libraries
that are not installed have no figures (`benchmarks.network_rivals`).
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch
from torch import nn

from benchmarks.measure import RUNS, SEED, Figures, alternate, one_core, rate, ratio, spread
from benchmarks.network_rivals import RivalNetwork, installed
from benchmarks.slides import slide_events
from sliplab.analysis.networks.network import (
    build,
    by_class,
    by_parameter,
    matrices,
    on_grid,
    reset_states,
    set_weights,
    spike_counts,
)
from sliplab.analysis.networks.spiking import SpikeEngine
from sliplab.analysis.networks.training import fit
from sliplab.analysis.windows.dataset import SampleSet, TrialId
from sliplab.analysis.windows.sparse import SparseWindows
from sliplab.analysis.windows.windows import bin_events, list_events
from sliplab.protocols.network_settings import NetworkSettings
from sliplab.protocols.training import Training
from sliplab.protocols.windows import Windows
from sliplab.storage.streams import I64, U8, EventChunk

BATCH = 32
ROUNDS = 3
"""Repetitions of one window's inference within a run, where ours takes a tenth of a millisecond."""
OUTPUTS = 3 * NetworkSettings().outputs_per_class
MACS = (3200 * 25, 1600 * 72, 1600 * 32, 32 * OUTPUTS)
"""Multiply-adds a step of the dense layers."""

Forward = Callable[[torch.Tensor], torch.Tensor]


def measure(windows: int = 384, singles: int = 100, runs: int = RUNS) -> Figures:
    """All figures of the network."""
    settings = Windows()
    events = slide_events()
    x = _samples(events, windows, settings)
    y = np.arange(windows, dtype=np.int64) % 3
    net = gridded(settings, SEED)
    rivals: dict[str, tuple[Any, Forward]] = {"sinabs": (net, _sinabs(net))}
    for name, make in installed().items():
        rival = RivalNetwork(make, settings, SEED)
        rivals[name] = (rival, rival)
    return {
        **_training(x, y, settings, rivals, runs),
        **_inference(x, settings, net, rivals, singles, runs),
        **_floor(x, net, settings),
        **_windows(events, settings, runs),
    }


def gridded(settings: Windows, seed: int) -> nn.Sequential:
    """A fresh network with its weights on the grid."""
    net = build(NetworkSettings(), settings, seed)
    set_weights(net, by_parameter(on_grid(matrices(net))))
    return net


def _sinabs(net: nn.Sequential) -> Forward:
    def forward(x: torch.Tensor) -> torch.Tensor:
        reset_states(net)
        out: torch.Tensor = net(x.flatten(0, 1))
        return by_class(out.unflatten(0, (len(x), -1)).sum(dim=1))

    return forward


def _samples(events: EventChunk, count: int, settings: Windows) -> U8:
    """Windows from all over a trial."""
    last = int(events.t_us[-1]) - settings.length_ms * 1000
    starts = np.linspace(int(events.t_us[0]), last, count).astype(np.int64)
    return bin_events(events, starts, settings)


def _training(
    x: U8, y: I64, settings: Windows, rivals: dict[str, tuple[Any, Forward]], runs: int
) -> Figures:
    """An epoch with its validation, from the file of samples to new weights."""
    held = 16
    split = len(x) - held
    training = Training(epochs=1, batch=BATCH)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "train.arrays"
        trials = tuple(TrialId("made", str(k)) for k in range(3))
        SampleSet(SparseWindows.of(x), y, y, y, trials).save(path)
        dense = Path(folder) / "train.npy"
        np.save(dense, x)

        def ours() -> None:
            stored = SampleSet.load(path)
            rows = np.arange(len(x))
            parts = [stored.windows.take(part) for part in (rows[:split], rows[split:])]
            fit(
                parts[0],
                y[:split],
                parts[1],
                y[split:],
                NetworkSettings(),
                settings,
                training,
                SEED,
            )

        def theirs(module: Any, forward: Forward) -> Callable[[], None]:
            def epoch() -> None:
                stored = np.load(dense, mmap_mode="r")
                optimizer = torch.optim.Adam(module.parameters(), lr=training.learning_rate)
                order = np.random.default_rng(SEED).permutation(split)
                for start in range(0, split, BATCH):
                    rows = order[start : start + BATCH]
                    out = forward(torch.from_numpy(stored[rows].astype(np.float32)))
                    loss = nn.functional.cross_entropy(out, torch.from_numpy(y[rows]))
                    optimizer.zero_grad()
                    loss.backward()
                    optimizer.step()
                with torch.no_grad():
                    forward(torch.from_numpy(stored[split:].astype(np.float32)))

            return epoch

        work: dict[str, Callable[[], object]] = {"ours": ours}
        for name, (module, forward) in rivals.items():
            before = [p.detach().clone() for p in module.parameters()]
            work[name] = _restored(theirs(module, forward), module, before)
            work[f"{name}_alone"] = on_one_thread(work[name])
        taken = alternate(runs, **work)
    figures: Figures = {}
    for name in rivals:
        best = [min(pair) for pair in zip(taken[name], taken[f"{name}_alone"], strict=True)]
        figures |= ratio(f"train_x_{name}", best, taken["ours"])
    return figures | rate("train_windows_per_s", split, taken["ours"])


def _restored(
    work: Callable[[], None], module: nn.Module, values: list[torch.Tensor]
) -> Callable[[], None]:
    """The work, always from the same weights: spikes, and so time, depend on them."""

    def again() -> None:
        with torch.no_grad():
            for parameter, value in zip(module.parameters(), values, strict=True):
                parameter.copy_(value)
        work()
        with torch.no_grad():
            for parameter, value in zip(module.parameters(), values, strict=True):
                parameter.copy_(value)

    return again


def on_one_thread(work: Callable[[], object]) -> Callable[[], None]:
    """The same work with torch on one thread."""

    def alone() -> None:
        threads = torch.get_num_threads()
        torch.set_num_threads(1)
        try:
            work()
        finally:
            torch.set_num_threads(threads)

    return alone


def _inference(
    x: U8,
    settings: Windows,
    net: nn.Sequential,
    rivals: dict[str, tuple[Any, Forward]],
    singles: int,
    runs: int,
) -> Figures:
    """One window at a time, and all of them, each side at its best batch."""
    engine = SpikeEngine(net, settings.cells)
    few = x[: min(singles, len(x))]

    def one_by_one(forward: Forward) -> Callable[[], object]:
        def work() -> None:
            with torch.no_grad():
                for k in range(len(few)):
                    forward(torch.from_numpy(few[k : k + 1].astype(np.float32)))

        return on_one_thread(work)

    def at_once(forward: Forward, batch: int) -> Callable[[], object]:
        def work() -> None:
            with torch.no_grad():
                for k in range(0, len(x), batch):
                    forward(torch.from_numpy(x[k : k + batch].astype(np.float32)))

        return work

    work: dict[str, Callable[[], object]] = {
        "ours_1": lambda: [
            engine.counts(few[k : k + 1], 1) for _ in range(ROUNDS) for k in range(len(few))
        ],
        "ours_all": lambda: [engine.counts(x) for _ in range(ROUNDS)],
    }
    for name, (_, forward) in rivals.items():
        work[f"{name}_1"] = one_by_one(forward)
        for batch in (16, 64):
            work[f"{name}_x{batch}"] = at_once(forward, batch)
        work[f"{name}_xalone"] = on_one_thread(work[f"{name}_x64"])
    taken = alternate(runs, **work)
    for name in ("ours_1", "ours_all"):
        taken[name] = [each / ROUNDS for each in taken[name]]
    figures: Figures = {}
    for name in rivals:
        best = min((taken[n] for n in taken if n.startswith(f"{name}_x")), key=median)
        figures |= ratio(f"infer_batch1_x_{name}", taken[f"{name}_1"], taken["ours_1"])
        figures |= ratio(f"infer_batched_x_{name}", best, taken["ours_all"])
    mismatches = compared = 0
    for seed in range(SEED, SEED + 4):
        other = gridded(settings, seed)
        expected = spike_counts(other, x)
        found = SpikeEngine(other, settings.cells).counts(x)
        mismatches += int((found != expected).any(axis=1).sum())
        compared += int(expected.any(axis=1).sum())
    return {
        **figures,
        **spread("infer_batch1_ms", [each * 1e3 / len(few) for each in taken["ours_1"]]),
        **rate("infer_batched_windows_per_s", len(x), taken["ours_all"]),
        "spike_count_mismatches": float(mismatches),
        "windows_with_spikes_compared": float(compared),
    }


def _floor(x: U8, net: nn.Sequential, settings: Windows) -> Figures:
    """Return a lower bound on a window's time: its synaptic operations at matrix-product rate.

    ``infer_floor_us`` is that for the operations that there are, ``dense_floor_us`` for all of the
    dense layers: below the second no dense implementation gets, below the first none at all.
    """
    a = torch.rand(512, 512)
    alone = on_one_thread(lambda: [a @ a for _ in range(20)])
    best = min(alternate(RUNS, product=alone)["product"])
    macs_per_s = 20 * 512**3 / best
    sparse = SparseWindows.of(x)
    _, fired = SpikeEngine(net, settings.cells).spikes(sparse)
    operations = len(sparse.cell) * 200 + int((fired[:, :3] * np.array([36, 32, OUTPUTS])).sum())
    each = operations / len(x)
    return {
        "synaptic_operations_per_window": each,
        "matmul_gmac_per_s": macs_per_s / 1e9,
        "infer_floor_us": each / macs_per_s * 1e6,
        "dense_floor_us": settings.steps * sum(MACS) / macs_per_s * 1e6,
    }


def _windows(events: EventChunk, settings: Windows, runs: int) -> Figures:
    """A whole trial cut into windows end to end, on one core, beside Tonic where it is there."""
    first, last = int(events.t_us[0]), int(events.t_us[-1])
    starts = np.arange(first, last, settings.length_ms * 1000, dtype=np.int64)
    repeats = 20

    def listed() -> None:
        for _ in range(repeats):
            list_events(events, starts, settings)

    def dense() -> None:
        for _ in range(repeats):
            bin_events(events, starts, settings)

    work: dict[str, Callable[[], object]] = {"listed": listed, "dense": dense}
    if find_spec("tonic"):
        work["tonic"] = _tonic(events, starts, settings)
    with one_core():
        taken = alternate(runs, **work)
    amount = repeats * len(events) / 1e6
    figures = rate("windows_m_events_per_s", amount, taken["listed"])
    figures |= rate("windows_dense_m_events_per_s", amount, taken["dense"])
    if "tonic" in taken:
        each = [seconds / repeats for seconds in taken["dense"]]
        figures |= ratio("windows_x_tonic", taken["tonic"], each)
    return figures


def _tonic(events: EventChunk, starts: I64, settings: Windows) -> Callable[[], object]:
    """The same windows by its crop, down-sampling and `to_frame`."""
    from tonic.functional import (  # type: ignore[import-not-found,unused-ignore]
        to_frame_numpy,
    )

    kind = np.dtype([("x", np.int16), ("y", np.int16), ("t", np.int64), ("p", np.int8)])
    left, top = (640 - settings.crop_px) // 2, (480 - settings.crop_px) // 2
    edges = np.append(starts, starts[-1] + settings.length_ms * 1000)
    where = np.searchsorted(events.t_us, edges)

    def work() -> None:
        for k in range(len(starts)):
            part = slice(where[k], where[k + 1])
            x = events.x[part].astype(np.int32) - left
            y = events.y[part].astype(np.int32) - top
            p = events.p[part] > 0
            inside = (x >= 0) & (x < settings.crop_px) & (y >= 0) & (y < settings.crop_px) & p
            table = np.zeros(int(inside.sum()), kind)
            table["x"], table["y"] = x[inside] // settings.pool_px, y[inside] // settings.pool_px
            table["t"] = events.t_us[part][inside] - starts[k]
            if len(table):
                to_frame_numpy(
                    table, (settings.cells, settings.cells, 1), n_time_bins=settings.steps
                )

    return work
