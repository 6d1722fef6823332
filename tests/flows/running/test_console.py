"""Without a terminal a progress bar prints a line at intervals and nothing in between."""

from __future__ import annotations

import io
import json
from dataclasses import dataclass
from types import SimpleNamespace

import pytest
from rich.console import Console

from sliplab.flows.running import console
from sliplab.storage.schema.evaluation import Share


class Clock:
    """Seconds that go by when the test says so."""

    def __init__(self) -> None:
        self.s = 0.0

    def __call__(self) -> float:
        return self.s


def lines(monkeypatch: pytest.MonkeyPatch, *, terminal: bool, left: str | None) -> list[str]:
    """Return the output of a progress bar of six steps of 25 s."""
    out, clock = io.StringIO(), Clock()
    to = Console(file=out, force_terminal=terminal, soft_wrap=True, highlight=False)
    monkeypatch.setattr(console, "messages", to)
    monkeypatch.setattr("sliplab.flows.running.console.time", SimpleNamespace(monotonic=clock))
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


ID = "depth=3.4mm,direction=180deg,speed=0.6mmps,r=1"
COLUMNS = ["campaign", "trial", "recorded_s", "events", "cause"]
ROW = ["pilot", ID, 17.0, 216982, "gate: [/b] sync_uncertainty_arm_s is 68 us"]


def table(monkeypatch: pytest.MonkeyPatch, width: int | None, *, spare: int = 0) -> list[str]:
    """Print one row on so many columns."""
    out = io.StringIO()
    monkeypatch.setattr(console, "results", Console(file=out, width=width, color_system=None))
    console.print_table("trials", COLUMNS, [ROW], spare=spare)
    return [line.rstrip() for line in out.getvalue().splitlines() if line.strip()]


@pytest.mark.parametrize("width", [40, 60, 80, 100, 200])
def test_no_id_is_broken_at_any_width(monkeypatch: pytest.MonkeyPatch, width: int) -> None:
    for spare in (0, 3):
        lines = table(monkeypatch, width, spare=spare)
        assert sum(ID in line for line in lines) == 1
        words = {word for line in lines for word in line.split()}
        assert spare or set(COLUMNS) | set(str(ROW[4]).split()) <= words


@pytest.mark.parametrize(("width", "shown"), [(200, 5), (110, 5), (85, 4), (75, 3), (62, 2)])
def test_columns_are_left_out_so_that_rows_fit(
    monkeypatch: pytest.MonkeyPatch, width: int, shown: int
) -> None:
    lines = table(monkeypatch, width, spare=3)
    assert lines[1].split() == COLUMNS[:shown]
    assert all(len(line) <= width for line in lines)


def outside(monkeypatch: pytest.MonkeyPatch, cells: list[list[object]], spare: int = 0) -> str:
    """Print a table where there is no terminal, and return the text."""
    monkeypatch.delenv("COLUMNS", raising=False)
    out = io.StringIO()
    monkeypatch.setattr("sys.stdout", out)
    width = console.results_width()
    monkeypatch.setattr(console, "results", Console(file=out, width=width, color_system=None))
    console.print_table("trials " + "of a store " * 20, COLUMNS, cells, spare=spare)
    return out.getvalue()


@pytest.mark.parametrize(
    "row",
    [
        ROW,
        [*ROW[:4], "a cause of many words " * 60],
        [*ROW[:4], "/data/" + "campaign/" * 90],
        ["campaign" * 9, ID * 3, 17.0, 216982, "campaign/" * 20],
    ],
    ids=["short", "many words", "a long path", "three long words"],
)
def test_tables_outside_a_terminal_have_120_columns_and_no_trailing_blanks(
    monkeypatch: pytest.MonkeyPatch, row: list[object]
) -> None:
    text = outside(monkeypatch, [row] * 2)
    lines = text.splitlines()
    assert max(map(len, lines)) <= console.WIDTH == 120
    assert [line for line in lines if line != line.rstrip()] == []
    for cell in row:  # nothing is left out
        assert (str(cell)[:4] if isinstance(cell, str) else f"{cell:.0f}") in text
    assert sum(c in "abcdefg" for c in text) >= 2 * sum(
        c in "abcdefg" for c in "".join(map(str, row))
    )


def test_spare_columns_are_left_out_outside_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    text = outside(monkeypatch, [[*ROW[:4], "campaign/" * 20]], spare=1)
    assert ID in text
    assert "cause" not in text


def test_no_path_of_a_result_is_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    path = "/data/" + "campaign/" * 12 + "page.html"
    out = io.StringIO()
    monkeypatch.setattr(console, "results", Console(file=out, width=80, color_system=None))
    console.print_pairs("report", {"page": path, "trials": 3})
    assert path in out.getvalue()


def test_data_are_neither_control_codes_nor_markup(capsys: pytest.CaptureFixture[str]) -> None:
    text = "\x1b]0;title\x07 \x9b31m \u202e [red]x[/] [/no]"
    with pytest.MonkeyPatch.context() as patch:
        out = io.StringIO()
        patch.setattr(console, "results", Console(file=out, width=500, highlight=False))
        patch.setattr(console, "messages", Console(file=out, soft_wrap=True, highlight=False))
        console.print_table(text, ["a", text], [[text, 1.5], [None, text]])
        console.print_pairs(text, {text: text})
        console.say(text)
        with console.bar(text, 2) as bar:
            bar.advance(note=text)
        console.print_json({"a": text})
    shown = out.getvalue()
    assert shown.count("\\x1b]0;title\\x07 \\x9b31m \\u202e [red]x[/] [/no]") >= 7
    written = capsys.readouterr().out
    assert json.loads(written) == {"a": text}
    for steers in "\x1b\x07\x9b\u202e":
        assert steers not in shown
        assert steers not in written


def test_names_between_colons_are_no_pictures() -> None:
    with console.messages.capture() as said, console.results.capture() as shown:
        console.say("{a:b:}")
        console.print_pairs("pairs", {"key": "{a:b:}"})
        console.print_table("table", ["{a:b:}"], [["{a:b:}"]])
    assert said.get().count("{a:b:}") == 1
    assert shown.get().count("{a:b:}") == 3


def test_typed_values_are_printed_by_their_fields(capsys: pytest.CaptureFixture[str]) -> None:
    @dataclass(frozen=True)
    class Inner:
        name: str
        share: Share

    given = Share(share=0.5, low=None, high=None, n=2, trials=1)
    console.print_json({"step": "x", "inner": [Inner("a", given)]})
    assert capsys.readouterr().out == (
        '{"step": "x", "inner": [{"name": "a", "share": '
        '{"share": 0.5, "low": null, "high": null, "n": 2, "trials": 1}}]}\n'
    )
    with pytest.raises(TypeError, match="object has no form in JSON"):
        console.print_json({"step": object()})
