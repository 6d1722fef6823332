"""A trained network for other programs and chips: ONNX, a Speck, a model card."""

from __future__ import annotations

from sliplab.protocols.plugin import Plugin

PLUGIN = Plugin(commands={"export-model": "sliplab.plugins.deploy.command:app"})
