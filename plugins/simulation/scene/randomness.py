"""Random numbers that depend on their purpose, and never on earlier draws.

A trial must give the same bytes whether it is the first of a campaign or taken again after a
crash, read in one chunk or in a thousand. So there is no global generator: each use names its
seed, its purpose and, where it draws in pieces, the number of the piece.
"""

from __future__ import annotations

import zlib

import numpy as np


def generator(seed: int, purpose: str, *indices: int) -> np.random.Generator:
    """A PCG64 generator that belongs to `seed`, `purpose` and `indices` alone."""
    return np.random.Generator(np.random.PCG64(_sequence(seed, purpose, indices)))


def key(seed: int, purpose: str, *indices: int) -> int:
    """A 64-bit key for counter-based hashing, 0 to 2**64 - 1."""
    return int(_sequence(seed, purpose, indices).generate_state(1, np.uint64)[0])


def _sequence(seed: int, purpose: str, indices: tuple[int, ...]) -> np.random.SeedSequence:
    return np.random.SeedSequence([seed, zlib.crc32(purpose.encode()), *indices])
