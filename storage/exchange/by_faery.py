"""Prophesee's raw and dat files and `.es`, through faery, where it is installed.

`pip install faery`. It is no dependency: nothing else here needs it.
"""

from __future__ import annotations

from collections.abc import Iterator
from importlib import import_module, util
from pathlib import Path
from typing import Any

from protocols.errors import InputError
from storage.exchange.foreign import ForeignTrial, Wrong, event_chunk
from storage.streams import EventChunk

LIBRARY = "faery"


def read_by_faery(path: Path, name: str) -> ForeignTrial:
    """A `.raw`, `.dat` or `.es` file as a trial called `name`.

    Raises:
        InputError: faery is not installed.
        Wrong: faery cannot read the file.
    """
    if util.find_spec(LIBRARY) is None:
        raise InputError(
            path,
            "",
            None,
            "is read by the library faery, which is not installed: pip install faery",
        )
    size = _guarded(path, lambda: _stream(path).dimensions())

    def all_events() -> Iterator[EventChunk]:
        packets = _guarded(path, lambda: iter(_stream(path)))
        while (rows := _guarded(path, lambda: next(packets, None))) is not None:
            yield event_chunk(rows["x"], rows["y"], rows["on"].view("u1"), rows["t"])

    return ForeignTrial(
        name, path.name, all_events, "the camera's own clock, us, from the file's beginning",
        (int(size[0]), int(size[1])), about={"read_by": LIBRARY},
        unknown=("sync grade", "poses", "motion", "condition", "frames", "triggers"),
    )  # fmt: skip


def _stream(path: Path) -> Any:
    return import_module(LIBRARY).events_stream_from_file(path)


def _guarded(path: Path, step: Any) -> Any:
    """A step in faery; a panic of its Rust code is no `Exception`."""
    try:
        return step()
    except (KeyboardInterrupt, SystemExit, Wrong):
        raise
    except BaseException as error:
        raise Wrong(f"{path.name}: cannot be read: {error}") from None
