"""Hashes that are the same on every machine: of text, and of plain data as canonical JSON."""

from __future__ import annotations

import hashlib
import json
from typing import Any


def hash_data(data: Any) -> str:
    """SHA-256 of `data` (JSON types only) as canonical JSON, 64 hex digits.

    Raises:
        ValueError: a NaN or an infinity, which JSON has no word for.
    """
    text = json.dumps(data, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hash_text(text)


def hash_text(text: str) -> str:
    """SHA-256 of `text` in UTF-8, 64 hex digits."""
    return hashlib.sha256(text.encode()).hexdigest()


def hash_integer(*parts: object) -> int:
    """A 63-bit integer from the texts of `parts`: a seed, or a rank in a seeded order."""
    text = "|".join(str(part) for part in parts)
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big") >> 1
