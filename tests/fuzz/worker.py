"""One process that reads damaged files; its parent sees how it ends.

Every case is made of its number and the seed alone, so that one that fails can be looked at again.
"""

from __future__ import annotations

import faulthandler
import os
import random
import resource
import sys
import traceback
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from sliplab.protocols.errors import InputError
from sliplab.storage.errors import StoreError
from tests.fuzz.mutate import mutate
from tests.fuzz.targets import Target, targets

MEMORY = 2 << 30
"""Address space that a worker may take beyond what it has when it begins."""
_FORBIDDEN = (
    "os.system",
    "os.exec",
    "os.posix_spawn",
    "os.spawn",
    "os.fork",
    "os.forkpty",
    "subprocess.",
    "pty.",
    "socket.connect",
    "socket.bind",
    "ctypes.dlopen",
    "shutil.rmtree",
    "urllib.",
    "ftplib.",
    "http.",
    "smtplib.",
    "pickle.find_class",
    "os.remove",
    "os.rename",
    "os.rmdir",
    "os.chmod",
    "os.symlink",
    "os.link",
    "os.mkdir",
    "shutil.move",
    "shutil.copyfile",
)


def case(found: list[Target], seed: int, number: int) -> tuple[Target, str, bytes]:
    """The target, the name of the file that was damaged, and what became of it."""
    rng = random.Random(f"{seed}/{number}")
    target = rng.choices(found, [item.weight for item in found])[0]
    name = rng.choice(sorted(target.seeds))
    return target, name, mutate(target.kind, target.seeds[name], rng, list(target.seeds.values()))


class Watch:
    """Notes when reading does what no reader does: starts programs, writes outside of its box."""

    def __init__(self, box: Path) -> None:
        self.box = os.fspath(box)
        self.on = False
        self.seen: list[str] = []
        sys.addaudithook(self._hook)

    def _hook(self, event: str, arguments: tuple[Any, ...]) -> None:
        if not self.on:
            return
        if event == "open":
            path, _, flags = arguments
            writes = isinstance(flags, int) and flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
            if writes and not os.path.abspath(os.fsdecode(path)).startswith(self.box):
                self.seen.append(f"open {path!r} for writing")
        elif event.startswith(_FORBIDDEN) and not self._inside(event, arguments):
            self.seen.append(f"{event} {arguments!r:.200}")

    def _inside(self, event: str, arguments: tuple[Any, ...]) -> bool:
        """Files of its own."""
        if not event.startswith(
            ("os.re", "os.mkdir", "os.rmdir", "os.link", "os.chmod", "shutil.")
        ):
            return False
        paths = [item for item in arguments[:2] if isinstance(item, str | bytes | os.PathLike)]
        return all(os.path.abspath(os.fsdecode(p)).startswith(self.box) for p in paths)


def work(
    pipe: Connection,
    box: Path,
    foreign: dict[str, bytes],
    seed: int,
    numbers: list[int],
    limit_s: float,
) -> None:
    """Read the cases with these numbers; tells each number before it begins, then what came."""
    box.mkdir(parents=True, exist_ok=True)
    os.chdir(box)
    found = targets(box.parent / "small-store", foreign)
    for target in found:  # whole files first: what is loaded late is loaded now
        for name, data in target.seeds.items():
            target.read(box, name, data)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, used + MEMORY))
    watch = Watch(box)
    for number in numbers:
        pipe.send(("begin", number, None))
        target, name, data = case(found, seed, number)
        watch.on = True
        faulthandler.dump_traceback_later(limit_s, exit=True)
        try:
            target.read(box, name, data)
            outcome = "clean"
        except (InputError, StoreError) as error:
            outcome = "refused" if str(error).strip() else "refused without a word"
        except BaseException as error:
            where = traceback.extract_tb(error.__traceback__)[-1]
            said = f"{type(error).__name__}: {error}"[:200]
            outcome = f"{said} at {Path(where.filename).name}:{where.lineno}"
        finally:
            faulthandler.cancel_dump_traceback_later()
            watch.on = False
        if watch.seen:
            outcome = f"ran something: {watch.seen}"
            watch.seen.clear()
        pipe.send(("end", target.name, outcome))
    pipe.send(("done", None, None))
