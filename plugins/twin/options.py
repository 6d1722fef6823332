"""Options that the studies of a twin share."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sliplab.protocols.errors import InputError

if TYPE_CHECKING:
    from sliplab.analysis.campaigns import Collected
    from sliplab.storage.trials.store import TrialStore

WorldsOption = Annotated[
    int, typer.Option("--worlds", min=100, max=100_000, help="Worlds to simulate.")
]
SpreadOption = Annotated[
    float,
    typer.Option(
        "--spread", min=0.05, max=5, help="Largest change of a parameter: 0.5 is by half."
    ),
]
SeedOption = Annotated[
    int, typer.Option("--seed", min=0, max=2**31, help="Seed of the simulated worlds.")
]


def campaigns_of(folder: Path, names: list[str] | None) -> tuple[TrialStore, list[Collected]]:
    """Return a store and its campaigns of these names; all without any."""
    from sliplab.flows.steps import prepare_store
    from sliplab.storage.remote.mirror import open_store

    store = open_store(folder)
    prepare_store(folder)  # before anything imports Prefect
    from sliplab.analysis.campaigns import collected

    return store, collected(store, names)


def one_campaign(folder: Path, name: str | None) -> tuple[TrialStore, Collected]:
    """Return a store and its campaign of this name, which may be left out if it is the only one.

    Raises:
        InputError: it is needed.
    """
    store, found = campaigns_of(folder, None if name is None else [name])
    if len(found) != 1:
        names = ", ".join(item.name for item in found)
        raise InputError("--campaign", "", None, f"is needed: the store has {names}")
    return store, found[0]
