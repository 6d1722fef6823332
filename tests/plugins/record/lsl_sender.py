"""`python lsl_sender.py NAME`: send events over LSL, each with the time that a true clock shows.

The two channels are the true times before and after the stamp was taken, seconds of CLOCK_BOOTTIME,
which runs as the host's monotonic clock does.
"""

from __future__ import annotations

import select
import sys
import time

import pylsl


def true_s() -> float:
    """Seconds of a clock that nothing sets."""
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME) / 1e9


def main(name: str) -> None:
    info = pylsl.StreamInfo(name, "events", 2, 0.0, "double64", name)
    info.set_channel_labels(["before", "after"])
    outlet = pylsl.StreamOutlet(info)
    print("ready", flush=True)
    while True:
        before = true_s()
        stamp = pylsl.local_clock()
        outlet.push_sample([before, true_s()], stamp)
        select.select([], [], [], 0.01)  # not `time.sleep`, which waits by the clock that jumps


if __name__ == "__main__":
    main(sys.argv[1])
