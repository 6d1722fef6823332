"""What plug-ins add: commands, documents, and functions at named places of the core.

A plug-in is a package with a `Plugin`. Those that ship are the packages in `sliplab.plugins`, each
with its `PLUGIN`. Other distributions name theirs in the group of entry points `sliplab.plugins`:

    [project.entry-points."sliplab.plugins"]
    my_subject = "my_package:PLUGIN"

A declaration imports nothing; what it names is imported when it is used. A plug-in that cannot be
imported does not affect others.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from pkgutil import iter_modules
from typing import Any

from sliplab.protocols.plugins import PluginError, import_foreign

GROUP = "sliplab.plugins"


@dataclass(frozen=True)
class Plugin:
    """What a package adds. Each value is ``module:object``.

    Attributes:
        commands: Typer applications by the first word of a command, or by the group that they
            extend, such as ``calibrate``.
        documents: by kind, models of the JSON documents that it writes
            (`storage.schema.document.Document`), each with the title of its schema.
        formats: formats of recordings (`storage.formats.format.Format`) by name.
        hooks: functions that the core calls, by the name of the place; docs/architecture.md lists
            the places.
    """

    commands: Mapping[str, str] = field(default_factory=dict)
    documents: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    formats: Mapping[str, str] = field(default_factory=dict)
    hooks: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Plugins:
    """Plug-ins that are installed.

    Attributes:
        found: by name, sorted.
        faults: why a plug-in cannot be used, one line each.
    """

    found: Mapping[str, Plugin]
    faults: tuple[str, ...]

    def commands(self) -> dict[str, list[str]]:
        """Return places of Typer applications by the first word of their commands."""
        words: dict[str, list[str]] = {}
        for plugin in self.found.values():
            for word, place in plugin.commands.items():
                words.setdefault(word, []).append(place)
        return words

    def documents(self) -> dict[str, tuple[str, str]]:
        """Return places of documents' models, with titles, by kind.

        The first plug-in of a kind has it.
        """
        kinds: dict[str, tuple[str, str]] = {}
        for plugin in self.found.values():
            kinds = {**plugin.documents, **kinds}
        return kinds

    def formats(self) -> dict[str, str]:
        """Return places of formats by name. The first plug-in that declares a name has it."""
        places: dict[str, str] = {}
        for plugin in self.found.values():
            places |= {name: each for name, each in plugin.formats.items() if name not in places}
        return places

    def hooks(self, name: str) -> Iterator[Any]:
        """Import and yield the functions of a place, in the order of the plug-ins' names.

        Raises:
            PluginError: one of them cannot be imported.
        """
        for plugin in self.found.values():
            if name in plugin.hooks:
                yield import_foreign(plugin.hooks[name])


@cache
def plugins() -> Plugins:
    """Return the plug-ins that are installed; their declarations are imported."""
    found: dict[str, Plugin] = {}
    faults = []
    for name, place in _places():
        try:
            plugin = import_foreign(place)
            if not isinstance(plugin, Plugin):
                raise PluginError(f"{place} is a {type(plugin).__name__}, not a Plugin")
        except PluginError as error:
            faults.append(f"the plug-in {name} cannot be used: {error}")
        else:
            found.setdefault(name, plugin)  # another package cannot replace one that ships
    return Plugins(found, tuple(faults))


def _places() -> list[tuple[str, str]]:
    """Return names and places, those that ship first: by their folders, so a checkout is enough."""
    folders = iter_modules(import_module(GROUP).__path__)
    shipped = [(each.name, f"{GROUP}.{each.name}:PLUGIN") for each in folders]
    others = [(point.name, point.value) for point in entry_points(group=GROUP)]
    return sorted(shipped) + sorted(others)
