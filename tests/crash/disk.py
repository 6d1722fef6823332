"""A disk as a model: what a program sees, and what a power cut leaves of it.

Bytes of a file are safe once it was flushed; the entries of a folder once the folder was. What was
not flushed may be on the disk or not, each piece by itself, a write even in part. A rename is on
the disk in both folders or in neither, as file systems with a journal hold it.
"""

from __future__ import annotations

import copy
import random
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

from tests.crash.policies import Done

Tree = dict[str, bytes | None]
"""By path inside the watched folder: a file's bytes, or None for a folder."""


@dataclass
class File:
    """Bytes as seen, as safe, and the changes that lie between."""

    live: bytearray = field(default_factory=bytearray)
    safe: bytearray = field(default_factory=bytearray)
    pending: list[Done] = field(default_factory=list)


@dataclass
class Folder:
    """Entries as seen, and as safe."""

    live: dict[str, File | Folder] = field(default_factory=dict)
    safe: dict[str, File | Folder] = field(default_factory=dict)


Node = File | Folder


@dataclass
class Move:
    """A change of entries that is not safe yet: `node` leaves one place, or comes to another."""

    node: Node
    out_of: tuple[Folder, str] | None
    into: tuple[Folder, str] | None


class Disk:
    """One watched folder, from which recorded calls are made one after the other."""

    def __init__(self, root: Path) -> None:
        self._root = str(root)
        self._top = Folder()
        self._moves: list[Move] = []
        for path in sorted(root.rglob("*")) if root.is_dir() else []:
            folder, name = self._place(str(path))
            data = None if path.is_dir() else path.read_bytes()
            node = Folder() if data is None else File(bytearray(data), bytearray(data))
            folder.live[name] = folder.safe[name] = node

    def _place(self, path: str) -> tuple[Folder, str]:
        parts = PurePosixPath(path).relative_to(self._root).parts
        folder = self._top
        for part in parts[:-1]:
            inner = folder.live[part]
            assert isinstance(inner, Folder)
            folder = inner
        return folder, parts[-1]

    def _node(self, path: str) -> Node | None:
        if path == self._root:
            return self._top
        try:
            folder, name = self._place(path)
        except KeyError:
            return None
        return folder.live.get(name)

    def make(self, call: Done) -> None:
        """Make one recorded call."""
        node = self._node(call.path)
        if call.kind in {"write", "truncate"}:
            if isinstance(node, File):
                _change(node.live, call, 1.0)
                node.pending.append(call)
        elif call.kind == "fsync":
            self._flush(node)
        elif call.path == self._root:
            pass  # the watched folder itself, which is there
        elif call.kind in {"create", "mkdir"}:
            self._move(File() if call.kind == "create" else Folder(), None, call.path)
        elif call.kind in {"unlink", "rmdir"}:
            assert node is not None
            self._move(node, call.path, None)
        elif call.kind in {"rename", "link"}:
            assert node is not None
            self._move(node, call.path if call.kind == "rename" else None, call.to)
        else:
            raise AssertionError(f"no such call: {call.kind}")

    def _move(self, node: Node, out_of: str | None, into: str | None) -> None:
        move = Move(
            node,
            None if out_of is None else self._place(out_of),
            None if into is None else self._place(into),
        )
        if move.out_of is not None:
            del move.out_of[0].live[move.out_of[1]]
        if move.into is not None:
            move.into[0].live[move.into[1]] = node
        self._moves.append(move)

    def _flush(self, node: Node | None) -> None:
        if isinstance(node, File):
            node.safe, node.pending = bytearray(node.live), []
            return
        waiting: list[Move] = []
        followed: set[int] = set()
        for move in reversed(self._moves):
            places = [place[0] for place in (move.out_of, move.into) if place is not None]
            # what happened to a node before a flushed change is on the disk as well
            if any(folder is node for folder in places) or id(move.node) in followed:
                followed.add(id(move.node))
            else:
                waiting.insert(0, move)
        kept = {id(move) for move in waiting}
        for move in self._moves:
            if id(move) not in kept:
                _settle(move)
        self._moves = waiting

    def seen(self) -> Tree:
        """Return the state that a program sees now, which a killed one leaves behind."""
        return _tree(self._top, safe=False)

    def left(self) -> Tree:
        """Return the state after a power cut that loses everything not flushed."""
        return _tree(self._top, safe=True)

    def torn(self, rng: random.Random) -> Tree:
        """Return the state after a power cut that loses some unflushed data and tears writes."""
        other = copy.deepcopy(self)
        lost: set[int] = set()  # nodes of which a change is lost, and so all that came after it
        for move in other._moves:
            if id(move.node) in lost or rng.random() >= 0.5:
                lost.add(id(move.node))
            else:
                _settle(move)
        for file in _files(other._top):
            for call in file.pending:
                if rng.random() < 0.6:
                    _change(file.safe, call, rng.choice((1.0, 1.0, rng.random())))
        return _tree(other._top, safe=True)


def _change(data: bytearray, call: Done, share: float) -> None:
    if call.kind == "truncate":
        del data[call.size :]
        data.extend(bytes(call.size - len(data)))
        return
    piece = call.data[: int(len(call.data) * share)]
    data.extend(bytes(max(0, call.offset - len(data))))
    data[call.offset : call.offset + len(piece)] = piece


def _settle(move: Move) -> None:
    if move.out_of is not None:
        folder, name = move.out_of
        if folder.safe.get(name) is move.node:
            del folder.safe[name]
    if move.into is not None:
        folder, name = move.into
        folder.safe[name] = move.node


def _files(folder: Folder) -> list[File]:
    found: dict[int, File] = {}
    waiting: list[Node] = [folder]
    while waiting:
        node = waiting.pop()
        if isinstance(node, File):
            found[id(node)] = node
        else:
            waiting += [*node.live.values(), *node.safe.values()]
    return list(found.values())


def _tree(folder: Folder, *, safe: bool, above: str = "") -> Tree:
    tree: Tree = {}
    for name, node in (folder.safe if safe else folder.live).items():
        if isinstance(node, File):
            tree[above + name] = bytes(node.safe if safe else node.live)
        else:
            tree[above + name] = None
            tree |= _tree(node, safe=safe, above=f"{above}{name}/")
    return tree


def write_tree(tree: Tree, root: Path) -> None:
    """Put a tree into a folder, which is made."""
    root.mkdir(parents=True)
    for name, data in tree.items():
        if data is None:
            (root / name).mkdir(parents=True, exist_ok=True)
        else:
            (root / name).parent.mkdir(parents=True, exist_ok=True)
            (root / name).write_bytes(data)
