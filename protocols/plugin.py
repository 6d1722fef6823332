"""What plug-ins add to the core, each by its declaration.

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
from importlib.metadata import EntryPoint, entry_points
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
        studies: by name, studies (`analysis.study.Study`): each is a command with a result and a
            page. One of a group, such as ``calibrate``, has the name ``GROUP NAME``.
        documents: by kind, further models of the JSON documents that it writes
            (`storage.schema.document.Document`), each with the title of its schema. One of a kind
            ``NAME-summary`` is a report's summary, which other reports are compared with.
        detectors: detectors of slip (`analysis.detectors.detector.Detector`), by name: classes or
            functions without arguments.
        drivers: drivers of devices (`rigs.core.driver.Driver`), by name. A package that has only
            drivers names them in the group of entry points `sliplab.drivers` instead.
        sections: sections of the report by name (`analysis.report.plugin_sections.ReportSection`).
        problems: by name, functions that return a problem (`analysis.problem.Problem`), or None,
            given the labels of a store and some of its campaigns.
        searches: by name, functions that return a search of a study (`analysis.study_plan.Search`)
            or None, given the study's plan and its run requests.
        formats: formats of recordings (`storage.formats.format.Format`) by name.
        exports: forms of `sliplab export` (`flows.exports.Export`) by name.
        hooks: functions that the core calls, by the name of the place; docs/architecture.md lists
            the places.
    """

    commands: Mapping[str, str] = field(default_factory=dict)
    studies: Mapping[str, str] = field(default_factory=dict)
    documents: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    detectors: Mapping[str, str] = field(default_factory=dict)
    drivers: Mapping[str, str] = field(default_factory=dict)
    sections: Mapping[str, str] = field(default_factory=dict)
    problems: Mapping[str, str] = field(default_factory=dict)
    searches: Mapping[str, str] = field(default_factory=dict)
    formats: Mapping[str, str] = field(default_factory=dict)
    exports: Mapping[str, str] = field(default_factory=dict)
    hooks: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Plugins:
    """Plug-ins that are installed.

    Attributes:
        found: by name, sorted.
        packages: the distribution of each, and its version, by name.
        faults: why a plug-in cannot be used, one line each.
    """

    found: Mapping[str, Plugin]
    packages: Mapping[str, str]
    faults: tuple[str, ...]

    def commands(self) -> dict[str, list[str]]:
        """Return places of Typer applications and studies by the first word of their commands."""
        words: dict[str, list[str]] = {}
        for plugin in self.found.values():
            for name, place in (*plugin.commands.items(), *plugin.studies.items()):
                words.setdefault(name.split(" ")[0], []).append(place)
        return words

    def declared(self, what: str) -> dict[str, Any]:
        """Return what plug-ins declare, by name; the first plug-in that declares a name has it.

        Args:
            what: an attribute of `Plugin` with one place a name, such as ``sections``.
        """
        places: dict[str, Any] = {}
        for plugin in self.found.values():
            for name, place in getattr(plugin, what).items():
                places.setdefault(name, place)
        return places

    def hook(self, name: str) -> Any:
        """Import and return the function of a place that one plug-in fills: the first that does.

        Raises:
            PluginError: none does, or it cannot be imported.
        """
        for function in self.hooks(name):
            return function
        raise PluginError(f"no plug-in fills the place {name}")

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
    own = shipped()
    points = sorted((each.name, each.value, package_of(each)) for each in entry_points(group=GROUP))
    others = _declared(points)
    return Plugins(  # another package cannot replace one that ships
        {**own.found, **{k: v for k, v in others.found.items() if k not in own.found}},
        {**others.packages, **own.packages},
        own.faults + others.faults,
    )


@cache
def shipped() -> Plugins:
    """Return the plug-ins that ship. They are found by their folders, so a checkout is enough."""
    names = sorted(each.name for each in iter_modules(import_module(GROUP).__path__))
    return _declared([(name, f"{GROUP}.{name}:PLUGIN", "sliplab") for name in names])


def _declared(places: list[tuple[str, str, str]]) -> Plugins:
    """Import declarations, given names, places and distributions."""
    found: dict[str, Plugin] = {}
    packages: dict[str, str] = {}
    faults = []
    for name, place, package in places:
        try:
            plugin = import_foreign(place)
            if not isinstance(plugin, Plugin):
                raise PluginError(f"{place} is a {type(plugin).__name__}, not a Plugin")
        except PluginError as error:
            faults.append(f"the plug-in {name} cannot be used: {error}")
        else:
            found.setdefault(name, plugin)
            packages.setdefault(name, package)
    return Plugins(found, packages, tuple(faults))


def package_of(point: EntryPoint) -> str:
    """Return the distribution of an entry point, and its version."""
    return "" if point.dist is None else f"{point.dist.name} {point.dist.version}"
