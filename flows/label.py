"""Labelling: ground truth for every committed trial whose label is missing or stale."""

from __future__ import annotations

import os
import signal
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import active_children, get_context
from pathlib import Path
from typing import Any

from prefect import flow, task
from prefect.cache_policies import NO_CACHE

from analysis import labelling
from flows import console
from flows.campaigns import Collected
from flows.orchestration import Parcel, run
from flows.timing import timed
from protocols.settings import Labelling
from storage.derived import Derived, make_key
from storage.recording import Recording
from storage.store import Store

STEP = "labels"
CHUNK = 64

Work = tuple[Path, str, str, Labelling]
"""Recording's folder, campaign, key, settings."""
Chunk = tuple[Store, list[Work], ProcessPoolExecutor, console.Bar]


def label_key(recording: Recording, settings: Labelling) -> str:
    """The key of a trial's label."""
    return make_key(STEP, labelling.VERSION, recording.checksum, settings.model_dump(mode="json"))


def stale_labels(store: Store, campaigns: list[Collected]) -> list[Work]:
    """(recording folder, campaign, key, settings) of every label that has to be made."""
    work = []
    for item in campaigns:
        results = Derived.of(store, STEP, item.name)
        for _, recording in item.trials:
            key = label_key(recording, item.settings.labelling)
            if not results.fresh(recording.folder.name, key):
                work.append((recording.folder, item.name, key, item.settings.labelling))
    return work


def _leave_signals_to_the_parent() -> None:
    """Ctrl-C reaches every process of a terminal; only the parent answers it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _label_one(folder: Path, settings: Labelling) -> tuple[dict[str, Any], dict[str, Any]]:
    """Runs in a process of its own."""
    label = labelling.label_recording(Recording(folder), settings)
    return label.as_json(), label.as_arrays()


@task(name="label trials", cache_policy=NO_CACHE, persist_result=False)
def label_chunk(chunk: Parcel[Chunk]) -> int:
    """Label some trials on all cores; each is kept as soon as it is there."""
    store, work, pool, bar = chunk.content
    futures = {pool.submit(_label_one, item[0], item[3]): item for item in work}
    for future in as_completed(futures):
        folder, campaign, key, _ = futures[future]
        data, arrays = future.result()
        Derived.of(store, STEP, campaign).write(folder.name, key, data, arrays)
        bar.advance(1, folder.name)
    return len(work)


@flow(name="label", validate_parameters=False, persist_result=False)
def label_flow(wanted: Parcel[tuple[Store, list[Work]]]) -> int:
    """Label what is stale, in core-sized chunks."""
    store, work = wanted.content
    workers = max(1, min(len(work), os.cpu_count() or 1))
    with (
        timed(store, "label"),
        ProcessPoolExecutor(
            workers, mp_context=get_context("spawn"), initializer=_leave_signals_to_the_parent
        ) as pool,
        console.bar("label (trials)", len(work)) as bar,
    ):
        try:
            for start in range(0, len(work), CHUNK):
                label_chunk(Parcel((store, work[start : start + CHUNK], pool, bar)))
        except BaseException:
            for worker in active_children():
                worker.terminate()  # what a worker had not handed over is simply made again
            raise
    return len(work)


def label(store: Store, campaigns: list[Collected]) -> dict[str, Any]:
    """Label every trial of `campaigns` that needs it."""
    total = sum(len(item.trials) for item in campaigns)
    work = stale_labels(store, campaigns)
    if work:
        run(label_flow, Parcel((store, work)))
    return {"step": "label", "done": len(work), "fresh": total - len(work)}
