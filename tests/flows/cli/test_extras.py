"""Commands without any extra installed, and the message that names the missing one."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterable
from importlib import metadata
from pathlib import Path

import pytest

from sliplab.flows.running.extras import EXTRAS, lacking
from sliplab.protocols.later import installed
from tests.command_line import MANY
from tests.conftest import ROOT
from tests.flows.older import older_store
from tests.flows.programs import ended

BLOCKED = """
import sys

class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in MISSING:
            raise ModuleNotFoundError(f"No module named '{name}'", name=name)

MISSING = set(sys.argv.pop(1).split(","))
sys.meta_path.insert(0, Missing())
"""
PYTHON = """
import sliplab
store = sliplab.open_store(sys.argv[1])
assert len(store.trials()) == 4
for trial in store:
    assert len(trial.events()) > 10_000 and len(trial.poses()) and len(trial.pulses())
    assert trial.onsets().incipient_ns
assert store.summary()["simulated"] is True
assert len(sliplab.plan("pilot").trials) == 36
assert not MISSING & set(sys.modules), MISSING & set(sys.modules)
for ask in (store.label, store.train, lambda: sliplab.load_model(store.models()[0])):
    try:
        ask()
    except ModuleNotFoundError as error:
        print(error)
"""


def run(code: str, extras: tuple[str, ...], *arguments: object) -> subprocess.CompletedProcess[str]:
    """Run Python without what these extras bring."""
    missing = ",".join(module for extra in extras for module in EXTRAS[extra])
    return ended([sys.executable, "-c", code, missing, *arguments], 300)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four labelled slides, a network and a report; nothing here changes them."""
    return older_store(tmp_path_factory.mktemp("extras") / "store")


CORE = (
    "--version",
    "plan pilot",
    "plan pilot --rig mock",
    "rigs",
    "schema rig",
    "schema protocol",
    "trials STORE",
    "verify STORE",
    "migrate STORE",
    "export STORE small --as dsec --output OUT/dsec",
    "export STORE small --as labels --output OUT/labels.csv",
)


def run_all(
    commands: Iterable[str], extras: tuple[str, ...], store: Path, out: Path
) -> list[tuple[int, str, str]]:
    """Run commands in one process without these extras: exit code and both streams of each."""
    trial = next((store / "campaigns" / "small" / "trials").iterdir()).name
    places = {"STORE": str(store), "OUT": str(out), "TRIAL": trial}
    wanted = [
        re.sub("|".join(places), lambda name: places[name[0]], command).split()
        for command in commands
    ]
    done = run(BLOCKED + MANY, extras, json.dumps(wanted))
    assert done.returncode == 0, done.stderr
    ended = [(code, printed, said) for code, printed, said in json.loads(done.stdout)]
    assert len(ended) == len(wanted)
    return ended


def test_the_core_plans_reads_and_writes(store: Path, tmp_path: Path) -> None:
    for command, (code, _, said) in zip(
        CORE, run_all(CORE, tuple(EXTRAS), store, tmp_path), strict=True
    ):
        assert code == 0, f"{command}: {said}"


@pytest.mark.long
def test_python_reads_a_store_with_the_core_alone(store: Path) -> None:
    done = run(BLOCKED + PYTHON, tuple(EXTRAS), store)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == [
        "`Store.label` needs prefect, from the extra 'prefect': pip install 'sliplab[prefect]'",
        "`Store.train` needs prefect, from the extra 'prefect': pip install 'sliplab[prefect]'",
        "`load_model` needs torch, from the extra 'learn': pip install 'sliplab[learn]'",
    ]


LACKING: dict[str, dict[str, str]] = {
    "video": {
        "collect pilot --rig mock --store OUT/mock --trials 1": "av",
    },
    "parquet": {
        "trials STORE --output OUT/trials.parquet": "pyarrow",
        "export STORE small --as aedat4 --output OUT/aedat4": "pyarrow",
    },
    "learn": {
        "train STORE": "torch",
        "export-model STORE/models/small.pt --out OUT/model": "torch",
        "detect --rig rehearsal --model STORE/models/small.pt": "torch",
    },
    "prefect": {
        "label STORE": "prefect",
        "sync STORE": "prefect",
        "review STORE": "uvicorn",
        "collect pilot --rig rehearsal --store OUT/new --trials 1": "prefect",
    },
    "report": {
        "sync STORE": "matplotlib",
        "calibrate board --out OUT/board.pdf": "matplotlib",
    },
    "hardware": {
        "rigs irb120 --ask": "abb_motion_program_exec",
        "rigs ur5 --ask": "rtde_control",
        "check pilot --rig ur5 --store OUT/ur5": "rtde_control",
        "check pilot --rig loopback --store OUT/loopback": "rtde_control",
    },
    "cluster": {"label STORE --dask 127.0.0.1:1": "distributed"},
    "view": {"view STORE TRIAL --save OUT/trial.rrd": "rerun"},
    "publish": {"publish STORE --as mcap --output OUT/published": "mcap"},
}
"""Commands, and the module of the extra that each needs first."""


TOGETHER = ["prefect", "report hardware", "parquet", "learn publish", "video cluster view"]
"""Extras that a process lacks: all at once where no command needs two of them."""


@pytest.mark.long
@pytest.mark.parametrize("extras", TOGETHER)
def test_a_command_says_which_extra_it_lacks(extras: str, store: Path, tmp_path: Path) -> None:
    lacked = extras.split()
    wanted = [(extra, *each) for extra in lacked for each in LACKING[extra].items()]
    lines = [f"{command} --json" for _, command, _ in wanted]
    done = run_all(lines, tuple(lacked), store, tmp_path)
    for (extra, command, module), (code, out, said) in zip(wanted, done, strict=True):
        found = json.loads(out)["error"]
        assert (code, found["exit_code"]) == (2, 2), f"{command}: {said}"
        if extra == "cluster":  # the option is what is wrong
            assert found["key"] == "--dask"
            assert found["message"].endswith("`pip install 'sliplab[cluster]'`")
        else:
            assert (found["file"], found["key"], found["value"]) == (None, None, None)
            assert found["message"] == (
                f"`sliplab {command.split()[0]}` needs {module}, from the extra '{extra}': "
                f"pip install 'sliplab[{extra}]'"
            )
        assert f"error: {found['message']}\n" in said
        assert "Traceback" not in said


def test_every_extra_is_lacked_once() -> None:
    assert sorted(" ".join(TOGETHER).split()) == sorted(LACKING)


def test_a_damaged_package_is_not_called_missing() -> None:
    assert lacking(ModuleNotFoundError("", name="torch.nn"), "x") is None
    assert lacking(ModuleNotFoundError("", name="sympy"), "x") is None
    assert lacking(ImportError("", name="torch"), "x") is None
    assert lacking(ModuleNotFoundError("", name="torch"), "x") is not None


def test_every_extra_that_is_named_brings_its_modules() -> None:
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    for extra, modules in EXTRAS.items():
        brought: set[str] = set()
        for line in declared["optional-dependencies"][extra]:
            name = re.split("[<>=[;]", line)[0].strip()
            if name == "xarray" and not installed("xarray"):
                brought.add(name)  # no other part of the product or its tests needs it
            elif name != "sliplab":
                files = metadata.files(name) or ()
                brought |= {file.parts[0].partition(".")[0] for file in files}
        assert set(modules) <= brought, f"[{extra}] lacks {set(modules) - brought}"
