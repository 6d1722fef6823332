"""URLs of pushed stores: what is one, and what none of them may carry."""

from __future__ import annotations

import os
import re
from urllib.parse import urlsplit

from sliplab.protocols.errors import InputError

_URL = re.compile(r"([a-z][a-z0-9+.-]*)://.+")


def is_url(place: str | os.PathLike[str]) -> bool:
    """Whether `place` is a URL rather than a folder."""
    return _URL.fullmatch(os.fspath(place)) is not None


def check_url(url: str) -> str:
    """`url` without a slash at its end.

    Raises:
        InputError: it is none, is of a kind that chains others, or carries a secret.
    """
    if not is_url(url):
        raise InputError("URL", "", url, "must be a URL such as s3://bucket/folder")
    parts = urlsplit(url)
    if parts.username or parts.password or parts.query or parts.fragment:
        shown = f"{parts.scheme}://.../{parts.path.lstrip('/')}"
        raise InputError(
            "URL", "", shown, "must not carry keys, passwords or options: put them into the "
            "environment or fsspec's configuration",
        )  # fmt: skip
    if "::" in url or ".." in parts.path.split("/"):
        raise InputError("URL", "", url, "must name one place, without '::' and '..'")
    return url.rstrip("/")
