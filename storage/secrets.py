"""Passwords and keys that stand in the environment never stand in a store, a log or a message.

Errors of other libraries quote addresses with their credentials, and command lines are kept with
locks. Such text goes through here before it is kept or said. Data do not: a condition must not
change because it looks like somebody's key.
"""

from __future__ import annotations

import os
import re

_NAMED = re.compile(
    r"(?:^|_)(KEY|TOKEN|SECRET|PASSWORD|PASSWD|PASSPHRASE|CREDENTIALS?|AUTH_STRING)(?:_|$)", re.I
)
_URL = re.compile(r"(://[^\s/@:\"']*:)([^\s/@\"']+)(?=@)")
_SHORTEST = 8
"""A shorter value is a switch, or stands in many a word."""
MASK = "****"


def masked(text: str) -> str:
    """`text` with every secret replaced by ``****``.

    Secrets are the passwords of addresses (``scheme://user:password@host``), wherever they come
    from, and the values of environment variables that are named as one.
    """
    for secret in _secrets():
        if secret in text:
            text = text.replace(secret, MASK)
    return _URL.sub(rf"\1{MASK}", text) if "://" in text else text


def _secrets() -> list[str]:
    """Longest first: one may be part of another."""
    found = set()
    for name, value in os.environ.items():
        if len(value) >= _SHORTEST and _NAMED.search(name) and not value.startswith("/"):
            found.add(value)
        elif "@" in value and (told := _URL.search(value)) and len(told[2]) >= _SHORTEST:
            found.add(told[2])
    return sorted(found, key=len, reverse=True)
