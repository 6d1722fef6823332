"""The sync box's real firmware in a simulated ATmega328P, talking to the real driver.

Edges are checked by the cycle at which the timer made them. Skipped where the compiler or the
simulator are not installed (Debian: gcc-avr avr-libc simavr libsimavr-dev libelf-dev).
"""

from __future__ import annotations

import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import serial

from sliplab.plugins.devices.sync_box.driver import SerialSyncBox
from sliplab.plugins.devices.sync_box.line import ALL_TO_HZ, BAUD, MOST_HZ, NAME, LineReader, seal
from sliplab.plugins.devices.sync_box.port import SyncBoxFault
from sliplab.plugins.devices.sync_box.settings import SyncBoxSettings
from sliplab.protocols.timing import Code
from sliplab.rigs.core.pulse_code import code_bits
from tests.conftest import ROOT

FIRMWARE = ROOT / "rigs" / "firmware"
HOST = Path(__file__).with_name("firmware_host.c")
MHZ = 16
SEED = 0xBEEFACE1
CODES: tuple[Code, ...] = ("lfsr", "irregular", "regular")
FLASH_BYTES, MEMORY_BYTES = 30 << 10, 2 << 10
"""Of an ATmega328P with its bootloader."""
LATEST_CYCLES = 4
"""So long an instruction in progress hides an edge from the trace; interrupts take longer."""


def lacking() -> str:
    """Return the tools that are not installed; empty if all are."""
    tools = [tool for tool in ("avr-gcc", "avr-nm", "make", "cc") if shutil.which(tool) is None]
    if tools:
        return ", ".join(tools)
    for what, command, header in (
        ("avr-libc", ["avr-gcc", "-mmcu=atmega328p"], "avr/io.h"),
        ("libsimavr-dev", ["cc"], "simavr/sim_avr.h"),
        ("libelf-dev", ["cc"], "libelf.h"),
    ):
        found = subprocess.run(
            [*command, "-E", "-"], input=f"#include <{header}>\n", capture_output=True, text=True
        )
        if found.returncode:
            return what
    return ""


LACKING = lacking()
pytestmark = [
    pytest.mark.skipif(bool(LACKING), reason=f"not installed: {LACKING}"),
    pytest.mark.realtime,
]


@dataclass
class Built:
    """Firmware and simulator, ready to run."""

    elf: Path
    host: Path
    wraps_at: int
    """Return the address of the firmware's timer wrap counter in data memory."""


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Built:
    out = tmp_path_factory.mktemp("firmware")
    elf, host = out / "sync_box.elf", out / "host"
    make = ["make", "-s", "-C", str(FIRMWARE), f"OUT={out}"]
    compile_host = ["cc", "-O2", "-Wall", "-o", str(host), str(HOST), "-lsimavr", "-lelf"]
    for command in (make, compile_host):
        done = subprocess.run(command, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
    names = subprocess.run(["avr-nm", elf], capture_output=True, text=True, check=True).stdout
    (wraps,) = (line.split()[0] for line in names.splitlines() if line.endswith(" wraps"))
    return Built(elf, host, int(wraps, 16) & 0xFFFF)


@dataclass
class Board:
    """A simulated board that runs."""

    port: str
    trace: Path
    process: subprocess.Popen[str]

    def edges(self, pin: int, level: int = 1) -> np.ndarray:
        """Cycles at which an output (1 trigger, 2 code) went to `level`."""
        rows = [line.split() for line in self.trace.read_text().splitlines()]
        mine = [row for row in rows if row[0] == str(pin)]
        assert all(int(row[3]) <= LATEST_CYCLES for row in mine), "not made by the timer"
        return np.array([int(row[1]) for row in mine if int(row[2]) == level], np.int64)

    def exposures(self) -> np.ndarray:
        """Cycles at which exposures began."""
        rows = [line.split() for line in self.trace.read_text().splitlines()]
        return np.array([int(row[1]) for row in rows if row[0] == "X"], np.int64)


Run = Callable[..., Board]


@pytest.fixture
def run(built: Built, tmp_path: Path) -> Iterator[Run]:
    boards: list[Board] = []

    def begin(delay: int = 0, every: int = 0, wraps: int = 0) -> Board:
        trace = tmp_path / "trace"
        numbers = [str(number) for number in (delay, every, built.wraps_at, wraps)]
        process = subprocess.Popen(
            [built.host, built.elf, trace, *numbers], stdout=subprocess.PIPE, text=True
        )
        assert process.stdout is not None
        port = next(line for line in process.stdout if line.startswith("port ")).split()[1]
        boards.append(Board(port, trace, process))
        return boards[-1]

    yield begin
    for board in boards:
        board.process.kill()
        board.process.communicate()


@pytest.fixture
def connect() -> Iterator[Callable[[Board], SerialSyncBox]]:
    boxes: list[SerialSyncBox] = []

    def to(board: Board) -> SerialSyncBox:
        # a simulator on a busy machine is slower than a board
        limits = SyncBoxSettings(port=board.port, answer_s=2.0, boot_s=10.0, silence_s=5.0)
        boxes.append(SerialSyncBox(limits))
        boxes[-1].connect()
        return boxes[-1]

    yield to
    for box in boxes:
        box.close()


Connect = Callable[[Board], SerialSyncBox]


def train(box: SerialSyncBox, rate_hz: float, code: Code, ticks: int) -> np.ndarray:
    """Pulses of a train of at least so many ticks, ns."""
    box.start(rate_hz, SEED, code)
    found, end = [box.read_pulses().t_ns], time.monotonic() + 20.0
    while max(chunk.max(initial=-1) for chunk in found) < (ticks - 16) / rate_hz * 1e9:
        assert time.monotonic() < end
        threading.Event().wait(0.02)
        found.append(box.read_pulses().t_ns)
    box.stop()
    return np.concatenate([*found, box.read_pulses().t_ns])


def test_it_fits(built: Built) -> None:
    sizes = subprocess.run(["avr-size", built.elf], capture_output=True, text=True, check=True)
    text, data, bss = (int(word) for word in sizes.stdout.splitlines()[1].split()[:3])
    assert text + data < FLASH_BYTES
    assert data + bss < MEMORY_BYTES - 512, "the rest is the stack's"


@pytest.mark.parametrize("code", CODES)
def test_at_100_hz_every_edge_is_160000_cycles_from_the_last(
    run: Run, connect: Connect, code: Code
) -> None:
    board = run()
    box = connect(board)
    pulses = train(box, 100.0, code, 120)
    trigger, sent = board.edges(1), board.edges(2)
    assert len(trigger) >= 100
    assert set(np.diff(trigger)) == {160_000}
    bits = np.isin(trigger, sent).astype(np.uint8)
    assert np.array_equal(bits, code_bits(SEED, len(trigger), code))
    assert np.isin(sent, trigger).all(), "both lines rise on the same cycle"
    assert np.array_equal(pulses, (sent - trigger[0]) * 1000 // MHZ)
    for pin in (1, 2):
        assert set(board.edges(pin, 0) - board.edges(pin, 1)) == {80_000}, "whole pulses of 5 ms"
    assert not box.losses


@pytest.mark.quick(1)
@pytest.mark.parametrize("rate_hz", [MOST_HZ, ALL_TO_HZ, 333.333, 1.5])
def test_any_rate_is_kept_to_the_cycle(run: Run, connect: Connect, rate_hz: float) -> None:
    """A period that is no whole number of cycles is spread: no tick is off by a cycle or more."""
    board = run()
    box = connect(board)
    pulses = train(box, rate_hz, "lfsr", 20 if rate_hz < 10 else 400)
    trigger, sent = board.edges(1), board.edges(2)
    ticks = np.arange(len(trigger))
    due = ticks * (MHZ * 1_000_000_000) // round(rate_hz * 1000)
    assert np.array_equal(trigger - trigger[0], due)
    bits = np.isin(trigger, sent).astype(np.uint8)
    assert np.array_equal(bits, code_bits(SEED, len(trigger)))
    assert np.array_equal(pulses, (sent - trigger[0]) // MHZ * 1000)
    assert not box.losses


@pytest.mark.quick(2)
@pytest.mark.parametrize("delay", [1, 100, 1234, 65_536])
def test_exposures_are_stamped_to_the_microsecond(run: Run, connect: Connect, delay: int) -> None:
    board = run(delay=delay)
    box = connect(board)
    train(box, 100.0, "lfsr", 80)
    stamps = box.read_exposures().t_ns
    edges = (board.exposures() - board.edges(1)[0])[: len(stamps)]
    assert len(stamps) >= 50
    assert np.array_equal(stamps, edges // MHZ * 1000)


def test_exposures_of_a_camera_that_runs_by_itself(run: Run, connect: Connect) -> None:
    """It ran before the train did: those exposures are not among the stamps."""
    board = run(every=77_777)
    box = connect(board)
    for _ in range(3):
        before = len(board.edges(1))
        train(box, 100.0, "regular", 40)
        stamps = box.read_exposures().t_ns
        # counted: the pause between two trains may by chance be one period, and was once
        edges = board.exposures() - board.edges(1)[before]
        assert len(stamps) >= 40
        assert np.array_equal(stamps, edges[edges >= 0][: len(stamps)] // MHZ * 1000)
        assert not box.losses


def test_all_is_reported_at_the_highest_rate_with_exposures(run: Run, connect: Connect) -> None:
    board = run(delay=200)
    box = connect(board)
    train(box, MOST_HZ, "lfsr", 1500)
    assert len(board.edges(1)) > 1400
    losses = box.losses
    assert (losses.pulses, losses.exposures, losses.reported_by_box) == (0, 0, 0)


def test_a_flood_of_exposures_is_counted_and_moves_no_edge(run: Run, connect: Connect) -> None:
    """4,000 a second, as from a loose wire: far more than the line carries."""
    board = run(every=4000)
    box = connect(board)
    pulses = train(box, 100.0, "lfsr", 120)
    trigger, sent = board.edges(1), board.edges(2)
    assert set(np.diff(trigger)) == {160_000}
    assert np.array_equal(pulses, (sent - trigger[0]) * 1000 // MHZ), "no pulse is lost to it"
    losses = box.losses
    assert losses.pulses == 0
    assert losses.reported_by_box > 1000
    assert losses.exposures > 1000


def test_the_clock_goes_through_32_bits(run: Run, connect: Connect) -> None:
    """A box that has been on for 71 minutes: neither its clock nor its reports come round."""
    board = run(wraps=2**32 * MHZ // 2**16 - 250)
    box = connect(board)
    assert box.read_clock().device_ns[0] < 2**32 * 1000
    pulses = train(box, 100.0, "lfsr", 150)
    trigger, sent = board.edges(1), board.edges(2)
    assert np.array_equal(pulses, (sent - trigger[0]) * 1000 // MHZ)
    box.close()
    assert int(raw(board.port, "T? 1")[0].split()[2]) > 2**32


def test_the_clock_goes_on_after_the_stop(run: Run, connect: Connect) -> None:
    box = connect(run())
    box.start(100.0, SEED)
    reads = [box.read_clock() for _ in range(5)]
    box.stop()
    reads += [box.read_clock() for _ in range(5)]
    device = [int(read.device_ns[0]) for read in reads]
    assert device == sorted(device)
    assert all(read.before_ns[0] < read.after_ns[0] for read in reads)


def test_a_reset_is_noticed_and_survived(run: Run, connect: Connect) -> None:
    board = run()
    box = connect(board)
    train(box, 100.0, "lfsr", 30)
    box.start(100.0, SEED)
    board.process.send_signal(signal.SIGUSR1)
    with pytest.raises(SyncBoxFault, match="restarted"):  # noqa: PT012
        for _ in range(1200):
            box.read_pulses()
            threading.Event().wait(0.01)
    pulses = train(box, 100.0, "regular", 40)
    assert pulses[:2].tolist() == [0, 160_000_000]


def raw(port: str, *requests: str | bytes) -> list[str]:
    """The lines that answer each request, one for one."""
    answers: list[str] = []
    with serial.Serial(port, BAUD, timeout=0.5) as line:
        reader = LineReader()
        for request in requests:
            line.write(request if isinstance(request, bytes) else seal(request))
            bodies = reader.bodies(line.readline())
            while bodies and bodies[0].startswith(("B ", "P ")):
                bodies = reader.bodies(line.readline())
            answers += bodies
    return answers


def test_what_it_answers(run: Run, connect: Connect) -> None:
    board = run()
    connect(board).close()
    # requests, and the answers that never change
    rate, code = "E rate must be 1 to 1000 Hz", "E code must be lfsr, irregular or regular"
    seed = "E seed must be 1 to 4294967294"
    asked = {
        "ID?": f"ID {NAME}",
        "GO": "E not armed",
        "ARM 0.999 1 0 lfsr": rate,
        "ARM 1000.001 1 0 lfsr": rate,
        "ARM 1e2 1 0 lfsr": rate,
        "ARM 100 0 0 lfsr": seed,
        "ARM 100 4294967295 0 lfsr": seed,
        "ARM 100 1 0 prbs": code,
        "ARM 100": seed,
        "FLY": "E unknown",
        b"ID?*00\n": "E checksum",
        b"x" * 100 + b"\n": "E checksum",
        "ARM 200.5 77 3 irregular": "OK ARM",
    }
    answers = raw(board.port, *asked, "GO", "GO", "ARM 100 1 0 lfsr", "STOP")
    assert answers[:13] == list(asked.values())
    assert answers[13].startswith("OK GO ")
    assert answers[13] == answers[14], "a host that missed the answer asks again"
    assert answers[15] == "E running"
    assert answers[16] in {f"OK STOP {sent}" for sent in (1, 2, 3)}


def test_a_train_of_n_ticks_ends_by_itself(run: Run, connect: Connect) -> None:
    board = run()
    connect(board).close()
    raw(board.port, "ARM 200 77 7 lfsr", "GO")
    end = time.monotonic() + 3.0
    while len(board.edges(1, 0)) < 7 and time.monotonic() < end:
        threading.Event().wait(0.01)
    assert raw(board.port, "STOP") == ["OK STOP 7"]
    assert set(np.diff(board.edges(1))) == {80_000}
    assert len(board.edges(1)) == 7
