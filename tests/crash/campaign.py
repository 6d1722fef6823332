"""A campaign of small fast slides, and what must be true of its store at any moment."""

from __future__ import annotations

import copy
import hashlib
from pathlib import Path
from typing import Any

import yaml

from sliplab.flows.collecting.session import open_session
from sliplab.flows.planning.run_request import RunRequest, make_request
from sliplab.storage.files import read_json
from sliplab.storage.trials.store import TrialStore
from sliplab.storage.trials.verify import UNFINISHED, verify
from tests.conftest import ROOT, SMALL

NAME = "crash"
BY_TIME = {"provenance.json"}
"""Time and place: the only file of a trial that differs between runs."""

WITH_VIDEO = {
    "extends": str(ROOT / "rigs" / "mock.yaml"),
    "name": "crash",
    "streams": {
        "side": {"kind": "events", "mock": {"width": 160, "height": 120, "px_per_mm": 3.5}},
        "back": {
            "kind": "frames",
            "scale_px_per_mm": 4,
            "region_px": [64, 64],
            "mock": {"px_per_mm": 4},
            "timing": {"resolution_us": 0},
        },
    },
}
"""The rig of trials with a video, which has a further camera of either kind, too."""


def protocol(trials: int, video: bool = False) -> dict[str, Any]:
    """Slides that are over in a second, each in a direction of its own."""
    data = copy.deepcopy(SMALL)
    data["name"] = NAME
    collection = data["collection"]
    collection["factors"]["depth"]["values"] = [2.4]
    collection["factors"]["speed"]["values"] = [1.6]
    collection["factors"]["direction"]["values"] = [
        round(137.508 * number % 360, 2) for number in range(trials)
    ]
    collection["motion"][3]["distance"] = "1.6 mm"
    collection["motion"][2] = {"phase": "hold", "settle": "0.2 s", "duration": "0.5 s"}
    collection["maintenance"] = {"rezero": {"every": 7, "speed": "0.5 mm/s", "search": "0.5 mm"}}
    # about one attempt in five is over this, so that retakes are interrupted as well
    collection["gates"]["sync_uncertainty"]["digital_input"] = "0.0036 ms"
    collection["gates"]["retakes"] = 10
    if video:
        collection["recording"]["region"] = {"width": "12 mm", "height": "12 mm"}
    data["analysis"]["split"] = {"method": "ranked"}
    return data


def run_request(folder: Path, trials: int, video: bool = False) -> RunRequest:
    """Protocol and rig file in `folder`, and a store beside them that may not exist yet."""
    folder.mkdir(parents=True, exist_ok=True)
    text = yaml.dump(protocol(trials, video), Dumper=yaml.CSafeDumper)
    (folder / "protocol.yaml").write_text(text)
    rig = ROOT / "rigs" / "rehearsal.yaml"
    if video:
        rig = folder / "rig.yaml"
        rig.write_text(yaml.safe_dump(WITH_VIDEO))
    return make_request(folder / "protocol.yaml", rig, folder / "store")


def collect(wanted: RunRequest) -> None:
    """Take what the store lacks, as `sliplab collect` does below Prefect."""
    with open_session(wanted) as work:
        work.collector.rig.connect()
        work.collector.take(work.trials)


def hashes(store: Path) -> dict[str, dict[str, str]]:
    """SHA-256 of every file of every committed trial, without what differs by time."""
    folder = store / "campaigns" / NAME / "trials"
    return {
        trial.name: {
            path.name: hashlib.sha256(path.read_bytes()).hexdigest()
            for path in sorted(trial.iterdir())
            if path.name not in BY_TIME
        }
        for trial in (sorted(folder.iterdir()) if folder.is_dir() else [])
    }


def wrong(store: Path, whole: dict[str, dict[str, str]]) -> list[str]:
    """Return the faults of a store right after a kill; empty if it is consistent.

    A trial that is there is byte for byte the undisturbed one, and `verify` finds nothing that is
    damaged, only what the next collection clears up.
    """
    found = [
        f"{name}: is not the undisturbed trial"
        for name, files in hashes(store).items()
        if whole.get(name) != files
    ]
    if (store / "store.json").exists():
        problems = verify(TrialStore.open(store))
        found += [f"{p.path}: {p.what}" for p in problems if p.kind != UNFINISHED]
    return found


def wrong_at_the_end(
    store: Path, whole: dict[str, dict[str, str]], also: str = "interrupted"
) -> list[str]:
    """Return the faults of a store after the campaign has finished; empty if there are none.

    Args:
        also: how another cause may begin for which something is in quarantine.
    """
    found = wrong(store, whole)
    there = hashes(store)
    found += [f"{name}: is missing" for name in sorted(whole.keys() - there.keys())]
    found += [f"{p.path}: {p.what}" for p in verify(TrialStore.open(store))]
    campaign = store / "campaigns" / NAME
    wanted = {
        "protocol.yaml",
        "rig.yaml",
        "campaign.json",
        "checksums.json",
        "trials",
        "incoming",
        "quarantine",
        "bench",
    }
    for folder, names in ((store, {"store.json", ".lock", "campaigns"}), (campaign, wanted)):
        strangers = {path.name for path in folder.iterdir()} - names
        found += [f"{folder / name}: is litter" for name in sorted(strangers)]
    found += [f"{path}: is litter" for path in store.rglob("*.tmp")]
    found += [f"{path}: is litter" for path in (campaign / "incoming").iterdir()]
    for path in (campaign / "quarantine").iterdir():
        cause = str(read_json(path / "cause.json").get("cause", ""))
        if not cause.startswith(("interrupted", "gate: ", also)):
            found.append(f"{path}: is in quarantine for '{cause}'")
    return found
