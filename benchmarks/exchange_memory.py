"""Memory of import and export: peak of a process that reads or writes one large recording, MB.

Each run is a process of its own, whose peak includes the interpreter and all libraries. Events are
random, in order of time, at a million a second; the files are written in pieces.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.measure import SEED, Figures, peak_mb
from sliplab.storage.streams import EventChunk

PIECE = 1 << 20
SIZE = (640, 480)
EXPORTS = ("aedat4", "dsec")
ADAPTED = ("csv", "numpy")
FORMS = ("aedat4", "dsec", "raw", *ADAPTED)
_ADAPTER = """\
adapter: 1
name: large
experiment: kinematic
trials: {{files: data.{ending}, id: "{{stem}}"}}
streams:
  events: {{format: {form}, columns: {{t: t, x: x, y: y, p: p}}, unit: us, size_px: [640, 480]}}
"""
_ENDINGS = {"csv": "csv", "numpy": "npy"}


def measure(events: int = 10_000_000, forms: tuple[str, ...] = FORMS) -> Figures:
    """Peaks of importing files of some formats, and of exporting what was imported."""
    figures: Figures = {"events": events}
    for form in forms:
        with tempfile.TemporaryDirectory() as place:
            folder = Path(place)
            (folder / "data").mkdir()
            write(form, folder / "data", events)
            figures[f"{form}_import_peak_mb"] = _peak("import", form, folder)
            if form in EXPORTS:
                figures[f"{form}_export_peak_mb"] = _peak("export", form, folder)
    return figures


def pieces(events: int) -> Iterator[EventChunk]:
    """Yield random events, `PIECE` at a time."""
    generator = np.random.default_rng(SEED)
    for first in range(0, events, PIECE):
        count = min(PIECE, events - first)
        yield EventChunk(
            generator.integers(0, SIZE[0], count, np.uint16),
            generator.integers(0, SIZE[1], count, np.uint16),
            generator.integers(0, 2, count, np.uint8),
            np.arange(first, first + count, dtype=np.int64),
        )


def write(form: str, folder: Path, events: int) -> None:
    """Write a file of a format, and the adapter next to it where it needs one."""
    if form in ADAPTED:
        (folder.parent / "adapter.yaml").write_text(
            _ADAPTER.format(form=form, ending=_ENDINGS[form])
        )
    {"aedat4": _aedat4, "dsec": _dsec, "raw": _raw, "csv": _csv, "numpy": _numpy}[form](
        folder, events
    )


def _aedat4(folder: Path, events: int) -> None:
    from sliplab.storage.formats.aedat4 import EVENTS, Aedat4Stream, Aedat4Writer

    streams = {0: Aedat4Stream(EVENTS, "events", SIZE, "benchmark")}
    with Aedat4Writer(folder / "data.aedat4", streams) as file:
        for chunk in pieces(events):
            file.events(0, chunk)


def _dsec(folder: Path, events: int) -> None:
    from sliplab.storage.formats.dsec import write_dsec

    write_dsec(folder / "data.h5", pieces(events), None, simulated=False)


def _raw(folder: Path, events: int) -> None:
    """EVT 2.0: words of 32 bits, with the high part of the time where it changes."""
    with (folder / "data.raw").open("wb") as file:
        file.write(b"% evt 2.0\n% geometry 640x480\n% end\n")
        for chunk in pieces(events):
            low = chunk.t_us % 64
            word = chunk.p.astype(np.int64) << 28 | low << 22 | chunk.x.astype(np.int64) << 11
            word |= chunk.y
            high = np.flatnonzero(low == 0)
            words = np.insert(word, high, 8 << 28 | chunk.t_us[high] >> 6)
            file.write(words.astype("<u4").tobytes())


def _csv(folder: Path, events: int) -> None:
    import pyarrow as pa
    from pyarrow.csv import CSVWriter

    kinds = {"t": pa.int64(), "x": pa.uint16(), "y": pa.uint16(), "p": pa.uint8()}
    with CSVWriter(folder / "data.csv", pa.schema(kinds)) as file:
        for chunk in pieces(events):
            columns = {"t": chunk.t_us, "x": chunk.x, "y": chunk.y, "p": chunk.p}
            file.write(pa.table(columns))


def _numpy(folder: Path, events: int) -> None:
    rows = np.lib.format.open_memmap(
        folder / "data.npy",
        "w+",
        [("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("p", "u1")],
        (events,),
    )
    first = 0
    for chunk in pieces(events):
        part = rows[first : first + len(chunk)]
        part["t"], part["x"], part["y"], part["p"] = chunk.t_us, chunk.x, chunk.y, chunk.p
        first += len(chunk)
    rows.flush()


def _peak(what: str, form: str, folder: Path) -> float:
    command = [sys.executable, "-m", __name__, what, form, str(folder)]
    done = subprocess.run(command, stdout=subprocess.PIPE, check=True)
    return float(done.stdout)


def run(what: str, form: str, folder: Path) -> None:
    """Import the data of a folder into the store next to it, or export that."""
    from sliplab.storage.trials.store import TrialStore

    store = TrialStore(folder / "store")
    if what == "export":
        from sliplab.storage.formats.export_trials import export_trials

        recordings = list(store.campaign("large").recordings())
        export_trials(recordings, folder / "out", form, "large")
    elif form in ADAPTED:
        from sliplab.plugins.adapters.importing import import_adapted
        from sliplab.plugins.adapters.trials import find_trials
        from sliplab.protocols.adapter import load_adapter
        from sliplab.storage.formats.data_folder import DataFolder

        file = folder / "adapter.yaml"
        found = find_trials(load_adapter(file), file, DataFolder(folder / "data"))
        import_adapted(store, "large", found, file.read_text("utf-8"))
    else:
        from sliplab.storage.formats.import_trials import import_trials
        from sliplab.storage.formats.recognition import trials_in

        data = folder / "data"
        import_trials(store, "large", trials_in(data, form), data, form)


if __name__ == "__main__":
    run(sys.argv[1], sys.argv[2], Path(sys.argv[3]))
    print(peak_mb())
