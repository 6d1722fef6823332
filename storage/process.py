"""Processes: their identity (pid and start time, since pids are reused), and children's ends."""

from __future__ import annotations

import ctypes
import fcntl
import getpass
import multiprocessing
import os
import signal
import socket
import subprocess
import sys
import threading
import weakref
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from functools import partial
from multiprocessing import resource_tracker
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sliplab.storage.errors import masked

if TYPE_CHECKING:
    from sliplab.storage.streams import Json

_COMMAND_CHARACTERS = 300
_STARTED = 19
"""Field of /proc/PID/stat after the name: when it started, ticks since the machine did."""
_USED = 11
"""Fields for the time that it used, in user mode and in the kernel."""
_OF_TERMINAL = signal.SIGINT, signal.SIGHUP
"""Signals that a terminal sends to all of its processes."""
_F_SETSIG = 10
"""Linux's `fcntl` command that chooses the signal of O_ASYNC; Python has no name for it."""


def give_memory_back() -> None:
    """Return freed memory to the system, which glibc's allocator keeps between what is in use."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


def this_process() -> Json:
    """Return ``pid``, ``host``, ``user``, ``command``, ``since``, ``boot`` and ``ticks``."""
    return {
        "pid": os.getpid(),
        "host": socket.gethostname(),
        "user": user_name(),
        "command": masked(f"sliplab {' '.join(sys.argv[1:])}")[:_COMMAND_CHARACTERS].strip(),
        "since": now(),
        "boot": _boot(),
        "ticks": started_ticks(os.getpid()),
    }


def now() -> str:
    """Return the time in UTC, to a second, as ISO 8601."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def user_name() -> str:
    """Return the name of the user, or the number of one without a name."""
    try:
        return getpass.getuser()
    except (OSError, KeyError):
        return f"user {os.getuid()}"


def started_ticks(pid: int) -> int | None:
    """Return when a process began, ticks after the machine did; None if it is gone or hidden.

    A process that ended and was not waited for yet counts as gone.
    """
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        return None if fields[0] in {"Z", "X"} else int(fields[_STARTED])
    except (OSError, ValueError, IndexError):
        return None


def used_s(pid: int) -> float:
    """Return the processor time that a process has used, s; 0 if it is gone."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[_USED]) + int(fields[_USED + 1])) / os.sysconf("SC_CLK_TCK")
    except (OSError, ValueError, IndexError):
        return 0.0


def is_here(who: Json) -> bool:
    """Return whether the process that `this_process` described runs on this machine, now."""
    pid = who.get("pid")
    if not isinstance(pid, int) or who.get("boot") != _boot() or who.get("ticks") is None:
        return False
    return bool(started_ticks(pid) == who["ticks"])


def send(who: Json, number: signal.Signals) -> bool:
    """Send a signal to the process that `this_process` described, and to no other.

    Returns:
        False if it does not run on this machine any more, or belongs to another user.
    """
    if not isinstance(who.get("pid"), int) or not hasattr(os, "pidfd_open"):
        return False
    try:
        handle = os.pidfd_open(who["pid"])  # from here on its number cannot pass to another
    except OSError:
        return False
    try:
        if not is_here(who):
            return False
        signal.pidfd_send_signal(handle, number)
        return True
    except OSError:
        return False
    finally:
        os.close(handle)


def named(who: Json) -> str:
    """Name a process: ``pid 12 of anna on bench, `sliplab collect ...`, since ...``.

    Another user may have written it: nothing in it reaches a terminal that is no plain text.
    """
    if "pid" not in who:
        return "an unknown program"
    who = {key: _printable(value) for key, value in who.items()}
    text = f"pid {who['pid']}"
    for word, key in (("of", "user"), ("on", "host")):
        if who.get(key):
            text += f" {word} {who[key]}"
    if who.get("command"):
        text += f", `{who['command']}`"
    if who.get("store"):
        text += f", for the store {who['store']}"
    return text + (f", since {who['since']}" if who.get("since") else "")


def _printable(value: object) -> str:
    text = "" if value is None else str(value)[:_COMMAND_CHARACTERS]
    return "".join(letter if letter.isprintable() else "?" for letter in text)


def _boot() -> str:
    """Return the id of this run of the machine."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    except OSError:
        return ""


def leave_to_parent() -> None:
    """Leave Ctrl-C and a closed terminal, which reach every process of it, to the parent.

    A parent that is killed handles nothing: its children end with it. By themselves they would
    stay, each waiting at a pipe whose other end the next one holds open.
    """
    for number in _OF_TERMINAL:
        signal.signal(number, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent,), name="parent", daemon=True).start()


@contextmanager
def out_of_reach() -> Iterator[None]:
    """Start child processes in the block: a signal of the terminal does not reach them.

    They inherit the mask of blocked signals, so that none interrupts them before they have come to
    `leave_to_parent`. This process gets those that came meanwhile when the block ends.
    """
    resource_tracker.ensure_running()  # which starts with the first child, and unblocks Ctrl-C
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _OF_TERMINAL)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _end_with(parent: BaseProcess) -> None:
    parent.join()  # bounded by the parent's life
    os._exit(1)


class Child(subprocess.Popen[bytes]):
    """A program in a session of its own, out of reach of the terminal's signals.

    Args:
        options: of `subprocess.Popen`.

    Raises:
        OSError: it cannot be started.
    """

    def __init__(self, command: Sequence[str], **options: Any) -> None:
        super().__init__(command, start_new_session=True, **options)

    def stop(self, limit_s: float, *, at_once: bool = False, group: bool = False) -> None:
        """End the program, and wait for that; safe to call more than once, in any thread.

        Args:
            limit_s: time to end when asked, and again when killed.
            at_once: kill it without asking first.
            group: end what it started, too, which may outlive it.
        """
        send = partial(os.killpg, self.pid) if group else self.send_signal
        # one that was stopped would not see that it is asked
        asked = [] if at_once else [(signal.SIGTERM, signal.SIGCONT)]
        for numbers in (*asked, (signal.SIGKILL,)):
            for number in numbers:
                with suppress(ProcessLookupError):
                    send(number)
            with suppress(subprocess.TimeoutExpired):
                self.wait(limit_s)


def start_tethered(command: Sequence[str], **options: Any) -> Child:
    """Start a foreign program that ends with this process.

    The kernel kills it and its process group when this process ends, however it ends: it does so
    when the last writer of a pipe is gone that the program inherits.

    Args:
        options: of `subprocess.Popen`.

    Raises:
        OSError: it cannot be started.
    """
    theirs, ours = os.pipe()
    try:
        process = Child(command, pass_fds=[theirs], **options)
        weakref.finalize(process, os.close, ours)
        with suppress(OSError):  # a kernel without it
            fcntl.fcntl(theirs, fcntl.F_SETOWN, -process.pid)
            fcntl.fcntl(theirs, _F_SETSIG, signal.SIGKILL)
            fcntl.fcntl(theirs, fcntl.F_SETFL, os.O_ASYNC)
    except BaseException:
        os.close(ours)
        raise
    finally:
        os.close(theirs)
    return process
