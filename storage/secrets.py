"""Passwords and keys that stand in the environment never stand in a store, a log or a message.

Errors of other libraries quote addresses with their credentials, and command lines are kept with
locks. Such text goes through here before it is kept or said. Data do not: a condition must not
change because it looks like somebody's key.
"""

from __future__ import annotations

import os

from sliplab.protocols.shown import MASK, is_secret, password_in, without_passwords

_SHORTEST = 8
"""A shorter value is a switch, or stands in many a word."""


def masked(text: str) -> str:
    """`text` with every secret replaced by ``****``.

    Secrets are the passwords of addresses (``scheme://user:password@host``), wherever they come
    from, and the values of environment variables that are named as one.
    """
    for secret in _secrets():
        if secret in text:
            text = text.replace(secret, MASK)
    return without_passwords(text)


def _secrets() -> list[str]:
    """Longest first: one may be part of another."""
    found = set()
    for name, value in os.environ.items():
        if len(value) < _SHORTEST:
            continue
        if is_secret(name) and not value.startswith("/"):
            found.add(value)
        elif (password := password_in(value)) and len(password) >= _SHORTEST:
            found.add(password)
    return sorted(found, key=len, reverse=True)
