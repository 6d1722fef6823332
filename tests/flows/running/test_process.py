"""Standard streams that are closed, full, or without a reader: one line, the right exit code."""

from __future__ import annotations

import fcntl
import io
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from typing import TextIO

import pytest

from sliplab.flows.running import process
from sliplab.flows.running.process import OutputLost
from tests.conftest import ROOT
from tests.flows.programs import ended

pytestmark = pytest.mark.programs

PIPE_BYTES = 4096
PLAN = f"{sys.executable} -m flows plan {ROOT / 'protocols' / 'kinematic.yaml'}"
SHORT = f"{sys.executable} -m flows plan {ROOT / 'protocols' / 'pilot.yaml'}"
"""Drawn at once; the other fills a pipe, and takes seconds as a table."""
LOST = "error: the result cannot be written to standard output: "


def shell(line: str) -> subprocess.CompletedProcess[str]:
    """Run a line of bash whose last command's exit code is the line's."""
    return ended(["bash", "-c", line], stdin=subprocess.DEVNULL)


@pytest.mark.quick(3)
@pytest.mark.parametrize(
    ("line", "code", "said"),
    [
        ("{short} >&-", 1, LOST + "it is closed\n"),
        ("{short} --json >&-", 1, LOST + "it is closed\n"),
        ("{short} --json > /dev/full", 1, LOST + "No space left on device\n"),
        ("{plan} --help > /dev/full", 1, LOST + "No space left on device\n"),
        ("set -o pipefail; {plan} --json | head -c 1 > /dev/null", 141, ""),
        ("set -o pipefail; {plan} --json | true", 141, ""),
        ("set -o pipefail; {plan} --help | true", 141, ""),
        ("{plan} --json --enable a=b >&-", 2, "error: --enable"),
        ("{short} <&- > /dev/null", 0, ""),
        ("{short} 2>&- > /dev/null", 0, ""),
        ("{plan} --enable a=b 2>&-", 2, ""),
        ("{plan} --enable a=b 2> /dev/full", 2, ""),
        ("{short} <&- >&- 2>&-", 1, ""),
    ],
)
def test_each_stream_may_be_closed_or_full(line: str, code: int, said: str) -> None:
    done = shell(line.format(plan=PLAN, short=SHORT))
    assert done.returncode == code
    assert done.stderr.startswith(said)
    assert done.stderr.count("\n") == (1 if said else 0)


def test_a_closed_stream_is_no_file_of_ours() -> None:
    """The next file that is opened has a number of its own, so nothing can be printed into it."""
    line = (
        "import os; from sliplab.flows.running.process import guarded\n"
        "with guarded(): assert os.open('/dev/null', os.O_RDONLY) > 2"
    )
    done = shell(f'{sys.executable} -c "{line}" <&- >&- 2>&-')
    assert done.returncode == 0


@pytest.fixture
def pipe() -> Iterator[tuple[int, int]]:
    """Both ends of a small pipe."""
    read, write = os.pipe()
    fcntl.fcntl(write, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
    yield read, write
    os.close(write)
    os.close(read)


def stream(handle: int, *, required: bool) -> TextIO:
    return process._text(handle, "", None, required=required)


def test_messages_that_nobody_reads_are_dropped(
    pipe: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A stalled reader of the log must not hold up an arm."""
    monkeypatch.setattr(process, "PATIENCE_S", 0.01)
    read, write = pipe
    messages = stream(write, required=False)
    for number in range(1000):
        print(f"message {number} {'.' * 80}", file=messages)
    assert os.read(read, 2 * PIPE_BYTES).startswith(b"message 0 ")
    print("later", file=messages)
    assert os.read(read, 2 * PIPE_BYTES).endswith(b"later\n")


def test_a_slow_reader_gets_all_of_a_result(pipe: tuple[int, int]) -> None:
    read, write = pipe
    os.set_blocking(write, False)  # as a program that shares the pipe may leave it
    script = "import sys, time; time.sleep(0.3); print(len(sys.stdin.buffer.read()))"
    reader = subprocess.Popen(
        [sys.executable, "-c", script], stdin=read, stdout=subprocess.PIPE, close_fds=True
    )
    try:
        results = stream(os.dup(write), required=True)
        results.write("x" * 500_000)
        results.flush()
        os.close(results.fileno())
        os.dup2(os.open(os.devnull, os.O_WRONLY), write)  # the last writing end
        out, _ = reader.communicate(timeout=60)
    finally:
        reader.kill()
        reader.wait(60)
    assert out.strip() == b"500000"


def test_a_result_without_a_reader_is_an_error_once() -> None:
    read, write = os.pipe()
    os.close(read)
    results = stream(write, required=True)
    results.write("lost")
    with pytest.raises(OutputLost, match="Broken pipe"):
        results.flush()
    results.write("and what is left at the end")
    results.flush()
    os.close(write)


def test_streams_of_a_test_are_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    out = io.StringIO()
    monkeypatch.setattr("sys.stdout", out)
    with process.guarded():
        assert sys.stdout is out


def test_a_file_name_that_is_no_text_can_be_printed() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "sliplab", "plan", b"no\xffname.yaml", "--json"],
        cwd=ROOT,
        capture_output=True,
        timeout=120,
    )
    assert done.returncode == 2
    assert json.loads(done.stdout)["error"]["file"] == "no\udcffname.yaml"
    assert b"Traceback" not in done.stderr
