"""Entries are written into rig files: whole or not at all, comments kept, the old file beside."""

from __future__ import annotations

from datetime import date
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sliplab.protocols import InputError
from sliplab.protocols.yaml_file import parse_yaml
from sliplab.rigs import rig_edit
from sliplab.rigs.rig_edit import edited, writable_target, write_entries
from sliplab.rigs.rig_file import load_rig_file
from sliplab.rigs.rig_inheritance import shipped_rigs
from sliplab.storage.trials.store import TrialStore
from tests.conftest import ROOT
from tests.rigs.core.test_calibration import WHOLE

MOCK = (ROOT / "rigs" / "mock.yaml").read_text()
DAY = date(2026, 12, 1)
PLANE = {**WHOLE["contact_plane"], "taught": DAY}


def mine(folder: Path, text: str = MOCK) -> Path:
    path = folder / "lab.yaml"
    path.write_text(text)
    return path


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A rig file of its own."""
    return mine(tmp_path)


@pytest.mark.parametrize("name", shipped_rigs())
def test_nothing_changed_is_nothing_changed(name: str) -> None:
    text = shipped_rigs()[name].read_text()
    assert edited(text, {}) == text


@given(st.floats(-500.0, 500.0), st.floats(0.0, 9.0))
def test_what_is_written_is_what_is_read(x: float, residual: float) -> None:
    changes = {
        "calibration.contact_plane.centre": [f"{x:.4f} mm", "0 mm", "1 mm"],
        "calibration.lens": {"distortion": [x / 1e6, -x], "residual": f"{residual:.4f} mm"},
    }
    data = parse_yaml(edited(MOCK, changes), "test")["calibration"]
    assert data["contact_plane"]["centre"][0] == f"{x:.4f} mm"
    assert [float(v) for v in data["lens"]["distortion"]] == [round(x / 1e6, 6), round(-x, 6)]


def test_only_the_entry_changes(path: Path, tmp_path: Path) -> None:
    written = write_entries(path, path, {"calibration.contact_plane": PLANE}, today=DAY)
    before, after = MOCK.splitlines(), path.read_text().splitlines()
    assert [line for line in before if line not in after] == before[10:14]
    comments = [line.split("#", 1)[1] for line in before if "#" in line]
    assert comments == [line.split("#", 1)[1] for line in after if "#" in line]
    plane = load_rig_file(path)[0].calibration.contact_plane
    assert (plane.taught, plane.residual, plane.method) == (DAY, 0.02, "touches")
    assert written.retained == tmp_path / "lab.before-2026-12-01.yaml"
    assert written.retained.read_text() == MOCK
    again = write_entries(path, path, {}, today=DAY)
    assert again.retained.name == "lab.before-2026-12-01-2.yaml"


def test_a_result_that_is_no_rig_file_is_not_written(path: Path, tmp_path: Path) -> None:
    line = {**PLANE, "above": ["400 mm", "24 mm", "300.1 mm"]}
    with pytest.raises(InputError, match="almost on one line") as caught:
        write_entries(path, path, {"calibration.contact_plane": line}, today=DAY)
    assert caught.value.key == "calibration.contact_plane"
    assert path.read_text() == MOCK
    assert [p.name for p in tmp_path.iterdir()] == ["lab.yaml"]


def test_a_disk_that_fails_leaves_the_old_file(path: Path, monkeypatch: Any) -> None:
    write = rig_edit.write_text

    def fails(target: Path, text: str) -> None:
        if target == path:
            raise OSError(28, "No space left on device")
        write(target, text)

    monkeypatch.setattr(rig_edit, "write_text", fails)
    with pytest.raises(OSError, match="No space"):
        write_entries(path, path, {"calibration.contact_plane": PLANE}, today=DAY)
    assert path.read_text() == MOCK


def test_a_file_that_somebody_else_changed_meanwhile_is_kept(path: Path) -> None:
    _, read = load_rig_file(path)
    path.write_text(MOCK.replace("poll: 200 ms", "poll: 100 ms"))
    with pytest.raises(InputError, match="was changed while measuring"):
        write_entries(path, path, {}, today=DAY, expected=read)


def test_shipped_files_are_never_written_to(tmp_path: Path) -> None:
    for path in shipped_rigs().values():
        with pytest.raises(InputError, match="never overwritten"):
            writable_target(path, None)
        with pytest.raises(InputError, match="never overwritten"):
            writable_target(mine(tmp_path), path)
        assert writable_target(path, tmp_path / "new.yaml") == tmp_path / "new.yaml"


def test_targets_that_cannot_be(path: Path, tmp_path: Path) -> None:
    (tmp_path / "other.yaml").write_text("")
    (store := TrialStore.create(tmp_path / "s").folder / "campaigns").mkdir(exist_ok=True)
    for out, says in (
        (tmp_path / "other.yaml", "exists: give it as --rig"),
        (tmp_path / "new.txt", "must end in .yaml"),
        (store / "new.yaml", "belongs to the store"),
        (tmp_path / "nowhere" / "new.yaml", "folder does not exist"),
    ):
        with pytest.raises(InputError, match=says):
            writable_target(path, out)
    assert writable_target(path, path) == path


def test_a_link_stays_a_link(path: Path, tmp_path: Path) -> None:
    link = tmp_path / "current.yaml"
    link.symlink_to(path)
    write_entries(link, writable_target(link, None), {"sensor": "other"}, today=DAY)
    assert link.is_symlink()
    assert "sensor: other" in path.read_text()


def extending(folder: Path, own: dict[str, Any] | str) -> Path:
    mine(folder)
    path = folder / "child.yaml"
    path.write_text(f"# mine\nextends: lab.yaml\nname: child\n{own}")
    return path


def test_an_extending_file_gets_the_entry_and_its_parent_does_not(tmp_path: Path) -> None:
    path = extending(tmp_path, "")
    write_entries(path, path, {"calibration.contact_plane": PLANE}, today=DAY)
    assert path.read_text().startswith("# mine\nextends: lab.yaml\n")
    assert (tmp_path / "lab.yaml").read_text() == MOCK
    found = load_rig_file(path)[0].calibration
    assert found.contact_plane.taught == DAY
    assert found.touch_depth == 0.34


def test_elsewhere_an_extending_file_is_written_merged(tmp_path: Path) -> None:
    path = extending(tmp_path, "")
    (tmp_path / "there").mkdir()
    target = tmp_path / "there" / "new.yaml"
    written = write_entries(path, target, {"calibration.contact_plane": PLANE}, today=DAY)
    assert written.retained is None
    assert "extends" not in parse_yaml(target.read_text(), target)
    assert load_rig_file(target)[0].name == "child"


def test_what_is_removed_is_gone_even_where_a_parent_has_it(tmp_path: Path) -> None:
    path = extending(tmp_path, "")
    key = "calibration.depth_zero"
    zero = {**WHOLE["depth_zero"], "taught": DAY}
    write_entries(tmp_path / "lab.yaml", tmp_path / "lab.yaml", {key: zero}, today=DAY)
    assert load_rig_file(path)[0].calibration.zero_mm == 0.01
    write_entries(path, path, {}, today=DAY, remove=[key])
    assert load_rig_file(path)[0].calibration.depth_zero is None
    lab = tmp_path / "lab.yaml"
    write_entries(lab, lab, {}, today=DAY, remove=[key, "calibration.nothing"])
    assert "depth_zero" not in lab.read_text()
