"""The host reads a simulated device's clock: a question, an answer, and what both take."""

from __future__ import annotations

import numpy as np

from sliplab.rigs.mock.world import World
from sliplab.rigs.scene.randomness import generator
from sliplab.storage.clockmap import ClockMap
from sliplab.storage.streams import ClockReads


class ClockReader:
    """Reads of one device's clock.

    The virtual clock stands still meanwhile, so an answer lies ahead of it by a fraction of a
    millisecond as a rule; the next question waits for the answer before.
    """

    def __init__(self, world: World, device: str) -> None:
        self._world, self._device = world, device
        self._begin()
        world.on_begin.append(self._begin)

    def _begin(self) -> None:
        self._random = generator(self._world.seed, f"{self._device} clock reads")
        self._answered_ns = 0

    def read(self, clock: ClockMap, unit_ns: int = 1) -> ClockReads:
        """One read.

        Args:
            clock: true time to the device's.
            unit_ns: what the device cuts its clock to.
        """
        settings = self._world.settings.clocks
        late_us = settings.read_shortest_us + settings.read_spread_us * (
            self._random.standard_exponential(2)
        )
        late_ns = np.rint(np.minimum(late_us, settings.read_longest_us) * 1000)
        question_ns, answer_ns = late_ns.astype(np.int64).tolist()
        before_ns = max(self._world.now_ns, self._answered_ns)
        shown_ns = clock.to_reference(before_ns + question_ns) // unit_ns * unit_ns
        self._answered_ns = before_ns + question_ns + answer_ns
        row = (shown_ns, before_ns, self._answered_ns)
        return ClockReads(*(np.array([value], np.int64) for value in row))
