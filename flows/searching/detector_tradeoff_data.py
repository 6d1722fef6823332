"""What the detector's trade-off learns from and is judged on: trials, and windows of any length.

Windows of every length cover the same stretches of a trial: as many milliseconds a class as the
protocol's own windows do. Otherwise short windows would all lie next to the onsets, and accuracies
would differ by where windows lie instead of by what they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from sliplab.analysis.campaigns import Collected, training_campaigns
from sliplab.analysis.detectors.latency import true_slip
from sliplab.analysis.detectors.rule_sweep import Trials
from sliplab.analysis.windows import dataset
from sliplab.analysis.windows.dataset import SampleSet
from sliplab.flows.labelling.reviewed import Labels
from sliplab.flows.searching.detector_tradeoff_grid import Setting
from sliplab.protocols import Trial
from sliplab.protocols.hashing import hash_integer
from sliplab.protocols.settings import AnalysisSettings, Samples
from sliplab.storage.schema.label import TrialLabel
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import StoreError


@dataclass(frozen=True)
class Ask:
    """How large the search is.

    Attributes:
        samples: training windows of each network; the same number of test windows at most, and a
            quarter of it to choose epochs by.
        epochs: of each training at most; the protocol's other settings stay.
        trials: validation and test trials of each kind that detections are judged on, at most.
        seeds: trainings of each setting.
        stride_ms: the finest stride.
    """

    samples: int = 12_000
    epochs: int = 4
    trials: int = 60
    seeds: int = 3
    stride_ms: int = 10


@dataclass(frozen=True)
class Used:
    """A trial that is used, with its label."""

    item: Collected
    trial: Trial
    recording: Recording
    label: TrialLabel
    label_key: str

    @property
    def both(self) -> bool:
        """Whether both onsets are known."""
        return true_slip(self.label) is not None

    @property
    def named(self) -> list[str]:
        """What results depend on here, for a key."""
        return [self.item.name, self.trial.id, self.recording.checksum, self.label_key]


class Data:
    """The trials of a store, as a search uses them.

    Args:
        labels: of the store, every used trial labelled.
        campaigns: the kinematic ones train and choose; gravity and disturbance give leads.

    Raises:
        StoreError: no kinematic campaign, a trial without a label, or a part without trials.
    """

    def __init__(self, labels: Labels, campaigns: Sequence[Collected], ask: Ask) -> None:
        self.labels, self.ask = labels, ask
        self._kinematic = training_campaigns(list(campaigns))
        self._others = [item for item in campaigns if item not in self._kinematic]
        self.settings: AnalysisSettings = self._kinematic[0].settings
        for name in ("train", "validation", "test"):
            if not getattr(self, name):
                raise StoreError(f"the search needs {name} trials with both onsets; there are none")

    @cached_property
    def train(self) -> list[Used]:
        """Training trials with both onsets."""
        return self._of(self._kinematic, "train", None)

    @cached_property
    def validation(self) -> list[Used]:
        """What chooses epochs, smoothing and margin."""
        return self._of(self._kinematic, "validation", self.ask.trials)

    @cached_property
    def test(self) -> list[Used]:
        """What figures are of."""
        return self._of(self._kinematic, "test", self.ask.trials)

    @cached_property
    def falling(self) -> list[Used]:
        """Test trials of plates that slip by their own weight: what leads are of."""
        return self._of(self._others, "test", self.ask.trials)

    @property
    def judged(self) -> list[Used]:
        """All whose windows are counted, in the order in which their counts are kept."""
        return [*self.validation, *self.test, *self.falling]

    def _of(self, campaigns: Sequence[Collected], split: str, most: int | None) -> list[Used]:
        """Of each campaign the first so many by a hash: fewer are always among more."""
        found = []
        for item in campaigns:
            ours = []
            for trial, recording in item.of_split(split):
                if not self.labels.fresh(item, recording):
                    raise StoreError(
                        f"{item.name}: {trial.id} has no label yet; run `sliplab label`"
                    )
                label = self.labels.read(item, recording)
                ours.append(Used(item, trial, recording, label, self.labels.key(item, recording)))
            known = [used for used in ours if used.both]
            known.sort(key=lambda used: hash_integer("tradeoff", item.name, used.trial.id))
            found += known[:most]
        return found

    def inputs(self, *parts: list[Used]) -> list[Any]:
        """What results depend on, for a key."""
        return [dataset.VERSION, *([used.named for used in part] for part in parts)]

    def samples(self, setting: Setting, part: list[Used], most: int) -> SampleSet:
        """Windows of trials by the 50/50/50 rule, as many of each trial as of any other.

        Args:
            most: windows in all.
        """
        windows = setting.windows(self.settings.windows)
        own = self.settings.windows.length_ms * self.settings.samples.per_class
        per_class = Samples(per_class=max(1, round(own / setting.length_ms)))
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
            parts.append(
                SampleSet(
                    found.windows.take(rows),
                    found.y[rows],
                    found.trial[rows],
                    found.start_ns[rows],
                    found.trials,
                )
            )
        return SampleSet.join(parts, windows)


def true_onsets(part: Sequence[Used]) -> Trials:
    """The true slip of trials with both onsets, and how early is too early."""

    def column(values: list[int]) -> npt.NDArray[np.int64]:
        return np.array(values, np.int64)

    slips = [slip for used in part if (slip := true_slip(used.label)) is not None]
    return Trials(
        column([slip.incipient_ns for slip in slips]),
        column([slip.gross_ns for slip in slips]),
        column([slip.end_ns for slip in slips]),
        column([round(used.item.settings.detection.false_early_ms * 1e6) for used in part]),
    )
