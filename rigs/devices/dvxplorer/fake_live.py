"""A DVXplorer on the network that sends what it is given, as it is given it."""

from __future__ import annotations

from sliplab.rigs.devices.dvxplorer.fake_server import DvServer
from sliplab.rigs.devices.dvxplorer.fake_stream import (
    events_header,
    events_packet,
    triggers_header,
    triggers_packet,
)
from sliplab.storage.streams import EventChunk, PulseChunk

NAME = "stand-in"


class LiveDvxplorer:
    """An event camera whose data come from elsewhere in this process.

    Args:
        size: columns and rows.

    Attributes:
        ports: of events and of triggers.
    """

    def __init__(self, size: tuple[int, int]) -> None:
        self._events = DvServer(events_header(size, NAME))
        self._triggers = DvServer(triggers_header(NAME))
        self.ports = self._events.port, self._triggers.port
        self._silent = False

    def send(self, chunk: EventChunk, pulses: PulseChunk) -> None:
        """Send events, and rising edges of its input; nothing while it is stalled."""
        if self._silent:
            return
        if len(chunk):
            self._events.send(events_packet(chunk))
        if len(pulses.t_ns):
            self._triggers.send(triggers_packet(pulses.t_ns // 1000))

    def stall(self) -> None:
        """Send nothing from now on; the connections stay."""
        self._silent = True

    def resume(self) -> None:
        """Send again what comes from now on; what a stall kept back is lost."""
        self._silent = False

    def close(self) -> None:
        """The cable is pulled: connections break. Any number of times."""
        self._events.close()
        self._triggers.close()
