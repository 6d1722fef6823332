"""Rounds of a campaign with claims, and whether its plan can have the blocks that they need."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import count

from sliplab.protocols.claims import AdaptiveChoice, Stopping
from sliplab.protocols.factors import Level
from sliplab.protocols.key_errors import KeyedError
from sliplab.protocols.model import Collection
from sliplab.protocols.shown import plural

Levels = Mapping[str, tuple[Level, ...]]
"""Enabled levels of each factor."""


@dataclass(frozen=True)
class _Grid:
    conditions: int
    stretches: int
    stopping: Stopping
    choice: AdaptiveChoice | None

    def ends(self, repetitions: int, most: int | None) -> list[int]:
        """Return how many measured trials there are at the end of each round, the first always."""
        total = self.conditions * repetitions
        if self.choice is None:
            first = step = self.conditions * self.stopping.repetitions
        else:
            first = self.stretches * max(self.choice.start // self.stretches, 2)
            step = self.stretches * self.choice.batch
        ends = [*range(min(first, total), total, step), total]
        return [ends[0], *(end for end in ends[1:] if most is None or end <= most)]

    def blocks(self, size: int | None, repetitions: int, most: int | None) -> int:
        """Return how many blocks, or batches, of a size there are at the end."""
        if self.choice is not None and size is not None:
            choice = self.choice.model_copy(update={"batch": size})
            grid = _Grid(self.conditions, self.stretches, self.stopping, choice)
            return len(grid.ends(repetitions, most))
        taken = self.ends(repetitions, most)[-1] // self.conditions
        if size is None:
            return taken
        return taken * self.stretches * math.ceil(self.conditions / self.stretches / size)


def _grid(collection: Collection, levels: Levels) -> _Grid | None:
    if collection.stopping is None:
        return None
    factors = collection.all_factors
    by_person = [name for name in factors if factors[name].changeover == "person"]
    conditions, stretches = (
        math.prod(len(levels[name]) for name in names) for names in (factors, by_person)
    )
    return _Grid(conditions, stretches, collection.stopping, collection.adaptive)


def check_first_round(collection: Collection, levels: Levels) -> None:
    """Check that a campaign with claims may take its first round. Raises KeyedError."""
    grid = _grid(collection, levels)
    if grid is None or (most := grid.stopping.most) is None:
        return
    first = grid.ends(collection.repetitions, most)[0]
    if most < first:
        raise KeyedError(
            "collection.stopping.most",
            most,
            f"must be at least {first}, the trials of the first round, which is taken whole",
        )


def block_warnings(collection: Collection, levels: Levels) -> Iterator[str]:
    """Yield a line for each claim that a plan can never call, for lack of blocks."""
    grid = _grid(collection, levels)
    if grid is None:
        return
    repetitions, most = collection.repetitions, grid.stopping.most
    key, size = "collection.stopping.block", grid.stopping.block
    if grid.choice is not None:
        key, size = "collection.choice.batch", grid.choice.batch
    has = grid.blocks(size, repetitions, most)
    for number, claim in enumerate(grid.stopping.claims):
        needed = claim.least_blocks
        if has >= needed:
            continue
        enough = next(n for n in count(repetitions) if grid.blocks(size, n, None) >= needed)
        faults = []
        if enough > repetitions:
            faults.append(f"collection.repetitions = {repetitions} must be at least {enough}")
        if most is not None:
            ends = grid.ends(enough, None)
            trials = next(end for end in ends if grid.blocks(size, enough, end) >= needed)
            if trials > most:
                faults.append(f"collection.stopping.most = {most} must be at least {trials}")
        text = " and ".join(faults)
        sizes = range(grid.conditions // grid.stretches if size is None else size - 1, 0, -1)
        least = 2 if grid.choice is None else 1
        smaller = (n for n in sizes if n >= least and grid.blocks(n, repetitions, most) >= needed)
        if fits := next(smaller, None):
            text += f", or {key}{'' if size is None else f' = {size}'} must be at most {fits}"
            if grid.choice is None:
                text += ", if trials further apart do not resemble each other"
        yield (
            f"collection.stopping.claims[{number}] ({claim.text(collection.all_factors)}): needs "
            f"{plural(needed, 'block')}, and the plan has {has}, so it cannot be called: {text}"
        )
