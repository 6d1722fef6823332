"""Foreign data sets by adapters: what is imported, and what is refused."""

from __future__ import annotations

import copy
import json
import re
import zipfile
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from sliplab.analysis.campaigns import Collected
from sliplab.plugins.adapters.importing import import_adapted
from sliplab.plugins.adapters.trials import find_trials
from sliplab.protocols.adapter import load_adapter
from sliplab.protocols.errors import InputError
from sliplab.storage.errors import DamagedFile
from sliplab.storage.formats.data_folder import DataFolder
from sliplab.storage.formats.foreign import FormatError
from sliplab.storage.formats.tables import read_columns
from sliplab.storage.trials.store import TrialStore
from sliplab.storage.trials.verify import verify
from tests.command_line import here
from tests.conftest import ROOT
from tests.plugins.adapters.adapters import COUNTS, SLIDES, bring, slides, touches
from tests.protocols.planning import put_all
from tests.protocols.planning import rows as table_of
from tests.storage.formats.recordings import write_aedat4


def test_counts_become_events_that_bin_to_the_counts(tmp_path: Path) -> None:
    made = touches(tmp_path / "set", lambda n: f"sample_{n}_label_{n % 3}.npy")
    np.save(tmp_path / "set" / "train" / "sample_9_label_1.npy", np.zeros((5, 2, 8)))
    campaign = bring(COUNTS, tmp_path / "set", tmp_path / "store")
    for id_, counts in made.items():
        recording = campaign.recording(id_)
        events = recording.events()
        again = np.zeros_like(counts)
        np.add.at(again, (events.x, events.p, events.t_us // 20_000), 1)
        np.testing.assert_array_equal(again, counts)
        assert recording.event_px == (5, 1)
        assert recording.record.imported.span_ns == (0, 160_000_000)
    assert not len(campaign.recording("train-sample_9_label_1").events())
    plan = Collected(campaign).planned
    assert plan.classes == ("0", "1", "2")
    assert {trial.id: trial.split for trial in plan}["test-sample_4_label_1"] == "test"


@pytest.mark.parametrize("below", ["", "Ev-Other", "Ev-Other/train"])
def test_the_shipped_adapter_fits_other_names_and_other_places(below: str, tmp_path: Path) -> None:
    text = (ROOT / "examples" / "ev-objects" / "adapter.yaml").read_text()
    touches(tmp_path / "set" / "Ev-Other", lambda n: f"touch-{n}.object{n % 3:02d}_x.npy")
    campaign = bring({}, tmp_path / "set" / below, tmp_path / "store", text)
    assert len(campaign.committed()) == (3 if below.endswith("train") else 6)
    assert Collected(campaign).planned.classes == ("00", "01", "02")
    given = campaign.recording("train-touch-2.object02_x").record.imported.given
    assert [span.name for span in given.spans] == ["02"]


def test_a_pattern_that_fits_nothing_says_what_is_there(tmp_path: Path) -> None:
    touches(tmp_path / "set", lambda n: f"sample_{n}.bin.npy")
    wrong = {**COUNTS, "trials": {"files": "*.mat"}}
    with pytest.raises(InputError, match=r"trials.files = \*.mat: fits no file .* 6 files: test/"):
        bring(wrong, tmp_path / "set", tmp_path / "store")
    assert not (tmp_path / "store").exists()


def test_a_set_of_slides_comes_with_all_of_its_streams(tmp_path: Path) -> None:
    names = slides(tmp_path / "set")
    campaign = bring(SLIDES, tmp_path / "set", tmp_path / "store")
    assert campaign.committed() == set(names)
    recording = campaign.recording("ann_0.6_0")
    record = recording.record
    assert record.condition == {"speed": "0.6 mm/s", "side": "left"}
    fields = {"person": "ann", "speed": "0.6", "number": "0", "side": "left"}
    assert record.imported.fields == fields
    events = recording.events()
    np.testing.assert_array_equal(events.t_us, np.arange(101) * 10_000)
    np.testing.assert_array_equal(events.p, np.arange(101) % 2 == 0)
    with recording.open() as reader:
        np.testing.assert_array_equal(reader.poses().xyz_mm[3], [100, 3000, 0])
    assert record.counts.frames == 4
    assert record.streams["force"].rows == 5
    given = record.imported.given
    assert (given.incipient_ns, given.gross_ns) == (305_000_000, 405_500_000)
    assert given.uncertainty_ns == 2_500_000
    assert record.clocks.frames.grade == "given"
    assert record.clocks.arm.uncertainty_ns is None
    assert "clock of arm" in record.imported.unknown
    assert [step.phase for step in record.steps] == ["hold", "slide"]
    assert recording.motion_ns == (100_000_000, 900_000_000)
    assert campaign.recording("ann_2_1").record.imported.given.gross_ns is None
    assert campaign.recording("cid_2_0").record.imported.given is None
    parts = {trial.id: trial.split for trial in Collected(campaign).planned}
    assert parts["ann_0.6_0"] == parts["ann_2_1"]


def spans_of(folder: Path) -> dict[str, Any]:
    """The same slides with their labels as intervals in a file a trial, in JSON lines."""
    for name in slides(folder):
        lines = [(0, 0.25, "stick"), (0.25, 0.500000001, "slip")]
        text = "".join(json.dumps({"a": a, "b": b, "what": c}) + "\n" for a, b, c in lines)
        (folder / "rec" / name / "marks.jsonl").write_text(text)
    spans = {"file": "rec/{folder}/marks.jsonl", "start": "a", "end": "b", "class": "what"}
    names = {"stick": "no_slip", "slip": "incipient"}
    spans |= {"unit": "s", "clock": "start", "names": names}
    return {**SLIDES, "labels": {"spans": spans}}


def test_intervals_become_onsets_of_slip_or_classes(tmp_path: Path) -> None:
    adapter = spans_of(tmp_path / "set")
    campaign = bring(adapter, tmp_path / "set", tmp_path / "store")
    given = campaign.recording("bob_0.6_1").record.imported.given
    assert (given.incipient_ns, given.gross_ns, given.spans) == (250_000_000, None, ())
    adapter = {**adapter, "name": "marks", "experiment": "classes"}
    del adapter["motion"]
    adapter["labels"]["spans"].pop("names")
    campaign = bring(adapter, tmp_path / "set", tmp_path / "store")
    given = campaign.recording("bob_0.6_1").record.imported.given
    assert [(s.start_ns, s.end_ns, s.name) for s in given.spans] == [
        (0, 250_000_000, "stick"),
        (250_000_000, 500_000_001, "slip"),
    ]
    assert Collected(campaign).planned.classes == ("slip", "stick")


def test_a_table_may_say_what_the_trials_are_and_a_zip_is_read_in_place(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    counts = rng.integers(0, 3, (4, 2, 3))
    with zipfile.ZipFile(tmp_path / "set.zip", "w") as packed:
        for number in range(4):
            np.save(tmp_path / "one.npy", counts)
            packed.write(tmp_path / "one.npy", f"top/data/{number}.npy")
        table = [{"name": n, "kind": "ab"[n % 2], "who": "x"} for n in range(4)]
        packed.writestr("top/trials.json", json.dumps(table))
        packed.writestr("top/.hidden", "")
        packed.writestr("../out.npy", "")
    adapter = {
        "adapter": 1,
        "name": "packed",
        "experiment": "classes",
        "trials": {"table": "**/trials.json", "files": "top/data/{name}.npy", "id": "t{name}"},
        "streams": {"events": {"format": "counts", "axes": ["step", "y", "x"], "step_ms": 0.5}},
        "labels": {"class": "{kind}"},
    }
    campaign = bring(adapter, tmp_path / "set.zip", tmp_path / "store")
    recording = campaign.recording("t3")
    again = np.zeros_like(counts)
    events = recording.events()
    np.add.at(again, (events.t_us // 500, events.y, events.x), 1)
    np.testing.assert_array_equal(again, counts)
    assert recording.event_px == (3, 2)
    assert recording.record.imported.fields == {"name": "3", "kind": "b", "who": "x"}


ORDER = "{file: onsets.csv, match: {trial: '{id}'}, incipient: full, gross: first, unit: ms, \
clock: frames, uncertainty_ms: 2}"
# what is changed | what is said
WRONG = f"""
    fields.side.from: '{{nothing}}' | adapter.yaml: fields.side = '?{{nothing}}.*is no field of \
rec/ann_0.6_0
    trials.id: '{{person}}' | trials.id = '?{{person}}.*gives .* and .* one id, ann
    factors.speed.field: person | factors.speed = '?ann.*must be a number of mm/s
    streams.events.columns.t: zeit | events.csv: streams.events: has no column zeit; there are \
time, x
    streams.events.columns.t: trial | events.csv: streams.events: has no column trial
    labels.onsets.gross: fall | labels.onsets.gross = '?fall.*there are first
    labels.onsets.unit: s | onsets.csv: row 2, first = '?300.*lies outside of
    labels.onsets: {ORDER} | onsets.csv: row 2, first = '?300.*lies before full
    streams.events.size_px: [8, 12] | up to column 15 .* 8 x 12
    streams.events.format: csvv | streams.events.format = csvv.*did you mean 'csv'
    motion.end: 5 | motion.start = 0.1: to 5: lies outside
"""


@pytest.mark.parametrize(("change", "message"), table_of(WRONG))
def test_what_is_wrong_is_named_and_nothing_is_written(
    change: str, message: str, tmp_path: Path
) -> None:
    adapter = copy.deepcopy(SLIDES)
    put_all(adapter, change)
    slides(tmp_path / "set")
    file = tmp_path / "adapter.yaml"
    file.write_text(yaml.safe_dump(adapter))
    done = here("import", "--adapter", file, tmp_path / "set", "--store", tmp_path / "store")
    assert done.returncode == 2, done.stderr
    assert re.search(message, done.stderr), done.stderr
    assert not (tmp_path / "store").exists()


def test_tables_name_the_row_that_is_wrong(tmp_path: Path) -> None:
    slides(tmp_path / "set")
    onsets = tmp_path / "set" / "onsets.csv"
    for text, message in (
        ("trial,first,full\nann_0.6_0,nan,1\n", "row 2, first = '?nan"),
        ("trial,first,full\nann_0.6_0,300,400\nann_0.6_0,310,400\n", "row 3.* same trial as row 2"),
        ("trial,first,full\nann_0.6_0,300\n", "row 2.*2 cells below a heading of 3"),
        ("trial,first,first\n", "row 1 = '?first.*two columns"),
    ):
        onsets.write_text(text)
        with pytest.raises(InputError, match=message):
            bring(SLIDES, tmp_path / "set", tmp_path / "store")
    events = tmp_path / "set" / "rec" / "ann_0.6_0" / "events.csv"
    onsets.write_text("trial,first,full\nann_0.6_0,300,400\nzoe,1,2\n")
    for row, message in (
        ("0.1,1,1,x", "not all numbers: row 2 is 'x'"),
        ("nan,1,1,1", "no number in column time: row 2"),
    ):
        events.write_text(f"time,x,y,polarity\n{row}\n")
        with pytest.raises(InputError, match=message):
            bring(SLIDES, tmp_path / "set", tmp_path / "store")


def test_an_import_lists_first_then_adds_what_is_new(tmp_path: Path) -> None:
    made = touches(tmp_path / "set", lambda n: f"sample_{n}_label_{n % 3}.npy")
    (tmp_path / "set" / "notes.txt").write_text("mixed")
    (tmp_path / "set" / "link.npy").symlink_to("/etc/hostname")
    file = tmp_path / "adapter.yaml"
    line = ("import", "--adapter", file, tmp_path / "set", "--store", tmp_path / "store", "--json")
    file.write_text(yaml.safe_dump(COUNTS))
    listed = json.loads(here(*line, "--dry-run").stdout)
    assert not (tmp_path / "store").exists()
    assert {row["trial"]: row["label"] for row in listed["trials"]} == {
        name: name[-1] for name in made
    }
    assert {item["file"]: item["reason"] for item in listed["skipped"]} == {
        "notes.txt": "matches no pattern of the adapter",
        "link.npy": "is a link",
    }
    done = here(*line)
    assert len(json.loads(done.stdout)["imported"]) == 6, done.stderr
    np.save(tmp_path / "set" / "train" / "sample_7_label_1.npy", np.ones((5, 2, 8)))
    file.write_text(yaml.safe_dump({**COUNTS, "title": "Later", "split": {"together": "object"}}))
    again = json.loads(here(*line).stdout)
    assert (again["imported"], len(again["there"])) == (["train-sample_7_label_1"], 6)
    campaign = TrialStore.open(tmp_path / "store").campaign("touch")
    assert "Later" in campaign.protocol_file.read_text()
    file.write_text(yaml.safe_dump({**COUNTS, "labels": {}}))
    refused = here(*line)
    assert refused.returncode == 2
    assert "labels: differs from the adapter of campaign 'touch'" in refused.stderr
    assert not verify(TrialStore.open(tmp_path / "store"))


def test_a_table_without_a_heading_keeps_its_first_row(tmp_path: Path) -> None:
    folder = DataFolder(tmp_path)
    (tmp_path / "a.csv").write_text("1;on;2.5\n2;off;3\n")
    (tmp_path / "b.csv").write_text("t;how;x\n1;on;2.5\n")
    for name, rows in (("a.csv", 2), ("b.csv", 1)):
        found, _ = read_columns(folder, name, "csv", {"t": 0, "x": 2})
        assert (len(found["t"]), found["x"][0]) == (rows, 2.5)
    assert read_columns(folder, "b.csv", "csv", {"t": "t", "x": 2})[0]["t"].tolist() == [1]
    with pytest.raises(FormatError, match="has no column x; there are 1, on"):
        read_columns(folder, "a.csv", "csv", {"t": "x"})


def test_what_is_committed_stays_when_an_import_is_stopped(tmp_path: Path) -> None:
    touches(tmp_path / "set", lambda n: f"sample_{n}_label_{n % 3}.npy")
    file = tmp_path / "adapter.yaml"
    file.write_text(yaml.safe_dump(COUNTS))
    found = find_trials(load_adapter(file), file, DataFolder(tmp_path / "set"))
    store = TrialStore.create(tmp_path / "store")
    left = iter(range(2))

    def stop(trial: str) -> None:
        if next(left, None) is None:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        import_adapted(store, "touch", found, file.read_text(), stop)
    assert len(store.campaign("touch").committed()) == 2
    assert not verify(store)
    again = import_adapted(store, "touch", found, file.read_text())
    assert (len(again["imported"]), len(again["there"])) == (4, 2)


def test_of_a_damaged_file_what_stands_whole_is_taken_with_its_labels(tmp_path: Path) -> None:
    folder = tmp_path / "theirs"
    folder.mkdir()
    write_aedat4(folder / "slip.aedat4")
    whole = (folder / "slip.aedat4").read_bytes()
    (folder / "slip.aedat4").write_bytes(whole[:-5000])
    file = tmp_path / "a.yaml"
    file.write_text(
        "adapter: 1\nname: slips\nexperiment: classes\ntrials: {files: '{object}.aedat4'}\n"
        "streams: {events: {format: aedat4}}\nlabels: {class: '{object}'}\n"
    )
    store = TrialStore.create(tmp_path / "store")
    with closing(DataFolder(folder)) as opened:
        found = find_trials(load_adapter(file), file, opened)
        with pytest.raises(
            DamagedFile, match=r"slip\.aedat4: streams\.events: is cut short: .*--salvage imports"
        ):
            import_adapted(store, "slips", found, file.read_text())
        assert not store.campaigns()
        done = import_adapted(store, "slips", found, file.read_text(), salvage=True)
    (lost,) = done["salvaged"]
    assert (done["events"], lost["file"]) == (2300, "slip.aedat4")
    record = store.campaign("slips").recording("slip").record
    assert record.imported.lost is not None
    assert [span.name for span in record.imported.given.spans] == ["slip"]
