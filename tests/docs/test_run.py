"""The printed commands that take no hardware and no minutes are run, on a store with two trials.

`test_commands.py` has looked at all of them; those of the tutorial and the how-to guides are run
in their own order.
"""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest

from sliplab.protocols.plan import load_plan
from sliplab.rigs.rig_file import load_rig_file
from tests.conftest import ROOT
from tests.docs.blocks import PAGES, Command, commands
from tests.docs.walk import run

pytestmark = pytest.mark.programs

ORDER = (
    "plan",
    "schema",
    "rigs",
    "check",
    "register",
    "trials",
    "verify",
    "migrate",
    "sync",
    "teach",
    "calibrate",
    "export",
    "import",
    "push",
    "pull",
    "skip",
    "again",
)
"""Cheap pages, in an order in which each finds its inputs."""
ELSEWHERE = (
    "--rig loopback",
    "--dask",
    "s3://",
    "--follow",
    "--watch",
    "--pilot",
    "KIND",
    "lab-pickles",
    "--help",
    "--stamp",
    "--as croissant",
    "--as onnx",
)
"""Needs a rig in real time, other machines, a running campaign or claims, a time-stamping
authority or a network, writes what is there already, or stands for a word."""

ADAPTER = """adapter: 1
name: touches
simulated: true
experiment: kinematic
trials: {files: "*.aedat4"}
streams: {events: {format: aedat4}}
"""


def test_cheap_commands_run_as_printed(checkout: Path) -> None:
    (checkout / "lab.yaml").write_text(load_rig_file(Path("rehearsal"))[1])
    # what exchange.md takes in
    assert run("sliplab export data pilot --as aedat4 --output recordings", checkout).code == 0
    # what publish.md takes in
    assert run("sliplab export data --as mcap --output bags", checkout).code == 0
    assert run("sliplab export data --as croissant --output slides", checkout).code == 0
    assert run("sliplab label data", checkout).code == 0  # labels to be exported
    # a recording that was cut short, and a data set with its adapter
    whole = min((checkout / "recordings").glob("*.aedat4"))
    (checkout / "cut.aedat4").write_bytes(whole.read_bytes()[:-5000])
    (checkout / "folder").mkdir()
    (checkout / "folder" / "touch.aedat4").write_bytes(whole.read_bytes())
    (checkout / "theirs.yaml").write_text(ADAPTER)

    trials = [trial.id for trial in load_plan(ROOT / "protocols" / "pilot.yaml")]
    wanted = sorted(
        {_filled(command, checkout, trials) for page in PAGES for command in commands(page)} - {""},
        key=lambda line: (_place(line), line),
    )
    assert len(wanted) >= 25
    failed = []
    for line in wanted:
        done = run(line, checkout)
        if done.code != 0:
            failed.append(f"{line}: exit {done.code}\n{done.out}{done.said}")
    assert not failed, "\n".join(failed)


def _place(line: str) -> int:
    word = line.split()[1]
    return ORDER.index("pull" if word == "verify" and "file://" in line else word)


def _filled(command: Command, folder: Path, trials: list[str]) -> str:
    """The line to run, with names in place of what stands for them; empty if it is not run."""
    name, *words = command.words
    line = " ".join(words)
    if name != "sliplab" or len(words) < 2 or words[0] not in ORDER:
        return ""
    if any(part in line for part in ELSEWHERE):
        return ""
    moves = words[0] == "teach" or words[:2] in (["calibrate", "lens"], ["calibrate", "crop"])
    if moves and "--dry-run" not in words:
        return ""
    if words[:2] in (["calibrate", "scene"], ["calibrate", "drift"], ["calibrate", "gap"]):
        return ""  # simulates hundreds of pilots
    if not command.fenced and not any(word.isupper() or "/" in word for word in words):
        return ""  # named in prose, without what it works on
    walked = command.page.name == "tutorial.md" or command.page.parent.name == "howto"
    if words[-1] == "--why" or walked:
        return ""
    names = {
        "PROTOCOL": "protocols/pilot.yaml",
        "FILE": {"rigs": "rehearsal", "plan": "protocols/pilot.yaml"}.get(words[0], "file.json"),
        "FILE.pdf": "board.pdf",
        "RIG": "rehearsal",
        "STORE": "data",
        "DIR": "out" if words[0] == "export" else "data",
        "WHAT": "pilot",
        "PATH": "recordings/",
        "NAME": "others",
        "TRIAL": trials[-1],
        "ID": trials[-1],
        "TEXT": "a reason",
        "N": "1",
        "EXPR": "depth_mm < 3",
        "URL": f"file://{folder}/shelf",
        "COPY": "copy",
    }
    if words[0] == "pull":
        names["STORE"] = "copy"
    return shlex.join([name, *(names.get(word, word) for word in words)])
