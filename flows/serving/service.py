"""What `sliplab serve` was started with, told to the processes of its flow runs.

It goes through the environment and not through the runs' parameters, which anybody who sees
Prefect's page could change.
"""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path

ENVIRONMENT = "SLIPLAB_SERVICE"


@dataclass(frozen=True)
class Service:
    """One rig, one store, one program that serves them.

    Attributes:
        store: its absolute folder; rig: a rig file, or the name of one that ships.
        name: of the deployments: ``collect/NAME``.
        server: Prefect's, as `run_records.server_name` calls it.
        pid: of the program that serves.
    """

    store: str
    rig: str
    name: str
    server: str
    pid: int

    @property
    def folder(self) -> Path:
        """The store's folder."""
        return Path(self.store)

    def tell(self) -> None:
        """Put it into the environment of the processes that are started from here on."""
        os.environ[ENVIRONMENT] = json.dumps(asdict(self))


def service() -> Service:
    """What this process is served by.

    Raises:
        RuntimeError: nobody serves here.
    """
    text = os.environ.get(ENVIRONMENT)
    if text is None:
        raise RuntimeError("this flow runs under `sliplab serve` only")
    return Service(**json.loads(text))
