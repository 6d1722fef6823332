"""Listening sockets of a process and its children, from the kernel's tables (Linux)."""

from __future__ import annotations

import ipaddress
import os
import struct
from contextlib import suppress
from pathlib import Path

_LISTEN = "0A"


def listening(pid: int) -> set[str]:
    """The addresses of all TCP ports on which a process and its children listen."""
    sockets: set[str] = set()
    for each in [pid, *_children(pid)]:
        with suppress(OSError):
            for handle in Path(f"/proc/{each}/fd").iterdir():
                with suppress(OSError):
                    sockets.add(os.readlink(handle).removeprefix("socket:[").removesuffix("]"))
    found = set()
    for name in ("tcp", "tcp6"):
        for line in Path(f"/proc/net/{name}").read_text().splitlines()[1:]:
            fields = line.split()
            if fields[3] == _LISTEN and fields[9] in sockets:
                found.add(_address(fields[1].partition(":")[0]))
    return found


def _children(pid: int) -> list[int]:
    found = []
    with suppress(OSError):
        for task in Path(f"/proc/{pid}/task").iterdir():
            for child in (task / "children").read_text().split():
                found += [int(child), *_children(int(child))]
    return found


def _address(text: str) -> str:
    """An address as the kernel writes it: words of 32 bits in the machine's own order."""
    words = [int(text[k : k + 8], 16) for k in range(0, len(text), 8)]
    return str(ipaddress.ip_address(struct.pack(f"={len(words)}I", *words)))
