"""Entries of the bench on scenes made by hand: files, programs, and what ships."""

from __future__ import annotations

import os
import sys
import time
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy.special import softmax

from sliplab.analysis.detectors.detector import DetectorError, Scene
from sliplab.analysis.detectors.detectors import Predictions
from sliplab.analysis.detectors.feeding import feed
from sliplab.analysis.detectors.registry import contents, known, make_detector
from sliplab.analysis.detectors.smoothing_rule import detect
from sliplab.analysis.metrics.classification import INCIPIENT
from sliplab.analysis.windows.sparse import SparseWindows
from sliplab.plugins.bench.audit import audit, drawn_edges
from sliplab.plugins.bench.entries.hyperdimensional import Hyperdimensional
from sliplab.plugins.bench.entries.network import PaperEntry
from sliplab.plugins.bench.entries.onnx_model import OnnxModel
from sliplab.plugins.bench.entries.program import ANSWER, MOST, ExternalProcess
from sliplab.plugins.bench.entries.thresholds import Fall, motions
from sliplab.plugins.bench.entries.trivial import Random
from sliplab.plugins.bench.windowed import MeanOdds
from sliplab.protocols.errors import InputError
from tests.conftest import ROOT
from tests.plugins.bench.made import Counting, scene, some_scenes


@pytest.fixture(scope="module")
def one() -> Scene:
    return scene(np.random.default_rng(1), 2.0)


def program(folder: Path, text: str) -> str:
    """A command that runs a Python program."""
    file = folder / "detector.py"
    file.write_text(text)
    return f"{sys.executable} {file}"


def test_a_program_gives_the_evidence_of_the_same_detector_in_python(one: Scene) -> None:
    detector = ExternalProcess(f"{sys.executable} {ROOT / 'examples/bench/rate.py'}")
    try:
        for _ in range(2):  # a scene does not depend on the one before
            expected, found = feed(Counting(), one), feed(detector, one)
            assert np.array_equal(found.t_us, expected.t_us)
            assert np.array_equal(found.value, expected.value)
        audit(detector, one, drawn_edges(one, 1), feed(detector, one), [1.0])
    finally:
        detector.close()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("import time; time.sleep(600)", "has not answered in 0.5 s, and was killed"),
        ("import sys; sys.exit('no model here')", "ended with exit code 1: no model here"),
        (
            "import sys; sys.stdout.buffer.write(b'x' * 16); sys.stdout.flush(); sys.stdin.read()",
            "answered b'xxxx'",
        ),
    ],
)
def test_a_program_that_fails_is_ended_and_says_why(
    text: str, said: str, one: Scene, tmp_path: Path
) -> None:
    answer_s = 0.5 if "sleep" in text else 30.0  # it takes a while to start
    detector = ExternalProcess(program(tmp_path, text), answer_s=answer_s, end_s=0.5)
    with pytest.raises(DetectorError, match=said):
        feed(detector, one)
    detector.close()
    assert detector._process.poll() is not None


def test_a_program_that_writes_before_it_reads_blocks_nobody(one: Scene, tmp_path: Path) -> None:
    text = "import sys; sys.stdout.buffer.write(bytes(10**6)); sys.stdout.flush(); sys.stdin.read()"
    detector = ExternalProcess(program(tmp_path, text), answer_s=30.0, end_s=0.5)
    with pytest.raises(DetectorError, match="answered"):
        feed(detector, one)
    detector.close()


ANSWERS = """
import os, struct, subprocess, sys
{before}
while head := sys.stdin.buffer.read(16):
    kind, n, value = struct.unpack("<4sIq", head)
    if kind == b"EVTS":
        sys.stdin.buffer.read(16 * n)
        sys.stdout.buffer.write(struct.pack("<4sIq", b"EVID", 1, 0))
        sys.stdout.buffer.write(struct.pack("<qdii", value, {value}, -1, 0))
        sys.stdout.flush()
"""


@pytest.mark.parametrize("value", ["float('nan')", "float('inf')"])
def test_a_program_whose_evidence_is_no_number_is_refused(
    value: str, one: Scene, tmp_path: Path
) -> None:
    text = ANSWERS.format(before="", value=value)
    detector = ExternalProcess(program(tmp_path, text), answer_s=30.0)
    with pytest.raises(DetectorError, match="must be finite or -inf"):
        feed(detector, one)
    detector.close()


@pytest.mark.parametrize("own_session", [False, True])
def test_children_of_a_program_end_with_it(own_session: bool, one: Scene, tmp_path: Path) -> None:
    pids = tmp_path / "pid"
    before = (
        "child = subprocess.Popen([sys.executable, '-c', 'import signal; signal.pause()'], "
        f"start_new_session={own_session})\n"
        f"open({str(pids)!r}, 'w').write(str(child.pid))"
    )
    detector = ExternalProcess(
        program(tmp_path, ANSWERS.format(before=before, value="1.0")), 30.0, 5.0
    )
    feed(detector, one)
    child = int(pids.read_text())
    os.kill(child, 0)
    detector.close()
    until_s = time.monotonic() + 30.0
    while alive(child):
        assert time.monotonic() < until_s


def alive(pid: int) -> bool:
    """Whether a process runs: one that has ended may still be there to be reaped."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.quick(1)
@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("import os\nwhile True: os.write(1, bytes(65536))", "writes without end|answered b"),
        ("import os\nwhile True: os.write(2, bytes(65536))", "has not answered in 2 s"),
    ],
    ids=["output", "errors"],
)
def test_a_program_that_floods_its_output_is_bounded(
    text: str, said: str, one: Scene, tmp_path: Path
) -> None:
    detector = ExternalProcess(program(tmp_path, text), answer_s=2.0, end_s=0.2)
    with pytest.raises(DetectorError, match=said):
        feed(detector, one)
    assert len(detector._read) <= MOST * ANSWER.itemsize + (1 << 17)
    assert len(detector._last_errors) <= 1 << 16
    detector.close()


@pytest.mark.parametrize("command", ["/nowhere/detector", ""])
def test_a_program_that_is_not_there_is_named(command: str) -> None:
    with pytest.raises(InputError, match="run:"):
        make_detector(f"run:{command}")


def onnx_file(path: Path, columns: int, shape: list[object], **metadata: str) -> str:
    """A network whose votes are the window's events, for slip."""
    from onnx import TensorProto, helper, numpy_helper, save

    votes = np.zeros((1, columns), np.float32)
    votes[0, columns // 2] = 0.01
    graph = helper.make_graph(
        [
            helper.make_node("Cast", ["x"], ["floats"], to=TensorProto.FLOAT),
            helper.make_node("Flatten", ["floats"], ["flat"]),
            helper.make_node("ReduceSum", ["flat", "axis"], ["sum"]),
            helper.make_node("MatMul", ["sum", "votes"], ["y"]),
        ],
        "counting",
        [helper.make_tensor_value_info("x", TensorProto.UINT8, shape)],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, ["n", columns])],
        [
            numpy_helper.from_array(votes, "votes"),
            numpy_helper.from_array(np.array([1], np.int64), "axis"),
        ],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)])
    model.ir_version = 8
    helper.set_model_props(model, metadata)
    save(model, str(path))
    return str(path)


def test_an_onnx_file_of_one_output_gives_evidence(one: Scene, tmp_path: Path) -> None:
    file = onnx_file(
        tmp_path / "e.onnx", 1, ["n", 10, 2, 4, 4], step_ms="2", crop_px="480", stride_ms="20"
    )
    detector = make_detector(file)
    found = feed(detector, one)
    assert found.t_us[:2].tolist() == [20_000, 40_000]
    edges = np.arange(0, one.end_us, 20_000)
    inside = (one.events.x >= 80) & (one.events.x < 560)
    counts = np.histogram(one.events.t_us[inside], edges)[0]
    assert found.value[: len(counts)] == pytest.approx(0.01 * counts)
    assert set(found.label.tolist()) == {-1}
    assert detector.cost().memory_bytes == 4 + 8


def test_an_onnx_file_of_three_outputs_gives_classes(one: Scene, tmp_path: Path) -> None:
    detector = OnnxModel(onnx_file(tmp_path / "c.onnx", 3, ["n", 30, 1, 20, 20], gain="100"))
    found = audit(detector, one, drawn_edges(one, 1), feed(detector, one), [0.0])
    assert found.t_us[:2].tolist() == [30_000, 40_000]
    after = found.t_us > one.slip.physical_us + 100_000
    assert found.value[after].min() > found.value[~after].max() - 1.0
    assert (found.label[after] == 1).all()


@pytest.mark.parametrize(
    ("shape", "metadata", "said"),
    [
        (["n", 30, 3, 20, 20], {}, "must have 1 or 2 channels"),
        (["n", 30, 1, 20, 10], {}, "as many rows as columns"),
        (["n", 30, 1, 21, 21], {}, "which divide 400"),
        (["n", 30, 1, "rows", 20], {}, "must be uint8"),
        (["n", 30, 1, 20, 20], {"stride_ms": "often"}, "stride_ms = often: must be a number"),
        (["n", 30, 1, 20, 20], {"gain": "-1"}, "must be positive"),
    ],
)
def test_another_onnx_file_is_refused(
    shape: list[object], metadata: dict[str, str], said: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=said):
        OnnxModel(onnx_file(tmp_path / "m.onnx", 3, shape, **metadata))


def test_what_is_no_onnx_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        make_detector(str(tmp_path / "m.onnx"))
    (tmp_path / "m.onnx").write_text("no model")
    with pytest.raises(InputError, match="cannot be run"):
        make_detector(str(tmp_path / "m.onnx"))


def test_what_a_name_means_is_hashed(tmp_path: Path) -> None:
    command = program(tmp_path, "1")
    before = contents(f"run:{command}")
    program(tmp_path, "2")
    after = contents(f"run:{command}")
    assert len(before) == len(after) == 2
    assert before[0] == after[0], "the interpreter"
    assert before[1] != after[1]
    assert contents("rate") == contents("flow") != contents("cnn")


def test_shipped_detectors_can_be_made() -> None:
    for name in known():
        make_detector(name).begin(640, 480)


def test_random_is_neither_the_same_in_each_scene_nor_biased(one: Scene) -> None:
    first, second = (feed(Random(), it).value for it in (one, some_scenes(4)[0]))
    n = min(len(first), len(second))
    assert abs(np.corrcoef(first[:n], second[:n])[0, 1]) < 0.2
    assert abs(np.corrcoef(first[1:], first[:-1])[0, 1]) < 0.2
    assert first.mean() == pytest.approx(0.5, abs=0.1)


def test_a_fall_is_the_drop_of_a_mean_below_its_largest_of_half_a_second(one: Scene) -> None:
    class Step(Fall):
        """80 events a window for a second, then 16."""

        def measured(self, x: SparseWindows) -> np.ndarray:
            self.number = getattr(self, "number", 0) + len(x)
            number = np.arange(self.number - len(x), self.number)
            return np.where(number < 100, 80.0, 16.0)

    found = feed(Step(), one).value
    assert found[50:100] == pytest.approx(0)
    assert found[100:108] == pytest.approx(8.0 * np.arange(1, 9))
    assert found[108:148] == pytest.approx(64)
    assert found[160:] == pytest.approx(0)


def test_motion_points_from_darker_to_brighter_events() -> None:
    dense = np.zeros((1, 2, 2, 20, 20), np.uint8)
    dense[0, 0, 0, 5, 4], dense[0, 1, 1, 5, 8] = 3, 2
    assert not motions(SparseWindows.of(dense)).any(), "patches of one polarity show no motion"
    dense[0, 1, 1, 5, 6] = 2
    found = motions(SparseWindows.of(dense))[0]
    (patch,) = np.flatnonzero(found.any(axis=1))
    assert patch == 6, "rows 4 to 7, columns 4 to 7"
    assert found[patch].tolist() == [0.0, 2 * 2.0], "two columns, times the fewer events"


def test_hyperdimensional_prototypes_have_384_bytes_and_tell_scenes_apart() -> None:
    detector = Hyperdimensional()
    train, test = some_scenes(1)[:6], some_scenes(2)[:4]
    detector.train(train, train)
    assert detector._prototypes.shape == (3, 1024)
    assert detector.cost().memory_bytes == 384
    for one in test:
        found = feed(detector, one)
        slipping = found.t_us > one.slip.physical_us + 150_000
        assert np.median(found.value[slipping]) > np.percentile(found.value[~slipping], 95)


def test_the_papers_entry_speaks_where_the_published_rule_does() -> None:
    paper = PaperEntry()
    rule = paper.settings.detection
    assert (rule.smoothing, rule.margin) == (4, 2.0)
    counts = np.random.default_rng(5).integers(0, 12, (300, 3))
    ends = 30_000_000 * np.arange(1, 301)
    expected = detect(counts, ends, rule).valid_class == INCIPIENT
    paper.restart()
    windows = Predictions(counts, counts.sum(axis=1), ends)
    cuts = pairwise([0, 1, 2, 40, 41, 300])
    found = np.concatenate([paper.read(windows[a:b]) for a, b in cuts])
    assert expected.any()
    assert np.array_equal(found > -np.inf, expected)
    assert (found[expected] >= 2.0).all()


def test_mean_odds_do_not_depend_on_how_windows_come() -> None:
    votes = np.random.default_rng(6).normal(0, 4, (100, 3))
    whole, parts = MeanOdds(), MeanOdds()
    expected, classes = whole.step(votes)
    found = [parts.step(part) for part in np.split(votes, [1, 3, 4, 60])]
    assert np.concatenate([value for value, _ in found]) == pytest.approx(expected)
    assert np.concatenate([label for _, label in found]).tolist() == classes.tolist()
    assert classes.tolist() == votes.argmax(axis=1).tolist()
    p = softmax(votes, axis=1)
    odds = np.clip(np.log((p[:, 1] + p[:, 2]) / p[:, 0]), -6, 6)
    assert expected[50] == pytest.approx(odds[45:51].mean())
    assert expected[2] == pytest.approx(odds[:3].mean())
