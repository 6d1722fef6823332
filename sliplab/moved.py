"""Names of packages and modules that have moved: code that imports the old ones still works."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

MOVED = {
    "sliplab.rigs.testing": "sliplab.plugins.driver_kit",
    "sliplab.analysis.bench": "sliplab.plugins.bench",
    "sliplab.plugins.bench.alarms": "sliplab.analysis.detectors.alarms",
    "sliplab.plugins.bench.interface": "sliplab.analysis.detectors.detector",
    "sliplab.plugins.bench.registry": "sliplab.analysis.detectors.registry",
    "sliplab.protocols.conditions": "sliplab.protocols.model",
    "sliplab.flows.planning.schema": "sliplab.flows.planning.json_schemas",
    "sliplab.rigs.mock.faults": "sliplab.plugins.simulation.fault_book",
    "sliplab.rigs.mock.fault_settings": "sliplab.rigs.core.faults",
    "sliplab.rigs.mock.fault_kinds": "sliplab.rigs.core.faults",
    "sliplab.flows.server": "sliplab.plugins.web.server",
    "sliplab.flows.web": "sliplab.plugins.web.pages",
    "sliplab.rigs.loopback": "sliplab.plugins.loopback",
    "sliplab.storage.formats.adapted": "sliplab.plugins.adapters.importing",
    "sliplab.storage.formats.adapted_trials": "sliplab.plugins.adapters.trials",
    "sliplab.rigs.devices.uvc": "sliplab.plugins.uvc",
    "sliplab.rigs.devices.ati_net_ft": "sliplab.plugins.ati_net_ft",
    "sliplab.analysis.evaluation.classes": "sliplab.plugins.classes.evaluation",
    "sliplab.storage.schema.classes": "sliplab.plugins.classes.document",
    "sliplab.rigs.devices.settings": "sliplab.rigs.device_section",
    "sliplab.rigs.mock": "sliplab.plugins.simulation",
    "sliplab.rigs.scene": "sliplab.plugins.simulation.scene",
    "sliplab.flows.scene_runs": "sliplab.plugins.simulation.scene_runs",
    "sliplab.rigs.devices": "sliplab.plugins.devices",
    "sliplab.rigs.levels": "sliplab.plugins.simulation.levels",
    "sliplab.analysis.metrics.paired": "sliplab.plugins.studies.detector.paired",
    "sliplab.analysis.metrics.pareto": "sliplab.plugins.studies.detector.pareto",
    "sliplab.storage.workers": "sliplab.storage.spawn_context",
}
"""Old names of packages and modules, and what they are now."""


class _Alias(Loader):
    """Loads a module by its new name."""

    def __init__(self, now: str) -> None:
        self._module = import_module(now)
        self._spec = self._module.__spec__

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        return self._module

    def exec_module(self, module: ModuleType) -> None:
        module.__spec__ = self._spec  # which the import of the old name has replaced


class _Finder(MetaPathFinder):
    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        for old, new in MOVED.items():
            if name == old or name.startswith(f"{old}."):
                return ModuleSpec(name, _Alias(new + name.removeprefix(old)))
        return None


def install() -> None:
    """Look for modules among those that have moved, first.

    Python's own finder would find them again by the new package's path, as other modules.
    """
    if not any(isinstance(each, _Finder) for each in sys.meta_path):
        sys.meta_path.insert(0, _Finder())
