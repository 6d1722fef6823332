"""One evaluation as it is asked for: of the store's network, a model file, or predictions."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from sliplab.flows.planning.parameters import RuleOptions, made
from sliplab.flows.steps import run_step
from sliplab.protocols.errors import InputError

if TYPE_CHECKING:
    import pandas as pd


def run_evaluation(
    folder: Path,
    names: list[str] | None,
    *,
    margin: float | None = None,
    smoothing: int | None = None,
    reviewed: bool = False,
    baselines: bool = False,
    checks: bool = False,
    model: Path | None = None,
    engine: str | None = None,
    predictions: Path | pd.DataFrame | None = None,
    dask: str | None = None,
    promise: float | None = None,
) -> dict[str, Any]:
    """Score a network on the test trials.

    Args:
        folder, names: the store, and the campaigns; all of them by default.
        margin: by which the winner must lead, in spikes (of predictions that are no spikes, a
            share). smoothing: windows to average. By default the protocol's.
        reviewed: apply the decisions made in a review.
        baselines, checks: also train baselines; fail if permuted labels reveal a fault.
        model, engine: a model file instead of the store's network, or a detector's calibration
            (.json); what counts the network's spikes.
        predictions: of another program, instead; see `analysis.evaluation.predictions`.
        dask: the scheduler whose workers take the trials.
        promise: false alarms an hour, at most, at which the store's detectors are compared, too.

    Returns:
        the step's result; of `model` and `predictions` a `flows.judge_network.NetworkScores`, of a
        detector's calibration a `flows.judge_detector.JudgedDetector`.

    Raises:
        InputError: arguments that exclude each other, or that are wrong.
        StoreError: a label or a network is missing or stale.
    """
    from sliplab.analysis.detectors.skin import is_calibration

    made(RuleOptions, margin=margin, smoothing=smoothing)
    options: dict[str, Any] = {"margin": margin, "smoothing": smoothing, "reviewed": reviewed}
    if model is None and engine is not None:
        raise InputError("--engine", "", engine, "belongs to --model")
    if model is not None and predictions is not None:
        raise InputError("--predictions", "", None, "cannot be given with --model")
    if model is not None or predictions is not None:
        alone = (("--baselines", baselines), ("--checks", checks), ("--promise", promise))
        for name, chosen in alone:
            if chosen:
                raise InputError(name, "", None, "applies only to the store's own network")
    if predictions is not None:
        options["predictions"] = predictions
        return {**run_step(folder, names, "judge_predictions", dask, **options)}
    if model is not None and is_calibration(model):
        of_networks = (("--margin", margin), ("--smoothing", smoothing), ("--engine", engine))
        for name, given in of_networks:
            if given is not None:
                raise InputError(name, "", given, f"is of networks, and {model} is a detector")
        return {**run_step(folder, names, "judge_detector", dask, model=model, reviewed=reviewed)}
    if model is not None:
        options |= {"model": model, "engine": engine}
        return {**run_step(folder, names, "judge_model", dask, **options)}
    done: dict[str, Any] = {**run_step(folder, names, "evaluate", dask, promise=promise, **options)}
    for step, chosen in (("window_baselines", baselines), ("window_checks", checks)):
        if chosen:
            done[step] = run_step(folder, names, step, reviewed=reviewed)
    return done
