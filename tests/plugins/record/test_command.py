"""`sliplab record` at a terminal and without one."""

from __future__ import annotations

import json
import os
import pty
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from sliplab.storage.trials.store import TrialStore
from tests.command_line import here


@pytest.fixture
def streams(tmp_path: Path) -> Iterator[Path]:
    """A file with a stream of numbers, which a server sends."""
    server = socket.create_server(("127.0.0.1", 0))
    end = threading.Event()

    def serve() -> None:
        index = 0
        link = server.accept()[0]
        with link:
            while not end.wait(0.01):
                with suppress(ConnectionError):  # its reader has ended
                    link.sendall(b"%d,2\n" % index)
                index += 1

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    file = tmp_path / "streams.yaml"
    file.write_text(_gauge(server))
    yield file
    end.set()
    thread.join(5)
    server.close()


def test_for_and_every_make_trials_of_their_length(tmp_path: Path, streams: Path) -> None:
    store = tmp_path / "store"
    words = ["--for", "1.5s", "--every", "0.5s", "--set", "object=mug", "--set", "grip_n=2"]
    done = here("record", str(streams), "--store", store, "--campaign", "rows", *words, "--json")
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert result == {
        "campaign": "rows",
        "trials": ["000001", "000002", "000003"],
        "salvaged": [],
        "lost": {},
        "faults": [],
        "warnings": [],
    }
    for recording in TrialStore.open(store).campaign("rows").recordings():
        assert recording.record.condition == {"object": "mug", "grip": "2.0 N"}
        last = recording.record.trial == "000003"  # which begins late on a busy machine
        assert 0.5 * (not last) <= recording.record.recorded_s < 1.5
        assert recording.record.streams["gauge"].rows > 10


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["nothing.yaml"], "no such file"),
        (["lsl:x", "--for", "soon"], "must be a time with its unit"),
        (["lsl:x", "--set", "mug"], "must be NAME=VALUE"),
        (["lsl:x", "--set", "a=1", "--set", "a=2"], "gives a condition twice"),
        (["lsl:x", "--set", "grip_n=1", "--set", "grip=2"], "gives the factor grip a second time"),
        (["usb:/dev/video0@big"], "must be usb:DEVICE or usb:DEVICE@WIDTHxHEIGHT"),
        (["rehearsal.yaml"], "no such file"),
        (["loopback"], "a file of streams, lsl:NAME or usb:DEVICE"),
        (["usb:"], "a file of streams, lsl:NAME or usb:DEVICE"),
        (["midi:x"], "a file of streams, lsl:NAME or usb:DEVICE"),
        (["lsl:x", "--campaign", "../x"], "must be a folder's name"),
    ],
)
def test_wrong_words_are_refused(tmp_path: Path, words: list[str], said: str) -> None:
    done = here("record", "--store", tmp_path / "store", "--campaign", "rows", *words)
    assert done.returncode == 2
    assert said in done.stderr.replace("\n", " ")


@pytest.mark.programs
def test_keys_start_mark_and_stop_and_ctrl_c_keeps_the_trial(tmp_path: Path, streams: Path) -> None:
    store = tmp_path / "store"
    screen, terminal = pty.openpty()
    command = [sys.executable, "-m", "sliplab", "record", str(streams), "--store", str(store)]
    child = subprocess.Popen(
        [*command, "--campaign", "keys"], stdin=terminal, stdout=terminal, stderr=terminal
    )
    os.close(terminal)
    try:
        _wait_for(screen, "space: start")
        os.write(screen, b" ")
        _wait_for(screen, "gauge")
        os.write(screen, b"m ")
        _wait_for(screen, "trial 000001 is committed")
        os.write(screen, b" ")
        _wait_for(screen, "gauge")
        child.send_signal(signal.SIGINT)
        _wait_for(screen, "trial 000002 is committed")
        assert child.wait(30) == 0
    finally:
        child.kill()
        child.wait()
        os.close(screen)
    first, second = TrialStore.open(store).campaign("keys").recordings()
    assert [mark.name for mark in first.record.imported.marks] == ["slip"]
    assert first.record.imported.given.uncertainty_ns == 5e8
    assert second.record.streams["gauge"].rows > 0


@pytest.mark.programs
def test_ctrl_c_before_the_time_is_over_still_says_what_was_recorded(
    tmp_path: Path, streams: Path
) -> None:
    store = tmp_path / "store"
    words = ["record", str(streams), "--store", str(store), "--campaign", "rows", "--for", "60s"]
    child = subprocess.Popen(
        [sys.executable, "-m", "sliplab", *words, "--json"], stdout=subprocess.PIPE, text=True
    )
    deadline = time.monotonic() + 60
    while not list(store.glob("campaigns/rows/incoming/*/begun.json")):
        assert time.monotonic() < deadline
        assert child.poll() is None
    child.send_signal(signal.SIGINT)
    said, _ = child.communicate(timeout=60)
    assert child.returncode == 130
    assert json.loads(said)["trials"] == ["000001"]


@pytest.mark.parametrize(
    ("sent", "said"),
    [(b"1,2\n", "gauge"), (b"", "nothing came from any stream")],
)
def test_a_recording_ends_with_its_last_stream_and_says_that_it_failed(
    tmp_path: Path, sent: bytes, said: str
) -> None:
    server = socket.create_server(("127.0.0.1", 0))

    def send_and_leave() -> None:
        with server.accept()[0] as link:
            link.sendall(sent)

    thread = threading.Thread(target=send_and_leave, daemon=True)
    thread.start()
    file = tmp_path / "short.yaml"
    file.write_text(_gauge(server))
    words = ["--store", tmp_path / "store", "--campaign", "rows", "--for", "600s", "--json"]
    done = here("record", str(file), *words)
    thread.join(5)
    server.close()
    assert done.returncode == 1
    result = json.loads(done.stdout)
    assert result["trials"] == ["000001"]
    assert any(said in fault for fault in result["faults"]), result


def _gauge(server: socket.socket) -> str:
    """A file of streams with the rows of a server."""
    place = f"tcp://127.0.0.1:{server.getsockname()[1]}"
    return (
        "streams:\n"
        "  gauge: {kind: table, device: "
        f"{{driver: columns, place: '{place}', columns: {{pull: N, angle: deg}}}}}}\n"
    )


def _wait_for(screen: int, text: str) -> None:
    """Wait until a terminal shows a text."""
    shown, deadline = "", time.monotonic() + 60
    while text not in shown:
        ready, _, _ = select.select([screen], [], [], 1.0)
        assert time.monotonic() < deadline, shown
        if ready:
            shown += os.read(screen, 4096).decode("utf-8", "replace")
