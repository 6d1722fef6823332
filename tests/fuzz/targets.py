"""Fuzzing targets: seed files to damage, and the real readers that parse them."""

from __future__ import annotations

import json
import pickle
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from sliplab.storage.trials.superblock import SIGNATURE
from tests.conftest import ROOT

SCHEDULE = b"""\
schedule: 1
rig: mock
nights:
  - {days: [mon, tue, wed, thu, fri], from: "19:00", to: "07:00"}
weekends: {from: "sat 08:00", to: "mon 06:00"}
deployments:
  - {name: pilot, flow: collect, protocol: protocols/pilot.yaml, store: data/pilot, trials: 20}
"""


@dataclass(frozen=True)
class Target:
    """One kind of file.

    Attributes:
        kind: how it may be damaged (`tests.fuzz.mutate.mutate`).
        seeds: whole files by name.
        read: puts the damaged file where it belongs in a folder, and reads all of it.
        weight: how often it is chosen.
    """

    name: str
    kind: str
    seeds: dict[str, bytes]
    read: Callable[[Path, str, bytes], None]
    weight: int = 1


def _written(box: Path, name: str, data: bytes) -> Path:
    path = box / name
    path.write_bytes(data)
    return path


def read_protocol(box: Path, name: str, data: bytes) -> None:
    """A protocol, expanded, with all that `sliplab plan` tells of it."""
    from sliplab.flows.planning.plan_view import plan_json
    from sliplab.protocols.plan import load_plan

    plan = load_plan(_written(box, "protocol.yaml", data))
    json.dumps(plan_json(plan, None, None, None), allow_nan=False)
    plan.warnings()


def read_rig(box: Path, name: str, data: bytes) -> None:
    """A rig file, with what it extends."""
    from sliplab.rigs.rig_file import load_rig_file, same_rig

    for other in (ROOT / "rigs").glob("*.yaml"):
        if not (box / other.name).exists():
            shutil.copy(other, box / other.name)
    rig, text = load_rig_file(_written(box, "rig-under-test.yaml", data))
    rig.skin.layout_mm()
    same_rig(text, text + "\n")


def read_yaml(box: Path, name: str, data: bytes) -> None:
    """Any other YAML: at the least the loader stands."""
    from sliplab.protocols.yaml_file import parse_yaml, read_text

    path = _written(box, "schedule.yaml", data)
    parse_yaml(read_text(path, "schedule"), path)


def read_store(box: Path, name: str, data: bytes) -> None:
    """A store with one damaged file, through everything that looks into stores.

    Half of the files get a checksum that fits, so that what is behind the checksums meets them.
    """
    from sliplab.storage.trials.checksums import sha256

    store = box / "store"
    if not store.exists():
        shutil.copytree(box.parent / "small-store", store)
        for path in store.rglob("*.*"):
            path.chmod(path.stat().st_mode | 0o200)
    path = store / name
    kept = path.read_bytes()
    sums = path.parent / "checksums.json"
    kept_sums = sums.read_bytes() if sums.exists() else None
    path.write_bytes(data)
    try:
        fits = len(data) % 2 or path.suffix == ".h5"
        if kept_sums is not None and fits and path.name != "checksums.json":
            said = json.loads(kept_sums)
            if path.name in said:
                said[path.name] = {"sha256": sha256(path), "bytes": len(data)}
                sums.write_text(json.dumps(said))
        look_through(store, with_trials="/trials/" in name)
    finally:
        path.write_bytes(kept)
        if kept_sums is not None:
            sums.write_bytes(kept_sums)


def look_through(folder: Path, with_trials: bool = True) -> None:
    """Everything that reads a store without devices; one fault does not hide the others."""
    from sliplab.protocols.errors import InputError
    from sliplab.storage.errors import StoreError
    from sliplab.storage.trials.catalogue import catalogue, table_records
    from sliplab.storage.trials.control import open_requests, paused, skipped
    from sliplab.storage.trials.store import TrialStore
    from sliplab.storage.trials.verify import verify

    store = TrialStore.open(folder)
    if with_trials:
        json.dumps([vars(item) for item in verify(store)], allow_nan=False)
        json.dumps(table_records(catalogue(store, [])), allow_nan=False)
    open_requests(store)
    paused(store)
    found: StoreError | InputError | None = None
    for campaign in store.campaigns():
        looks: list[Callable[[], Any]] = [
            lambda campaign=campaign: campaign.info,
            lambda campaign=campaign: skipped(campaign),
            campaign.quarantined,
            campaign.failed_attempts,
            campaign.attempts,
            campaign.damaged,
        ]
        looks += [
            lambda recording=recording: read_recording(recording)
            for recording in (campaign.recordings() if with_trials else ())
        ]
        for look in looks:
            try:
                look()
            except (StoreError, InputError) as error:
                found = error
    if found is not None:
        raise found


def read_recording(recording: Any) -> None:
    """All streams of a trial, and its clocks."""
    json.dumps(recording.record.to_json())
    if recording.clocks.events is not None:
        recording.clock("events")
    _ = recording.motion_phase, recording.simulated, recording.frame_source
    recording.simulation_truth()
    recording.checksum  # noqa: B018
    with recording.open() as reader:
        reader.events()
        reader.events(0, 10_000_000)
        reader.poses()
        reader.counts()
    recording.frame_times()


def read_foreign_pickle(box: Path, name: str, data: bytes) -> None:
    """A pickle of the lab's kind."""
    from sliplab.plugins.formats.lab import pickles

    _read_pickles_here()
    pickles.parse_pickle(data, name)


def _read_pickles_here() -> None:
    """Read pickles without the child process: the worker watches and limits this one."""
    from sliplab.plugins.formats.lab import pickle_child, pickles

    pickles.in_child = lambda data, seconds: pickle_child.answer(data)


def read_foreign(box: Path, name: str, data: bytes) -> None:
    """A file of another program, found by its name and read to its end."""
    from sliplab.protocols.errors import InputError
    from sliplab.storage.formats.foreign import FormatError
    from sliplab.storage.formats.import_trials import import_trials
    from sliplab.storage.formats.recognition import kind_of, trials_in
    from sliplab.storage.trials.store import TrialStore

    _read_pickles_here()
    folder = box / "foreign"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    if name.endswith(".json"):
        (folder / "t.aedat4").write_bytes((box.parent / "t.aedat4").read_bytes())
    path = _written(folder, name, data)
    where = folder if name.endswith(".json") else path
    try:
        if name.endswith(".mcap"):  # may hold a whole trial of a store
            shutil.rmtree(box / "again", ignore_errors=True)
            made = TrialStore.create(box / "again")
            salvage = bool(len(data) % 2)
            found = trials_in(where, "mcap", salvage=salvage)
            import_trials(made, "again", found, where, "mcap", salvage=salvage)
            return
        for trial in trials_in(where, kind_of(where), salvage=bool(len(data) % 2)):
            if trial.error is not None:
                raise trial.error
            sum(len(chunk) for chunk in trial.events())
            sum(len(chunk) for chunk in (trial.frames or (lambda: iter(())))())
            json.dumps([trial.about, trial.condition], allow_nan=False)
    except FormatError as error:
        raise InputError(path, "", None, str(error)) from None


def make_foreign(folder: Path) -> dict[str, bytes]:
    """One small file of each kind, by name."""
    from sliplab.storage.formats.export_trials import export_trials
    from sliplab.storage.trials.store import TrialStore
    from tests.storage.formats.files import lab_cells, lab_hdf5

    recording = TrialStore.open(folder / "small-store").campaign("c").recording("a,r=1")
    lab_hdf5(folder / "lab.h5")
    found = {"lab.h5": (folder / "lab.h5").read_bytes()}
    with h5py.File(folder / "lab.h5", "r+") as file:
        file.attrs["sensor_resolution"] = np.array([640, 480])
    found["d2_s1.0_stream"] = (folder / "lab.h5").read_bytes()
    cells = lab_cells((128, 128), {(3, 5): [10.5, 11.0], (100, 7): [12.0]})
    np.save(folder / "a_events_on.npy", cells, allow_pickle=True)
    found["a_events_on.npy"] = (folder / "a_events_on.npy").read_bytes()
    np.save(folder / "a_events_on.npy", np.arange(128 * 128.0).reshape(128, 128, 1))
    found["b_off.npy"] = (folder / "a_events_on.npy").read_bytes()
    for kind in ("dsec", "aedat4"):  # whose manifest stays
        out = folder / f"box-made-{kind}"
        export_trials([recording], out, kind, "c")
        for path in out.iterdir():
            plain = {".json": "sliplab-export.json"}.get(path.suffix, f"t{path.suffix}")
            data = path.read_bytes()
            found[plain] = data.replace(b"a,r=1.aedat4", b"t.aedat4")
    (folder / "t.aedat4").write_bytes(found["t.aedat4"])
    return found | _made_mcap(folder)


def _made_mcap(folder: Path) -> dict[str, bytes]:
    """A published trial as it is, and without compression and checksums, which hide damage."""
    from mcap.reader import make_reader
    from mcap.writer import CompressionType, Writer

    from sliplab.plugins.formats.ros.mcap_writer import write_mcap
    from sliplab.storage.trials.store import TrialStore

    store = TrialStore.open(folder / "small-store")
    campaign = store.campaign("c")
    whole, bare = folder / "whole.mcap", folder / "bare.mcap"
    whole.unlink(missing_ok=True)
    write_mcap(whole, store, campaign, campaign.recording("a,r=1"))
    with whole.open("rb") as file, bare.open("wb") as out:
        reader = make_reader(file)
        writer = Writer(out, compression=CompressionType.NONE, enable_crcs=False)
        writer.start("ros2")
        channels: dict[int, int] = {}
        for schema, channel, message in reader.iter_messages():
            if channel.id not in channels:
                known = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, known, channel.metadata
                )
            number = channels[channel.id]
            writer.add_message(number, message.log_time, message.data, message.publish_time)
        for one in reader.iter_attachments():
            writer.add_attachment(0, 0, one.name, one.media_type, one.data)
        for about in reader.iter_metadata():
            writer.add_metadata(about.name, about.metadata)
        writer.finish()
    return {"a.mcap": whole.read_bytes(), "b.mcap": bare.read_bytes()}


def pickle_seeds() -> dict[str, bytes]:
    """Small ones in all protocols."""
    lists = np.empty((4, 3), object)
    for index in np.ndindex(4, 3):
        lists[index] = [float(i) + 0.25 for i in range(sum(index))]
    values = {
        "lists": lists,
        "times": [1700000000.25 + i for i in range(20)],
        "array": np.arange(20.0).reshape(4, 5),
        "mixed": {"a": [1, 2.5, "x", None, True], "b": (1, (2, 3)), "c": np.float32(2), "d": b"x"},
    }
    return {
        f"{name}-{protocol}": pickle.dumps(value, protocol)
        for name, value in values.items()
        for protocol in range(pickle.HIGHEST_PROTOCOL + 1)
    }


def make_small_store(folder: Path) -> None:
    """A store with a bit of everything that may stand in one."""
    from sliplab.storage.trials import control
    from tests.storage.trial_files import campaign, commit

    made = campaign(folder)
    protocol = "protocol: 1\ncollection: {factors: {depth: {unit: mm, values: [2.4, 2.8]}}}\n"
    made.update({"name": "c", "simulated": True}, protocol, "rig: 1\ndevices: [a, b]\n")
    steps = [{"index": 0, "phase": "slide", "start_ns": 10, "end_ns": 500}]
    commit(made, "a,r=1", steps=steps)
    by = {"who": "somebody", "when": "2026-01-01T00:00:00Z", "why": "because"}
    control.skip(made, ["c,r=1"], by)
    made.quarantine(commit(made, "d,r=1"), "gate sync_uncertainty")
    made.add_bench_record({"operator": "somebody", "temperature": 21.5})
    store_of = made.folder.parents[1]
    from sliplab.storage.trials.store import TrialStore

    opened = TrialStore.open(store_of)
    control.answer(opened, control.ask(opened, "pause", who="a"), {"did": "paused"})
    control.ask(opened, "again", who="a", campaign="c", trials=("a,r=1",))


def targets(small_store: Path, foreign: dict[str, bytes]) -> list[Target]:
    """All of them; `small_store` and `foreign` were made by the functions above."""
    manifest = {name: data for name, data in foreign.items() if name.endswith(".json")}
    files = {
        path.relative_to(small_store).as_posix(): path.read_bytes()
        for path in sorted(small_store.rglob("*"))
        if path.suffix in {".json", ".yaml"}
    }
    data = next(small_store.glob("campaigns/c/trials/*/data.h5"))
    small = sorted((ROOT / "protocols").glob("pilot*.yaml"))
    rigs = sorted((ROOT / "rigs").glob("*.yaml"))
    return [
        Target("protocol", "yaml", {p.name: p.read_bytes() for p in small}, read_protocol, 4),
        Target("rig", "yaml", {p.name: p.read_bytes() for p in rigs}, read_rig, 3),
        Target("schedule", "yaml", {"schedule.yaml": SCHEDULE}, read_yaml, 1),
        Target(
            "record",
            "json",
            {name: data for name, data in files.items() if name.endswith(".json")},
            read_store,
            4,
        ),
        Target(
            "campaign yaml",
            "yaml",
            {name: data for name, data in files.items() if name.endswith(".yaml")},
            read_store,
            1,
        ),
        Target("manifest", "json", manifest, read_foreign, 1),
        Target(
            "foreign",
            "bytes",
            {name: data for name, data in foreign.items() if name not in manifest},
            read_foreign,
            6,
        ),
        Target(
            "trial hdf5",
            "hdf5",
            {data.relative_to(small_store).as_posix(): data.read_bytes()},
            read_store,
            3,
        ),
        Target(
            "foreign hdf5",
            "hdf5",
            {name: item for name, item in foreign.items() if item.startswith(SIGNATURE)},
            read_foreign,
            3,
        ),
        Target("pickle", "bytes", pickle_seeds(), read_foreign_pickle, 8),
    ]
