"""A trained network for other programs and chips: ONNX, a Speck, a model card."""

from __future__ import annotations

from sliplab.protocols.plugin import Plugin

_COMMAND = "sliplab.plugins.deploy.command"
PLUGIN = Plugin(
    commands={"export-model": f"{_COMMAND}:app"},
    exports={"onnx": f"{_COMMAND}:ONNX", "card": f"{_COMMAND}:CARD", "nir": f"{_COMMAND}:NIR"},
)
