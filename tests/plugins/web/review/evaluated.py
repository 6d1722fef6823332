"""A reviewable campaign with an evaluation whose detections and windows a test chooses."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sliplab.analysis.detectors.latency import DetectedOnsets, score_trial, true_slip
from sliplab.analysis.evaluation import evaluation as evaluations
from sliplab.analysis.evaluation import windows
from sliplab.analysis.evaluation.trials import summaries
from sliplab.analysis.labels.reviewed import StoreLabels
from sliplab.analysis.metrics import classification, window_groups
from sliplab.analysis.windows.sample_sets import load_samples
from sliplab.protocols.detection import Detection
from sliplab.storage.schema import evaluation
from sliplab.storage.schema.evaluation import (
    ChangePointCoverage,
    NoSlip,
    ProbabilityCalibration,
    SignedDeviation,
    TrialScore,
)
from sliplab.storage.schema.label import LABELS, TrialLabel
from sliplab.storage.trials.derived import Derived
from tests.analysis.labels.reviewable import NAME, Reviewable

MS = 1_000_000
TRIALS = 110
"""12 of them are test trials."""
RULE = Detection()
NOTHING = SignedDeviation(n=0, median=None, median_abs=None, max_abs=None)
NO_SHARE = evaluation.Share(share=None, low=None, high=None, n=0, trials=0)


class Evaluated(Reviewable):
    """The campaign with an evaluation."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder, TRIALS)
        self.tests = [trial.id for trial, _ in self.item.of_split("test")]
        self.trained = [trial.id for trial, _ in self.item.of_split("train")]

    def label(self, trial: str) -> TrialLabel:
        """A trial's label as it is stored."""
        return Derived.of(self.store, LABELS, NAME).load(trial, TrialLabel)

    def change(self, trial: str, **values: Any) -> None:
        """Change keys of a trial's label."""
        derived = Derived.of(self.store, LABELS, NAME)
        derived.write(trial, self.keys[trial], {**derived.read(trial), **values})

    def widen(self, trial: str, incipient_ms: float, gross_ms: float = 0.0) -> None:
        """Let a label state intervals of these standard deviations."""
        gross_ns, incipient_ns, *_ = self.label(trial).per_marker_ns
        stated = {
            f"{kind}_ns": [at - round(2 * MS * ms), at + round(2 * MS * ms)]
            for kind, at, ms in (
                ("incipient", incipient_ns, incipient_ms),
                ("gross", gross_ns, gross_ms),
            )
        }
        self.change(trial, intervals=stated)

    def row(self, trial: str, label: TrialLabel, found: DetectedOnsets) -> TrialScore:
        """Score a trial as an evaluation does."""
        slip = true_slip(label)
        tolerance = round(RULE.false_early_ms * MS)
        return TrialScore(
            campaign=NAME,
            experiment="kinematic",
            trial=trial,
            condition={},
            incipient_ns=label.incipient_ns,
            gross_ns=label.gross_ns,
            end_ns=None if slip is None else slip.end_ns,
            detected_incipient_ns=found.incipient_ns,
            detected_gross_ns=found.gross_ns,
            latency=None if slip is None else score_trial(found, slip, tolerance),
        )

    def evaluate(self, latencies_ms: Sequence[float]) -> list[TrialScore]:
        """Keep an evaluation in which detections of test trials come so long after either onset.

        Latencies are of the onsets that the labels have, or had before they were in doubt. The
        windows of test trials are answered at random, 70 % of them rightly.
        """
        rows = []
        for trial, late in zip(self.tests, latencies_ms, strict=True):
            incipient, gross = (
                self.label(trial).per_marker_ns[1],
                self.label(trial).per_marker_ns[0],
            )
            found = DetectedOnsets(incipient + round(late * MS), gross + round(late * MS))
            rows.append(self.row(trial, self.label(trial), found))
        labels = StoreLabels(self.store)
        train = load_samples(labels, [self.item], "train")
        load_samples(labels, [self.item], "validation")
        test = load_samples(labels, [self.item], "test")
        rng = np.random.default_rng(1)
        said = np.where(rng.random(len(test)) < 0.7, test.y, rng.integers(0, 3, len(test)))
        counts = np.eye(3, dtype=np.int64)[said]
        hits = window_groups.strict_hits(counts, test.y)
        by_onset = evaluation.DeviationByOnset(incipient=NOTHING, gross=NOTHING)
        kept = evaluation.Evaluation(
            format=evaluations.FORMAT,
            seed=0,
            trials=tuple(rows),
            experiments=summaries(rows),
            windows=evaluation.WindowScores(
                **dict(classification.score(counts, test.y, 2.0)),
                interval=window_groups.share(hits, test.trial),
                reliability=(),
                calibration=ProbabilityCalibration(
                    temperature=None, ece=None, cross_entropy=None, uncalibrated=None
                ),
                by_factor={},
                by_tenth={},
                no_slip=NoSlip(hold=NO_SHARE, loading=NO_SHARE),
                by_trial=(),
                seeds=evaluation.Seeds(each=(), spread={}),
                work=None,
                baselines={},
                beside={},
                samples=evaluation.SampleCounts(train=len(train), test=len(test)),
            ),
            label_error_ms=evaluation.LabelErrors(rule="paper", **dict(by_onset)),
            label_rules_ms=evaluation.RuleErrors(
                paper=by_onset,
                change_point=by_onset,
                apart=by_onset,
                papillae=ChangePointCoverage(**dict(NOTHING), coverage=None),
            ),
            detection={NAME: RULE},
            choices={NAME: None},
            detectors=None,
        )
        Derived.of(self.store, evaluations.STEP).write(evaluations.NAME, "e", kept)
        Derived.of(self.store, windows.STEP).write(
            windows.NAME,
            "e",
            {},
            {
                "counts": counts,
                "y": test.y,
                "trial": test.trial,
                "trials": np.array(test.trials, np.str_).reshape(-1, 2),
            },
        )
        return rows
