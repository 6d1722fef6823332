"""Networks of other programs: their function returns counts, and its faults are named."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest
import torch

from sliplab.analysis.networks.external_model import ExternalModel, load_external
from sliplab.protocols import InputError
from sliplab.protocols.windows import Windows
from tests.conftest import ROOT

pytestmark = pytest.mark.usefixtures("one_thread")

TOTALS = """
import numpy as np


def network(x):
    from neighbour import LEAST

    print("for people")
    total = x.sum(axis=(1, 2, 3, 4))
    return np.stack([total < LEAST, total == LEAST, total > LEAST], axis=1)


network.windows = {"length_ms": 4, "crop_px": 40}
network.outputs_per_class = 2
"""


def written(folder: Path, text: str = TOTALS) -> Path:
    """A file with a function, and a neighbour that it imports."""
    (folder / "neighbour.py").write_text("LEAST = 3\n")
    (folder / "lab.py").write_text(text)
    return folder / "lab.py:network"


def windows(n: int) -> np.ndarray:
    return np.random.default_rng(1).poisson(0.2, (n, 4, 1, 2, 2)).astype(np.uint8)


def test_the_function_counts(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found, x = load_external(written(tmp_path)), windows(150)
    assert found.windows == Windows(length_ms=4, crop_px=40)
    assert (found.outputs_per_class, found.place) == (2.0, f"{tmp_path / 'lab.py'}:network")
    total = x.sum(axis=(1, 2, 3, 4), dtype=np.int64)
    expected = np.stack([total < 3, total == 3, total > 3], axis=1).astype(np.int64)
    assert expected.any(axis=0).all()
    np.testing.assert_array_equal(found.counts(x), expected)
    assert found.counts(x[:0]).shape == (0, 3)
    assert capsys.readouterr().out == ""  # which a program may read
    # as a worker gets it
    again: ExternalModel = pickle.loads(pickle.dumps(found))
    np.testing.assert_array_equal(again.counts(x), expected)


def test_other_weights_are_another_network(tmp_path: Path) -> None:
    text = """
import numpy as np
from pathlib import Path
WEIGHTS = np.load(Path(__file__).with_name("w.npy"))
def network(x):
    return x.sum(axis=(1, 2, 3, 4))[:, None] * WEIGHTS
network.windows = {"length_ms": 4, "crop_px": 40}
"""
    marks = []
    for weights in ([1, 2, 3], [1, 2, 3], [1, 2, 4]):
        np.save(tmp_path / "w.npy", weights)
        marks.append(load_external(written(tmp_path, text)).fingerprint)
    assert marks[0] == marks[1] != marks[2]


WRONG = {
    "no file": ("other.py:network", None, r"other\.py: cannot be read"),
    "no function named": ("lab.py", None, r"lab\.py: must be FILE\.py:FUNCTION"),
    "no such function": (
        "lab.py:net",
        None,
        r"lab\.py: net: must be a function|= net: must be a f",
    ),
    "no Python": ("lab.py:network", "def network(x) return", "cannot be loaded: SyntaxError"),
    "fails when loaded": ("lab.py:network", "import nothing_like_it", "ModuleNotFoundError"),
    "fails": ("lab.py:network", "def network(x):\n    return 1 / 0", "ZeroDivisionError"),
    "a class too few": (
        "lab.py:network",
        "def network(x):\n    return [[0, 1]] * len(x)",
        r"returned the shape \(16, 2\); must be \(16, 3\)",
    ),
    "no counts": (
        "lab.py:network",
        "def network(x):\n    return [[0.5, 0, 0]] * len(x)",
        "must be whole, 0 to",
    ),
    "NaN": (
        "lab.py:network",
        "def network(x):\n    return [[float('nan'), 0, 0]] * len(x)",
        "must be whole, 0 to",
    ),
    "leaves": ("lab.py:network", "def network(x):\n    raise SystemExit(3)", "SystemExit: 3"),
    "leaves when loaded": ("lab.py:network", "raise SystemExit(3)", "loaded: SystemExit: 3"),
    "too many": (
        "lab.py:network",
        "def network(x):\n    return [[1e30, 0, 0]] * len(x)",
        "must be whole, 0 to 1000000",
    ),
    "windows as a number": (
        "lab.py:network",
        "def network(x):\n    pass\nnetwork.windows = 5",
        "windows = 5: must be a mapping",
    ),
    "windows": (
        "lab.py:network",
        "def network(x):\n    pass\nnetwork.windows = {'lenght_ms': 30}",
        r"did you mean 'length_ms'",
    ),
    "outputs as a word": (
        "lab.py:network",
        "def network(x):\n    pass\nnetwork.outputs_per_class = 'many'",
        "outputs_per_class = many: must be a number",
    ),
    "outputs": (
        "lab.py:network",
        "def network(x):\n    pass\nnetwork.outputs_per_class = 0",
        "outputs_per_class = 0: must be a number above 0",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_faults_are_named(name: str, tmp_path: Path) -> None:
    place, text, message = WRONG[name]
    written(tmp_path, TOTALS if text is None else text)
    with pytest.raises(InputError, match=message):
        load_external(tmp_path / place)


def test_the_documented_network_counts_as_sinabs_does(tmp_path: Path) -> None:
    text = (ROOT / "docs" / "models.md").read_text()
    (tmp_path / "lab.py").write_text(text.split('```python title="lab.py"\n')[1].split("```")[0])
    torch.manual_seed(0)
    found = load_external(tmp_path / "lab.py:network")
    x = np.random.default_rng(2).poisson(0.5, (3, 30, 1, 20, 20)).astype(np.uint8)
    counts = found.counts(x)
    assert counts.any()
    for one, expected in zip(x, counts, strict=True):  # every window from rest
        np.testing.assert_array_equal(found.counts(one[None])[0], expected)
