"""Size of a kinematic trial and processing time of each step, for docs/scale.md.

Bytes with a video (`video_`) and with tracks in its place (`tracks_`); milliseconds a trial by
step, each on one core, but for `counts_ms`, where the network uses all; pushing to a folder and to
an S3 server on the loopback, read back or not. All trials are simulated. The S3 server is moto's,
in Python: it bounds the rate, and a real one does not.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from uuid import uuid4

import numpy as np
import numpy.typing as npt

from benchmarks.measure import RUNS, Figures, Seconds, alternate, one_core, rate, spread
from benchmarks.trials import open_session
from sliplab.analysis.clocks.refit import fit_again
from sliplab.analysis.labels import labelling
from sliplab.analysis.networks import training
from sliplab.analysis.networks.network import build, weights
from sliplab.analysis.windows import dataset
from sliplab.protocols import load_plan
from sliplab.storage.remote.manifest import trial_manifest
from sliplab.storage.remote.objects import Remote
from sliplab.storage.remote.push import PushOptions, push
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import TrialStore

ROOT = Path(__file__).parent.parent


def measure(trials: int = 1, runs: int = RUNS, s3: bool = True) -> Figures:
    """Bytes and milliseconds a trial, and megabytes a second pushed."""
    settings = load_plan(ROOT / "protocols" / "kinematic.yaml").protocol.analysis
    net = build(settings.network, settings.windows, 0)
    fitted = training.Fitted(
        weights(net), settings.network, settings.windows, settings.training, 0, (), 1, ()
    )
    figures: Figures = {}
    for rig, prefix in (("rehearsal", "tracks_"), ("mock", "video_")):
        with open_session(rig, trials) as taking:
            taking.take()
            campaign = taking.collector.campaign
            store = TrialStore.open(campaign.folder.parent.parent)
            found = list(campaign.recordings())
            each = len(found)
            sizes = [trial_manifest(campaign, item.trial_id).files for item in found]
            figures[f"{prefix}bytes"] = (
                sum(known.bytes for files in sizes for known in files.values()) / each
            )
            figures[f"{prefix}events"] = sum(r.record.counts.events for r in found) / each
            steps: dict[str, Callable[[Recording], object]] = {
                "sync": lambda item: fit_again(item, None),
                "label": lambda item: labelling.label_results(item, settings.labelling),
                "windows": lambda item: dataset.trial_windows(item, settings.windows),
            }
            with one_core():
                taken = _timed(found, steps, runs)
            if rig == "rehearsal":
                windows = [dataset.trial_windows(item, settings.windows)[0] for item in found]
                taken |= alternate(runs, counts=partial(_count, fitted, windows))
            for name, seconds in taken.items():
                figures |= spread(f"{prefix}{name}_ms", [1e3 * s / each for s in seconds])
            if rig == "mock":
                figures |= _pushing(store, runs, s3)
    return figures


def _timed(
    found: list[Recording], steps: dict[str, Callable[[Recording], object]], runs: int
) -> dict[str, Seconds]:
    def all_of(step: Callable[[Recording], object]) -> Callable[[], object]:
        # opened anew, so that reading and checking are part of it
        return lambda: [step(Recording(item.folder, item.sync_file)) for item in found]

    return alternate(runs, **{name: all_of(step) for name, step in steps.items()})


def _count(fitted: training.Fitted, windows: list[npt.NDArray[np.uint8]]) -> None:
    for x in windows:
        training.predict_counts(fitted, x)


def _pushing(store: TrialStore, runs: int, s3: bool) -> Figures:
    with tempfile.TemporaryDirectory() as folder:
        places = {"folder": lambda: f"file://{folder}/{uuid4().hex}"}
        figures = _rates(store, runs, places)
    if s3:
        import boto3

        from tests.storage.remote.remotes import s3_server

        with s3_server() as endpoint:
            boto3.client("s3", endpoint_url=endpoint).create_bucket(Bucket="lab")
            figures |= _rates(store, runs, {"s3": lambda: f"s3://lab/{uuid4().hex}"})
    return figures


def _rates(store: TrialStore, runs: int, places: dict[str, Callable[[], str]]) -> Figures:
    figures: Figures = {}
    for name, new in places.items():
        sent: list[int] = []

        def send(read_back: bool, new: Callable[[], str] = new, sent: list[int] = sent) -> None:
            done = push(store, Remote(new()), options=PushOptions(read_back=read_back))
            sent.append(done.bytes)

        taken = alternate(runs, checked=lambda: send(True), sizes=lambda: send(False))
        figures |= rate(f"push_{name}_mb_per_s", sent[0] / 1e6, taken["checked"])
        figures |= rate(f"push_{name}_sizes_only_mb_per_s", sent[0] / 1e6, taken["sizes"])
    return figures
