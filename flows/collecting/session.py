"""One session at a rig: takes trials one after the other and commits the good ones.

The session knows nothing of Prefect; `flows.collecting.collect` decides in what pieces it is
driven. What is done is what the store holds, so a session can die at any instruction and the next
one goes on.
"""

from __future__ import annotations

import platform
import shutil
import socket
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import version
from typing import Any

from sliplab.analysis.quality import Assessment, Motion, assess
from sliplab.flows.collecting.trial_gate import TrialGate
from sliplab.flows.running import stopping
from sliplab.protocols import Plan, Task, Trial
from sliplab.protocols.hashing import hash_integer
from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.core.rig import Rig, StopRequested, TrialRun
from sliplab.rigs.rig_file import RigFile
from sliplab.storage.errors import translated_disk_errors
from sliplab.storage.schema.trial import (
    Geometry,
    Provenance,
    Quality,
    RecordedTiming,
    Step,
    TrialRecord,
)
from sliplab.storage.streams import Json
from sliplab.storage.trials.store import Campaign
from sliplab.storage.trials.writer import TrialWriter

_PACKAGES = ("sliplab", "numpy", "numba", "h5py", "hdf5plugin", "av")


@dataclass
class Session:
    """Takes the trials of one plan on one rig into one campaign.

    Attributes:
        on_trial: called after each trial with it and ``committed``, ``set aside`` or ``skipped``.
        gate: the trial gate, asked before each attempt and notified of each trial, if there is one.
    """

    plan: Plan
    rig_file: RigFile
    rig: Rig
    campaign: Campaign
    operator: str = ""
    on_trial: Callable[[Trial, str], None] = field(default=lambda trial, outcome: None)
    gate: TrialGate | None = None
    taken: int = 0
    retaken: int = 0
    _before: Trial | None = None
    _warm: bool = False
    _zero_slot: int | None = None

    def take(self, trials: list[Trial]) -> None:
        """Take `trials`, with what has to be done before each.

        Raises:
            RigError: a device failed, or a person did not do what was asked.
            StoreError: the store's disk is full, read-only or failing.
            CampaignStopped: something that is watched between trials ended the campaign.
            KeyboardInterrupt: somebody asked to stop.
        """
        for trial in trials:
            with translated_disk_errors(self.campaign.folder, RigError):
                if not self._may_take(trial):
                    continue
                self._prepare(trial)
                self._take(trial)
            self._before = trial

    def fresh_start(self) -> None:
        """Somebody may have been at the rig: look at plate, skin and depth zero anew."""
        self._before, self._warm, self._zero_slot = None, False, None

    def _may_take(self, trial: Trial) -> bool:
        if self.gate is None or self.gate.may_take(trial):
            return True
        self.on_trial(trial, "skipped")
        return False

    def _over(self, trial: Trial, outcome: str) -> None:
        self.on_trial(trial, outcome)
        if self.gate is not None:
            self.gate.after(trial, outcome)

    def _prepare(self, trial: Trial) -> None:
        """What the protocol wants before this trial, given what this session did already."""
        self._change_over(trial)
        for task in self.plan.tasks_before(trial):
            if task.kind == "clean":
                self._ask(task)
        self._warm_and_zero(trial)

    def _change_over(self, trial: Trial) -> None:
        for task in self.plan.changeovers(self._before, trial):
            if not self._mounted(trial):
                self._ask(task)
                if not self._mounted(trial):
                    raise RigError("plate", f"{task.prompt}: the rig finds another mass mounted")

    def _warm_and_zero(self, trial: Trial) -> None:
        """Warm the skin up and find depth zero, as far as that was not done yet."""
        upkeep = self.plan.protocol.collection.maintenance
        if upkeep.warm_up is not None and not self._warm:
            warm_up = upkeep.warm_up
            self.rig.press(
                float(warm_up.depth),
                float(warm_up.speed),
                float(warm_up.clearance),
                warm_up.presses,
            )
            self._warm = True
        if upkeep.rezero is not None:
            slot = self.plan.rezero_task(trial).slot
            if slot != self._zero_slot:
                seed = hash_integer(self.plan.protocol.collection.seed, "rezero", slot)
                self.rig.touch_off(float(upkeep.rezero.speed), float(upkeep.rezero.search), seed)
                self._zero_slot = slot

    def _mounted(self, trial: Trial) -> bool:
        """Whether the plate that the trial needs hangs on the slider, to a gram."""
        mass = self.plan.mass_kg(trial)
        return mass is None or self.rig.plate is None or abs(self.rig.plate.mass_kg() - mass) < 1e-3

    def _ask(self, task: Task) -> None:
        if not self.rig.operator.ask(task.kind, task.prompt, task.expected):
            raise RigError("operator", f"'{task.prompt}' was not confirmed")

    def _take(self, trial: Trial) -> None:
        """Take one trial until it passes its gates or its retakes are used up."""
        collection = self.plan.protocol.collection
        frame_px = self.rig_file.frame_px(self.plan)
        attempt = self.campaign.attempts().get(trial.id, 0)
        failed = self.campaign.failed_attempts().get(trial.id, 0)
        while True:
            writer = self.campaign.begin(
                trial.id,
                frame_px,
                collection.recording.sync_rate,
                spool=self.rig_file.frame_camera.spool,
            )
            started = datetime.now(UTC)
            try:
                run = self.rig.run_trial(
                    self.plan.program(trial),
                    writer,
                    hash_integer(trial.seed, attempt),
                    frame_px,
                    collection.recording.sync_rate,
                )
                folder = writer.seal()
                found = assess(
                    folder,
                    _motion(run),
                    collection.gates,
                    self.rig.timing,
                    collection.recording.sync_rate,
                    self.rig.frames.mid_exposure_ns if frame_px is not None else None,
                )
            except BaseException as error:
                self._abandon(writer, error)
                raise
            self.taken += 1
            provenance = self._provenance(started)
            if found.passed:
                try:
                    writer.commit(self._record(trial, attempt, run, found, frame_px), provenance)
                except (OSError, RuntimeError) as error:
                    self._abandon(writer, error)
                    raise
                self._over(trial, "committed")
                return
            self._reject(trial, attempt, writer, found, provenance, run, frame_px)
            attempt += 1
            failed += 1
            if failed > collection.gates.retakes:
                self._over(trial, "set aside")
                return
            if not self._may_take(trial):
                return
            self._change_over(trial)  # only after a pause is there anything to do
            self._warm_and_zero(trial)
            self.retaken += 1

    def _abandon(self, writer: TrialWriter, error: BaseException) -> None:
        """Put what there is of a trial aside, with its cause, if that can be written at all.

        What cannot be moved now is found and put aside when the campaign goes on.
        """
        with suppress(OSError, RuntimeError):
            writer.abandon()
        with suppress(OSError):
            if writer.folder.exists():
                self.campaign.quarantine(writer.folder, _cause(error))

    def _reject(
        self,
        trial: Trial,
        attempt: int,
        writer: TrialWriter,
        found: Assessment,
        provenance: Provenance,
        run: TrialRun,
        frame_px: tuple[int, int] | None,
    ) -> None:
        record = self._record(trial, attempt, run, found, frame_px)
        target = self.campaign.quarantine_path(trial.id)
        cause = {"cause": f"gate: {found.causes}", "trial": trial.id, "attempt": attempt}
        writer.set_aside(target, record, provenance, cause)

    def _record(
        self,
        trial: Trial,
        attempt: int,
        run: TrialRun,
        found: Assessment,
        frame_px: tuple[int, int] | None,
    ) -> TrialRecord:
        """The trial's record: everything that follows from protocol, seed and versions."""
        recorded = run.recorded_ns
        first, last = run.steps[0][0], run.steps[-1][0]
        given: dict[str, Any] = {}
        if described := self.rig.describe():
            given["devices"] = described
        if run.truth is not None:
            given["simulation_truth"] = run.truth
        return TrialRecord(
            format=TrialRecord.FORMAT,
            trial=trial.id,
            campaign=self.campaign.name,
            experiment=self.plan.protocol.collection.experiment,
            role=trial.role,
            block=trial.block,
            repetition=trial.repetition,
            attempt=attempt,
            condition=self.plan.describe(trial),
            seed=trial.seed,
            rig=self.rig.name,
            simulated=self.rig_file.simulated,
            recorded_s=(recorded[1] - recorded[0]) / 1e9,
            motion_s=(last.end_ns - first.start_ns) / 1e9,
            depth_zero_mm=run.zero_mm,
            counts=found.counts,
            clocks=found.clocks,
            timing=RecordedTiming(
                rig=self.rig.timing,
                rate_hz=self.plan.protocol.collection.recording.sync_rate,
                mid_exposure_ns=self.rig.frames.mid_exposure_ns if frame_px else None,
            ),
            quality=Quality(passed=found.passed, gates=found.gates),
            steps=tuple(
                Step(phase=step.phase, start_ns=step.start_ns, end_ns=step.end_ns, recorded=kept)
                for step, kept in run.steps
            ),
            geometry=self._geometry(frame_px),
            **given,
        )

    def _geometry(self, frame_px: tuple[int, int] | None) -> Geometry:
        given: dict[str, Any] = {}
        if (centre := self.rig_file.calibration.centre_px) is not None:
            given["event_centre_px"] = centre
        return Geometry(
            event_px=(self.rig.events.width, self.rig.events.height),
            frame_px=frame_px,
            px_per_mm=self.rig_file.frame_camera.scale_px_per_mm,
            skin_mm=tuple(self.rig_file.skin.layout_mm()),
            centre=0,
            **given,
        )

    def _provenance(self, started: datetime) -> Provenance:
        """When, where and with what: outside the checksums."""
        return Provenance(
            started=started.isoformat(timespec="milliseconds"),
            ended=datetime.now(UTC).isoformat(timespec="milliseconds"),
            host=socket.gethostname(),
            operator=self.operator,
            skin=self.rig_file.skin.serial,
            disk_free=shutil.disk_usage(self.campaign.folder).free,
            **_installed(),
        )


def _motion(run: TrialRun) -> Motion:
    """Return what the quality of a trial is judged by."""
    moving = next(step for step, _ in run.steps if step.phase in {"slide", "retract"})
    return Motion(run.recorded_ns, (moving.start_ns, moving.end_ns), run.path)


@cache
def _installed() -> Json:
    """What does not change while a program runs, and takes long to find out."""
    return {
        "system": platform.platform(),
        "python": platform.python_version(),
        "versions": {name: version(name) for name in _PACKAGES},
    }


def _cause(error: BaseException) -> str:
    """Why a trial ended early, for its quarantine."""
    # compiled code that a signal interrupts raises an error of its own
    if isinstance(error, (KeyboardInterrupt, StopRequested)) or stopping.requested():
        return "stopped by a person"
    return f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
