"""`sliplab bench`: detectors on the scenes of the bench.

Each detector runs in a process of its own, which is given events chunk by chunk. All choices are
made by `prepare`, which has no test scene. A detector's figures are stored as soon as they are
complete, so that a stopped run of a given seed resumes with the next detector. A seed that is drawn
is in memory alone until the run ends: only detectors that could not be fitted to its worlds are
judged on them.
"""

from __future__ import annotations

import json
import secrets
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import closing
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
from sliplab.analysis.detectors.feeding import CHUNK_US, feed, steady
from sliplab.analysis.detectors.registry import contents, is_shipped, make_detector
from sliplab.flows.running import console, stopping
from sliplab.plugins.bench import scenes
from sliplab.plugins.bench.apart import ApartDetector, alone
from sliplab.plugins.bench.audit import FINE_US, audit, drawn_edges
from sliplab.plugins.bench.definition import SEEDS, SIZES, VERSION, WORLDS, Size
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

ENTRIES_VERSION = 4
"""Incremented when figures or intervals on the same scenes may differ, or rules are stricter."""
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
    detector: Detector, given: Sequence[Scene], advance: Advance, chunk_us: int = CHUNK_US
) -> list[SceneEvidence]:
    """Return a detector's evidence on scenes, whose events it is given in chunks of one length."""
    found = []
    for scene in given:
        evidence = feed(detector, scene, steady(scene, chunk_us))
        found.append(SceneEvidence(evidence, scene.slip, scene.world))
        advance()
    return found


def measure(
    name: str, prepared: Prepared, tests: Tests, seed: int, advance: Advance
) -> BenchDetector:
    """Return the figures of a detector on test scenes.

    Evidence counts as it answered to the shortest chunks, the first time that it saw a scene: none
    rests on what came later than `FINE_US`, whatever the detector remembers.

    Raises:
        DetectorError: its evidence is invalid, or rests on later events.
    """
    detector, levels = prepared.detector, prepared.levels
    slides = [scene for scene in tests.scenes if scene.end_us < LONG_US]
    detector.decisions_us.clear()
    found = judged(detector, slides, advance, FINE_US)
    decision_us = float(np.median(detector.decisions_us or [0.0]))
    found += judged(detector, tests.scenes[len(slides) :], advance, FINE_US)  # long holds
    disturbed = {
        nuisance: judged(detector, given, advance, FINE_US)
        for nuisance, given in tests.nuisances.items()
    }
    chosen = np.random.default_rng(seed).permutation(len(slides))[:AUDITED]
    for place in chosen.tolist():
        scene, expected = slides[place], found[place].evidence
        edges = drawn_edges(scene, hash_integer("chunks", seed, place))
        audit(detector, scene, edges, expected, [level.value for level in levels])
    cost = detector.cost()
    return BenchDetector(
        name=name,
        curve=tested(found, levels),
        nuisances=nuisance_scores(disturbed, levels[0].value),
        disturbed=disturbed_rate(disturbed, levels[0].value),
        accuracy=accuracy(found),
        operations=cost.operations,
        memory_bytes=cost.memory_bytes,
        decision_us=decision_us,
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
    return KeptDetector(row=row, hours=bench.hours, alone=bool(alone()))


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
    """Return what Page's test on the slipping marker needs, over the test slides."""
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


def _published_seed(folder: Path) -> int | None:
    """Return the seed that a folder's last run drew; None where none did.

    Raises:
        InputError: the file of the seed does not have one.
    """
    path = folder / SEED_FILE
    if not path.exists():
        return None
    found = read_json(path).get("seed")
    if type(found) is not int or not 0 <= found < SEEDS:
        raise InputError(str(path), "seed", found, f"must be a whole number from 0 to {SEEDS - 1}")
    return found


def _contents(name: str) -> object:
    """Return what changes with a detector's files; wrong input fails here, before all simulation.

    Nothing of a detector that does not ship runs in this process.
    """
    if is_shipped(name):
        make_detector(name).close()
        return contents(name)
    try:
        with closing(ApartDetector(name)) as detector:
            return detector.contents
    except DetectorError as error:
        raise InputError("DETECTOR", "", name, str(error)) from None


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
        seed: of the test worlds; None: that which the folder's last run drew if all have results
            with it, and else drawn, for all of them.
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
    if worlds not in WORLDS:
        raise InputError("--worlds", "", worlds, f"must be one of {', '.join(WORLDS)}")
    hashes = {name: _contents(name) for name in names}
    saved = Derived(folder / "detectors")

    def keys_of(seed: int) -> dict[str, str]:
        # the usual worlds keep the key that they had before there were others
        of_scenes = [ENTRIES_VERSION, size, seed, *([] if worlds == "usual" else [worlds])]
        return {name: make_key("bench", VERSION, [name, hashes[name]], of_scenes) for name in names}

    def kept(seed: int) -> dict[str, KeptDetector]:
        return {
            name: saved.load(key[:16], KeptDetector)
            for name, key in keys_of(seed).items()
            if saved.fresh(key[:16], key)
        }

    drawn = seed is None
    if seed is None:
        seed = _published_seed(folder)
        if seed is None or len(kept(seed)) < len(names):
            seed = secrets.randbelow(SEEDS)
    keys, found = keys_of(seed), kept(seed)

    def keep(one: KeptDetector) -> None:
        key = keys[one.row.name]
        saved.write(key[:16], key, one)
        found[one.row.name] = one  # not read again: a later detector may have changed the file

    try:
        missing = [name for name in names if name not in found]
        if missing:
            jobs = [DetectorJob(name, SIZES[size], seed, worlds) for name in missing]
            _judge_each(jobs, workers, keep)
    finally:
        if drawn:
            make_folder(folder)
            write_text(folder / SEED_FILE, json.dumps({"seed": seed}) + "\n")
    limit = Derived(folder / "limits")
    of_scenes = make_key("limit of the bench", VERSION, [worlds], [LIMIT_VERSION, size, seed])
    if not limit.fresh(of_scenes[:16], of_scenes):
        limit.write(of_scenes[:16], of_scenes, find_limit(SIZES[size], seed, worlds))
    rows = [found[name] for name in names]
    return BenchResult(
        simulated=True,
        version=VERSION,
        size=size,
        seed=seed,
        worlds=worlds,
        scenes=BenchScenes(SIZES[size], seed).counts,
        hours=rows[0].hours,
        alone=all(one.alone for one in rows),
        detectors=tuple(ranked([one.row for one in rows])),
        limit=limit.load(of_scenes[:16], BenchLimit),
    )
