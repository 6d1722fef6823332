"""Training and inference beside Sinabs' own layers in the same run, and cutting windows.

Both sides hold the same weights and see the same windows, cut from a simulated trial. Ours uses all
threads, as in use; Sinabs has whichever is faster in the run, all threads or one, because threads
that wait for each other at every step suffer from whatever else runs. One window at a time is timed
on one thread on both sides. What is trained is arbitrary: only time and spikes count here.
"""

from __future__ import annotations

from collections.abc import Callable
from statistics import median

import numpy as np
import torch
from torch import nn

from analysis.iaf import fused_counts
from analysis.network import build, reset_states, spike_counts
from analysis.training import fit
from analysis.windows import bin_events
from benchmarks.measure import RUNS, SEED, Figures, alternate, one_core, rate, ratio, spread
from benchmarks.slides import slide_events
from protocols.settings import Network, Training, Windows
from storage.streams import I64, U8, EventChunk

BATCH = 64
BATCHES = (16, 64)


def measure(windows: int = 384, singles: int = 100, runs: int = RUNS) -> Figures:
    """All figures of the network."""
    settings = Windows()
    events = slide_events()
    x = _samples(events, windows, settings)
    y = np.arange(windows, dtype=np.int64) % 3
    return {
        **_training(x, y, settings, runs),
        **_inference(x, settings, singles, runs),
        **_windows(events, settings, runs),
    }


def _samples(events: EventChunk, count: int, settings: Windows) -> U8:
    """Windows from all over a trial."""
    last = int(events.t_us[-1]) - settings.length_ms * 1000
    starts = np.linspace(int(events.t_us[0]), last, count).astype(np.int64)
    return bin_events(events.x, events.y, events.p, events.t_us, starts, settings)


def _training(x: U8, y: I64, settings: Windows, runs: int) -> Figures:
    """One step of training with its validation, from the uint8 windows to new weights."""
    split = min(BATCH, len(x) * 3 // 4)
    training = Training(epochs=1, batch=BATCH)
    x, y = x[: split + 16], y[: split + 16]
    train, val = (x[:split], y[:split]), (x[split:], y[split:])

    def ours() -> None:
        fit(*train, *val, Network(), settings, training, SEED)

    def sinabs() -> None:
        net = build(Network(), settings, SEED)
        optimizer = torch.optim.Adam(net.parameters(), lr=training.learning_rate)
        order = np.random.default_rng(SEED).permutation(split)
        for start in range(0, split, BATCH):
            rows = order[start : start + BATCH]
            part = torch.from_numpy(train[0][rows].astype(np.float32))
            reset_states(net)
            out = net(part.flatten(0, 1)).unflatten(0, (len(rows), -1)).sum(dim=1)
            loss = nn.functional.cross_entropy(out, torch.from_numpy(train[1][rows]))
            optimizer.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            optimizer.step()
        spike_counts(net, val[0], batch=BATCH)

    taken = alternate(runs, ours=ours, sinabs=sinabs, alone=on_one_thread(sinabs))
    best = [min(pair) for pair in zip(taken["sinabs"], taken["alone"], strict=True)]
    return {
        **ratio("train_x_sinabs", best, taken["ours"]),
        **spread("train_ms_per_window", [each * 1e3 / split for each in taken["ours"]]),
    }


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


def _inference(x: U8, settings: Windows, singles: int, runs: int) -> Figures:
    """One window at a time, and all of them, each side at its best batch."""
    net = build(Network(), settings, SEED)
    few = x[: min(singles, len(x))]

    def one_by_one(counts: Callable[..., I64]) -> Callable[[], object]:
        return on_one_thread(lambda: [counts(net, few[k : k + 1]) for k in range(len(few))])

    def at_once(counts: Callable[..., I64], batch: int) -> Callable[[], object]:
        return lambda: counts(net, x, batch=batch)

    rivals = {"ours_1": one_by_one(fused_counts), "sinabs_1": one_by_one(spike_counts)}
    for batch in BATCHES:
        rivals[f"ours_x{batch}"] = at_once(fused_counts, batch)
        rivals[f"sinabs_x{batch}"] = at_once(spike_counts, batch)
    rivals["sinabs_xalone"] = on_one_thread(rivals["sinabs_x64"])
    taken = alternate(runs, **rivals)
    best = {
        side: min((taken[name] for name in taken if name.startswith(f"{side}_x")), key=median)
        for side in ("ours", "sinabs")
    }
    mismatches = compared = 0
    for seed in range(SEED, SEED + 4):
        other = build(Network(), settings, seed)
        expected = spike_counts(other, x)
        mismatches += int((fused_counts(other, x) != expected).any(axis=1).sum())
        compared += int(expected.any(axis=1).sum())
    return {
        **ratio("infer_batch1_x_sinabs", taken["sinabs_1"], taken["ours_1"]),
        **spread("infer_batch1_ms", [each * 1e3 / len(few) for each in taken["ours_1"]]),
        **ratio("infer_batched_x_sinabs", best["sinabs"], best["ours"]),
        **rate("infer_batched_windows_per_s", len(x), best["ours"]),
        "spike_count_mismatches": float(mismatches),
        "windows_with_spikes_compared": float(compared),
    }


def _windows(events: EventChunk, settings: Windows, runs: int) -> Figures:
    """A whole trial cut into windows end to end, on one core."""
    first, last = int(events.t_us[0]), int(events.t_us[-1])
    starts = np.arange(first, last, settings.length_ms * 1000, dtype=np.int64)
    repeats = 20

    def cut() -> None:
        for _ in range(repeats):
            bin_events(events.x, events.y, events.p, events.t_us, starts, settings)

    with one_core():
        taken = alternate(runs, ours=cut)["ours"]
    return rate("windows_m_events_per_s", repeats * len(events) / 1e6, taken)
