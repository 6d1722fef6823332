"""Plug-ins: what they declare is found, and loaded when it is used."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from sliplab.flows.cli.app import command_line
from sliplab.protocols import plugin
from sliplab.protocols.plugin import Plugin, plugins
from tests.conftest import ROOT
from tests.flows.programs import NO_SERVER
from tests.packages import write_metadata
from tests.protocols.planning import said_by

LOADED = """
import contextlib, io, json, sys
from sliplab.flows.cli.app import command_line

for words in json.loads(sys.argv[1]):
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(sys.stderr):
        command_line(words)(words, standalone_mode=False)
    print(json.dumps([name for name in sys.modules if name.startswith("sliplab.plugins")]))
"""


def loaded(*commands: Sequence[str]) -> list[list[str]]:
    """Run commands in a new process; return the modules of plug-ins that are there after each."""
    said = said_by(LOADED, json.dumps(commands), **NO_SERVER).splitlines()
    return [json.loads(line) for line in said if line.startswith("[")]


def test_a_command_loads_no_plug_in_that_it_does_not_use(tmp_path: Path) -> None:
    """One after another in a new process: what one loads stays for the next."""
    options = ("--rig", "rehearsal", "--store", str(tmp_path / "store"), "--trials", "1")
    planned, collected, helped = loaded(
        ("plan", "pilot", "--json"), ("collect", "pilot", *options), ("bench", "--help")
    )
    assert planned == []
    assert {name.split(".")[2] for name in collected if name.count(".") > 1} == {"simulation"}
    assert "sliplab.plugins.bench.study" in helped
    assert "sliplab.plugins.bench.run" not in helped


@pytest.mark.long
def test_claims_are_loaded_when_they_are_looked_at(tmp_path: Path) -> None:
    claims = tmp_path / "claims.yaml"
    stopping = "  stopping: {claims: [{figure: first_slip, at_most: 10 s}]}\n"
    pilot = (ROOT / "protocols" / "pilot.yaml").read_text()
    claims.write_text(pilot.replace("collection:\n", f"collection:\n{stopping}", 1))
    options = ("--rig", "rehearsal", "--store", str(tmp_path / "store"), "--trials", "1")
    planned, collected = loaded(("plan", str(claims), "--json"), ("collect", str(claims), *options))
    assert planned == []
    assert "sliplab.plugins.claims.rounds" in collected
    assert not [name for name in collected if name.startswith("sliplab.plugins.claims.power")]
    assert not [name for name in collected if name.startswith("sliplab.plugins.bench.")]


def test_help_of_all_plug_ins_loads_no_arrays() -> None:
    code = (
        "import sys; sys.argv = ['sliplab', '--help']\n"
        "from sliplab.flows.__main__ import main\n"
        "try: main()\n"
        "except SystemExit: print({'numpy', 'h5py', 'pandas', 'torch'} & set(sys.modules))"
    )
    assert said_by(code).splitlines()[-1] == "set()"


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Return a function that installs a package for one test."""

    def install(name: str, declared: str) -> None:
        monkeypatch.setitem(sys.modules, name, None)  # forgotten again at the end
        del sys.modules[name]
        (tmp_path / f"{name}.py").write_text(declared)
        write_metadata(tmp_path, name, {plugin.GROUP: {name: f"{name}:PLUGIN"}})
        plugins.cache_clear()

    monkeypatch.syspath_prepend(str(tmp_path))
    yield install
    plugins.cache_clear()


def test_packages_of_others_declare_the_same(installed: Any) -> None:
    installed(
        "lab_subject",
        "from sliplab.protocols.plugin import Plugin\n"
        "PLUGIN = Plugin(hooks={'place': 'lab_subject:answer'}, commands={'rub': 'lab_subject:x'})"
        "\n"
        "def answer(): return 42\n",
    )
    found = plugins()
    assert isinstance(found.found["lab_subject"], Plugin)
    assert [hook() for hook in found.hooks("place")] == [42]
    assert found.commands()["rub"] == ["lab_subject:x"]
    assert found.faults == ()


@pytest.mark.parametrize(
    ("declared", "reason"),
    [
        ("raise OSError('no camera')", "OSError: no camera"),
        ("import sys; sys.exit(3)", "exit code 3"),
        ("PLUGIN = 4", "is a int, not a Plugin"),
        ("", "has no attribute 'PLUGIN'"),
    ],
)
def test_one_that_is_broken_is_named_and_harms_no_other(
    installed: Any, declared: str, reason: str
) -> None:
    installed("lab_unusable", declared)
    found = plugins()
    assert "bench" in found.found
    (fault,) = found.faults
    assert fault.startswith("the plug-in lab_unusable cannot be used: ")
    assert reason in fault


def test_names_from_before_a_move_still_work() -> None:
    code = (
        "import sliplab.analysis.bench.interface as old, sliplab.plugins.bench.interface as later;"
        "import sliplab.analysis.detectors.detector as new;"
        "from sliplab.analysis.bench import registry;"
        "import sliplab.analysis.detectors.registry as r;"
        "from sliplab.protocols.conditions import Gates; import sliplab.protocols.gates as g;"
        "from sliplab.protocols.settings import Detection, Labelling, Split, Training, Windows;"
        "assert Gates is g.Gates;"
        "print(old is later is new, registry is r, new.__spec__.name)"
    )
    assert said_by(code).split() == ["True", "True", "sliplab.analysis.detectors.detector"]


def test_help_names_a_plug_in_that_cannot_be_used(installed: Any, capsys: Any) -> None:
    installed("lab_broken_help", "import no_such_module_xyz\n")
    command_line(("--help",))
    said = capsys.readouterr().err
    assert "warning: the plug-in lab_broken_help cannot be used: " in said
    assert "no_such_module_xyz" in said
