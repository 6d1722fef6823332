"""Reader of Prophesee's raw and dat files and of `.es`, through faery if it is installed.

`pip install faery`. It is not a dependency of the project.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from importlib import import_module, util
from itertools import takewhile
from pathlib import Path
from typing import Any, TypeVar

from sliplab.protocols.errors import InputError
from sliplab.storage.formats.foreign import ForeignTrial, FormatError, event_chunk, read_head
from sliplab.storage.streams import EventChunk

LIBRARY = "faery"
EVENT_STREAM = b"Event Stream"
"""First bytes of a `.es` file."""
_RAW = re.compile(rb"(?mi)^% (?:evt \d|format EVT\d)")
_DAT = re.compile(rb"(?mi)^% version \d")
_NO_SIZE = (2048, 2048)
"""faery returns this where a file gives no size; its events' 11 bits reach no further."""
T = TypeVar("T")


def faery_type(head: bytes) -> str | None:
    """Return faery's name for the format of a file by its first bytes; None for any other."""
    if head.startswith(EVENT_STREAM):
        return "es"
    header = takewhile(lambda line: line.startswith(b"%"), head.split(b"\n"))
    lines = b"\n".join(header)
    if _RAW.search(lines):
        return "evt"
    return "dat" if _DAT.search(lines) else None


def read_by_faery(path: Path, name: str) -> ForeignTrial:
    """Read a `.raw`, `.dat` or `.es` file as a trial called `name`.

    Raises:
        InputError: faery is not installed.
        FormatError: the file says no format, or faery cannot read it.
    """
    if util.find_spec(LIBRARY) is None:
        raise InputError(
            path,
            "",
            None,
            "needs the library faery, which is not installed: pip install faery",
        )
    form = faery_type(read_head(path))
    if form is None:
        raise FormatError(
            "gives no format: a .raw file has a line `% evt 3.0` or `% format EVT3` in its header, "
            "a .dat file `% Version 2`, a .es file begins with `Event Stream`"
        )

    def stream() -> Any:
        return import_module(LIBRARY).events_stream_from_file(
            path, dimensions_fallback=_NO_SIZE, file_type=form
        )

    width, height = _guarded(lambda: stream().dimensions(), None, 0)
    known = (int(width), int(height)) if (width, height) != _NO_SIZE else None

    def all_events() -> Iterator[EventChunk]:
        count = 0
        packets = _guarded(lambda: iter(stream()), known, count)
        while (rows := _guarded(lambda: next(packets, None), known, count)) is not None:
            count += len(rows)
            yield event_chunk(rows["x"], rows["y"], rows["on"].view("u1"), rows["t"])

    return ForeignTrial(
        name, path.name, all_events, "the camera's own clock, us, from the file's beginning",
        lambda: known, about={"read_by": LIBRARY},
        unknown=("sync grade", "poses", "motion", "condition", "frames", "triggers"),
    )  # fmt: skip


def _guarded(step: Callable[[], T], size: tuple[int, int] | None, count: int) -> T:
    """Run a step in faery; a panic of its Rust code is no `Exception`."""
    try:
        return step()
    except (KeyboardInterrupt, SystemExit):
        raise
    except BaseException as error:
        text = " ".join(str(error).split()) or type(error).__name__
        text = re.sub(r'the stream "[^"]*"', "it", text)
        if "overflow" in text and size is not None:
            text += f": an event outside of the {size[0]} x {size[1]} pixels in its header"
        raise FormatError(
            "is damaged, truncated or not of the format in its header: after "
            f"{count:,} events faery stops with: {text}"
        ) from None
