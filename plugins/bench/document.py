"""Results of the open bench of detectors."""

from __future__ import annotations

from sliplab.storage.schema.document import Bool, Document, Int, Number, Part
from sliplab.storage.schema.evaluation import AlarmRate


class MedianLatency(Part):
    """A median over slides, missed ones infinitely late, with its 95 % interval over worlds.

    None where it is infinite, or so few worlds bound nothing.
    """

    value: Number | None
    low: Number | None
    high: Number | None


class BenchScores(Part):
    """Alarms of a detector on some scenes, above one level of its evidence.

    Attributes:
        worlds: simulated rigs of the scenes, over which intervals are; 0 in older results.
        latency_ms: from when the first tip slid. latency_paper_ms: from the paper's 2-pixel onset,
            negative before it.
        missed: slides without an alarm before gross slip. early: those of them in which a false
            alarm lasted until the slip.
    """

    slides: Int
    worlds: Int = 0
    latency_ms: MedianLatency
    latency_paper_ms: MedianLatency
    missed: Int
    early: Int
    false_alarms: AlarmRate


class BenchPoint(Part):
    """A detector on test scenes at one asked rate of false alarms.

    Attributes:
        asked: false alarms an hour. allowed: those of all validation scenes at the level.
        level: None where nothing bounds it.
        promised: the upper end of the validation scenes' rate is at most `asked`, and the lower
            end of the test scenes' is not above it; None in older results.
    """

    asked: Number
    allowed: Int
    level: Number | None
    promised: Bool | None = None
    test: BenchScores


class BenchDetector(Part):
    """A detector of the table.

    Attributes:
        curve: over the asked rates; the first one is the table's.
        nuisances: scores at the table's level, by nuisance.
        disturbed: false alarms in all scenes with nuisances at that level; None in older results.
        accuracy: of decisions on test scenes, mean of the classes' recalls; None without classes.
        operations: of a decision, and memory_bytes of parameters, as the detector states them.
        decision_us: measured.
        train_s: seconds of training.
    """

    name: str
    curve: tuple[BenchPoint, ...]
    nuisances: dict[str, BenchScores]
    disturbed: AlarmRate | None = None
    accuracy: Number | None
    operations: Number | None
    memory_bytes: Int | None
    decision_us: Number
    train_s: Number

    @property
    def table(self) -> BenchPoint:
        """Return the point of the table."""
        return self.curve[0]


class KeptDetector(Document):
    """Stored result of a detector, so that a run resumes."""

    row: BenchDetector
    hours: dict[str, Number]
    alone: Bool


class LimitPoint(Part):
    """How soon Page's test on the slipping marker is certain, at so many false alarms an hour."""

    asked: Number
    latency_ms: MedianLatency


class BenchLimit(Document):
    """Page's test on the slipping marker in the test slides, see `plugins.bench.limit`."""

    slides: Int
    points: tuple[LimitPoint, ...]


class BenchResult(Document):
    """The whole table.

    Attributes:
        version: of the bench's scenes. size: which set of them. seed: of the test worlds.
        worlds: which set of effects; `usual` in older results.
        scenes: their number by part. hours: without slip, of validation and test scenes.
        detectors: the best first.
        limit: what Page's test on the slipping marker needs; None in older results.
        alone: detectors saw no process but their own; None in older results.
    """

    simulated: Bool
    version: Int
    size: str
    seed: Int
    worlds: str = "usual"
    scenes: dict[str, Int]
    hours: dict[str, Number]
    detectors: tuple[BenchDetector, ...]
    limit: BenchLimit | None = None
    alone: Bool | None = None

    @property
    def command(self) -> str:
        """Command that makes it."""
        small = " --small" if self.size == "small" else ""
        worlds = "" if self.worlds == "usual" else f" --worlds {self.worlds}"
        return f"sliplab bench{small}{worlds} --seed {self.seed}"
