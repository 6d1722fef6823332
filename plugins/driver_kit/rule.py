"""Rules of conformance, and their violations in words."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from sliplab.rigs.core.capabilities import RigError

BenchT = TypeVar("BenchT", bound="Any")


class RuleViolation(Exception):
    """An observation that breaks the rule being checked, in words."""


class NotTried(Exception):
    """A rule that cannot be tried on this driver, with the reason."""


class RuleBroken(AssertionError):
    """A driver that breaks a rule.

    Attributes:
        rule: name of the rule.
        seen: observation that breaks it.
    """

    def __init__(self, driver: str, rule: Rule[Any], seen: str) -> None:
        super().__init__(
            f"{driver} breaks the rule '{rule.name}'\n  seen:  {seen}\n  right: {rule.right}"
        )
        self.rule, self.seen = rule.name, seen


@dataclass(frozen=True)
class Bounds:
    """Time limits of a driver, s: as long as its documentation promises, at most."""

    connect_s: float = 10.0
    """Opening a device, also one that does not answer."""
    call_s: float = 5.0
    """Every other call, `stop` and `close` of a device that does not answer too."""
    news_s: float = 5.0
    """Time from a fault to a call that reports it."""


@dataclass(frozen=True)
class Rule(Generic[BenchT]):
    """One rule: its name, what would be right, and the check on a bench.

    Attributes:
        name: name in reports of tests, such as ``stop while moving``.
        right: what a driver must do, one sentence.
        check: raises `RuleViolation` where the driver does something else, `NotTried` where it
            cannot be tried. A `RigError` that it lets through is a fault that the driver made up.
    """

    name: str
    right: str
    check: Callable[[BenchT], None]
    warm: bool = False
    """Open another device first: libraries keep threads and files of their first use for good."""

    def hold(self, driver: str, bench: BenchT) -> None:
        """Check the rule.

        Raises:
            RuleBroken: the driver breaks it.
            NotTried: it cannot be tried on this driver.
        """
        try:
            self.check(bench)
        except RuleViolation as seen:
            raise RuleBroken(driver, self, str(seen)) from seen.__cause__
        except RigError as error:
            text = f"{bench.last_call} raised {type(error).__name__} where nothing was wrong: "
            raise RuleBroken(driver, self, f"{text}{error}") from error


class Rules(Generic[BenchT]):
    """The rules of a kind of device, in the order in which they are declared."""

    def __init__(self) -> None:
        self.all: list[Rule[BenchT]] = []

    def add(
        self, name: str, right: str, *, warm: bool = False
    ) -> Callable[[Callable[[BenchT], None]], Callable[[BenchT], None]]:
        """Declare the decorated check as a rule."""

        def declare(check: Callable[[BenchT], None]) -> Callable[[BenchT], None]:
            self.all.append(Rule(name, right, check, warm))
            return check

        return declare
