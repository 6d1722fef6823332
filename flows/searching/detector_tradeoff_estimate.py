"""How long a run of the detector's trade-off will take, before it is begun."""

from __future__ import annotations

import time

from sliplab.analysis.networks import training
from sliplab.analysis.windows import dataset
from sliplab.flows.searching.detector_tradeoff_data import Data
from sliplab.flows.searching.detector_tradeoff_grid import counted_stride
from sliplab.flows.searching.detector_tradeoff_runs import PRECISIONS, Kept, Run
from sliplab.protocols.settings import Training

TRIALS, WINDOWS = 6, 96
"""Training trials and windows of them that a run is tried with."""


def estimate(kept: Kept, run: Run, like: list[Run]) -> dict[str, float]:
    """Seconds of a run by part, ``train`` and ``count``.

    As long as a kept run `like` it took; without one, reckoned from a few windows. Fresh weights
    fire less or more than trained ones, so the second is right within a factor of two or so.
    """
    known = [kept.derived.read(other.name)["seconds"] for other in like if kept.done(other)]
    known_run = next((seconds for seconds in known if seconds["train"] is not None), None)
    train, count = (
        _probe(kept.data, run) if known_run is None else (known_run["train"], known_run["count"])
    )
    return {"train": 0.0 if kept.model_path(run).exists() else train, "count": count}


def _probe(data: Data, run: Run) -> tuple[float, float]:
    few = data.train[:TRIALS]
    began = time.perf_counter()
    x = data.samples(run.setting, few, WINDOWS)
    cut = (time.perf_counter() - began) / len(few)
    how = Training.model_validate({**run.training.model_dump(), "epochs": 2, "patience": 2})
    fitted = training.fit(x.windows, x.y, x.windows, x.y, run.network, run.windows, how, run.seed)
    engine = training.engine(fitted)
    began = time.perf_counter()
    engine.counts(x.windows)
    each = (time.perf_counter() - began) / len(x)
    learn = min(fitted.epoch_seconds) / len(x)
    stride_ms = counted_stride(run.setting.length_ms, data.ask.stride_ms)
    spans = [dataset.recorded_span(used.recording) for used in data.judged]
    windows = sum(end - start for start, end in spans) / 1e6 / stride_ms
    trials = len(data.train) + len(data.validation) + len(data.test)
    samples = data.ask.samples
    train = trials * cut + learn * samples * run.training.epochs
    # counting, and accuracies and operations of two precisions
    return train, len(PRECISIONS) * (len(spans) * cut + each * (windows + 2 * samples))
