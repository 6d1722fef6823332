"""Slip on rigs without events: an ordinary classifier on the displacements of markers in frames."""

from __future__ import annotations

from sliplab.protocols.plugin import Plugin

PLUGIN = Plugin(problems={"markers": "sliplab.plugins.markers.problem:slip_by_markers"})
