"""Settings of a camera that is not there: they know what is simulated, and refuse the rest.

pylon's emulation holds most settings without obeying them, and its user set changes nothing. A
stand-in lays these over it: a value that its pictures do not show is refused as a camera refuses
one, and what somebody is said to have left in the camera stays in force until it is written.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any


class Setting:
    """A setting with the values that are simulated.

    Args:
        name: GenICam's.
        factory: value that the maker's user set has; it is simulated.
        choices: values of an enumeration or a switch that are simulated.
        limits: least and most of a number that are simulated; `factory` alone where neither.
        stored: value that somebody left in the camera, simulated or not.
        node: the emulation's setting, written as well where it has one.
    """

    def __init__(
        self,
        name: str,
        factory: Any,
        choices: tuple[Any, ...] = (),
        limits: tuple[float, float] | None = None,
        stored: Any = None,
        node: Any = None,
    ) -> None:
        self.name, self._factory, self._node = name, factory, node
        self._choices = choices or (() if limits else (factory,))
        self._limits = limits or (factory, factory)
        self._left = factory if stored is None else stored
        self._value = self._left

    @property
    def Symbolics(self) -> tuple[str, ...]:
        """Values of an enumeration."""
        return tuple(choice for choice in self._choices if isinstance(choice, str))

    @property
    def Min(self) -> Any:
        """The least of a number."""
        return self._limits[0]

    @property
    def Max(self) -> Any:
        """The most of a number."""
        return self._limits[1]

    @property
    def Value(self) -> Any:
        """What is in force."""
        return self._value

    @Value.setter
    def Value(self, value: Any) -> None:
        from pypylon import genicam

        if not self._simulates(value):
            raise genicam.InvalidArgumentException(self.refusal(value))
        if self._node is not None and self._node.GetAccessMode() == genicam.RW:
            self._node.Value = value
        self._value = value

    def GetAccessMode(self) -> int:
        """Can be read and written."""
        from pypylon import genicam

        mode: int = genicam.RW
        return mode

    @property
    def simulated(self) -> bool:
        """Whether what is in force is what the pictures show."""
        return self._simulates(self._value)

    def refusal(self, value: Any) -> str:
        """Why a value is refused."""
        low, high = self._limits
        those = " or ".join(map(str, self._choices)) if self._choices else f"{low} to {high}"
        return f"the stand-in simulates {self.name} {those}, not {value}"

    def load(self, stored: bool) -> None:
        """Take the value of the maker's user set, or what somebody stored."""
        self._value = self._left if stored else self._factory

    def _simulates(self, value: Any) -> bool:
        if self._choices:
            return value in self._choices
        return bool(self._limits[0] <= value <= self._limits[1])


class Selected:
    """A switch for each choice of a selector, off at first."""

    def __init__(self, selector: Setting) -> None:
        self._selector, self._on = selector, set[Any]()

    @property
    def Value(self) -> bool:
        """Of what is selected now."""
        return self._selector.Value in self._on

    @Value.setter
    def Value(self, on: bool) -> None:
        (self._on.add if on else self._on.discard)(self._selector.Value)

    @property
    def on(self) -> frozenset[Any]:
        """All choices that are switched on."""
        return frozenset(self._on)

    def GetAccessMode(self) -> int:
        """Can be read and written."""
        return self._selector.GetAccessMode()


class Command:
    """A command that does something of ours, and then the emulation's if there is one."""

    def __init__(self, work: Callable[[], None], node: Any = None) -> None:
        self._work, self._node = work, node

    def Execute(self) -> None:
        """Do it."""
        self._work()
        if self._node is not None:
            self._node.Execute()

    def IsDone(self) -> bool:
        """Whether it has ended."""
        return True

    def GetAccessMode(self) -> int:
        """Can be given."""
        from pypylon import genicam

        mode: int = genicam.WO
        return mode


class ReadOnly:
    """A value that the camera works out."""

    def __init__(self, read: Callable[[], float]) -> None:
        self._read = read

    @property
    def Value(self) -> float:
        """What it is now."""
        return self._read()

    def GetAccessMode(self) -> int:
        """Can be read."""
        from pypylon import genicam

        mode: int = genicam.RO
        return mode


class NodeMap:
    """Settings of an emulated camera with others laid over them."""

    def __init__(self, node_map: Any, own: Mapping[str, Any]) -> None:
        self._map, self._own = node_map, own

    def GetNode(self, name: str) -> Any:
        """A setting by its name; None where there is none."""
        own = self._own.get(name)
        return own if own is not None else self._map.GetNode(name)
