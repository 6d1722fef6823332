"""Wrong protocol and rig files through the command line: exit 2, one message that helps."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import pytest
import typer

from sliplab.flows.cli.app import command_line
from sliplab.protocols.shown import MASK
from tests.command_line import here
from tests.conftest import ROOT

PILOT = (ROOT / "protocols" / "pilot.yaml").read_text()
ABB = (ROOT / "rigs" / "irb120.yaml").read_text().replace("ur5.yaml", f"{ROOT}/rigs/ur5.yaml")
MOTION = PILOT[PILOT.index("  motion:\n") : PILOT.index("  recording:\n")]
MINUS, MICRO, MU = "\N{MINUS SIGN}", "\N{MICRO SIGN}", "\N{GREEK SMALL LETTER MU}"

PROTOCOLS: dict[str, tuple[str, str, str, str]] = {
    # what is replaced, by what, the message's "key = value", and what would be right
    "decimal comma": (
        "depth: $depth, speed: 2 mm/s}",
        "depth: $depth, speed: 2,5 mm/s}",
        "collection.motion[1].speed = 2,5 mm/s",
        "write 2.5 mm/s",
    ),
    "decimal comma without a unit": (
        "{smoothing: 4,",
        "{margin: 8,5, ",
        "analysis.detection.margin = 8,5",
        "write 8.5",
    ),
    "decimal comma in text": (
        "depth: 3.6 mm",
        "depth: 3,6 mm",
        "collection.limits.depth = 3,6 mm",
        "write '3.6 mm'",
    ),
    "unicode minus": (
        "x: {low: -10 mm",
        f"x: {{low: {MINUS}10 mm",
        f"collection.limits.workspace.x.low = {MINUS}10 mm",
        "U+2212 MINUS SIGN: write '-10 mm'",
    ),
    "unicode minus in a level": (
        "values: [0, 90, 180, 270]",
        f"values: [0, {MINUS}90, 180]",
        f"collection.factors.direction.values[1] = {MINUS}90",
        "U+2212 MINUS SIGN: write '-90'",
    ),
    "micro sign": (
        "clearance: 20 mm",
        f"clearance: 5000 {MICRO}m",
        f"collection.limits.clearance = 5000 {MICRO}m",
        "U+00B5 MICRO SIGN: write '5000 um'",
    ),
    "greek mu": (
        "clearance: 20 mm",
        f"clearance: 5000 {MU}m",
        f"collection.limits.clearance = 5000 {MU}m",
        "U+03BC GREEK SMALL LETTER MU: write '5000 um'",
    ),
    "other digits": (
        "clearance: 20 mm",
        "clearance: \N{FULLWIDTH DIGIT TWO}0 mm",
        "collection.limits.clearance = \N{FULLWIDTH DIGIT TWO}0 mm",
        "U+FF12 FULLWIDTH DIGIT TWO: write '20 mm'",
    ),
    "a name that is a switch": ("name: pilot", "name: no", "name = no", "reads as a switch: quote"),
    "a name that is a day": (
        "name: pilot",
        "name: 2026-11-23",
        "name = 2026-11-23",
        "reads as a day: quote",
    ),
    "a name that is a number": (
        "name: pilot",
        "name: 1.50",
        "name = 1.50",
        "reads as a number: quote",
    ),
    "a list where a number belongs": (
        "depth: 3.6 mm",
        "depth: [2.4, {a: 0.5}]",
        "collection.limits.depth = [2.4, {a: 0.5}]",
        "must be a finite number with a unit",
    ),
    "empty motion": (MOTION, "  motion:\n", "collection.motion", "is empty; must be a list"),
    "no motion": (MOTION, "  motion: []\n", "collection.motion = []", "must begin with 'approach'"),
    "motion is no list": (
        MOTION,
        "  motion: {phase: approach}\n",
        "collection.motion = {phase: approach}",
        "must be a list",
    ),
    "a merge": (
        "  repetitions: 1",
        "  <<: {repetitions: 1}",
        "collection.<<",
        "merge keys ('<<') are not supported; write the keys out (line 14)",
    ),
    "a tag": (
        "depth: 3.6 mm",
        "depth: !include x",
        "collection.limits.depth = x",
        "the tag !include is not supported",
    ),
    "an alias": (
        "depth: 3.6 mm",
        "depth: *deep",
        "collection.limits.depth = *deep",
        "aliases are not supported",
    ),
    "which phase": (
        "depth: $depth",
        "depth: $dept",
        "collection.motion[1].depth = $dept",
        "unknown factor $dept; defined factors: depth, speed, direction",
    ),
    "escape bytes": ("name: pilot", 'name: "\\e[31mred"', "name = \\x1b[31mred", "pattern"),
    "escape bytes in a key": (
        "  repetitions: 1",
        '  "\\e]0;title\\a": 1',
        "collection.\\x1b]0;title\\x07 = 1",
        "unknown key",
    ),
    "text that runs backwards": (
        "name: pilot",
        'name: "\\u202Etolip"',
        "name = \\u202etolip",
        "pattern",
    ),
    "no day": (
        "name: pilot",
        "name: 2026-02-30",
        "name = 2026-02-30",
        "is not a valid date",
    ),
    "a name twice": (
        "  repetitions: 1",
        "  repetitions: 1\n  repetitions: 2",
        "collection.repetitions",
        "duplicate key (line 15)",
    ),
    "a letter of another alphabet": (
        "speed: $speed",
        "speed: $sp\N{CYRILLIC SMALL LETTER IE}ed",
        "collection.motion[3].speed = $sp\N{CYRILLIC SMALL LETTER IE}ed",
        "must be a factor's name after '$'",
    ),
    "a stratum in another alphabet": (
        "strata: [depth, speed]",
        "strata: [d\N{CYRILLIC SMALL LETTER IE}pth, speed]",
        "analysis.split.strata[0] = d\N{CYRILLIC SMALL LETTER IE}pth",
        "(holds U+0435 CYRILLIC SMALL LETTER IE); defined factors: depth, speed, direction",
    ),
    "a key in another alphabet": (
        "  repetitions: 1",
        "  rep\N{CYRILLIC SMALL LETTER IE}titions: 1",
        "collection.rep\N{CYRILLIC SMALL LETTER IE}titions = 1",
        "unknown key (holds U+0435 CYRILLIC SMALL LETTER IE); did you mean 'repetitions'?",
    ),
    "strata": (
        "strata: [depth, speed]",
        "strata: [depht, speed]",
        "analysis.split.strata[0] = depht",
        "unknown factor depht; defined factors: depth, speed, direction",
    ),
    "repetitions": ("repetitions: 1", "repetitions: yes", "collection.repetitions = yes", "number"),
    "false early": (
        "false_early_ms: 30",
        "false_early_ms: .inf",
        "analysis.detection.false_early_ms = .inf",
        "must be a finite number",
    ),
    "margin": ("smoothing: 4", "margin: .inf", "analysis.detection.margin = .inf", "finite number"),
    "a count": (
        "frames_lost: 0",
        "frames_lost: 1000000000000",
        "collection.gates.frames_lost = 1000000000000",
        "less than or equal to 1000000",
    ),
    "directions": (
        "values: [0, 90, 180, 270]",
        "values: [0, 90, 180, 360]",
        "collection.factors.direction.values[3] = 360",
        "is the same direction as 0 deg",
    ),
    "a direction": (
        "values: [0, 90, 180, 270]",
        "values: [-1.0e+9]",
        "collection.factors.direction.values[0] = -1.0e+9",
        "must be from -360 to 360 deg",
    ),
    "a direction that YAML takes for text": (
        "values: [0, 90, 180, 270]",
        "values: [-1e9]",
        "collection.factors.direction.values[0] = -1e9",
        "reads as text; write -1000000000",
    ),
    "thousands": (
        "depth: 3.6 mm",
        "depth: 1,000 um",
        "collection.limits.depth = 1,000 um",
        "has a comma: write '1000 um' or '1.000 um'",
    ),
}


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
    assert old in PILOT
    path = tmp_path / "wrong.yaml"
    path.write_text(PILOT.replace(old, new, 1))
    more = [] if command == "plan" else ["--rig", "mock", "--store", tmp_path / "store"]
    line = refused(command, path, *more)
    assert line.startswith(f"error: {path}: {found}: "), line
    assert right in line


RIGS: dict[str, tuple[str, str, str, str]] = {
    "no day": (
        "name: irb120 ",
        "skin: {made: 2026-02-30}\nname: irb120 ",
        "skin.made = 2026-02-30",
        "is not a valid date; write one like 2026-02-28 (line 4)",
    ),
    "a number for a day": (
        "name: irb120 ",
        "skin: {made: 20261101}\nname: irb120 ",
        "skin.made = 20261101",
        "must be a date, such as 2026-11-23",
    ),
    "digits for a day": (
        "name: irb120 ",
        'skin: {made: "20261101"}\nname: irb120 ',
        "skin.made = 20261101",
        "must be a date, such as 2026-11-23",
    ),
    "password": (
        "password: robotics",
        "password: 12345",
        f"devices.arm.password = {MASK}",
        "quote",
    ),
    "passwrd": (
        "password: robotics",
        "passwrd: hunter2",
        f"devices.arm.passwrd = {MASK}",
        "did you mean 'password'",
    ),
    "a token": ("password: robotics", "token: hunter2", f"devices.arm.token = {MASK}", "unknown"),
    "a password as a key": (
        "password: robotics",
        '"password:hunter2": 1',
        f"devices.arm.password:{MASK} = {MASK}",
        "unknown key",
    ),
    "a password below a wrong key": (
        "devices:\n",
        "devices:\n  amr: {password: hunter2}\n",
        f"devices.amr = {{password: {MASK}}}",
        "did you mean 'arm'",
    ),
    "a tag as a password": (
        "password: robotics",
        "password: !hunter2 12345",
        f"devices.arm.password = {MASK}",
        "quote",
    ),
    "an alias as a password": (
        "password: robotics",
        "password: *hunter2",
        f"devices.arm.password = {MASK}",
        "quote",
    ),
    "a comma in a password": (
        "password: robotics",
        "tool: {password: 12,34}",
        f"devices.arm.tool.password = {MASK}",
        "quote",
    ),
    "a handle as a password": (
        "password: robotics",
        "password: !hunter2!12345 x",
        "",
        "quote",
    ),
    "an address with a password": (
        "host: 192.168.125.1 ",
        "host: http://anna:hunter2@10.0.0.1 ",
        f"devices.arm.host = http://anna:{MASK}@10.0.0.1",
        "",
    ),
}


@pytest.mark.parametrize("command", ["plan", "check", "rigs"])
@pytest.mark.parametrize("case", RIGS)
def test_a_wrong_rig_file(case: str, command: str, tmp_path: Path) -> None:
    old, new, found, right = RIGS[case]
    assert old in ABB
    path = tmp_path / "rig.yaml"
    path.write_text(ABB.replace(old, new, 1))
    if command == "rigs":
        done = here("rigs", path, "--json")
        assert done.returncode == 1
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
            leaves = {
                plain,
                *get_args(plain),
                *(x for y in get_args(plain) for x in get_args(y)),
            }
            info = [item for item in more if isinstance(item, typer.models.ParameterInfo)]
            if leaves & {int, float} and info:
                found[f"{prefix}{name} {parameter}"] = (leaves, info[0])
    for inner in group.registered_groups:
        assert inner.typer_instance is not None
        found |= _options(inner.typer_instance, f"{inner.name} " if inner.name else prefix)
    return found


OPTIONS = _options(command_line())


def test_there_are_numeric_options() -> None:
    assert len(OPTIONS) > 40
    assert "evaluate margin" in OPTIONS
    assert "collect temperature" in OPTIONS


@pytest.mark.parametrize("option", OPTIONS)
def test_numeric_options_are_bounded(option: str) -> None:
    info = OPTIONS[option][1]
    assert info.min is not None
    assert info.max is not None


@pytest.mark.parametrize("value", ["nan", "inf", "-inf", "1e400", "yes", "\N{MINUS SIGN}1"])
@pytest.mark.parametrize(
    "command",
    [
        ("evaluate", "none", "--margin"),
        ("evaluate", "none", "--smoothing"),
        ("collect", "none.yaml", "--rig", "mock", "--store", "none", "--temperature"),
        ("collect", "none.yaml", "--rig", "mock", "--store", "none", "--humidity"),
        ("collect", "none.yaml", "--rig", "mock", "--store", "none", "--trials"),
        ("tradeoff", "none", "--width"),
        ("tradeoff", "none", "--length"),
        ("tradeoff", "none", "--minutes"),
        ("detect", "--model", "none", "--rig", "mock", "--stride"),
        ("detect", "--model", "none", "--rig", "mock", "--seconds"),
        ("teach", "plane", "--rig", "mock", "--span"),
        ("pause", "none", "--wait"),
    ],
    ids=lambda words: f"{words[0]} {words[-1]}",
)
def test_options_take_finite_numbers_alone(command: tuple[str, ...], value: str) -> None:
    line = refused(*command, value)
    assert f"{command[-1]} = {value}: " in line


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("dept=2.4", "--enable = dept=2.4: unknown factor dept; defined factors: depth, speed, "),
        ("", "--enable = '': unknown factor ; defined factors: depth, speed, direction"),
        (f"direction={MINUS}90", f"= {MINUS}90: holds U+2212 MINUS SIGN: write '-90'"),
        ("depth=2,4", "= 2,4: has a decimal comma: write '2.4'"),
        ("depth=nan", "= nan: must be a finite number"),
        ("depth=\x1b[31m", "= \\x1b[31m: must be a number"),
    ],
)
def test_levels_to_be_enabled(given: str, message: str) -> None:
    assert message in refused("plan", ROOT / "protocols" / "pilot.yaml", "--enable", given)
