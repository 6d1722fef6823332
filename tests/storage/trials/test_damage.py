"""Whatever happens to a store's files, verify names it, and what is whole stays readable."""

import json
import os
from pathlib import Path

import h5py
import pytest

from sliplab.storage.errors import disk_fault, translated_disk_errors
from sliplab.storage.files import read_json, sweep_temporary, write_bytes
from sliplab.storage.schema.trial import Provenance
from sliplab.storage.trials.catalogue import catalogue
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import Campaign, StoreError, TrialStore
from sliplab.storage.trials.verify import DAMAGED, UNFINISHED, quarantine_damaged, verify
from tests.protocols.planning import rows
from tests.storage.trial_files import campaign, commit, fill, record

NOBODY = 2**22 + 1
"""No process has this number."""


def _link(path: Path, target: Path) -> None:
    path.rename(target)
    path.symlink_to(target)


def _flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


# what is done to a file or folder of the campaign | what verify says | what it is
DAMAGE = """
    remove campaign.json | campaign.json: cannot be read | damaged
    write campaign.json { | is not JSON | damaged
    write campaign.json DEEP | is not JSON | damaged
    write campaign.json {} | lacks 'name' | damaged
    write protocol.yaml protocol: 20 | protocol.yaml: does not match its checksum; \
`sliplab collect` | damaged
    write protocol.yaml a: &x [*x] | cannot be read | damaged
    write rig.yaml \xff | cannot be read | damaged
    remove rig.yaml | rig.yaml: cannot be | damaged
    remove checksums.json | collect` writes it | unfinished
    write checksums.json {"a": 1} | not a list of | damaged
    remove bench | is missing or not a folder | damaged
    make ../d | d: is a campaign without any trial | unfinished
    write ../x | x: is not a campaign folder | damaged
    link . | is not a campaign folder | damaged
    write .campaign.json.NOBODY.tmp | was left by a killed program | unfinished
    write trials/t/.cause.json.NOBODY.tmp | was left by a killed program | unfinished
    make quarantine/t.1 | gives no cause | damaged
    make trials/e | checksums.json: cannot | damaged
    write trials/e | e: is not a trial folder | damaged
    link trials/t | is not a trial folder | damaged
    link trials/t/data.h5 | is not a regular file | damaged
    write trials/t/checksums.json {"../../x": {"sha256": "", "bytes": 0}} | is not a list of \
checksums | damaged
    write trials/t/checksums.json {} | no checksum of data.h5 | damaged
    remove trials/t/provenance.json | provenance.json: cannot be | damaged
    flip trials/t/data.h5 | does not match its checksum | damaged
    flip trials/t/frames.mkv | does not match | damaged
    write trials/t/data.h5 x | has 1 bytes | damaged
    remove trials/t/frames.mkv | is missing | damaged
    flip trials/t/record.json | does not match | damaged
    remove trials/t/checksums.json | cannot be read | damaged
    write trials/t/notes.txt x | does not belong here | damaged
""".replace("DEEP", "[" * 100_000).replace("NOBODY", str(NOBODY))


def damage(folder: Path, how: str, place: str, text: str = "") -> None:
    path = folder / place
    if how == "write":
        path.write_bytes(text.encode("latin-1"))
    elif how == "link":
        _link(path, folder.parents[2] / "away")
    elif how == "remove":
        path.rmdir() if path.is_dir() else path.unlink()
    else:
        {"make": Path.mkdir, "flip": _flip}[how](path)


@pytest.mark.quick(15)
@pytest.mark.parametrize(("change", "says", "kind"), rows(DAMAGE))
def test_verify_names_it_and_what_is_whole_stays_readable(
    change: str, says: str, kind: str, tmp_path: Path
) -> None:
    where = campaign(tmp_path / "s")
    whole = [commit(where, name) for name in ("t", "whole")][1]
    damage(where.folder, *change.split(" ", 2))
    store = TrialStore.open(tmp_path / "s")
    problems = verify(store)
    kinds = {"damaged": DAMAGED, "unfinished": UNFINISHED}
    said = [f"{item.path}: {item.what}" for item in problems if item.kind == kinds[kind]]
    assert any(says in text for text in said), said or problems
    assert all(item.trial != "whole" for item in problems)
    if kind == "unfinished":
        assert all(item.kind == UNFINISHED for item in problems)
    json.dumps([vars(item) for item in problems])
    if whole.exists() and not where.folder.is_symlink():
        assert len(Recording(whole).events()) == 1000


def test_what_is_damaged_is_never_read(where: Campaign, tmp_path: Path) -> None:
    _flip(commit(where, "t") / "data.h5")
    _flip(commit(where, "u") / "record.json")
    commit(where, "whole")
    recording = where.recording("t")
    assert recording.record.trial == "t"
    with pytest.raises(StoreError, match=r"does not match its checksum.*verify .* --quarantine"):
        recording.events()
    unreadable: list[str] = []
    assert list(catalogue(TrialStore.open(tmp_path / "s"), unreadable)["trial"]) == ["t", "whole"]
    assert len(unreadable) == 1


def test_what_is_partial_is_no_trial_and_is_quarantined_with_its_cause(tmp_path: Path) -> None:
    where = campaign(tmp_path / "s")
    (commit(where, "short") / "data.h5").write_bytes(b"x")
    (commit(where, "lost") / "record.json").unlink()
    (where.folder / "trials" / "empty").mkdir()
    commit(where, "whole")
    assert where.committed() == {"whole"}
    assert [recording.trial_id for recording in where.recordings()] == ["whole"]
    unreadable: list[str] = []
    assert len(catalogue(TrialStore.open(tmp_path / "s"), unreadable)) == 1
    assert len(unreadable) == 3
    assert where.sweep() == 3
    causes = {item["trial"]: item["cause"] for item in where.quarantined()}
    assert causes["short"].startswith("damaged: ")
    assert causes["short"].endswith("data.h5: has 1 bytes, not " + causes["short"].split()[-1])
    assert causes["lost"].endswith("record.json: is missing")
    assert "checksums.json: cannot be read" in causes["empty"]
    assert where.failed_attempts() == {}
    assert verify(TrialStore.open(tmp_path / "s")) == []
    commit(where, "short")


def test_a_partial_trial_gives_way_to_the_one_that_is_taken(where: Campaign) -> None:
    (commit(where, "t") / "frames.mkv").unlink()
    commit(where, "t")
    assert where.committed() == {"t"}
    assert where.quarantined()[0]["cause"].endswith("frames.mkv: is missing")


def test_damaged_trials_are_set_aside_when_asked(where: Campaign, tmp_path: Path) -> None:
    _flip(commit(where, "t") / "data.h5")
    commit(where, "whole")
    store = TrialStore.open(tmp_path / "s")
    assert quarantine_damaged(store, verify(store)) == ["t"]
    assert where.committed() == {"whole"}
    assert where.quarantined()[0]["cause"] == "damaged: data.h5: does not match its checksum"
    assert verify(store) == []


def test_a_cause_that_cannot_be_read_is_unknown(where: Campaign) -> None:
    writer = where.begin("t", None, 100)
    writer.abandon()
    (where.quarantine(writer.folder, "gate: x") / "cause.json").write_text("{")
    assert where.quarantined()[0]["cause"] == "unknown"
    assert where.failed_attempts() == {}


def test_a_damaged_description_says_what_to_do(where: Campaign) -> None:
    commit(where, "t")
    (where.folder / "campaign.json").unlink()
    assert where.begun
    with pytest.raises(StoreError, match="restore it from a copy, or move"):
        _ = where.info


# -- only ever inside ----------------------------------------------------------------------


@pytest.mark.parametrize("inner", ["incoming", "trials", "bench", "quarantine"])
def test_a_link_does_not_lead_a_write_out_of_the_store(inner: str, tmp_path: Path) -> None:
    where, away = campaign(tmp_path / "s"), tmp_path / "away"
    _link(where.folder / inner, away)
    with pytest.raises(StoreError, match="points out of the store"):
        where.update(where.info, "protocol: 2\n", "rig: 1\n")
    if inner in {"incoming", "trials"}:
        with pytest.raises(StoreError, match="points out of the store"):
            where.begin("t", None, 100)
    if inner == "bench":
        with pytest.raises(StoreError, match="points out of the store"):
            where.add_bench_record({})
    if inner == "quarantine":
        with pytest.raises(StoreError, match="points out of the store"):
            where.quarantine(commit(where, "t"), "gate")
    assert list(away.iterdir()) == []


def test_data_that_point_out_of_their_file_are_refused(where: Campaign, tmp_path: Path) -> None:
    writer = where.begin("t", None, 100)
    fill(writer, with_frames=False)
    path = writer.seal() / "data.h5"
    with h5py.File(tmp_path / "other.h5", "w") as other:
        other["t"] = [1, 2]
    with h5py.File(path, "r+") as file:
        del file["arm_pulses/t"]
        file["arm_pulses/t"] = h5py.ExternalLink(str(tmp_path / "other.h5"), "/t")
    writer.commit(record("t"), Provenance())
    with (
        pytest.raises(ValueError, match="points outside the file"),
        where.recording("t").open() as reader,
    ):
        reader.pulses("arm_pulses")


# -- disks ---------------------------------------------------------------------------------


def test_a_disks_faults_are_said_in_words() -> None:
    assert disk_fault(OSError(28, "x")) == "is full"
    assert disk_fault(OSError(30, "x")) == "is read-only"
    reported = RuntimeError("Can't decrement id ref count (file write failed: errno = 28, ...)")
    assert disk_fault(reported) == "is full"
    assert disk_fault(RuntimeError("anything else")) is None
    assert disk_fault(FileNotFoundError(2, "x")) is None


def test_errors_of_other_devices_are_left_alone(tmp_path: Path) -> None:
    class Serial(RuntimeError):
        pass

    with pytest.raises(Serial), translated_disk_errors(tmp_path, Serial):
        raise Serial from OSError(5, "the cable was pulled")
    with (
        pytest.raises(StoreError, match="its disk reports errors"),
        translated_disk_errors(tmp_path),
    ):
        raise OSError(5, "Input/output error")


def test_temporary_files_are_swept_when_their_program_is_gone(tmp_path: Path) -> None:
    for name in (f".a.json.{NOBODY}.tmp", f".b.{os.getpid()}.tmp", f".c.{os.getppid()}.tmp", "d"):
        (tmp_path / name).write_text("")
    assert sweep_temporary(tmp_path) == 2
    assert {path.name for path in tmp_path.iterdir()} == {f".c.{os.getppid()}.tmp", "d"}


def test_a_long_name_has_room_for_its_temporary_file(tmp_path: Path) -> None:
    path = tmp_path / ("x" * 250 + ".json")
    write_bytes(path, b"{}")
    assert read_json(path) == {}


def test_bench_records_never_take_each_others_place(tmp_path: Path) -> None:
    where: Campaign = campaign(tmp_path / "s")
    for number in range(3):
        where.add_bench_record({"number": number})
    (where.folder / "bench" / "0001.json").unlink()
    where.add_bench_record({"number": 3})
    assert sorted(path.name for path in (where.folder / "bench").iterdir()) == [
        "0002.json",
        "0003.json",
        "0004.json",
    ]
