"""Patterns of file names that catch pieces of them, and texts that are put together from these.

A pattern is a path with ``/``: ``**/{part:train|test}/*_{object:number}.npy``. In a folder or file
name ``*`` matches any characters and ``?`` one; a folder ``**`` matches any folders, or none.
``{name}`` catches any characters, ``{name:number}`` a whole number without adjacent digits, and
``{name:one|two}`` one of these words. Where several matches are possible, earlier parts are greedy:
in ``*{object:number}*`` the object is the last number.

Names are matched here and not by regular expressions: those of a file from elsewhere could take
for ever. The time taken is bounded by the lengths of pattern and name.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

FIELD = r"[A-Za-z][A-Za-z0-9_]{0,31}"
MOST_CHARACTERS, MOST_WILDCARDS = 500, 16
_PIECE = re.compile(rf"\{{({FIELD})(?::([^{{}}/]+))?\}}|(\*+)|(\?)|([{{}}])|([^*?{{}}]+)")
_NUMBER = re.compile(r"[0-9]+(?:\.[0-9]+)?")
_ANY, _ONE, _DIGITS, _WORDS, _TEXT = "any", "one", "number", "words", "text"


@dataclass(frozen=True)
class _Piece:
    """A part of a folder or file name; `name` is the field that it catches."""

    kind: str
    texts: tuple[str, ...] = ()
    name: str | None = None

    def ends(self, text: str, begin: int) -> Iterator[int]:
        """Yield where the piece may end, that begins in `text` at `begin`; the furthest first."""
        if self.kind == _ANY:
            # a field is never empty
            yield from range(len(text), begin - (self.name is None), -1)
        elif self.kind == _ONE:
            if begin < len(text):
                yield begin + 1
        elif self.kind == _DIGITS:
            if begin and text[begin - 1].isdecimal():
                return
            found = _NUMBER.match(text, begin)
            if found is not None:
                yield found.end()
                whole = begin + len(found[0].partition(".")[0])
                if whole < found.end():
                    yield whole
        else:
            there = (begin + len(word) for word in self.texts if text.startswith(word, begin))
            yield from sorted(there, reverse=True)


_Segment = tuple[_Piece, ...]


@dataclass(frozen=True)
class FilePattern:
    """A pattern of file names below a folder.

    Attributes:
        text: as written.
        fields: names of what it catches.
    """

    text: str
    fields: tuple[str, ...]
    _segments: tuple[_Segment | None, ...]

    @property
    def exact(self) -> bool:
        """True without any wildcard: with its fields filled in it is the path of one file."""
        return all(
            segment is not None and all(piece.kind == _TEXT or piece.name for piece in segment)
            for segment in self._segments
        )

    def filled(self, fields: Mapping[str, str]) -> str:
        """Return the path of an exact pattern with its fields filled in.

        Raises:
            KeyError: a field that is not there.
        """
        return "/".join(
            "".join(piece.texts[0] if piece.name is None else fields[piece.name] for piece in part)
            for part in self._segments
            if part is not None
        )

    def match(self, path: str) -> dict[str, str] | None:
        """Return what the pattern catches in a path with ``/``; None where it does not match."""
        names = path.split("/")
        failed: set[tuple[int, int]] = set()

        def walk(at: int, name: int) -> dict[str, str] | None:
            if at == len(self._segments):
                return {} if name == len(names) else None
            if (at, name) in failed:
                return None
            segment, found = self._segments[at], None
            if segment is None:
                for last in range(len(names) - 1, name - 1, -1):
                    if (found := walk(at + 1, last)) is not None:
                        return found
            elif name < len(names) and (caught := _match(segment, names[name])) is not None:
                rest = walk(at + 1, name + 1)
                found = None if rest is None else caught | rest
            if found is None:
                failed.add((at, name))
            return found

        return walk(0, 0)


def parse_pattern(text: str) -> FilePattern:
    """Read a pattern.

    Raises:
        ValueError: it could lead out of its folder, or is no pattern; the text says what is right.
    """
    if not text or len(text) > MOST_CHARACTERS:
        raise ValueError(f"must be a pattern of file names of 1 to {MOST_CHARACTERS} characters")
    if any(ord(character) < 32 for character in text) or "\\" in text:
        raise ValueError("must be a pattern of file names with '/', without control characters")
    segments: list[_Segment | None] = []
    fields: list[str] = []
    for part in text.split("/"):
        if part == "":
            raise ValueError(
                "must be relative to the folder that is imported, with a name between two '/'"
            )
        if part in {".", ".."}:
            raise ValueError(f"must stay in the folder that is imported, without '{part}'")
        segment = None if part == "**" else _segment(part)
        segments.append(segment)
        fields += [piece.name for piece in segment or () if piece.name]
    if twice := next((name for name in fields if fields.count(name) > 1), None):
        raise ValueError(f"catches {{{twice}}} twice; use * for the second one")
    if segments[-1] is None:
        raise ValueError("must end in the name of a file, such as **/*.npy")
    wild = sum(segment is None for segment in segments)
    wild += sum(piece.kind != _TEXT for segment in segments for piece in segment or ())
    if wild > MOST_WILDCARDS:
        raise ValueError(f"must have at most {MOST_WILDCARDS} wildcards and fields")
    return FilePattern(text, tuple(fields), tuple(segments))


def _segment(part: str) -> _Segment:
    pieces = []
    for field, kind, stars, one, brace, text in _PIECE.findall(part):
        if brace:
            raise ValueError(
                "has a brace that is no field: a field is {name}, {name:number} or {name:one|two}"
            )
        if len(stars) > 1:
            raise ValueError("has '**' in a name: it stands for whole folders, between two '/'")
        if field:
            words = tuple(kind.split("|")) if kind and kind != _DIGITS else ()
            if words and not all(words):
                raise ValueError(f"has an empty word in {{{field}:{kind}}}")
            name = _WORDS if words else _DIGITS if kind else _ANY
            pieces.append(_Piece(name, words, field))
        else:
            pieces.append(_Piece(_ANY if stars else _ONE if one else _TEXT, (text,)))
    return tuple(pieces)


def _match(segment: _Segment, text: str) -> dict[str, str] | None:
    failed: set[tuple[int, int]] = set()

    def walk(at: int, begin: int) -> dict[str, str] | None:
        if at == len(segment):
            return {} if begin == len(text) else None
        if (at, begin) in failed:
            return None
        piece = segment[at]
        for end in piece.ends(text, begin):
            if piece.kind == _DIGITS and end < len(text) and text[end].isdecimal():
                continue
            rest = walk(at + 1, end)
            if rest is not None:
                return rest if piece.name is None else {piece.name: text[begin:end]} | rest
        failed.add((at, begin))
        return None

    return walk(0, 0)


def template_fields(text: str) -> tuple[str, ...]:
    """Return the fields in a text such as ``"{part}-{stem}"``.

    Raises:
        ValueError: a brace in it is no field.
    """
    rest = re.sub(rf"\{{{FIELD}\}}", "", text)
    if "{" in rest or "}" in rest:
        raise ValueError("has a brace that is no field: a field is {name}")
    return tuple(re.findall(rf"\{{({FIELD})\}}", text))


def fill(text: str, fields: Mapping[str, str]) -> str:
    """Put fields into a text such as ``"{part}-{stem}"``.

    Raises:
        KeyError: a field that is not there.
    """
    return re.sub(rf"\{{({FIELD})\}}", lambda found: fields[found[1]], text)
