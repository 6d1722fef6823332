"""Training learns, repeats to the bit, says what is wrong, and its files survive."""

from __future__ import annotations

import pickle
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from sliplab.analysis.detectors.network_detector import counting_of
from sliplab.analysis.metrics import classification as metrics
from sliplab.analysis.networks import model_file, training
from sliplab.analysis.networks.model_file import FORMAT, load, save
from sliplab.analysis.networks.network import (
    GRID,
    WEIGHTED,
    build,
    exact,
    matrices,
    spike_counts,
    weights,
)
from sliplab.analysis.networks.training import (
    EpochRecord,
    Fitted,
    fit,
    learning_rate,
    predict_counts,
    restore,
)
from sliplab.protocols.errors import InputError
from sliplab.protocols.network_settings import NetworkSettings
from sliplab.protocols.training import Training
from sliplab.protocols.windows import Windows

pytestmark = pytest.mark.usefixtures("one_thread")

NETWORK = NetworkSettings(conv1_channels=4, conv2_channels=4, hidden=12)
WINDOWS = Windows(length_ms=12, crop_px=160)  # (12, 1, 8, 8)
TRAINING = Training(
    epochs=6, batch=16, learning_rate=1e-2, patience=6, schedule="constant", gain=1.0, mirror=False
)


def windows_like(n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Three regimes in the manner of the real ones: noise, moving edges of discs, local bursts.

    Edges and bursts have as many events, so the rate alone cannot tell them apart.
    """
    rng = np.random.default_rng(seed)
    x = rng.poisson(0.02, (n, 12, 1, 8, 8)).astype(np.uint8)
    y = np.arange(n) % 3
    for sample, label in zip(x[:, :, 0], y, strict=True):
        if label == metrics.INCIPIENT:  # all the while, at the right-hand edges of four discs
            rows, columns = rng.integers(0, 8, 40), rng.choice([3, 7], 40)
            np.add.at(sample, (rng.integers(0, 12, 40), rows, columns), 1)
        elif label == metrics.GROSS:  # one place, a few milliseconds
            corner = rng.integers(0, 6, 2)
            steps = rng.integers(0, 9) + rng.integers(0, 4, 40)
            rows, columns = (corner[:, None] + rng.integers(0, 3, (2, 40))).tolist()
            np.add.at(sample, (steps, rows, columns), 1)
    return x, y


TRAIN, VAL, TEST = windows_like(150, 0), windows_like(60, 1), windows_like(90, 2)


def same(one: Fitted, other: Fitted) -> bool:
    """Return whether two networks have the same bits and the same history."""
    return one.history == other.history and all(
        torch.equal(one.state_dict[name], value) for name, value in other.state_dict.items()
    )


def run(seed: int = 0, **changes: object) -> Fitted:
    settings = TRAINING.model_copy(update=changes)
    return fit(*TRAIN, *VAL, NETWORK, WINDOWS, settings, seed)


@pytest.fixture(scope="module")
def fitted() -> Fitted:
    return run()


def test_a_network_without_biases_learns_and_has_none(tmp_path: Path) -> None:
    network = NETWORK.model_copy(update={"biases": False, "outputs_per_class": 1})
    found = fit(*windows_like(600, 3), *VAL, network, WINDOWS, TRAINING, 0)
    assert list(found.state_dict) == [f"{name}.weight" for name in WEIGHTED]
    counts = predict_counts(found, TEST[0])
    np.testing.assert_array_equal(counts, spike_counts(restore(found), TEST[0]))
    score = metrics.accuracy(counts, TEST[1])
    assert score.strict > 0.8
    # the margin in the record is the network's: two spikes for one output neuron
    record, val = found.chosen, predict_counts(found, VAL[0])
    assert record.val_margin == metrics.accuracy(val, VAL[1], 2.0).margin
    save(tmp_path / "a.pt", found)
    assert load(tmp_path / "a.pt").network == network


@pytest.mark.long
def test_every_seed_learns() -> None:
    settings = TRAINING.model_copy(update={"epochs": 10, "patience": 10})
    train = windows_like(600, 3)
    for seed in range(3):
        found = fit(*train, *VAL, NETWORK, WINDOWS, settings, seed)
        assert not found.warnings
        score = metrics.accuracy(predict_counts(found, TEST[0]), TEST[1])
        assert score.strict > 0.9, (seed, [r.val_strict for r in found.history])


def test_the_same_seed_gives_the_same_bits_and_the_same_file(
    fitted: Fitted, tmp_path: Path
) -> None:
    """Torch's global randomness is neither used nor moved."""
    torch.manual_seed(123)
    expected = torch.rand(1)
    torch.manual_seed(123)
    again = run()
    assert torch.equal(torch.rand(1), expected)
    assert same(again, fitted)
    save(tmp_path / "a.pt", fitted)
    save(tmp_path / "b.pt", again)  # its times differ and are not in the file
    assert (tmp_path / "a.pt").read_bytes() == (tmp_path / "b.pt").read_bytes()
    other = run(seed=1, epochs=1)
    assert not torch.equal(other.state_dict["fc2.weight"], fitted.state_dict["fc2.weight"])


@pytest.mark.long
@pytest.mark.parametrize("threads", [2, 5])
def test_the_number_of_threads_changes_no_bit(fitted: Fitted, threads: int) -> None:
    torch.set_num_threads(threads)
    again = run()
    assert torch.get_num_threads() == threads
    torch.set_num_threads(1)
    assert same(again, fitted)


def test_predictions_are_those_of_the_sinabs_network(fitted: Fitted) -> None:
    counts = predict_counts(fitted, TEST[0])
    assert counts.dtype == np.int64
    np.testing.assert_array_equal(counts, spike_counts(restore(fitted), TEST[0]))


def test_the_chosen_epoch_is_the_one_in_the_weights(fitted: Fitted) -> None:
    found = metrics.accuracy(predict_counts(fitted, VAL[0]), VAL[1], fitted.network.margin)
    chosen = fitted.chosen
    assert (found.argmax, found.strict, found.margin) == (
        chosen.val_argmax,
        chosen.val_strict,
        chosen.val_margin,
    )
    assert chosen.val_strict == max(r.val_strict for r in fitted.history)
    assert [r.epoch for r in fitted.history] == list(range(1, len(fitted.history) + 1))
    assert len(fitted.epoch_seconds) == len(fitted.history)


def test_patience_ends_it_and_the_callback_sees_every_epoch() -> None:
    seen: list[training.EpochRecord] = []
    # so small a step changes no weight enough to change any count
    settings = Training(epochs=50, batch=64, learning_rate=1e-12, patience=2)
    found = fit(*TRAIN, *VAL, NETWORK, WINDOWS, settings, 0, on_epoch=seen.append)
    assert len(found.history) == 3
    assert found.chosen_epoch == 1
    assert seen == list(found.history)


def test_small_batches_at_once_add_up_to_the_batch(monkeypatch: pytest.MonkeyPatch) -> None:
    """One step on a batch of 150, whole and in parts of 8 (the last is 6)."""
    one_step = {"epochs": 1, "batch": 150}
    parts = run(**one_step)
    monkeypatch.setattr("sliplab.analysis.networks.gradients.MICRO_BATCH", 150)
    whole = run(**one_step)
    assert parts.history[0].loss == pytest.approx(whole.history[0].loss, rel=1e-6)
    start = weights(build(NETWORK, WINDOWS, 0))
    for name, first in start.items():
        moved = whole.state_dict[name] - first
        assert moved.abs().max() > 0
        # Adam's first step is the sign of the gradient: only where that is nothing may they differ
        differs = (parts.state_dict[name] - whole.state_dict[name]).abs() > 1e-5
        assert differs.float().mean() < 0.01


@pytest.mark.quick(2)
@pytest.mark.parametrize("stop", [1, 3])
@pytest.mark.parametrize("schedule", ["constant", "cosine"])
def test_a_training_goes_on_to_the_same_bits(stop: int, schedule: str) -> None:
    """Killed after any epoch, it ends with the weights and records of an undisturbed one."""
    states: list[bytes] = []
    mirror = schedule == "cosine"
    changes = {"epochs": 4, "schedule": schedule, "mirror": mirror}
    settings = TRAINING.model_copy(update=changes)
    rest = (*TRAIN, *VAL, NETWORK, WINDOWS, settings, 0)
    whole = fit(*rest, on_state=states.append)
    reported: list[training.EpochRecord] = []
    again = fit(*rest, on_epoch=reported.append, state=states[stop - 1])
    assert same(again, whole)
    assert (tuple(reported), again.chosen_epoch) == (whole.history, whole.chosen_epoch)
    assert fit(*rest, state=states[-1]).history == whole.history  # nothing was left to do


@pytest.mark.parametrize("spoilt", [b"", b"nonsense", None])
def test_a_damaged_state_is_refused(spoilt: bytes | None) -> None:
    if spoilt is None:  # whole, but of another network
        states: list[bytes] = []
        other = NetworkSettings(conv1_channels=3, conv2_channels=4, hidden=12)
        few = TRAINING.model_copy(update={"epochs": 1})
        fit(*TRAIN, *VAL, other, WINDOWS, few, 0, on_state=states.append)
        spoilt = states[0]
    with pytest.raises(ValueError, match=r"state of this training|expected"):
        fit(*TRAIN, *VAL, NETWORK, WINDOWS, TRAINING, 0, state=spoilt)


def test_an_epoch_is_chosen_by_strict_accuracy_then_argmax_then_loss() -> None:
    def record(strict: float, argmax: float, loss: float) -> EpochRecord:
        return EpochRecord(1, 0.0, 0.0, loss, argmax, strict, 0.0, {})

    silent = record(0.0, 1 / 3, 1.0986)
    worse = [silent, record(0.8, 0.9, 0.1), record(0.9, 0.91, 0.1), record(0.9, 0.92, 0.3)]
    best = record(0.9, 0.92, 0.2)
    assert all(best.merit > other.merit for other in worse)


def test_mirrored_training_knows_slides_that_it_was_not_shown(fitted: Fitted) -> None:
    """Edges stand on the right of every training window; here they stand on the left."""
    x, y = TEST[0][..., ::-1], TEST[1]
    mirrored = run(mirror=True, epochs=10, patience=10)
    plain, both = (
        metrics.accuracy(predict_counts(net, np.ascontiguousarray(x)), y).strict
        for net in (fitted, mirrored)
    )
    assert both > plain + 0.1
    assert run(mirror=True, epochs=10, patience=10).history == mirrored.history


def test_trained_weights_lie_on_the_grid(fitted: Fitted) -> None:
    values = matrices(restore(fitted))
    for value, step in zip(values, GRID, strict=True):
        assert not np.any(np.mod(value.astype(np.float64), step))
    assert exact(values)


def test_silent_layers_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    network = NETWORK.model_copy(update={"weight_scale": (1e-3, 1.0, 1.0, 1.0)})
    settings = Training(epochs=1, batch=64, learning_rate=1e-9)
    monkeypatch.setattr("sliplab.analysis.networks.network.FIRST_BIAS", (0.0, 0.0))
    monkeypatch.setattr("sliplab.analysis.networks.network.FIRST_DRIVE", 0.0)
    found = fit(*TRAIN, *VAL, network, WINDOWS, settings, 0)
    assert [w.split()[1] for w in found.warnings] == ["iaf1", "iaf2", "iaf3", "iaf4"]
    assert "silent" in found.warnings[0]
    assert found.chosen.val_strict == 0.0
    assert found.chosen.val_argmax == pytest.approx(1 / 3)
    assert found.chosen.val_loss == pytest.approx(np.log(3))


def test_a_saved_model_is_the_same_model(fitted: Fitted, tmp_path: Path) -> None:
    path = tmp_path / "model.pt"
    save(path, fitted)
    again = load(path)
    assert same(again, fitted)
    assert (again.network, again.windows, again.training) == (NETWORK, WINDOWS, TRAINING)
    for name in ("seed", "chosen_epoch", "warnings"):
        assert getattr(again, name) == getattr(fitted, name)
    np.testing.assert_array_equal(predict_counts(again, TEST[0]), predict_counts(fitted, TEST[0]))


def test_a_failed_save_leaves_the_old_file_and_no_litter(
    fitted: Fitted, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "model.pt"
    path.write_bytes(b"old")

    def fail(*_: object) -> None:
        raise OSError("no space left")

    monkeypatch.setattr("sliplab.storage.files.os.replace", fail)
    with pytest.raises(OSError, match="no space"):
        save(path, fitted)
    assert [p.name for p in tmp_path.iterdir()] == ["model.pt"]
    assert path.read_bytes() == b"old"


class Bomb:
    def __reduce__(self) -> tuple[object, tuple[str]]:
        return (eval, ("1/0",))


def damaged(path: Path, kind: str) -> None:
    """Damage a model file, or replace it."""
    good, content = path.read_bytes(), torch.load(path, weights_only=True)
    middle = len(good) // 2
    raw = {
        "empty": b"",
        "half": good[:middle],
        "one bit": good[:middle] + bytes([good[middle] ^ 1]) + good[middle + 1 :],
        "not torch": b"hello" * 100,
        "pickle": pickle.dumps(Bomb()),
    }
    saved = {
        "code": {"format": FORMAT, "state_dict": Bomb()},
        "other format": {"format": "something"},
        "other content": [1, 2],
        "key missing": {k: v for k, v in content.items() if k != "seed"},
        "wrong shape": {**content, "network": {**content["network"], "hidden": 13}},
        "wrong setting": {**content, "network": {**content["network"], "hidden": -1}},
    }
    if kind in raw:
        path.write_bytes(raw[kind])
    elif kind in saved:
        torch.save(saved[kind], path)
    else:
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("a.txt", "a")


DAMAGES = ("empty", "half", "one bit", "not torch", "pickle", "other zip", "code")
DAMAGES += ("other format", "other content", "key missing", "wrong shape", "wrong setting")


@pytest.mark.parametrize("kind", DAMAGES)
def test_a_damaged_or_foreign_file_is_refused_by_name(
    kind: str, fitted: Fitted, tmp_path: Path
) -> None:
    path = tmp_path / "model.pt"
    save(path, fitted)
    damaged(path, kind)
    with pytest.raises(ValueError, match=r"model\.pt: not a model file"):
        load(path)


def test_a_missing_file_is_missing(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        load(tmp_path / "none.pt")


def test_wrong_samples_are_named() -> None:
    (x, y), rest = TRAIN, (NETWORK, WINDOWS, TRAINING, 0)
    for wrong, said in (
        ((x.astype(float), y, *VAL), r"training samples are float64 .*; expected uint8"),
        ((x, y, x[:0], y[:0]), "0 validation samples"),
        ((x, y[1:], *VAL), "150 training samples and 149 labels"),
        ((x, y + 1, *VAL), r"expected 0\.\.2"),
        ((x[:, 1:], y, *VAL), r"expected \(n, 12, 1, \d+, \d+\)"),
    ):
        with pytest.raises(ValueError, match=said):
            fit(*wrong, *rest)


def test_samples_may_be_read_only() -> None:
    x = TRAIN[0].copy()
    x.flags.writeable = False
    assert fit(x, TRAIN[1], *VAL, NETWORK, WINDOWS, Training(epochs=1), 0).chosen_epoch == 1


def test_the_rate_falls_along_half_a_cosine() -> None:
    falling = Training(epochs=10, learning_rate=1e-2, schedule="cosine")
    rates = [learning_rate(falling, done) for done in range(10)]
    assert rates[0] == 1e-2
    assert rates[5] == pytest.approx(5e-3)
    assert 0 < rates[-1] < 3e-4
    assert rates == sorted(rates, reverse=True)
    at = np.array([learning_rate(falling, k // 7, k % 7, 7) for k in range(70)])
    ramp = np.minimum(1.0, np.arange(1, 71) / (falling.warm_up * 70))
    np.testing.assert_allclose(at, 1e-2 * ramp * np.cos(np.pi * np.arange(70) / 140) ** 2)
    flat = Training(epochs=6, learning_rate=1e-2, schedule="constant")
    assert {learning_rate(flat, done) for done in range(5)} == {flat.learning_rate}


def test_the_rate_rises_in_a_line_first() -> None:
    rising = Training(epochs=10, learning_rate=1e-2, schedule="constant", warm_up=0.15)
    rates = [learning_rate(rising, k // 100, k % 100, 100) for k in range(1000)]
    np.testing.assert_allclose(rates[:150], 1e-2 * np.arange(1, 151) / 150, rtol=1e-12)
    assert set(rates[150:]) == {1e-2}
    flat = rising.model_copy(update={"warm_up": 0.0})
    assert learning_rate(flat, 0, 0, 100) == 1e-2


RATES = {"iaf1": 0.1, "iaf2": 0.2, "iaf3": 0.1, "iaf4": 0.1}
RECORD = training.EpochRecord(1, 0.5, 0.9, 0.25, 0.9, 0.8, 0.7, RATES)


def test_a_record_of_counts() -> None:
    train = np.array([[3, 0, 0], [0, 3, 3]])
    val = np.array([[4, 0, 0], [0, 4, 0], [2, 2, 2], [0, 0, 1]])
    y, true = np.array([0, 0]), np.array([0, 1, 2, 0])
    found = training.epoch_record(2, 0.5, train, y, val, true, RATES, 0.5, 2.0)
    assert (found.epoch, found.loss, found.rates) == (2, 0.5, RATES)
    assert (found.train_argmax, found.val_strict) == (0.5, 0.5)
    assert found.val_argmax == pytest.approx((2 + 1 / 3) / 4)
    right, wrong = np.log1p(2 * np.exp(-2.0)), np.log(2 + np.exp(0.5))
    assert found.val_loss == pytest.approx((2 * right + np.log(3) + wrong) / 4)


def test_saturated_and_silent_layers_are_named() -> None:
    assert training.layer_warnings(RECORD) == ()
    found = training.layer_warnings(replace(RECORD, rates={**RATES, "iaf2": 0.95, "iaf4": 0.0}))
    said = [w.split(":")[0] for w in found]
    assert said == ["layer iaf2 is saturated", "layer iaf4 is silent"]


OBJECTS = ("cup", "spoon", "sponge", "ball", "brush")
SKIN = Windows(length_ms=20, taxels=6, polarity="both")  # (20, 12, 1, 1)


def touches(n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Five objects: each touches other taxels, and two differ in when they do."""
    rng = np.random.default_rng(seed)
    x = rng.poisson(0.05, (n, 20, 12, 1, 1)).astype(np.uint8)
    y = np.arange(n) % 5
    for sample, label in zip(x[..., 0, 0], y, strict=True):
        taxels, begin = (label, 0) if label < 4 else (3, 10)
        more = rng.poisson(0.8, (10, 2)).astype(np.uint8)
        sample[begin : begin + 10, [taxels, taxels + 6]] += more
    return x, y


def test_other_classes_are_learned_from_taxels(tmp_path: Path) -> None:
    states: list[bytes] = []
    data = (*touches(200, 0), *touches(50, 1), NETWORK, SKIN)
    settings = TRAINING.model_copy(update={"epochs": 8, "patience": 8})
    found = fit(*data, settings, 0, classes=OBJECTS, on_state=states.append)
    x, y = touches(100, 2)
    counts = predict_counts(found, x)
    assert counts.shape == (100, 5)
    np.testing.assert_array_equal(counts, spike_counts(restore(found), x))
    strict = metrics.accuracy(counts, y).strict
    assert strict > 0.6  # chance is 0.2
    again = fit(*data, settings, 0, classes=OBJECTS, state=states[2])
    assert again.history == found.history
    save(tmp_path / "a.pt", found)
    read = load(tmp_path / "a.pt")
    assert (read.classes, read.windows) == (OBJECTS, SKIN)
    np.testing.assert_array_equal(predict_counts(read, x), counts)
    with pytest.raises(ValueError, match="shape"):
        fit(*data, settings, 0, classes=(*OBJECTS, "pen"), state=states[2])


def test_models_of_slip_do_not_name_their_classes(fitted: Fitted, tmp_path: Path) -> None:
    save(tmp_path / "a.pt", fitted)
    content = torch.load(tmp_path / "a.pt", weights_only=True)
    assert "classes" not in content
    assert load(tmp_path / "a.pt").classes == metrics.CLASSES
    fitted.check_slip("a.pt", "detection")


def test_what_is_made_for_slip_refuses_other_classes(fitted: Fitted) -> None:
    other = replace(fitted, classes=OBJECTS)
    said = (
        r"tells 5 classes apart \(cup, spoon, sponge, ball \.\.\.\); .*needs one of the classes no_"
    )
    for work in (lambda: other.check_slip("a.pt", "a Speck"), lambda: counting_of(other)):
        with pytest.raises(InputError, match=said + "slip, incipient, gross"):
            work()


@pytest.mark.parametrize("classes", [(), ("cup",), ("cup", "spoon", "cup")])
def test_classes_are_two_or_more(classes: tuple[str, ...]) -> None:
    with pytest.raises(ValueError, match="expected 2 or more, distinct"):
        fit(*TRAIN, *VAL, NETWORK, WINDOWS, TRAINING, 0, classes=classes)


def test_a_model_file_that_unpacks_without_bound_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "zeros.pt"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("archive/data/0", bytes((1 << 21) + 1))
    assert model_file.MOST_BYTES == 1 << 30
    monkeypatch.setattr(model_file, "MOST_BYTES", 1 << 21)
    with pytest.raises(ValueError, match="unpacks to over 2 MiB"):
        load(path)
