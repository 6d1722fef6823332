"""The bench from detectors' names to its table, on a few scenes."""

from __future__ import annotations

import json
import pickle
import struct
import sys
from collections.abc import Callable, Sequence
from contextlib import closing, nullcontext
from pathlib import Path

import pytest

from sliplab.analysis.detectors.alarms import Level
from sliplab.analysis.detectors.detector import DetectorError, Scene
from sliplab.plugins.bench import run, scenes
from sliplab.plugins.bench.apart import ApartDetector, alone, decoded
from sliplab.plugins.bench.definition import SIZES, ScenePart, Size
from sliplab.plugins.bench.document import BenchResult
from sliplab.plugins.bench.entries.thresholds import EventRate
from sliplab.plugins.bench.nuisances import NUISANCES
from sliplab.protocols.errors import InputError
from sliplab.storage.schema.evaluation import AlarmRate
from tests.command_line import here
from tests.patching import loose
from tests.plugins.bench.made import InThisProcess, some_scenes

TINY = Size(ScenePart(1, 2, 0), ScenePart(1, 3, 0), ScenePart(2, 2, 0), 1)
NAMES = ("rate", "always", "random")
FEW = NUISANCES[:2]
"""Each has its scenes: see `test_scenes`."""


@pytest.fixture(scope="module")
def simulated() -> Callable[[scenes.SceneDraw], Scene]:
    """Simulate each scene once for all tests."""
    found: dict[tuple[str, int], Scene] = {}
    simulate = scenes.simulated

    def once(drawn: scenes.SceneDraw) -> Scene:
        key = drawn.name, drawn.seed
        if key not in found:
            found[key] = simulate(drawn)
        return found[key]

    return once


@pytest.fixture
def apart(monkeypatch: pytest.MonkeyPatch) -> None:
    """Run detectors in processes of their own, as the bench does."""
    monkeypatch.setattr(run, "ApartDetector", ApartDetector)


@pytest.fixture(autouse=True)
def tiny(monkeypatch: pytest.MonkeyPatch, simulated: Callable[[scenes.SceneDraw], Scene]) -> None:
    monkeypatch.setitem(SIZES, "small", TINY)
    monkeypatch.setattr(scenes, "simulated", simulated)
    for module in (run, scenes):
        monkeypatch.setattr(module, "NUISANCES", FEW)
    monkeypatch.setattr(run, "ApartDetector", InThisProcess)
    run._bench.cache_clear()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("bench")


def choices(found: BenchResult) -> dict[str, list[tuple[float, int, float | None]]]:
    """All that was chosen, by detector."""
    return {
        row.name: [(point.asked, point.allowed, point.level) for point in row.curve]
        for row in found.detectors
    }


def test_worlds_that_do_not_exist_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="must be one of usual, creep, stick-slip"):
        run.run_bench(["rate"], "small", 1, tmp_path, worlds="harder")


@pytest.mark.long
def test_other_test_worlds_change_figures_and_no_choice(folder: Path) -> None:
    one, other = (run.run_bench(NAMES, "small", seed, folder) for seed in (1, 2))
    assert choices(one) == choices(other)
    figures = [
        {row.name: row.table.test.to_json() for row in found.detectors} for found in (one, other)
    ]
    assert figures[0]["rate"] != figures[1]["rate"]
    assert one.hours["validation"] == other.hours["validation"]
    assert one.hours["test"] != other.hours["test"]


@pytest.mark.long
def test_choices_are_made_before_a_test_scene_is_there(
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    simulated: Callable[[scenes.SceneDraw], Scene],
) -> None:
    done: list[str] = []
    promised_levels = run.promised_levels

    def simulate(drawn: scenes.SceneDraw) -> Scene:
        done.append(drawn.name.split()[0])
        return simulated(drawn)

    def choose(*args: object) -> object:
        done.append("chosen")
        return loose(promised_levels)(*args)

    monkeypatch.setattr(scenes, "simulated", simulate)
    monkeypatch.setattr(run, "promised_levels", choose)
    run.run_bench(["rate"], "small", 1, tmp_path)
    assert done[: done.index("chosen")] == ["train"] * 2 + ["validation"] * 3
    assert set(done[done.index("chosen") + 1 :]) == {"test", *FEW}


@pytest.mark.long
def test_a_detector_is_trained_on_training_and_validation_scenes(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    seen: list[list[str]] = []

    def train(self: EventRate, given: Sequence[Scene], validation: Sequence[Scene]) -> None:
        seen.extend([one.name for one in part] for part in (given, validation))

    monkeypatch.setattr(EventRate, "train", train)
    run.run_bench(["rate"], "small", 1, tmp_path)
    assert seen == [
        ["train 1.1", "train 1.2"],
        ["validation 1.1", "validation 1.2", "validation 1.3"],
    ]


def test_a_stopped_run_resumes_with_the_next_detector(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def stopped(self: EventRate, *_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(EventRate, "train", stopped)
        with pytest.raises(KeyboardInterrupt):
            run.run_bench(["always", "rate", "never"], "small", 1, tmp_path)
    trained: list[str] = []
    prepare = run.prepare

    def prepared(detector: InThisProcess, *rest: object) -> object:
        trained.append(type(detector.detector).__name__)
        return loose(prepare)(detector, *rest)

    monkeypatch.setattr(run, "prepare", prepared)
    found = run.run_bench(["always", "rate", "never"], "small", 1, tmp_path)
    assert trained == ["EventRate", "Never"]
    assert {row.name for row in found.detectors} == {"always", "rate", "never"}


@pytest.mark.long
@pytest.mark.usefixtures("apart")
def test_processes_give_the_figures_of_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (run, scenes):  # what is left out here is not left out in other processes
        monkeypatch.setattr(module, "NUISANCES", NUISANCES)
    one = run.run_bench(NAMES, "small", 1, tmp_path / "one")
    several = run.run_bench(NAMES, "small", 1, tmp_path / "several", workers=2)
    timed = {"decision_us": 0.0, "train_s": 0.0}
    rows, others = (
        [row.model_copy(update=timed) for row in found.detectors] for found in (one, several)
    )
    assert rows == others


def test_the_command_prints_what_it_writes(folder: Path) -> None:
    run.run_bench(NAMES, "small", 1, folder)  # in this process, where scenes are few
    words = ("bench", *NAMES, "--small", "--seed", 1, "--folder", folder)
    done = here(*words, "--json")
    assert done.returncode == 0, done.stderr
    data = json.loads(done.stdout)
    assert data.pop("page") == str(folder / "bench.html")
    assert data == json.loads((folder / "bench.json").read_text())
    assert data["simulated"] is True
    assert "simulated" in (folder / "bench.svg").read_text()
    page = (folder / "bench.html").read_text()
    assert all(
        text in page for text in ("simulated", "over 2 test worlds", "<svg", "decision (us)")
    )
    shown = here(*words)
    assert "bench 2, small, seed 1, usual worlds (simulated)" in shown.stdout
    said = " ".join(shown.stderr.split())
    assert "over 2 test worlds and 2 with nuisances; below 24 trials or worlds, here 2" in said
    for row in data["detectors"]:
        assert row["curve"][0]["test"]["worlds"] == 2
        assert row["disturbed"]["clusters"] == len(FEW)


def test_the_leaderboard_is_written_between_its_lines(folder: Path, tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(
        "# Bench\n\n<!-- bench: written by `sliplab bench` -->\nold\n<!-- bench: end -->\n\nafter\n"
    )
    run.run_bench(NAMES, "small", 1, folder)
    for _ in range(2):
        words = ("bench", *NAMES, "--small", "--seed", 1, "--folder", folder, "--leaderboard", page)
        assert here(*words).returncode == 0
    text = page.read_text()
    assert text.startswith("# Bench\n\n<!--")
    assert text.endswith("<!-- bench: end -->\n\nafter\n")
    assert text.count("| rate |") == 2
    assert "old" not in text
    assert "**simulated**" in text
    assert (tmp_path / "images" / "bench.svg").exists()


@pytest.mark.usefixtures("apart")
@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("rat",), "DETECTOR = rat: must be one of paper, ours"),
        (("rat",), "did you mean 'rate'?"),
        (("rate", "rate"), "DETECTOR = rate: must be named once"),
        (("no_such_module:Thing",), "no module no_such_module to import"),
        (("json:nothing",), "cannot be made: AttributeError"),
        (("collections:Counter",), "is a Counter, not a"),
        (("rate", "--leaderboard", "nowhere.md"), "nowhere.md"),
    ],
)
def test_wrong_input_is_said_before_anything_is_simulated(
    words: tuple[str, ...], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    done = here("bench", *words, "--small", "--folder", tmp_path / "f")
    assert done.returncode == 2
    assert said in done.stderr.replace("\n", " ")
    assert not (tmp_path / "f").exists()


@pytest.mark.usefixtures("apart")
def test_a_detector_that_breaks_the_rules_is_named(tmp_path: Path) -> None:
    name = "tests.plugins.bench.made:Broken"
    expected = rf"DETECTOR = {name}: validation 1.1: push returned int"
    with pytest.raises(InputError, match=expected):
        run.run_bench([name], "small", 1, tmp_path)


def test_a_detector_that_ships_elsewhere_is_not_imported_by_the_judge(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "entry_of_a_guest.py").write_text(
        "from tests.plugins.bench.made import Counting as Mine\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(run, "ApartDetector", ApartDetector)
    before = run._contents("entry_of_a_guest:Mine")
    assert "entry_of_a_guest" not in sys.modules
    with (tmp_path / "entry_of_a_guest.py").open("a") as file:
        file.write("# changed\n")
    assert run._contents("entry_of_a_guest:Mine") != before


@pytest.mark.parametrize("dishonest", [False, True])
def test_evidence_dated_back_gains_nothing_though_a_scene_is_remembered(dishonest: bool) -> None:
    detector = InThisProcess(f"tests.plugins.bench.made:{'Remembers' if dishonest else 'Late'}")
    none = Level(
        1.0, 15.0, AlarmRate(alarms=0, hours=1.0, value=0.0, low=None, high=None), promised=True
    )
    prepared = run.Prepared(loose(detector), [none], 0.0)
    row = run.measure("mine", prepared, run.Tests(some_scenes(3), {}), 1, lambda: None)
    assert row.table.test.early == 0
    assert row.table.test.latency_ms.value == pytest.approx(60.0, abs=5.0)


@pytest.mark.long
@pytest.mark.usefixtures("apart")
def test_a_detector_has_nothing_but_what_it_was_given(tmp_path: Path) -> None:
    name = "tests.plugins.bench.made:Snoops"
    row = run.run_bench([name], "small", 1, tmp_path).detectors[0]
    assert row.operations == 0, "no scene after its training, and no seed"
    assert row.decision_us > 0


@pytest.mark.long
def test_a_seed_is_drawn_once_for_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    one, two = tmp_path / "one", tmp_path / "two"
    drawn = iter((1, 2, 1))  # whose scenes have been simulated
    monkeypatch.setattr(run.secrets, "randbelow", lambda _: next(drawn))
    seeds = [run.run_bench(["always"], "small", None, at).seed for at in (one, one, two)]
    assert seeds == [1, 1, 2]
    found = run.run_bench(["always", "never"], "small", None, two)
    assert found.seed == 1, "one that was published is no test of what had no result with it"


@pytest.mark.parametrize("stop", [False, True])
def test_a_drawn_seed_is_published_when_the_judging_ends(
    stop: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seed = 1  # whose scenes have been simulated
    monkeypatch.setattr(run.secrets, "randbelow", lambda _: seed)
    judging: list[bool] = []

    def train(*_: object) -> None:
        judging.append((tmp_path / run.SEED_FILE).exists())
        if stop:
            raise KeyboardInterrupt

    monkeypatch.setattr(EventRate, "train", train)
    with pytest.raises(KeyboardInterrupt) if stop else nullcontext():
        run.run_bench(["rate"], "small", None, tmp_path)
    assert judging == [False]
    assert json.loads((tmp_path / run.SEED_FILE).read_text()) == {"seed": seed}


@pytest.mark.parametrize("seed", ['"x"', "-5", "true", "1.5", "99999999999999999999", "null"])
def test_a_seed_that_is_none_is_refused(seed: str, tmp_path: Path) -> None:
    (tmp_path / run.SEED_FILE).write_text(f'{{"seed": {seed}}}')
    with pytest.raises(InputError, match="must be a whole number from 0 to"):
        run.run_bench(["always"], "small", None, tmp_path)


@pytest.mark.parametrize(
    "data", [b"", b"?", b"e", b"e" + bytes(9), b"j{", pickle.dumps((True, None))], ids=repr
)
def test_an_answer_that_is_none_is_refused(data: bytes) -> None:
    with pytest.raises((ValueError, struct.error)):
        decoded(data)


@pytest.mark.parametrize(
    ("detector", "expected"), [("Neighbours", 1.0), ("Counting", None), ("Strange", DetectorError)]
)
def test_a_detector_states_its_cost_from_a_process_alone(
    detector: str, expected: float | type[DetectorError] | None
) -> None:
    if detector == "Neighbours" and not alone():
        pytest.skip("this system has no namespaces for a user")
    with closing(ApartDetector(f"tests.plugins.bench.made:{detector}")) as found:
        if isinstance(expected, type):
            with pytest.raises(expected, match="cost = "):
                found.cost()
        else:
            assert found.cost().operations == expected
