"""Files of formats that are known and not read: each is named, with what converts it."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from scipy.io import savemat

from sliplab.protocols.errors import InputError
from sliplab.storage.formats.aedat4 import Aedat4Stream, Aedat4Writer
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


def _written(data: bytes) -> Callable[[Path], object]:
    return lambda path: path.write_bytes(data)


def _matlab(**how: Any) -> Callable[[Path], object]:
    return lambda path: savemat(path, {"x": np.arange(9)}, **how)


DV = "; read is AEDAT 4.0, to which iniVation's DV converts it"
UNSAID = "which does not say what its variables are: load it by "
AS_HDF5 = "scipy.io.loadmat, and write its events as the columns events/x, y, p and t (us) of an "
N_MNIST = (
    "has the form of a file of N-MNIST, 5 bytes an event and no header, which is not read: "
    "load it by tonic.io.read_mnist_file, and write its events as "
)
AEDAT = b"#!AER-DAT%.1f\r\n%b" + bytes(80)
FILES: dict[str, tuple[str, Callable[[Path], object], str]] = {
    "AEDAT 1.0": ("a.aedat", _written(bytes(60)), "is an AEDAT 1.0 file; "),
    "AEDAT 2": ("a.aedat", _written(AEDAT % (2.0, b"# x\r\n")), f"is an AEDAT 2.0 file{DV}"),
    "AEDAT 3": ("a.aedat", _written(AEDAT % (3.1, b"#Format: RAW\r\n")), f"AEDAT 3.1 file{DV}"),
    "AEDAT in raw": ("a.raw", _written(AEDAT % (3.1, b"")), "is an AEDAT 3.1 file"),
    "MATLAB 5": ("a.mat", _matlab(), f"is a MATLAB file of format 5.0, {UNSAID}{AS_HDF5}"),
    "MATLAB 4": ("a.mat", _matlab(format="4"), f"is a MATLAB file of format 4, {UNSAID}scipy"),
    "MATLAB 7.3": ("a.mat", _matlab_73, f"of format 7.3, {UNSAID}h5py"),
    "MATLAB in h5": ("a.h5", _matlab(appendmat=False), "is a MATLAB file of format 5.0"),
    "N-MNIST": ("00002.bin", _n_mnist, N_MNIST),
}


@pytest.mark.parametrize("name", FILES)
def test_a_known_format_that_is_not_read_is_named(tmp_path: Path, name: str) -> None:
    file, write, says = FILES[name]
    path = tmp_path / file
    write(path)
    for place in (path, tmp_path):
        with pytest.raises(InputError) as caught:
            kind_of(place)
        assert caught.value.message.startswith(f"{path}: ")
        assert says in caught.value.message
        assert "\n" not in caught.value.message


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
    with Aedat4Writer(
        tmp_path / "b.aedat4", {0: Aedat4Stream("EVTS", "e", (640, 480), "x")}
    ) as writer:
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
