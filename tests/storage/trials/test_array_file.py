"""A file of arrays maps into memory, has equal bytes for equal arrays, says when it is spoilt."""

from pathlib import Path

import numpy as np
import pytest

from sliplab.storage.trials.array_file import map_arrays, write_arrays


def test_arrays_come_back_aligned_and_mapped(tmp_path: Path) -> None:
    path = tmp_path / "a.arrays"
    arrays = {
        "a": np.arange(7, dtype=np.uint8),
        "none": np.empty((0, 3), np.float32),
        "b": np.arange(12.0).reshape(3, 4)[:, ::2],
        "c": np.array(5, np.int64),
    }
    write_arrays(path, arrays)
    found = map_arrays(path)
    assert list(found) == sorted(arrays)
    for name, array in arrays.items():
        np.testing.assert_array_equal(found[name], array)
        assert found[name].dtype == array.dtype
        assert found[name].ctypes.data % 64 == 0 or not array.size
    first = path.read_bytes()
    write_arrays(path, arrays)
    assert path.read_bytes() == first


def test_objects_are_refused_and_nothing_is_written(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="things holds objects"):
        write_arrays(tmp_path / "a.arrays", {"things": np.array([{}])})
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b"sliplab-arrays-1", b"sliplab-arrays-9"),
        (b'"<i8"', b'"|O8"'),
        (b"[1000]", b"[9000]"),
        (b"[1000]", b"[-100]"),
        (b'"at"', b'"it"'),
        (b"{", b"["),
    ],
)
def test_a_spoilt_file_is_named(tmp_path: Path, old: bytes, new: bytes) -> None:
    path = tmp_path / "a.arrays"
    write_arrays(path, {"a": np.arange(1000)})
    data = path.read_bytes()
    assert data.count(old) >= 1
    path.write_bytes(data.replace(old, new, 1))
    with pytest.raises(ValueError, match=r"a\.arrays"):
        map_arrays(path)
