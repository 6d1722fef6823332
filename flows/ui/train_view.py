"""Progress of a training: a bar, and its curves in the store and on Prefect's page."""

from __future__ import annotations

import base64
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict
from typing import Any

from sliplab.analysis.networks.models import ModelOnDisk
from sliplab.analysis.networks.training import EpochRecord
from sliplab.analysis.report.figures.windows import training_curves
from sliplab.flows.running import console, orchestration
from sliplab.storage.files import write_text


@contextmanager
def training_progress(model: ModelOnDisk, simulated: bool) -> Iterator[TrainingProgress]:
    """Show the training of a model while the block runs."""
    with console.bar(f"train {model.title} (epochs)", model.settings.training.epochs) as bar:
        yield TrainingProgress(model, bar, simulated)


class TrainingProgress:
    """Progress display of a training: a bar, and a plot drawn after each epoch.

    The plot is in the store and on Prefect's page. Where the page cannot be reached, the store
    has it.
    """

    def __init__(self, model: ModelOnDisk, bar: Any, simulated: bool) -> None:
        self._model, self._bar, self._simulated = model, bar, simulated
        self._records: list[dict[str, float]] = []
        self._best: EpochRecord | None = None
        self._artifact: Any = None

    def epoch(self, record: EpochRecord) -> None:
        """An epoch is over."""
        self._records.append(asdict(record))
        if self._best is None or record.merit > self._best.merit:
            self._best = record
        self._bar.advance(1, f"loss {record.loss:.3f}, validation {record.val_strict:.3f} strict")
        svg = training_curves(self._records, self._best.epoch, simulated=self._simulated)
        write_text(self._model.curves_path, svg)
        if not orchestration.uses_private_server():
            with suppress(Exception):
                self._show(svg)

    def _show(self, svg: str) -> None:
        """On the page of the flow run; made at the first epoch, changed after."""
        from prefect.client.orchestration import get_client
        from prefect.client.schemas.actions import ArtifactCreate, ArtifactUpdate
        from prefect.context import get_run_context

        data = "data:image/svg+xml;base64," + base64.b64encode(svg.encode()).decode()
        words = f"training curves of {self._model.title}, {len(self._records)} epochs"
        with get_client(sync_client=True) as client:
            if self._artifact is not None:
                client.update_artifact(self._artifact, ArtifactUpdate(data=data, description=words))
                return
            run: Any = get_run_context()
            made = client.create_artifact(
                ArtifactCreate(
                    key=f"train-{self._model.title.replace(' ', '-')}-curves",
                    type="image",
                    data=data,
                    description=words,
                    flow_run_id=run.task_run.flow_run_id,
                )
            )
            self._artifact = made.id
