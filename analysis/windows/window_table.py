"""The windows of a store's trials as a table, by which models of other programs are trained and
judged."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pandas as pd

from sliplab.analysis.campaigns import Collected, training_campaigns
from sliplab.analysis.labels.reviewed import StoreLabels
from sliplab.analysis.metrics.classification import CLASSES
from sliplab.analysis.windows.dataset import TrialId, run_starts, sample_starts
from sliplab.protocols.hashing import hash_integer
from sliplab.storage.errors import StoreError
from sliplab.storage.trials.recording import Recording

SPLITS = ("train", "validation", "test")
I64 = npt.NDArray[np.int64]


def whole_ns(column: pd.Series) -> tuple[I64, npt.NDArray[np.bool_]]:
    """Return times as integers, 0 where they are not whole nanoseconds, and where they are."""
    values = pd.to_numeric(column, errors="coerce")
    good = (values.abs() < 2**63) & (values % 1 == 0)  # NaN is neither
    return values.where(good, 0).to_numpy(np.int64), good.to_numpy(np.bool_)


@dataclass(frozen=True)
class LabelledWindows:
    """The windows of one trial.

    Attributes:
        key: of its label.
        run_ns: start of each window in which slip is detected, ns, (n,).
        sample_ns: start of each window that is a sample, ns, (m,); none of other experiments than
            slides.
        y: class of each sample, (m,).
    """

    trial: TrialId
    split: str
    recording: Recording
    key: str
    length_ns: int
    run_ns: I64
    sample_ns: I64
    y: I64

    @property
    def starts_ns(self) -> I64:
        """Start of each window once, ascending."""
        return np.union1d(self.run_ns, self.sample_ns)

    def table(self) -> pd.DataFrame:
        """Return the windows as rows of `window_table`."""
        starts = self.starts_ns
        names = np.full(len(starts), None, object)
        names[np.searchsorted(starts, self.sample_ns)] = np.array(CLASSES, object)[self.y]
        return pd.DataFrame(
            {
                "campaign": self.trial.campaign,
                "trial": self.trial.trial,
                "split": self.split,
                "start_ns": starts,
                "end_ns": starts + self.length_ns,
                "run": np.isin(starts, self.run_ns),
                "label": names,
            }
        )


def trial_windows(
    labels: StoreLabels, campaigns: list[Collected], split: str
) -> Iterator[LabelledWindows]:
    """Yield the windows of each labelled trial of a part of the split.

    Raises:
        StoreError: there are no slides with events, or one has no label.
    """
    kinematic = training_campaigns(campaigns)
    settings = kinematic[0].settings
    slides = {item.name for item in kinematic}
    none = np.empty(0, np.int64)
    for item in campaigns:
        stride = item.settings.detection.stride_ms
        for trial, recording in item.of_split(split):
            samples = none, none
            if item.name in slides:
                if not labels.fresh(item, recording):
                    text = f"{item.name}: {trial.id} has no label yet; run `sliplab label`"
                    raise StoreError(text)
                label, seed = labels.read(item, recording), hash_integer("samples", trial.id)
                samples = sample_starts(recording, label, settings.windows, settings.samples, seed)
            yield LabelledWindows(
                TrialId(item.name, trial.id),
                split,
                recording,
                labels.key(item, recording),
                settings.windows.length_ms * 1_000_000,
                run_starts(recording, settings.windows, stride),
                *samples,
            )


def window_table(
    labels: StoreLabels, campaigns: list[Collected], splits: tuple[str, ...]
) -> pd.DataFrame:
    """Return the windows of all labelled trials, by trial and time.

    Returns:
        a row for each window: ``campaign``, ``trial``, ``split``, ``start_ns``, ``end_ns`` on the
        trial's time line; ``run``: slip is detected in it; ``label``: its class where it is a
        sample, else None.
    """
    parts = [it.table() for split in splits for it in trial_windows(labels, campaigns, split)]
    empty = pd.DataFrame(
        columns=["campaign", "trial", "split", "start_ns", "end_ns", "run", "label"]
    )
    return pd.concat(parts, ignore_index=True) if parts else empty
