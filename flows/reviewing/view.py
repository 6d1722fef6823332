"""One trial in Rerun: everything that was recorded and made of it, on one time line.

What is written can be read by Rerun's viewer and by its own readers. Times are the trial's own
(the sync box's clock), int64 nanoseconds, none of them rounded. Sizes are bounded: a trial of any
length becomes a file that a laptop opens.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import ModuleType
from typing import Any

from sliplab.analysis.campaigns import Collected
from sliplab.flows.reviewing.view_streams import Subject
from sliplab.flows.running import stopping
from sliplab.protocols.errors import InputError
from sliplab.storage.errors import StoreError
from sliplab.storage.trials.store import Store

APPLICATION = "sliplab"


def find(store: Store, trial: str, campaign: str | None = None) -> Subject:
    """The committed trial of this id.

    Raises:
        InputError: there is none, or several campaigns have it.
    """
    found = [
        Collected(item)
        for item in store.campaigns()
        if campaign in (None, item.name) and trial in item.committed()
    ]
    if not found:
        where = str(store.folder) if campaign is None else f"campaign '{campaign}'"
        raise InputError(
            "TRIAL", "", trial,
            f"is no committed trial of {where}; `sliplab trials {store.folder}` lists them",
        )  # fmt: skip
    if len(found) > 1:
        names = ", ".join(item.name for item in found)
        raise InputError("TRIAL", "", trial, f"is in {names}; name one with --campaign")
    return Subject(store, found[0], found[0].campaign.recording(trial))


def rerun() -> ModuleType:
    """The Rerun library.

    Raises:
        ModuleNotFoundError: it is not installed.
    """
    import rerun as found

    return found


def save(subject: Subject, path: Path) -> dict[str, Any]:
    """Write a trial as an .rrd file, whole or not at all.

    Returns:
        how many there are of what, and the file's bytes.

    Raises:
        StoreError: the trial is damaged.
        ModuleNotFoundError: Rerun is not installed.
    """
    library = rerun()
    from sliplab.flows.reviewing.view_streams import blueprint, send

    library.set_strict_mode(True)  # what cannot be written is an error, not a warning

    library.set_strict_mode(True)  # what cannot be written is an error, not a warning

    aside = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        stream = library.RecordingStream(
            APPLICATION, recording_id=f"{subject.item.name}/{subject.trial}"
        )
        try:
            stream.save(aside, default_blueprint=blueprint(library))
            counts = send(library, stream, subject)
            stream.flush()
        finally:
            stream.disconnect()
        os.replace(aside, path)
    finally:
        aside.unlink(missing_ok=True)
    return {**counts, "bytes": path.stat().st_size}


def show(subject: Subject) -> None:
    """Open a trial in Rerun's viewer, and wait until somebody closes it.

    Raises:
        StoreError: there is no display.
        ModuleNotFoundError: Rerun is not installed.
    """
    rerun()
    if not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise StoreError(
            "there is no display here; --save FILE.rrd writes a file to open elsewhere"
        )
    with tempfile.TemporaryDirectory(prefix="sliplab-view-") as folder:
        path = Path(folder) / f"{subject.item.name}.rrd"
        save(subject, path)
        with silent() as environment, viewer(str(path), environment=environment) as window:
            while window.poll() is None:
                stopping.wait(0.2)
        if window.returncode:
            raise StoreError(f"Rerun's viewer ended with {window.returncode}")


ALONE = ("--bind", "127.0.0.1", "--port", "auto")
"""Options of Rerun's viewer. Its server listens on every network of the computer unless told
otherwise, and hands the file to whatever listens on its usual port, maybe another user's."""


@contextmanager
def viewer(*arguments: str, environment: dict[str, str]) -> Iterator[subprocess.Popen[bytes]]:
    """Run Rerun's program while the block runs; nothing of it is left afterwards.

    It has a session of its own, because it starts another program, which outlives it otherwise.
    """
    # what it prints is for people: standard output has nothing but the command's result
    process = subprocess.Popen(
        [program(), *ALONE, *arguments], env=environment, stdout=2, start_new_session=True
    )
    try:
        yield process
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGTERM)
        with suppress(subprocess.TimeoutExpired):
            process.wait(10)
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait(10)


def program() -> str:
    """Rerun's own program.

    Raises:
        StoreError: it cannot be found.
    """
    import sys

    sibling = Path(sys.executable).with_name("rerun")
    found = str(sibling) if sibling.exists() else shutil.which("rerun")
    if found is None:
        raise StoreError("Rerun's program `rerun` cannot be found beside its library")
    return found


@contextmanager
def silent() -> Iterator[dict[str, str]]:
    """An environment in which Rerun's viewer sends nothing home.

    Its only switch is a file among the user's settings. It is set in a folder of ours, so that the
    user's own choice stays what it is.

    Raises:
        StoreError: the switch could not be set.
    """
    with tempfile.TemporaryDirectory(prefix="sliplab-rerun-") as folder:
        environment = {**os.environ, "XDG_CONFIG_HOME": folder}
        done = subprocess.run(
            [program(), "analytics", "disable"], env=environment, capture_output=True, timeout=60,
            check=False,
        )  # fmt: skip
        if done.returncode:
            raise StoreError(f"Rerun's analytics cannot be switched off: {done.stderr.decode()}")
        yield environment
