"""`python -m benchmarks.exchange [FORMAT ...] [--events N] [--runs N]`: files of other programs.

All read the same files, on one core, fully into arrays, in turn, ours and those of others. Times
are of the processor, which other programs on the machine change less. Ours are the readers and the
writer of `sliplab import` and `export`. faery and dv-processing come with the extras; expelliarmus
(`pip install expelliarmus`) takes part where it is installed. A ratio above 1 says that ours is the
faster one.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from functools import partial
from importlib import import_module, util
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.measure import Figures, Seconds, machine, one_core, rate, ratio
from benchmarks.slides import many_events
from sliplab.storage.formats.aedat4 import EVENTS, Aedat4Stream, Aedat4Writer
from sliplab.storage.formats.known import known_format
from sliplab.storage.streams import EventChunk

SIZE = (640, 480)
VERSIONS = {"evt2": "evt2", "evt3": "evt3", "dat": "dat2", "es": None, "aedat4": None}
"""Formats, each with the version of it that faery writes."""
ENDINGS = {"evt2": "raw", "evt3": "raw"}
EXPELLIARMUS = {"evt2", "evt3", "dat"}
Work = dict[str, Callable[[], object]]


def measure(*forms: str, events: int = 3_000_000, runs: int = 3) -> Figures:
    """Read and write times of some formats, or of all, by each program that has them."""
    with tempfile.TemporaryDirectory() as folder:
        return _measure(Path(folder), forms or tuple(VERSIONS), many_events(events), runs)


def _measure(folder: Path, forms: tuple[str, ...], data: EventChunk, runs: int) -> Figures:
    figures: Figures = {}
    rows = _as_faery(data)
    for form in forms:
        file = folder / f"data.{ENDINGS.get(form, form)}"
        _faery_write(rows, file, form)
        _check(file, form, data)
        read = _readers(file, form)
        write = _writers(rows, data, folder, form)
        with one_core():
            for what, work in (("read", read), ("write", write)):
                taken = _alternate(runs, work)
                for name, seconds in taken.items():
                    key = f"{form}_{what}_{name}"
                    figures |= rate(f"{key}_m_events_per_s", len(data) / 1e6, seconds)
                    if name != "ours" and "ours" in taken:
                        figures |= ratio(f"{key}_ratio", seconds, taken["ours"])
        file.unlink()
    return figures


def _alternate(runs: int, work: Work) -> dict[str, Seconds]:
    """Processor seconds of each in every round, after one round that does not count."""
    taken: dict[str, Seconds] = {name: [] for name in work}
    for number in range(runs + 1):
        for name, one in work.items():
            started = time.process_time()
            one()
            if number:
                taken[name].append(time.process_time() - started)
    return taken


def _readers(file: Path, form: str) -> Work:
    work: Work = {"ours": partial(_ours, file, form), "faery": partial(_faery, file)}
    if form == "aedat4":
        work["dv_processing"] = partial(_dv, file)
    if form in EXPELLIARMUS and util.find_spec("expelliarmus"):
        wizard = import_module("expelliarmus").Wizard(encoding=form)
        work["expelliarmus"] = partial(wizard.read, file)
    return work


def _writers(rows: Any, data: EventChunk, folder: Path, form: str) -> Work:
    work: Work = {
        "faery": partial(_faery_write, rows, folder / f"faery.{ENDINGS.get(form, form)}", form)
    }
    if form == "aedat4":
        work["ours"] = partial(_ours_write, data, folder / "ours.aedat4")
    if form in EXPELLIARMUS and util.find_spec("expelliarmus"):
        wizard = import_module("expelliarmus").Wizard(encoding=form)
        packed = np.empty(len(data), [("t", "<i8"), ("x", "<i2"), ("y", "<i2"), ("p", "u1")])
        packed["t"], packed["x"], packed["y"], packed["p"] = data.t_us, data.x, data.y, data.p
        work["expelliarmus"] = partial(
            wizard.save, folder / f"other.{ENDINGS.get(form, form)}", packed
        )
    return work


def _as_faery(data: EventChunk) -> Any:
    rows = np.empty(len(data), import_module("faery").EVENTS_DTYPE)
    rows["t"], rows["x"], rows["y"], rows["on"] = data.t_us, data.x, data.y, data.p
    return rows


def _faery_write(rows: Any, file: Path, form: str) -> None:
    stream = import_module("faery").events_stream_from_array(rows, SIZE)
    kind = {"evt2": "evt", "evt3": "evt", "aedat4": "aedat"}.get(form, form)
    # AEDAT4 compressed as ours is
    stream.to_file(file, version=VERSIONS[form], file_type=kind, compression=("zstd", 1))


def _faery(file: Path) -> Any:
    return import_module("faery").events_stream_from_file(file).to_array()


def _ours(file: Path, form: str) -> EventChunk:
    """All events, each chunk copied to its place as it comes, as an import consumes it."""
    kind = {"evt2": "raw", "evt3": "raw", "dat": "raw"}.get(form, form)
    most = file.stat().st_size  # none of these files has two events in a byte
    types = {"x": np.uint16, "y": np.uint16, "p": np.uint8, "t_us": np.int64}
    columns = {name: np.empty(most, dtype) for name, dtype in types.items()}
    count = 0
    read = known_format(kind).read
    assert read is not None
    for chunk in read(file, "trial").events():
        for name, column in columns.items():
            column[count : count + len(chunk)] = getattr(chunk, name)
        count += len(chunk)
    return EventChunk(**{name: column[:count] for name, column in columns.items()})


def _ours_write(data: EventChunk, file: Path) -> None:
    with Aedat4Writer(file, {0: Aedat4Stream(EVENTS, "events", SIZE, "benchmark")}) as out:
        out.events(0, data)


def _dv(file: Path) -> list[Any]:
    """All events in columns, as the others return them."""
    recording = import_module("dv_processing").io.MonoCameraRecording(str(file))
    parts = []
    while (batch := recording.getNextEventBatch()) is not None:
        parts.append((batch.timestamps(), batch.coordinates(), batch.polarities()))
    return [np.concatenate(column) for column in zip(*parts, strict=True)]


def _check(file: Path, form: str, data: EventChunk) -> None:
    """Compare what ours reads with what was written; Prophesee's times may begin elsewhere."""
    found = _ours(file, form)
    shift = int(data.t_us[0]) - int(found.t_us[0])
    for column in ("x", "y", "p"):
        if not np.array_equal(getattr(found, column), getattr(data, column)):
            raise RuntimeError(f"{form}: {column} came back otherwise than it was written")
    if not np.array_equal(found.t_us + shift, data.t_us):
        raise RuntimeError(f"{form}: times came back otherwise than they were written")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Time readers and writers of other formats.")
    parser.add_argument("forms", nargs="*", metavar="FORMAT", help=", ".join(VERSIONS))
    parser.add_argument("--events", type=int, default=3_000_000)
    parser.add_argument("--runs", type=int, default=3)
    given = parser.parse_args()
    figures = measure(*given.forms, events=given.events, runs=given.runs)
    print(json.dumps({"figures": figures, "machine": machine()}, indent=1))
