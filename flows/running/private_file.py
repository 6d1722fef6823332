"""Secrets in files that only this user can read."""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from sliplab.protocols import InputError
from sliplab.storage.files import write_bytes


def stored_secret(path: Path, pattern: str, make: Callable[[], str]) -> str:
    """Return the secret of a file, stored from one start to the next.

    Args:
        pattern: regular expression of a secret; a file with other content, or one that others can
            read, is replaced.
        make: returns a new secret.

    Raises:
        InputError: it cannot be stored where only this user can read it.
    """
    with suppress(OSError, UnicodeDecodeError):
        if _private(path) and re.fullmatch(pattern, saved := path.read_text().strip()):
            return saved
    secret = make()
    write_private(path, secret)
    return secret


def write_private(path: Path, text: str) -> None:
    """Write a line of text to a file that only this user can read.

    Raises:
        InputError: it cannot be written, or others could read it on this file system.
    """
    try:
        write_bytes(path, f"{text}\n".encode(), mode=0o600)
        private = _private(path)
    except OSError as error:
        raise InputError(path, "", None, f"cannot be written: {error.strerror}") from None
    if not private:
        path.unlink()
        raise InputError(
            path,
            "",
            None,
            "can be read by other users on this file system; name another folder in PREFECT_HOME",
        )


def _private(path: Path) -> bool:
    found = path.lstat()
    alone = stat.S_ISREG(found.st_mode) and not found.st_mode & 0o077
    return alone and found.st_uid == os.getuid()
