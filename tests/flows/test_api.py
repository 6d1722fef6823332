"""`import sliplab`: what it gives is what the store holds, and what it refuses it names."""

from __future__ import annotations

import errno
import inspect
import json
import math
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

import sliplab
from sliplab.flows import api
from sliplab.flows.collecting.requests import CampaignStopped
from sliplab.flows.notebook import arguments
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.store import TrialStore
from tests.command_line import here
from tests.flows.older import older_store
from tests.patching import loose

FIRST = "depth=2.4mm,direction=0deg,speed=1.6mmps,r=1"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four labelled slides and a network; nothing here changes them."""
    return older_store(tmp_path_factory.mktemp("api") / "store")


@pytest.fixture(scope="module")
def store(folder: Path) -> sliplab.Store:
    return sliplab.open_store(folder)


def test_importing_it_loads_no_library() -> None:
    code = (
        "import sys, sliplab; "
        "heavy = {'numpy', 'pandas', 'torch', 'prefect', 'pydantic', 'cv2', 'h5py', 'typer'}; "
        "print(sorted(heavy & set(sys.modules)), sliplab.__version__)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["[]", "0.1.0"]


def test_every_name_is_there_and_others_are_not() -> None:
    assert {name for name in sliplab.__all__ if getattr(sliplab, name, None) is None} == set()
    assert dir(sliplab) == sorted(sliplab.__all__)
    assert sliplab.CampaignStopped is CampaignStopped
    with pytest.raises(AttributeError, match="has no attribute 'opne_store'"):
        loose(sliplab).opne_store  # noqa: B018


def test_the_table_has_units_and_is_filtered(store: sliplab.Store) -> None:
    assert store.campaigns == ["small"]
    table = store.trials("direction_deg >= 180")
    assert sorted(table["direction_deg"]) == [180.0, 270.0]
    assert [trial.id for trial in store] == sorted(store.trials()["trial"])
    with pytest.raises(ValueError, match="the columns are campaign, trial"):
        store.trials("depht > 1")


def test_a_trials_arrays_share_one_time_line(store: sliplab.Store, folder: Path) -> None:
    trial = store.trial(FIRST)
    stored = TrialStore.open(folder).campaign("small").recording(FIRST)
    events, poses = trial.events(), trial.poses()
    raw = stored.events()
    assert len(events) == len(events.t_ns) == stored.record.counts.events
    assert (events.t_ns == stored.clock("events").to_reference(raw.t_us * 1000)).all()
    assert (np.diff(events.t_ns) >= 0).all()
    assert set(np.unique(events.p)) == {0, 1}
    assert poses.xyz_mm.shape == poses.rotvec_deg.shape == (len(poses), 3)
    assert (np.diff(trial.pulses()) > 0).all()
    # the arm slides while frames are taken: 5 mm along x at 1.6 mm/s
    start, end = trial.step("slide")
    assert (end - start) / 1e9 == pytest.approx(5 / 1.6, abs=0.05)
    moving = (poses.t_ns >= start) & (poses.t_ns <= end)
    travelled = np.ptp(poses.xyz_mm[moving], axis=0)
    assert travelled.max() == pytest.approx(5, abs=0.05)
    times = trial.frame_times()
    assert ((times > start) & (times < end)).sum() == pytest.approx((end - start) / 1e7, abs=2)


def test_a_stretch_of_events_is_cut_from_them(store: sliplab.Store) -> None:
    trial = store.trial(FIRST)
    whole = trial.events()
    start, end = 1_000_000_000, 1_030_000_000
    part = trial.events(start, end)
    inside = (whole.t_ns >= start) & (whole.t_ns < end)
    assert 0 < len(part) < len(whole)
    for name in ("t_ns", "x", "y", "p"):
        assert (getattr(part, name) == getattr(whole, name)[inside]).all()


def test_onsets_are_those_of_the_label(store: sliplab.Store) -> None:
    trial = store.trial(FIRST)
    assert trial.simulated
    onsets = trial.onsets()
    assert (onsets.incipient_ns, onsets.gross_ns) == (651002014, 3410998537)
    times, displacement = trial.displacements()
    assert displacement.shape == (len(times), 19)
    # 2 px is slip: the first frame in which any marker is that far is the onset's
    slipped = (displacement > 2).any(axis=1)
    assert times[slipped.argmax()] == onsets.incipient_ns


def test_a_network_counts_as_the_evaluation_did(store: sliplab.Store, folder: Path) -> None:
    (path,) = store.models()
    model = sliplab.load_model(path)
    kept = Derived.of(TrialStore.open(folder), "counts", "small")
    judged = [trial for trial in store if kept.key(trial.id) is not None]
    assert judged
    for trial in judged:
        found, before = model.counts(trial), kept.arrays(trial.id)
        assert (found.counts == before["counts"]).all()
        assert (found.end_ns == before["end_ns"]).all()
        # clocks differ by microseconds, so an event may fall into the window beside
        again = model.counts_of(trial.events(), found.end_ns - 30_000_000)
        assert again.shape == found.counts.shape
        assert np.abs(again - found.counts).sum() <= 0.01 * found.counts.sum()
    events = judged[0].events()
    backwards = sliplab.Events(events.t_ns[::-1], events.x, events.y, events.p)
    with pytest.raises(ValueError, match="not sorted"):
        model.counts_of(backwards, np.array([0]))


def test_a_step_runs_what_is_missing_only(folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder, tmp_path / "store")
    mine = sliplab.open_store(tmp_path / "store")
    assert mine.label()["done"] == 0
    shutil.rmtree(mine.folder / "derived" / "labels")
    with pytest.raises(sliplab.StoreError, match="has no label yet"):
        mine.trial(FIRST).onsets()
    with pytest.raises(sliplab.StoreError, match="has no label yet"):
        mine.trial(FIRST).displacements()
    assert mine.label(["small"])["done"] == 4
    assert mine.summary()["simulated"] is True


def test_what_is_not_there_is_named(store: sliplab.Store, tmp_path: Path) -> None:
    with pytest.raises(sliplab.StoreError, match="nothing: is no committed trial of"):
        store.trial("nothing")
    with pytest.raises(sliplab.StoreError, match="has no video; its camera provided tracks"):
        store.trial(FIRST).frame(0)
    with pytest.raises(sliplab.StoreError, match="is not a store"):
        sliplab.open_store(tmp_path)
    with pytest.raises(sliplab.InputError, match="no built-in protocol"):
        sliplab.plan("nothing")
    with pytest.raises(sliplab.InputError, match="trials = 0: must be greater"):
        sliplab.collect("pilot", "rehearsal", tmp_path / "new", trials=0)
    assert not (tmp_path / "new").exists()


def public_functions() -> dict[str, Any]:
    """Every public function and method of the interface."""
    found = {name: getattr(api, name) for name in api.__all__}
    kinds = (api.Store, api.Trial, api.Model)
    methods = {f"{kind.__name__}.{name}": it for kind in kinds for name, it in vars(kind).items()}
    return {
        name: it
        for name, it in {**found, **methods}.items()
        if inspect.isfunction(it) and "._" not in name
    }


@pytest.mark.parametrize("name", public_functions())
def test_every_argument_of_a_wrong_type_is_named(name: str) -> None:
    function = public_functions()[name]
    assert hasattr(function, "__wrapped__")
    for key, parameter in inspect.signature(function).parameters.items():
        if key == "self" or parameter.kind is parameter.VAR_KEYWORD:
            continue
        with pytest.raises(sliplab.InputError, match=f"^{key} = .*: must be "):
            arguments._checked(key, object(), parameter.annotation)


def test_wrong_arguments_are_named_with_what_is_right(store: sliplab.Store, tmp_path: Path) -> None:
    trial, model = store.trial(FIRST), sliplab.load_model(store.models()[0])
    record = trial.recording.record.model_copy(update={"steps": ()})
    still = sliplab.Trial(
        store._store, "small", SimpleNamespace(record=record, folder=trial.recording.folder)
    )
    empty = sliplab.Store(TrialStore.create(tmp_path / "empty"))
    for call, words in {
        lambda: loose(sliplab).open_store(None): "place: must be text or a path",
        lambda: sliplab.load_model(tmp_path / "none.pt"): "none.pt: cannot be read: No such file",
        lambda: loose(sliplab).plan("pilot", enable=[1]): "enable = [1]: must be a list of names",
        lambda: sliplab.collect("pilot", "rehearsal", tmp_path, temperature=math.nan): (
            "temperature = .nan: must be a finite number or None"
        ),
        lambda: sliplab.collect("pilot", "rehearsal", tmp_path, trials=0, humidity=200): (
            "humidity = 200: must be less than or equal to 100"
        ),
        lambda: loose(sliplab).check("pilot"): (
            "check(): missing a required argument: 'rig'; its arguments are protocol, rig, store"
        ),
        lambda: store.evaluate(margin=-1): "margin = -1: must be greater than or equal to 0",
        lambda: loose(store).evaluate(
            colour=1
        ): "evaluate(): got an unexpected keyword argument 'colour'",
        lambda: store.note(" "): "text = '': must not be empty",
        lambda: store.trials("depth_mm"): "where = depth_mm: cannot be read",
        lambda: store.report(against="none"): "--against = none: must be a store with a report",
        lambda: loose(trial).events(0.5): "start_ns = 0.5: must be a whole number or None",
        lambda: trial.events(-(10**30)): f"start_ns = {-(10**30)}: must fit 64 bits",
        lambda: trial.events(0, 10**30): f"end_ns = {10**30}: must fit 64 bits",
        lambda: trial.step("slid"): "phase = slid: must be one of approach,",
        lambda: still.step("slide"): "phase = slide: is not there: there is none",
        lambda: loose(model).counts_of(
            trial.events(), 0
        ): "start_ns: must be an array of shape (n,)",
        lambda: loose(model).counts_of(trial.events(), [[0]]): "not (1, 1)",
        lambda: store.export("labels", tmp_path / "a.csv", "small", campaign="again"): (
            "--campaign = again: is no campaign of"
        ),
        lambda: empty.export("labels", tmp_path / "a.csv", "pilot"): "campaigns: none; ",
    }.items():
        with pytest.raises(sliplab.InputError) as caught:
            call()
        assert words in str(caught.value)
    assert list(store.windows("test", "small")["campaign"].unique()) == ["small"]


def test_a_plan_as_a_table(store: sliplab.Store) -> None:
    plan = sliplab.plan("pilot")
    assert repr(plan) == "<Plan pilot: 36 trials, 0.18 h of motion>"
    table = plan.table()
    assert list(table["trial"]) == [trial.id for trial in plan]
    assert sorted(table["depth_mm"].unique()) == [2.4, 2.8, 3.4]
    assert table["motion_s"].sum() == pytest.approx(plan.total_seconds)


def test_checks_and_exchanges_are_those_of_the_commands(
    store: sliplab.Store, folder: Path, tmp_path: Path
) -> None:
    found = store.verify()
    assert (found["ok"], found["trials"], found["problems"]) == (True, 4, [])
    said = here("verify", folder, "--json")
    assert json.loads(said.stdout) == found == sliplab.verify(folder)
    with pytest.raises(sliplab.InputError, match="is not a store"):
        sliplab.verify(tmp_path)
    done = store.export("labels", tmp_path / "labels.csv", "small")
    assert done == {"labels": 4, "output": str(tmp_path / "labels.csv")}
    with pytest.raises(sliplab.InputError, match="PART: is needed"):
        store.export("dsec", tmp_path / "out")
    with pytest.raises(sliplab.InputError, match="--colour: does not belong to --as labels; no"):
        store.export("labels", tmp_path / "labels.csv", "small", colour=1)
    store.export("dsec", tmp_path / "dsec", FIRST)
    new = tmp_path / "new"
    made = sliplab.import_data(tmp_path / "dsec", new, name="copy", simulated=True)
    assert len(made["imported"]) == 1
    (copy,) = sliplab.open_store(new)
    assert len(copy.events()) == len(store.trial(FIRST).events())
    with pytest.raises(sliplab.InputError, match="--name: is missing"):
        sliplab.import_data(tmp_path / "dsec", new)
    with pytest.raises(sliplab.InputError, match="--dry-run: is for an import with --adapter"):
        sliplab.import_data(tmp_path / "dsec", new, dry_run=True)


def test_check_says_whether_a_protocol_can_be_collected(tmp_path: Path) -> None:
    found = sliplab.check("pilot", rig="rehearsal", store=tmp_path / "new")
    assert found["passed"] == all(item.passed for item in found["checks"])
    assert "protocol and limits" in {item.name for item in found["checks"]}
    assert not (tmp_path / "new").exists()


def test_windows_are_items_of_torch_and_of_tonic(store: sliplab.Store) -> None:
    from torch.utils.data import DataLoader

    windows = store.windows("train")
    chosen = windows[windows["label"].notna()]
    pixels, events = store.torch_dataset(), store.tonic_dataset()
    assert len(pixels) == len(events) == len(chosen)
    x, y = next(iter(DataLoader(pixels, batch_size=4)))
    assert x.shape == (4, 30, 1, 20, 20)
    classes = ["no_slip", "incipient", "gross"]
    assert [classes[k] for k in y] == chosen["label"].head(4).tolist()
    assert events.sensor_size == (640, 480, 2)
    found, label = events[1]
    assert found.dtype.names == events.ordering == ("x", "y", "t", "p")
    assert ((found["t"] >= 0) & (found["t"] <= 30_000)).all()
    assert label == pixels[1][1]
    whole = store.tonic_dataset(transform=len, target_transform=str)
    assert whole[1] == (len(found), str(label))
    # rows in any order, and those without a class
    mixed = windows.sample(20, random_state=0)
    again = store.torch_dataset(windows=mixed)
    one = store.torch_dataset(windows=mixed.iloc[7:8])
    assert torch.equal(again[7][0], one[0][0])
    unlabelled = windows[windows["label"].isna()].head(1)
    assert store.torch_dataset(windows=unlabelled)[0][1] == -1
    with pytest.raises(sliplab.InputError, match="windows: start_ns: is missing"):
        store.torch_dataset(windows=windows.drop(columns="start_ns"))
    few = windows.head(4)
    right = int(few["start_ns"].iloc[2]) + 30_000_000
    for wrong_end, count in ((right + 1, 1), (None, 1), (few["start_ns"], 4)):
        wrong = few.copy()
        wrong.loc[few.index[2] if count == 1 else few.index, "end_ns"] = wrong_end
        row = 2 if count == 1 else 0
        first = int(few["start_ns"].iloc[row]) + 30_000_000
        for dataset in (store.torch_dataset, store.tonic_dataset):
            with pytest.raises(sliplab.InputError) as caught:
                dataset(windows=wrong)
            assert f"windows: end_ns[{row}] = " in str(caught.value)
            assert f"must be {first}: windows of the store have 30 ms" in str(caught.value)
    assert len(store.torch_dataset(windows=few.drop(columns="end_ns"))) == 4
    wrong = few.assign(start_ns=[math.nan, 0.5, 1e30, 1 << 60], label=[None, "slip", None, None])
    wrong["trial"] = ["nobody", *wrong["trial"][1:]]
    for dataset in (store.torch_dataset, store.tonic_dataset):
        with pytest.raises(sliplab.InputError) as caught:
            dataset(windows=wrong)
        for words in (
            "windows: start_ns[0] = .nan: must be whole nanoseconds; not so in 3 rows",
            "windows: label[1] = slip: must be one of no_slip, incipient, gross, None",
            "windows: trial[0] = nobody: is no committed trial",
            f"windows: start_ns[3] = {1 << 60}: lies outside of the recording of",
        ):
            assert words in str(caught.value)


def test_a_trial_is_described_for_xarray(store: sliplab.Store) -> None:
    trial = store.trial(FIRST)
    found = trial.to_dict()
    sizes: dict[str, int] = {}
    for part in (*found["coords"].values(), *found["data_vars"].values()):
        assert len(part["dims"]) == part["data"].ndim
        for name, size in zip(part["dims"], part["data"].shape, strict=True):
            assert sizes.setdefault(name, size) == size
    assert sizes["events"] == len(trial.events())
    assert (found["data_vars"]["poses_xyz_mm"]["data"] == trial.poses().xyz_mm).all()
    assert found["attrs"]["simulated"] is True
    assert found["attrs"]["gross_ns"] == trial.onsets().gross_ns


def test_a_trial_is_a_data_set_of_xarray(store: sliplab.Store) -> None:
    pytest.importorskip("xarray")
    data = store.trial(FIRST).to_xarray()
    assert data.sizes["markers"] == len(data["markers_t_ns"])


def test_missing_xarray_names_its_extra(
    store: sliplab.Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'sliplab\[xarray\]'"):
        store.trial(FIRST).to_xarray()


def test_a_notebook_shows_tables_and_figures(store: sliplab.Store) -> None:
    plan, trial, model = (
        sliplab.plan("pilot"),
        store.trial(FIRST),
        sliplab.load_model(store.models()[0]),
    )
    assert isinstance(plan, sliplab.Plan)
    for shown, words in (
        (plan, ("36 trials", "depth_mm")),
        (store, ("small", "<td>4</td>")),
        (trial, ("simulated", "2.4 mm", "gross_ns")),
        (model, ("no slip", "simulated", "30 ms")),
    ):
        html = shown._repr_html_()
        assert all(word in html for word in words), html
        svg = shown.plot()._repr_svg_()
        assert svg.startswith("<svg")
        assert ("simulated" in svg) == (shown is not plan)


def test_the_own_network_comes_first_and_is_named(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "models").mkdir()
    shutil.copy(folder / "store.json", tmp_path)
    for name in ("paper-seed0", "seed10", "seed2", "seed0"):
        shutil.copy(folder / "models" / "seed0.pt", tmp_path / "models" / f"{name}.pt")
    paths = sliplab.open_store(tmp_path).models()
    assert [path.stem for path in paths] == ["seed0", "seed2", "seed10", "paper-seed0"]
    assert repr(sliplab.load_model(paths[-1])).startswith("<Model paper-seed0.pt of no slip,")


def test_a_disk_that_refuses_is_an_error_of_the_store(
    store: sliplab.Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(errno.EROFS, "read-only", "/store/report")

    monkeypatch.setattr(api.Store, "_run", refuse)
    with pytest.raises(sliplab.StoreError, match=r"^/store/report: its disk is read-only: fix"):
        store.report()


def test_scores_name_the_extra_that_is_missing(
    store: sliplab.Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(ModuleNotFoundError, match="parquet"):
        store.scores()
