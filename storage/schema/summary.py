"""The numbers of a report, `report/summary.json`; every key is explained in docs/summary.md.

Times are milliseconds unless a name says otherwise; shares are 0 to 1; null is what cannot be
computed. Keys that an older version did not write have a default.
"""

from __future__ import annotations

from typing import Any, Generic, Literal, TypeVar

from pydantic import Field

from sliplab.storage.schema.document import Bool, Document, Int, Number, Part

Outcome = Literal[
    "detected_first", "late", "missed", "false_early", "without_onsets", "not_evaluated",
    "not_taken",
]  # fmt: skip
"""By a trial's incipient detection; every trial of a plan has exactly one."""
GrossOutcome = Literal["detected", "late", "missed", "false_early", "without_onsets"]
Known = Number | None
Span = tuple[Number, Number] | None
"""A 95 % interval, low and high; null where so few trials bound nothing."""
T = TypeVar("T")


class ByOnset(Part, Generic[T]):
    """One value for each onset."""

    incipient: T
    gross: T


class ByClass(Part, Generic[T]):
    """One value for each class of windows."""

    no_slip: T
    incipient: T
    gross: T


class Share(Part):
    """A share of windows, or a difference of shares, with its 95 % interval over trials."""

    share: Known
    low: Known
    high: Known
    n: Int
    """Windows."""
    trials: Int


class Accuracy(Part):
    """Accuracy of windows: ties shared, ties wrong, and won by the margin of a detection."""

    argmax: Known
    strict: Known
    margin: Known
    n: Int


class Statistics(Part):
    """A time over the trials that have it, and how many have none, by cause."""

    n: Int
    mean: Known
    std: Known
    median: Known
    p95: Known
    min: Known
    max: Known
    missed: Int
    late: Int
    false_early: Int


class Lead(Statistics):
    """True gross onset less the incipient detection."""

    detected_first: Int


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


class Experiment(Part):
    """Detections of one experiment's test trials."""

    trials: Int
    without_onsets: Int
    latency_ms: ByOnset[Statistics]
    lead_ms: Lead
    accounted: Accounts
    intervals: TrialIntervals


class Calibration(Part):
    """Softmax of the counts over a temperature, as probabilities."""

    temperature: Known = None
    """Fitted on validation windows."""
    ece: Known = None
    """Expected calibration error on test windows."""
    uncalibrated: dict[str, Known] = Field(default_factory=dict)


class Reliability(Share):
    """Windows by the winner's lead over the next class."""

    lead: Int
    """Least, in spikes."""
    to: Int | None
    """Most; null where there is no bound."""
    right: Int = 0


class Tenth(Share):
    """Recall in one tenth of a class's phase."""

    tenth: Int


class NoSlip(Part):
    """No-slip windows before the motion, and in it before the first slip."""

    hold: Share
    loading: Share


class TrialErrors(Part):
    """Windows of one trial."""

    campaign: str
    trial: str
    condition: dict[str, str] = Field(default_factory=dict)
    n: Int
    errors: Int
    strict: Known = None
    taken: dict[str, Int] = Field(default_factory=dict)


class Seed(Part):
    """One trained seed on the test windows."""

    argmax: Known = None
    strict: Known = None
    margin: Known = None
    seed: Int | None = None
    chosen: Bool = False
    validation_strict: Known = None


class Range(Part):
    """Mean, lowest and highest over seeds."""

    mean: Known
    min: Known
    max: Known


class Seeds(Part):
    """Every trained seed."""

    each: tuple[Seed, ...]
    spread: dict[str, Range] = Field(default_factory=dict)


class Work(Part):
    """Computation of a window in the mean, by layer and in `all`."""

    synaptic_operations: dict[str, Number]
    dense_multiply_adds: dict[str, Number]
    share: Number
    spikes: dict[str, Number]
    rates: dict[str, Number]
    events: Number
    n: Int


class Compared(Part):
    """Another method on the same windows."""

    argmax: Known
    low: Known = None
    high: Known = None
    network_ahead: Share
    """The network's accuracy less the method's."""
    made: dict[str, Any] = Field(default_factory=dict)
    """How it was trained: weights, epochs, seeds."""


class NetworkWindows(Experiment):
    """A network's windows and detections on kinematic test trials."""

    accuracy: Accuracy
    confusion: tuple[tuple[Int, ...], ...]
    precision: ByClass[Known]
    recall: ByClass[Known]
    interval: Share
    """Of strict accuracy."""
    window_intervals: dict[str, Share] = Field(default_factory=dict)
    """Of `accuracy` (ties shared), `incipient_precision` and `incipient_recall`."""


class Kinematic(NetworkWindows):
    """The store's own network, from every side."""

    baselines: dict[str, Known]
    samples: dict[str, Int]
    trained_baselines: dict[str, Compared] = Field(default_factory=dict)
    seeds: Seeds
    reliability: tuple[Reliability, ...] = ()
    calibration: Calibration = Calibration()
    by_factor: dict[str, dict[str, Share]] = Field(default_factory=dict)
    by_tenth: dict[str, tuple[Tenth, ...]] = Field(default_factory=dict)
    no_slip: NoSlip | None = None
    by_trial: tuple[TrialErrors, ...] = ()
    work: Work | None = None
    beside: dict[str, Compared] = Field(default_factory=dict)


class DetectionRule(Part):
    """The settings of detection that were used."""

    smoothing: Int
    margin: Number
    choose: str = "protocol"
    """What chose them: `protocol`, `validation` or `test`."""


class FalseEarlyRate(Part):
    """A share of trials with its exact interval."""

    value: Known
    low: Known
    high: Known


class DetectorScores(Part):
    """A detector on the trials of one split."""

    latency_ms: ByOnset[Statistics]
    lead_ms: Lead
    false_early_rate: FalseEarlyRate
    median_with_missed_ms: Known
    """Median incipient latency, missed and late ones as infinite; null where that is infinite."""


class DetectorRate(Part):
    """A detector whose level allows a rate of false early detections."""

    asked: Number
    allowed: Int
    """Validation trials that may be false early."""
    choice: Any = None
    """What else was chosen, such as the windows that are averaged."""
    validation: DetectorScores
    test: DetectorScores


class CurvePoint(Part):
    """Latency on test trials at one rate on validation trials."""

    rate: Number
    median_ms: Known


class Detector(Part):
    """A detector at all rates."""

    name: str
    stride_ms: Int
    curve: tuple[CurvePoint, ...]
    rates: tuple[DetectorRate, ...]


class Detectors(Part):
    """Detectors compared at equal rates of false early detections."""

    detectors: tuple[Detector, ...]
    carried: tuple[Detector, ...] = ()
    """The same of a network whose states are carried from window to window."""
    strides_ms: tuple[Int, ...]
    trials: dict[str, Int]
    """By split."""


class Network(Part):
    """Another network on the same trials."""

    title: str
    preset: str | None
    seed: Int | None
    engine: str
    exact: Bool
    detection: dict[str, DetectionRule]
    kinematic: NetworkWindows
    gravity: Experiment
    disturbance: Experiment


class Difference(Part):
    """A setting in which the network differs from the paper's."""

    setting: str
    key: str
    paper: str
    here: str
    source: str


class Paper(Part):
    """The network's settings beside the paper's."""

    preset: str | None
    differences: tuple[Difference, ...]
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
    """How far a late detection came after its event."""
    late_gross_ms: Known = None


class Trend(Part):
    """Change over 100 trials, in percent of the median."""

    n: Int
    percent_per_100_trials: Known
    low: Known
    high: Known


class ReferenceTrial(Part):
    """One reference trial."""

    trial: str
    place: Int
    hold_events_per_s: Number
    first_slip_ms: Known
    """After the motion began."""


class References(Part):
    """A campaign's reference trials, and wear."""

    trials: tuple[ReferenceTrial, ...]
    wear: dict[str, Trend]


class Spread(Part):
    """Distances of onsets."""

    n: Int
    median: Known
    median_abs: Known
    max_abs: Known


class LabelErrors(Part):
    """Labels in use less the simulation's truth of their rule."""

    rule: str
    incipient: Spread
    gross: Spread


class Papillae(Spread):
    """Change points of all papillae, and the share of intervals that hold the truth."""

    coverage: Known


class Rules(Part):
    """Both labelling rules less their truth, and less each other."""

    paper: ByOnset[Spread]
    change_point: ByOnset[Spread]
    apart: ByOnset[Spread]
    papillae: Papillae


class LabelCheck(Part):
    """Labels of slides taken again with video."""

    trials: Int
    simulated: Bool = True
    rules_ms: Rules


class Hold(Part):
    """Slips in the hold of a campaign's trials."""

    trials: Int
    slipped: Int
    limit_px: Known
    most_px: Number
    apart_ms: ByOnset[Spread]
    """The paper's onset from the hold's end less the one from its start."""


class Labels(Part):
    """The labels behind all figures."""

    error_ms: LabelErrors
    rules_ms: Rules
    source: dict[str, Int] = Field(default_factory=dict)
    reviewed: dict[str, Int] | None = None
    check: LabelCheck | None = None
    holds: dict[str, Hold] = Field(default_factory=dict)


class HoldoutWindows(Part):
    """Windows of the hold-out campaign."""

    strict: Share
    argmax: Share


class Holdout(Part):
    """The store's network on another skin and seed."""

    trials: Int
    protocol_seed: Int
    skin_seed: Int
    model: str
    versions: tuple[str, ...]
    windows: HoldoutWindows
    latency_ms: ByOnset[Statistics]
    lead_ms: Lead
    without_onsets: Int = 0
    intervals: TrialIntervals


class Sync(Part):
    """How devices were timed; uncertainties are of the worst trial, in microseconds."""

    grade: str | None
    """Of the frames, or of the arm."""
    grades: dict[str, str]
    worst_uncertainty_us: Known
    worst_against_events_us: dict[str, Number]


class Quality(Part):
    """Trials and attempts."""

    planned: Int
    committed: Int
    retaken: Int
    quarantined: Int
    interrupted: Int = 0


class Planned(Part):
    """A campaign's plan beside what was taken."""

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


class Summary(Document):
    """A report's numbers."""

    simulated: Bool
    kinematic: Kinematic
    gravity: Experiment
    disturbance: Experiment
    networks: dict[str, Network] = Field(default_factory=dict)
    paper: Paper | None = None
    trials: tuple[TrialOutcome, ...]
    references: dict[str, References] = Field(default_factory=dict)
    labels: Labels
    detection: dict[str, DetectionRule] = Field(default_factory=dict)
    """By campaign."""
    choices: dict[str, Any] = Field(default_factory=dict)
    """By campaign, what chose the rule; null where the protocol says it."""
    detectors: Detectors | None = None
    holdout: Holdout | None = None
    sync: Sync
    quality: Quality
    planned: dict[str, Planned] = Field(default_factory=dict)
    timing_s: dict[str, Number] = Field(default_factory=dict)
    """The one entry that differs between equal runs."""
    versions: dict[str, str]
    protocols: dict[str, Hashes]
    seeds: SeedsUsed
