"""Trying many rules of a driver at once: nearly all of their time is waiting."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

from sliplab.plugins.driver_kit.conformance import Case
from sliplab.plugins.driver_kit.rule import NotTried, RuleBroken

AT_ONCE = 6
"""More would be late in one process: fakes drop packets that are, as networks do."""


def try_rule(case: Case) -> tuple[str, str]:
    """Return what was wrong, and why a rule was not tried; both empty if it holds."""
    try:
        case()
    except RuleBroken as error:
        return str(error), ""
    except NotTried as reason:
        return "", str(reason)
    return "", ""


def try_all(cases: Sequence[Case], at_once: int = AT_ONCE) -> tuple[dict[str, str], dict[str, str]]:
    """Return the broken rules, and those that were not tried, by name.

    Rules about what stays open are tried alone, after the others.
    """
    together = [case for case in cases if not case.rule.warm]
    alone = [case for case in cases if case.rule.warm]
    with ThreadPoolExecutor(at_once) as pool:
        found = list(pool.map(try_rule, together))
    found += [try_rule(case) for case in alone]
    named = zip((case.rule.name for case in (*together, *alone)), found, strict=True)
    results = dict(named)
    broken = {name: wrong for name, (wrong, _) in results.items() if wrong}
    return broken, {name: why for name, (_, why) in results.items() if why}


def each_apart(make: Callable[[], list[Case]]) -> list[Case]:
    """Return the cases of a driver, each with an address of its own."""
    return [make()[number] for number in range(len(make()))]
