"""One network of the detector's trade-off: trained, counted over whole trials, measured, kept.

A run is a setting and a seed. Its network is kept as soon as it is trained, and after each epoch
everything that the next one needs, so a search may be stopped anywhere. Names hold the key: a
search with other samples or other trials displaces nothing of this one.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from torch import nn

from sliplab.analysis.metrics import classification as metrics
from sliplab.analysis.networks import model_file, training
from sliplab.analysis.networks.quantised import common_net, quantise
from sliplab.analysis.networks.spiking import Engine
from sliplab.analysis.networks.synaptic import count_net_work
from sliplab.analysis.networks.training import EpochRecord, Fitted, restore
from sliplab.analysis.windows import dataset
from sliplab.analysis.windows.dataset import SampleSet
from sliplab.analysis.windows.samples import strided_windows
from sliplab.analysis.windows.sparse import SparseWindows
from sliplab.flows.searching.detector_tradeoff_data import Ask, Data, Used
from sliplab.flows.searching.detector_tradeoff_grid import Setting, counted_stride
from sliplab.protocols.settings import Network, Training, Windows
from sliplab.storage.files import make_folder, write_bytes
from sliplab.storage.trials.derived import Derived, make_key

STEP = "tradeoff"
VERSION = 1
PRECISIONS = ("trained", "8 bit")
SINGLE, BATCH, ROUNDS = 200, 512, 5
"""Windows measured one at a time; windows in a batch; how often the batch is measured."""

Advance = Callable[[str, float, str], None]
"""Told of which part of a run, ``train`` or ``count``, what share more is done, and a note."""


@dataclass(frozen=True)
class Run:
    """A setting and a seed, with the keys that its results must have."""

    setting: Setting
    seed: int
    windows: Windows
    network: Network
    training: Training
    model_key: str
    key: str

    @property
    def name(self) -> str:
        """Of the result; its network's name has the other key."""
        return f"{self.setting.slug}_seed{self.seed}_{self.key[:12]}"

    @property
    def words(self) -> str:
        """For people."""
        return f"{self.setting.words}, seed {self.seed}"


def make_run(data: Data, setting: Setting, seed: int) -> Run:
    """What is to be made, before anything is."""
    ask, base = data.ask, data.settings
    windows, network = setting.windows(base.windows), setting.network(base.network)
    own = base.training.model_dump()
    how = Training.model_validate({**own, "epochs": ask.epochs, "seeds": (seed,)})
    learned = [
        windows.model_dump(mode="json"),
        network.model_dump(mode="json"),
        how.model_dump(mode="json"),
        [base.windows.length_ms, base.samples.per_class, ask.samples],
    ]
    model_key = make_key(
        "tradeoff model",
        training.VERSION,
        data.inputs(data.train, data.validation),
        learned,
    )
    judged = data.inputs(data.validation, data.test, data.falling)
    key = make_key(STEP, VERSION, [model_key, judged], ask.stride_ms)
    return Run(setting, seed, windows, network, how, model_key, key)


class Kept:
    """Where the runs of a store are kept."""

    def __init__(self, data: Data) -> None:
        self.data = data
        self.derived = Derived.of(data.labels.store, STEP)
        self._of: Windows | None = None
        self._made: dict[str, SampleSet] = {}

    def done(self, run: Run) -> bool:
        """Whether a run's result is there."""
        return self.derived.fresh(run.name, run.key)

    def read(self, run: Run) -> tuple[dict[str, Any], dict[str, npt.NDArray[Any]]]:
        """A run's figures and its spike counts."""
        return self.derived.read(run.name), self.derived.arrays(run.name)

    def model_path(self, run: Run) -> Path:
        """The trained network."""
        name = f"{run.setting.slug}_seed{run.seed}_{run.model_key[:12]}.pt"
        return self.derived.folder / name

    def fitted(self, run: Run, advance: Callable[[float, str], None]) -> Fitted:
        """A run's network: the kept one, or trained now, from where it was stopped."""
        path = self.model_path(run)
        if path.exists():
            advance(1.0, "")
            return model_file.load(path)
        make_folder(path.parent)
        state = path.with_suffix(".state")
        train, validation = self._samples(run, "train"), self._samples(run, "validation")

        def on_epoch(record: EpochRecord) -> None:
            note = f"{run.words}: epoch {record.epoch}, {record.val_strict:.3f} strict"
            advance(1.0 / run.training.epochs, note)

        fitted = training.fit(
            train.windows, train.y, validation.windows, validation.y,
            run.network, run.windows, run.training, run.seed,
            on_epoch=on_epoch,
            on_state=partial(write_bytes, state),
            state=state.read_bytes() if state.exists() else None,
        )  # fmt: skip
        model_file.save(path, fitted)
        state.unlink(missing_ok=True)
        return fitted

    def make(self, run: Run, advance: Advance) -> None:
        """Train, count, measure and keep."""
        fitted = self.fitted(run, partial(advance, "train"))
        began = time.perf_counter()
        results: dict[str, Any] = {}
        arrays: dict[str, npt.NDArray[Any]] = {}
        for precision in PRECISIONS:
            net = network_of(fitted, precision)
            if isinstance(net, str):
                results[precision] = {"left out": net}
                advance("count", 1 / len(PRECISIONS), "")
                continue
            engine = Engine(net, run.windows.cells)
            test, validation = (self._samples(run, part) for part in ("test", "validation"))
            results[precision] = _window_figures(net, engine, test, validation)
            trials = self.data.judged
            counts, firsts = [], []
            for used in trials:
                one, first = _count(used, engine, run.windows, self.data.ask)
                counts.append(one)
                firsts.append(first)
                share = 1 / len(PRECISIONS) / len(trials)
                advance("count", share, f"{run.words}: {used.trial.id}")
            arrays[f"counts {precision}"] = np.concatenate(counts)
            arrays["sizes"] = np.array([len(one) for one in counts], np.int64)
            arrays["first_end_ns"] = np.array(firsts, np.int64)
        figures = {
            "setting": run.setting.as_dict(),
            "seed": run.seed,
            "chosen_epoch": fitted.chosen_epoch,
            "warnings": list(fitted.warnings),
            "seconds": {
                "train": sum(fitted.epoch_seconds) or None,  # None: it was trained before
                "count": time.perf_counter() - began,
            },
            "precisions": results,
        }
        self.derived.write(run.name, run.key, figures, arrays)

    def _samples(self, run: Run, part: str) -> SampleSet:
        """The windows of a part, made once for all runs in a row with the same windows."""
        if self._of != run.windows:
            self._of, self._made = run.windows, {}
        if part not in self._made:
            most = self.data.ask.samples
            most = most if part != "validation" else max(1, most // 4)
            self._made[part] = self.data.samples(run.setting, getattr(self.data, part), most)
        return self._made[part]


def network_of(fitted: Fitted, precision: str) -> nn.Sequential | str:
    """The network in a precision, or why there is none."""
    net = restore(fitted)
    if precision == "trained":
        return net
    try:
        return common_net(fitted, quantise(net))
    except ValueError as error:
        return str(error)


def trial_counts(
    arrays: dict[str, npt.NDArray[Any]], precision: str, counted_ms: int
) -> list[tuple[npt.NDArray[Any], npt.NDArray[np.int64]]]:
    """Spike counts (n, 3) and window ends int64 (n,) of each trial: what `Kept.make` kept."""
    sizes = arrays["sizes"]
    edges = np.concatenate([[0], sizes.cumsum()])
    counts = arrays[f"counts {precision}"]
    return [
        (
            counts[edges[k] : edges[k + 1]],
            int(arrays["first_end_ns"][k])
            + np.arange(sizes[k], dtype=np.int64) * counted_ms * 1_000_000,
        )
        for k in range(len(sizes))
    ]


def _count(
    used: Used, engine: Engine, windows: Windows, ask: Ask
) -> tuple[npt.NDArray[np.uint16], int]:
    """Spike counts of a trial's windows at the finest stride, and the first one's end."""
    length_ns = windows.length_ms * 1_000_000
    stride_ns = counted_stride(windows.length_ms, ask.stride_ms) * 1_000_000
    span = dataset.recorded_span(used.recording)
    starts = strided_windows(*span, length_ns, stride_ns)
    counts = engine.counts(dataset.cut_windows(used.recording, starts, windows))
    # at most 1000 steps of 64 neurons
    return counts.astype(np.uint16), span[0] + length_ns


def _window_figures(
    net: nn.Sequential, engine: Engine, test: SampleSet, validation: SampleSet
) -> dict[str, Any]:
    """Accuracy, work and time of windows."""
    found = metrics.accuracy(engine.counts(test.windows), test.y)
    chosen = metrics.accuracy(engine.counts(validation.windows), validation.y)
    work = count_net_work(net, engine.shape[-1], test.windows)
    single, batched = measure(engine, test.windows)
    return {
        "test": {"strict": found.strict, "argmax": found.argmax, "windows": found.n},
        "validation": {"strict": chosen.strict, "windows": chosen.n},
        "synaptic_operations": None if work is None else sum(work.synaptic.values()),
        "events": None if work is None else work.events,
        "us_single": single,
        "us_batched": batched,
    }


def measure(engine: Engine, x: SparseWindows) -> tuple[float, float]:
    """Microseconds a window in one thread: one at a time, and in a batch; medians.

    The processor's time of this thread, so that what else runs does not count as computing. Rounds
    of both alternate, so that what the machine does meanwhile meets both.
    """
    few = [x.take(np.array([k])) for k in range(min(SINGLE, len(x)))]
    many = x.take(np.arange(min(BATCH, len(x))))
    engine.counts(many, threads=1)
    single, batched = [], []
    for _ in range(ROUNDS):
        for one in few:
            began = time.thread_time()
            engine.counts(one, threads=1)
            single.append(time.thread_time() - began)
        began = time.thread_time()
        engine.counts(many, threads=1)
        batched.append((time.thread_time() - began) / len(many))
    return 1e6 * float(np.median(single)), 1e6 * float(np.median(batched))
