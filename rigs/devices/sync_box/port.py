"""The serial port of a sync box: questions with answers, and a thread that reads all else.

The thread notes when each line arrived, so that an answer's time does not depend on who waits for
it. Every wait ends: the limits stand in `SyncBoxSettings` and in the constants here.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable

import serial

from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.devices.sync_box.line import NAME, LineReader, seal
from sliplab.rigs.devices.sync_box.settings import SyncBoxSettings

DEVICE = "sync box"
TRIES = 3
"""Tries of a request whose answer is missing or garbled."""
READ_S = 0.05
"""The reading thread looks this often whether it shall end."""
JOIN_S = 1.0
"""Time for which `close` waits for the reading thread."""
MOST_ANSWERS = 64
"""Lines kept that nobody asked for."""


class SyncBoxFault(RigError):
    """The box began anew, fell silent or went away: what it sent since is not to be trusted."""

    def __init__(self, message: str) -> None:
        super().__init__(DEVICE, message)


class SyncPort:
    """One open port, from `SyncPort(...)` to `close`.

    Args:
        settings: port and time limits.
        now_ns: the host's monotonic clock.
        take: is given each line's body in the reading thread, `news` held; what it does not want
            (False) may be an answer. A `ValueError` of it is a garbled line.

    Attributes:
        news: held by whoever looks at what the reading thread changes.
        fault: the first one, while `news` is held; everything raises it from then on.
        lines: cuts lines, and counts garbled ones.
        read_to_ns: all that came before this time of the host's has been taken; a host that was
            busy for a while has not heard a silence.

    Raises:
        SyncBoxFault: no such port, or no sync box with this protocol behind it, after `boot_s` and
            three answers at the most.
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
                f"the rig file names its port and that no other program holds it"
            ) from error
        self._thread = threading.Thread(target=self._listen, name="sync box", daemon=True)
        self._thread.start()
        try:
            self._greet()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Give the port back; any number of times."""
        self._closing.set()
        self._thread.join(JOIN_S)
        self._serial.close()

    def ask(self, question: str, answer: str) -> tuple[str, int, int]:
        """Ask until there is an answer that begins with `answer`, `TRIES` times at the most.

        Returns:
            What follows `answer`, and the host's times before asking and behind the answer, ns.

        Raises:
            SyncBoxFault: no answer, or the box refuses.
        """
        for _ in range(TRIES):
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
        """Remember the first fault; `news` is held."""
        if self.fault is None:
            self.fault = fault
        self.news.notify_all()

    def check(self) -> None:
        """Raise the fault if there is one; `news` is held."""
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
                f"{self._settings.port} answers as '{found[0]}', not as '{NAME}': flash the "
                f"firmware that belongs to this version (docs/sync-box.md)"
            )
        with self.news:
            self._greeted = True
        self.ask("STOP", "OK STOP")  # a train of whoever came before

    def _try(self, question: str, answer: str) -> tuple[str, int, int] | None:
        """Ask once; None where no answer comes in time, or the box could not read the question."""
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
                self.fail(began_anew("it said so"))
            return
        try:
            if not self._take(body):
                self._answers.append((body, arrived_ns))
        except ValueError:
            self.lines.wrong += 1


def began_anew(how: str) -> SyncBoxFault:
    """The board was reset; `how` says how one knows."""
    return SyncBoxFault(
        f"the board began anew ({how}); its clock is another one now. Check its supply and "
        f"USB cable, then start the trial again"
    )


def _gone(error: Exception) -> SyncBoxFault:
    return SyncBoxFault(f"the connection broke ({error}). Plug it in, then start the trial again")
