"""The evaluation of a network: windows, trials, detectors, and baselines.

Shares, accuracies and rates run from 0 to 1. Intervals are 95 % over trials. Times and latencies
are in milliseconds unless a name ends in `_ns`: integer nanoseconds on the trial's time line. A
figure that cannot be computed is null.
"""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field, PlainSerializer

from sliplab.protocols.detection import Detection
from sliplab.storage.schema.document import Bool, Document, Int, Number, Part

Settings = Annotated[Detection, PlainSerializer(lambda settings: settings.model_dump(mode="json"))]
"""The section `analysis.detection` of a protocol, with what was chosen."""


class Share(Part):
    """A share of windows with its interval over trials."""

    share: Number | None
    low: Number | None
    """Lower end of the interval; null if there is none."""
    high: Number | None
    n: Int
    """Windows."""
    trials: Int


class Tenth(Share):
    """Recall in one tenth of a phase."""

    tenth: Int
    """From 1 to 10."""


class LeadShare(Share):
    """Windows by the spikes by which the winning class leads the next one."""

    lead: Int
    """The least lead of the row, spikes."""
    to: Int | None
    """The most; null: no bound."""
    right: Int
    """Windows that were classified rightly."""


class Accuracy(Part):
    """Three accuracies over the same samples; null if there are no samples."""

    argmax: Number | None
    """A sample whose class ties for the maximum with k-1 others counts 1/k, so a silent network
    scores 1/3 and the order of the classes cannot matter."""
    strict: Number | None
    """Only a unique winner counts; a tie is wrong."""
    margin: Number | None
    """Only a unique winner that leads every other by at least the margin counts."""
    n: Int
    """Samples."""


ByClass = dict[str, Number | None]
"""By `no_slip`, `incipient`, `gross`."""


class Classification(Part):
    """Classified windows against their true classes."""

    accuracy: Accuracy
    confusion: tuple[tuple[Int, ...], ...]
    """Rows are true classes; columns predicted ones, the fourth undecided windows."""
    precision: ByClass
    """Right among all decided for the class; undecided windows are in no class."""
    recall: ByClass
    """Right among all that truly are of the class; undecided windows are not right."""
    balance: ByClass
    """Share of each class among the windows."""


class CalibrationScores(Part):
    """Difference between predicted probabilities and observed frequencies."""

    ece: Number
    """Expected calibration error, 0 to 1."""
    cross_entropy: Number
    """Mean over windows, nats."""


class ProbabilityCalibration(Part):
    """Scores of test windows at the temperature that validation windows give."""

    temperature: Number | None
    """Spikes; null without validation windows."""
    ece: Number | None
    cross_entropy: Number | None
    uncalibrated: CalibrationScores | None
    """The same at the temperature 1."""


class NoSlip(Part):
    """Recall of no slip."""

    hold: Share
    """Before the motion."""
    loading: Share
    """From the motion's start on."""


class TrialWindows(Part):
    """The windows of one trial."""

    campaign: str
    trial: str
    condition: dict[str, str]
    """Levels by factor, with their units."""
    n: Int
    """Windows."""
    errors: Int
    """Windows that were not classified rightly."""
    strict: Number
    taken: dict[str, Int]
    """Windows by what was taken for what, such as `gross as incipient`."""


class SeedScores(Part):
    """One trained seed on the test windows."""

    seed: Int
    chosen: Bool
    validation_strict: Number | None
    argmax: Number | None
    strict: Number | None
    margin: Number | None


class SeedSpread(Part):
    """A figure over seeds."""

    mean: Number | None
    min: Number | None
    max: Number | None


class Seeds(Part):
    """Every trained seed on the same windows."""

    each: tuple[SeedScores, ...]
    spread: dict[str, SeedSpread]
    """By `argmax`, `strict` and `margin`."""


class WindowWork(Part):
    """Mean work of the network per window."""

    synaptic_operations: dict[str, Number]
    """Additions that input spikes cause, by weighted layer, and `all`."""
    dense_multiply_adds: dict[str, Number]
    """Of the same layers where every place and step is computed."""
    share: Number
    """The first as a share of the second."""
    spikes: dict[str, Number]
    """By spiking layer."""
    rates: dict[str, Number]
    """Spikes per neuron and step, by spiking layer."""
    events: Number
    """Input events."""
    n: Int
    """Windows that were counted."""
    footprint_bytes: Int | None = None
    """Of weights and potentials, in float32; these three are those of NeuroBench."""
    connection_sparsity: Number | None = None
    """Share of the weights that are 0."""
    activation_sparsity: Number | None = None
    """Share of the neurons and steps without a spike."""


class Baseline(Part):
    """Another method on the same windows as the network."""

    argmax: Number | None
    """Accuracy of the method."""
    low: Number | None
    high: Number | None
    network_ahead: Share
    """Accuracy of the network less that of the method, with the interval of the difference."""


class TrainedBaseline(Baseline):
    """A trained method that the network is compared with."""

    made: dict[str, Any]
    """Description of the fit, as text and numbers."""


class SampleCounts(Part):
    """Windows of each part of the split."""

    train: Int
    test: Int


class WindowIntervals(Part):
    """Accuracy, and precision and recall of incipient slip, with intervals over trials."""

    accuracy: Share
    incipient_precision: Share
    incipient_recall: Share


class WindowScores(Classification):
    """All figures of the test windows."""

    interval: Share
    """Strict accuracy."""
    reliability: tuple[LeadShare, ...]
    calibration: ProbabilityCalibration
    by_factor: dict[str, dict[str, Share]]
    """Strict accuracy by factor and level."""
    by_tenth: dict[str, tuple[Tenth, ...]]
    """Recall by class and tenth of its phase."""
    no_slip: NoSlip
    by_trial: tuple[TrialWindows, ...]
    """The worst first."""
    seeds: Seeds
    work: WindowWork | None
    """Null without windows."""
    baselines: dict[str, Number | None]
    """Accuracy of simple methods that are fitted at once."""
    beside: dict[str, Baseline]
    """The same, compared with the network."""
    samples: SampleCounts


class OtherWindowScores(Classification):
    """The test windows by a network that is not the store's own."""

    interval: Share
    """Strict accuracy."""
    window_intervals: WindowIntervals


class TrialLatency(Part):
    """One trial's detections against its label's onsets."""

    latency_incipient_ms: Number | None
    """Detection minus the label's onset; negative down to the tolerance where it came early; null
    where missed, false early or late."""
    latency_gross_ms: Number | None
    lead_ms: Number | None
    """True gross onset minus incipient detection, above zero; null where the incipient detection is
    not counted."""
    late_incipient_ms: Number | None
    """A late detection minus the event's end, zero or more; null where it is not late."""
    late_gross_ms: Number | None
    missed_incipient: Bool
    """There was no detection."""
    missed_gross: Bool
    false_early_incipient: Bool
    """The detection came before the label's onset by more than the tolerance."""
    false_early_gross: Bool

    @property
    def uncounted(self) -> tuple[int, int, int, int]:
        """Numbers, 0 or 1, against a choice's bounds: false early, then missed or late, by onset.

        Incipient slip comes before gross slip.
        """
        return (
            int(self.false_early_incipient),
            int(self.false_early_gross),
            int(self.missed_incipient or self.late_incipient_ms is not None),
            int(self.missed_gross or self.late_gross_ms is not None),
        )


class TrialScore(Part):
    """Onsets, detections and latency of one trial."""

    campaign: str
    experiment: str
    trial: str
    condition: dict[str, str]
    """Levels by factor, with their units."""
    incipient_ns: Int | None
    """By the label; null where it has none."""
    gross_ns: Int | None
    end_ns: Int | None
    """End of the slip; null where an onset is missing."""
    detected_incipient_ns: Int | None
    detected_gross_ns: Int | None
    latency: TrialLatency | None
    """Null where an onset is missing."""


class LatencyFigures(Part):
    """A latency or lead over trials, ms, of the detections that count.

    n, missed, late and false_early add up to the trials. In the median missed and late ones count,
    too: as infinitely late, and as no lead at all. It is null where it is one of these.
    """

    mean: Number | None
    std: Number | None
    """Sample standard deviation; null below two values."""
    median: Number | None
    p95: Number | None
    min: Number | None
    max: Number | None
    n: Int
    missed: Int
    late: Int
    """Detections at the event's end or after it."""
    false_early: Int


class LeadFigures(LatencyFigures):
    """Lead of incipient detections over gross onsets."""

    detected_first: Int
    """n, under the name that readers look for."""


class LatencyByOnset(Part):
    """Latency of either onset."""

    incipient: LatencyFigures
    gross: LatencyFigures


class SeedTimes(Part):
    """One trained network on the trials of one experiment, by the chosen one's rule."""

    seed: Int
    chosen: Bool
    latency_ms: LatencyByOnset
    lead_ms: LeadFigures


class ExperimentScores(Part):
    """The trials of one experiment."""

    trials: Int
    without_onsets: Int
    """Trials whose label lacks an onset; they are not in the figures."""
    latency_ms: LatencyByOnset
    lead_ms: LeadFigures
    by_seed: tuple[SeedTimes, ...] = ()
    """Every trained network on the same trials; written only where there are several."""


class SignedDeviation(Part):
    """Signed differences over trials, ms."""

    n: Int
    median: Number | None
    median_abs: Number | None
    max_abs: Number | None


class DeviationByOnset(Part):
    """Of either onset."""

    incipient: SignedDeviation
    gross: SignedDeviation


class LabelErrors(DeviationByOnset):
    """Ruling labels less what is true of their rule, over simulated trials."""

    rule: str
    """Rules, joined by `+`."""


class ChangePointCoverage(SignedDeviation):
    """Change points of all papillae less the truth."""

    coverage: Number | None
    """Share of the 95 % intervals that hold the truth."""


class RuleErrors(Part):
    """Both rules of labelling against the truth, and against each other."""

    paper: DeviationByOnset
    """The paper's rule less the true crossing."""
    change_point: DeviationByOnset
    """The change point less the true start of the slip."""
    apart: DeviationByOnset
    """The paper's rule less the change point."""
    papillae: ChangePointCoverage


class RuleChoice(Part):
    """Smoothing and margin chosen from a grid, and how they did on the trials that chose."""

    smoothing: Int
    """Windows."""
    margin: Number
    """Spikes."""
    split: str
    """The trials that chose: `validation` or `test`."""
    trials: Int
    allowed: Int
    """Trials that may be false early, for either onset; as many may be missed or late."""
    false_early: Int
    false_early_gross: Int
    missed: Int
    missed_gross: Int
    late: Int
    late_gross: Int
    median_ms: Number | None
    """Median incipient latency, a missed or late one infinite; null if so."""


class Rate(Part):
    """A share of trials with its exact interval."""

    value: Number
    low: Number
    high: Number


class AlarmRate(Part):
    """False alarms an hour without slip, with its 95 % interval over trials or worlds."""

    alarms: Int
    hours: Number
    value: Number
    low: Number | None
    """Null with one trial or world."""
    high: Number | None
    clusters: Int = 0
    """Trials or worlds that the interval is over; 0 in older results."""


class OnsetFigures(Part):
    """Decisions on trials by one reference onset, which need not be the label's."""

    trials: Int
    """Trials with both onsets by this reference."""
    lacking: Int
    """Trials without; they are in no other figure."""
    latency_ms: LatencyByOnset
    median_incipient_ms: tuple[Number | None, Number | None] | None
    """95 % interval of the median incipient latency; null where so few trials bound nothing, an end
    where it is infinite."""
    median_gross_ms: tuple[Number | None, Number | None] | None
    false_early_rate: Rate | None
    """Of incipient detections; null without trials."""
    early_by_paper: Int
    """Incipient detections that are false early by the paper's onset, in trials with both."""
    not_before: Int
    """Of these, the ones at this reference's onset or after it."""
    width_ms: Number | None
    """Median width of the incipient onset's 95 % interval; null where none is stated."""
    unsure: Int
    """Incipient detections that are false early by one end of that interval alone."""


class DetectorTrials(Part):
    """A detector over some trials."""

    false_early_before_ms: tuple[Number, ...]
    """By how much each false early detection came before its onset, ascending."""
    false_early_rate: Rate
    median_with_missed_ms: Number | None
    """Median incipient latency, a missed or late one infinite; null if so."""
    latency_ms: LatencyByOnset
    lead_ms: LeadFigures


class DetectorLevels(Part):
    """Evidence from which on a detector reports an onset; null: infinite."""

    incipient: Number | None
    gross: Number | None


class DetectorRate(Part):
    """A detector whose level allows so many false early validation trials."""

    asked: Number
    """Share of false early trials."""
    allowed: Int
    """The same in trials."""
    choice: Int
    """Chosen smoothing, windows; 0 if there is nothing to choose."""
    levels: DetectorLevels
    validation: DetectorTrials
    test: DetectorTrials
    by_reference: dict[str, OnsetFigures] = Field(default_factory=dict)
    """Test trials by `paper`, `change_point` and, only where simulated, `true`; empty in older
    evaluations."""


class CurvePoint(Part):
    """Test latency at one number of false early validation trials."""

    allowed: Int
    rate: Number
    median_ms: Number | None


class DetectorScores(Part):
    """One detector at one stride."""

    name: str
    stride_ms: Int
    rates: tuple[DetectorRate, ...]
    curve: tuple[CurvePoint, ...]


class PartTrials(Part):
    """Trials of each part of the split."""

    train: Int
    validation: Int
    test: Int


class DetectorComparison(Part):
    """All detectors at equal rates of false early detections."""

    trials: PartTrials
    strides_ms: tuple[Int, ...]
    detectors: tuple[DetectorScores, ...]
    carried: tuple[DetectorScores, ...] | None = None
    """The same by stateful inference; not written without it."""


Experiments = dict[str, ExperimentScores]
"""By `kinematic`, `gravity`, `disturbance`."""


class MarkerClassifier(Part):
    """The classifier of a store without events: it sees the displacement of markers in frames."""

    title: str
    frames: Int
    """Frames of a window, whose newest one has the class."""
    markers: Int
    points: Int
    """Points of a class that is certain; counts, leads and margins are in points, not spikes."""
    weights: Int
    """Weights and biases."""
    multiply_adds: Int
    """Of one window."""


class Evaluation(Document):
    """Results that `evaluate` keeps of the store's network."""

    key: str = ""
    """Of what made it."""
    format: tuple[Int, Int]
    """Versions of the step and of its windows."""
    seed: Int
    """Of the chosen network."""
    windows: WindowScores
    trials: tuple[TrialScore, ...]
    experiments: Experiments
    label_error_ms: LabelErrors
    label_rules_ms: RuleErrors
    reviewed: dict[str, Int] | None = None
    """Trials by the state of people's decisions; null where they are not applied."""
    detection: dict[str, Settings]
    """By campaign, with the chosen smoothing and margin."""
    choices: dict[str, RuleChoice | None]
    """By campaign; null where the protocol sets smoothing and margin."""
    detectors: DetectorComparison | None
    classifier: MarkerClassifier | None = None
    """Written only where there are no events: the network then sees marker displacements."""


class OtherEvaluation(Document):
    """Results that `evaluate` keeps of another network: of `analysis.also`, `--model`, or
    `--predictions`."""

    key: str = ""
    data_key: str | None = None
    """Of the test trials and their labels alone."""
    title: str
    """The network as text."""
    engine: str
    """Engine that counted its spikes: `fast`, `sinabs`, or `predictions` of another program."""
    exact: Bool
    """Both give the same counts by arithmetic."""
    preset: str | None
    seed: Int | None
    windows: OtherWindowScores
    trials: tuple[TrialScore, ...]
    experiments: Experiments
    detection: dict[str, Settings]


class BaselineResult(Document):
    """Results that `evaluate --baselines` keeps of one method; its votes are in another file."""

    key: str = ""
    argmax: Number | None
    made: dict[str, Any]
    """Description of the fit, as text and numbers."""


class LabelCheck(Document):
    """Labels from the drawn video of a simulated rig against the truth."""

    key: str = ""
    trials: Int
    simulated: Bool
    rules_ms: RuleErrors


class ExperimentLatency(Part):
    """Latencies over the test trials of an experiment."""

    trials: Int
    """Trials with both onsets."""
    latency_ms: LatencyByOnset


Latencies = dict[str, ExperimentLatency]
"""By experiment."""


class CountChange(Part):
    """Change of spike counts by quantisation."""

    windows: Int
    equal_counts: Number
    """Share of windows with equal counts."""
    equal_class: Number
    """Share with the same class: the same unique winner, or none."""
    equal_class_by_margin: Number
    mean_change: Number
    """Of a count."""
    largest_change: Int
