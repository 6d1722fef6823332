"""What arms say of themselves, for a look at the rig before a campaign; nothing moves."""

from __future__ import annotations

from sliplab.rigs.arms import ur_ports
from sliplab.rigs.arms.abb_rws import WebServices
from sliplab.rigs.capabilities import DeviceHealth

UNKNOWN = "unknown"
PORT_S = 1.0
"""For each question to a dashboard, s."""


def ur_health(host: str, notes: tuple[str, ...]) -> DeviceHealth:
    """Of a Universal Robots controller, by its dashboard (e-Series guide, PolyScope 5).

    Raises:
        PortError: it does not answer.
    """

    def ask(request: str) -> str:
        answer = ur_ports.dashboard(host, request, PORT_S)
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


def abb_health(web: WebServices, notes: tuple[str, ...]) -> DeviceHealth:
    """Of an ABB controller, by its web services (RobotWare 6).

    Args:
        web: a session of them.
        notes: what the driver has to say besides.

    Raises:
        WebError: it does not answer.
    """
    system, identity, status = web.about("rw/system"), web.about("ctrl/identity"), web.status()
    return DeviceHealth(
        device="arm",
        model=identity.get("ctrl-name", UNKNOWN),
        serial=identity.get("ctrl-id", UNKNOWN),
        firmware=f"RobotWare {system.get('rwversion', UNKNOWN)}",
        temperature_c=None,
        clock="the controller's, in every EGM pose",
        notes=(f"mode {status.mode}", f"controller {status.controller}", *notes),
    )


def socket_health(info: str) -> DeviceHealth:
    """Of the server that some labs run on an ABB controller, by what it says of itself."""
    return DeviceHealth(
        device="arm",
        model=info or UNKNOWN,
        serial=UNKNOWN,
        firmware=UNKNOWN,
        temperature_c=None,
        clock="the host's: this server tells no time",
    )
