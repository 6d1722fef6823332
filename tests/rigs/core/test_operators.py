"""A person at the plate is asked, and believed; and the clock of the computer that asks."""

from __future__ import annotations

import os
import threading
import time

import pytest

from sliplab.rigs.core.capabilities import Clock, Operator, Plate, RigError
from sliplab.rigs.core.host_clock import HostClock
from sliplab.rigs.core.operators import ConsoleOperator, PersonAtPlate, mass_of


class Person:
    """Says yes or no, and remembers what was asked."""

    def __init__(self, willing: bool = True) -> None:
        self.willing = willing
        self.asked: list[tuple[str, str, str]] = []

    def ask(self, task: str, prompt: str, expected: str) -> bool:
        self.asked.append((task, prompt, expected))
        return self.willing


def test_a_person_is_a_plate_and_an_operator() -> None:
    person = PersonAtPlate(Person(), 0.165)
    assert isinstance(person, Plate)
    assert isinstance(person, Operator)


def test_a_person_is_told_what_to_do_with_the_plate() -> None:
    asked = Person()
    plate = PersonAtPlate(asked, 0.165)
    plate.act("raise", 0.5)
    plate.act("release", 1.5)
    plate.act("catch", 0.0)
    assert [word for _, _, word in asked.asked] == ["raised", "released", "caught"]
    assert "over 1.5 s" in asked.asked[1][1]
    assert {task for task, _, _ in asked.asked} == {"plate"}


def test_what_was_not_done_is_an_error_that_says_what() -> None:
    plate = PersonAtPlate(Person(willing=False), 0.165)
    with pytest.raises(RigError, match=r"'let go of the plate.*over 2 s' was not confirmed"):
        plate.act("release", 2.0)


def test_a_confirmed_changeover_mounts_its_mass_and_nothing_else_does() -> None:
    asked = Person()
    plate = PersonAtPlate(asked, 0.165)
    assert plate.ask("clean", "Wipe the plate.", "clean")
    assert plate.mass_kg() == 0.165
    assert plate.ask("changeover", "Mount the plate.", "0.245 kg")
    assert plate.mass_kg() == 0.245
    asked.willing = False
    assert not plate.ask("changeover", "Mount the plate.", "0.5 kg")
    assert plate.mass_kg() == 0.245


@pytest.mark.parametrize(("said", "kg"), [("0.205 kg", 0.205), (" 165 g ", 0.165), ("1kg", 1.0)])
def test_masses_are_read_with_their_unit(said: str, kg: float) -> None:
    assert mass_of(said) == pytest.approx(kg)


@pytest.mark.parametrize("said", ["", "0.2", "0 kg", "-1 kg", "2 lb", "heavy", "1,5 kg"])
def test_a_mass_that_cannot_be_read_is_refused_before_anybody_is_asked(said: str) -> None:
    asked = Person()
    with pytest.raises(RigError, match=r"expected a mass such as 0\.205 kg"):
        PersonAtPlate(asked, 0.165).ask("changeover", "Mount it.", said)
    assert asked.asked == []


def test_the_hosts_clock_is_the_one_that_drivers_stamp_by() -> None:
    clock = HostClock()
    assert isinstance(clock, Clock)
    before = time.monotonic_ns()
    now = clock.now_ns()
    assert before <= now <= time.monotonic_ns()
    clock.wait(0.02)
    assert clock.now_ns() - now >= 20_000_000
    clock.wait(-1.0)  # nothing to wait for


def test_a_question_that_nobody_waits_for_takes_no_answer(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """After a fault the rig asks something else while the first question is still open."""
    ours, theirs = os.openpty()
    with open(theirs) as terminal:
        monkeypatch.setattr("sys.stdin", terminal)
        console, first, answer = ConsoleOperator(), list[bool](), list[bool]()
        old = threading.Thread(target=lambda: first.append(console.ask("plate", "raise", "raised")))
        old.start()
        while "raised" not in capsys.readouterr().err:
            assert old.is_alive()
        new = threading.Thread(target=lambda: answer.append(console.ask("mass", "mount", "0.2 kg")))
        new.start()
        old.join(10.0)
        assert first == [False]
        os.write(ours, b"wrong\n0.2 kg\n")
        new.join(10.0)
        assert answer == [True]
    os.close(ours)
