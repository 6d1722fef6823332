"""Sanitised text for display: values as YAML writes them, no secrets, no control codes.

A message quotes the content of a file. The file may contain a password, or bytes that control a
terminal (``ESC ]0;...`` sets its title, an override of direction shows text backwards); neither is
shown.
"""

from __future__ import annotations

import difflib
import re
import unicodedata
from collections.abc import Iterable
from datetime import date
from decimal import Decimal
from functools import lru_cache
from itertools import pairwise

MASK = "****"

CONTROL = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ufeff]"
)
"""Characters that steer a terminal, or the direction of text; not line breaks and tabs."""
_WORDS = re.compile(r"[A-Z]?[a-z0-9]+|[A-Z0-9]+")
_ENDS = ("key", "keys", "token", "tokens", "secret", "secrets", "credential", "credentials")
_PARTS = ("passw", "passphrase", "secret")
_WHOLE = frozenset({"pass", "pwd", "pw", "auth"})
_ALIKE = frozenset({"key", "keys", "token", "tokens"})
"""Words of secrets that are also words of a lab: a key that is gripped, a token that is lifted."""
_OWN = frozenset({"factors", "context", "condition", "streams"})
"""Sections whose keys are names that a user gives."""
_TRIAL = re.compile(r"(?:[\w-]+=[^,\s=]+,)+r=\d+(?![\w=])")
"""A trial's id: levels by factor."""
_MISSPELT = ("password", "passwd", "passphrase", "secret", "token", "credentials")
_CLOSE = 0.85
_WRITTEN = re.compile(r"(?<![\w-])([\w-]+)\s*[:=]\s*(?=[^\s*])")
_URL = re.compile(r"(://[^\s/@:\"']*:)([^\s/@\"']+)(?=@)")
_LONGEST = 200
"""Characters of a value; paths are to be seen whole."""
_LOOKED_AT = 1000
"""Characters of a text or a name that are searched: a file may hold a million."""


def is_secret(name: str) -> bool:
    """Return whether a key or a variable of this name holds a secret, also if it is misspelt."""
    return any(_is_secret_word(word.lower()) for word in _WORDS.findall(name[:_LOOKED_AT]))


@lru_cache(maxsize=4096)  # each store, message and file asks for the same names
def _is_secret_word(word: str) -> bool:
    if word in _WHOLE or word.endswith(_ENDS) or any(part in word for part in _PARTS):
        return True
    return bool(difflib.get_close_matches(word, _MISSPELT, n=1, cutoff=_CLOSE))


def is_own_name(section: str, name: str) -> bool:
    """Return whether a key below a section is a user's name of something: no secret's."""
    words = [word.lower() for word in _WORDS.findall(name[:_LOOKED_AT])]
    return section in _OWN and not any(
        _is_secret_word(word) for word in words if word not in _ALIKE
    )


def holds_secret(key: str, *, of_mapping: bool = False) -> bool:
    """Return whether a part of a key's path (``devices.arm.password``) is a secret's name.

    A section that is called ``key`` is not a secret, nor is a name that a user gives to a factor or
    a stream, or the level of such a factor.

    Args:
        of_mapping: the key's value is a section of its own.
    """
    names = ["", *re.findall(r"[^.\[\]]+", key)]
    for number, (section, name) in enumerate(pairwise(names), 2):
        inside = number < len(names)
        if (inside and name == "key") or not is_secret(name):
            continue
        if not (is_own_name(section, name) and (inside or of_mapping or section == "condition")):
            return True
    return False


def password_in(url: str) -> str | None:
    """The password of the first address (``scheme://user:password@host``) in a text."""
    found = _URL.search(url)
    return None if found is None else found[2]


def without_passwords(text: str) -> str:
    """`text` with the passwords of its addresses masked."""
    return _URL.sub(rf"\1{MASK}", text) if "://" in text else text


def foreign_character(text: str) -> str:
    """``U+0435 CYRILLIC SMALL LETTER IE``: the first character beyond ASCII; empty without one."""
    for character in text:
        if not character.isascii():
            return f"U+{ord(character):04X} {unicodedata.name(character, 'without a name')}"
    return ""


def nearest(name: str, names: Iterable[str]) -> str | None:
    """Return the one of some names that a misspelt one is close to, if any."""
    known = {each.casefold().replace("-", "_"): each for each in names}
    close = difflib.get_close_matches(name.casefold().replace("-", "_"), known, n=1)
    return known[close[0]] if close else None


def did_you_mean(name: str, names: Iterable[str]) -> str:
    """Return ``; did you mean 'depth'?`` for a name that is close to a known one, else nothing."""
    close = nearest(name, names)
    return f"; did you mean '{close}'?" if close else ""


def one_of(name: object, names: Iterable[str]) -> str:
    """Return ``must be one of a, b``, with the nearest of them for a misspelt name."""
    known = list(names)
    if not known:
        return "is not there: there is none"
    return f"must be one of {', '.join(known)}{did_you_mean(str(name), known)}"


def plural(count: int, noun: str) -> str:
    """Return a count with its noun: "1 trial", "2 trials", "3 batches"."""
    end = "" if count == 1 else "es" if noun.endswith(("s", "x", "ch", "sh")) else "s"
    return f"{count} {noun}{end}"


def printable(text: str) -> str:
    """`text` with control codes written out (``\\x1b``); line breaks and tabs stay."""
    return CONTROL.sub(lambda found: _escaped(found[0]), text)


def shown(value: object, key: str = "") -> str:
    """A value in one line of at most 200 characters, as YAML would write it.

    Args:
        key: its location; values of secret keys are masked, at any depth.
    """
    text = printable(" ".join(_yaml(value, key).split()))
    return text if len(text) <= _LONGEST else text[: _LONGEST - 3] + "..."


def shown_key(key: str) -> str:
    """A key in one line of at most 1000 characters, a secret written into it masked."""
    return printable(" ".join(_without_secret(key[:_LOOKED_AT]).split()))


def _escaped(character: str) -> str:
    code = ord(character)
    return f"\\x{code:02x}" if code < 256 else f"\\u{code:04x}"


def _yaml(value: object, key: str) -> str:
    if value is None:
        return "null"
    if holds_secret(key, of_mapping=isinstance(value, dict)):
        return MASK
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, dict):
        pairs = ", ".join(
            f"{shown_key(str(k))}: {_yaml(v, f'{key}.{k}')}" for k, v in value.items()
        )
        return f"{{{pairs}}}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_yaml(part, "") for part in value) + "]"
    if isinstance(value, float | Decimal) and not (number := Decimal(value)).is_finite():
        return ".nan" if number.is_nan() else ".inf" if number > 0 else "-.inf"
    if isinstance(value, date):
        return value.isoformat()
    return _without_secret(str(value)) or "''"


def _without_secret(text: str) -> str:
    ids = [found.span() for found in _TRIAL.finditer(text[:_LOOKED_AT])]
    for found in _WRITTEN.finditer(text[:_LOOKED_AT]):
        level = any(begin <= found.start() < end for begin, end in ids)
        if is_secret(found[1]) and not (level and is_own_name("condition", found[1])):
            return without_passwords(text[: found.end()]) + MASK
    return without_passwords(text)
