"""Wrong protocol and rig files through the command line: exit 2, one message that helps."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import pytest
import typer
import yaml

from sliplab.flows.cli.app import command_line
from sliplab.protocols.shown import MASK
from sliplab.storage.trials.store import TrialStore
from tests.command_line import here
from tests.conftest import ROOT

PILOT = (ROOT / "protocols" / "pilot.yaml").read_text()
ABB = (ROOT / "rigs" / "irb120.yaml").read_text().replace("ur5.yaml", f"{ROOT}/rigs/ur5.yaml")
MOTION = PILOT[PILOT.index("  motion:\n") : PILOT.index("  recording:\n")]
MINUS = "\N{MINUS SIGN}"
CASES = yaml.safe_load(Path(__file__).with_name("wrong_input.yaml").read_text())
PROTOCOLS, RIGS = CASES["protocols"], CASES["rigs"]


def refused(*arguments: object) -> str:
    """The first message of a command that refuses its input; others are of the same file."""
    done = here(*arguments)
    assert done.returncode == 2, done.stderr
    assert done.stdout == ""
    line, *more = done.stderr.splitlines()
    assert line.startswith("error: ")
    file = line.removeprefix("error: ").partition(": ")[0]
    assert [each for each in more if not each.startswith(f"{file}: ")] == []
    for each in (line, *more):
        assert not re.search(r"[\x00-\x1f\x7f-\x9f]|Decimal\(|datetime", each)
    return line


@pytest.mark.parametrize("command", ["plan", "check"])
@pytest.mark.parametrize("case", PROTOCOLS)
def test_a_wrong_protocol(case: str, command: str, tmp_path: Path) -> None:
    old, new, found, right = PROTOCOLS[case]
    old = MOTION if old == "MOTION" else old
    assert old in PILOT
    path = tmp_path / "wrong.yaml"
    path.write_text(PILOT.replace(old, new, 1))
    more = [] if command == "plan" else ["--rig", "mock", "--store", tmp_path / "store"]
    line = refused(command, path, *more)
    assert line.startswith(f"error: {path}: {found}: "), line
    assert right in line


@pytest.mark.parametrize("command", ["plan", "check", "rigs"])
@pytest.mark.parametrize("case", RIGS)
def test_a_wrong_rig_file(case: str, command: str, tmp_path: Path) -> None:
    old, new, found, right = (each.replace("MASK", MASK) for each in RIGS[case])
    assert old in ABB
    path = tmp_path / "rig.yaml"
    path.write_text(ABB.replace(old, new, 1))
    if command == "rigs":
        done = here("rigs", path, "--json")
        assert done.returncode == 2
        line = json.loads(done.stdout)["rigs"][0]["answer"]
    else:
        more = ["--store", tmp_path / "store"] if command == "check" else []
        line = refused(command, ROOT / "protocols/pilot.yaml", "--rig", path, *more)
    assert f"{path}: " in line
    assert found in line
    assert right in line
    for secret in ("hunter2", "12345", "12.34", "12,34", "robotics"):
        assert secret not in line


def _options(
    group: typer.Typer, prefix: str = ""
) -> dict[str, tuple[Any, typer.models.ParameterInfo]]:
    """Type and information of every numeric option of every command, by their names."""
    found = {}
    for command in group.registered_commands:
        assert command.callback is not None
        name = command.name or command.callback.__name__.replace("_", "-")
        hints = get_type_hints(command.callback, include_extras=True)
        for parameter, hint in hints.items():
            plain, *more = get_args(hint) if get_origin(hint) is Annotated else (hint,)
            leaves = {plain, *get_args(plain)}.union(*map(get_args, get_args(plain)))
            info = [item for item in more if isinstance(item, typer.models.ParameterInfo)]
            if leaves & {int, float} and info:
                found[f"{prefix}{name} {parameter}"] = (leaves, info[0])
    for inner in group.registered_groups:
        assert inner.typer_instance is not None
        found |= _options(inner.typer_instance, f"{inner.name} " if inner.name else prefix)
    return found


OPTIONS = _options(command_line())


def test_numeric_options_are_bounded() -> None:
    assert len(OPTIONS) > 40
    assert {"evaluate margin", "collect temperature_c"} <= OPTIONS.keys()
    assert [name for name, (_, info) in OPTIONS.items() if None in (info.min, info.max)] == []


@pytest.mark.parametrize("value", ["nan", "inf", "-inf", "1e400", "yes", "\N{MINUS SIGN}1"])
@pytest.mark.parametrize(
    "command",
    [
        "evaluate none --margin",
        "evaluate none --smoothing",
        "collect none.yaml --rig mock --store none --temperature",
        "collect none.yaml --rig mock --store none --humidity",
        "collect none.yaml --rig mock --store none --trials",
        "tradeoff none --width",
        "tradeoff none --length",
        "tradeoff none --minutes",
        "detect --model none --rig mock --stride",
        "detect --model none --rig mock --seconds",
        "teach plane --rig mock --span",
        "pause none --wait",
    ],
)
def test_options_take_finite_numbers_alone(command: str, value: str) -> None:
    words = command.split()
    assert f"{words[-1]} = {value}: " in refused(*words, value)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("dept=2.4", "--enable = dept=2.4: unknown factor dept; defined factors: depth, speed, "),
        ("depth", "--enable = depth: must be factor=level, such as depth=LEVEL"),
        ("", "--enable = '': unknown factor ; defined factors: depth, speed, direction"),
        (f"direction={MINUS}90", f"= {MINUS}90: holds U+2212 MINUS SIGN: write '-90'"),
        ("depth=2,4", "= 2,4: has a decimal comma: write '2.4'"),
        ("depth=nan", "= nan: must be a finite number"),
        ("depth=\x1b[31m", "= \\x1b[31m: must be a number"),
    ],
)
def test_levels_to_be_enabled(given: str, message: str) -> None:
    assert message in refused("plan", ROOT / "protocols" / "pilot.yaml", "--enable", given)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("holdout", "s3://bucket/x"), "s3://bucket/x: is a URL, not a folder"),
        (("check", "pilot", "--rig", "mock", "--store", "s3://b/x"), "s3://b/x: is a URL"),
        (
            ("import", "file:///x", "--store", "x", "--name", "x"),
            "file:///x: is a URL",
        ),
        (("evaluate", "x", "--margin", "nan"), "--margin = nan: must be a number"),
        (("pause", "x", "--wait", "-1"), "--wait = -1: must be greater than or equal to 0"),
    ],
)
def test_option_or_argument_of_another_kind_is_refused(words: tuple[str, ...], says: str) -> None:
    assert says in refused(*words)


def test_schema_without_a_kind_lists_the_kinds() -> None:
    assert here("schema").stdout.split()[:3] == ["protocol", "rig", "adapter"]


def test_requests_pass_their_options_on(tmp_path: Path) -> None:
    folder = TrialStore.create(tmp_path / "store").folder
    for words in (("pause", folder, "--why", "lunch", "--wait", "1"), ("resume", folder)):
        done = here(*words, "--who", "anna", "--json")
        assert done.returncode == 0, done.stderr
        assert json.loads(done.stdout)["who"] == "anna"
    assert here("stop", folder, "--wait", "1").returncode == 0
