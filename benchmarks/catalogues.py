"""One filtered query over very many trial records, as `sliplab trials --where` asks it.

The records are as long as real ones in what the catalogue reads; the events and frames beside them
are one file under many names, which the catalogue does not open.
"""

from __future__ import annotations

import json
import os
import tempfile
import time
from pathlib import Path

from benchmarks.measure import Figures, alternate, spread
from sliplab.storage.clockmap import ClockMap
from sliplab.storage.files import sha256
from sliplab.storage.trials.catalogue import catalogue, query
from sliplab.storage.trials.checksums import CHECKSUMS, DATA, FRAMES, RECORD
from sliplab.storage.trials.store import TrialStore

_LINKS = 30_000
"""Names that a file system lets one file have, and then some."""
WHERE = "depth_mm > 3 and side == 'right' and events > 500"


def catalogue_figures(records: int, runs: int) -> Figures:
    """Seconds of the first catalogue, which builds the index, and of a query after it."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        store = TrialStore.create(Path(folder) / "store")
        fill(store, records)
        began = time.perf_counter()
        whole = catalogue(store)
        built = time.perf_counter() - began
        catalogue(store)  # what was written just before the first one is only believed now

        def ask() -> None:
            if not len(query(catalogue(store), WHERE)) < len(whole) == records:
                raise RuntimeError("the catalogue lacks trials")

        taken = alternate(runs, ask=ask)["ask"]
    return {"catalogue_build_s": built, **spread("catalogue_100k_s", taken)}


def fill(store: TrialStore, records: int) -> None:
    """Commit so many trials to a campaign of their own."""
    campaign = store.campaign("many")
    campaign.update({"name": "many", "simulated": True}, "protocol: 1\n", "rig: 1\n")
    first: dict[str, Path] = {}
    data = b"x"
    for number in range(records):
        folder = campaign.folder / "trials" / f"t{number:06d}"
        folder.mkdir()
        if number % _LINKS == 0:
            for name in (DATA, FRAMES):
                (folder / name).write_bytes(data)
                first[name] = folder / name
            same = {"sha256": sha256(first[DATA]), "bytes": len(data)}
        else:
            for name, path in first.items():
                os.link(path, folder / name)
        (folder / RECORD).write_text(json.dumps(_record(number)))
        size = (folder / RECORD).stat().st_size
        sums = {
            DATA: same,
            FRAMES: same,
            RECORD: {"sha256": sha256(folder / RECORD), "bytes": size},
        }
        (folder / CHECKSUMS).write_text(json.dumps(sums))


def _record(number: int) -> dict[str, object]:
    return {
        "trial": f"t{number:06d}",
        "experiment": "kinematic",
        "role": "measured",
        "repetition": number % 9,
        "block": number // 1000,
        "attempt": 0,
        "simulated": True,
        "recorded_s": 1.5 + number / 7,
        "counts": {"events": number % 1000, "frames": 100, "poses": 250, "pulses": 75},
        "clocks": {
            "events": {
                "uncertainty_ns": 1000.0 + number % 13,
                "map": ClockMap.line(0, number).to_json(),
            }
        },
        "quality": {"passed": True},
        "condition": {
            "depth": f"{2 + number % 20 / 10:.1f} mm",
            "speed": "1.6 mm/s",
            "side": "right" if number % 2 else "left",
        },
    }
