"""Training, validation and test trials of detectors, found before any is read."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from sliplab.analysis.campaigns import Collected, training_campaigns
from sliplab.analysis.detectors.detector_comparison import (
    Parts,
    PromisedRule,
    compare,
    promised,
    tuned,
)
from sliplab.analysis.detectors.detectors import Predictions, TrialWithSlip, Tuned
from sliplab.analysis.detectors.latency import TrueSlip, true_slip
from sliplab.analysis.detectors.onset_references import References, references_of
from sliplab.analysis.detectors.predictions import (
    PredictionRequest,
    prediction_request,
    predictions,
)
from sliplab.analysis.detectors.rule_sweep import SpikeCounts, choose_smoothing
from sliplab.analysis.labels.reviewed import StoreLabels
from sliplab.protocols.detection import Detection
from sliplab.protocols.settings import AnalysisSettings
from sliplab.storage.schema.evaluation import DetectorComparison, RuleChoice
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import StoreError, TrialStore


@dataclass(frozen=True)
class KnownTrial:
    """A trial with both onsets, and the inference that it needs."""

    request: PredictionRequest
    label: str
    slip: TrueSlip
    references: References


@dataclass(frozen=True)
class DetectorWork:
    """Further inputs of detectors, in addition to those that are scored anyway.

    Attributes:
        scored: windows of scored trials whose stride is not a window's length.
        choosing: by campaign, the trials that choose its smoothing and margin; empty where the
            protocol says them.
        compared: ``train``, ``validation`` and ``test`` trials of the comparison; None without.
        stateful: the same by stateful inference; None without.
    """

    scored: list[PredictionRequest]
    choosing: dict[str, list[KnownTrial]]
    compared: dict[str, list[KnownTrial]] | None
    stateful: dict[str, list[KnownTrial]] | None

    @property
    def requests(self) -> list[PredictionRequest]:
        """Inference that all of them need, each once."""
        known = [
            *self.choosing.values(),
            *(self.compared or {}).values(),
            *(self.stateful or {}).values(),
        ]
        every = [*self.scored, *(trial.request for trials in known for trial in trials)]
        unique = {(item.campaign, item.recording.folder.name, item.step): item for item in every}
        return list(unique.values())

    @property
    def inputs(self) -> list[Any]:
        """Inputs of the results, for a key."""

        def keys(trials: list[KnownTrial]) -> list[list[str]]:
            return [[trial.request.key, trial.label] for trial in trials]

        return [
            [item.key for item in self.scored],
            {name: keys(trials) for name, trials in self.choosing.items()},
            *(
                None if parts is None else {name: keys(trials) for name, trials in parts.items()}
                for parts in (self.compared, self.stateful)
            ),
        ]

    def choices(
        self, store: TrialStore, detection: dict[str, Detection]
    ) -> dict[str, RuleChoice | None]:
        """Smoothing and margin by campaign; None where the protocol says them."""
        found: dict[str, RuleChoice | None] = {}
        for name, settings in detection.items():
            trials = self.choosing[name]
            if not trials:
                found[name] = None
                continue
            counted = [_counted(store, trial) for trial in trials]
            found[name] = choose_smoothing(counted, settings, settings.choose)
        return found

    def tune(
        self, store: TrialStore, settings: AnalysisSettings, detection: Detection
    ) -> list[Tuned]:
        """Return detectors at the middle of the rates that are compared; none without a comparison.

        Args:
            settings: windows and strides; detection: the paper's rule.
        """
        return tuned(_parts(store, self.compared), settings, detection)

    def promise(
        self, store: TrialStore, settings: AnalysisSettings, detection: Detection, rate: float
    ) -> list[PromisedRule]:
        """Return the same detectors at the levels that promise a rate, with their test figures.

        Args:
            settings, detection: as `tune`.
            rate: false alarms an hour without slip, at most.
        """
        return promised(_parts(store, self.compared), settings, detection, rate)

    def compare(
        self, store: TrialStore, settings: AnalysisSettings, detection: Detection
    ) -> DetectorComparison | None:
        """Compare detectors; None where nothing is to be compared.

        Args:
            settings: windows and strides; detection: the paper's rule.
        """
        found = compare(_parts(store, self.compared), settings, detection)
        if found is None or self.stateful is None:
            return found
        stateful = compare(_parts(store, self.stateful), settings, detection)
        return found.model_copy(update={"carried": () if stateful is None else stateful.detectors})


def detector_work(
    labels: StoreLabels, campaigns: list[Collected], detection: dict[str, Detection], model_key: str
) -> DetectorWork:
    """Find the trials and windows that detectors need.

    Raises:
        StoreError: smoothing and margin are to be chosen, and there is no trial to choose by.
    """
    used = training_campaigns(campaigns)
    settings = used[0].settings
    length = settings.windows.length_ms

    def request(
        name: str, recording: Recording, stride_ms: int, stateful: bool = False
    ) -> PredictionRequest:
        return prediction_request(name, recording, model_key, settings.windows, stride_ms, stateful)

    def known(
        split: str, stride_ms: int, most: int | None = None, stateful: bool = False
    ) -> list[KnownTrial]:
        found: list[KnownTrial] = []
        for item in used:
            for _, recording in item.of_split(split):
                label = labels.read(item, recording)
                slip = true_slip(label)
                if slip is None:
                    continue
                if most is not None and len(found) >= most:
                    return found
                found.append(
                    KnownTrial(
                        request(item.name, recording, stride_ms, stateful),
                        labels.key(item, recording),
                        slip,
                        references_of(recording, label),
                    )
                )
        return found

    choosing: dict[str, list[KnownTrial]] = {}
    scored = []
    for item in campaigns:
        ours = detection[item.name]
        choosing[item.name] = []
        if ours.choose != "protocol":
            choosing[item.name] = known(ours.choose, ours.stride_ms or length)
            if not choosing[item.name]:
                raise StoreError(
                    f"{item.name}: smoothing and margin are to be chosen by {ours.choose} trials, "
                    "and no kinematic one has both onsets"
                )
        if ours.stride_ms is not None:
            scored += [request(item.name, r, ours.stride_ms) for _, r in item.of_split("test")]
    fine, asked = settings.fine_stride_ms, settings.detection.compare

    def compared(stateful: bool) -> dict[str, list[KnownTrial]] | None:
        if fine is None or asked is None or (stateful and not asked.carried):
            return None
        return {
            "train": known("train", length, asked.train_trials, stateful),
            "validation": known("validation", fine, None, stateful),
            "test": known("test", fine, None, stateful),
        }

    return DetectorWork(scored, choosing, compared(False), compared(True))


def _parts(store: TrialStore, known: dict[str, list[KnownTrial]] | None) -> Parts:
    """The trials of a comparison, read; no trials without one."""
    names = ("train", "validation", "test")
    return Parts(*([_labelled(store, t) for t in (known or {}).get(name, ())] for name in names))


def _labelled(store: TrialStore, trial: KnownTrial) -> TrialWithSlip:
    arrays = predictions(store, trial.request)
    windows = Predictions(arrays["counts"], arrays["events"], arrays["end_ns"])
    return TrialWithSlip(windows, trial.slip, trial.references)


def _counted(store: TrialStore, trial: KnownTrial) -> SpikeCounts:
    arrays = predictions(store, trial.request)
    return SpikeCounts(arrays["counts"], arrays["end_ns"], trial.slip)
