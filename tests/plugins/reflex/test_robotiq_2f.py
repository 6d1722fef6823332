"""The driver of Robotiq 2F grippers on its fake: what goes over the wire, stalls, faults."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass

import pytest

from sliplab.plugins.reflex.robotiq_2f import DRIVER, protocol
from sliplab.plugins.reflex.robotiq_2f.driver import Robotiq2f
from sliplab.plugins.reflex.robotiq_2f.fake import ElasticObject, FakeRobotiq
from sliplab.plugins.reflex.robotiq_2f.settings import Robotiq2fSettings
from sliplab.rigs.core.capabilities import Gripper, RigError
from sliplab.rigs.core.driver import GripperScene
from sliplab.rigs.core.finger_motion import FingerMotion
from tests.patching import loose, put
from tests.rigs.waiting import until

MS = 1_000_000


@dataclass
class Bench:
    """A driver on its fake, on a clock that the test turns."""

    fake: FakeRobotiq
    gripper: Robotiq2f
    now_ns: int = 0

    def wait(self, ms: float) -> None:
        """Let time pass, after what was sent has come."""
        self.gripper.state()
        self.now_ns += round(ms * MS)


@pytest.fixture
def bench() -> Iterator[Bench]:
    """A gripper that is half open, with an elastic object of 30 mm and 50 N/mm."""
    fingers = FingerMotion(40.0, 8 * MS, 1000.0)
    clock: list[Bench] = []

    def now_ns() -> int:
        return clock[0].now_ns if clock else 0

    held = ElasticObject(fingers, 30.0, 50.0)
    with FakeRobotiq("2F-85", GripperScene(fingers, now_ns), held.feel) as fake:
        host, port = fake.address
        settings = Robotiq2fSettings(host=host, port=port, opening_mm=40.0, answer_s=0.5)
        gripper = Robotiq2f(settings)
        clock.append(Bench(fake, gripper))
        gripper.connect()
        yield clock[0]
        gripper.close()


def test_a_move_is_moving_before_the_gripper_has_taken_it_up(bench: Bench) -> None:
    """Until it echoes the request, a gripper says that it has arrived: at the last place."""
    bench.gripper.move(35.0, 150.0, 20.0)
    assert bench.fake.answer("GET OBJ") == b"OBJ 3\n"
    assert bench.gripper.state().moving
    bench.wait(50)
    assert bench.gripper.state().moving
    bench.wait(1000)
    state = bench.gripper.state()
    assert not state.moving
    assert not state.stalled
    # 150 of 255 counts would be a little tighter than 35 mm
    assert state.opening_mm == pytest.approx(85.0 * (1 - 150 / 255))
    assert bench.fake.sets == ["SET POS 150 SPE 255 FOR 0 GTO 1"]


@pytest.mark.parametrize("step_ms", [0.3, 0.7, 0.9, 1.1, 2.1])
def test_a_move_taken_up_between_two_questions_is_moving(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, step_ms: float
) -> None:
    answer = bench.fake.answer

    def slowly(line: str) -> bytes:
        found = answer(line)
        bench.now_ns += round(step_ms * MS) * line.startswith("GET")
        return found

    monkeypatch.setattr(bench.fake, "answer", slowly)
    bench.gripper.move(35.0, 150.0, 20.0)
    assert bench.gripper.state().moving


def test_a_stop_ends_a_move_where_the_fingers_are(bench: Bench) -> None:
    bench.gripper.move(0.0, 20.0, 20.0)
    bench.wait(200)
    bench.gripper.stop()
    assert not bench.gripper.state().moving
    bench.wait(100)
    opening = bench.gripper.state().opening_mm
    bench.wait(1000)
    assert bench.gripper.state().opening_mm == opening
    assert 30.0 < opening < 40.0
    bench.gripper.stop()  # any number of times
    bench.wait(1)
    assert bench.fake.sets[1:] == ["SET GTO 0", "SET GTO 0"]


def test_closing_fingers_stall_at_their_force(bench: Bench) -> None:
    bench.gripper.move(20.0, 50.0, 60.0)
    bench.wait(1000)
    state = bench.gripper.state()
    assert state.stalled
    assert not state.moving
    # 60 N are 47.4 counts, rounded down, and 50 N/mm; positions come in steps of 0.33 mm
    force_n = 20.0 + 215.0 * 47 / 255
    assert state.opening_mm == pytest.approx(30.0 - force_n / 50.0, abs=0.17)


def test_steps_are_rounded_to_the_wider_weaker_and_slower_side() -> None:
    allowed = protocol.range_of("2F-85")
    for opening in (0.0, 0.1, 33.3, 39.6, 40.0, 84.9, 85.0):
        counts = protocol.position_counts(opening, allowed)
        assert opening - 1e-4 <= protocol.opening_mm(counts, allowed) < opening + allowed.step_mm
    for span in (allowed.speed_mm_s, allowed.force_n):
        for share in (0.0, 0.3, 0.999, 1.0):
            value = span[0] + share * (span[1] - span[0])
            assert protocol.of_counts(protocol.least_counts(value, span), span) <= value + 1e-4


def test_an_opening_that_was_asked_for_comes_back_the_same() -> None:
    for model in ("2F-85", "2F-140"):
        allowed = loose(protocol).range_of(model)
        for counts in range(256):
            opening = protocol.opening_mm(counts, allowed)
            assert protocol.position_counts(opening, allowed) == counts


def test_a_fault_is_said_with_what_to_do(bench: Bench) -> None:
    bench.gripper.move(20.0, 50.0, 60.0)
    bench.wait(50)
    bench.fake.fail()
    with pytest.raises(RigError, match=r"gripper: draws too much current \(fault 14\)"):
        bench.gripper.state()


def test_a_gripper_that_is_not_active_is_not_activated(bench: Bench) -> None:
    bench.fake.registers["STA"] = 0
    with pytest.raises(RigError, match="not activated: activate it at the pendant"):
        bench.gripper.connect()
    assert bench.fake.sets == []
    with pytest.raises(RigError, match="is not connected"):
        bench.gripper.state()


def test_silence_and_a_broken_line_are_said_in_time(bench: Bench) -> None:
    bench.fake.silence()
    with pytest.raises(RigError, match=r"gripper: no answer from .*timed out"):
        bench.gripper.state()
    bench.fake.close()
    with pytest.raises(RigError, match="no answer"):
        bench.gripper.state()
    with pytest.raises(RigError, match="no answer"):
        bench.gripper.connect()
    bench.gripper.stop()  # nothing to stop
    bench.gripper.close()


def test_an_answer_to_another_question_is_no_answer(bench: Bench) -> None:
    put(bench.fake, "answer", lambda line: b"ackack STA 3\n")
    with pytest.raises(RigError, match=r"answered b'STA 3' to GET FLT"):
        bench.gripper.state()


def test_out_of_range_sends_nothing(bench: Bench) -> None:
    with pytest.raises(RigError, match="force 10 N is out of its range, 20 to 235 N"):
        bench.gripper.move(30.0, 50.0, 10.0)
    assert bench.fake.sets == []


def test_it_is_a_gripper_and_says_how_it_is(bench: Bench) -> None:
    assert isinstance(bench.gripper, Gripper)
    health = bench.gripper.health()
    assert health.model == "Robotiq 2F-85"
    assert "opening 40.0 mm" in health.notes[0]
    host, port = bench.fake.address
    reached = Robotiq2fSettings(host=host, port=port, opening_mm=40.0)
    assert DRIVER.ping(reached) is None
    assert DRIVER.range(reached) == bench.gripper.range


# -- answers that are none ----------------------------------------------------------------------


def answer_with(bench: Bench, name: str, wrong: bytes) -> list[str]:
    """Let the gripper answer a question wrongly; the lines that it is sent from now on."""
    sent: list[str] = []
    right = bench.fake.answer

    def answer(line: str) -> bytes:
        sent.append(line.strip())
        return wrong if line.strip() == f"GET {name}" else right(line)

    put(bench.fake, "answer", answer)
    return sent


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("FLT", b"FLT 256\n"),
        ("FLT", b"FLT -1\n"),
        ("FLT", b"FLT\n"),
        ("FLT", b"FLT 0 0\n"),
        ("FLT", b"FLT 0.0\n"),
        ("FLT", "FLT \N{SUPERSCRIPT TWO}\n".encode()),
        ("POS", b"POS 300\n"),
        ("POS", b"POS " + b"9" * 5000 + b"\n"),
        ("POS", b"POS 0" * 20),
        ("OBJ", b"OBJ 4\n"),
        ("OBJ", b"\xff\x1b[31m" * 50 + b"\n"),
        ("OBJ", b"POS 3\n"),
    ],
)
def test_wrong_answer_is_refused_and_nothing_more_asked(
    bench: Bench, name: str, wrong: bytes
) -> None:
    sent = answer_with(bench, name, wrong)
    for _ in range(2):
        with pytest.raises(RigError, match=r"gripper: answered .*; connect it again") as fault:
            bench.gripper.state()
        assert len(str(fault.value)) < 400
    assert sent.count(f"GET {name}") == 1
    with pytest.raises(RigError, match="connect it again"):
        bench.gripper.move(30.0, 50.0, 60.0)
    bench.gripper.stop()
    assert sent[-1] == "SET GTO 0"


def test_acks_without_end_are_refused(bench: Bench) -> None:
    answer_with(bench, "FLT", b"ack" * 100_000)
    with pytest.raises(RigError, match="its answer does not end"):
        bench.gripper.state()


def test_answer_to_a_lost_question_is_not_taken_for_the_next(bench: Bench) -> None:
    answer_with(bench, "FLT", b"")
    with pytest.raises(RigError, match="timed out"):
        bench.gripper.state()
    bench.fake.send(b"FLT 0\nPOS 200\nOBJ 3\n")
    with pytest.raises(RigError, match="timed out"):
        bench.gripper.state()


def test_stop_after_a_broken_connection_takes_a_new_one(bench: Bench) -> None:
    bench.gripper.move(0.0, 20.0, 20.0)
    bench.wait(100)
    bench.fake.cut()
    with pytest.raises(RigError, match="it closed the connection"):
        bench.gripper.state()
    bench.gripper.stop()
    assert bench.fake.sets[-1] == "SET GTO 0"
    bench.fake.close()
    with pytest.raises(RigError, match="no answer"):
        bench.gripper.stop()


@pytest.mark.realtime
@pytest.mark.parametrize("byte", [b"F", b"\r", b"a"])
def test_stop_is_sent_while_an_answer_drips(byte: bytes) -> None:
    lines: list[bytes] = []

    def serve(server: socket.socket) -> None:
        """Answer as a gripper at rest, but to POS with a byte every 50 ms."""
        link, _ = server.accept()
        answers = {b"FLT": b"FLT 0\n", b"STA": b"STA 3\n"}
        with link, link.makefile("rb") as requests, suppress(OSError):
            for line in requests:
                lines.append(line)
                if line == b"GET POS\n":
                    threading.Thread(target=drip, args=(link,), daemon=True).start()
                else:
                    link.sendall(answers.get(line.split()[1], b"ack"))

    def drip(link: socket.socket) -> None:
        with suppress(OSError):
            while True:
                link.sendall(byte)
                threading.Event().wait(0.05)

    with socket.create_server(("127.0.0.1", 0)) as server:
        threading.Thread(target=serve, args=(server,), daemon=True).start()
        settings = Robotiq2fSettings(
            host="127.0.0.1", port=server.getsockname()[1], opening_mm=40.0, answer_s=0.5
        )
        gripper = Robotiq2f(settings)
        gripper.connect()
        faults: list[RigError] = []

        def ask() -> None:
            try:
                gripper.state()
            except RigError as fault:
                faults.append(fault)

        asking = threading.Thread(target=ask)
        began = time.monotonic()
        asking.start()
        until(lambda: b"GET POS\n" in lines, 5.0)
        gripper.stop()
        until(lambda: b"SET GTO 0\n" in lines, 5.0)
        assert asking.is_alive()
        asking.join(5.0)
        assert time.monotonic() - began < 3.0
        assert "timed out" in str(faults[0])
        gripper.close()
