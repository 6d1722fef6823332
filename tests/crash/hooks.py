"""Stands between this process and the C library where files are changed.

Python, HDF5 and FFmpeg all reach the system through the C library's `write`, `fsync`, `rename`
and so on. Their tables of imported functions are pointed at functions of ours, in this process
only: that needs neither a compiler nor a privilege, and sees what Python-level patches do not.
64-bit Linux.
"""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

LIBRARIES = ("python", "libhdf5", "libavformat", "libavutil")
_INT, _LONG, _SIZE = ctypes.c_int, ctypes.c_long, ctypes.c_size_t
_PATH, _POINTER = ctypes.c_char_p, ctypes.c_void_p
_SIGNATURES: dict[str, tuple[type, ...]] = {
    "write": (_INT, _POINTER, _SIZE),
    "pwrite": (_INT, _POINTER, _SIZE, _LONG),
    "open": (_PATH, _INT, _INT),
    "openat": (_INT, _PATH, _INT, _INT),
    "ftruncate": (_INT, _LONG),
    "fsync": (_INT,),
    "fdatasync": (_INT,),
    "rename": (_PATH, _PATH),
    "renameat": (_INT, _PATH, _INT, _PATH),
    "link": (_PATH, _PATH),
    "linkat": (_INT, _PATH, _INT, _PATH, _INT),
    "unlink": (_PATH,),
    "unlinkat": (_INT, _PATH, _INT),
    "mkdir": (_PATH, _INT),
    "mkdirat": (_INT, _PATH, _INT),
    "rmdir": (_PATH,),
    # answered as missing, so that nothing is written past the hooks
    "sendfile": (_INT, _INT, _POINTER, _SIZE),
    "copy_file_range": (_INT, _POINTER, _INT, _POINTER, _SIZE, _INT),
    "writev": (_INT, _POINTER, _INT),
    "pwritev": (_INT, _POINTER, _INT, _LONG),
}
_WIDE = {"pwrite", "open", "openat", "ftruncate", "sendfile", "pwritev"}
_AT_FDCWD, _AT_REMOVEDIR = -100, 0x200
_KINDS = {
    "pwrite": "write",
    "openat": "open",
    "fdatasync": "fsync",
    "renameat": "rename",
    "linkat": "link",
    "unlinkat": "unlink",
    "mkdirat": "mkdir",
    "ftruncate": "truncate",
}
WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC
_libc = ctypes.CDLL(None, use_errno=True)


@dataclass
class Call:
    """One call that changes a file; `go` makes it, `fail` refuses it.

    Attributes:
        kind: open, write, truncate, fsync, rename, link, unlink, mkdir or rmdir.
        path: what it changes, absolute.
        to: the new name of a rename or a link.
        flags: of an open.
        offset: where a write begins, bytes.
        size: bytes of a write, or the new length of a truncation.
    """

    kind: str
    path: str
    real: Callable[..., int]
    arguments: tuple[object, ...]
    to: str = ""
    flags: int = 0
    offset: int = 0
    size: int = 0
    address: int = 0

    @property
    def data(self) -> bytes:
        """The bytes of a write."""
        return ctypes.string_at(self.address, self.size)

    def go(self, size: int | None = None) -> int:
        """Make the call, a write with its first `size` bytes only; what it returns."""
        arguments = list(self.arguments)
        if size is not None:
            arguments[2] = size
        return int(self.real(*arguments))

    @staticmethod
    def fail(number: int) -> int:
        """Return the result of a system call that fails with error `number`."""
        ctypes.set_errno(number)
        return -1


Policy = Callable[[Call], int]
_kept: list[object] = []


def install(folder: Path, policy: Policy) -> None:
    """Ask `policy` about every call that changes something in `folder`, until the process ends.

    Raises:
        RuntimeError: not a 64-bit Linux, or nothing could be hooked.
    """
    if sys.platform != "linux" or sys.maxsize < 2**32:
        raise RuntimeError("files are watched on 64-bit Linux only")
    inside = os.fsencode(folder.resolve()).decode(errors="surrogateescape")
    hooks = {}
    for name, signature in _SIGNATURES.items():
        for alias in (name, f"{name}64") if name in _WIDE else (name,):
            real = getattr(_libc, alias, None)
            if real is None:
                continue
            wide = "write" in name or name in {"sendfile", "copy_file_range"}
            result = ctypes.c_ssize_t if wide else _INT
            real.argtypes, real.restype = signature, result
            kind = ctypes.CFUNCTYPE(result, *signature, use_errno=True)
            hook = kind(_answer(name, real, inside, policy))
            _kept.append(hook)
            hooks[alias.encode()] = ctypes.cast(hook, ctypes.c_void_p).value
    if not _patch(hooks):
        raise RuntimeError("no library's calls could be watched")


def _answer(name: str, real: Callable[..., int], inside: str, policy: Policy) -> Callable[..., int]:
    def answer(*arguments: object) -> int:
        try:
            if name in {"sendfile", "copy_file_range", "writev", "pwritev"}:
                return _refuse_fast(arguments, real, inside)
            call = _call(name, real, arguments)
            watched = call.path == inside or call.path.startswith(inside + "/")
            plain_read = call.kind == "open" and not call.flags & WRITING
            return policy(call) if watched and not plain_read else call.go()
        except BaseException as error:  # nothing above would see it
            os.write(2, f"hook of {name}: {error!r}\n".encode())
            os._exit(99)

    return answer


def _refuse_fast(arguments: tuple[object, ...], real: Callable[..., int], inside: str) -> int:
    target = os.readlink(f"/proc/self/fd/{arguments[0]}")
    if target.startswith(inside + "/"):
        return Call.fail(38)  # ENOSYS: callers fall back to read and write
    return int(real(*arguments))


def _call(name: str, real: Callable[..., int], arguments: tuple[object, ...]) -> Call:
    call = Call(_KINDS.get(name, name), "", real, arguments)
    first = arguments[0]
    if name in {"write", "pwrite", "ftruncate", "fsync", "fdatasync"}:
        assert isinstance(first, int)
        call.path = _of_handle(first)
        if call.kind == "write":
            call.address, call.size = int(arguments[1] or 0), int(arguments[2])  # type: ignore[call-overload]
            if name == "pwrite":
                call.offset = int(arguments[3])  # type: ignore[call-overload]
            elif call.path.startswith("/"):
                call.offset = _position(first)
        elif name == "ftruncate":
            call.size = int(arguments[1])  # type: ignore[call-overload]
    elif name.endswith("at"):
        call.path = _path(first, arguments[1])
        if name in {"renameat", "linkat"}:
            call.to = _path(arguments[2], arguments[3])
        elif name == "openat":
            call.flags = int(arguments[2])  # type: ignore[call-overload]
        elif name == "unlinkat" and int(arguments[2]) & _AT_REMOVEDIR:  # type: ignore[call-overload]
            call.kind = "rmdir"
    else:
        call.path = _path(_AT_FDCWD, first)
        if name in {"rename", "link"}:
            call.to = _path(_AT_FDCWD, arguments[1])
        elif name == "open":
            call.flags = int(arguments[1])  # type: ignore[call-overload]
    return call


def _of_handle(handle: int) -> str:
    try:
        return os.readlink(f"/proc/self/fd/{handle}")
    except OSError:
        return ""


def _position(handle: int) -> int:
    try:
        return os.lseek(handle, 0, os.SEEK_CUR)
    except OSError:
        return 0


def _path(folder: object, name: object) -> str:
    text = os.fsdecode(name)  # type: ignore[arg-type]
    if text.startswith("/"):
        return os.path.normpath(text)
    base = os.getcwd() if folder == _AT_FDCWD else _of_handle(int(folder))  # type: ignore[call-overload]
    return os.path.normpath(os.path.join(base, text))


# -- the tables of imported functions ------------------------------------------------------


class _Header(ctypes.Structure):
    _fields_ = [
        ("type", ctypes.c_uint32),
        ("flags", ctypes.c_uint32),
        ("offset", ctypes.c_uint64),
        ("vaddr", ctypes.c_uint64),
        ("paddr", ctypes.c_uint64),
        ("filesz", ctypes.c_uint64),
        ("memsz", ctypes.c_uint64),
        ("align", ctypes.c_uint64),
    ]


class _Object(ctypes.Structure):
    _fields_ = [
        ("base", ctypes.c_uint64),
        ("name", ctypes.c_char_p),
        ("headers", ctypes.POINTER(_Header)),
        ("count", ctypes.c_uint16),
    ]


class _Relocation(ctypes.Structure):
    _fields_ = [
        ("offset", ctypes.c_uint64),
        ("info", ctypes.c_uint64),
        ("addend", ctypes.c_int64),
    ]


_PT_DYNAMIC = 2
_STRTAB, _SYMTAB, _RELA, _RELASZ, _PLTRELSZ, _JMPREL = 5, 6, 7, 8, 2, 23


def _patch(hooks: dict[bytes, int | None]) -> int:
    """Point every entry of the names in `hooks` elsewhere; returns how many there were."""
    patched = 0
    for place, name in entries():
        if (hook := hooks.get(name)) is not None:
            _store(place, hook)
            patched += 1
    return patched


@cache
def entries() -> list[tuple[int, bytes]]:
    """Return the places of all entries and their names; forked processes need not look again."""
    found: list[tuple[int, int]] = []

    def visit(item: ctypes._Pointer[_Object], size: int, unused: int | None) -> int:
        one = item.contents
        name = os.path.basename(one.name or b"").decode(errors="replace")
        if name and not any(part in name for part in LIBRARIES):
            return 0
        for header in one.headers[: one.count]:
            if header.type == _PT_DYNAMIC:
                found.append((one.base, one.base + header.vaddr))
        return 0

    signature = ctypes.CFUNCTYPE(_INT, ctypes.POINTER(_Object), _SIZE, ctypes.c_void_p)
    _libc.dl_iterate_phdr(signature(visit), None)
    return [entry for base, dynamic in found for entry in _entries_of(base, dynamic)]


def _entries_of(base: int, dynamic: int) -> list[tuple[int, bytes]]:
    tags: dict[int, int] = {}
    while (tag := ctypes.c_int64.from_address(dynamic).value) != 0:
        tags[tag] = ctypes.c_uint64.from_address(dynamic + 8).value
        dynamic += 16
    if _STRTAB not in tags or _SYMTAB not in tags:
        return []
    names, symbols = (_absolute(tags[tag], base) for tag in (_STRTAB, _SYMTAB))
    found = []
    for table, length in ((_JMPREL, _PLTRELSZ), (_RELA, _RELASZ)):
        if table not in tags:
            continue
        count = tags[length] // ctypes.sizeof(_Relocation)
        for entry in (_Relocation * count).from_address(_absolute(tags[table], base)):
            symbol = entry.info >> 32
            if symbol:
                at = names + ctypes.c_uint32.from_address(symbols + 24 * symbol).value
                found.append((base + entry.offset, ctypes.string_at(at)))
    return found


def _absolute(address: int, base: int) -> int:
    return address if address >= base else base + address


def _store(address: int, value: int) -> None:
    page = os.sysconf("SC_PAGESIZE")
    start = address // page * page
    protect = _libc.mprotect
    protect.argtypes = (ctypes.c_void_p, _SIZE, _INT)
    if protect(start, page, 3) != 0:  # stays writable: other entries share the page
        raise OSError(ctypes.get_errno(), "mprotect")
    ctypes.c_uint64.from_address(address).value = value
