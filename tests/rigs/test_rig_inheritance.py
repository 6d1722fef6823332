"""Rig files that build on others: merged deeply, blamed on the right file, whole in the store."""

from pathlib import Path

import pytest

from sliplab.plugins.simulation.settings import scene_of
from sliplab.protocols import InputError, load_plan
from sliplab.rigs.rig_file import load_rig_file, rig_hash
from sliplab.rigs.rig_inheritance import read_rig, rig_path, shipped_rigs
from tests.conftest import ROOT
from tests.protocols.planning import rows

MOCK = (ROOT / "rigs" / "mock.yaml").read_text()


@pytest.fixture
def base(tmp_path: Path) -> Path:
    """A folder with a copy of the mock rig."""
    (tmp_path / "mock.yaml").write_text(MOCK)
    return tmp_path


def child(base: Path, text: str, name: str = "child.yaml") -> Path:
    """A rig file beside the mock rig."""
    path = base / name
    path.write_text(text)
    return path


def test_keys_are_merged_deeply_and_lists_replaced(base: Path) -> None:
    path = child(
        base,
        "extends: mock.yaml\nname: other\n"
        "calibration: {contact_plane: {centre: [401.5 mm, 0 mm, 300 mm]}}\n"
        "mock: {scene: {friction: {kinetic: 0.7}}}\n",
    )
    rig, _ = load_rig_file(path)
    known, _ = load_rig_file(base / "mock.yaml")
    assert rig.name == "other"
    assert rig.calibration.contact_plane.centre == (401.5, 0.0, 300.0)
    assert rig.calibration.contact_plane.right == known.calibration.contact_plane.right
    assert rig.mock.scene.friction.kinetic == 0.7
    assert rig.mock.seed == known.mock.seed
    assert rig.limits == known.limits


def test_the_text_stands_alone_and_reads_the_same(base: Path, tmp_path: Path) -> None:
    path = child(base, "extends: mock.yaml\nmock: {event_camera: {noise_hz: 0.10}}\n")
    rig, text = load_rig_file(path)
    alone = tmp_path / "elsewhere"
    alone.mkdir()
    (alone / "rig.yaml").write_text(text)
    again, same = load_rig_file(alone / "rig.yaml")
    assert again == rig
    assert same == text
    assert "extends" not in text.replace("Merged", "")
    assert rig_hash(same) == rig_hash(text)


def test_the_hash_follows_what_is_extended(base: Path) -> None:
    path = child(base, "extends: mock.yaml\nname: other\n")
    before = rig_hash(load_rig_file(path)[1])
    assert rig_hash(load_rig_file(path)[1]) == before
    (base / "mock.yaml").write_text(MOCK.replace("depth: 4 mm", "depth: 3.9 mm"))
    assert rig_hash(load_rig_file(path)[1]) != before


def test_a_name_alone_is_a_rig_that_ships_unless_a_file_has_it(base: Path) -> None:
    rig, _ = load_rig_file(child(base, "extends: rehearsal\nname: mine\n"))
    assert (rig.name, rig.frame_source) == ("mine", "tracks")
    (base / "rehearsal").write_text((base / "mock.yaml").read_text())
    rig, _ = load_rig_file(child(base, "extends: rehearsal\nname: mine\n"))
    assert rig.frame_source == "video"


def test_a_copy_of_a_shipped_rig_extends_what_that_extends(tmp_path: Path) -> None:
    shipped = (ROOT / "rigs" / "mock_frames.yaml").read_text()
    assert "extends: mock.yaml" in shipped
    rig, _ = load_rig_file(child(tmp_path, shipped))
    assert rig.driver == "mock"
    # also where the copy has the name of what it extends
    rig, _ = load_rig_file(child(tmp_path, "extends: mock.yaml\nname: own\n", "mock.yaml"))
    assert rig.name == "own"


def test_a_file_that_extends_nothing_keeps_its_own_text(base: Path) -> None:
    assert load_rig_file(base / "mock.yaml")[1] == MOCK


def test_files_may_extend_files_that_extend(base: Path) -> None:
    child(
        base, "extends: mock.yaml\nname: one\nmock: {seed: 5, arm: {latency_us: 7}}\n", "one.yaml"
    )
    (base / "sub").mkdir()
    rig, text = load_rig_file(child(base / "sub", "extends: ../one.yaml\nmock: {seed: 6}\n"))
    assert (rig.name, rig.mock.seed, rig.mock.arm.latency_us) == ("one", 6, 7)
    assert text.startswith("# Merged: child.yaml on one.yaml on mock.yaml\n")


NOISE, SPEED = "mock.event_camera.noise_hz", "limits: {depth: 4 mm, speed: 5 kg, reach: 15 mm}"
FAULTS = f"""
    mock: {{event_camera: {{noise_hz: -1}}}} | | child.yaml | {NOISE} | greater than or equal to 0
    mock: {{arm: {{latency_us: 5}}}} | mock: {{seed: 1, event_camera: {{noise_hz: -1}}}} \
| mock.yaml | {NOISE} | greater than or equal to 0
    limits: {{depht: 3 mm}} | | child.yaml | limits.depht | did you mean 'depth'
    limits: {{depth: 3 mm}} | {SPEED} | mock.yaml | limits.speed | mm/s
    frame_camera: {{scale_px_per_mm: 12}} | | child.yaml | frame_camera.scale_px_per_mm \
| must be mock.frame_camera.px_per_mm = 20
    limits: {{depth: 0.2 mm}} | | child.yaml | limits.depth | limits.depth = 0.2 mm: contradicts
    timing: {{sync_box: {{drift_ppm: 5}}}} | | child.yaml | timing.sync_box.drift_ppm \
| mock.yaml: mock.clocks.sync_box_ppm = 10.0: must be at most timing.sync_box.drift_ppm = 5
    mock: {{clocks: {{read_longest_us: 1}}}} | mock: {{seed: 1, clocks: {{read_shortest_us: 9}}}} \
| child.yaml | mock.clocks.read_longest_us | must be at least read_shortest_us = 9
    calibration: {{contact_plane: {{centre: [a, 0 mm, 0 mm]}}}} | | child.yaml \
| calibration.contact_plane.centre[0] | number with a unit
"""


@pytest.mark.parametrize(("own", "inherited", "file", "key", "says"), rows(FAULTS))
def test_a_fault_is_blamed_on_the_file_that_has_it(
    own: str, inherited: str, file: str, key: str, says: str, base: Path
) -> None:
    path = child(base, f"extends: mock.yaml\n{own}\n")
    if inherited:
        word = inherited.partition(":")[0]
        lines = MOCK.splitlines()
        at = next(i for i, line in enumerate(lines) if line.startswith(f"{word}:"))
        rest = at + 1
        while rest < len(lines) and lines[rest].startswith("  "):
            rest += 1
        (base / "mock.yaml").write_text("\n".join([*lines[:at], inherited, *lines[rest:]]) + "\n")
    with pytest.raises(InputError) as caught:
        load_rig_file(path)
    assert caught.value.file == str(base / file)
    assert caught.value.key == key
    assert says in caught.value.message


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("extends: none.yaml\n", "extends = none.yaml: no such file"),
        ("extends: mock_wek.yaml\n", "did you mean 'mock_weak'?"),
        ("extends: child.yaml\n", "extends = child.yaml: is circular"),
        ("extends: [mock.yaml]\n", "must be the path of a rig file"),
        ('extends: "a\\0b"\n', "must be the path of a rig file"),
        ("extends: /dev/zero\n", "is not a regular file"),
        ("extends: loop.yaml\n", "extends = child.yaml: is circular"),
    ],
)
def test_what_cannot_be_extended_is_said(text: str, says: str, base: Path) -> None:
    child(base, "extends: child.yaml\n", "loop.yaml")
    with pytest.raises(InputError) as caught:
        load_rig_file(child(base, text))
    assert says in caught.value.message


def test_shipped_rigs_are_found_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mock").mkdir()
    for name in ("loopback", "mock", "mock_noisy", "mock-noisy", "mock-quiet", "rehearsal"):
        assert rig_path(Path(name)) == shipped_rigs()[name.replace("-", "_")]
    assert rig_path(Path("mock.yaml")) == Path("mock.yaml")
    assert rig_path(Path("some/mock")) == Path("some/mock")
    (tmp_path / "mine").write_text(MOCK)
    assert load_rig_file(Path("mine"))[0].name == "mock"
    says = r"rehersal: .* shipped rigs: irb120, loopback, loopback_gripper, mock, mock_events, "
    with pytest.raises(InputError, match=says):
        rig_path(Path("rehersal"))


def test_what_ships_is_the_mock_rig_but_for_one_thing_each() -> None:
    mock, noisy, weak, rehearsal = (
        load_rig_file(Path(name))[0] for name in ("mock", "mock-noisy", "mock-weak", "rehearsal")
    )
    timing = weak.timing
    assert (timing.code, timing.frames) == ("irregular", "device time stamps")
    assert timing.arm == "host time"
    assert weak.model_copy(update={"name": "mock", "timing": mock.timing}) == mock
    assert noisy.mock.event_camera.noise_hz == pytest.approx(10 * mock.mock.event_camera.noise_hz)
    same = noisy.mock.event_camera.model_copy(update={"noise_hz": 0.01})
    assert noisy.mock.model_copy(update={"event_camera": same}) == mock.mock
    assert (mock.frame_source, rehearsal.frame_source) == ("video", "tracks")
    video = rehearsal.mock.frame_camera.model_copy(update={"level": "video"})
    assert rehearsal.mock.model_copy(update={"frame_camera": video}) == mock.mock


def test_regions_in_pixels() -> None:
    rig, _ = load_rig_file(Path("mock"))
    sides = {"kinematic": 832, "gravity": 832, "disturbance": 832}
    for name, side in (sides | {"pilot": 720, "pilot_gravity": 832}).items():
        assert rig.frame_px(load_plan(Path(name))) == (side, side), name


def test_bytes_of_a_frame_know_the_level_and_the_plate() -> None:
    mock, rehearsal = (load_rig_file(Path(name))[0] for name in ("mock", "rehearsal"))
    known = mock.estimates
    assert mock.frame_bytes(False) == known.bytes_per_frame
    assert mock.frame_bytes(True) == known.bytes_per_plate_frame
    for plate in (False, True):
        assert rehearsal.frame_bytes(plate) == known.bytes_per_tracked_frame
    # 19 markers of two floats of 4 bytes, and times
    assert 50 < known.bytes_per_tracked_frame < 19 * 8 + 50


def test_what_was_read_keeps_every_file_apart(base: Path) -> None:
    path = child(base, "extends: mock.yaml\nmock: {seed: 3}\n")
    found = read_rig(path)
    assert [file.name for file, _ in found.parts] == ["child.yaml", "mock.yaml"]
    assert found.blame("mock.seed").name == "child.yaml"
    assert found.blame("limits.depth").name == "mock.yaml"
    assert found.blame("nothing.like.it").name == "child.yaml"


def test_a_device_with_another_driver_takes_the_place_of_the_one_below(tmp_path: Path) -> None:
    arm = "{driver: abb, host: 10.0.0.2, limits: {low_mm: [-1, -1, -1], high_mm: [1, 1, 1]}}"
    path = tmp_path / "mine.yaml"
    path.write_text(f"extends: {shipped_rigs()['ur5']}\nname: mine\ndevices: {{arm: {arm}}}\n")
    devices = load_rig_file(path)[0].devices
    assert (devices.arm.driver, devices.arm.host) == ("abb", "10.0.0.2")
    assert devices.frame_camera.trigger_line == "Line1"


@pytest.mark.parametrize("name", ["ur5", "irb120"])
def test_rig_files_to_copy_are_whole(name: str) -> None:
    rig, _ = load_rig_file(Path(name))
    assert not rig.simulated
    assert not rig.has_plate
    assert rig.frame_source == "video"
    with pytest.raises(ValueError, match="is real"):
        _ = scene_of(rig)
