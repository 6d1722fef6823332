"""An ordinary classifier for marker displacements: a perceptron with one hidden layer.

Scikit-learn trains it; the trained one is four arrays, so its file needs no pickle, and running it
is two matrix products.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.special import softmax
from threadpoolctl import threadpool_limits

from sliplab.analysis.metrics import classification as metrics
from sliplab.analysis.metrics.classification import CLASSES
from sliplab.plugins.markers.displacement import FRAMES, MarkerSamples
from sliplab.storage.trials.array_file import Arrays, map_arrays, write_arrays

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]

FORMAT = "sliplab-marker-model-1"
KIND = "multilayer perceptron on marker displacements"
VERSION = 1
HIDDEN, EPOCHS, BATCH, LEARNING_RATE, RIDGE = 32, 40, 128, 1e-3, 1e-3
POINTS = 100
"""Points that a class gets when it is certain: probabilities as whole numbers, which the rule of
detection takes where a spiking network gives spikes."""


@dataclass(frozen=True)
class Epoch:
    """Loss and accuracies after one epoch; its names are those of the spiking network's record."""

    epoch: int
    loss: float
    val_loss: float
    train_argmax: float
    val_argmax: float
    val_strict: float


@dataclass(frozen=True)
class MarkerNet:
    """A trained perceptron: ``softmax(max(0, z @ first + bias) @ last + last_bias)``.

    Its inputs are ``z = asinh(displacement / px)``: linear below a pixel, where slip begins, and
    logarithmic where a marker has long slipped.

    Attributes:
        weights: (k, h) and (h, 3) of k inputs; biases: (h,) and (3,).
        markers: number of markers that it takes.
        history: every epoch; chosen_epoch: whose weights these are.
    """

    weights: tuple[F64, F64]
    biases: tuple[F64, F64]
    markers: int
    seed: int
    history: tuple[Epoch, ...]
    chosen_epoch: int

    @property
    def title(self) -> str:
        """The classifier as text."""
        inputs, hidden = self.weights[0].shape
        return f"{KIND}: {inputs} inputs, {hidden} hidden units, {len(CLASSES)} classes"

    @property
    def size(self) -> int:
        """Number of weights and biases."""
        return sum(part.size for part in (*self.weights, *self.biases))

    @property
    def multiply_adds(self) -> int:
        """Multiply-adds of one window."""
        return sum(part.size for part in self.weights)

    def probabilities(self, x: F32) -> F64:
        """Return the probability of each class, (n, 3), of windows (n, FRAMES, markers, 2).

        Raises:
            ValueError: windows of another shape.
        """
        if x.shape[1:] != (FRAMES, self.markers, 2):
            raise ValueError(
                f"windows of {x.shape[1:]}: this network takes {(FRAMES, self.markers, 2)}"
            )
        z = _inputs(x)
        # sums over threads differ between numbers of them
        with threadpool_limits(1):
            hidden = np.maximum(z @ self.weights[0] + self.biases[0], 0.0)
            return np.asarray(softmax(hidden @ self.weights[1] + self.biases[1], axis=1))

    def points(self, x: F32) -> I64:
        """Return the probabilities in whole points, int64 (n, 3)."""
        return np.rint(POINTS * self.probabilities(x)).astype(np.int64)


def fit(train: MarkerSamples, validation: MarkerSamples, seed: int) -> MarkerNet:
    """Train, and select the epoch of best strict validation accuracy; ties by the lower loss.

    Args:
        seed: of the first weights and of the order of the samples.

    Raises:
        ValueError: a class is missing among the training samples, or there are no validation
            samples.
    """
    from sklearn.neural_network import MLPClassifier  # takes a second

    missing = [name for k, name in enumerate(CLASSES) if not (train.y == k).any()]
    if missing:
        raise ValueError(f"no training samples of {', '.join(missing)}; collect more trials")
    if not len(validation):
        raise ValueError("no validation samples; collect more trials")
    z = _inputs(train.x)
    model = MLPClassifier(
        (HIDDEN,),
        alpha=RIDGE,
        batch_size=min(BATCH, len(z)),
        learning_rate_init=LEARNING_RATE,
        random_state=seed,
    )
    history: list[Epoch] = []
    best: tuple[tuple[float, float], MarkerNet] | None = None
    with threadpool_limits(1), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that one epoch is no convergence
        for number in range(1, EPOCHS + 1):
            model.partial_fit(z, train.y, classes=np.arange(len(CLASSES)))
            net = MarkerNet(
                _pair(model.coefs_),
                _pair(model.intercepts_),
                train.x.shape[2],
                seed,
                (),
                number,
            )
            seen, held = net.probabilities(train.x), net.probabilities(validation.x)
            known = metrics.accuracy(held, validation.y)
            history.append(
                Epoch(
                    number,
                    _loss(seen, train.y),
                    _loss(held, validation.y),
                    metrics.accuracy(seen, train.y).argmax or 0.0,
                    known.argmax or 0.0,
                    known.strict or 0.0,
                )
            )
            rank = (history[-1].val_strict, -history[-1].val_loss)
            if best is None or rank > best[0]:
                best = rank, net
    assert best is not None
    return replace(best[1], history=tuple(history))


def _inputs(x: F32) -> F64:
    """Return the network's inputs for windows, (n, k)."""
    return np.arcsinh(x.reshape(len(x), -1).astype(np.float64))


def _pair(parts: Sequence[Any]) -> tuple[F64, F64]:
    first, last = parts
    return np.array(first, np.float64), np.array(last, np.float64)


def _loss(probabilities: F64, labels: I64) -> float:
    """Mean cross-entropy, nats."""
    true = probabilities[np.arange(len(labels)), labels]
    return -float(np.log(np.maximum(true, np.finfo(np.float64).tiny)).mean())


def save(path: Path, net: MarkerNet) -> None:
    """Write a model file: whole or not at all, and the same bytes for the same model."""
    stated = {
        "format": FORMAT,
        "kind": KIND,
        "classes": list(CLASSES),
        "frames": FRAMES,
        "markers": net.markers,
        "seed": net.seed,
        "chosen_epoch": net.chosen_epoch,
        "history": [asdict(epoch) for epoch in net.history],
    }
    arrays: Arrays = {
        "weights_0": net.weights[0],
        "weights_1": net.weights[1],
        "biases_0": net.biases[0],
        "biases_1": net.biases[1],
        "said": np.frombuffer(json.dumps(stated).encode(), np.uint8),
    }
    write_arrays(path, arrays)


def load(path: Path) -> MarkerNet:
    """Read a model file that `save` wrote. Nothing in it is executed.

    Raises:
        OSError: it does not exist, or it cannot be read.
        ValueError: it is not such a file, or its arrays do not fit each other.
    """
    arrays = {name: np.array(array) for name, array in map_arrays(path).items()}
    try:
        stated = json.loads(arrays["said"].tobytes())
        if stated["format"] != FORMAT:
            raise ValueError(f"format = {stated['format']}: must be {FORMAT}")
        if stated["frames"] != FRAMES:
            raise ValueError(f"frames = {stated['frames']}: must be {FRAMES}")
        net = MarkerNet(
            (arrays["weights_0"], arrays["weights_1"]),
            (arrays["biases_0"], arrays["biases_1"]),
            stated["markers"],
            stated["seed"],
            tuple(Epoch(**epoch) for epoch in stated["history"]),
            stated["chosen_epoch"],
        )
        net.probabilities(np.zeros((1, FRAMES, net.markers, 2), np.float32))
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: not a marker model of this program: {error}") from error
    return net
