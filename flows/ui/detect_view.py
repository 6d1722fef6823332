"""Live detection on the terminal: bars that are drawn again and again, or a line a change."""

from __future__ import annotations

import time
from collections import deque
from types import TracebackType

from rich.console import Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from sliplab.analysis.detectors.live import TimedDecision
from sliplab.analysis.metrics.classification import CLASSES, GROSS, INCIPIENT
from sliplab.flows.running import console

EVERY_NS = 150_000_000
"""The shortest time between two drawings: drawing takes milliseconds that detection lacks."""
WIDTH = 30
LAST = 5
_STYLES = ("green", "yellow", "red")


class DetectView:
    """A context manager; on anything but a terminal it prints a line at each change of state.

    Args:
        title: says "simulated" where that is so.
        most: spikes that a class can give in a window; None for a detector without a network.
    """

    def __init__(self, title: str, most: int | None) -> None:
        self._title, self._most = title, most
        self._rate: deque[tuple[float, int]] = deque(maxlen=34)
        self._last: deque[str] = deque(maxlen=LAST)
        self._state = ""
        self._now: TimedDecision | None = None
        self._drawn_ns = 0
        self._live: Live | None = None
        if console.messages.is_terminal:
            self._live = Live(console=console.messages, auto_refresh=False)

    def __enter__(self) -> DetectView:
        if self._live is not None:
            self._live.start()
        else:
            console.say(self._title)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._live is not None:
            self._draw()
            self._live.stop()

    def on_decision(self, timed: TimedDecision) -> None:
        """Take up a decision."""
        made = timed.decision
        self._now = timed
        self._rate.append((made.end_us - made.start_us, made.events))
        if timed.state != self._state or made.onset is not None:
            self._state = timed.state
            line = _line(timed)
            self._last.append(line)
            if self._live is None:
                console.say(line)

    def poll(self) -> None:
        """Draw again, if `EVERY_NS` have passed."""
        if self._live is None or time.monotonic_ns() - self._drawn_ns < EVERY_NS:
            return
        self._draw()
        self._drawn_ns = time.monotonic_ns()

    def _draw(self) -> None:
        assert self._live is not None
        self._live.update(self._picture(), refresh=True)

    def _picture(self) -> Group:
        table = Table.grid(padding=(0, 1))
        timed = self._now
        smoothed = None if timed is None else timed.decision.smoothed
        for number, name in enumerate(CLASSES if self._most else ()):
            mean = 0.0 if smoothed is None else smoothed[number]
            filled = min(WIDTH, round(WIDTH * mean / (self._most or 1)))
            bar = Text("█" * filled + "·" * (WIDTH - filled), style=_STYLES[number])
            table.add_row(name.replace("_", " "), bar, f"{mean:5.2f}")
        slipped = None if timed is None else timed.decision.slipped
        if slipped is not None:
            bar = Text("█" * round(WIDTH * slipped) + "·" * (WIDTH - round(WIDTH * slipped)))
            table.add_row("tips slipped", bar, f"{100 * slipped:3.0f} %")
        if timed is None:
            return Group(Text(self._title), table, Text("no window yet"))
        span_us = sum(part[0] for part in self._rate)
        rate = sum(part[1] for part in self._rate) / span_us * 1e6 if span_us else 0.0
        valid = timed.decision.valid_class
        style = {INCIPIENT: "bold yellow", GROSS: "bold red"}.get(valid, "bold green")
        state = Text(f"{timed.state.replace('_', ' '):<10}", style=style if valid >= 0 else "dim")
        state.append(f"  {timed.trial_s:8.2f} s  {timed.phase}  {rate:,.0f} events/s", "default")
        return Group(Text(self._title), table, state, *(Text(line) for line in self._last))


def _line(timed: TimedDecision) -> str:
    made = timed.decision
    said = f"evidence {made.value:.3g}"
    if made.counts is not None:
        said = f"spikes {'/'.join(str(count) for count in made.counts)}"
    if made.slipped is not None:
        said += f", {100 * made.slipped:.0f} % of the tips slipped"
    late = "" if timed.latency_ms is None else f", {timed.latency_ms:.1f} ms after its last event"
    onset = f"; first {made.onset}" if made.onset else ""
    phase = f" ({timed.phase})" if timed.phase else ""
    return (
        f"{timed.trial_s:8.3f} s{phase} camera {made.end_us} us: "
        f"{timed.state.replace('_', ' ')}, {said}{late}{onset}"
    )
