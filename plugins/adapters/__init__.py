"""Data sets of other labs, read as an adapter file describes them."""

from __future__ import annotations

from sliplab.protocols.plugin import Plugin

PLUGIN = Plugin(hooks={"import_adapted": "sliplab.plugins.adapters.imports:import_adapted"})
