"""The two text ports of a Universal Robots controller, with a timeout on every wait.

29999 is the dashboard: one line per request and per answer (the vendor's dashboard guide for
e-Series, PolyScope 5). 30003 accepts scripts: a new script ends the running one. Neither needs a
program on the controller, so both remain available when the control client is lost.
"""

from __future__ import annotations

import contextlib
import socket

from sliplab.plugins.devices.ur.settings import DASHBOARD_PORT, SCRIPT_PORT
from sliplab.rigs.core.capabilities import UNKNOWN, DeviceHealth
from sliplab.rigs.core.network import BoundedSocket

HEALTH_S = 1.0
"""Timeout of each dashboard request about the arm's health, s."""
_LONGEST_LINE = 10_000
"""Longest answer, bytes; normal answers have about 100."""


class PortError(RuntimeError):
    """A text port did not accept or answer a request in time."""


def dashboard(host: str, request: str, within_s: float) -> str:
    """Send one request to the dashboard and return its answer without the newline.

    Raises:
        PortError: no connection or no answer within `within_s` seconds.
    """
    try:
        with BoundedSocket.open(host, DASHBOARD_PORT, within_s) as link:
            _line(link)  # the greeting
            link.sendall(request.encode() + b"\n")
            return _line(link)
    except OSError as error:
        raise PortError(f"dashboard of {host}: '{request}': {error}") from None


def send_script(host: str, script: str, within_s: float) -> None:
    """Send a script to the controller, which ends the program that runs there.

    Raises:
        PortError: it could not be sent within `within_s` seconds.
    """
    try:
        with socket.create_connection((host, SCRIPT_PORT), within_s) as link:
            link.sendall(script.encode())
            link.shutdown(socket.SHUT_WR)
    except OSError as error:
        raise PortError(f"script port of {host}: {error}") from None


def end_program(host: str, deceleration_m_s2: float, within_s: float) -> bool:
    """End the controller's program, and any move with it, over one port or the other.

    Takes at most twice `within_s`.

    Returns:
        whether the controller confirmed it. A script that was sent may end it too, but without a
        confirmation: only a pose stream can show it.
    """
    try:
        if dashboard(host, "stop", within_s) == "Stopped":
            return True
    except PortError:
        pass  # the other port may still accept a script
    with contextlib.suppress(PortError):
        send_script(host, f"stopl({deceleration_m_s2:g})\n", within_s)
    return False


def _line(link: BoundedSocket) -> str:
    data = b""
    while not data.endswith(b"\n"):
        data += link.receive(4096)
        if len(data) > _LONGEST_LINE:
            raise ConnectionError("the answer is not a line of text")
    return data.decode(errors="replace").strip()


def read_health(host: str, notes: tuple[str, ...]) -> DeviceHealth:
    """Return the health report of a UR controller from its dashboard (PolyScope 5).

    Raises:
        PortError: it does not answer.
    """

    def ask(request: str) -> str:
        answer = dashboard(host, request, HEALTH_S)
        return UNKNOWN if answer.startswith("could not understand") else answer

    remote = "in remote control" if ask("is in remote control") == "true" else "NOT remote control"
    return DeviceHealth(
        device="arm",
        model=ask("get robot model"),
        serial=ask("get serial number"),
        firmware=ask("PolyscopeVersion"),
        temperature_c=None,
        clock="the controller's, in every pose",
        notes=(remote, *notes),
    )
