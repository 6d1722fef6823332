"""The numbers of a report, `report/summary.json`; every key is explained in docs/summary.md.

Times are milliseconds unless a name says otherwise; shares are 0 to 1; null is what cannot be
computed. Keys that an older version did not write have a default.
"""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from sliplab.storage.schema.document import Bool, Document, Int, Number, Part
from sliplab.storage.schema.evaluation import (
    Accuracy,
    AlarmRate,
    Baseline,
    ByClass,
    DetectorComparison,
    DeviationByOnset,
    ExperimentScores,
    LabelCheck,
    LabelErrors,
    LatencyByOnset,
    LeadFigures,
    LeadShare,
    MarkerClassifier,
    NoSlip,
    OnsetFigures,
    ProbabilityCalibration,
    RuleChoice,
    RuleErrors,
    SampleCounts,
    Seeds,
    Share,
    Tenth,
    TrainedBaseline,
    TrialWindows,
    WindowWork,
)

Outcome = Literal[
    "detected_first",
    "late",
    "missed",
    "false_early",
    "without_onsets",
    "not_evaluated",
    "not_taken",
]
"""By a trial's incipient detection; every trial of a plan has exactly one."""
GrossOutcome = Literal["detected", "late", "missed", "false_early", "without_onsets"]
Known = Number | None
Span = tuple[Number | None, Number | None] | None
"""A 95 % interval, low and high; null where so few trials bound nothing, an end where it is
infinite."""


class Accounts(Part):
    """Every test trial of the plans once; the outcomes add up to `planned`."""

    planned: Int
    detected_first: Int = 0
    late: Int = 0
    missed: Int = 0
    false_early: Int = 0
    without_onsets: Int = 0
    not_evaluated: Int = 0
    not_taken: Int = 0

    def of(self, outcome: str) -> int:
        """Return the number of trials with an outcome."""
        return int(getattr(self, outcome))


class TimeIntervals(Part):
    """Intervals over trials of a time's statistics."""

    n: Int
    mean: Span = None
    median: Span = None
    p95: Span = None


class TrialIntervals(Part):
    """Intervals of the times that a trial has."""

    duration_ms: TimeIntervals
    latency_incipient_ms: TimeIntervals
    latency_gross_ms: TimeIntervals
    lead_ms: TimeIntervals

    def of(self, name: str) -> TimeIntervals:
        """Return the intervals of one time."""
        found: TimeIntervals = getattr(self, name)
        return found


class Experiment(ExperimentScores):
    """Detections of one experiment's test trials."""

    accounted: Accounts
    intervals: TrialIntervals
    by_reference: dict[str, OnsetFigures] = Field(default_factory=dict)
    """By `paper`, `change_point` and, only where simulated, `true`."""
    first_slip_ms: Known = None
    """When the first tip slips, from the labelled onset, median over trials; only where
    simulated."""


class NetworkWindows(Experiment):
    """A network's windows and detections on kinematic test trials."""

    false_alarms: dict[str, AlarmRate] = Field(default_factory=dict)
    """By `quiet`, in these trials before slip, and, where `sliplab stress` measured them, `none`
    and `nuisances`: by the rule of detection in its trials without and with nuisances."""

    accuracy: Accuracy
    confusion: tuple[tuple[Int, ...], ...]
    precision: ByClass
    recall: ByClass
    interval: Share
    """Of strict accuracy."""
    window_intervals: dict[str, Share] = Field(default_factory=dict)
    """Of `accuracy` (ties shared), `incipient_precision` and `incipient_recall`."""


class Kinematic(NetworkWindows):
    """The store's own network, from every side."""

    baselines: dict[str, Known]
    samples: SampleCounts
    trained_baselines: dict[str, TrainedBaseline] = Field(default_factory=dict)
    seeds: Seeds
    reliability: tuple[LeadShare, ...] = ()
    calibration: ProbabilityCalibration
    by_factor: dict[str, dict[str, Share]] = Field(default_factory=dict)
    by_tenth: dict[str, tuple[Tenth, ...]] = Field(default_factory=dict)
    no_slip: NoSlip | None = None
    by_trial: tuple[TrialWindows, ...] = ()
    work: WindowWork | None = None
    beside: dict[str, Baseline] = Field(default_factory=dict)


class RuleSettings(Part):
    """The settings of detection that were used."""

    smoothing: Int
    margin: Number
    choose: str = "protocol"
    """Source of both: `protocol`, `validation` or `test`."""
    false_early_ms: Number | None = None
    """A detection earlier than the onset by more is false."""


class NetworkSummary(Part):
    """Another network on the same trials."""

    title: str
    preset: str | None
    seed: Int | None
    engine: str
    exact: Bool
    detection: dict[str, RuleSettings]
    kinematic: NetworkWindows
    gravity: Experiment
    disturbance: Experiment


class SettingDifference(Part):
    """A setting in which the network differs from the paper's."""

    setting: str
    key: str
    paper: str
    here: str
    source: str


class PaperSettings(Part):
    """The network's settings and the paper's."""

    preset: str | None
    differences: tuple[SettingDifference, ...]
    assumed: tuple[str, ...]
    """Settings that the paper does not say, with their values."""


class TrialOutcome(Part):
    """One evaluated trial."""

    campaign: str
    experiment: str
    trial: str
    outcome: Outcome
    gross: GrossOutcome
    duration_ms: Known
    """True length of the incipient slip."""
    latency_incipient_ms: Known
    latency_gross_ms: Known
    lead_ms: Known
    late_incipient_ms: Known = None
    """Delay of a late detection after its event."""
    late_gross_ms: Known = None


class DriftTrend(Part):
    """Change over 100 trials, in percent of the median."""

    n: Int
    percent_per_100_trials: Known
    low: Known
    high: Known


class ReferenceTrial(Part):
    """One reference trial."""

    trial: str
    place: Int
    hold_events_per_s: Known
    """Null without events."""
    first_slip_ms: Known
    """After the motion began."""


class ReferenceSummary(Part):
    """A campaign's reference trials, and wear."""

    trials: tuple[ReferenceTrial, ...]
    wear: dict[str, DriftTrend]


class HoldSummary(Part):
    """Slips in the hold of a campaign's trials."""

    trials: Int
    slipped: Int
    limit_px: Known
    most_px: Number
    apart_ms: DeviationByOnset
    """The paper's onset from the hold's end less the one from its start."""


class LabelSummary(Part):
    """The labels behind all figures."""

    error_ms: LabelErrors
    rules_ms: RuleErrors
    source: dict[str, Int] = Field(default_factory=dict)
    reviewed: dict[str, Int] | None = None
    check: LabelCheck | None = None
    holds: dict[str, HoldSummary] = Field(default_factory=dict)
    given_within_ms: Number | None = None
    """Largest uncertainty that is stated of onsets that came with recordings; null where one states
    none; written only for such onsets."""


class HoldoutWindows(Part):
    """Windows of the hold-out campaign."""

    strict: Share
    argmax: Share


class HoldoutSummary(Part):
    """The store's network on another skin and seed."""

    trials: Int
    protocol_seed: Int
    skin_seed: Int
    model: str
    versions: tuple[str, ...]
    false_alarms: AlarmRate | None = None
    """In quiet holding."""
    windows: HoldoutWindows
    latency_ms: LatencyByOnset
    lead_ms: LeadFigures
    without_onsets: Int = 0
    intervals: TrialIntervals


class Sync(Part):
    """Grades of the devices' clocks; uncertainties are of the worst trial, in microseconds."""

    grade: str | None
    """Of the frames, or of the arm."""
    grades: dict[str, str]
    worst_uncertainty_us: Known
    worst_against_events_us: dict[str, Number]


class QualitySummary(Part):
    """Trials and attempts."""

    planned: Int
    committed: Int
    retaken: Int
    quarantined: Int
    interrupted: Int = 0


class Planned(Part):
    """A campaign's plan and the trials taken."""

    seconds: Number
    seconds_collected: Number
    bytes: Int
    bytes_collected: Int


class Hashes(Part):
    """Of a protocol's two sections."""

    collection: str
    analysis: str


class SeedsUsed(Part):
    """Seeds of networks and collections."""

    network: tuple[Int, ...]
    chosen: Int
    collection: dict[str, Int]


class StepLeftOut(Part):
    """An analysis that a rig with one camera cannot have."""

    name: str
    reason: str


class MotionRate(Part):
    """Event rate of a campaign's trials, median over trials, events per second."""

    trials: Int
    hold: Number | None
    motion: Number | None


class OneCameraSummary(Document):
    """The numbers of a report on a rig with one camera."""

    simulated: Bool
    one_camera: Literal["events", "frames"]
    """The stream that was recorded."""
    left_out: tuple[StepLeftOut, ...]
    """Analyses that need the other stream."""
    labels: LabelSummary | None = None
    """Null where trials have no labels yet."""
    event_rates: dict[str, MotionRate] | None = None
    """By campaign; null without events."""
    references: dict[str, ReferenceSummary] = Field(default_factory=dict)
    """Of campaigns with reference trials."""
    classifier: MarkerClassifier | None = None
    """Trained on marker displacements; only where frames alone were recorded. This key and the next
    six are written only where the store is evaluated, with the meaning that they have in `Summary`;
    where events alone were recorded, the other keys of `Summary` are, too."""
    kinematic: Kinematic | None = None
    gravity: Experiment | None = None
    disturbance: Experiment | None = None
    trials: tuple[TrialOutcome, ...] = ()
    detection: dict[str, RuleSettings] = Field(default_factory=dict)
    choices: dict[str, RuleChoice | None] = Field(default_factory=dict)
    clocks_us: dict[str, Number]
    """Uncertainty of each device's own clock against the sync box, worst trial, microseconds."""
    sync: Sync
    quality: QualitySummary
    planned: dict[str, Planned]
    timing_s: dict[str, Number] = Field(default_factory=dict)
    versions: dict[str, str]
    protocols: dict[str, Hashes]


class Summary(Document):
    """A report's numbers."""

    simulated: Bool
    kinematic: Kinematic
    gravity: Experiment
    disturbance: Experiment
    networks: dict[str, NetworkSummary] = Field(default_factory=dict)
    paper: PaperSettings | None = None
    trials: tuple[TrialOutcome, ...]
    references: dict[str, ReferenceSummary] = Field(default_factory=dict)
    labels: LabelSummary
    detection: dict[str, RuleSettings] = Field(default_factory=dict)
    """By campaign."""
    choices: dict[str, RuleChoice | None] = Field(default_factory=dict)
    """By campaign, what chose the rule; null where the protocol says it."""
    detectors: DetectorComparison | None = None
    holdout: HoldoutSummary | None = None
    sync: Sync
    quality: QualitySummary
    planned: dict[str, Planned] = Field(default_factory=dict)
    timing_s: dict[str, Number] = Field(default_factory=dict)
    """The one entry that differs between equal runs."""
    versions: dict[str, str]
    protocols: dict[str, Hashes]
    seeds: SeedsUsed
