"""The detector sweep: networks of a grid of settings, trained, run over trials and scored.

A run is a setting and a seed. Window length, step, pooling and width need a training each; stride,
precision, smoothing and margin are read off the same network, so spikes are counted once over whole
trials. A network is stored as soon as it is trained, and each epoch stores a checkpoint, so a
search may be stopped anywhere. Names hold the key: a search with other samples or other trials
displaces nothing of this one.

Windows of every length cover the same stretches of a trial: as many milliseconds a class as the
protocol's own windows do. Otherwise short windows would all lie next to the onsets, and accuracies
would differ by where windows lie instead of by their length.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
from torch import nn

from sliplab.analysis.campaigns import Collected, training_campaigns
from sliplab.analysis.detectors.latency import true_slip
from sliplab.analysis.metrics import classification as metrics
from sliplab.analysis.networks import model_file, training
from sliplab.analysis.networks.quantised import common_net, quantise
from sliplab.analysis.networks.spiking import SpikeEngine
from sliplab.analysis.networks.synaptic import count_net_work
from sliplab.analysis.networks.training import EpochRecord, Fitted, restore
from sliplab.analysis.sweeps.runner import Advance, Arrays, Sweep
from sliplab.analysis.windows import dataset
from sliplab.analysis.windows.dataset import SampleSet
from sliplab.analysis.windows.sparse import SparseWindows
from sliplab.plugins.studies.detector.grid import NetworkSetting, SettingGrid, counted_stride
from sliplab.protocols import PlannedTrial
from sliplab.protocols.hashing import hash_integer
from sliplab.protocols.network_settings import NetworkSettings
from sliplab.protocols.settings import AnalysisSettings
from sliplab.protocols.training import Training
from sliplab.protocols.windows import SampleSettings, Windows
from sliplab.storage.files import make_folder, write_bytes
from sliplab.storage.schema.label import TrialLabel
from sliplab.storage.streams import Json
from sliplab.storage.trials.derived import Derived, make_key
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import StoreError

STEP = "tradeoff"
VERSION = 1
PRECISIONS = ("trained", "8 bit")
SINGLE, BATCH, ROUNDS = 200, 512, 5
"""Windows measured one at a time; windows in a batch; how often the batch is measured."""
PROBE_TRIALS, PROBE_WINDOWS = 6, 96
"""Training trials and windows of them that a run is tried with for an estimate."""


@dataclass(frozen=True)
class SearchSize:
    """Size of a search.

    Attributes:
        samples: training windows of each network; the same number of test windows at most, and a
            quarter of it to choose epochs by.
        epochs: of each training at most; the protocol's other settings stay.
        trials: validation and test trials of each kind that detections are evaluated on, at most.
        seeds: trainings of each setting.
        stride_ms: the finest stride.
    """

    samples: int = 12_000
    epochs: int = 4
    trials: int = 60
    seeds: int = 3
    stride_ms: int = 10


class LabelSource(Protocol):
    """Labels of a store, such as `sliplab.analysis.labels.reviewed.StoreLabels`."""

    def fresh(self, item: Collected, recording: Recording) -> bool:
        """Return whether a trial has its label."""

    def key(self, item: Collected, recording: Recording) -> str:
        """Return the key of a trial's label."""

    def read(self, item: Collected, recording: Recording) -> TrialLabel:
        """Return a trial's label."""


@dataclass(frozen=True)
class LabelledTrial:
    """A trial with both onsets, its label and the label's key."""

    item: Collected
    trial: PlannedTrial
    recording: Recording
    label: TrialLabel
    label_key: str

    @property
    def inputs(self) -> list[str]:
        """Inputs of the results, for a key."""
        return [self.item.name, self.trial.id, self.recording.checksum, self.label_key]


@dataclass(frozen=True)
class SearchTrials:
    """The trials of a search.

    Attributes:
        settings: the analysis settings of the first kinematic campaign.
        train: training trials.
        validation: choose epochs, smoothing and margin.
        test: figures are of these.
        falling: test trials of plates that slip by their own weight: leads are of these.
    """

    settings: AnalysisSettings
    train: list[LabelledTrial]
    validation: list[LabelledTrial]
    test: list[LabelledTrial]
    falling: list[LabelledTrial]

    @property
    def judged(self) -> list[LabelledTrial]:
        """All whose windows are counted, in the order of their stored counts."""
        return [*self.validation, *self.test, *self.falling]

    def samples(self, setting: NetworkSetting, part: list[LabelledTrial], most: int) -> SampleSet:
        """Return windows of trials by the 50/50/50 rule, as many of each trial as of any other.

        Args:
            most: windows in all.
        """
        windows = setting.windows(self.settings.windows)
        own = self.settings.windows.length_ms * self.settings.samples.per_class
        per_class = SampleSettings(per_class=max(1, round(own / setting.length_ms)))
        parts = []
        for number, used in enumerate(part):
            share = most // len(part) + (number < most % len(part))
            if not share:
                break
            seed = hash_integer("tradeoff samples", used.trial.id)
            trial = dataset.TrialId(used.item.name, used.trial.id)
            found = dataset.trial_samples(
                used.recording, used.label, trial, windows, per_class, seed
            )
            rows = np.sort(np.random.default_rng(seed).permutation(len(found))[:share])
            y, trials, start_ns = (v[rows] for v in (found.y, found.trial, found.start_ns))
            parts.append(SampleSet(found.windows.take(rows), y, trials, start_ns, found.trials))
        return SampleSet.join(parts, windows)


def search_trials(
    labels: LabelSource, campaigns: Sequence[Collected], size: SearchSize
) -> SearchTrials:
    """Return the labelled trials of campaigns: of each the first so many by a hash.

    Fewer trials are so always among more.

    Raises:
        StoreError: no kinematic campaign, a trial without a label, or a part without trials.
    """

    def of(items: Sequence[Collected], split: str, most: int | None) -> list[LabelledTrial]:
        found = []
        for item in items:
            ours = []
            for trial, recording in item.of_split(split):
                if not labels.fresh(item, recording):
                    raise StoreError(
                        f"{item.name}: {trial.id} has no label yet; run `sliplab label`"
                    )
                label = labels.read(item, recording)
                if true_slip(label) is not None:
                    key = labels.key(item, recording)
                    ours.append(LabelledTrial(item, trial, recording, label, key))
            ours.sort(key=lambda used: hash_integer("tradeoff", used.item.name, used.trial.id))
            found += ours[:most]
        return found

    kinematic = training_campaigns(list(campaigns))
    falling = [item for item in campaigns if item not in kinematic]
    parts = {
        "train": of(kinematic, "train", None),
        "validation": of(kinematic, "validation", size.trials),
        "test": of(kinematic, "test", size.trials),
    }
    for name, part in parts.items():
        if not part:
            raise StoreError(f"the search needs {name} trials with both onsets; there are none")
    return SearchTrials(kinematic[0].settings, **parts, falling=of(falling, "test", size.trials))


@dataclass(frozen=True)
class SearchRun:
    """A setting and a seed, with the keys of the network and of the result."""

    setting: NetworkSetting
    seed: int
    windows: Windows
    network: NetworkSettings
    training: Training
    model_key: str
    key: str

    @property
    def name(self) -> str:
        """Name of the result; its network's name has the other key."""
        return f"{self.setting.slug}_seed{self.seed}_{self.key[:12]}"

    @property
    def title(self) -> str:
        """The run as text."""
        return f"{self.setting.title}, seed {self.seed}"


def make_run(
    trials: SearchTrials, size: SearchSize, setting: NetworkSetting, seed: int
) -> SearchRun:
    """Return a run, with its keys."""

    def inputs(*parts: list[LabelledTrial]) -> list[Any]:
        return [dataset.VERSION, *([used.inputs for used in part] for part in parts)]

    base = trials.settings
    windows, network = setting.windows(base.windows), setting.network(base.network)
    own = base.training.model_dump()
    how = Training.model_validate({**own, "epochs": size.epochs, "seeds": (seed,)})
    learned = [
        windows.model_dump(mode="json"),
        network.model_dump(mode="json"),
        how.model_dump(mode="json"),
        [base.windows.length_ms, base.samples.per_class, size.samples],
    ]
    model_key = make_key(
        "tradeoff model", training.VERSION, inputs(trials.train, trials.validation), learned
    )
    judged = inputs(trials.validation, trials.test, trials.falling)
    key = make_key(STEP, VERSION, [model_key, judged], size.stride_ms)
    return SearchRun(setting, seed, windows, network, how, model_key, key)


class DetectorSearch:
    """The runs of a grid on a store's trials, and how each is made.

    Attributes:
        runs: all settings with one seed, then with the next: a stopped search has them all.
        sweep: makes and keeps what is pending; its estimates are in seconds.
    """

    def __init__(
        self, trials: SearchTrials, grid: SettingGrid, size: SearchSize, derived: Derived
    ) -> None:
        self.trials, self.grid, self.size, self.derived = trials, grid, size, derived
        self.runs = [
            make_run(trials, size, setting, seed)
            for seed in range(size.seeds)
            for setting in grid.settings
        ]
        self.sweep = Sweep(self.runs, derived, self.measure, self.estimate)
        self._seconds: dict[NetworkSetting, tuple[float, float]] = {}
        self._samples_of: Windows | None = None
        self._samples: dict[str, SampleSet] = {}

    def read(self, run: SearchRun) -> tuple[Json, Arrays]:
        """Return a stored run's figures and its spike counts."""
        return self.derived.read(run.name), self.derived.arrays(run.name)

    def model_path(self, run: SearchRun) -> Path:
        """Return the file of a run's trained network."""
        name = f"{run.setting.slug}_seed{run.seed}_{run.model_key[:12]}.pt"
        return self.derived.folder / name

    def warnings(self) -> dict[str, list[str]]:
        """Return the warnings of stored networks, by run."""
        there = [run for run in self.runs if self.sweep.done(run)]
        found = {run.title: self.derived.read(run.name)["warnings"] for run in there}
        return {title: warnings for title, warnings in found.items() if warnings}

    def estimate(self, run: SearchRun) -> dict[str, float]:
        """Return the seconds of a run by part, ``train`` and ``count``.

        As long as a stored run of the same setting took; without one, estimated from a few windows.
        Fresh weights fire less or more than trained ones, so the second is right within a factor
        of two or so.
        """
        if run.setting not in self._seconds:
            retained = [
                self.derived.read(other.name)["seconds"]
                for other in self.runs
                if other.setting == run.setting and self.sweep.done(other)
            ]
            known = next((each for each in retained if each["train"] is not None), None)
            self._seconds[run.setting] = (
                self._probe(run) if known is None else (known["train"], known["count"])
            )
        train, count = self._seconds[run.setting]
        return {"train": 0.0 if self.model_path(run).exists() else train, "count": count}

    def _probe(self, run: SearchRun) -> tuple[float, float]:
        trials, samples = self.trials, self.size.samples
        few = trials.train[:PROBE_TRIALS]
        began = time.perf_counter()
        x = trials.samples(run.setting, few, PROBE_WINDOWS)
        cut = (time.perf_counter() - began) / len(few)
        how = Training.model_validate({**run.training.model_dump(), "epochs": 2, "patience": 2})
        fitted = training.fit(
            x.windows, x.y, x.windows, x.y, run.network, run.windows, how, run.seed
        )
        engine = fitted.engine
        began = time.perf_counter()
        engine.counts(x.windows)
        each = (time.perf_counter() - began) / len(x)
        learn = min(fitted.epoch_seconds) / len(x)
        stride_ms = counted_stride(run.setting.length_ms, self.size.stride_ms)
        spans = [dataset.recorded_span(used.recording) for used in trials.judged]
        windows = sum(end - start for start, end in spans) / 1e6 / stride_ms
        count = len(trials.train) + len(trials.validation) + len(trials.test)
        train = count * cut + learn * samples * run.training.epochs
        # counting, and accuracies and operations of two precisions
        return train, len(PRECISIONS) * (len(spans) * cut + each * (windows + 2 * samples))

    def fitted(self, run: SearchRun, advance: Callable[[float, str], None]) -> Fitted:
        """Return a run's network: the stored one, or trained now, from its last checkpoint."""
        path = self.model_path(run)
        if path.exists():
            advance(1.0, "")
            return model_file.load(path)
        make_folder(path.parent)
        state = path.with_suffix(".state")
        train, validation = self._part(run, "train"), self._part(run, "validation")

        def on_epoch(record: EpochRecord) -> None:
            note = f"{run.title}: epoch {record.epoch}, {record.val_strict:.3f} strict"
            advance(1.0 / run.training.epochs, note)

        fitted = training.fit(
            train.windows,
            train.y,
            validation.windows,
            validation.y,
            run.network,
            run.windows,
            run.training,
            run.seed,
            on_epoch=on_epoch,
            on_state=partial(write_bytes, state),
            state=state.read_bytes() if state.exists() else None,
        )
        model_file.save(path, fitted)
        state.unlink(missing_ok=True)
        return fitted

    def measure(self, run: SearchRun, advance: Advance) -> tuple[Json, Arrays]:
        """Train a run's network and count its spikes; return figures and counts."""
        fitted = self.fitted(run, partial(advance, "train"))
        began = time.perf_counter()
        results: Json = {}
        arrays: Arrays = {}
        trials = self.trials.judged
        for precision in PRECISIONS:
            net = network_of(fitted, precision)
            if isinstance(net, str):
                results[precision] = {"left out": net}
                advance("count", 1 / len(PRECISIONS), "")
                continue
            engine = SpikeEngine(net, run.windows.cells)
            test, validation = self._part(run, "test"), self._part(run, "validation")
            results[precision] = _window_figures(net, engine, test, validation)
            counts, firsts = [], []
            for used in trials:
                one, first = self._count(used.recording, engine, run.windows)
                counts.append(one)
                firsts.append(first)
                share = 1 / len(PRECISIONS) / len(trials)
                advance("count", share, f"{run.title}: {used.trial.id}")
            arrays[f"counts {precision}"] = np.concatenate(counts)
            arrays["sizes"] = np.array([len(one) for one in counts], np.int64)
            arrays["first_end_ns"] = np.array(firsts, np.int64)
        figures = {
            "setting": asdict(run.setting),
            "seed": run.seed,
            "chosen_epoch": fitted.chosen_epoch,
            "warnings": list(fitted.warnings),
            "seconds": {
                "train": sum(fitted.epoch_seconds) or None,  # None: it was trained before
                "count": time.perf_counter() - began,
            },
            "precisions": results,
        }
        return figures, arrays

    def _part(self, run: SearchRun, part: str) -> SampleSet:
        """Return the windows of a part, made once for all runs in a row with the same windows."""
        if self._samples_of != run.windows:
            self._samples_of, self._samples = run.windows, {}
        if part not in self._samples:
            most = self.size.samples
            most = most if part != "validation" else max(1, most // 4)
            trials = getattr(self.trials, part)
            self._samples[part] = self.trials.samples(run.setting, trials, most)
        return self._samples[part]

    def _count(
        self, recording: Recording, engine: SpikeEngine, windows: Windows
    ) -> tuple[npt.NDArray[np.uint16], int]:
        """Return spike counts of a trial at the finest stride, and the end of the first window."""
        stride_ms = counted_stride(windows.length_ms, self.size.stride_ms)
        x, _ = dataset.trial_windows(recording, windows, stride_ms)
        first_ns = dataset.recorded_span(recording)[0] + windows.length_ms * 1_000_000
        # at most 1000 steps of 64 neurons
        return engine.counts(x).astype(np.uint16), first_ns


def network_of(fitted: Fitted, precision: str) -> nn.Sequential | str:
    """Return the network in a precision, or why there is none."""
    net = restore(fitted)
    if precision == "trained":
        return net
    try:
        return common_net(fitted, quantise(net))
    except ValueError as error:
        return str(error)


def trial_counts(
    arrays: Arrays, precision: str, counted_ms: int
) -> list[tuple[npt.NDArray[Any], npt.NDArray[np.int64]]]:
    """Return spike counts (n, 3) and window ends int64 (n,) of each trial, from a run's arrays."""
    sizes = arrays["sizes"]
    pieces = np.split(arrays[f"counts {precision}"], sizes.cumsum()[:-1])
    step_ns = counted_ms * 1_000_000
    return [
        (counts, int(first) + np.arange(size, dtype=np.int64) * step_ns)
        for counts, size, first in zip(pieces, sizes, arrays["first_end_ns"], strict=True)
    ]


def _window_figures(
    net: nn.Sequential, engine: SpikeEngine, test: SampleSet, validation: SampleSet
) -> Json:
    """Return accuracy, work and time of windows."""
    found = metrics.accuracy(engine.counts(test.windows), test.y)
    chosen = metrics.accuracy(engine.counts(validation.windows), validation.y)
    work = count_net_work(net, engine.shape[-1], test.windows)
    single, batched = measure_speed(engine, test.windows)
    return {
        "test": {"strict": found.strict, "argmax": found.argmax, "windows": found.n},
        "validation": {"strict": chosen.strict, "windows": chosen.n},
        "synaptic_operations": None if work is None else work.synaptic_operations["all"],
        "events": None if work is None else work.events,
        "us_single": single,
        "us_batched": batched,
    }


def measure_speed(engine: SpikeEngine, x: SparseWindows) -> tuple[float, float]:
    """Return microseconds a window in one thread: one at a time, and in a batch; medians.

    The processor's time of this thread, so that other programs do not count. Rounds of both
    alternate, so that a change of the machine's speed meets both.
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
