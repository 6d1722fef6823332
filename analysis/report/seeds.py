"""Effect of a network's seed, in words: networks of other seeds have other figures."""

from __future__ import annotations

from sliplab.analysis.report.page import percent
from sliplab.storage.schema.evaluation import Seeds


def seed_words(seeds: Seeds) -> str:
    """Return the strict accuracy of every trained seed and its range, or that there is one."""
    strict = seeds.spread["strict"]
    if len(seeds.each) < 2:
        return "one network; another seed would give other figures"
    each = ", ".join(f"{it.seed}: {percent(it.strict)}" for it in seeds.each)
    low = percent(strict.min).removesuffix(" %")
    return f"{len(seeds.each)} seeds from {low} to {percent(strict.max)} strict ({each})"
