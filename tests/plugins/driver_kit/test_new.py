"""`sliplab new driver`: a package that works at once, and refuses what it should."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

from sliplab.plugins.driver_kit.new_package import KINDS, name_fault, package_files
from tests.command_line import answer, here
from tests.rigs.waiting import own_address

_OFFLINE = ("--quiet", "--no-index", "--no-deps", "--no-build-isolation", "--no-compile")
LIMIT_S = 300


def run(*words: object, cwd: Path, site: Path) -> str:
    """Run a program that finds packages in `site`; what it prints."""
    done = subprocess.run(
        [sys.executable, "-m", *map(str, words)],
        cwd=cwd,
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": str(site), "SLIPLAB_RUNTIME": str(site / "runtime")},
        timeout=LIMIT_S,
    )
    assert done.returncode == 0, f"{words}\n{done.stdout}{done.stderr}"
    return done.stdout


def install(site: Path, into: Path, *kinds: str) -> list[Path]:
    """Write a package of each kind, and install it to `site`; their folders."""
    folders = [
        answer("new", "driver", f"lab_{kind}", "--kind", kind, "--into", into)["folder"]
        for kind in kinds
    ]
    run("pip", "install", *_OFFLINE, "--target", site, *folders, cwd=into, site=site)
    return list(map(Path, folders))


def test_it_writes_what_it_says(tmp_path: Path) -> None:
    made = answer("new", "driver", "lab_arm", "--into", tmp_path)
    assert made["folder"] == str(tmp_path / "lab-arm")
    assert (made["driver"], made["kind"]) == ("lab_arm", "arm")
    folder = Path(made["folder"])
    there = [p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()]
    assert sorted(there) == made["files"]
    assert "lab_arm/driver.py" in made["files"]


@pytest.mark.parametrize("kind", KINDS)
def test_nothing_of_the_example_is_left_and_every_module_compiles(kind: str) -> None:
    for path, text in package_files("lab_thing", [kind]).items():
        assert "xample" not in text, path
        assert "sliplab.plugins.driver_kit" not in text, path
        if path.endswith(".py"):
            compile(text, path, "exec")
        assert max(map(len, text.splitlines())) <= 100, path


def test_several_kinds_are_drivers_of_one_package() -> None:
    made = package_files("lab", ["arm", "force", "gripper", "scalar"])
    project = tomllib.loads(made["pyproject.toml"])
    kinds = ("arm", "force", "gripper", "scalar")
    drivers = {f"lab_{kind}": f"lab_{kind}:DRIVER" for kind in kinds}
    assert project["project"]["entry-points"]["sliplab.drivers"] == drivers
    assert project["tool"]["setuptools"]["packages"] == list(drivers)
    rig = yaml.safe_load(made["rig.yaml"])
    assert [device["driver"] for device in rig["devices"].values()] == list(drivers)[:3]
    (stream,) = yaml.safe_load(made["streams.yaml"])["streams"].values()
    assert stream["device"] == {"driver": "lab_scalar"}
    assert rig["mock"] == {
        "arm": {"start_xyz_mm": [397, 0, 300]},
        "force": {},
        "gripper": {"opening_mm": 40},
    }
    assert {f"{name}/driver.py" for name in drivers} | {
        f"tests/test_{name}.py" for name in drivers
    } < made.keys()


def test_a_kind_given_twice_is_refused(tmp_path: Path) -> None:
    done = here("new", "driver", "lab", "--kind", "arm,arm", "--into", tmp_path)
    assert done.returncode == 2
    assert "must name" in done.stderr


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("Lab-Arm", "must be lower-case letters, digits and underscores"),
        ("", "must be lower-case letters"),
        ("3arm", "a letter first"),
        ("json", "is a name that Python or SlipLab uses"),
        ("class", "is a name that Python or SlipLab uses"),
        ("ur", "is already the name of a driver of sliplab"),
        ("numpy", "is the name of an installed package"),
    ],
)
def test_a_name_that_cannot_be_is_refused_in_a_line(name: str, why: str, tmp_path: Path) -> None:
    assert why in name_fault(name)
    done = here("new", "driver", name, "--into", tmp_path)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "NAME" in done.stderr
    assert why in done.stderr
    assert not list(tmp_path.iterdir())


def test_it_overwrites_nothing(tmp_path: Path) -> None:
    kept = tmp_path / "lab-arm" / "driver.py"
    kept.parent.mkdir()
    kept.write_text("mine")
    done = here("new", "driver", "lab_arm", "--into", tmp_path, "--json")
    assert done.returncode == 2
    assert json.loads(done.stdout)["error"]["message"].endswith(
        "exists already and is not overwritten"
    )
    assert [path.name for path in kept.parent.iterdir()] == ["driver.py"]
    assert kept.read_text() == "mine"


def test_a_kind_or_a_folder_that_is_none_is_refused_in_a_line(tmp_path: Path) -> None:
    done = here("new", "driver", "lab_arm", "--kind", "camera", "--into", tmp_path)
    assert done.returncode == 2
    assert "must be one of arm, events, frames, sync, force, gripper, scalar" in done.stderr
    (tmp_path / "file").write_text("")
    done = here("new", "driver", "lab_arm", "--into", tmp_path / "file")
    assert done.returncode == 2
    assert "cannot be written: Not a directory" in done.stderr


@pytest.mark.programs
@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS)
def test_an_installed_package_keeps_every_rule_and_its_rig_file_is_valid(
    kind: str, tmp_path: Path
) -> None:
    site = tmp_path / "site"
    (folder,) = install(site, tmp_path, kind)
    said = run("pytest", "-q", "-p", "no:cacheprovider", cwd=folder, site=site)
    assert "passed" in said
    assert ("1 skipped" in said) == (kind == "scalar")  # it has no clock that falls back
    if kind == "scalar":
        return
    (rig,) = json.loads(run("sliplab", "rigs", "rig.yaml", "--json", cwd=folder, site=site))["rigs"]
    assert rig["name"] == f"lab-{kind}-loopback"
    assert not rig["wrong"]


@pytest.mark.programs
@pytest.mark.long
def test_a_rig_of_new_drivers_alone_collects_on_a_loopback_rig(
    tmp_path: Path, small: dict[str, Any]
) -> None:
    site, work = tmp_path / "site", tmp_path / "work"
    work.mkdir()
    rig: dict[str, Any] = {}
    kinds = [kind for kind, key in KINDS.items() if key]
    for folder in install(site, tmp_path, *kinds):
        for key, value in yaml.safe_load((folder / "rig.yaml").read_text()).items():
            rig[key] = {**rig.get(key, {}), **value} if isinstance(value, dict) else value
    assert {each["driver"] for each in rig["devices"].values()} == {f"lab_{k}" for k in kinds}
    rig["devices"]["arm"]["host"] = own_address()
    (work / "rig.yaml").write_text(yaml.safe_dump(rig))
    collection = small["collection"]
    collection["factors"] = {
        "depth": {"unit": "mm", "values": [2.4]},
        "speed": {"unit": "mm/s", "values": [6]},
        "direction": {"unit": "deg", "values": [0]},
    }
    collection["repetitions"] = 1
    collection.pop("maintenance")
    collection["gates"] |= {"retakes": 5}
    collection["gates"]["sync_uncertainty"] |= {"host_time": "500 ms", "digital_input": "5 ms"}
    (work / "protocol.yaml").write_text(yaml.safe_dump(small))
    on = ("protocol.yaml", "--rig", "rig.yaml", "--store", "store", "--json")
    taken = json.loads(run("sliplab", "collect", *on, cwd=work, site=site))
    assert (taken["planned"], taken["committed"], taken["simulated"]) == (1, 1, True)
