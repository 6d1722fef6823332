"""Where there is no terminal a bar says now and then how far it is, and nothing in between."""

from __future__ import annotations

import io
from types import SimpleNamespace

import pytest
from rich.console import Console

from flows.running import console


class Clock:
    """Seconds that go by when the test says so."""

    def __init__(self) -> None:
        self.s = 0.0

    def __call__(self) -> float:
        return self.s


def lines(monkeypatch: pytest.MonkeyPatch, *, terminal: bool, left: str | None) -> list[str]:
    """What a bar of six steps of 25 s writes."""
    out, clock = io.StringIO(), Clock()
    to = Console(file=out, force_terminal=terminal, soft_wrap=True, highlight=False)
    monkeypatch.setattr(console, "messages", to)
    monkeypatch.setattr("flows.running.console.time", SimpleNamespace(monotonic=clock))
    with console.bar("grid", 6, left) as bar:
        for k in range(6):
            clock.s += 25.0
            bar.advance(note=f"trial {k + 1}", left=left or "")
    return [line for line in out.getvalue().splitlines() if line]


def test_a_log_gets_a_line_a_minute(monkeypatch: pytest.MonkeyPatch) -> None:
    said = lines(monkeypatch, terminal=False, left="1 h left")
    assert said == ["grid: 3 of 6, 1 h left, trial 3", "grid: 6 of 6, 1 h left, trial 6"]


def test_the_time_that_is_left_is_the_bars_own_guess(monkeypatch: pytest.MonkeyPatch) -> None:
    first, last = lines(monkeypatch, terminal=False, left=None)
    assert first.startswith("grid: 3 of 6, ")
    assert first.endswith(" left, trial 3")
    assert last.startswith("grid: 6 of 6, ")


def test_a_terminal_has_the_bar_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    assert not any(line.startswith("grid: ") for line in lines(monkeypatch, terminal=True, left=""))
