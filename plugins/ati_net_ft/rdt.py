"""Protocol of an ATI Net F/T sensor: records of its Raw Data Transfer, and its configuration page.

RDT is UDP, big-endian. A request is 8 bytes: `u16 0x1234, u16 command, u32 count`, a count of 0
being without end. A record is 36 bytes: `u32 rdt_sequence, u32 ft_sequence, u32 status` and six
`i32` counts, Fx Fy Fz Tx Ty Tz. `rdt_sequence` numbers the records of one request from 1;
`ft_sequence` counts the sensor's own samples and continues from request to request. The layout is
that of the maker's manual 9620-05-NET FT; the status bits are those of 9610-05-Ethernet Axia, of
which a Net Box shares the error bit and the latch of a monitor condition.
"""

from __future__ import annotations

import struct
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

HEADER = 0x1234
REQUEST = struct.Struct(">HHI")
STOP, STREAM, SET_BIAS = 0x0000, 0x0002, 0x0042
SEQUENCES = struct.Struct(">III")
RECORD = np.dtype(
    [
        ("rdt", ">u4"),
        ("ft", ">u4"),
        ("status", ">u4"),
        ("force", ">i4", 3),
        ("torque", ">i4", 3),
    ]
)
ERROR, MONITOR = 1 << 31, 1 << 16
"""Any error; and the latch of a monitor condition set by the user, which is not an error."""
BITS = {
    0: "internal temperature out of range",
    1: "supply voltage out of range",
    2: "broken gauge",
    5: "an error without a bit",
    7: "calibration not accessible",
    27: "gauge out of range",
    28: "simulated error",
    29: "wrong checksum of the calibration",
    30: "force or torque out of range",
}
PAGE, RATE_PAGE, FILTER_PAGE = "netftapi2.xml", "comm.cgi?comrdtrate=", "setting.cgi?setuserfilter="
NEWTONS = {"N": 1.0, "kN": 1e3, "lbf": 4.4482216152605, "klbf": 4448.2216152605, "kgf": 9.80665}
NEWTON_METRES = {
    "N-m": 1.0,
    "Nm": 1.0,
    "N-mm": 1e-3,
    "Nmm": 1e-3,
    "kN-m": 1e3,
    "kNm": 1e3,
    "lbf-in": 0.1129848290276167,
    "lbf-ft": 1.3558179483314004,
    "kgf-cm": 0.0980665,
}


def request(command: int, count: int = 0) -> bytes:
    """Return the bytes of one request."""
    return REQUEST.pack(HEADER, command, count)


def status_problem(status: int) -> str | None:
    """Return the errors in a status word as text; None where there is none."""
    if not status & ERROR or status == ERROR | MONITOR:
        return None
    named = [text for bit, text in BITS.items() if status >> bit & 1]
    return f"status 0x{status:08X}: {', '.join(named) or 'see its manual'}"


def records(data: bytes) -> npt.NDArray[Any]:
    """Return the records in a run of whole ones."""
    return np.frombuffer(data, RECORD)


@dataclass(frozen=True)
class ConfigurationPage:
    """The configuration page of a sensor."""

    counts_per_n: float
    counts_per_nm: float
    rate_hz: int | None
    filter_number: int | None
    serial: str
    product: str
    firmware: str

    @staticmethod
    def parse(text: bytes) -> ConfigurationPage:
        """Read a page.

        Raises:
            ValueError: it is no such page, or lacks the calibration; the text says which part.
        """
        if len(text) > 1 << 20 or b"<!" in text:  # no entities are expanded
            raise ValueError("is no configuration page")
        try:
            root = ElementTree.fromstring(text)
        except ElementTree.ParseError as error:
            raise ValueError(f"is no configuration page: {error}") from None
        found = {
            part.tag.rsplit("}", 1)[-1].lower(): (part.text or "").strip() for part in root.iter()
        }
        if found.get("comrdte", "1").lower() in {"0", "disabled"}:
            raise ValueError("says that RDT is switched off; switch it on there")
        return ConfigurationPage(
            _calibration(found, "cfgcpf", "scfgfu", NEWTONS),
            _calibration(found, "cfgcpt", "scfgtu", NEWTON_METRES),
            _whole(found.get("comrdtrate")),
            _whole(found.get("setuserfilter")),
            found.get("setserial", ""),
            found.get("prodname", ""),
            found.get("setfwver", ""),
        )


def _calibration(found: dict[str, str], counts: str, unit: str, factors: dict[str, float]) -> float:
    """Return counts of an SI unit.

    Raises:
        ValueError: the page lacks them, or has a unit that is not known.
    """
    try:
        per_unit = float(found[counts])
        factor = factors[found[unit]]
    except KeyError as error:
        name = str(error.args[0])
        if name in {counts, unit}:
            raise ValueError(f"lacks <{name}>") from None
        raise ValueError(f"<{unit}> is {name!r}; known: {', '.join(factors)}") from None
    except ValueError:
        raise ValueError(f"<{counts}> is {found[counts]!r}, no number") from None
    if not 0 < per_unit < float("inf"):
        raise ValueError(f"<{counts}> is {per_unit:g}; must be above 0")
    return per_unit / factor


def _whole(text: str | None) -> int | None:
    try:
        return None if text is None else int(text)
    except ValueError:
        return None
