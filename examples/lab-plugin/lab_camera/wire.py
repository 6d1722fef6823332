"""The lab camera's bytes. All numbers are little-endian.

The camera greets with `GREETING`: a magic word, columns and rows, serial number. ``+`` starts the
stream and ``-`` stops it; each is answered by a packet in the stream, so that what belongs to a run
can be distinguished from earlier data. A packet is `HEAD` and as many items: a kind and a count.
"""

from __future__ import annotations

import struct

import numpy as np

GREETING = struct.Struct("<8sHH16s")
MAGIC = b"LABCAM 1"
HEAD = struct.Struct("<cI")
EVENTS, EDGES, STARTED, STOPPED = b"E", b"S", b"+", b"-"
"""Kinds of packets: events, rising edges of the input (int64, us), and the two answers."""
EVENT = np.dtype([("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("p", "u1")])
"""One event: time in us of the camera's clock, column, row, polarity (1: brighter)."""
EDGE = np.dtype("<i8")
MOST_ITEMS = 1 << 22
"""A packet with more items than this is no packet."""
