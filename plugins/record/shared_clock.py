"""Clocks that devices and the host share, TAI by PTP and UTC, as the host has them.

A host without a daemon that sets it has a TAI that equals UTC. TAI is then made of UTC and a table
of leap seconds, so that neither are stamps of UTC taken for TAI, nor those of TAI refused.
"""

from __future__ import annotations

import time
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sliplab.storage.clockmap import BILLION

if TYPE_CHECKING:
    from sliplab.storage.streams import ClockReads

SHARED = {"ptp": "TAI", "utc": "UTC"}
"""Time scale of each declaration."""
TAI_S = 37
"""TAI - UTC since 2017 (IERS, Bulletin C 52), where the system has no table of its own, seconds."""
GPS_S = 19
"""TAI - GPS time (IS-GPS-200), seconds."""
TABLE = Path("/usr/share/zoneinfo/leap-seconds.list")
_NTP_S = 2_208_988_800
"""From 1900, whence the table counts, to 1970, seconds."""
_APART_NS = BILLION // 2
"""Stamps closer to an offset than this are taken to have it."""


def kernel_s() -> int:
    """Return TAI - UTC as the host's kernel has it, seconds; 0 where nothing has set it."""
    return round(time.clock_gettime(time.CLOCK_TAI) - time.clock_gettime(time.CLOCK_REALTIME))


def tai_s() -> int:
    """Return TAI - UTC today, seconds: the kernel's, or the table's where that cannot be right."""
    own_s = kernel_s()
    return own_s if own_s >= TAI_S else _by_table_s()


@cache
def _by_table_s() -> int:
    now_s = time.time_ns() // BILLION + _NTP_S
    try:
        rows = [line.split() for line in TABLE.read_text("ascii").splitlines() if line[:1] != "#"]
        past = [int(row[1]) for row in rows if row and int(row[0]) <= now_s]
    except (OSError, ValueError, IndexError):
        past = []
    return max([TAI_S, *past[-1:]])


def now_ns(clock: str) -> int:
    """Return a shared clock's time, ns.

    Args:
        clock: a name of `SHARED`.
    """
    return time.time_ns() + (tai_s() if clock == "ptp" else 0) * BILLION


def doubt(clock: str) -> str:
    """Return what a trial's record says of a clock that the host's kernel does not know."""
    if clock != "ptp" or kernel_s() >= TAI_S:
        return ""
    return f"the host's kernel does not know TAI, which was taken to be UTC + {tai_s()} s"


def explained(clock: str, reads: ClockReads) -> str:
    """Return what else stamps may be that arrivals refuse; nothing where no one offset fits.

    Args:
        reads: bounds of the host's clock for the newest stamps, and for the shared clock itself.
    """
    width = (reads.after_ns - reads.before_ns).astype(np.float64)
    off = (reads.device_ns - reads.before_ns) - width / 2
    # the clock itself is read at once, unless the host was busy
    off -= off[np.argmin(width)]
    wrong = np.abs(off) >= _APART_NS
    if not wrong.any():
        return ""
    # how long before its arrival a stamp may have been made is stated, and the same for all
    right = ~wrong & np.isclose(width, np.median(width[wrong]), rtol=0.01)
    stamps = off[wrong]
    if stamps.size <= right.sum() or np.ptp(stamps) > 2 * _APART_NS:
        return ""
    by_s = float(np.median(stamps)) / BILLION
    scale, utc_s = SHARED[clock], -tai_s() if clock == "ptp" else 0
    found = f"its stamps are {abs(by_s):.3f} s {'ahead of' if by_s > 0 else 'behind'} {scale}"
    offsets = {"utc": utc_s, "ptp": utc_s + tai_s(), "own": utc_s + tai_s() - GPS_S}
    for name, ahead_s in offsets.items():
        if abs(by_s - ahead_s) < _APART_NS / BILLION:
            other = SHARED.get(name, "GPS time")
            return f"{found}, as {other} is: is this {other}? Declare its clock as {name}"
    return f"{found} as the host has it: is the host's clock right, and the device's?"
