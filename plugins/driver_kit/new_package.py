"""A new package: an example driver under another name, with a rig file, a test and a page."""

from __future__ import annotations

import keyword
import re
import sys
from collections.abc import Sequence
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from string import Template

from sliplab.rigs.core.registry import listed

KINDS = {
    "arm": "arm",
    "events": "event_camera",
    "frames": "frame_camera",
    "sync": "sync_box",
    "force": "force_sensor",
    "gripper": "gripper",
    "scalar": "",
}
"""Key of the device in a rig file, by the example that a new driver starts from; that of a scalar
sensor is the name of its stream."""
_EXAMPLES = "sliplab.plugins.driver_kit.examples"
_OWN_IMPORT = r"^from {package}\S* import (?:\([^)]*\)|[^\n(]*)\n"

PYPROJECT = Template("""\
[build-system]
requires = ["setuptools>=77"]
build-backend = "setuptools.build_meta"

[project]
name = "$project"
version = "0.1.0"
description = "A driver for SlipLab."
requires-python = ">=3.11"
dependencies = ["sliplab"]

[project.optional-dependencies]
dev = ["pytest>=9"]

[project.entry-points."sliplab.drivers"]
$entries

[tool.setuptools]
packages = [$packages]
""")

README = Template("""\
# $title

A driver for SlipLab. It runs unchanged, on a fake of a device that does not exist.

```sh
pip install -e .[dev]
pytest                       # the rules that SlipLab holds a driver of this kind to
sliplab rigs --drivers       # lists $title
```

| file | change it to |
| --- | --- |
| `$name/__init__.py` | your device's settings, and how it is looked for |
| `$name/driver.py` | how your device is spoken to: its protocol, or its maker's library |
| `$name/fake.py` | what your device answers, so that all of it is tested without one |

$files

Write down here what was never tried on the device itself.
""")

_FILES = {
    "rig.yaml": """\
`rig.yaml` is a loopback rig with its fake (`sliplab rigs rig.yaml` reads it); the rig file of a
real rig has the same section of `devices:`, with the settings of your device.""",
    "streams.yaml": """\
`sliplab record streams.yaml --store data --campaign NAME` records it; a rig file has the same
section of `streams:`.""",
}
STREAMS = Template("""\
streams:
$streams
""")
RIG = Template("""\
# The loopback rig with $title:
# on fakes, so all that it stores is simulated.
extends: loopback
name: $project-loopback
devices:
$devices
$more""")
_TEXTS = {"rig.yaml": RIG, "streams.yaml": STREAMS}
_IN_RIG = {
    "arm": (
        ", host: 127.0.0.1, limits: {frame: plate, low_mm: [-20, -20, -70],\n"
        "    high_mm: [20, 20, 4.4], depth_mm: 4.4, speed_mm_s: 100}",
        "mock: {arm: {start_xyz_mm: [397, 0, 300]}}   # within the limits\n",
    ),
    "force": (
        "",
        "timing: {force: {grade: host time, delay: {shortest_us: 0, longest_us: 400000}}}\n"
        "mock: {force: {}}   # what its fake shows\n",
    ),
    "gripper": (
        ", opening_mm: 40",
        "mock: {gripper: {opening_mm: 40}}   # the fingers that its fake moves\n",
    ),
}
"""Further entries of a rig file, in the device's section and below it."""

TEST = Template('''\
"""$name keeps the rules that SlipLab holds a driver of its kind to, on its fake."""

from $name import DRIVER, $settings
from sliplab.testing import conformance$more

test_driver = conformance(DRIVER, $settings($arguments))
''')
_ARGUMENTS = {
    "arm": (
        '\n    host="127.0.0.1", port=free_port(),\n'
        '    limits={"low_mm": (300, -100, 200), "high_mm": (500, 100, 400)},\n'
    ),
    "gripper": "opening_mm=40",
}
"""Arguments of the settings in the test."""


def name_fault(name: str) -> str:
    """Return the fault in the name of a new driver; empty if there is none."""
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name):
        return "must be lower-case letters, digits and underscores, a letter first"
    if keyword.iskeyword(name) or name in sys.stdlib_module_names or name in {"sliplab", "tests"}:
        return "is a name that Python or SlipLab uses; choose another one"
    if name in listed():
        return f"is already the name of a driver of {listed()[name].package}; choose another one"
    found = find_spec(name)
    if found is not None and found.origin is not None:  # no mere folder
        return "is the name of an installed package; choose another one"
    return ""


def driver_names(name: str, kinds: Sequence[str]) -> list[str]:
    """Return the names of a package's drivers: its own, or with several kinds one for each."""
    return [name] if len(kinds) == 1 else [f"{name}_{kind}" for kind in kinds]


def package_files(name: str, kinds: Sequence[str]) -> dict[str, str]:
    """Return the text of each file of a new package, by its path.

    Args:
        name: of the package, and of its driver if there is one.
        kinds: of `KINDS`, each once.
    """
    drivers = driver_names(name, kinds)
    inside = {d: (k, *_IN_RIG.get(k, ("", ""))) for d, k in zip(drivers, kinds, strict=True)}
    in_rig = {driver: part for driver, part in inside.items() if KINDS[part[0]]}
    files = ["rig.yaml"] if in_rig else []
    files += ["streams.yaml"] if len(in_rig) < len(inside) else []
    words = {
        "project": name.replace("_", "-"),
        "title": " and ".join(drivers),
        "entries": "\n".join(f'{driver} = "{driver}:DRIVER"' for driver in drivers),
        "packages": ", ".join(f'"{driver}"' for driver in drivers),
        "devices": "\n".join(
            f"  {KINDS[kind]}: {{driver: {driver}{device}}}"
            for driver, (kind, device, _) in in_rig.items()
        ),
        "streams": "\n".join(
            f"  {driver}: {{kind: scalar, unit: degC, device: {{driver: {driver}}}}}"
            for driver in inside
            if driver not in in_rig
        ),
        "more": _joined([more for _, _, more in in_rig.values()]),
        "files": "\n\n".join(_FILES[name] for name in files),
    }
    found = {
        "pyproject.toml": PYPROJECT.substitute(words),
        "README.md": README.substitute(words, name=name if len(kinds) == 1 else f"{name}_KIND"),
    }
    found |= {name: _TEXTS[name].substitute(words) for name in files}
    for driver, kind in zip(drivers, kinds, strict=True):
        found |= _driver_files(driver, kind)
    return found


def _joined(entries: Sequence[str]) -> str:
    """Join further entries of a rig file, `mock:` once."""
    lines = [line for text in entries for line in text.splitlines()]
    simulated = [line for line in lines if line.startswith("mock: ")]
    rest = [line for line in lines if line not in simulated]
    if len(simulated) > 1:
        # a block, with each device's own comment
        rest.append("mock:")
        for line in simulated:
            entry, hash_, comment = line.removeprefix("mock: {").partition("#")
            entry = entry.rstrip().removesuffix("}")
            rest.append(f"  {entry}   {hash_}{comment}".rstrip())
    else:
        rest += simulated
    return "".join(f"{line}\n" for line in rest)


def _driver_files(name: str, kind: str) -> dict[str, str]:
    """Return the module of one driver and its test."""
    class_name = "".join(part.capitalize() for part in name.split("_"))
    example = f"Example{kind.capitalize()}"
    words = {
        "name": name,
        "settings": f"{class_name}Settings",
        "more": ", free_port" if kind == "arm" else "",
        "arguments": _ARGUMENTS.get(kind, ""),
    }
    found = {f"tests/test_{name}.py": TEST.substitute(words)}
    for module in ("__init__", "driver", "fake"):
        text = (files(_EXAMPLES) / kind / f"{module}.py").read_text()
        text = text.replace(f"{_EXAMPLES}.{kind}", name)
        text = text.replace(example, class_name).replace(f"example_{kind}", name)
        text = re.sub(
            r"(?:the e|E)xample (?:arm|event camera|frame camera|sync box|"
            r"force sensor|gripper|scalar sensor)",
            name,
            text,
        )
        found[f"{name}/{module}.py"] = _own_imports_last(text, name)
    return found


def _own_imports_last(text: str, package: str) -> str:
    """Move a module's imports of the same package after those of others."""
    pattern = re.compile(_OWN_IMPORT.format(package=package), re.MULTILINE)
    own = "".join(pattern.findall(text))
    rest = pattern.sub("", text)
    others = list(re.finditer(_OWN_IMPORT.format(package="sliplab"), rest, re.MULTILINE))
    if not own or not others:
        return text
    end = others[-1].end()
    return f"{rest[:end]}\n{own}{rest[end:]}"


def write_package(folder: Path, name: str, kinds: Sequence[str]) -> list[str]:
    """Write a new package into a folder that does not exist yet; return its files.

    Raises:
        FileExistsError: the folder exists.
        OSError: it cannot be written.
    """
    folder.mkdir(parents=True)
    texts = package_files(name, kinds)
    for path, text in texts.items():
        (folder / path).parent.mkdir(exist_ok=True)
        (folder / path).write_text(text)
    return sorted(texts)
