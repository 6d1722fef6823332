"""Files of formats that are known and not read: each is named, with what converts it."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.io import savemat

from sliplab.protocols.errors import InputError
from sliplab.storage.formats.aedat4 import Aedat4Writer, Stream
from sliplab.storage.formats.known import known_formats
from sliplab.storage.formats.recognition import kind_of, skipped_in, trials_in
from tests.storage.formats.recordings import all_events


def _n_mnist(path: Path, count: int = 3000) -> None:
    """Column, row, polarity with 23 bits of time: 5 bytes each, the highest first."""
    rng = np.random.default_rng(3)
    t = np.cumsum(rng.integers(0, 200, count))
    p = rng.integers(0, 2, count)
    parts = (rng.integers(0, 34, count), rng.integers(0, 34, count), p << 7 | t >> 16, t >> 8, t)
    path.write_bytes(np.stack(parts, 1).astype(np.uint8).tobytes())


def _matlab_73(path: Path) -> None:
    """An HDF5 file behind 512 bytes of text, as MATLAB writes it."""
    with h5py.File(path, "w", userblock_size=512) as file:
        file["events/x"] = np.arange(3)
    text = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(512, b" ")
    path.write_bytes(text + path.read_bytes()[512:])


FILES: dict[str, tuple[str, Callable[[Path], object], str]] = {
    "AEDAT 1.0": ("a.aedat", lambda path: path.write_bytes(bytes(60)), "is an AEDAT 1.0 file; "),
    "AEDAT 2.0": (
        "a.aedat",
        lambda path: path.write_bytes(b"#!AER-DAT2.0\r\n# x\r\n" + bytes(80)),
        "is an AEDAT 2.0 file; read is AEDAT 4.0, to which iniVation's DV converts it",
    ),
    "AEDAT 3.1": (
        "a.aedat",
        lambda path: path.write_bytes(b"#!AER-DAT3.1\r\n#Format: RAW\r\n" + bytes(80)),
        "is an AEDAT 3.1 file; read is AEDAT 4.0, to which iniVation's DV converts it",
    ),
    "AEDAT 3.1 by another ending": (
        "a.raw",
        lambda path: path.write_bytes(b"#!AER-DAT3.1\r\n" + bytes(80)),
        "is an AEDAT 3.1 file",
    ),
    "MATLAB 5": (
        "a.mat",
        lambda path: savemat(path, {"x": np.arange(9)}),
        "is a MATLAB file of format 5.0, which does not say what its variables are: load it by "
        "scipy.io.loadmat, and write its events as the columns events/x, y, p and t (us) of an ",
    ),
    "MATLAB 4": (
        "a.mat",
        lambda path: savemat(path, {"x": np.arange(9)}, format="4"),
        "is a MATLAB file of format 4, which does not say what its variables are: load it by scipy",
    ),
    "MATLAB 7.3": (
        "a.mat",
        _matlab_73,
        "of format 7.3, which does not say what its variables are: load it by h5py",
    ),
    "MATLAB by another ending": (
        "a.h5",
        lambda path: savemat(path, {"x": np.arange(9)}, appendmat=False),
        "is a MATLAB file of format 5.0",
    ),
    "N-MNIST": (
        "00002.bin",
        _n_mnist,
        "has the form of a file of N-MNIST, 5 bytes an event and no header, which is not read: "
        "load it by tonic.io.read_mnist_file, and write its events as ",
    ),
}


@pytest.mark.parametrize("name", FILES)
def test_a_known_format_that_is_not_read_is_named_with_what_converts_it(
    tmp_path: Path, name: str
) -> None:
    file, write, says = FILES[name]
    path = tmp_path / file
    write(path)
    with pytest.raises(InputError) as caught:
        kind_of(path)
    assert caught.value.message.startswith(f"{path}: ")
    assert says in caught.value.message
    assert "\n" not in caught.value.message
    with pytest.raises(InputError) as caught:
        kind_of(tmp_path)
    assert caught.value.message.startswith(f"{path}: ")
    assert says in caught.value.message


@pytest.mark.parametrize("kind", [name for name, each in known_formats() if each.read])
def test_a_stated_kind_does_not_mistake_it_for_another(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "a.aedat4"
    path.write_bytes(b"#!AER-DAT2.0\r\n" + bytes(80))
    (found,) = trials_in(path, kind)
    assert isinstance(found.error, InputError)
    assert found.error.message.startswith(f"{path}: is an AEDAT 2.0 file")


def test_among_other_files_it_is_skipped_with_the_reason(tmp_path: Path) -> None:
    for name, (file, write, _) in FILES.items():
        write(tmp_path / f"{name} {file}")
    with Aedat4Writer(tmp_path / "b.aedat4", {0: Stream("EVTS", "e", (640, 480), "x")}) as writer:
        writer.events(0, all_events(100))
    assert kind_of(tmp_path) == "aedat4"
    skipped = {item.file: item.reason for item in skipped_in(tmp_path, "aedat4")}
    for name, (file, _, says) in FILES.items():
        assert says in skipped[f"{name} {file}"]


def test_other_bytes_are_not_taken_for_n_mnist(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    for number in range(50):
        path = tmp_path / f"{number}.bin"
        path.write_bytes(rng.integers(0, 256, 5 * int(rng.integers(1, 400)), np.uint8).tobytes())
    (tmp_path / "zeros.bin").write_bytes(bytes(500))
    with pytest.raises(InputError, match="contains no known file format"):
        kind_of(tmp_path)
    shutil.rmtree(tmp_path)
