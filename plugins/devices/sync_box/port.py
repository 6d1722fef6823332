"""The serial port of a sync box: requests with answers, and a thread that reads all lines.

The thread records the arrival time of each line, so an answer's time does not depend on the thread
that waits for it. Every wait has a timeout, in `SyncBoxSettings` or in the constants here.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable

import serial

from sliplab.plugins.devices.sync_box.line import NAME, LineReader, seal
from sliplab.plugins.devices.sync_box.settings import SyncBoxSettings
from sliplab.rigs.core.capabilities import RigError

DEVICE = "sync box"
TRIES = 3
"""Attempts at a request whose answer is missing or garbled."""
READ_S = 0.05
"""Period at which the reading thread checks whether to end."""
JOIN_S = 1.0
"""Timeout for the reading thread to end in `close`."""
MOST_ANSWERS = 64
"""Buffered lines that no request waits for."""


class SyncBoxFault(RigError):
    """The box restarted, fell silent or was disconnected; its data since then are invalid."""

    def __init__(self, message: str) -> None:
        super().__init__(DEVICE, message)


class SyncPort:
    """One open port, from construction to `close`.

    Args:
        settings: port and timeouts.
        now_ns: the host's monotonic clock.
        take: called with each line's body in the reading thread, with `news` held; returns False
            for a line that may be an answer. A `ValueError` marks a garbled line.

    Attributes:
        news: condition to hold while reading state that the reading thread changes.
        fault: the first fault; read with `news` held. Every call raises it from then on.
        lines: splits lines, and counts garbled ones.
        read_to_ns: host time up to which all data have been read; a delay of the host is not
            silence of the box.

    Raises:
        SyncBoxFault: no such port, or no sync box with this protocol on it, after `boot_s` and
            three answers at most.
    """

    def __init__(
        self,
        settings: SyncBoxSettings,
        now_ns: Callable[[], int],
        take: Callable[[str], bool],
    ) -> None:
        self._settings, self._now_ns, self._take = settings, now_ns, take
        self.news = threading.Condition()
        self.fault: SyncBoxFault | None = None
        self.lines = LineReader()
        self.read_to_ns = now_ns()
        self._answers: deque[tuple[str, int]] = deque(maxlen=MOST_ANSWERS)
        self._greeted = False
        self._tries = 0
        self._closing = threading.Event()
        try:
            self._serial = serial.Serial(
                settings.port,
                settings.baud,
                timeout=READ_S,
                write_timeout=settings.answer_s,
                exclusive=True,
            )
        except (OSError, ValueError) as error:
            raise SyncBoxFault(
                f"cannot open {settings.port}: {error}. Check that the box is plugged in, that "
                f"the rig file names its port and that no other program is using it"
            ) from error
        self._thread = threading.Thread(target=self._listen, name="sync box", daemon=True)
        self._thread.start()
        try:
            self._greet()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the port; safe to call more than once."""
        self._closing.set()
        self._thread.join(JOIN_S)
        self._serial.close()

    def ask(self, question: str, answer: str, numbered: bool = False) -> tuple[str, int, int]:
        """Send a request until an answer begins with `answer`, at most `TRIES` times.

        Args:
            numbered: number each try, because a late answer must not be taken for the next one.

        Returns:
            the text after `answer`, and the host's times before the request and at the answer, ns.

        Raises:
            SyncBoxFault: no answer, or the box refuses.
        """
        for _ in range(TRIES):
            if numbered:
                self._tries += 1
                found = self._try(f"{question} {self._tries}", f"{answer} {self._tries} ")
            else:
                found = self._try(question, answer)
            if found is not None:
                return found
        fault = SyncBoxFault(
            f"no answer to {question.split()[0]} in {TRIES * self._settings.answer_s:g} s. Check "
            f"its cable and supply, then start the trial again"
        )
        with self.news:
            self.fail(fault)
        raise fault

    def fail(self, fault: SyncBoxFault) -> None:
        """Store the first fault; call with `news` held."""
        if self.fault is None:
            self.fault = fault
        self.news.notify_all()

    def check(self) -> None:
        """Raise the fault if there is one; call with `news` held."""
        if self.fault is not None:
            raise self.fault

    def _greet(self) -> None:
        deadline = self._now_ns() + round(self._settings.boot_s * 1e9)
        while (found := self._try("ID?", "ID ")) is None:
            if self._now_ns() > deadline:
                raise SyncBoxFault(
                    f"no answer on {self._settings.port} within {self._settings.boot_s:g} s. Check "
                    f"that this is the box's port, that it runs at {self._settings.baud} baud and "
                    f"that its firmware is flashed (docs/sync-box.md)"
                )
        if found[0] != NAME:
            raise SyncBoxFault(
                f"{self._settings.port} identifies itself as '{found[0]}', not '{NAME}': flash the "
                f"firmware of this SlipLab version (docs/sync-box.md)"
            )
        with self.news:
            self._greeted = True
        self.ask("STOP", "OK STOP")  # end a train of an earlier client

    def _try(self, question: str, answer: str) -> tuple[str, int, int] | None:
        """Send a request once; None if it times out, or if the box received it garbled."""
        with self.news:
            self._answers.clear()
        before_ns = self._now_ns()
        try:
            self._serial.write(seal(question))
        except (OSError, serial.SerialException) as error:
            with self.news:
                self.fail(_gone(error))
        deadline = before_ns + round(self._settings.answer_s * 1e9)
        with self.news:
            while True:
                self.check()
                while self._answers:
                    body, after_ns = self._answers.popleft()
                    if body.startswith(answer):
                        return body.removeprefix(answer), before_ns, after_ns
                    if body == "E checksum":
                        return None
                    if body.startswith("E "):
                        raise SyncBoxFault(f"refuses {question.split()[0]}: {body[2:]}")
                left_s = (deadline - self._now_ns()) / 1e9
                if left_s <= 0:
                    return None
                self.news.wait(left_s)

    def _listen(self) -> None:
        while not self._closing.is_set():
            began_ns = self._now_ns()
            try:
                data = self._serial.read(self._serial.in_waiting or 1)
                arrived_ns = self._now_ns()
                with self.news:
                    for body in self.lines.bodies(data):
                        self._sort(body, arrived_ns)
                    self.read_to_ns = began_ns
                    self.news.notify_all()
            except Exception as error:  # a thread that dies must not look like a silent box
                with self.news:
                    self.fail(_gone(error))
                return

    def _sort(self, body: str, arrived_ns: int) -> None:
        if body.startswith("B "):
            if self._greeted:
                self.fail(restarted("start message received"))
            return
        try:
            if not self._take(body):
                self._answers.append((body, arrived_ns))
        except ValueError:
            self.lines.wrong += 1


def restarted(how: str) -> SyncBoxFault:
    """Return the fault of a board that was reset; `how` names the evidence."""
    return SyncBoxFault(
        f"the board restarted ({how}), so its clock was reset. Check its supply and "
        f"USB cable, then start the trial again"
    )


def _gone(error: Exception) -> SyncBoxFault:
    return SyncBoxFault(f"the connection broke ({error}). Plug it in, then start the trial again")
