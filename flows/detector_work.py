"""Which trials detectors learn from, are set by and are judged on, found before any is read."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from analysis.detector_comparison import Parts
from analysis.detectors import Heard, Labelled
from analysis.smoothing_choice import Choice, Counted, choose_smoothing
from flows.campaigns import Collected, training_campaigns
from flows.detector_trials import Wanted, heard, want
from flows.reviewed import Labels
from protocols.settings import Detection
from storage.recording import Recording
from storage.store import Store, StoreError


@dataclass(frozen=True)
class Known:
    """A trial with both onsets, and the windows of it that are wanted."""

    wanted: Wanted
    label: str
    incipient_ns: int
    gross_ns: int


@dataclass(frozen=True)
class DetectorWork:
    """Everything that detectors need besides what is scored anyway.

    Attributes:
        scored: windows of scored trials whose stride is not a window's length.
        choosing: by campaign, the trials that choose its smoothing and margin; empty where the
            protocol says them.
        compared: ``train``, ``validation`` and ``test`` trials of the comparison; None without.
    """

    scored: list[Wanted]
    choosing: dict[str, list[Known]]
    compared: dict[str, list[Known]] | None

    @property
    def wanted(self) -> list[Wanted]:
        """Windows of all of them, each once."""
        known = [*self.choosing.values(), *(self.compared or {}).values()]
        every = [*self.scored, *(trial.wanted for trials in known for trial in trials)]
        unique = {(item.campaign, item.recording.folder.name, item.step): item for item in every}
        return list(unique.values())

    @property
    def inputs(self) -> list[Any]:
        """What results depend on here, for a key."""

        def keys(trials: list[Known]) -> list[list[str]]:
            return [[trial.wanted.key, trial.label] for trial in trials]

        return [
            [item.key for item in self.scored],
            {name: keys(trials) for name, trials in self.choosing.items()},
            None if self.compared is None else {n: keys(t) for n, t in self.compared.items()},
        ]

    def choices(self, store: Store, detection: dict[str, Detection]) -> dict[str, Choice | None]:
        """Smoothing and margin by campaign; None where the protocol says them."""
        found: dict[str, Choice | None] = {}
        for name, settings in detection.items():
            trials = self.choosing[name]
            if not trials:
                found[name] = None
                continue
            counted = [_counted(store, trial) for trial in trials]
            found[name] = choose_smoothing(counted, settings, settings.choose)
        return found

    def parts(self, store: Store) -> Parts | None:
        """The trials of the comparison, read; None without one."""
        if self.compared is None:
            return None
        return Parts(
            **{
                name: [_labelled(store, t) for t in trials]
                for name, trials in self.compared.items()
            }
        )


def detector_work(
    labels: Labels, campaigns: list[Collected], detection: dict[str, Detection], model_key: str
) -> DetectorWork:
    """Find it.

    Raises:
        StoreError: smoothing and margin are to be chosen, and there is no trial to choose by.
    """
    used = training_campaigns(campaigns)
    settings = used[0].settings
    length = settings.windows.length_ms

    def hear(name: str, recording: Recording, stride_ms: int) -> Wanted:
        return want(name, recording, model_key, settings.windows, stride_ms)

    def known(split: str, stride_ms: int, most: int | None = None) -> list[Known]:
        found: list[Known] = []
        for item in used:
            for _, recording in item.of_split(split):
                label = labels.read(item, recording)
                if label["incipient_ns"] is None or label["gross_ns"] is None:
                    continue
                if most is not None and len(found) >= most:
                    return found
                found.append(
                    Known(
                        hear(item.name, recording, stride_ms),
                        labels.key(item, recording),
                        label["incipient_ns"],
                        label["gross_ns"],
                    )
                )
        return found

    choosing: dict[str, list[Known]] = {}
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
            scored += [hear(item.name, r, ours.stride_ms) for _, r in item.of_split("test")]
    fine = settings.fine_stride_ms
    compared = None
    if fine is not None and settings.detection.compare is not None:
        compared = {
            "train": known("train", length, settings.detection.compare.train_trials),
            "validation": known("validation", fine),
            "test": known("test", fine),
        }
    return DetectorWork(scored, choosing, compared)


def _labelled(store: Store, trial: Known) -> Labelled:
    arrays = heard(store, trial.wanted)
    return Labelled(
        Heard(arrays["counts"], arrays["events"], arrays["end_ns"]),
        trial.incipient_ns,
        trial.gross_ns,
    )


def _counted(store: Store, trial: Known) -> Counted:
    arrays = heard(store, trial.wanted)
    return Counted(arrays["counts"], arrays["end_ns"], trial.incipient_ns, trial.gross_ns)
