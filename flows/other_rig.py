"""Trials of a campaign on a rig with other simulated numbers: taken, labelled, judged."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from sliplab.analysis.campaigns import Collected, collected, training_campaigns
from sliplab.analysis.evaluation.trials import score_row
from sliplab.analysis.labels.reviewed import Labels
from sliplab.analysis.networks import training
from sliplab.analysis.windows import dataset
from sliplab.analysis.windows.sample_sets import load_samples
from sliplab.analysis.windows.samples import strided_windows
from sliplab.flows.collect import collect
from sliplab.flows.label import label
from sliplab.flows.planning.run_request import RunRequest, make_request
from sliplab.protocols.settings import Detection
from sliplab.protocols.yaml_file import parse_yaml, read_text
from sliplab.rigs.rig_inheritance import rig_yaml
from sliplab.storage.files import make_folder, write_text
from sliplab.storage.schema.evaluation import TrialScore
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import Store


def other_request(
    item: Collected,
    change: Mapping[str, Any],
    folder: Path,
    most: int | None = None,
    protocol: Mapping[str, Any] | None = None,
) -> RunRequest:
    """Return a run request for the same protocol, into ``folder/store``.

    Args:
        change: values by key, nested as in a rig file.
        folder: gets the changed rig file too.
        most: trials at most.
        protocol: values of the protocol to change, likewise.
    """
    make_folder(folder)
    rig = folder / f"{item.name}.yaml"
    _write_changed(item.campaign.folder / "rig.yaml", "rig file", change, rig)
    file = item.campaign.protocol_file
    if protocol is not None:
        file = folder / f"{item.name}.protocol.yaml"
        _write_changed(item.campaign.protocol_file, "protocol", protocol, file)
    enabled: Any = item.info.get("enabled", ())
    return make_request(
        file, rig, folder / "store", enable=tuple(enabled), campaign=item.name, most=most
    )


def _write_changed(source: Path, what: str, change: Mapping[str, Any], path: Path) -> None:
    data = parse_yaml(read_text(source, what), source)
    _merge(data, change)
    write_text(path, rig_yaml(data))


def _merge(data: dict[str, Any], other: Mapping[str, Any]) -> None:
    for name, value in other.items():
        if isinstance(value, Mapping) and isinstance(data.setdefault(name, {}), dict):
            _merge(data[name], value)
        else:
            data[name] = value


def retake(run_requests: Sequence[RunRequest]) -> tuple[Store, list[Collected]]:
    """Take what is missing of the trials and label them; return the store and its campaigns."""
    store = Store.create(run_requests[0].store)
    for run_request in run_requests:
        collect(run_request)
    campaigns = collected(store, [run_request.campaign for run_request in run_requests])
    label(store, campaigns)
    return store, campaigns


@dataclass(frozen=True)
class Judged:
    """Outputs of a network and a rule on a store's test trials.

    Attributes:
        counts: spikes of each class in each sample, int64 (n, 3).
        samples: of the kinematic test trials.
        trials: a row of `analysis.evaluation.trials.score_row` for each, and its recording.
    """

    counts: npt.NDArray[np.int64]
    samples: dataset.SampleSet
    trials: list[tuple[TrialScore, Recording]]


def judge(
    fitted: training.Fitted,
    detection: Mapping[str, Detection],
    store: Store,
    campaigns: list[Collected],
) -> Judged:
    """Judge the labelled test trials of a store by a network that another one trained.

    Args:
        detection: smoothing, margin and stride by campaign.
    """
    labels, rows = Labels(store), []
    for item in campaigns:
        settings = detection[item.name]
        for trial, recording in item.of_split("test"):
            counts, end_ns = _counts(recording, fitted, settings)
            of_trial = labels.read(item, recording)
            row = score_row(item, trial, of_trial, counts, end_ns, settings)
            rows.append((row, recording))
    samples = load_samples(labels, training_campaigns(campaigns), "test")
    return Judged(training.predict_counts(fitted, samples.windows), samples, rows)


def _counts(
    recording: Recording, fitted: training.Fitted, settings: Detection
) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
    """Return spikes of consecutive windows (n, 3), and where they end (n,), ns."""
    windows = fitted.windows
    if settings.stride_ms is None:
        x, end_ns = dataset.trial_windows(recording, windows)
    else:
        length_ns = windows.length_ms * 1_000_000
        span, stride_ns = dataset.recorded_span(recording), settings.stride_ms * 1_000_000
        starts = strided_windows(*span, length_ns, stride_ns)
        x, end_ns = dataset.cut_windows(recording, starts, windows), starts + length_ns
    return training.predict_counts(fitted, x), end_ns
