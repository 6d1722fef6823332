"""`sliplab bench`: detectors on the scenes of the bench.

Each detector runs in a process of its own, which is given events chunk by chunk. All choices are
made by `prepare`, which has no test scene. A detector's figures are stored as soon as they are
complete, so that a stopped run resumes with the next detector.
"""

from __future__ import annotations

import json
import secrets
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from functools import cached_property, lru_cache
from multiprocessing import active_children
from pathlib import Path

import numpy as np

from sliplab.analysis.detectors.alarms import (
    Level,
    SceneEvidence,
    hours_without_slip,
    promised_levels,
)
from sliplab.analysis.detectors.detector import Detector, DetectorError, Evidence, Scene
from sliplab.analysis.detectors.feeding import feed
from sliplab.analysis.detectors.registry import contents, make_detector
from sliplab.flows.running import console, stopping
from sliplab.plugins.bench import scenes
from sliplab.plugins.bench.apart import ApartDetector
from sliplab.plugins.bench.audit import audit, drawn_edges
from sliplab.plugins.bench.definition import SIZES, VERSION, WORLDS, Size
from sliplab.plugins.bench.document import (
    BenchDetector,
    BenchLimit,
    BenchResult,
    KeptDetector,
    LimitPoint,
)
from sliplab.plugins.bench.figures import (
    RATES,
    accuracy,
    disturbed_rate,
    median_latency,
    nuisance_scores,
    ranked,
    tested,
)
from sliplab.plugins.bench.limit import waits_ms
from sliplab.plugins.bench.nuisances import NUISANCES
from sliplab.plugins.bench.scenes import LONG_US, SceneDraw
from sliplab.protocols.errors import InputError
from sliplab.protocols.hashing import hash_integer
from sliplab.storage.files import make_folder, read_json, write_text
from sliplab.storage.process import give_memory_back, out_of_reach
from sliplab.storage.spawn_context import WORKERS
from sliplab.storage.trials.derived import Derived, make_key

ENTRIES_VERSION = 3
"""Incremented when a shipped detector has other figures or intervals on the same scenes."""
LIMIT_VERSION = 1
AUDITED = 24
"""Slides of the test in which causality is checked."""
SEED_FILE = "seed.json"
Advance = Callable[[], None]


@dataclass(frozen=True)
class TrainingScenes:
    """Scenes that everybody knows: those that train, and those that choose."""

    train: Sequence[Scene]
    validation: Sequence[Scene]


@dataclass(frozen=True)
class Tests:
    """Scenes in worlds that the user's seed draws."""

    scenes: Sequence[Scene]
    nuisances: Mapping[str, Sequence[Scene]]


@dataclass(frozen=True)
class Prepared:
    """A trained detector with the levels of its evidence, chosen without test scenes."""

    detector: ApartDetector
    levels: list[Level]
    train_s: float


def prepare(detector: ApartDetector, training: TrainingScenes, advance: Advance) -> Prepared:
    """Train a detector, and set its levels on validation scenes.

    Args:
        advance: called after the training and after each scene.
    """
    start = time.perf_counter()
    detector.train(training.train, training.validation)
    train_s = time.perf_counter() - start
    advance()
    found = judged(detector, training.validation, advance)
    return Prepared(detector, promised_levels(found, RATES), train_s)


def judged(
    detector: Detector, given: Sequence[Scene], advance: Advance, seed: int | None = None
) -> list[SceneEvidence]:
    """Return a detector's evidence on scenes.

    Args:
        seed: draws the chunks in which events are given; without one each has a second.
    """
    found = []
    for place, scene in enumerate(given):
        edges = None if seed is None else drawn_edges(scene, hash_integer("chunks", seed, place))
        found.append(SceneEvidence(feed(detector, scene, edges), scene.slip, scene.world))
        advance()
    return found


def measure(
    name: str, prepared: Prepared, tests: Tests, seed: int, advance: Advance
) -> BenchDetector:
    """Return the figures of a detector on test scenes.

    Raises:
        DetectorError: its evidence is invalid, or rests on later events.
    """
    detector, levels = prepared.detector, prepared.levels
    found = judged(detector, tests.scenes, advance, seed)
    disturbed = {
        nuisance: judged(detector, given, advance, hash_integer(nuisance, seed))
        for nuisance, given in tests.nuisances.items()
    }
    slides = [place for place, scene in enumerate(tests.scenes) if scene.end_us < LONG_US]
    chosen = np.random.default_rng(seed).permutation(slides)[:AUDITED]
    detector.decisions_us.clear()
    for place in chosen.tolist():
        expected = found[place].evidence
        audit(detector, tests.scenes[place], expected, [level.value for level in levels])
    cost = detector.cost()
    return BenchDetector(
        name=name,
        curve=tested(found, levels),
        nuisances=nuisance_scores(disturbed, levels[0].value),
        disturbed=disturbed_rate(disturbed, levels[0].value),
        accuracy=accuracy(found),
        operations=cost.operations,
        memory_bytes=cost.memory_bytes,
        decision_us=float(np.median(detector.decisions_us or [0.0])),
        train_s=prepared.train_s,
    )


@dataclass
class BenchScenes:
    """The scenes of one size and seed, simulated when they are first needed.

    Attributes:
        worlds: one of `WORLDS`.
        advance: called after each simulated scene.
    """

    size: Size
    seed: int
    worlds: str = "usual"
    advance: Advance = lambda: None

    @property
    def count(self) -> int:
        """Number of all scenes."""
        return sum(self.counts.values())

    @property
    def counts(self) -> dict[str, int]:
        """Number of scenes by part."""
        parts = {name: getattr(self.size, name) for name in ("train", "validation", "test")}
        found = {name: part.worlds * part.slides + part.holds for name, part in parts.items()}
        return {**found, "nuisances": self.size.nuisance * len(NUISANCES)}

    @cached_property
    def training(self) -> TrainingScenes:
        """Scenes that train and choose."""
        train, validation = scenes.training_scenes(self.size, self.worlds)
        return TrainingScenes(self._simulated(train), self._simulated(validation))

    @cached_property
    def tests(self) -> Tests:
        """Test scenes."""
        nuisances = scenes.nuisance_scenes(self.size, self.seed, self.worlds)
        return Tests(
            self._simulated(scenes.test_scenes(self.size, self.seed, self.worlds)),
            {name: self._simulated(drawn) for name, drawn in nuisances.items()},
        )

    @property
    def fed(self) -> int:
        """Number of scenes that a detector is fed, and one for its training."""
        return self.count - self.counts["train"] + 1

    @property
    def hours(self) -> dict[str, float]:
        """Hours without slip of the validation and test scenes."""
        none = Evidence.of([], [])
        return {
            name: hours_without_slip([SceneEvidence(none, scene.slip) for scene in part])
            for name, part in (
                ("validation", self.training.validation),
                ("test", self.tests.scenes),
            )
        }

    def _simulated(self, drawn: Sequence[SceneDraw]) -> list[Scene]:
        found = []
        for one in drawn:
            found.append(scenes.simulated(one))
            # it lies between the events of retained scenes: 15 MB a scene, 11 GB in the full set
            give_memory_back()
            self.advance()
        return found


@dataclass(frozen=True)
class DetectorJob:
    """A detector to evaluate."""

    name: str
    size: Size
    seed: int
    worlds: str = "usual"


@lru_cache(maxsize=1)
def _bench(size: Size, seed: int, worlds: str) -> BenchScenes:
    """Return the scenes; a process simulates them once."""
    return BenchScenes(size, seed, worlds)


def _judge(job: DetectorJob, advance: Advance | None = None) -> KeptDetector:
    """Evaluate a detector, in a process beside this one.

    Raises:
        InputError: it breaks the rules of the bench.
    """
    bench = _bench(job.size, job.seed, job.worlds)
    bench.advance = advance or (lambda: None)
    detector = None
    try:
        detector = ApartDetector(job.name)
        prepared = prepare(detector, bench.training, bench.advance)
        row = measure(job.name, prepared, bench.tests, job.seed, bench.advance)
    except DetectorError as error:
        raise InputError("DETECTOR", "", job.name, str(error)) from None
    finally:
        if detector is not None:
            detector.close()
    return KeptDetector(row=row, hours=bench.hours)


def _judge_each(
    jobs: Sequence[DetectorJob], workers: int, done: Callable[[KeptDetector], None]
) -> None:
    """Evaluate detectors, several at once in separate processes.

    Args:
        done: called with each as soon as it is complete.
    """
    if min(workers, len(jobs)) < 2:
        scenes_of = _bench(jobs[0].size, jobs[0].seed, jobs[0].worlds)
        total = scenes_of.count + len(jobs) * scenes_of.fed
        with console.bar("bench (scenes, simulated)", total) as bar:
            for job in jobs:
                done(_judge(job, bar.advance))
        return
    with (
        console.bar("bench (detectors, simulated)", len(jobs)) as bar,
        ProcessPoolExecutor(min(workers, len(jobs)), WORKERS, stopping.leave_to_parent) as pool,
    ):
        try:
            with out_of_reach():
                futures = [pool.submit(_judge, job) for job in jobs]
            for judged_one in as_completed(futures):
                found = judged_one.result()
                done(found)
                bar.advance(1, found.row.name)
        except BaseException:
            for worker in active_children():
                worker.terminate()  # what it had not returned is made again
            raise


def find_limit(size: Size, seed: int, worlds: str = "usual") -> BenchLimit:
    """Return what an observer that knows the scenes would need, over the test slides."""
    drawn = [it for it in scenes.test_scenes(size, seed, worlds) if it.hold_s * 1e6 < LONG_US]
    waits = []
    with console.bar("limit (slides, simulated)", len(drawn)) as bar:
        for slide in drawn:
            waits.append(waits_ms(slide, RATES))
            bar.advance()
    names = [slide.world for slide in drawn]
    return BenchLimit(
        slides=len(drawn),
        points=tuple(
            LimitPoint(asked=asked, latency_ms=median_latency(late, names))
            for asked, late in zip(RATES, zip(*waits, strict=True), strict=True)
        ),
    )


def _drawn_seed(folder: Path) -> int:
    """Return the seed of a folder's test worlds, which is drawn once.

    Raises:
        InputError: the file of the seed does not have one.
    """
    path = folder / SEED_FILE
    if not path.exists():
        make_folder(folder)
        write_text(path, json.dumps({"seed": secrets.randbelow(2**31)}) + "\n")
    found = read_json(path).get("seed")
    if not isinstance(found, int):
        raise InputError(str(path), "seed", found, "must be a whole number")
    return found


def run_bench(
    names: Sequence[str],
    size: str,
    seed: int | None,
    folder: Path,
    workers: int = 1,
    worlds: str = "usual",
) -> BenchResult:
    """Evaluate detectors without a result; return the table of all that are named.

    Args:
        names: of detectors, see `registry`. size: one of `SIZES`.
        seed: of the test worlds; None: that of the folder, and drawn where it has none.
        folder: keeps what a detector gave.
        workers: processes at the most; each simulates the scenes for itself.
        worlds: one of `WORLDS`.

    Raises:
        InputError: there are no such worlds or detector, it breaks the rules, or `folder` is a
            file.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError("--folder", "", str(folder), "must be a folder")
    twice = next((name for name in names if list(names).count(name) > 1), None)
    if twice is not None:
        raise InputError("DETECTOR", "", twice, "must be named once")
    for name in names:
        make_detector(name).close()  # wrong input fails before anything is simulated
    if worlds not in WORLDS:
        raise InputError("--worlds", "", worlds, f"must be one of {', '.join(WORLDS)}")
    saved = Derived(folder / "detectors")
    if seed is None:
        seed = _drawn_seed(folder)
    # the usual worlds keep the key that they had before there were others
    scene_key = [ENTRIES_VERSION, size, seed, *([] if worlds == "usual" else [worlds])]
    keys = {name: make_key("bench", VERSION, [name, contents(name)], scene_key) for name in names}

    def keep(found: KeptDetector) -> None:
        key = keys[found.row.name]
        saved.write(key[:16], key, found)

    missing = [name for name, key in keys.items() if not saved.fresh(key[:16], key)]
    if missing:
        jobs = [DetectorJob(name, SIZES[size], seed, worlds) for name in missing]
        _judge_each(jobs, workers, keep)
    limit = Derived(folder / "limits")
    of_scenes = make_key("limit of the bench", VERSION, [worlds], [LIMIT_VERSION, size, seed])
    if not limit.fresh(of_scenes[:16], of_scenes):
        limit.write(of_scenes[:16], of_scenes, find_limit(SIZES[size], seed, worlds))
    found = [saved.load(key[:16], KeptDetector) for key in keys.values()]
    return BenchResult(
        simulated=True,
        version=VERSION,
        size=size,
        seed=seed,
        worlds=worlds,
        scenes=BenchScenes(SIZES[size], seed).counts,
        hours=found[0].hours,
        detectors=tuple(ranked([one.row for one in found])),
        limit=limit.load(of_scenes[:16], BenchLimit),
    )
