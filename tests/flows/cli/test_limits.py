"""Limits of the system that a command runs into: one line, exit 1, and nothing called damaged."""

from __future__ import annotations

import errno
import json
import os
import select
import shutil
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from sliplab.flows.running.process import exhausted, too_few_threads
from sliplab.storage.causes import causes
from sliplab.storage.errors import StoreError, disk_full
from sliplab.storage.trials.store import TrialStore
from sliplab.storage.trials.verify import verify
from tests.command_line import here
from tests.conftest import ROOT
from tests.flows.programs import ended

PLAN = (ROOT / "protocols" / "pilot.yaml",)


STARTED = """
import resource, sys
from sliplab.flows.__main__ import main
which, limit = getattr(resource, sys.argv.pop(1)), int(sys.argv.pop(1))
resource.setrlimit(which, (limit, limit))
main()
"""


@pytest.mark.parametrize(
    ("which", "limit", "message"),
    [
        ("RLIMIT_AS", 40_000 << 10, "there is not enough memory (ulimit -v is 40000): "),
        ("RLIMIT_AS", 60_000 << 10, "there is not enough memory (ulimit -v is 60000): "),
        # here OpenBLAS would end the process without an object
        ("RLIMIT_AS", 120_000 << 10, "there is not enough memory (ulimit -v is 120000): "),
        ("RLIMIT_NOFILE", 3, "too many files are open (ulimit -n is 3): "),
    ],
)
def test_a_program_that_cannot_be_loaded(which: str, limit: int, message: str) -> None:
    done = ended([sys.executable, "-c", STARTED, which, limit, "plan", *PLAN, "--json"])
    error = json.loads(done.stdout)["error"]
    assert (done.returncode, error["exit_code"]) == (1, 1)
    assert error["message"].startswith(message)
    assert done.stderr.startswith(f"error: {message}")
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("raised", "message"),
    [
        (MemoryError(), "there is not enough memory"),
        (MemoryError("Unable to allocate 11.9 TiB for an array"), "there is not enough memory"),
        (OSError(errno.ENOMEM, "Cannot allocate memory"), "there is not enough memory"),
        (SystemError("error return without exception set"), "there is not enough memory"),
        (ImportError("libx.so: failed to map segment from shared object"), "not enough memory"),
        (OSError(errno.EMFILE, "Too many open files", "x.json"), "too many files are open"),
        (OSError(errno.ENFILE, "Too many open files in system"), "too many files are open"),
        (BlockingIOError(errno.EAGAIN, "Resource temporarily unavailable"), "no more processes"),
        (RuntimeError("can't start new thread"), "no more processes or threads can be started"),
        (OSError(errno.EFBIG, "File too large"), "its disk does not allow a larger file"),
        (OSError(errno.ENOSPC, "No space left on device"), "its disk is full"),
        (OSError(errno.ENOSPC, "", "/a/from", None, "/tmp/to"), "/tmp/to: its disk is full"),
    ],
)
@pytest.mark.parametrize("hidden", [False, True])
def test_what_has_run_out_is_said(
    raised: Exception, message: str, hidden: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where the system's own error was replaced by one that names a file."""

    def fail(*_: object) -> None:
        if not hidden:
            raise raised
        try:
            raise raised
        except Exception as error:
            raise StoreError(f"s/store.json: {error}; it is damaged") from None

    monkeypatch.setattr("sliplab.protocols.plan.load_plan", fail)
    done = here("plan", *PLAN, "--json")
    assert done.returncode == 1
    if not hidden or exhausted(raised):
        assert message in json.loads(done.stdout)["error"]["message"]
    assert done.stderr.count("\n") == 1


def test_an_error_that_caused_itself_is_no_endless_search() -> None:
    first, second = ValueError("broken"), OSError(errno.ENOSPC, "no space")
    first.__cause__ = first
    second.__context__, first.__context__ = first, second
    assert exhausted(first) is None
    assert disk_full(second)
    assert [*causes(second)] == [second, first]


def test_without_processes_a_collection_ends_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fork(*_: object, **__: object) -> None:
        raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))

    monkeypatch.setattr("sliplab.flows.running.orchestration._servers", {})
    monkeypatch.setattr("sliplab.flows.running.embedded_server.Child", fork)
    words = (*PLAN, "--rig", "rehearsal", "--store", tmp_path / "s", "--trials", 1)
    done = here("collect", *words, "--json")
    error = json.loads(done.stdout)["error"]
    assert done.returncode == 1
    assert "no more processes or threads can be started" in error["message"]
    assert "Traceback" not in done.stderr


@pytest.fixture(scope="module")
def taken(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that `store` copies."""
    folder = tmp_path_factory.mktemp("limits") / "s"
    done = here("collect", *PLAN, "--rig", "rehearsal", "--store", folder, "--trials", 1)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture
def store(taken: Path, tmp_path: Path) -> TrialStore:
    """A store with one committed trial."""
    return TrialStore.open(shutil.copytree(taken, tmp_path / "s"))


@pytest.mark.parametrize("number", [errno.EMFILE, errno.ENFILE, errno.ENOMEM])
@pytest.mark.parametrize("function", ["read_json", "sha256"])
def test_a_trial_that_cannot_be_read_now_is_not_damaged(
    number: int, function: str, store: TrialStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Sweeping and quarantine would move a whole trial away."""
    (campaign,) = store.campaigns()
    before = campaign.committed()

    def fail(path: Path) -> None:
        raise OSError(number, os.strerror(number), str(path))

    with monkeypatch.context() as patch:
        patch.setattr(f"sliplab.storage.trials.checksums.{function}", fail)
        with pytest.raises(OSError, match=os.strerror(number)):
            verify(store)
        if function == "read_json":
            with pytest.raises(OSError, match=os.strerror(number)):
                campaign.sweep()
        done = here("verify", store.folder, "--quarantine", "--json")
        assert done.returncode == 1
        assert list(json.loads(done.stdout)) == ["error"]
    assert campaign.committed() == before
    assert campaign.quarantined() == []
    assert verify(store) == []


FULL = """
import resource, sys
from pathlib import Path
from sliplab.storage.trials.hdf5_writer import StreamFile
from tests.storage.trial_files import events
path = Path(sys.argv[1])
file = StreamFile(path)
most = path.stat().st_size + 30_000
resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))
file.add("events", events(200_000))
try:
    getattr(file, sys.argv[2])()
    print("closed")
except OSError as error:
    print("refused", error.errno)
"""


@pytest.mark.parametrize(
    ("how", "said"), [("finish", f"refused {errno.EFBIG}"), ("abandon", "closed")]
)
def test_hdf5_does_not_crash_a_program_whose_file_may_grow_no_more(
    how: str, said: str, tmp_path: Path
) -> None:
    """HDF5 crashed it at its exit: collect ended with a segmentation fault, not with exit 1."""
    done = ended([sys.executable, "-c", FULL, tmp_path / "data.h5", how])
    assert (done.returncode, done.stdout) == (0, f"{said}\n"), done.stderr


CRASH = """
import os, signal, sys, time
from sliplab.flows.running import process
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job ignores it
import resource
resource.setrlimit(resource.RLIMIT_AS, (4 << 30, 4 << 30))
from sliplab.flows import __main__ as program
def run():
    print(os.getpid(), flush=True)
    if sys.argv[1] == "crash":
        os.kill(os.getpid(), signal.SIGSEGV)
    if sys.argv[1] == "wait":
        try:
            signal.sigtimedwait([], 60)
        except KeyboardInterrupt:
            return 130
    return 7
program._run = run
program.main()
"""


def limited(how: str) -> subprocess.Popen[str]:
    """Run a command that crashes, waits or ends, under a limit of memory."""
    return subprocess.Popen(
        [sys.executable, "-c", CRASH, how, "--json"],
        cwd=ROOT,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )


def test_a_library_that_crashes_for_want_of_memory_ends_in_one_line() -> None:
    process = limited("crash")
    out, said = process.communicate(timeout=60)
    _, line = out.splitlines()
    assert process.returncode == json.loads(line)["error"]["exit_code"] == 1
    assert said.startswith("error: a library crashed (Segmentation fault), as it does without")
    assert said.count("\n") == 1
    process = limited("end")
    process.communicate(timeout=60)
    assert process.returncode == 7


def test_a_program_with_limited_memory_can_be_stopped() -> None:
    with limited("wait") as process:
        child = int(process.stdout.readline())
        assert child != process.pid
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 130


def test_a_child_ends_with_its_killed_parent() -> None:
    with limited("wait") as process:
        watched = os.pidfd_open(int(process.stdout.readline()))
        try:
            process.kill()
            assert select.select([watched], [], [], 60)[0] == [watched]
        finally:
            os.close(watched)


def test_threads_that_cannot_be_started_are_said_before_a_library_asks_for_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert too_few_threads() is None
    start, begun = threading.Thread.start, []

    def refuse_the_second(self: threading.Thread) -> None:
        if begun:
            raise RuntimeError("can't start new thread")
        begun.append(self)
        start(self)

    monkeypatch.setattr(threading.Thread, "start", refuse_the_second)
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    said = too_few_threads()
    assert said.startswith("no more processes or threads can be started")
    (thread,) = begun
    assert not thread.is_alive()
