"""Devices on the network: a check that a port answers, and the lock of an arm."""

from __future__ import annotations

import socket

from sliplab.rigs.core.arm_settings import BaseArmSettings

ANSWER_S = 1.0
"""Timeout of a connection, s."""


def answers(host: str, port: int) -> str | None:
    """Return None if a port accepts a TCP connection within `ANSWER_S`, else the reason."""
    try:
        with socket.create_connection((host, port), ANSWER_S):
            return None
    except OSError as error:
        return f"{host}:{port}: {error}; check its power, its cable and the address"


def arm_lock(settings: BaseArmSettings) -> dict[str, str]:
    """Return the lock of an arm: one program at a time at a controller's address."""
    host = settings.host.lower()
    return {f"arm-{host}": f"the arm at {host}"}
