"""The table of formats: it contains those of another lab's package and the core's."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sliplab.flows.imports import import_data
from sliplab.protocols.errors import InputError
from sliplab.protocols.plugin import Plugin, Plugins, plugins
from sliplab.storage.formats import known
from sliplab.storage.formats.known import known_format, known_formats
from sliplab.storage.formats.recognition import MIXED, kind_of, skipped_in, trials_in
from tests.protocols.test_plugin import loaded
from tests.storage.formats.recordings import write_aedat4

TICKS = """
from functools import partial
from pathlib import Path
import numpy as np
from sliplab.storage.formats.foreign import Damage, ForeignTrial, FormatError, event_chunk
from sliplab.storage.formats.format import Files, Format, Layout

MAGIC = b"ticks\\n"

def read(path, name):
    data = path.read_bytes()
    if not data.startswith(MAGIC):
        raise FormatError("is no file of ticks")
    rows = np.frombuffer(data[len(MAGIC):], np.int64).reshape(-1, 4)
    return ForeignTrial(name, path.name, lambda: iter([event_chunk(*rows.T)]), "start")

def both(files, name):
    one, two = (read(file, name) for file in sorted(files))
    def events():
        yield from one.events()
        yield from two.events()
    return ForeignTrial(name, "two halves", events, "start")

def join(files, kind, path):
    halves = [file for file in files if file.suffix == ".half"]
    return [Files("whole", "halves", tuple(halves), lambda name, salvage: both(halves, name))] * (
        len(halves) == 2
    )

HALVES = Format()
LAYOUT = Layout(join=join)
"""


def ticks(path: Path, first_us: int = 1000) -> None:
    """Write ten events, 100 us apart."""
    t_us = first_us + 100 * np.arange(10)
    rows = np.stack([np.arange(10), np.arange(10), np.arange(10) % 2, t_us], axis=1)
    path.write_bytes(b"ticks\n" + rows.astype(np.int64).tobytes())


@pytest.fixture
def declare(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str, Plugin], None]:
    """Return a function that puts a module and its declaration among the plug-ins."""

    def put(text: str, declared: Plugin) -> None:
        (tmp_path / "code").mkdir()
        (tmp_path / "code" / "lab_ticks.py").write_text(text)
        monkeypatch.syspath_prepend(str(tmp_path / "code"))
        monkeypatch.setitem(sys.modules, "lab_ticks", None)  # forgotten again at the end
        del sys.modules["lab_ticks"]
        found = Plugins({**plugins().found, "lab_ticks": declared}, {}, ())
        monkeypatch.setattr(known, "plugins", lambda: found)
        known._load.cache_clear()

    return put


def test_layout_of_another_package_joins_files(declare: Any, tmp_path: Path) -> None:
    hooks = {"layout": "lab_ticks:LAYOUT"}
    declare(TICKS, Plugin(formats={"halves": "lab_ticks:HALVES"}, hooks=hooks))
    folder = tmp_path / "in"
    folder.mkdir()
    for name, first_us in (("1.half", 1000), ("2.half", 3000)):
        ticks(folder / name, first_us)
    write_aedat4(folder / "d.aedat4")
    assert kind_of(folder) == MIXED
    one, two = trials_in(folder, MIXED)
    assert (one.name, two.name) == ("d", "whole")
    assert sum(len(chunk) for chunk in two.events()) == 20
    assert skipped_in(folder, MIXED) == []


def test_unusable_format_is_named_and_harms_no_other(declare: Any, tmp_path: Path) -> None:
    declare("TICKS = 4", Plugin(formats={"ticks": "lab_ticks:TICKS", "none": "lab_none:NONE"}))
    assert "ticks" not in dict(known_formats())
    reason = "cannot be loaded: lab_ticks:TICKS is a int, not a Format"
    with pytest.raises(InputError, match=reason):
        known_format("ticks")
    ticks(tmp_path / "a.tick")
    with pytest.raises(InputError, match=f"no known file format.*; ticks {reason}; none cannot"):
        kind_of(tmp_path / "a.tick")
    write_aedat4(tmp_path / "d.aedat4")
    assert kind_of(tmp_path / "d.aedat4") == "aedat4"


FAULTY = """
from sliplab.storage.formats.foreign import ForeignTrial
from sliplab.storage.formats.format import Format

def sniff(path, head):
    if b"sniff" in head:
        raise KeyError("magic")
    return head.startswith(b"tick")

def read(path, name):
    text = path.read_text()
    def events():
        yield from ()
        raise OSError("cannot unpack")
    if "read" in text:
        raise TypeError("no header")
    return ForeignTrial(name, path.name, lambda: [][1] if "call" in text else events(), "start")

FAULTY = Format((".tick",), sniff, read)
"""


def test_faults_of_a_reader_leave_the_other_files(declare: Any, tmp_path: Path) -> None:
    declare(FAULTY, Plugin(formats={"faulty": "lab_ticks:FAULTY"}))
    folder = tmp_path / "in"
    folder.mkdir()
    for name in ("sniff", "read", "call", "events"):
        (folder / f"{name}.tick").write_text(f"tick {name}")
    (folder / "sniff.tick").write_text("tick sniff read")
    write_aedat4(folder / "good.aedat4")
    found = import_data(folder, tmp_path / "store", name="a")
    assert found["imported"] == ["good"]
    code = "fails in the code of the format faulty (lab_ticks:FAULTY)"
    assert {each["trial"]: each["reason"] for each in found["failed"]} == {
        name: f"{folder / name}.tick: {code}: {why}"
        for name, why in {
            "call": "IndexError: list index out of range",
            "events": "OSError: cannot unpack",
            "read": "TypeError: no header",
            "sniff": "TypeError: no header",
        }.items()
    }


@pytest.mark.parametrize("what", ["read_all", "layout"])
def test_fault_of_a_folders_reader_is_one_line(declare: Any, tmp_path: Path, what: str) -> None:
    text = """
from sliplab.storage.formats.format import Format, Layout
def fail(*_):
    raise TypeError("of the folder")
FAULTY = Format(sniff=lambda path, head: path.is_dir(), read_all=fail)
LAYOUT = Layout(folder=fail)
"""
    hooks = {"layout": "lab_ticks:LAYOUT"} if what == "layout" else {}
    formats = {} if hooks else {"faulty": "lab_ticks:FAULTY"}
    declare(text, Plugin(formats=formats, hooks=hooks))
    with pytest.raises(InputError, match=r"\(lab_ticks:[A-Z]+\): TypeError: of the folder"):
        import_data(tmp_path, tmp_path / "store", name="a")
    assert not (tmp_path / "store").exists()


@pytest.mark.long
def test_file_of_the_core_loads_no_other_format(tmp_path: Path) -> None:
    write_aedat4(tmp_path / "a.aedat4")
    file, store = str(tmp_path / "a.aedat4"), str(tmp_path / "store")
    (found,) = loaded(("import", file, "--store", store, "--name", "a"))
    assert "sliplab.plugins.formats.lab.layout" in found  # a run's folder may lie around the file
    for name in ("prophesee", "event_stream", "ros.mcap", "ros.bags", "lerobot"):
        assert f"sliplab.plugins.formats.{name}" not in found
    out = str(tmp_path / "out")
    (found,) = loaded(("export", store, "a", "--format", "aedat4", "--output", out))
    assert not [name for name in found if name.startswith("sliplab.plugins.formats.")]
